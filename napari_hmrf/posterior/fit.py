"""Properties of tissue from its measured motion: growth, stiffness, Poisson's ratio and loads.

The displacement d of elastic tissue is in equilibrium, g(d, p) = 0, where g are the forces on the
sites and p the unknown properties. The properties are those with which the displacement is closest
to the measured one, y, in units of its standard deviation s:

    minimize  sum of |H d(p) - y|^2 / s^2

by Gauss-Newton steps. The derivative of the displacement with respect to a property p_k is the
response of the tissue to the forces ``- dg / dp_k``: one solve for each property and step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_flag
from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.posterior.field_data import FieldData
from napari_hmrf.posterior.response import Response
from napari_hmrf.posterior.sampling import checked_prior
from napari_hmrf.posterior.uncertainty import checked_labels
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments, solve
from napari_hmrf.solver.uncertain_landmarks import Landmarks

Float64Array = npt.NDArray[np.float64]

#: Largest number of Gauss-Newton steps, and of halvings of a step.
_STEPS, _HALVINGS = 20, 8
#: Change of a property, in units of its standard deviation, below which the steps end.
_SETTLED = 0.02
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
        square root.
    problem : Problem
        Problem with the fitted properties, without the measured motion.
    prior : ElasticPrior
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
    prior: ElasticPrior
    solution: Solution

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
        Measured displacement in the unit of `spacing`; NaN where it is unknown. Do not pass the
        result of a registration or of `solve` with an elastic model: it would return the stiffness
        that was assumed there.
    sd : float or array_like, shape (H, W) or (D, H, W), optional
        Standard deviation of each component of the measured displacement, whose errors at different
        sites are taken to be independent. Required with `measured`.
    landmarks : Landmarks, optional
        Further measured displacements, each with its own standard deviation.
    stiffness, growth, poisson : iterable of int
        Labels whose stiffness, growth strain or Poisson's ratio is fitted. Only ratios of stiffness
        affect a displacement: unless there are forces, leave out the stiffness of one label.
    load : bool
        True to fit a factor on the forces of the problem, relative to the stiffness.
    prior : ElasticPrior, optional
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
    >>> true = Problem(moved, held, np.where(labels == 2, 5.0, 1.0))
    >>> seen = solve(true).displacement + np.random.default_rng(0).normal(0, 0.02, moved.shape)
    >>> guess = Problem(moved, held, np.ones((32, 32)))
    >>> found = fit(guess, labels, measured=seen, sd=0.02, stiffness=[2]).stiffness[2]
    >>> found.interval[0] < 5 < found.interval[1]
    True
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    require_flag("load", load)
    numbers = checked_labels(labels, problem)
    bare = variant_of(problem, precision=None, landmarks=None)
    elastic = checked_prior(bare, prior)
    data = FieldData.of(problem, measured, sd, landmarks)
    tissue = _Tissue(bare, elastic)
    wanted = {"stiffness": stiffness, "growth": growth, "poisson": poisson}
    properties = _properties(tissue, numbers, wanted, load)
    return _Fitter(tissue, data, properties, backend, cancel, progress).run()


class _Tissue(NamedTuple):
    """Problem and prior with certain values of the properties."""

    problem: Problem
    prior: ElasticPrior

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
    """

    kind: ClassVar[str]
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

    def __init__(self, label: int, sites: npt.NDArray[np.bool_], prior: ElasticPrior) -> None:
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


class _Fitter:
    """Gauss-Newton iteration for the properties of tissue."""

    def __init__(
        self,
        tissue: _Tissue,
        data: FieldData,
        properties: Sequence[_Property],
        backend: str,
        cancel: CancelFlag | None,
        progress: Progress | None,
    ) -> None:
        self._initial = tissue
        self._data, self._properties = data, properties
        self._backend, self._cancel, self._progress = backend, cancel, progress
        self._optimizer = Multigrid(tolerance=data.tolerance(tissue.problem))

    def run(self) -> Fit:
        """Return the fitted properties."""
        values = np.array([each.initial for each in self._properties])
        tissue, solution, differences = self._at(values)
        for number in range(_STEPS):
            if self._progress is not None:
                self._progress(Monitor(f"step {number + 1} of the fit", number / _STEPS))
            slopes = self._slopes(tissue, solution)
            inverse = self._covariance(slopes)
            step = -inverse @ (slopes.T @ differences)
            spread = np.sqrt(np.diag(inverse) * max(1.0, self._misfit(differences)))
            if (np.abs(step) <= _SETTLED * spread).all():
                return self._result(values, tissue, solution, differences, inverse)
            step *= min(1.0, _LARGEST_STEP / float(np.abs(step).max()))
            before = float(differences @ differences)
            for _ in range(_HALVINGS):
                tried = self._within_limits(values + step)
                tissue, solution, differences = self._at(tried)
                if float(differences @ differences) <= before:
                    break
                step /= 2
            else:
                tissue, solution, differences = self._at(values)
                if (np.abs(step) * 2**_HALVINGS <= spread).all():
                    return self._result(values, tissue, solution, differences, inverse)
                break
            values = tried
        raise ConvergenceError(
            "the fit did not settle. Fit fewer properties, or start from better values"
        )

    def _within_limits(self, values: Float64Array) -> Float64Array:
        low, high = np.transpose([each.limits for each in self._properties])
        return np.clip(values, low, high)

    def _at(self, values: Float64Array) -> tuple[_Tissue, Solution, Float64Array]:
        """Return the tissue with certain properties, its motion and the differences."""
        tissue = self._initial
        for each, value in zip(self._properties, values, strict=True):
            tissue = each.apply(tissue, float(value))
        solution = solve(
            tissue.problem,
            tissue.prior,
            optimizer=self._optimizer,
            backend=self._backend,
            cancel=self._cancel,
        )
        return tissue, solution, self._data.misfit(solution.displacement)

    def _slopes(self, tissue: _Tissue, solution: Solution) -> Float64Array:
        """Return the derivatives of the differences with respect to the properties."""
        response = Response(tissue.problem, tissue.prior, self._backend, self._cancel)
        forces = _forces(tissue, solution)
        slopes = []
        for each in self._properties:
            changed, step = each.change(tissue)
            push = -(_forces(changed, solution) - forces) / step
            moved = np.zeros_like(push)
            if push.any():
                moved = response.to(push, response.units_for(push))
            slopes.append(self._data.derivative(moved))
        return np.stack(slopes, axis=1)

    def _covariance(self, slopes: Float64Array) -> Float64Array:
        """Return the covariance of the properties.

        Raises
        ------
        ProblemError
            If the measured motion does not determine a property.
        """
        sizes = np.sqrt((slopes**2).sum(axis=0))
        for each, size in zip(self._properties, sizes, strict=True):
            if size * _UNKNOWN < 1:
                raise ProblemError(
                    each.kind,
                    f"cannot be fitted: the measured motion hardly depends on {each.words}. Leave "
                    "it out, or measure more accurately.",
                )
        matrix = slopes.T @ slopes
        values, vectors = np.linalg.eigh(matrix)
        if values[0] * _UNKNOWN**2 < 1:
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
        return np.asarray(np.linalg.inv(matrix))

    def _misfit(self, differences: Float64Array) -> float:
        """Return the mean squared difference, in units of its variance."""
        freedom = max(1, differences.size - len(self._properties))
        return float(differences @ differences) / freedom

    def _result(
        self,
        values: Float64Array,
        tissue: _Tissue,
        solution: Solution,
        differences: Float64Array,
        inverse: Float64Array,
    ) -> Fit:
        misfit = self._misfit(differences)
        # Differences larger than their errors make the properties less certain.
        covariance = inverse * max(1.0, misfit)
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
        return Fit(
            found["stiffness"],
            found["growth"],
            found["poisson"],
            found["load"].get(0),
            covariance,
            misfit,
            tissue.problem,
            tissue.prior,
            solution,
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


def _ratios_of(prior: ElasticPrior, shape: tuple[int, ...]) -> Float64Array:
    return np.broadcast_to(np.asarray(prior.poisson, dtype=np.float64), shape)


def _properties(
    tissue: _Tissue,
    labels: npt.NDArray[Any],
    wanted: Mapping[str, Iterable[int]],
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
                found.append(_Stiffness(int(number), sites))
            elif kind == "growth":
                found.append(_Growth(int(number), sites, problem))
            else:
                found.append(_Poisson(int(number), sites, prior))
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
