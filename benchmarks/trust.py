"""Comparison of thousands of random problems with exact solutions of the same equations.

    python benchmarks/trust.py [--loops 5000] [--first 0] [--shaders 500] [--volumes 300]
                               [--seed 0] [--page FILE]
    python benchmarks/trust.py --only 123 [--backend opengl]

Every random problem (`random_problems.py`) is solved by the package on compiled loops or shaders,
and by `exact`, which shares only the equations with the package. Violations are errors of more than
three times the tolerance or the reported error, refusals of problems with a unique solution,
results other than the least motion for problems without a unique solution, and exceptions that are
not the package's. The compiled loops solve problems with odd numbers as large images, of which only
the rows of tissue are stored. A refusal is correct in three cases, which are decided without the
package: no tissue can move; there is a zero-energy motion (in the blanket reading, counted in
integer arithmetic, `exact.rank`); or the softest motion is so soft relative to the stiffest motion
(in 32 digits) that double precision cannot resolve the solution. Then small volumes
(`random_volumes.py`) are solved by loops only; a distance from a direct solve that exceeds the
reported error is a violation. Exits with 1 if there are violations.
"""

from __future__ import annotations

import argparse
import platform
import re
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np
import psutil
from random_problems import RandomProblem, random_problem
from random_volumes import judge as judge_volumes

from napari_hmrf import ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.errors import Cancelled, ConvergenceError, HmrfError, ProblemError
from napari_hmrf.solver.backends.cpu import layout
from validation.oracles.exact import Exact, exact_field
from validation.oracles.exact.rank import free_motions

#: Kinds of violations and their definitions.
KINDS = {
    "wrong": "further from the exact field than three times the tolerance",
    "reported": "further from the exact field than three times the reported error plus 1e-4 px",
    "refused": "refused, although there is a unique solution",
    "free": "not the field of least motion, although tissue is free to move",
    "crashed": "ended with an exception that is not the package's, or with non-finite values",
    "late": "not solved in time",
}
_TIMES = 3.0
_GRACE = 1e-4
_SECONDS = 300.0
# Largest accuracy of an exact field, in pixels, for which it is used.
_SURE = 1e-6
# Ratio of the softest to the stiffest motion below which double precision is insufficient.
_BEYOND = 1e-13
# Unit roundoff of double precision.
_ROUNDING = 2.0**-53
# Largest acceptable effect of rounding on the field, as a fraction of the tolerance.
_TOO_MUCH = 0.1
#: Refusals that are correct.
RIGHT = {
    "refused, free": "some tissue moves at no cost, or no tissue can move",
    "refused, sensitive": "the solution depends on digits beyond double precision",
}
_PAGE = """# Random problems against exact solutions

This campaign generates random problems of 1 to 64 pixels a side, with every kind of tissue, void,
observations, pixels and penalties, and with contrasts up to 1e7. Each problem is solved by the
package and by a direct solution of the same equations in 32 digits (`validation/oracles/exact`),
which shares no code with the package. Problems with odd numbers are solved as large images, of
which only the rows of tissue are stored. `make trust PAGE=docs/validation/trust.md` wrote this page
on {machine}.

{report}
"""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a problem.

    Attributes
    ----------
    number : int
        Number of the problem.
    backend : str
        Name of the backend.
    outcome : str
        ``"answered"``, ``"unsure"``, one of `RIGHT`, or one of `KINDS`.
    reading, tissue, words : str
        Name of the energy, kind of tissue, and description of the problem.
    contrast : float
        Ratio of the largest to the smallest stiffness.
    error, reported, tolerance : float
        Largest distance from the exact field, reported error, and tolerance, in pixels; NaN if
        there is none.
    seconds : float
        Time of the solver.
    saying : str
        Error message, if the problem was refused.
    ways : int
        Number of independent motions by which fields of the same energy differ.
    least : float
        For a refusal, ratio of the stiffness of the softest motion to that of the stiffest.
    swing : float
        For a violation, largest change of the exact field, in pixels, if the force of each
        observation changes by a factor of 1 + 1e-6 or 1 - 1e-6 at random.
    """

    number: int
    backend: str
    outcome: str
    reading: str
    tissue: str
    words: str
    contrast: float
    tolerance: float
    error: float = float("nan")
    reported: float = float("nan")
    seconds: float = 0.0
    saying: str = ""
    ways: int = 0
    least: float = float("nan")
    swing: float = 0.0

    @property
    def violation(self) -> bool:
        """True if the outcome is a violation."""
        return self.outcome in KINDS

    @property
    def decade(self) -> str:
        """Decade of the contrast."""
        return "uniform" if self.contrast == 1 else f"1e{int(np.floor(np.log10(self.contrast)))}"


def judge(drawn: RandomProblem, backend: str) -> Verdict:
    """Solve a problem and judge the result."""
    about = {
        "number": drawn.number,
        "backend": backend,
        "reading": drawn.reading,
        "tissue": drawn.tissue,
        "words": drawn.words,
        "contrast": drawn.contrast,
        "tolerance": drawn.tolerance,
    }
    try:
        problem = drawn.problem
    except HmrfError as error:
        return Verdict(outcome="refused", saying=str(error), **about)
    patience = threading.Event()
    alarm = threading.Timer(_SECONDS, patience.set)
    alarm.start()
    begun = time.perf_counter()
    solution, refusal, crash = None, None, ""
    try:
        with warnings.catch_warnings(), _layout_of(drawn.number):
            warnings.simplefilter("error", RuntimeWarning)
            optimizer = Multigrid(drawn.tolerance)
            solution = solve(
                problem, drawn.prior, optimizer=optimizer, backend=backend, cancel=patience
            )
    except HmrfError as error:
        refusal = error
    except Exception as error:  # noqa: BLE001 - unexpected errors are findings
        crash = f"{type(error).__name__}: {error}"
    finally:
        alarm.cancel()
    about["seconds"] = time.perf_counter() - begun
    if crash:
        return Verdict(outcome="crashed", saying=crash, **about)
    if isinstance(refusal, Cancelled):
        return Verdict(outcome="late", **about)
    truth = exact_field(problem, drawn.prior)
    if refusal is not None:
        outcome = why_refused(problem, drawn.prior, drawn.tolerance, truth, refusal)
        return Verdict(outcome=outcome, saying=str(refusal), least=truth.least, **about)
    assert solution is not None
    assert solution.convergence is not None
    if not truth.sure or not truth.accuracy < _SURE:
        return Verdict(outcome="unsure", **about)
    about["ways"], about["reported"] = truth.motions, solution.convergence.error
    about["error"] = error = _distance(solution.displacement / problem.unit, truth)
    if not np.isfinite(error):
        return Verdict(outcome="crashed", saying="not a number", **about)
    if error > _TIMES * drawn.tolerance:
        outcome = "wrong"
    elif error > _TIMES * solution.convergence.error + _GRACE:
        outcome = "reported"
    else:
        return Verdict(outcome="answered", **about)
    if truth.free:
        outcome = "free"
    return Verdict(outcome=outcome, swing=_swing(drawn, truth), **about)


def _layout_of(number: int) -> AbstractContextManager[object]:
    """Return a context in which images are stored without void if the number is odd."""
    return patch.dict(layout._FEW, {2: 0}) if number % 2 else nullcontext()


def why_refused(
    problem: Problem,
    prior: ElasticPrior | SeilerPrior,
    tolerance: float,
    truth: Exact,
    refusal: HmrfError,
) -> str:
    """Return the outcome of a refusal; ``"refused"`` if there is no explanation.

    Parameters
    ----------
    problem : Problem
        Problem that was refused.
    prior : ElasticPrior or SeilerPrior
        Prior of the solve.
    tolerance : float
        Tolerance of the solve, in pixels.
    truth : Exact
        Exact solution of the same problem.
    refusal : HmrfError
        Error that was raised.
    """
    if not isinstance(refusal, ProblemError | ConvergenceError):
        return "refused"
    everything = bool(problem.known[problem.tissue].all())
    if isinstance(refusal, ProblemError) and not truth.moving.any() and not everything:
        return "refused, free"
    blanket = isinstance(prior, SeilerPrior) and prior.conditional == "blanket"
    if free_motions(problem) if blanket else truth.least == 0:
        return "refused, free"
    reach = float(np.abs(problem.observed[problem.known]).max(initial=0.0)) / problem.unit
    # If several fields have the same energy, the solver must find the field of least motion.
    least = truth.least if truth.motions else min(truth.least, truth.least_found)
    swing = _ROUNDING * reach / max(least, 1e-300)
    beyond = least < _BEYOND or swing > _TOO_MUCH * tolerance
    # Insufficient precision does not explain a ProblemError, which claims non-uniqueness.
    sensitive = beyond and isinstance(refusal, ConvergenceError)
    return "refused, sensitive" if sensitive else "refused"


def _distance(displacement: np.ndarray, truth: Exact) -> float:
    """Return the largest distance of a site from its exact position, in pixels."""
    off = displacement.astype(np.float64) - truth.displacement
    off[~np.isfinite(off)] = np.inf
    return float(np.hypot(off[..., 0], off[..., 1]).max())


def _swing(drawn: RandomProblem, truth: Exact) -> float:
    """Return the largest change of the field for relative changes of each force by 1e-6."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], drawn.confidence.shape)
    other = exact_field(drawn.problem, drawn.prior, 1 + 1e-6 * signs)
    return _distance(other.displacement, truth) if other.sure else float("inf")


@dataclass
class Campaign:
    """Results of many problems.

    Attributes
    ----------
    seed : int
        Seed of the problems.
    verdicts : list of Verdict
        Outcome of each problem.
    seconds : float
        Total time.
    growth : dict of str to float
        Growth of memory after the first tenth of the problems of each backend, in MiB.
    """

    seed: int
    verdicts: list[Verdict]
    seconds: float = 0.0
    growth: dict[str, float] = field(default_factory=dict)

    @property
    def violations(self) -> list[Verdict]:
        """Violations, worst first."""
        found = [verdict for verdict in self.verdicts if verdict.violation]
        order = list(KINDS)
        return sorted(found, key=lambda v: (order.index(v.outcome), -np.nan_to_num(v.error)))

    @property
    def sound(self) -> bool:
        """True if there are no violations."""
        return not self.violations


def campaign(
    numbers: Iterable[tuple[int, str]], seed: int = 0, tell: Callable[[str], None] | None = None
) -> Campaign:
    """Judge problems that are given as pairs (number, backend)."""
    plan = list(numbers)
    run = Campaign(seed, [])
    process, begun = psutil.Process(), time.perf_counter()
    planned = Counter(backend for _, backend in plan)
    memory: dict[str, list[float]] = {backend: [] for backend in planned}
    last = 0.0
    for done, (number, backend) in enumerate(plan, start=1):
        run.verdicts.append(judge(random_problem(seed, number), backend))
        memory[backend].append(process.memory_info().rss / 2**20)
        latest = run.verdicts[-1]
        if tell is not None and latest.violation:
            tell(f"{latest.outcome}: {_line(latest, seed)} {latest.saying}")
        now = time.perf_counter()
        if tell is not None and (now - last > 10 or done == len(plan)):
            last = now
            worse = sum(verdict.violation for verdict in run.verdicts)
            tell(f"{done} of {len(plan)}, {worse} violations, {now - begun:.0f} s")
    run.seconds = time.perf_counter() - begun
    run.growth = {name: taken[-1] - taken[len(taken) // 10] for name, taken in memory.items()}
    return run


def report(run: Campaign, most: int = 10) -> str:
    """Return the findings in Markdown, with at most `most` violations of each kind."""
    verdicts = run.verdicts
    counts = Counter(verdict.outcome for verdict in verdicts)
    per_backend = Counter(verdict.backend for verdict in verdicts)
    ran = " and ".join(f"{count} on {name}" for name, count in per_backend.items())
    grown = " and ".join(f"{size:.0f} ({name})" for name, size in run.growth.items())
    solver = sum(verdict.seconds for verdict in verdicts)
    lines = [
        f"{len(verdicts)} problems of seed {run.seed} ({ran}) in {run.seconds:.0f} s;",
        f"the solver took {solver:.0f} s of it. Memory grew by {grown} MiB after the first tenth.",
        f"**{len(run.violations)} violations.** {counts['answered']} problems were solved within",
        f"the bounds, {counts['refused, free']} were refused because tissue was free to move, and",
        f"{counts['refused, sensitive']} because double precision is insufficient. The exact field",
        f"of {counts['unsure']} problems is not sure.",
        "",
    ]
    lines += [f"- *{kind}*: {meaning}." for kind, meaning in RIGHT.items()]
    lines += [f"- *{kind}*: {meaning}." for kind, meaning in KINDS.items()]
    for name, key in (
        ("energy", lambda v: v.reading),
        ("contrast", lambda v: v.decade),
        ("tissue", lambda v: v.tissue),
        ("device", lambda v: v.backend),
    ):
        lines += ["", *_table(name, verdicts, key)]
    softest = [v.least for v in verdicts if v.outcome == "refused, sensitive"]
    if softest:
        text = f"{min(softest):.1e} to {max(softest):.1e}"
        lines += ["", f"Softest motions of problems refused as sensitive: {text} of the stiffest."]
    lines += ["", *_ratios(verdicts)]
    for kind in KINDS:
        found = [verdict for verdict in run.violations if verdict.outcome == kind]
        groups: dict[str, list[Verdict]] = {}
        for verdict in found:
            groups.setdefault(_gist(verdict.saying), []).append(verdict)
        for gist, group in sorted(groups.items(), key=lambda item: -len(item[1])):
            said = f" with the message “{gist}”" if gist else ""
            worst = "; the worst are" if len(group) > most else ""
            lines += ["", f"**{kind}**: {len(group)}{said}{worst}", ""]
            lines += [f"- {_line(verdict, run.seed)}" for verdict in group[:most]]
    return "\n".join(lines)


def _gist(saying: str) -> str:
    """Return the start of a message without numbers."""
    return re.sub(r"\(?-?\d[\d.,e+\-x ]*\)?", "# ", saying)[:90]


def _table(name: str, verdicts: list[Verdict], key: Callable[[Verdict], str]) -> list[str]:
    """Return the table of the number of outcomes by class."""
    columns = ["answered", *RIGHT, "unsure", *KINDS]
    lines = [
        f"| {name} | problems | " + " | ".join(columns) + " |",
        "| --- |" + " ---: |" * (1 + len(columns)),
    ]
    for value in sorted({key(verdict) for verdict in verdicts}):
        counts = Counter(verdict.outcome for verdict in verdicts if key(verdict) == value)
        cells = [counts.total(), *(counts[column] for column in columns)]
        lines.append(f"| {value} | " + " | ".join(str(cell or "") for cell in cells) + " |")
    return lines


def _ratios(verdicts: list[Verdict]) -> list[str]:
    """Return the table of true errors relative to reported errors and to the tolerance."""
    answered = [v for v in verdicts if np.isfinite(v.error) and v.outcome != "free"]
    if not answered:
        return []
    parts = (50, 90, 99, 99.9, 100)
    lines = [
        "| true error over | " + " | ".join(f"{part} %" for part in parts) + " |",
        "| --- |" + " ---: |" * len(parts),
    ]
    for name, ratio in (
        ("reported", [v.error / max(v.reported, _GRACE) for v in answered]),
        ("tolerance", [v.error / v.tolerance for v in answered]),
    ):
        values = np.percentile(ratio, parts)
        lines.append(f"| {name} | " + " | ".join(f"{value:.2g}" for value in values) + " |")
    lines += ["", "(Reported errors below 1e-4 px count as 1e-4 px here.)"]
    return lines


def _line(verdict: Verdict, seed: int) -> str:
    """Return a line about a violation, with the options that reproduce it."""
    found = f"`--seed {seed} --only {verdict.number} --backend {verdict.backend}`: "
    found += f"{verdict.reading}, {verdict.words}"
    if np.isfinite(verdict.error):
        found += f": true {verdict.error:.2g} px, reported {verdict.reported:.2g} px"
    if np.isfinite(verdict.least):
        found += f"; softest motion {verdict.least:.1e} of the stiffest"
    if verdict.ways:
        found += f"; {verdict.ways} motions cost nothing"
    if verdict.swing > 1e-4:
        found += f"; a change of each force by a millionth moves {verdict.swing:.2g} px"
    return found


def _page(run: Campaign, volumes: str = "") -> str:
    machine = f"{platform.system()}, {psutil.cpu_count()} cores, Python {platform.python_version()}"
    return _PAGE.format(machine=machine, report=report(run) + volumes)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign and print the findings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, default=5000, help="problems for the compiled loops")
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--shaders", type=int, default=500, help="problems for the shaders")
    parser.add_argument("--volumes", type=int, default=300, help="small volumes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the only problems to run")
    parser.add_argument("--backend", help="for --only: cpu, which is the default, or opengl")
    parser.add_argument("--page", type=Path, help="path of a page to write")
    parser.add_argument("--worst", type=int, default=10, help="number of each kind to list")
    options = parser.parse_args(arguments)
    if options.only is None:
        if options.backend:
            parser.error("--backend requires --only; otherwise use --loops and --shaders")
        first = options.first
        plan = [(k, "cpu") for k in range(first, first + options.loops)]
        plan += [(k, "opengl") for k in range(first, first + options.shaders)]
    else:
        plan = [(k, options.backend or "cpu") for k in options.only]
    run = campaign(plan, options.seed, lambda said: print(said, file=sys.stderr, flush=True))
    volumes, wrong = "", 0
    if options.only is None and options.volumes:
        volumes, wrong = judge_volumes(range(options.seed, options.seed + options.volumes))
        volumes = f"\n\n## Volumes\n\n{volumes}"
    if options.page is not None:
        options.page.write_text(_page(run, volumes), encoding="utf-8")
    if options.only is not None:
        for verdict in run.verdicts:
            print(f"{verdict.outcome}: {_line(verdict, options.seed)}")
            if verdict.saying:
                print(f"    “{verdict.saying}”")
    else:
        print(report(run, options.worst) + volumes)
    return 0 if run.sound and not wrong else 1


if __name__ == "__main__":
    sys.exit(main())
