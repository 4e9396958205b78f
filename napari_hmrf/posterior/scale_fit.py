"""Scale of the prior, by maximum likelihood.

The differences r between observations and the motion of the tissue without them are normally
distributed with the covariance ``a^2 T C + R`` (see `data_space`), where a is a factor on the
typical strain. After one decomposition that makes both matrices diagonal, with the entries p_i and
1, the logarithm of the likelihood is a sum,

    L(a) = - 1/2 sum of [ log(a^2 p_i + 1) + z_i^2 / (a^2 p_i + 1) ] + const

whose maximum is found by a search on a grid and a refinement. The ends of an interval of 95 % are
where the likelihood is smaller than its maximum by a factor of exp(-1.92).

D. Harville: Maximum likelihood approaches to variance component estimation and to related problems.
Journal of the American Statistical Association 72, 1977.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.data_space import DataSpace, data_space
from napari_hmrf.posterior.sampling import checked_prior, energy_of
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments
from napari_hmrf.solver.uncertain_landmarks import Landmarks, StrainScale

Float64Array = npt.NDArray[np.float64]
#: Logarithm of a factor, or an array of logarithms.
Logarithm = float | Float64Array

#: Smallest and largest logarithm of a factor, and number of trial values.
_LOW, _HIGH, _COUNT = math.log(1e-4), math.log(1e4), 48
#: Distance from the smallest logarithm up to which the factor counts as 0.
_NEAR = 1.0
#: Half of the 95 % quantile of the chi-squared distribution with one degree of freedom.
_DROP = 1.9207
#: Smallest number of independent combinations of observations.
_LEAST = 4


@dataclass(frozen=True, eq=False)
class ScaleFit:
    """Scale of the prior that makes the observations most likely.

    Attributes
    ----------
    scale : StrainScale
        Fitted scale.
    strain_interval : (float, float)
        Interval that contains the typical strain with a probability of 95 %. It begins at 0 if the
        errors of the observations may explain all of them.
    freedom : int
        Number of independent combinations of observed components that no free rigid motion changes.
    log_likelihood : float
        Logarithm of the probability density of these combinations.
    problem : Problem
        Problem with the fitted scale, for `solve` and `uncertainty`.
    """

    scale: StrainScale
    strain_interval: tuple[float, float]
    freedom: int
    log_likelihood: float
    problem: Problem

    def __repr__(self) -> str:
        low, high = self.strain_interval
        return f"ScaleFit(strain {self.scale.strain:.3g} ({low:.3g} to {high:.3g}))"


def fit_scale(
    problem: Problem,
    prior: Prior | None = None,
    *,
    scale: StrainScale | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> ScaleFit:
    """Fit the typical strain of the tissue to uncertain observations, by maximum likelihood.

    The typical strain cannot be deduced from the stiffness. If several landmarks were observed,
    their motion shows how much the tissue is strained, as far as it differs from the motion that
    held tissue and loads cause. Rigid motions of tissue that is held by observations only are
    unknown, and do not count (restricted maximum likelihood).

    A fitted scale explains the observations by definition. To test whether observations agree with
    the model (see `check_agreement`), state the scale instead.

    Parameters
    ----------
    problem : Problem
        Problem with landmarks or a precision, without a drift or doubted observations.
    prior : ElasticPrior, optional
        By default elastic tissue, as for `solve`.
    scale : StrainScale, optional
        Scale whose strain is fitted; its extent and stiffness stay the same. By default that of the
        landmarks. It is required for a precision, as for `sample_posterior`.
    backend, cancel
        As for `solve`.
    progress : callable, optional
        As for `solve`. Each observed component takes one solve.

    Returns
    -------
    ScaleFit

    Raises
    ------
    ArgumentError
        If an argument is invalid.
    ProblemError
        If there are no observations, too few, or more than 3000 components; if all are in held
        tissue; if they do not determine the strain; or for the reasons of `sample_posterior`.
    Cancelled
        If `cancel` was set.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_hmrf import Problem
    >>> from napari_hmrf.landmarks import Landmarks, StrainScale
    >>> from napari_hmrf.posterior import fit_scale
    >>> held = np.zeros((32, 32, 2))
    >>> held[0] = 1
    >>> points = np.array([(8, 8), (8, 24), (16, 16), (24, 8), (24, 24), (30, 16)])
    >>> targets = points + np.outer(points[:, 0] / 10, (1, 0))
    >>> marks = Landmarks(points, targets, sd=0.2, scale=StrainScale(0.5))
    >>> given = {"observed": 0 * held, "confidence": held, "stiffness": np.ones((32, 32))}
    >>> found = fit_scale(Problem(**given, landmarks=marks))
    >>> low, high = found.strain_interval
    >>> 0.1 < low < found.scale.strain < high < 0.5
    True
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    elastic, energy = checked_prior(problem, prior), energy_of(problem, scale)
    marks = problem.landmarks
    stated = scale or (StrainScale() if marks is None else marks.scale)
    space = data_space(problem, elastic, energy, backend, progress, cancel)
    return scale_in(space, energy, stated, problem)


def scale_in(space: DataSpace, energy: float, stated: StrainScale, problem: Problem) -> ScaleFit:
    """Fit the typical strain to the observations of a data space.

    Parameters
    ----------
    space : DataSpace
    energy : float
        Unit of energy of the stated scale, T in the equations.
    stated : StrainScale
        Scale whose strain is fitted.
    problem : Problem
        Problem of the observations.

    Raises
    ------
    ProblemError
        If the observations are too few, or do not determine the strain.
    """
    count = len(space.residual)
    if count < _LEAST:
        raise ProblemError(
            "landmarks",
            f"are too few: apart from rigid motions they have {count} independent components, and "
            f"{_LEAST} are needed. Add landmarks.",
        )
    likelihood = Likelihood.of(space, energy)
    if not likelihood.shares.any():
        raise ProblemError(
            "landmarks",
            "are all in held tissue, so they do not depend on the scale. Add landmarks elsewhere.",
        )
    strain = likelihood.most_likely()
    interval = likelihood.interval(strain)
    if strain < _LOW + _NEAR:
        raise ProblemError(
            "scale",
            "cannot be fitted: the errors of the observations explain all of their motion. The "
            f"typical strain is at most {stated.strain * interval[1]:.2g}; state a smaller one.",
        )
    fitted = replace(stated, strain=stated.strain * math.exp(strain))
    return ScaleFit(
        fitted,
        (stated.strain * interval[0], stated.strain * interval[1]),
        count,
        float(likelihood.value(strain)) + likelihood.constant,
        _rescaled(problem, fitted, math.exp(strain)),
    )


def _rescaled(problem: Problem, scale: StrainScale, factor: float) -> Problem:
    """Return the problem with another scale, whose strain is larger by a factor."""
    changes: dict[str, Any] = {}
    marks = problem.landmarks
    if marks is not None:
        changes["landmarks"] = Landmarks(marks.points, marks.targets, sd=marks.sd, scale=scale)
    if problem.precision is not None:
        precision = problem.precision * factor**2
        precision.setflags(write=False)
        changes["precision"] = precision
    return variant_of(problem, **changes)


class Likelihood(NamedTuple):
    """Likelihood of a factor on the typical strain.

    Attributes
    ----------
    shares : ndarray, shape (k,)
        Variances under the prior, relative to those of the errors: p in the equations.
    squares : ndarray, shape (k,)
        Squared differences, relative to the variances of the errors: z^2 in the equations.
    constant : float
        Part of the logarithm that does not depend on the factor.
    """

    shares: Float64Array
    squares: Float64Array
    constant: float

    @classmethod
    def of(cls, space: DataSpace, energy: float) -> Likelihood:
        """Make both covariances diagonal."""
        root = np.linalg.cholesky(space.noise)
        scaled = scipy.linalg.solve_triangular(
            root, np.diag(np.sqrt(energy * space.variance)), lower=True
        )
        shares, ways = np.linalg.eigh(scaled @ scaled.T)
        differences = ways.T @ scipy.linalg.solve_triangular(root, space.residual, lower=True)
        constant = -float(np.log(np.diag(root)).sum()) - len(shares) / 2 * math.log(2 * math.pi)
        return cls(np.maximum(shares, 0), differences**2, constant)

    def value(self, strain: Logarithm) -> Float64Array:
        """Return the logarithm of the likelihood of logarithms of factors, one or an array."""
        variances = np.multiply.outer(np.exp(2 * np.asarray(strain)), self.shares) + 1
        return np.asarray(-0.5 * (np.log(variances) + self.squares / variances).sum(axis=-1))

    def most_likely(self) -> float:
        """Return the logarithm of the most likely factor."""
        values = np.linspace(_LOW, _HIGH, _COUNT)
        best = int(np.argmax(self.value(values)))
        ends = values[max(best - 1, 0)], values[min(best + 1, _COUNT - 1)]
        found = scipy.optimize.minimize_scalar(
            lambda value: -float(self.value(value)), bounds=ends, method="bounded"
        )
        return float(found.x)

    def interval(self, best: float) -> tuple[float, float]:
        """Return the factors at which the value is smaller than its maximum by `_DROP`."""
        target = float(self.value(best)) - _DROP

        def above(value: float) -> float:
            return float(self.value(value)) - target

        low = 0.0
        if above(_LOW) < 0:
            low = math.exp(scipy.optimize.brentq(above, _LOW, best, xtol=1e-3))
        high = math.inf
        if above(_HIGH) < 0:
            high = math.exp(scipy.optimize.brentq(above, best, _HIGH, xtol=1e-3))
        return low, high
