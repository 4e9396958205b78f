"""Random problems by the thousand, each compared with a reference.

    python -m benchmarks.campaign images=5000 volumes=600 [--seed 0] [--first 0] [--backend opengl]
    python -m benchmarks.campaign images --only 123

A name alone runs the usual number of problems. `validation/problems.py` draws the problems, and the
functions that judge them describe the references and what is a fault. Prints the outcomes by kind
of problem, and each fault with the command that repeats it. Exits with 1 if there is any.
"""

from __future__ import annotations

import argparse
import itertools
import math
import re
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks.clock import MemoryGrowth, now, since
from benchmarks.table import markdown
from napari_hmrf import ElasticPrior, LiveSolver, Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.errors import Cancelled, ConvergenceError, HmrfError, ProblemError
from napari_hmrf.field.followers import followers_of
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.fields import count_folds
from napari_hmrf.solver.backends.cpu import layout
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.live_solver import TOLERANCE, Update
from napari_hmrf.solver.priors.finite_strain import BARRIER_BEGIN
from napari_hmrf.solver.unfolded import unfolded
from validation.bodies import between_plates, dice_of
from validation.oracles.elasticity import direct_solution
from validation.oracles.exact import Exact, exact_field
from validation.oracles.exact.equations import free_motions
from validation.oracles.large_motion import large_field, smallest_jacobian, with_stiff_bodies
from validation.oracles.large_sliding import NotSettledError, large_sliding_field
from validation.oracles.paper import solve_exactly
from validation.oracles.parts import dense_solution, forces_of, sliding_field
from validation.oracles.posterior import posterior_mean
from validation.oracles.slipping import Slipped, slipped
from validation.problems import (
    INPUTS,
    LargeMotion,
    RandomProblem,
    State,
    edits_of,
    mild_tissue,
    random_combination,
    random_data,
    random_large_data,
    random_large_motion,
    random_large_parts,
    random_parts,
    random_problem,
    tissue_with_gaps,
    tissue_with_parts,
)

_TIMES = 3.0
_GRACE = 1e-4
# Time after which a solve is late, and after which a sequence of edits ends, in seconds.
_SECONDS, _PATIENCE = 300.0, 120.0
# Largest accuracy of an exact field, in pixels, for which it is used.
_SURE = 1e-6
# Ratio of the softest to the stiffest motion below which double precision is insufficient.
_BEYOND = 1e-13
# Unit roundoff of double precision.
_ROUNDING = 2.0**-53
# Largest acceptable effect of rounding on the field, as a fraction of the tolerance.
_TOO_MUCH = 0.1
# Rounding of values that are stored in single precision, in pixels, for targets of large motion.
_ROUNDED, _ROUNDED_TARGETS = 1e-6, 1e-5
# Rounding of a field that consists of several, as with a drift, in pixels.
_ROUNDED_FIELD = 1e-5
# Largest error of a problem with a cavity or parts, and largest motion before it is scaled down,
# in pixels.
_LARGEST, _MOTION = 0.01, 4.0
# Least eigenvalue, of a matrix with a diagonal of 1, below which a dense system is singular.
_SINGULAR = 1e-10
# Tilt of the normals of interfaces in degrees, number of tilts, and change of the field, relative
# to its largest value, from which labels do not determine the motion. Fitted normals of small
# curved interfaces have errors of this size.
_TILT, _TILTS, _UNDETERMINED = 2.0, 4, 0.3
#: Largest accepted ratio of the error beside gaps to the larger of report and tolerance.
BOUND = 1.05
# Tolerance of cold solves, and largest difference that is due to rounding, in pixels.
_COLD, _GRACE_OF_EDITS = 1e-4, 1e-9
# Largest distance of the tissue from a target that is reached, in pixels.
_MET = 0.01
# Stiffnesses of stiff tissue whose limit is rigid tissue, relative to the stiffest tissue.
_STIFF = 1e5, 1e6
# Shapes of volumes that test the memory, and largest accepted growth, in MB.
_SHAPES = tuple(itertools.product((4, 6, 8, 10, 12, 13), (5, 7, 9, 11, 12, 13), (4, 8, 13)))
_GROWTH = 100.0

#: Outcomes that are faults, and their definitions.
FAULTS = {
    "wrong": "further from the reference than the tolerance or the bound of the campaign allows",
    "reported": "further from the reference than the reported error allows",
    "refused": "refused, although there is a unique solution",
    "free": "not the field of least motion, although tissue is free to move",
    "crashed": "ended with an exception that is not the package's, or with non-finite values",
    "late": "not solved in time",
    "differs": "an edit differs from a cold solve by more than the sum of both reported errors",
    "one refuses": "an edit or its cold solve is refused, but not both",
    "folded": "large motion with folds or values that are not numbers",
    "unreported": "an error beyond the tolerance, or a missed target, is not reported",
    "farther": "large motion that was continued is refused or ends farther from its targets",
}


@dataclass(frozen=True)
class Verdict:
    """Outcome of a solve.

    Attributes
    ----------
    outcome : str
        One of `FAULTS`, or another word.
    kinds : dict of str to str
        Kinds of the problem, for the tables.
    error, reported, tolerance : float
        True and reported error and tolerance, in pixels; NaN if there is none.
    seconds : float
        Time of the solver.
    note : str
        Description of the problem, reason of a refusal, further findings.
    """

    outcome: str
    kinds: dict[str, str] = field(default_factory=dict)
    error: float = math.nan
    reported: float = math.nan
    tolerance: float = math.nan
    seconds: float = 0.0
    note: str = ""

    @property
    def is_fault(self) -> bool:
        """True if the outcome is a fault."""
        return self.outcome in FAULTS


def judge_image(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare an image with a solution in 32 digits, which shares only the equations.

    Faults are errors of more than three times the tolerance, or of the reported error plus 1e-4 px,
    and results other than the least motion where tissue is free. A refusal is right in three cases,
    which are decided without the package: no tissue can move; there is a motion without energy (in
    the blanket reading, counted in integers); or the softest motion is too soft, relative to the
    stiffest, for double precision. Loops solve odd numbers as large images, without their void.
    """
    yield _judged_image(random_problem(dice_of(seed, number)), backend, number % 2 == 1)


def _judged_image(drawn: RandomProblem, backend: str, as_large: bool) -> Verdict:
    about: dict[str, Any] = {"kinds": drawn.kinds | {"device": backend}, "note": str(drawn)}
    try:
        problem = drawn.problem
    except HmrfError as error:
        return Verdict("refused", **about | {"note": f"{drawn}: {error}"})
    patience = threading.Event()
    alarm = threading.Timer(_SECONDS, patience.set)
    alarm.start()
    begun = now()
    solution, refusal = None, None
    try:
        with warnings.catch_warnings(), ExitStack() as stack:
            warnings.simplefilter("error", RuntimeWarning)
            if as_large:
                stack.enter_context(patch.dict(layout._FEW, {2: 0}))
            optimizer = Multigrid(drawn.tolerance)
            solution = solve(
                problem, drawn.prior, optimizer=optimizer, backend=backend, cancel=patience
            )
    except Cancelled:
        return Verdict("late", **about)
    except HmrfError as error:
        refusal = error
    except Exception as error:  # noqa: BLE001 - unexpected errors are findings
        return Verdict("crashed", **about | {"note": f"{drawn}: {type(error).__name__}: {error}"})
    finally:
        alarm.cancel()
    about |= {"seconds": since(begun).wall, "tolerance": drawn.tolerance}
    truth = exact_field(problem, drawn.prior)
    if solution is None:
        assert refusal is not None
        about["note"] += f": {refusal}; softest motion {truth.least:.1e} of the stiffest"
        return Verdict(why_refused(problem, drawn.prior, drawn.tolerance, truth, refusal), **about)
    assert solution.convergence is not None
    if not truth.sure or not truth.accuracy < _SURE:
        return Verdict("unsure", **about)
    about["reported"] = reported = solution.convergence.error
    about["error"] = error = _apart(solution.displacement / problem.unit, truth.displacement)
    if not np.isfinite(error):
        return Verdict("crashed", **about)
    if error <= _TIMES * drawn.tolerance and error <= _TIMES * reported + _GRACE:
        return Verdict("right", **about)
    about["note"] += f"; {truth.motions} motions cost nothing" if truth.motions else ""
    about["note"] += f"; a change of each force by a millionth moves {_swing(drawn, truth):.2g} px"
    wrong = "wrong" if error > _TIMES * drawn.tolerance else "reported"
    return Verdict("free" if truth.free else wrong, **about)


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
        return "refused: free"
    blanket = isinstance(prior, SeilerPrior) and prior.conditional == "blanket"
    if free_motions(problem) if blanket else truth.least == 0:
        return "refused: free"
    reach = float(np.abs(problem.observed[problem.known]).max(initial=0.0)) / problem.unit
    # If several fields have the same energy, the solver must find the field of least motion.
    least = truth.least if truth.motions else min(truth.least, truth.least_found)
    swing = _ROUNDING * reach / max(least, 1e-300)
    beyond = least < _BEYOND or swing > _TOO_MUCH * tolerance
    # Insufficient precision does not explain a ProblemError, which claims non-uniqueness.
    sensitive = beyond and isinstance(refusal, ConvergenceError)
    return "refused: sensitive" if sensitive else "refused"


def _apart(one: Any, two: Any) -> float:
    """Return the largest distance of a site in two fields; infinity if one is not a number."""
    off = np.asarray(one, np.float64) - two
    return float(np.linalg.norm(np.where(np.isfinite(off), off, np.inf), axis=-1).max(initial=0))


def _swing(drawn: RandomProblem, truth: Exact) -> float:
    """Return the largest change of the field for relative changes of each force by 1e-6."""
    signs = dice_of(0).choice([-1.0, 1.0], drawn.problem.confidence.shape)
    other = exact_field(drawn.problem, drawn.prior, 1 + 1e-6 * signs)
    return _apart(other.displacement, truth.displacement) if other.sure else math.inf


def judge_volume(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare a small volume with a direct solve: elements by scikit-fem, or the paper's model.

    Errors above the reported error are faults. Every second volume is solved as if it were too
    large for a factorization, and every second pair is stored without void, as large volumes are.
    """
    drawn = random_problem(dice_of(seed, number), axes=3)
    try:
        with ExitStack() as as_large:
            if number % 2:
                as_large.enter_context(patch.object(Factors, "fit", staticmethod(lambda *_: False)))
            if number % 4 > 1:
                as_large.enter_context(patch.dict(layout._FEW, {3: 0}))
            optimizer = Multigrid(drawn.tolerance)
            found = solve(drawn.problem, drawn.prior, optimizer=optimizer, backend=backend)
    except ProblemError:
        yield Verdict("refused: free", drawn.kinds)
        return
    except ConvergenceError as error:
        yield Verdict("refused: no bound", drawn.kinds, note=f"{drawn}: {error}")
        return
    problem, prior = drawn.problem, drawn.prior
    is_paper = isinstance(prior, SeilerPrior)
    truth = solve_exactly(problem, "centred") if is_paper else direct_solution(problem, prior)
    of = found.convergence
    assert of is not None
    error = float(np.abs(found.displacement - truth)[problem.tissue].max()) / problem.unit
    outcome = "right" if error <= of.error + _ROUNDED else "reported"
    kinds = drawn.kinds | {"way": of.way}
    yield Verdict(outcome, kinds, error, of.error, drawn.tolerance, note=str(drawn))


def judge_parts(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare a problem with a cavity, sliding parts or both with a dense solution.

    Faults are errors above 0.01 px, or above three times the reported error plus 1e-4 px. A refusal
    is a fault unless the dense system is singular, or small tilts of the normals of interfaces
    change the field as much as its own size.
    """
    axes, kind = 3 if number // 3 % 3 == 0 else 2, ("cavity", "sliding", "both")[number % 3]
    drawn = random_parts(dice_of(seed, number), axes, kind != "sliding", kind != "cavity")
    kinds = {"problem": f"{kind}, {'images' if axes == 2 else 'volumes'}"} | drawn.kinds
    exact, least = _reference_of_parts(drawn)
    if np.abs(exact).max() > _MOTION:  # False if the field is unknown
        share = _MOTION / float(np.abs(exact).max())
        drawn, exact = drawn.scaled(share), share * exact
    try:
        found = solve(drawn.problem, drawn.prior, backend=backend)
    except (ProblemError, ConvergenceError) as refusal:
        outcome = "refused" if least > _SINGULAR else "refused: singular"
        if outcome == "refused" and _depends_on_normals(drawn, exact):
            outcome = "refused: motion depends on the normals"
        yield Verdict(outcome, kinds, note=f"{drawn}, least eigenvalue {least:.1e}: {refusal}")
        return
    except Exception as crash:  # noqa: BLE001  any other error is a fault
        yield Verdict("crashed", kinds, note=f"{drawn}: {crash!r}")
        return
    if not np.isfinite(exact).all():
        yield Verdict("solved, singular", kinds, note=str(drawn))
        return
    yield _beside(found, drawn.problem, exact, kinds, f"{drawn}, least eigenvalue {least:.1e}")


def _beside(
    found: Solution, problem: Problem, exact: np.ndarray, kinds: dict[str, str], note: str = ""
) -> Verdict:
    """Compare a solution with the exact field in pixels, at the sites of elements."""
    of = found.convergence
    assert of is not None
    whole = sites_of_elements(problem.stiffness)
    error = float(np.abs(found.displacement / problem.unit - exact)[whole].max())
    outcome = "right" if error <= _LARGEST else "wrong"
    if outcome == "right" and error > _TIMES * of.error + _GRACE:
        outcome = "reported"
    return Verdict(outcome, kinds, error, of.error, Multigrid().tolerance, note=note)


# Pairs of inputs, in the order of their numbers; every fourth problem has a third input.
_PAIRS = tuple(itertools.combinations(INPUTS, 2))


def judge_combination(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare a pair of inputs of small elastic tissue with a dense solution.

    Images and volumes of all pairs follow each other. Errors above the reported error are faults,
    except for fields of the same energy. So are refusals, unless tissue is free to move, loads
    exceed the forces of all observations that may slip, landmarks determine a strain of the drift
    to no better than 100 % or compress tissue to nothing, or small tilts of the normals of
    interfaces change the field as much as its own size.
    """
    dice = dice_of(seed, number)
    axes = 3 if number // len(_PAIRS) % 2 else 2
    inputs = set(_PAIRS[number % len(_PAIRS)])
    if dice.random() < 0.25:
        inputs.add(str(dice.choice(INPUTS)))
    drawn = random_combination(dice, axes, frozenset(inputs))
    kinds = {"problem": "images" if axes == 2 else "volumes", "inputs": drawn.kinds["inputs"]}
    exact = _reference_of(drawn)
    most = float(np.abs(exact.field).max())
    if most > _MOTION:
        drawn = drawn.scaled(_MOTION / most)
        exact = _reference_of(drawn)
    begun = now()
    try:
        optimizer = Multigrid(drawn.tolerance)
        found = solve(drawn.problem, drawn.prior, optimizer=optimizer, backend=backend)
    except (ProblemError, ConvergenceError) as refusal:
        outcome = "refused: free" if exact.is_free else "refused"
        if not exact.is_proven:
            outcome = "refused: no minimum"
        elif exact.least_strain <= -1 or exact.strain_sd > 1:
            outcome = "refused: no drift"
        elif outcome == "refused" and _depends_on_normals(drawn, exact.field):
            outcome = "refused: motion depends on the normals"
        seconds = since(begun).wall
        yield Verdict(outcome, kinds, seconds=seconds, note=f"{drawn}: {refusal}")
        return
    except Exception as crash:  # noqa: BLE001  any other error is a fault
        yield Verdict("crashed", kinds, note=f"{drawn}: {crash!r}")
        return
    seconds, of = since(begun).wall, found.convergence
    assert of is not None
    moved = found.displacement / drawn.problem.unit
    compared = sites_of_elements(drawn.problem.stiffness)
    followers = followers_of(drawn.problem.tissue)
    if drawn.problem.sliding is None and followers is not None:
        compared.ravel()[followers.sites] = True
    error = float(np.abs(moved - exact.field)[compared].max(initial=0.0))
    size = max(1.0, float(np.abs(exact.field).max()))
    outcome = "right" if error <= of.error + _ROUNDED_FIELD * size else "reported"
    if outcome == "reported" and exact.motions:
        least = exact.energy(exact.field)
        same = abs(exact.energy(moved) - least) <= _ROUNDED * max(1.0, abs(least))
        outcome = "right: one of several" if same else outcome
    outcome = outcome if exact.is_proven else "unsure"
    yield Verdict(
        outcome, kinds, error, of.error, drawn.tolerance, seconds=seconds, note=str(drawn)
    )


def _reference_of(drawn: RandomProblem, tilt: float = 0.0, number: int = 0) -> Slipped:
    """Return the dense solution in pixels, in which sites in no element follow their tissue."""
    problem, force = drawn.problem, _force_on(drawn)
    if problem.sliding is not None:
        return slipped(problem, drawn.prior, force, tilt, number)
    joined = connected(problem, drawn.prior)
    if force is not None:
        force = joined.carried(force)
    exact = slipped(joined.problem, drawn.prior, force)
    field = exact.field * problem.unit
    joined.extend(field)
    held = (problem.confidence >= 1) & ~sites_of_elements(problem.tissue)[..., None]
    field[held] = problem.observed[held]
    return exact._replace(field=field / problem.unit)


# Inputs beside sliding parts, for `tissue_with_parts`.
_BESIDE_PARTS: dict[str, dict[str, bool]] = {
    "nothing else": {},
    "landmarks": {"has_landmarks": True},
    "a drift": {"has_drift": True},
    "rigid bodies": {"has_bodies": True},
    "rigid bodies and a drift": {"has_bodies": True, "has_drift": True},
}


def judge_sliding(_: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare larger sliding parts, with growth, forces and a precision, with sparse solutions.

    Every fifty problems have other inputs beside the parts. Faults are those of `judge_parts`, and
    all refusals.
    """
    beside, inputs = list(_BESIDE_PARTS.items())[number // 50 % len(_BESIDE_PARTS)]
    problem, prior = tissue_with_parts(number, **inputs)
    kinds = {"beside": beside, "grid": " x ".join(map(str, problem.shape))}
    kinds["parts"] = str(2 + number % 3)
    try:
        found = solve(problem, prior, backend=backend)
    except (ProblemError, ConvergenceError) as refusal:
        yield Verdict("refused", kinds, note=str(refusal))
        return
    tens = (len(found.energy) - 1) // 10
    kinds["cycles"] = f"{10 * tens} to {10 * tens + 9}"
    yield _beside(found, problem, sliding_field(problem, prior) / problem.unit, kinds)


def judge_data(_: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare tensors of data of any rank and strength, and landmarks, with sparse solutions.

    Faults are those of `judge_parts`.
    """
    kinds, problem = random_data(number)
    prior = ElasticPrior(0.3)
    found = solve(problem, prior, backend=backend)
    yield _beside(found, problem, posterior_mean(problem, prior) / problem.unit, kinds)


def judge_large_data(_: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare data in large motion with the field to which an independent Newton's method settles.

    The method begins at the solution: tissue may have several equilibria. Its energy has no barrier
    in volumes, so those with nearly folded elements are not compared. Rigid tissue is the limit of
    stiff tissue. Faults are those of `judge_parts`, and refusals.
    """
    case = random_large_data(number)
    problem, kinds = case.problem, {"data": case.kind}
    kinds["rigid tissue"] = "some" if problem.rigid.any() else "none"
    begun = now()
    try:
        found = solve(problem, case.prior, backend=backend)
    except HmrfError as refusal:
        yield Verdict("refused", kinds, note=str(refusal))
        return
    seconds = since(begun).wall
    if (verdict := _unreached(found, kinds, seconds)) is not None:
        yield verdict
        return
    if problem.is_volume and _smallest_elastic_jacobian(case, found) < BARRIER_BEGIN:
        yield Verdict("not compared", kinds, seconds=seconds)
        return
    verdict = _beside(found, problem, _settled(case, found) / problem.unit, kinds)
    yield replace(verdict, seconds=seconds)


def _unreached(found: Solution, kinds: dict[str, str], seconds: float) -> Verdict | None:
    """Return the verdict on large motion that says that it is not in equilibrium, or None."""
    reach = found.reach
    assert reach is not None
    if reach.where is None and reach.unbalanced_at is None:
        return None
    return Verdict("unreached, as reported", kinds, seconds=seconds, note=str(reach))


def judge_large_sliding(_: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare sliding parts in large motion with an independent Newton's method.

    Both are loaded from rest. If they settle elsewhere, the independent method begins again from
    the solution. Faults are those of `judge_parts`, and refusals of parts that are held.
    """
    case = random_large_parts(number)
    problem, kinds = case.problem, {"parts": case.kind}
    kinds["problem"] = "volumes" if problem.is_volume else "images"
    begun = now()
    try:
        found = solve(problem, case.prior, backend=backend)
    except ProblemError as refusal:
        outcome = "refused: sliding" if refusal.field == "sliding" else "refused"
        yield Verdict(outcome, kinds, note=str(refusal))
        return
    except HmrfError as refusal:
        yield Verdict("refused", kinds, note=str(refusal))
        return
    seconds = since(begun).wall
    if (verdict := _unreached(found, kinds, seconds)) is not None:
        yield verdict
        return
    assert found.reach is not None
    if problem.is_volume and found.reach.least_jacobian < BARRIER_BEGIN:
        yield Verdict("not compared", kinds, seconds=seconds)
        return
    try:
        exact = large_sliding_field(problem, case.prior)
    except NotSettledError as reason:
        yield Verdict("not compared", kinds, seconds=seconds, note=str(reason))
        return
    verdict = _beside(found, problem, exact / problem.unit, kinds)
    if verdict.is_fault:
        with suppress(NotSettledError):
            again = _beside(found, problem, _settled_parts(case, backend) / problem.unit, kinds)
            if not again.is_fault:
                note = f"the other is {verdict.error:.2g} pixels away"
                verdict = replace(again, outcome="another equilibrium", note=note)
    yield replace(verdict, seconds=seconds)


def _settled_parts(case: LargeMotion, backend: str) -> np.ndarray:
    """Return the field to which the independent method settles from that of sliding parts."""
    problem, prior = unfolded(case.problem, case.prior)
    found, boxes = solve(problem, prior, backend=backend), problem.coupling.boxes
    start = np.zeros((len(boxes), *case.problem.observed.shape))
    for of_part, box in zip(start, boxes, strict=True):
        of_part[box.image] = found.displacement[box.unfolded]
    return large_sliding_field(case.problem, case.prior, 1, start)


def _settled(case: LargeMotion, found: Solution) -> np.ndarray:
    """Return the field to which the independent method settles from a solution."""
    problem, start = case.problem, found.displacement
    if not problem.rigid.any():
        return large_field(problem, case.prior, 1, start=start)
    one, two = (
        large_field(with_stiff_bodies(problem, ratio), case.prior, 1, start=start)
        for ratio in _STIFF
    )
    # The motion of stiff tissue within itself decreases in proportion to its stiffness.
    return np.asarray(two + (two - one) / (_STIFF[1] / _STIFF[0] - 1))


def _smallest_elastic_jacobian(case: LargeMotion, found: Solution) -> float:
    """Return a bound below the Jacobians of all elements without their growth."""
    loads = case.problem.loads
    least = float(case.prior.corner_jacobians(case.problem, found.displacement).min())
    if loads is None or loads.growth is None:
        return least
    return least / max(1.0, float((1 + loads.growth).max()) ** 3)


def _reference_of_parts(drawn: RandomProblem) -> tuple[np.ndarray, float]:
    """Return the dense solution in pixels, and the least eigenvalue for a diagonal of 1."""
    field, least = dense_solution(drawn.problem, drawn.prior, _force_on(drawn))
    return field / drawn.problem.unit, least


def _force_on(drawn: RandomProblem) -> np.ndarray | None:
    """Return the force of a cavity and of other loads on each site, or None without a cavity."""
    if drawn.contents is None:
        return None
    force = forces_of(drawn.contents, drawn.problem.stiffness, drawn.problem.spacing)
    return force if drawn.loads is None or drawn.loads.force is None else force + drawn.loads.force


def _depends_on_normals(drawn: RandomProblem, exact: np.ndarray) -> bool:
    """Return whether small tilts of the normals change the field as much as its own size."""
    if drawn.problem.sliding is None:
        return False
    changes = []
    for number in range(_TILTS):
        tilted = _reference_of(drawn, _TILT, number)
        changes.append(math.inf if tilted.is_free else float(np.abs(tilted.field - exact).max()))
    return max(changes) > _UNDETERMINED * max(float(np.abs(exact).max()), 1e-9)


def judge_gaps(
    _: int, number: int, backend: str = "cpu", axes: int = 2, sides: tuple[int, int] = (16, 50)
) -> Iterator[Verdict]:
    """Compare tissue with necks, flaps and islands with direct solves, at two tolerances.

    A weak rotation of a flap costs so little energy that an error estimate may miss it. An error
    above 1.05 times the larger of the reported error and the tolerance is a fault.
    """
    try:
        problem, prior, exact = tissue_with_gaps(number, axes, sides), ElasticPrior(0.3), None
    except ProblemError:
        return  # the random tissue touches neither of the prescribed sides
    for tolerance in (0.01, 0.001):
        kinds = {"tolerance": f"{tolerance:g}", "device": backend}
        begun = now()
        try:
            found = solve(problem, prior, optimizer=Multigrid(tolerance), backend=backend)
        except HmrfError as refusal:
            yield Verdict("refused: by the solver", kinds, note=str(refusal))
            continue
        seconds, of = since(begun).wall, found.convergence
        if exact is None:
            exact = direct_solution(problem, prior)
        assert of is not None
        error = _apart(found.displacement, exact)
        outcome = "right" if error <= BOUND * max(of.error, tolerance) else "reported"
        yield Verdict(outcome, kinds | {"way": of.way}, error, of.error, tolerance, seconds)


def judge_large_gaps(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare as `judge_gaps` does, in images of 200 to 600 pixels a side."""
    return judge_gaps(seed, number, backend, 2, (200, 601))


def judge_gaps_in_volumes(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare as `judge_gaps` does, in volumes of 8 to 17 voxels a side."""
    return judge_gaps(seed, number, backend, 3, (8, 18))


def judge_edits(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Compare each live result in a sequence of edits with a cold solve at a tight tolerance.

    Even numbers start with a random image, others with mild tissue. Differences that exceed the sum
    of both reported errors are faults, and so are refusals by one of the solves only, unless the
    exact solution explains them. A cold solve that fails is repeated at the tolerance of the live
    solver. Results that take minutes are not faults, because the user can cancel them.
    """
    try:
        if number % 2:
            start = mild_tissue(dice_of(seed, number, 2))
        else:
            drawn = random_problem(dice_of(seed, number))
            start = State(drawn.problem, drawn.prior)
    except HmrfError:
        return  # the random tissue touches none of the prescribed edges
    updates: list[Update] = []
    steps: list[tuple[str, State, Update | None]] = []
    # Run the cold solves afterwards, because the live solver would reuse their results. An edit
    # that yields an invalid problem ends the sequence.
    with suppress(HmrfError), LiveSolver(updates.append, backend=backend) as live:
        for kind, state in edits_of(start, dice_of(seed, number, 1)):
            live.submit(state)
            if not live.wait(_PATIENCE):
                steps.append((kind, state, None))
                break
            steps.append((kind, state, updates[-1]))
    for kind, state, update in steps:
        prior = state.prior
        plane = prior.plane if isinstance(prior, ElasticPrior) else prior.conditional
        held = "held" if prior.penalty in (None, math.inf) else "slips"
        kinds = {"energy": f"{plane}, {held}", "edit": kind}
        yield Verdict("slow", kinds) if update is None else _compared(update, state, kinds)


def _compared(update: Update, state: State, kinds: dict[str, str]) -> Verdict:
    """Compare a result of the live solver with a cold solve."""
    cold, refusal = _cold(state, _COLD)
    if cold is None and update.solution is not None:
        # The tight tolerance may be out of reach where that of the live solver is not.
        cold, refusal = _cold(state, TOLERANCE)
    if update.solution is None and not isinstance(update.error, ProblemError | ConvergenceError):
        return Verdict("crashed", kinds, note=repr(update.error))
    if update.solution is None and cold is None:
        return Verdict("both refuse", kinds)
    if update.solution is None or cold is None:
        # The tolerance of the solve that was refused.
        tolerance = TOLERANCE
        error = update.error if update.solution is None else refusal
        assert isinstance(error, HmrfError)
        why = why_refused(*state, tolerance, exact_field(*state), error)
        who = "live" if update.solution is None else "cold"
        outcome = "one refuses" if why == "refused" else "one refuses, rightly"
        return Verdict(outcome, kinds, note=f"{who}: {error}")
    assert update.solution.convergence is not None
    assert cold.convergence is not None
    unit = state.problem.unit
    difference = _apart(update.solution.displacement / unit, cold.displacement / unit)
    allowed = update.solution.convergence.error + cold.convergence.error
    outcome = "right" if difference <= allowed + _GRACE_OF_EDITS else "differs"
    return Verdict(outcome, kinds, difference, allowed, TOLERANCE)


def _cold(state: State, tolerance: float) -> tuple[Solution | None, HmrfError | None]:
    """Solve without earlier results; return the solution, or the reason of the refusal."""
    try:
        optimizer = Multigrid(tolerance)
        return solve(state.problem, state.prior, optimizer=optimizer, backend="cpu"), None
    except (ProblemError, ConvergenceError) as error:
        return None, error


def judge_large_motion(
    seed: int, number: int, backend: str = "cpu", axes: int = 2
) -> Iterator[Verdict]:
    """Solve a problem of large motion, and check its folds, its reports and its continuation.

    The targets of even numbers are sampled from a map without folds.
    """
    case = random_large_motion(dice_of(seed, number), axes, number % 2 == 0)
    problem, kinds = case.problem, {"targets": case.kind}
    begun = now()
    try:
        found = solve(problem, case.prior, backend=backend)
    except HmrfError as error:
        note = f"{type(error).__name__}: {error}"
        yield Verdict("refused: by the solver", kinds, note=note)
        return
    seconds = since(begun).wall
    reach, of = found.reach, found.convergence
    assert reach is not None
    assert of is not None
    gap = _gap(problem, found.displacement)
    least = smallest_jacobian(problem, found.displacement, 2 if axes == 2 else 10)
    folds = count_folds(found.displacement, spacing=problem.spacing, tissue=problem.tissue)
    is_finite = math.isfinite(of.error) and math.isfinite(of.residual)
    told = reach.unbalanced_at is not None
    told = told and reach.unbalanced >= 0.99 * of.error * problem.unit
    there = 0.0 if reach.where is None else gap[reach.where]
    said = reach.missing / problem.unit
    is_gap_said = max(abs(gap.max() - said), abs(there - said)) <= _MET
    outcome = "right" if gap.max() <= _MET else "right, targets missed"
    if not least > 0 or not reach.least_jacobian > 0 or folds or not is_finite:
        outcome = "folded"
    elif (of.error > Multigrid().tolerance and not told) or not is_gap_said:
        outcome = "unreported"
    elif gap.max() > _MET and _ends_farther(case, found, float(gap.max())):
        outcome = "farther"
    note = f"least Jacobian {least:.2g}; {folds} folds; {reach}; error {of.error:.2g} px"
    yield Verdict(outcome, kinds, seconds=seconds, note=note)


def judge_large_volume(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Check as `judge_large_motion` does, in volumes."""
    return judge_large_motion(seed, number, backend, axes=3)


def _ends_farther(case: LargeMotion, found: Solution, gap: float) -> bool:
    """Continue from a solution; return whether this is refused or ends farther from the targets.

    As in `reach`, growth that was completed counts before the distance from the targets.
    """
    try:
        further = solve(case.problem, case.prior, backend="cpu", initial=found)
    except HmrfError:
        return True
    assert found.reach is not None
    assert further.reach is not None
    if further.reach.grown != found.reach.grown:
        return further.reach.grown < found.reach.grown
    return bool(_gap(case.problem, further.displacement).max() > gap + _ROUNDED_TARGETS)


def _gap(problem: Problem, displacement: Any) -> np.ndarray:
    """Return the distance of each site from its target, in pixels.

    A site in no element has no target of its own: it follows the tissue that takes its target.
    """
    gap = np.where(problem.known, problem.observed - displacement.astype(np.float64), 0)
    gap[~sites_of_elements(problem.tissue)] = 0
    return np.asarray(np.linalg.norm(gap, axis=-1) / problem.unit)


def judge_memory(seed: int, number: int, backend: str = "cpu") -> Iterator[Verdict]:
    """Solve small volumes of 108 shapes in turn; in every tenth, observations may slip.

    Memory that grows by more than 100 MB after the first tenth of the volumes is a fault.
    """
    shape = _SHAPES[number % len(_SHAPES)]
    problem = between_plates(10 ** dice_of(seed, number).uniform(0, 3, shape), (1.0, 0.0, 0.0))
    prior = ElasticPrior(0.3, penalty=math.inf if number % 10 else 5.0)
    solve(problem, prior, backend=backend)
    yield Verdict("right")


class Campaign(NamedTuple):
    """Function that solves and judges a problem, and the usual number of problems."""

    judge: Callable[..., Iterator[Verdict]]
    examples: int


CAMPAIGNS = {
    "images": Campaign(judge_image, 5000),
    "volumes": Campaign(judge_volume, 600),
    "parts": Campaign(judge_parts, 2500),
    "combinations": Campaign(judge_combination, 100 * len(_PAIRS)),
    "sliding": Campaign(judge_sliding, 50 * len(_BESIDE_PARTS)),
    "data": Campaign(judge_data, 100),
    "large-data": Campaign(judge_large_data, 600),
    "large-sliding": Campaign(judge_large_sliding, 300),
    "gaps": Campaign(judge_gaps, 4000),
    "large-gaps": Campaign(judge_large_gaps, 1000),
    "gaps-in-volumes": Campaign(judge_gaps_in_volumes, 1000),
    "edits": Campaign(judge_edits, 2000),
    "large-motion": Campaign(judge_large_motion, 3000),
    "large-volumes": Campaign(judge_large_volume, 1000),
    "memory": Campaign(judge_memory, 5000),
}


class Run(NamedTuple):
    """Verdicts of a campaign with their numbers, its time in s, and growth of memory in MB."""

    name: str
    options: str
    verdicts: list[tuple[int, Verdict]]
    seconds: float
    grown: float

    @property
    def faults(self) -> list[tuple[int, Verdict]]:
        """Numbers and verdicts of faults, in the order of `FAULTS`, largest errors first."""
        order = list(FAULTS)
        some = [each for each in self.verdicts if each[1].is_fault]
        return sorted(some, key=lambda each: (order.index(each[1].outcome), -_size(each[1])))

    @property
    def is_right(self) -> bool:
        """True if there are no faults."""
        return not self.faults and not (self.name == "memory" and self.grown > _GROWTH)


def _size(verdict: Verdict) -> float:
    return float(np.nan_to_num(verdict.error))


def run(
    name: str, numbers: Iterable[int], seed: int = 0, backend: str = "cpu", loud: bool = False
) -> Run:
    """Judge the problems with some numbers; if `loud`, print the progress."""
    options = f"{name} --seed {seed}" + ("" if backend == "cpu" else f" --backend {backend}")
    begun, last, plan = now(), 0.0, list(numbers)
    verdicts: list[tuple[int, Verdict]] = []
    memory = MemoryGrowth(warm_up=1 + len(plan) // 10)
    memory.measure()
    for done, number in enumerate(plan, start=1):
        new = [(number, verdict) for verdict in CAMPAIGNS[name].judge(seed, number, backend)]
        verdicts += new
        memory.measure()
        for _, verdict in new if loud else ():
            if verdict.is_fault or len(plan) == 1:
                print(_line(number, verdict, options), file=sys.stderr, flush=True)
        seconds = since(begun).wall
        if loud and seconds - last > 10:
            last = seconds
            print(f"{name}: {done} of {len(plan)}, {seconds:.0f} s", file=sys.stderr)
    return Run(name, options, verdicts, since(begun).wall, memory.megabytes)


def report(of: Run, most: int = 10) -> str:
    """Return the findings in Markdown, with at most `most` faults of each kind."""
    verdicts = [verdict for _, verdict in of.verdicts]
    counts = Counter(verdict.outcome for verdict in verdicts)
    told = ", ".join(f"{count} {outcome}" for outcome, count in counts.most_common())
    counted = len({number for number, _ in of.verdicts})
    solver = sum(verdict.seconds for verdict in verdicts)
    lines = [
        f"`{of.options}`: {counted} problems in {of.seconds:.0f} s, {solver:.0f} s in the solver.",
        f"Memory grew by {of.grown:.0f} MB after the first tenth.",
        f"**{len(of.faults)} faults.** Results: {told}.",
    ]
    outcomes = sorted(counts, key=lambda outcome: (outcome in FAULTS, -counts[outcome]))
    for kind in dict.fromkeys(name for verdict in verdicts for name in verdict.kinds):
        values = [verdict.kinds.get(kind, "-") for verdict in verdicts]
        each = Counter(zip(values, (verdict.outcome for verdict in verdicts), strict=True))
        rows = [
            (value, values.count(value), *(each[value, outcome] or "" for outcome in outcomes))
            for value in sorted(set(values))
        ]
        lines += ["", markdown((kind, "results", *outcomes), rows)]
    known = [v for v in verdicts if np.isfinite(v.error) and v.outcome != "free"]
    if known:
        parts = (50, 90, 99, 99.9, 100)
        rows = [
            (
                "error over report",
                *np.percentile([v.error / max(v.reported, _GRACE) for v in known], parts),
            ),
            ("error over tolerance", *np.percentile([v.error / v.tolerance for v in known], parts)),
            ("error, px", *np.percentile([v.error for v in known], parts)),
        ]
        lines += ["", markdown(("share of results", *(f"{part} %" for part in parts)), rows)]
        lines += ["", f"(Reported errors below {_GRACE:g} px count as {_GRACE:g} px here.)"]
    groups: dict[tuple[str, str], list[str]] = {}
    for number, verdict in of.faults:
        gist = re.sub(r"\(?-?\d[\d.,e+\-x ]*\)?", "# ", verdict.note.rpartition(": ")[2])[:60]
        groups.setdefault((verdict.outcome, gist), []).append(_line(number, verdict, of.options))
    for (outcome, _), found in groups.items():
        lines += ["", f"**{outcome}** ({FAULTS[outcome]}): {len(found)}", ""]
        lines += [f"- {line}" for line in found[:most]]
    return "\n".join(lines)


def _line(number: int, verdict: Verdict, options: str) -> str:
    """Return a line about a verdict, with the options that repeat it."""
    text = f"`{options} --only {number}`: {verdict.outcome}"
    if np.isfinite(verdict.error):
        text += f", error {verdict.error:.2g} px, reported {verdict.reported:.2g} px"
    return f"{text}; {verdict.note or verdict.kinds}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run campaigns and print the findings."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="Outcomes that are faults: "
        + ". ".join(f"{name}: {meaning}" for name, meaning in FAULTS.items())
        + ".",
    )
    parser.add_argument("names", nargs="+", metavar="NAME[=EXAMPLES]", help=", ".join(CAMPAIGNS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the only problems to solve")
    parser.add_argument("--backend", default="cpu", help="cpu, which is the default, or opengl")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore", UserWarning)  # notes about assumptions
    is_right = True
    for name, _, examples in (each.partition("=") for each in options.names):
        if name not in CAMPAIGNS or not (examples or "0").isdecimal():
            parser.error(f"unknown campaign: {name}={examples}; use {', '.join(CAMPAIGNS)}")
        count = int(examples) if examples else CAMPAIGNS[name].examples
        numbers = options.only or range(options.first, options.first + count)
        found = run(name, numbers, options.seed, options.backend, loud=True)
        print(f"## {name.capitalize()}\n\n{report(found)}\n", flush=True)
        is_right &= found.is_right
    return int(not is_right)


if __name__ == "__main__":
    sys.exit(main())
