"""Gauss-Newton iteration over levels that moves the tissue of a problem until two images match.

Each step replaces the images by a quadratic data term around the current displacement
(`image_data`), adds it to the problem, and solves the problem. The first levels have large pixels,
so that large displacements are found first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import clear_large
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.field.neighbours import in_elements
from napari_hmrf.registration.image_data import (
    BoolArray,
    Checkpoint,
    FloatArray,
    ImageLevel,
    Images,
    LinearImages,
    Relation,
    is_function,
    reduced_pair,
    relation_of,
)
from napari_hmrf.registration.rigid_bodies import turned, with_rigid_held
from napari_hmrf.solver.data_term import combined_data
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, solve, stop_if_cancelled
from napari_hmrf.solver.uncertain_landmarks import Landmarks, corners_of

#: Weight of the elastic energy of tissue of typical stiffness that is strained along one axis only,
#: relative to the variance of the difference of the images. More different images lead to a
#: smoother motion.
_SMOOTHNESS = 1.0
#: Number of steps on the finest level, on the level before it, and on coarser levels.
_STEPS = (2, 3, 4)
#: Same if the brightness of one image is a function of that of the other, because each step
#: computes the function anew.
_STEPS_OF_FUNCTION = (4, 3, 4)
#: All relations of brightness, from simple to general.
RELATIONS: tuple[Relation, ...] = ("same", "inverse", "from fixed", "from moving")
#: Similarities for which the user may ask, and the relations among which each chooses.
SIMILARITIES: dict[str, tuple[Relation, ...]] = {
    "auto": RELATIONS,
    "same": ("same",),
    "inverse": ("inverse",),
    "other": ("from fixed", "from moving"),
}
#: Smallest number of pixels along the longest axis of the coarsest level.
_LEAST_PIXELS = 24
#: Largest number of levels.
_MOST_LEVELS = 5
#: Tolerance of a solve, in pixels of the level; the tolerance of the last solve.
_TOLERANCE, _LAST_TOLERANCE = 0.02, 1e-3
#: Jacobian determinant of a site below which the images count less around it.
_LEAST_JACOBIAN = 0.1
#: Factor by which the images count less where tissue would fold, and largest number of repetitions.
_WEAKER, _REPEATS = 0.25, 6
# Precision, relative to the typical stiffness, that marks tissue as observed before the data term
# of the images is known, so that a problem without other constraints is valid.
_PLACEHOLDER = 1e-12
#: Number of bisections that shorten a step if tissue folds for another reason.
_BISECTIONS = 12


@dataclass(frozen=True)
class Step:
    """Record of one step of a registration.

    Attributes
    ----------
    spacing : tuple of float
        Size of a pixel of the level along each axis.
    residual : float
        Root mean square of the difference of normalized brightness before the step.
    similarity : float
        Correlation of the locally normalized images before the step, at most 1.
    change : float
        Largest change of the displacement in this step, in the unit of the spacing.
    least_jacobian : float
        Smallest Jacobian determinant at a site after the step; above 0 without folds.
    """

    spacing: tuple[float, ...]
    residual: float
    similarity: float
    change: float
    least_jacobian: float


class Match(NamedTuple):
    """Motion of a problem that matches two images.

    Attributes
    ----------
    solution : Solution
        Solution of the last problem: the tissue, its constraints and the images.
    images : LinearImages
        Data term of the images in the last problem, relative to the typical stiffness.
    similarity_before : float
        Similarity on the finest level without any motion.
    residual, similarity : float
        As in a `Step`, after the last step.
    history : tuple of Step
    relation : Relation
        Relation of the brightness of the images.
    """

    solution: Solution
    images: LinearImages
    similarity_before: float
    residual: float
    similarity: float
    history: tuple[Step, ...]
    relation: Relation


Show = Callable[[Solution, Step], None]


def match(
    problem: Problem,
    prior: ElasticPrior,
    images: Images,
    *,
    unit: float,
    smoothness: float = 1.0,
    relations: Sequence[Relation] = RELATIONS,
    start: npt.NDArray[np.floating] | None = None,
    finest: bool = True,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
    show: Show | None = None,
) -> Match:
    """Move the tissue of a problem until the fixed image matches the moving image.

    Parameters
    ----------
    problem : Problem
        Tissue with its constraints, loads and landmarks (`without_placeholder`). A precision of the
        problem has no effect on levels with larger pixels.
    prior : ElasticPrior
    images : Images
    unit : float
        Typical stiffness of the tissue.
    smoothness : float
        Weight of the elastic energy, relative to the usual weight.
    relations : sequence of Relation
        Relations of the brightness of both images among which the images decide.
    start : ndarray, shape (H, W, 2) or (D, H, W, 3), optional
        Displacement from which the iteration starts, on the finest level only; by default, the
        iteration starts at zero on the coarsest level.
    finest : bool
        False to leave out the finest level; the solution is then on the level before it.
    progress, cancel
        As in `solve`.
    show : callable, optional
        Called after each level with its solution and the record of its last step.

    Returns
    -------
    Match

    Raises
    ------
    Cancelled
        If `cancel` was set.
    ProblemError, ConvergenceError
        As for `solve`.
    """
    checkpoint = partial(stop_if_cancelled, cancel)
    weight = smoothness * _SMOOTHNESS / _uniaxial_modulus(prior, len(problem.shape))
    relation = _relation(images, relations, problem, start, checkpoint)
    levels = schedule(problem.shape, relation)
    if start is not None:
        levels = levels[-1:]
    if not finest:
        levels = levels[:-1]
    report = _Report(problem.shape, levels, progress)
    history: list[Step] = []
    displacement, tissue = start, problem.tissue
    for size, count in levels:
        base, nu = _on_level(problem, size), _prior_on_level(prior, size)
        displacement = interpolated(displacement, tissue, base.shape, checkpoint)
        tissue = base.tissue
        pair = ImageLevel(
            reduced_pair(images, size, checkpoint), base.spacing, checkpoint, relation
        )
        for number in range(count):
            last = size == 1 and number == count - 1
            report.begin(size, number)
            solution = data = None  # frees memory, as does the next line: no model is used again
            compute_thread.result_of(clear_large, "freeing memory")
            data = pair.linear(displacement, weight)
            tolerance = _LAST_TOLERANCE if last else _TOLERANCE
            step = _StepSolver(base, nu, unit, tolerance, report.within, cancel)
            solution, data = step.without_folds(displacement, data)
            change = float(np.abs(solution.displacement - displacement).max())
            displacement = solution.displacement
            history.append(
                Step(base.spacing, data.residual, data.similarity, change, step.least_jacobian)
            )
            report.end()
            if show is not None and number == count - 1:
                show(solution, history[-1])
            checkpoint()
    assert displacement is not None
    assert solution is not None
    assert data is not None
    _, before = pair.agreement(np.zeros_like(displacement))
    after = pair.agreement(displacement)
    return Match(solution, data, before, *after, tuple(history), relation)


def _relation(
    images: Images,
    relations: Sequence[Relation],
    problem: Problem,
    start: npt.NDArray[np.floating] | None,
    checkpoint: Checkpoint,
) -> Relation:
    """Return the relation of brightness on the coarsest level, where motion matters least."""
    if len(relations) == 1:
        return relations[0]
    size, _ = schedule(problem.shape)[0]
    every = (slice(None, None, size),) * len(problem.shape)
    given = np.zeros((*problem.shape, len(problem.shape)), np.float32) if start is None else start
    spacing = tuple(size * each for each in problem.spacing)
    reduced = reduced_pair(images, size, checkpoint)
    return relation_of(reduced, given[every], spacing, relations, checkpoint)


def _uniaxial_modulus(prior: ElasticPrior, axes: int) -> float:
    """Return the stiffness of tissue strained along one axis, relative to Young's modulus.

    Nearly incompressible tissue resists such a strain more, and would smooth the motion more.
    """
    nu = float(np.median(prior.poisson))
    if axes == 2 and prior.plane == "stress":
        return 1 / (1 - nu**2)
    return (1 - nu) / ((1 + nu) * (1 - 2 * nu))


def placeholder(tissue: BoolArray, unit: float = 1.0) -> FloatArray:
    """Return a precision that stands for that of the images in a problem for `match`.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
    unit : float
        Typical stiffness of the tissue.
    """
    diagonal = np.where(tissue[..., None], np.float32(unit * _PLACEHOLDER), np.float32(0))
    return diagonal[..., None] * np.eye(tissue.ndim, dtype=np.float32)


def without_placeholder(problem: Problem, unit: float = 1.0) -> Problem:
    """Return a validated problem without the precision that stands for that of the images."""
    precision = problem.precision
    if precision is None:
        return problem
    # The placeholder is diagonal, so the largest component of other tensors is on the diagonal.
    own = np.einsum("...ii->...i", precision).max(axis=-1) > 2 * unit * _PLACEHOLDER
    rest = np.where(own[..., None, None], precision, 0) if own.any() else None
    return variant_of(problem, precision=rest)


def schedule(shape: Sequence[int], relation: Relation = "same") -> tuple[tuple[int, int], ...]:
    """Return the pixel size and the number of steps of each level, from coarse to fine."""
    steps = _STEPS_OF_FUNCTION if is_function(relation) else _STEPS
    levels = []
    for number in range(_MOST_LEVELS):
        size = 2**number
        if number and max(shape) / size < _LEAST_PIXELS:
            break
        levels.append((size, steps[min(number, len(steps) - 1)]))
    return tuple(reversed(levels))


class _Report:
    """Progress of all steps, weighted by their numbers of pixels."""

    def __init__(
        self,
        shape: Sequence[int],
        levels: Sequence[tuple[int, int]],
        progress: Progress | None,
    ) -> None:
        self._axes, self._progress = len(shape), progress
        self._whole = sum(count * self._cost(size) for size, count in levels)
        self._done, self._size, self._message = 0.0, 1, ""
        self._shown = 0.0

    def _cost(self, size: int) -> float:
        return float(size) ** -self._axes

    def begin(self, size: int, number: int) -> None:
        """Report the start of a step on the level with pixels of the given size."""
        self._size = size
        at = "" if size == 1 else f" at 1/{size} of the resolution"
        self._message = f"registering{at}, step {number + 1}"
        self._send(0.0)

    def within(self, monitor: Monitor) -> None:
        """Report the progress of the solve of the current step."""
        # The first solve on a computer may wait for a long time.
        is_preparing = monitor.message.startswith(PREPARING)
        self._send(monitor.fraction, monitor.message if is_preparing else "")

    def end(self) -> None:
        """Report the end of a step."""
        self._done += self._cost(self._size)
        self._send(0.0)

    def _send(self, fraction: float, message: str = "") -> None:
        if self._progress is not None:
            done = self._done + 0.9 * fraction * self._cost(self._size)
            # A solve may report a smaller fraction when it begins another stage.
            self._shown = max(self._shown, min(done / self._whole, 1.0))
            self._progress(Monitor(message or self._message, self._shown))


class _StepSolver:
    """Solver of one step: the problem of a level together with the data term of the images."""

    def __init__(
        self,
        base: Problem,
        prior: ElasticPrior,
        unit: float,
        tolerance: float,
        progress: Progress,
        cancel: CancelFlag | None,
    ) -> None:
        self._base, self._prior, self._unit = base, prior, unit
        self._optimizer = Multigrid(tolerance)
        self._progress, self._cancel = progress, cancel
        self.least_jacobian = 1.0

    def without_folds(
        self, before: npt.NDArray[np.floating], data: LinearImages
    ) -> tuple[Solution, LinearImages]:
        """Return the solution, and the data term, which is weaker where tissue would fold.

        Parameters
        ----------
        before : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Displacement before the step, without folds.
        data : LinearImages
        """
        for repeat in range(_REPEATS):
            solution = self._solve(data)
            least = self._determinants(solution.displacement)
            crushed = least < _LEAST_JACOBIAN
            if not crushed.any() or repeat == _REPEATS - 1:
                break
            # A wider region each time: the pull that crushes tissue may come from farther away.
            around = scipy.ndimage.binary_dilation(crushed, iterations=2 ** (repeat + 1))
            data = data.weakened(around, _WEAKER)
        if (least <= 0).any():
            solution = self._shortened(solution, before)
            least = self._determinants(solution.displacement)
        self.least_jacobian = float(np.nanmin(least, initial=1.0))
        return solution, data

    def _solve(self, data: LinearImages) -> Solution:
        base = self._base
        observed, precision = combined_data(
            (base.observed, base.precision),
            (data.observed, data.precision if self._unit == 1 else self._unit * data.precision),
            base.known,
        )
        problem = Problem(
            observed=observed,
            confidence=base.confidence,
            stiffness=base.stiffness,
            spacing=base.spacing,
            loads=base.loads,
            precision=precision,
            landmarks=base.landmarks,
        )
        solution = solve(
            problem,
            self._prior,
            optimizer=self._optimizer,
            progress=self._progress,
            cancel=self._cancel,
            rest_loose=True,
        )
        if not base.has_rigid:
            return solution
        # The solver rotates rigid tissue to first order. An exact rotation replaces it.
        exact = turned(solution.displacement, base.stiffness, base.spacing)
        held = with_rigid_held(problem, exact)
        return solve(
            held,
            self._prior,
            optimizer=self._optimizer,
            progress=self._progress,
            cancel=self._cancel,
            rest_loose=True,
        )

    def _determinants(self, displacement: npt.NDArray[np.floating]) -> FloatArray:
        return smallest_determinant(displacement, self._base.spacing, self._base.tissue)

    def _shortened(self, solution: Solution, before: npt.NDArray[np.floating]) -> Solution:
        """Return the longest part of a step that does not fold tissue, by bisection.

        If tissue folds before the step, as the interpolation of a coarser level may lead to, the
        result is the longest part of the whole displacement.
        """
        if (self._determinants(before) <= 0).any():
            before = np.zeros_like(before)
        change = solution.displacement - before
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            folds = (self._determinants(before + middle * change) <= 0).any()
            low, high = (low, middle) if folds else (middle, high)
        part = (before + low * change).astype(solution.displacement.dtype)
        note = "the motion was shortened, because tissue would fold"
        return replace(solution, displacement=part, notes=(*solution.notes, note))


def _on_level(problem: Problem, size: int) -> Problem:
    """Return a problem with the sites of a coarser level, every `size` sites along each axis.

    Values are those of the nearest site, as in the paper; they are never averaged.
    """
    if size == 1:
        return problem
    axes = len(problem.shape)
    every = (slice(None, None, size),) * axes
    loads, m = problem.loads, problem.stiffness[every]
    if loads is not None:
        growth, force = (
            None if each is None else scale * each[every]
            for each, scale in ((loads.growth, 1.0), (loads.force, float(size) ** axes))
        )
        loads = Loads(growth=growth, force=force)
    level = Problem(
        observed=problem.observed[every],
        confidence=problem.confidence[every],
        stiffness=m,
        spacing=[size * each for each in problem.spacing],
        loads=loads,
        precision=placeholder(m > 0),
        landmarks=_landmarks_on_level(problem.landmarks, m, size),
    )
    return without_placeholder(level)


def _landmarks_on_level(
    landmarks: Landmarks | None, m: npt.NDArray[Any], size: int
) -> Landmarks | None:
    """Return the landmarks that lie between sites of tissue of a level; None if there are none."""
    if landmarks is None:
        return None
    last = np.array(m.shape) - 1
    points = np.clip(landmarks.points / size, 0, last)
    corner, _ = corners_of(points, m.shape)
    inside = in_elements(m)[tuple(corner.T)]
    if not inside.any():
        return None
    steps = (landmarks.targets - landmarks.points)[inside] / size
    points = points[inside]
    return Landmarks(
        points,
        points + steps,
        sd=landmarks.sd[inside],
        scale=landmarks.scale,
        drift=landmarks.drift,
    )


def _prior_on_level(prior: ElasticPrior, size: int) -> ElasticPrior:
    if not isinstance(prior.poisson, np.ndarray):
        return prior
    every = (slice(None, None, size),) * prior.poisson.ndim
    return replace(prior, poisson=prior.poisson[every])


def interpolated(
    displacement: npt.NDArray[np.floating] | None,
    tissue: BoolArray,
    shape: tuple[int, ...],
    checkpoint: Checkpoint,
) -> npt.NDArray[np.floating]:
    """Return a displacement of the next coarser level, or of the same level, on a level.

    Sites without tissue count like the nearest tissue.

    Parameters
    ----------
    displacement : ndarray, shape (h, w, 2) or (d, h, w, 3), or None
        None for no displacement.
    tissue : ndarray of bool, shape (h, w) or (d, h, w)
        Tissue of the coarser level.
    shape : tuple of int
        Grid of the level.
    checkpoint : callable
        Called between the steps.
    """
    axes = len(shape)
    if displacement is None:
        return np.zeros((*shape, axes), np.float32)
    if displacement.shape[:-1] == shape:
        return displacement
    if not tissue.all():
        checkpoint()
        nearest = scipy.ndimage.distance_transform_edt(
            ~tissue, return_distances=False, return_indices=True
        )
        displacement = displacement[tuple(nearest)]
    at = np.meshgrid(*(np.arange(n, dtype=np.float32) / 2 for n in shape), indexing="ij")
    out = np.empty((*shape, axes), np.float32)
    for axis in range(axes):
        checkpoint()
        scipy.ndimage.map_coordinates(
            displacement[..., axis], at, output=out[..., axis], order=1, mode="nearest"
        )
    return out
