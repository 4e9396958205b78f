"""Random sequences of edits: live solver results compared with cold solves at a tight tolerance.

    python benchmarks/live_edits.py [--sequences 2000] [--first 0] [--seed 0] [--page FILE]
    python benchmarks/live_edits.py --seed 0 --only 123

Even-numbered sequences start with a random problem (`random_problems.py`). The other sequences
start with a body of mild tissue with prescribed edges, as in typical use. Patches are pulled,
dragged in small steps and released; confidence, stiffness, Poisson's ratio and the penalty change;
tissue is removed, added and grows; and edits are undone. Every result of the live solver, which
starts from earlier results, is compared with a cold solve of the same problem. A violation is a
difference that exceeds the sum of the two reported errors, or a refusal by only one of the two
solves; a cold solve that fails is repeated at the tolerance of the live solver. A refusal is not a
violation if the exact solution explains it: the solution is not unique, or double precision cannot
resolve it. Results that take minutes are counted as late; the user can cancel them. Exits with 1 if
there are violations.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from random_problems import noise, random_problem
from trust import why_refused

from napari_hmrf import ElasticPrior, LiveSolver, Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.errors import ConvergenceError, HmrfError, ProblemError
from napari_hmrf.loads import growth
from napari_hmrf.solver.live_solver import TOLERANCE, Update
from validation.oracles.exact import exact_field

#: Tolerance of cold solves, in pixels.
COLD = 1e-4
#: Largest difference that is not a violation, in pixels; rounding in double precision is smaller.
GRACE = 1e-9
#: Time after which a sequence ends without a result of the live solver, in seconds.
PATIENCE = 120.0
_EXPLAINED, _LATE = "one refuses, rightly", "late"
_FEWEST, _MOST = 3, 12
_SHARES = {
    "pull": 0.14,
    "move": 0.3,
    "let go": 0.05,
    "confidence": 0.07,
    "stiffness": 0.08,
    "penalty": 0.05,
    "poisson": 0.04,
    "remove": 0.06,
    "add": 0.04,
    "growth": 0.06,
    "undo": 0.11,
}
_PAGE = """# Live edits against cold solves

The live solver starts each solve from its earlier results. `make edits` compares its answers with
cold solves at a tolerance of {cold:g} px.

{report}
"""


class State(NamedTuple):
    """Problem and prior that are being edited."""

    problem: Problem
    prior: ElasticPrior | SeilerPrior


@dataclass(frozen=True)
class Answer:
    """Comparison of one live result with a cold solve.

    Attributes
    ----------
    sequence, step : int
        Number of the sequence, and of the edit in it.
    kind : str
        Kind of edit.
    reading : str
        Name of the energy.
    difference, live, cold : float
        Largest distance between the two results, and their reported errors, in pixels.
    message : str
        Error message if a solve was refused.
    outcome : str
        ``"agree"``, ``"differ"``, ``"both refuse"``, ``"live alone refuses"``,
        ``"cold alone refuses"``, ``"one refuses, rightly"``, ``"late"`` or
        ``"crashed"``.
    """

    sequence: int
    step: int
    kind: str
    reading: str
    outcome: str
    difference: float = math.nan
    live: float = math.nan
    cold: float = math.nan
    message: str = ""

    @property
    def is_violation(self) -> bool:
        """True if the two results contradict each other."""
        return self.outcome not in ("agree", "both refuse", _EXPLAINED, _LATE)


def start_of(seed: int, sequence: int) -> State:
    """Return the initial state of a sequence.

    Parameters
    ----------
    seed, sequence : int
        Seed of the campaign, and number of the sequence.
    """
    if sequence % 2 == 0:
        drawn = random_problem(seed, sequence)
        return State(drawn.problem, drawn.prior)
    dice = np.random.default_rng([seed, sequence, 2])
    shape = tuple(dice.integers(16, 81, 2))
    m = 10 ** (dice.uniform(0, 2) * (noise(dice, shape, dice.uniform(1, 6)) > dice.random()))
    if dice.random() < 0.3:
        m[noise(dice, shape, dice.uniform(2, 6)) < dice.uniform(0.02, 0.2)] = 0
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    edges = np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]
    for edge in dice.permutation(4)[: dice.integers(1, 5)]:
        c[edges[edge]] = 1
    c[m == 0] = 0
    spacing = (1.0, 1.0) if dice.random() < 0.6 else tuple(dice.uniform(0.5, 2, 2))
    nu, plane = float(dice.choice([0.0, 0.3, 0.45, 0.49])), str(dice.choice(["stress", "strain"]))
    penalty = math.inf if dice.random() < 0.6 else float(10 ** dice.uniform(-2, 2))
    prior: ElasticPrior | SeilerPrior = ElasticPrior(nu, plane=plane, penalty=penalty)
    if dice.random() < 0.25:
        prior = SeilerPrior(conditional=str(dice.choice(["centred", "blanket"])))
    return State(Problem(observed=y, confidence=c, stiffness=m, spacing=spacing), prior)


def states_of(start: State, dice: np.random.Generator) -> Iterator[tuple[str, State]]:
    """Yield the kind of each edit and the state after it.

    Parameters
    ----------
    start : State
        Initial state.
    dice : numpy.random.Generator
        Random number generator.
    """
    state = start
    history, patch = [state], np.zeros(state.problem.shape, dtype=bool)
    pull = np.zeros(2)
    yield "begin", state
    for _ in range(int(dice.integers(_FEWEST, _MOST))):
        kind = str(dice.choice([*_SHARES], p=[*_SHARES.values()]))
        if kind == "undo":
            back = int(dice.integers(1, 4))
            state = history[-1 - min(back, len(history) - 1)]
        else:
            if kind == "pull" or not patch.any():
                patch, pull = _patch(dice, state.problem), dice.normal(size=2)
                pull *= 10 ** dice.uniform(-1.5, 0.7)
            elif kind == "move":
                pull = pull + dice.normal(size=2) * 10 ** dice.uniform(-2, 0)
            state = _edited(kind, state, patch, pull, dice)
        history.append(state)
        yield kind, state


def _patch(dice: np.random.Generator, problem: Problem) -> np.ndarray:
    """Return the mask of a disc around a random tissue site."""
    at = dice.choice(np.argwhere(problem.tissue))
    rows, cols = np.indices(problem.shape)
    radius = dice.uniform(0.5, 1 + max(problem.shape) / 8)
    return np.asarray(np.hypot(rows - at[0], cols - at[1]) <= radius)


def _edited(
    kind: str, state: State, patch: np.ndarray, pull: np.ndarray, dice: np.random.Generator
) -> State:
    """Return the state after an edit."""
    problem, prior = state
    loads = problem.loads
    y, c, m = (
        np.array(each, dtype=np.float64)
        for each in (problem.observed, problem.confidence, problem.stiffness)
    )
    if kind in ("pull", "move"):
        y[patch] = pull * problem.unit
        c[patch] = 1
    elif kind == "let go":
        c[patch] = 0
    elif kind == "confidence":
        c[patch] = dice.uniform(0.01, 1)
    elif kind == "stiffness":
        m[patch] *= 10 ** dice.uniform(-2, 2)
    elif kind == "penalty":
        penalty = float(10 ** dice.uniform(-2, 3))
        prior = replace(prior, penalty=penalty)
    elif kind in ("remove", "add"):
        place = _patch(dice, problem)
        m[place] = 0 if kind == "remove" else np.where(m > 0, m, np.median(m[m > 0]))[place]
    elif isinstance(prior, ElasticPrior) and kind == "growth":
        place = np.where(_patch(dice, problem), dice.uniform(-0.2, 0.3), 0)
        loads = growth(place) if loads is None else loads + growth(place)
    elif isinstance(prior, ElasticPrior):
        prior = replace(prior, poisson=float(dice.choice([0.0, 0.3, 0.45, 0.49])))
    given = {"observed": y, "confidence": c, "stiffness": m, "spacing": problem.spacing}
    return State(Problem(**given, loads=loads), prior)


def judge(seed: int, sequence: int) -> list[Answer]:
    """Run a sequence on the live solver and compare each result.

    Parameters
    ----------
    seed, sequence : int
        Seed of the campaign, and number of the sequence.
    """
    try:
        start = start_of(seed, sequence)
    except HmrfError:
        return []  # the random tissue touches none of the prescribed edges
    dice = np.random.default_rng([seed, sequence, 1])
    updates: list[Update] = []
    steps: list[tuple[str, State, Update]] = []
    late: State | None = None
    edits = states_of(start, dice)
    # Run the cold solves afterwards, because the live solver would reuse their results. An edit
    # that yields an invalid problem ends the sequence.
    with suppress(HmrfError), LiveSolver(updates.append, backend="cpu") as live:
        for kind, state in edits:
            live.submit(state)
            if not live.wait(PATIENCE):
                late = state
                break
            steps.append((kind, state, updates[-1]))
    answers = [
        _compared(update, state, sequence, number, kind)
        for number, (kind, state, update) in enumerate(steps)
    ]
    if late is not None:
        answers.append(Answer(sequence, len(steps), kind, _reading(late.prior), _LATE))
    return answers


def _compared(update: Update, state: State, sequence: int, step: int, kind: str) -> Answer:
    """Compare a result of the live solver with a cold solve."""
    about: dict[str, Any] = {"sequence": sequence, "step": step, "kind": kind}
    about["reading"] = _reading(state.prior)
    cold, refusal = _cold(state, COLD)
    if cold is None and update.solution is not None:
        # The tight tolerance may be out of reach where that of the live solver is not.
        cold, refusal = _cold(state, TOLERANCE)
    if update.solution is None:
        if not isinstance(update.error, ProblemError | ConvergenceError):
            return Answer(outcome="crashed", message=repr(update.error), **about)
        outcome = "both refuse"
        if cold is not None:
            outcome = _alone("live", state, TOLERANCE, update.error)
        return Answer(outcome=outcome, message=str(update.error), **about)
    if cold is None:
        assert refusal is not None
        outcome = _alone("cold", state, TOLERANCE, refusal)
        return Answer(outcome=outcome, message=str(refusal), **about)
    assert update.solution.convergence is not None
    assert cold.convergence is not None
    both = update.solution.displacement, cold.displacement
    apart = (both[0].astype(np.float64) - both[1]) / state.problem.unit
    difference = float(np.hypot(apart[..., 0], apart[..., 1]).max())
    errors = update.solution.convergence.error, cold.convergence.error
    outcome = "agree" if difference <= sum(errors) + GRACE else "differ"
    return Answer(outcome=outcome, difference=difference, live=errors[0], cold=errors[1], **about)


def _cold(state: State, tolerance: float) -> tuple[Solution | None, HmrfError | None]:
    """Solve without earlier results; return the solution, or the reason of the refusal."""
    try:
        optimizer = Multigrid(tolerance)
        return solve(state.problem, state.prior, optimizer=optimizer, backend="cpu"), None
    except (ProblemError, ConvergenceError) as error:
        return None, error


def _alone(who: str, state: State, tolerance: float, refusal: HmrfError) -> str:
    """Return the outcome if only one of the two solves was refused."""
    truth = exact_field(*state)
    why = why_refused(*state, tolerance, truth, refusal)
    return f"{who} alone refuses" if why == "refused" else _EXPLAINED


def _reading(prior: ElasticPrior | SeilerPrior) -> str:
    """Return the name of the energy."""
    if isinstance(prior, ElasticPrior):
        how = "held" if prior.penalty == math.inf else "slips"
        return f"elastic {prior.plane}, {how}"
    return str(prior.conditional)


def report(answers: list[Answer], seed: int, sequences: range, seconds: float) -> str:
    """Return the findings in Markdown.

    Parameters
    ----------
    answers : list of Answer
        All comparisons.
    seed : int
        Seed of the campaign.
    sequences : range
        Numbers of the sequences.
    seconds : float
        Duration of the campaign.
    """
    counts = Counter(answer.outcome for answer in answers)
    violations = [answer for answer in answers if answer.is_violation]
    compared = [a for a in answers if math.isfinite(a.difference)]
    parts = [a.difference / max(a.live + a.cold, 1e-12) for a in compared]
    lines = [
        f"Sequences {sequences.start} to {sequences.stop - 1} of seed {seed}:",
        f"{len(answers)} answers in {seconds:.0f} s, tolerance {TOLERANCE:g} px.",
        f"**{len(violations)} violations.** "
        + ", ".join(f"{count} {name}" for name, count in counts.most_common())
        + ".",
    ]
    if parts:
        values = np.percentile(parts, (50, 90, 99, 100))
        worst = ", ".join(f"{value:.2g}" for value in values)
        lines.append(f"Difference over the sum of both errors, 50, 90, 99, 100 %: {worst}.")
    lines += ["", "| energy | answers | violations |", "| --- | ---: | ---: |"]
    for name in sorted({answer.reading for answer in answers}):
        some = [answer for answer in answers if answer.reading == name]
        lines.append(f"| {name} | {len(some)} | {sum(a.is_violation for a in some) or ''} |")
    lines += ["", *(_line(answer, seed) for answer in violations)]
    return "\n".join(lines)


def _line(answer: Answer, seed: int) -> str:
    """Return a line about a violation, with the command that reproduces it."""
    text = f"- `--seed {seed} --only {answer.sequence}` step {answer.step} ({answer.kind}), "
    text += f"{answer.reading}: {answer.outcome}"
    if math.isfinite(answer.difference):
        text += f" by {answer.difference:.3g} px, live {answer.live:.2g}, cold {answer.cold:.2g}"
    return text + (f": {answer.message[:160]}" if answer.message else "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign and print the findings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0, help="number of the first sequence")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="run only this sequence")
    parser.add_argument("--page", type=Path, help="path of a page to write")
    options = parser.parse_args(arguments)
    sequences = range(options.first, options.first + options.sequences)
    if options.only is not None:
        sequences = range(options.only, options.only + 1)
    begun, answers, last = time.perf_counter(), list[Answer](), 0.0
    for sequence in sequences:
        found = judge(options.seed, sequence)
        answers += found
        for answer in found:
            if answer.is_violation or options.only is not None:
                print(_line(answer, options.seed), file=sys.stderr, flush=True)
        if time.perf_counter() - last > 10:
            last = time.perf_counter()
            print(f"{sequence}, {len(answers)} answers, {last - begun:.0f} s", file=sys.stderr)
    text = report(answers, options.seed, sequences, time.perf_counter() - begun)
    print(text)
    if options.page is not None:
        options.page.write_text(_PAGE.format(cold=COLD, report=text), encoding="utf-8")
    return 1 if any(answer.is_violation for answer in answers) else 0


if __name__ == "__main__":
    sys.exit(main())
