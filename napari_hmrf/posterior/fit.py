"""Properties of tissue from its measured motion: growth, stiffness, Poisson's ratio and loads.

The displacement d of elastic tissue is in equilibrium, g(d, p) = 0, where g are the forces on the
sites and p the unknown properties. The properties are those with which the displacement is closest
to the measured one, y, in units of its standard deviation s:

    minimize  sum of |H d(p) - y|^2 / s^2

by Gauss-Newton steps. The derivative of the displacement with respect to a property p_k is the
response of the tissue to the forces ``- dg / dp_k``: one solve for each property and step. In large
motion, it is a difference of two solutions.

Instead of a measured displacement, two images can be compared (`ImagePairData`), first with large
pixels, so that large displacements are found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_whole, refuse_unless, require_flag
from napari_hmrf.checks import POISSON_RANGE
from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.posterior.field_data import FieldData
from napari_hmrf.posterior.pair_data import ImagePairData
from napari_hmrf.posterior.sampling import checked_prior
from napari_hmrf.posterior.uncertainty import checked_labels
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.registration.image_data import Images
from napari_hmrf.registration.matching import schedule
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.operator import Operator
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.solver.priors import Elastic, ElasticPrior, NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import (
    CancelFlag,
    Progress,
    check_arguments,
    solve,
    stop_if_cancelled,
)
from napari_hmrf.solver.uncertain_landmarks import Landmarks

Float64Array = npt.NDArray[np.float64]

#: Largest number of steps, and of trials of a step with more damping.
_STEPS, _TRIALS = 20, 8
#: Change of a property, in units of its standard deviation, below which the steps end; on levels
#: with large pixels, from which only a start is needed, the second number.
_SETTLED, _NEARLY_SETTLED = 0.02, 0.2
#: Damping of a step after a trial that failed, relative to the diagonal of the normal matrix, and
#: factor between trials.
_DAMPING, _DAMPING_FACTOR = 0.01, 10.0
#: Largest change of a property in a step: of a logarithm, of a ratio or of a strain.
_LARGEST_STEP = 1.0
#: Standard deviation of a property above which it counts as unknown.
_UNKNOWN = 1.0
#: Largest logarithm of the ratio between a fitted stiffness and the initial one.
_LARGEST_LOGARITHM = 7.0
#: Step of a finite difference of Poisson's ratio.
_SMALL = 1e-3
#: Half of an interval of 95 %, in standard deviations.
_INTERVAL = 1.96


@dataclass(frozen=True)
class FittedProperty:
    """Property of the tissue of a label, as fitted to a measured motion.

    Attributes
    ----------
    value : float
        Stiffness in the unit of the problem, strain of growth, Poisson's ratio, or factor on the
        loads.
    sd : float
        Standard deviation; of a stiffness, that of its logarithm, which is about a relative error.
    interval : (float, float)
        Interval that contains the property with a probability of 95 %.
    """

    value: float
    sd: float
    interval: tuple[float, float]

    def __repr__(self) -> str:
        low, high = self.interval
        return f"{self.value:.3g} ({low:.3g} to {high:.3g})"


@dataclass(frozen=True, eq=False)
class Fit:
    """Properties of tissue that explain a measured motion.

    Attributes
    ----------
    stiffness, growth, poisson : dict from int to FittedProperty
        Fitted properties by label.
    load : FittedProperty, optional
        Factor on the forces of the problem.
    covariance : ndarray, shape (k, k)
        Covariance of all properties, in the order stiffness (logarithms), growth, poisson, load.
    misfit : float
        Mean squared difference from the measured motion, in units of its variance: about 1 if model
        and standard deviation are right. If it is larger, standard deviations are multiplied by its
        square root. For images, whose noise is estimated from their differences, 1.
    similarity_before, similarity : float, optional
        Correlation of the normalized images without and with the motion, at most 1, as of a
        `Registration`; None without images.
    problem : Problem
        Problem with the fitted properties, without the measured motion.
    prior : ElasticPrior or NeoHookeanPrior
        Prior with the fitted Poisson's ratios.
    solution : Solution
        Solution of this problem.
    """

    stiffness: dict[int, FittedProperty]
    growth: dict[int, FittedProperty]
    poisson: dict[int, FittedProperty]
    load: FittedProperty | None
    covariance: Float64Array
    misfit: float
    problem: Problem
    prior: Elastic
    solution: Solution
    similarity_before: float | None = None
    similarity: float | None = None

    def __repr__(self) -> str:
        parts = [f"{name} {getattr(self, name)}" for name in ("stiffness", "growth", "poisson")]
        shown = [part for part in parts if not part.endswith("{}")]
        if self.load is not None:
            shown.append(f"load {self.load}")
        return f"Fit({', '.join(shown)}, misfit {self.misfit:.3g})"


def fit(
    problem: Problem,
    labels: npt.ArrayLike,
    *,
    measured: npt.ArrayLike | None = None,
    sd: npt.ArrayLike | None = None,
    landmarks: Landmarks | None = None,
    images: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    stiffness: Iterable[int] = (),
    growth: Iterable[int] = (),
    poisson: Iterable[int] = (),
    load: bool = False,
    prior: Prior | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Fit:
    """Fit properties of elastic tissue to its measured motion.

    Parameters
    ----------
    problem : Problem
        Tissue, with the properties that are known and an initial guess of the others, and its
        boundary conditions: sites whose motion is known, and loads. Its precision and landmarks are
        not used.
    labels : array_like of int, shape (H, W) or (D, H, W)
        Label of each site; the tissue of a label has one value of each fitted property.
    measured : array_like, shape (H, W, 2) or (D, H, W, 3), optional
        Measured displacement in the unit of `spacing`; NaN where a component is unknown. Do not
        pass the result of a registration or of `solve` with an elastic model: it would return the
        stiffness that was assumed there.
    sd : float or array_like, shape (H, W) or (D, H, W), optional
        Standard deviation of each component of the measured displacement, whose errors at different
        sites are taken to be independent. Required with `measured`.
    landmarks : Landmarks, optional
        Further measured displacements, each with its own standard deviation.
    images : (array_like, array_like), optional
        Images of the tissue before and after the motion, of the same kind, instead of `measured`
        and `landmarks`; each of shape (H, W) or (D, H, W), with NaN where pixels do not count.
        Brightness, contrast and bias may differ. The noise is estimated from their difference.
    stiffness, growth, poisson : iterable of int
        Labels whose stiffness, growth strain or Poisson's ratio is fitted. Only ratios of stiffness
        affect a displacement: unless there are forces, leave out the stiffness of one label.
    load : bool
        True to fit a factor on the forces of the problem, relative to the stiffness.
    prior : ElasticPrior or NeoHookeanPrior, optional
        By default elastic tissue, as for `solve`.
    backend, progress, cancel
        As for `solve`.

    Returns
    -------
    Fit

    Raises
    ------
    ArgumentError
        If an argument is invalid.
    ProblemError
        If nothing is measured or fitted, or the measured motion does not determine a property.
    ConvergenceError
        If the steps do not settle.
    Cancelled
        If `cancel` was set.

    Examples
    --------
    The stiffness of an inclusion, from the motion of the tissue around it:

    >>> import numpy as np
    >>> from napari_hmrf import Problem, solve
    >>> from napari_hmrf.posterior import fit
    >>> labels = np.ones((32, 32), int)
    >>> labels[10:20, 10:20] = 2
    >>> held, moved = np.zeros((2, 32, 32, 2))
    >>> held[[0, -1]] = 1
    >>> moved[-1, :, 0] = 2
    >>> true = Problem(observed=moved, confidence=held, stiffness=np.where(labels == 2, 5.0, 1.0))
    >>> seen = solve(true).displacement + np.random.default_rng(0).normal(0, 0.02, moved.shape)
    >>> guess = Problem(observed=moved, confidence=held, stiffness=np.ones((32, 32)))
    >>> found = fit(guess, labels, measured=seen, sd=0.02, stiffness=[2]).stiffness[2]
    >>> found.interval[0] < 5 < found.interval[1]
    True
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    require_flag("load", load)
    given = {"stiffness": stiffness, "growth": growth, "poisson": poisson}
    wanted = {kind: _named_labels(kind, numbers) for kind, numbers in given.items()}
    numbers = checked_labels(labels, problem)
    bare = variant_of(problem, precision=None, landmarks=None)
    tissue = _Tissue(bare, _checked_prior(bare, prior))
    levels: Sequence[FitData]
    if images is None:
        levels = [FieldData.of(problem, measured, sd, landmarks)]
    else:
        if measured is not None or landmarks is not None:
            raise ProblemError(
                "images", "replace a measured motion and landmarks. Pass one of them only."
            )
        pair, sizes = _checked_pair(images, bare), [size for size, _ in schedule(bare.shape)]
        levels = _pair_levels(pair, bare, sizes, cancel)
    properties = _properties(tissue, numbers, wanted, load)
    values = np.array([each.initial for each in properties])
    *coarse, finest = (
        _Fitter(
            tissue, data, properties, _FitSolver(backend, cancel, progress, number, len(levels))
        )
        for number, data in enumerate(levels)
    )
    for fitter in coarse:
        # Large pixels may show too little of small tissue; the next level then starts as this one.
        with suppress(ProblemError, ConvergenceError):
            values = fitter.values(values)
    return finest.run(values)


def _checked_prior(problem: Problem, prior: Prior | None) -> Elastic:
    """Return the prior of a problem to which properties can be fitted."""
    if not isinstance(prior, NeoHookeanPrior):
        return checked_prior(problem, prior)
    in_force = prior.in_force(problem)
    checked_prior(problem, in_force.at_rest)
    return in_force


def _checked_pair(images: tuple[npt.ArrayLike, npt.ArrayLike], problem: Problem) -> Images:
    """Check two images and mark their pixels that count.

    Raises
    ------
    ProblemError
        If there are not two images on the grid of the problem, or an image is uniform.
    """
    if len(images) != 2:
        raise ProblemError("images", "are not two: pass the image before and the image after.")
    pixels, counted = [], []
    for name, image in zip(("before", "after"), images, strict=True):
        values = np.array(as_numbers("images", image), dtype=np.float32)
        if values.shape != problem.shape:
            raise ProblemError(
                "images",
                f"have shape {values.shape} ({name}), but stiffness has shape {problem.shape}. "
                "Use the same pixel grid for all.",
            )
        known = np.isfinite(values)
        if not known.any() or np.ptp(values[known]) == 0:
            raise ProblemError("images", f"show no structure {name} the motion.")
        pixels.append(np.where(known, values, np.float32(0)))
        counted.append(known)
    return Images(pixels[0], pixels[1], (counted[0], counted[1]))


def _pair_levels(
    pair: Images, problem: Problem, sizes: Sequence[int], cancel: CancelFlag | None
) -> list[ImagePairData]:
    """Return the differences of two images on each level, from large to small pixels."""
    checkpoint = partial(stop_if_cancelled, cancel)
    return [ImagePairData(pair, problem, size, checkpoint) for size in sizes]


class FitData(Protocol):
    """Data to which properties are fitted, as differences in units of their noise."""

    def misfit(self, displacement: npt.NDArray[Any]) -> Float64Array:
        """Return the differences between a displacement and the data."""

    def derivative(self, displacement: npt.NDArray[Any], response: Float64Array) -> Float64Array:
        """Return the derivatives of the differences, given that of the displacement."""

    def tolerance(self, problem: Problem) -> float:
        """Return the tolerance of a solve, in pixels, at which its error is negligible."""

    def variance(self, differences: Float64Array) -> float:
        """Return the variance of the noise, from the differences at the solution."""

    def covariance(self, slopes: Float64Array, differences: Float64Array) -> Float64Array:
        """Return the covariance of the properties."""


class _Tissue(NamedTuple):
    """Problem and prior with certain values of the properties."""

    problem: Problem
    prior: Elastic

    def with_loads(self, **changes: npt.NDArray[Any]) -> _Tissue:
        """Return the tissue with another `growth` or `force`."""
        known = self.problem.loads
        kept = {} if known is None else {"growth": known.growth, "force": known.force}
        loads = Loads(**{**kept, **changes}, spacing=self.problem.spacing)
        return self._replace(problem=variant_of(self.problem, loads=loads))


class _Property:
    """Unknown property of the tissue of a label.

    Parameters
    ----------
    label : int
    sites : ndarray of bool
        Tissue of the label.

    Attributes
    ----------
    kind : str
        Name of the attribute of `Fit`.
    words : str
        Name for messages.
    initial : float
        Initial value; of a stiffness, 0: the logarithm of a factor.
    limits : (float, float)
        Range of values.
    probe : float
        Change for a difference of two solutions, in large motion.
    """

    kind: ClassVar[str]
    probe: ClassVar[float] = 0.01
    limits: ClassVar[tuple[float, float]] = (-math.inf, math.inf)

    def __init__(self, label: int, sites: npt.NDArray[np.bool_]) -> None:
        self.label, self.sites = label, sites
        self.words = f"the {self.kind} of label {label}"
        self.initial = 0.0

    def apply(self, tissue: _Tissue, value: float) -> _Tissue:
        """Return the tissue with a value of this property."""
        raise NotImplementedError

    def change(self, tissue: _Tissue) -> tuple[_Tissue, float]:
        """Return the tissue after a small change of this property, and the change."""
        raise NotImplementedError


class _Stiffness(_Property):
    kind = "stiffness"
    probe = 0.1
    limits = (-_LARGEST_LOGARITHM, _LARGEST_LOGARITHM)

    def apply(self, tissue: _Tissue, value: float) -> _Tissue:
        """Multiply the stiffness by the exponential of the value."""
        m = tissue.problem.stiffness.copy()
        m[self.sites] *= np.float32(math.exp(value))
        return tissue._replace(problem=variant_of(tissue.problem, stiffness=m))

    def change(self, tissue: _Tissue) -> tuple[_Tissue, float]:
        """Double the stiffness, in which the forces are linear: d m = m d(log m)."""
        return self.apply(tissue, math.log(2.0)), 1.0


class _Growth(_Property):
    kind = "growth"
    limits = (-0.9, 10.0)

    def __init__(self, label: int, sites: npt.NDArray[np.bool_], problem: Problem) -> None:
        super().__init__(label, sites)
        self.initial = float(_growth_of(problem)[sites].mean())

    def apply(self, tissue: _Tissue, value: float) -> _Tissue:
        """Set the strain of growth, which is the same in all directions."""
        return tissue.with_loads(growth=np.where(self.sites, value, _growth_of(tissue.problem)))

    def change(self, tissue: _Tissue) -> tuple[_Tissue, float]:
        """Add a growth of 1, in which the forces are linear."""
        return tissue.with_loads(growth=_growth_of(tissue.problem) + self.sites), 1.0


class _Poisson(_Property):
    kind = "poisson"
    limits = POISSON_RANGE

    def __init__(self, label: int, sites: npt.NDArray[np.bool_], prior: Elastic) -> None:
        super().__init__(label, sites)
        self.words = f"Poisson's ratio of label {label}"
        self.initial = float(_ratios_of(prior, sites.shape)[sites].mean())

    def apply(self, tissue: _Tissue, value: float) -> _Tissue:
        """Set Poisson's ratio."""
        ratios = np.where(self.sites, value, _ratios_of(tissue.prior, self.sites.shape))
        return tissue._replace(prior=replace(tissue.prior, poisson=ratios))

    def change(self, tissue: _Tissue) -> tuple[_Tissue, float]:
        """Change the ratio a little, away from its limit."""
        value = float(_ratios_of(tissue.prior, self.sites.shape)[self.sites][0])
        step = _SMALL if value + _SMALL < POISSON_RANGE[1] else -_SMALL
        return self.apply(tissue, value + step), step


class _Load(_Property):
    kind = "load"

    def __init__(self, force: npt.NDArray[Any]) -> None:
        super().__init__(0, np.empty(0, bool))
        self.words = "the size of the loads"
        self.initial, self._force = 1.0, force

    def apply(self, tissue: _Tissue, value: float) -> _Tissue:
        """Multiply the forces by the value."""
        return tissue.with_loads(force=value * self._force)

    def change(self, tissue: _Tissue) -> tuple[_Tissue, float]:
        """Add the forces once more."""
        assert tissue.problem.loads is not None
        assert tissue.problem.loads.force is not None
        return tissue.with_loads(force=tissue.problem.loads.force + self._force), 1.0


class _FitSolver:
    """Solver of the problems of a level, with progress over all levels."""

    def __init__(
        self,
        backend: str,
        cancel: CancelFlag | None,
        progress: Progress | None,
        level: int,
        levels: int,
    ) -> None:
        self.backend, self.cancel = backend, cancel
        self._progress, self._level, self._levels = progress, level, levels

    def begin(self, number: int) -> None:
        """Report the start of a step."""
        if self._progress is not None:
            done = (self._level + number / _STEPS) / self._levels
            self._progress(Monitor(f"step {number + 1} of the fit", done))

    def solve(self, tissue: _Tissue, tolerance: float, initial: Solution | None) -> Solution:
        """Return the motion of tissue.

        Raises
        ------
        ProblemError
            If large motion does not reach the boundary conditions or all growth.
        """
        solution = solve(
            tissue.problem,
            tissue.prior,
            optimizer=Multigrid(tolerance=tolerance),
            backend=self.backend,
            cancel=self.cancel,
            initial=initial,
        )
        reach = solution.reach
        if reach is not None and min(reach.part, reach.grown) < 1:
            raise ProblemError(
                "motion",
                "is not reached completely in large motion, because tissue would be crushed. Use "
                "a smaller motion, or the elastic model.",
            )
        return solution


class _State(NamedTuple):
    """Tissue with certain properties, its motion, and the differences from the data."""

    tissue: _Tissue
    solution: Solution
    differences: Float64Array

    @property
    def square(self) -> float:
        """Sum of the squares of the differences."""
        return float(self.differences @ self.differences)


class _Fitter:
    """Gauss-Newton iteration for the properties of tissue, on the data of a level."""

    def __init__(
        self, tissue: _Tissue, data: FitData, properties: Sequence[_Property], solver: _FitSolver
    ) -> None:
        self._initial, self._data, self._properties = tissue, data, properties
        self._solver, self._tolerance = solver, data.tolerance(tissue.problem)

    def values(self, start: Float64Array) -> Float64Array:
        """Return the values of the properties to which they nearly settle, from initial values."""
        return self._settle(start, _NEARLY_SETTLED)[0]

    def run(self, start: Float64Array) -> Fit:
        """Return the fitted properties, from initial values.

        Raises
        ------
        ProblemError
            If the measured motion does not determine a property.
        ConvergenceError
            If the steps do not settle.
        """
        values, state, slopes = self._settle(start, _SETTLED)
        self._check_determined(slopes, state.differences)
        return self._result(values, state, slopes)

    def _settle(
        self, values: Float64Array, accuracy: float
    ) -> tuple[Float64Array, _State, Float64Array]:
        """Return the values at which the steps settle, with their state and its derivatives.

        Steps are those of Levenberg and Marquardt.
        """
        state, damping = self._at(values, None), 0.0
        for number in range(_STEPS):
            self._solver.begin(number)
            slopes = self._slopes(values, state)
            variance = self._data.variance(state.differences)
            normal, gradient = slopes.T @ slopes, slopes.T @ state.differences
            scale = np.diag(np.diag(normal))
            # Properties that the motion does not determine yet change by less than `_UNKNOWN`.
            normal += variance / _UNKNOWN**2 * np.eye(len(values))
            spread = np.sqrt(variance * np.diag(np.linalg.inv(normal)))
            for trial in range(_TRIALS):
                step = -np.linalg.solve(normal + damping * scale, gradient)
                if trial == 0 and (np.abs(step) <= accuracy * spread).all():
                    return values, state, slopes
                step *= min(1.0, _LARGEST_STEP / float(np.abs(step).max()))
                tried = self._within_limits(values + step)
                with suppress(ProblemError):  # a motion that large motion does not reach
                    after = self._at(tried, state.solution)
                    if after.square <= state.square:
                        damping /= _DAMPING_FACTOR
                        break
                damping = max(_DAMPING, _DAMPING_FACTOR * damping)
            else:
                # The differences are as small as the accuracy of the solver allows.
                if (np.abs(np.linalg.solve(normal, gradient)) <= spread).all():
                    return values, state, slopes
                break
            values, state = tried, after
        raise ConvergenceError(
            "the fit did not settle. Fit fewer properties, or start from better values"
        )

    def _within_limits(self, values: Float64Array) -> Float64Array:
        low, high = np.transpose([each.limits for each in self._properties])
        return np.clip(values, low, high)

    def _at(self, values: Float64Array, initial: Solution | None) -> _State:
        """Return the state of the tissue with certain properties."""
        tissue = self._initial
        for each, value in zip(self._properties, values, strict=True):
            tissue = each.apply(tissue, float(value))
        solution = self._solver.solve(tissue, self._tolerance, initial)
        return _State(tissue, solution, self._data.misfit(solution.displacement))

    def _slopes(self, values: Float64Array, state: _State) -> Float64Array:
        """Return the derivatives of the differences with respect to the properties."""
        linear = isinstance(state.tissue.prior, ElasticPrior)
        responses = self._responses(state) if linear else self._probed(values, state)
        here = state.solution.displacement
        return np.stack([self._data.derivative(here, each) for each in responses], axis=1)

    def _responses(self, state: _State) -> Iterator[Float64Array]:
        """Return the derivatives of the displacement, as responses to forces."""
        tissue, solution = state.tissue, state.solution
        assert isinstance(tissue.prior, ElasticPrior)
        operator = Operator(tissue.problem, tissue.prior, self._solver.backend)
        forces = _forces(tissue, solution)
        for each in self._properties:
            changed, step = each.change(tissue)
            push = -(_forces(changed, solution) - forces) / step
            yield operator.solve(push, cancel=self._solver.cancel).astype(np.float64)

    def _probed(self, values: Float64Array, state: _State) -> Iterator[Float64Array]:
        """Return the derivatives of the displacement, as differences of two solutions."""
        for number, each in enumerate(self._properties):
            tried = values.copy()
            # Away from the nearer limit.
            low, high = each.limits
            step = each.probe if values[number] + each.probe < high else -each.probe
            tried[number] += step if tried[number] + step > low else each.probe
            moved = self._at(tried, state.solution).solution.displacement
            change = moved.astype(np.float64) - state.solution.displacement
            yield change / (tried[number] - values[number])

    def _check_determined(self, slopes: Float64Array, differences: Float64Array) -> None:
        """Raise an error if the measured motion does not determine a property."""
        least = math.sqrt(self._data.variance(differences)) / _UNKNOWN
        sizes = np.sqrt((slopes**2).sum(axis=0))
        for each, size in zip(self._properties, sizes, strict=True):
            if size < least:
                raise ProblemError(
                    each.kind,
                    f"cannot be fitted: the measured motion hardly depends on {each.words}. Leave "
                    "it out, or measure more accurately.",
                )
        matrix = slopes.T @ slopes
        values, vectors = np.linalg.eigh(matrix)
        if values[0] < least**2:
            parts = np.abs(vectors[:, 0])
            named = [
                each.words
                for each, part in zip(self._properties, parts, strict=True)
                if part > 0.3 * parts.max()
            ]
            raise ProblemError(
                self._properties[int(parts.argmax())].kind,
                f"cannot be fitted: {' and '.join(named)} can change together without a change of "
                "the measured motion. Leave one out.",
            )

    def _result(self, values: Float64Array, state: _State, slopes: Float64Array) -> Fit:
        covariance = self._data.covariance(slopes, state.differences)
        found: dict[str, dict[int, FittedProperty]] = {
            kind: {} for kind in ("stiffness", "growth", "poisson", "load")
        }
        for number, (each, value) in enumerate(zip(self._properties, values, strict=True)):
            sd = math.sqrt(covariance[number, number])
            ends = np.array([value - _INTERVAL * sd, value + _INTERVAL * sd])
            if each.kind == "stiffness":
                reference = float(np.median(self._initial.problem.stiffness[each.sites]))
                value, ends = reference * math.exp(value), reference * np.exp(ends)
            found[each.kind][each.label] = FittedProperty(float(value), sd, tuple(ends.tolist()))
        pair = self._data if isinstance(self._data, ImagePairData) else None
        alike = (None, None) if pair is None else pair.similarities(state.solution.displacement)
        freedom = max(1, state.differences.size - len(values))
        return Fit(
            found["stiffness"],
            found["growth"],
            found["poisson"],
            found["load"].get(0),
            covariance,
            1.0 if pair is not None else state.square / freedom,
            *state.tissue,
            state.solution,
            *alike,
        )


def _forces(tissue: _Tissue, solution: Solution) -> Float64Array:
    """Return the forces on the sites at a displacement, in the unit of `Loads`."""
    unit = tissue.prior.force_unit(tissue.problem)
    return tissue.prior.forces(tissue.problem, solution.displacement) * unit


def _growth_of(problem: Problem) -> Float64Array:
    """Return the growth of each site, which must be the same in all directions."""
    growth = None if problem.loads is None else problem.loads.growth
    if growth is None:
        return np.zeros(problem.shape)
    if growth.ndim > len(problem.shape):
        raise ProblemError(
            "growth",
            "is a tensor. Pass one number for each site to fit growth, which is then the same in "
            "all directions.",
        )
    return growth.astype(np.float64)


def _ratios_of(prior: Elastic, shape: tuple[int, ...]) -> Float64Array:
    return np.broadcast_to(np.asarray(prior.poisson, dtype=np.float64), shape)


def _named_labels(kind: str, numbers: Any) -> tuple[int, ...]:
    """Return the labels that an argument names; raise `ArgumentError` if it names none."""
    right = isinstance(numbers, Iterable) and not isinstance(numbers, str | bytes)
    found = tuple(numbers) if right else ()
    right = right and all(is_whole(each) and not isinstance(each, bool) for each in found)
    refuse_unless(right, kind, numbers, "the labels to fit, such as [2]")
    return tuple(map(int, found))


def _properties(
    tissue: _Tissue,
    labels: npt.NDArray[Any],
    wanted: Mapping[str, tuple[int, ...]],
    load: bool,
) -> list[_Property]:
    """Return the unknown properties, in the order of `Fit.covariance`.

    Raises
    ------
    ProblemError
        If nothing is fitted, or a label has no soft tissue.
    """
    problem, prior = tissue
    soft = problem.tissue & ~problem.rigid
    found: list[_Property] = []
    for kind, numbers in wanted.items():
        for number in numbers:
            sites = (labels == number) & soft
            if not sites.any():
                raise ProblemError(kind, f"names label {number}, which has no soft tissue.")
            if kind == "stiffness":
                found.append(_Stiffness(number, sites))
            elif kind == "growth":
                found.append(_Growth(number, sites, problem))
            else:
                found.append(_Poisson(number, sites, prior))
    force = None if problem.loads is None else problem.loads.force
    if load and force is None:
        raise ProblemError("load", "is to be fitted, but the problem has no forces. Add loads.")
    if load and force is not None:
        found.append(_Load(force))
    if not found:
        raise ProblemError(
            "stiffness", "and all other properties are known: name a label to fit, or pass load."
        )
    soft_labels = set(np.unique(labels[soft]).tolist())
    fitted = {each.label for each in found if each.kind == "stiffness"}
    if force is None and fitted >= soft_labels:
        raise ProblemError(
            "stiffness",
            "of all labels cannot be fitted: without forces, only ratios of stiffness affect the "
            "motion. Leave one label out.",
        )
    return found
