"""Scale of the prior and size of the errors of observations, by maximum likelihood.

The differences r between observations and the motion of the tissue without them are normally
distributed with the covariance ``a^2 T C + b^2 R`` (see `data_space`), where a is a factor on the
typical strain and b a factor on the standard deviations. After one decomposition that makes both
matrices diagonal, with the entries p_i and 1, the logarithm of the likelihood is a sum,

    L(a, b) = - 1/2 sum of [ log(a^2 p_i + b^2) + z_i^2 / (a^2 p_i + b^2) ] + const

whose maximum is found by a search on a grid and a refinement. The ends of an interval of 95 % are
where the largest likelihood for this value of the parameter is smaller than the maximum by a factor
of exp(-1.92) (profile likelihood).

D. Harville: Maximum likelihood approaches to variance component estimation and to related problems.
Journal of the American Statistical Association 72, 1977.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import require_flag
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
#: Smallest number of independent combinations of observations, for one or two parameters.
_LEAST = (4, 8)


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
    noise : float
        Fitted factor on all standard deviations; 1 if it was not fitted.
    noise_interval : (float, float)
        Interval that contains this factor with a probability of 95 %; (1, 1) if it was not fitted.
    freedom : int
        Number of independent combinations of observed components that no free rigid motion changes.
    log_likelihood : float
        Logarithm of the probability density of these combinations.
    problem : Problem
        Problem with the fitted scale and errors, for `solve` and `uncertainty`.
    """

    scale: StrainScale
    strain_interval: tuple[float, float]
    noise: float
    noise_interval: tuple[float, float]
    freedom: int
    log_likelihood: float
    problem: Problem

    def __repr__(self) -> str:
        low, high = self.strain_interval
        noise = ""
        if self.noise_interval != (1.0, 1.0):
            least, most = self.noise_interval
            noise = f", noise {self.noise:.3g} ({least:.3g} to {most:.3g})"
        return f"ScaleFit(strain {self.scale.strain:.3g} ({low:.3g} to {high:.3g}){noise})"


def fit_scale(
    problem: Problem,
    prior: Prior | None = None,
    *,
    scale: StrainScale | None = None,
    noise: bool = False,
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
    noise : bool
        True to fit a factor on the standard deviations of all observations, too. This takes more
        observations: their errors must be distinguished from small-scale strain.
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
        tissue; if they do not determine the strain or the noise; or for the reasons of
        `sample_posterior`.
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
    require_flag("noise", noise)
    elastic, energy = checked_prior(problem, prior), energy_of(problem, scale)
    marks = problem.landmarks
    stated = scale or (StrainScale() if marks is None else marks.scale)
    space = data_space(problem, elastic, energy, backend, progress, cancel)
    count, least = len(space.residual), _LEAST[noise]
    if count < least:
        raise ProblemError(
            "landmarks",
            f"are too few: apart from rigid motions they have {count} independent components, and "
            f"{least} are needed. Add landmarks.",
        )
    likelihood = Likelihood.of(space, energy, noise)
    if not likelihood.shares.any():
        raise ProblemError(
            "landmarks",
            "are all in held tissue, so they do not depend on the scale. Add landmarks elsewhere.",
        )
    strain = likelihood.most_likely()
    interval = likelihood.interval(likelihood.profile_strain, strain)
    if strain < _LOW + _NEAR:
        raise ProblemError(
            "scale",
            "cannot be fitted: the errors of the observations explain all of their motion. The "
            f"typical strain is at most {stated.strain * interval[1]:.2g}; state a smaller one.",
        )
    factor, ends = 1.0, (1.0, 1.0)
    if noise:
        logarithm = likelihood.noise_at(strain)
        ends = likelihood.interval(likelihood.profile_noise, logarithm)
        if logarithm < _LOW + _NEAR:
            raise ProblemError(
                "noise",
                "cannot be fitted: strain explains all of the observations, and their standard "
                f"deviations are at most {ends[1]:.2g} times the stated ones. Omit noise.",
            )
        factor = math.exp(logarithm)
    fitted = replace(stated, strain=stated.strain * math.exp(strain))
    return ScaleFit(
        fitted,
        (stated.strain * interval[0], stated.strain * interval[1]),
        factor,
        ends,
        count,
        likelihood.profile_strain(strain) + likelihood.constant,
        _rescaled(problem, fitted, math.exp(strain), factor),
    )


def _rescaled(problem: Problem, scale: StrainScale, strain: float, noise: float) -> Problem:
    """Return the problem with another scale, and with standard deviations times `noise`."""
    changes: dict[str, Any] = {}
    marks = problem.landmarks
    if marks is not None:
        changes["landmarks"] = Landmarks(
            marks.points, marks.targets, sd=noise * marks.sd, scale=scale
        )
    if problem.precision is not None:
        precision = problem.precision * (strain / noise) ** 2
        precision.setflags(write=False)
        changes["precision"] = precision
    return variant_of(problem, **changes)


class Likelihood(NamedTuple):
    """Likelihood of factors on the typical strain and on the standard deviations.

    Attributes
    ----------
    shares : ndarray, shape (k,)
        Variances under the prior, relative to those of the errors: p in the equations.
    squares : ndarray, shape (k,)
        Squared differences, relative to the variances of the errors: z^2 in the equations.
    constant : float
        Part of the logarithm that does not depend on the factors.
    with_noise : bool
        False if the factor on the standard deviations is 1.
    """

    shares: Float64Array
    squares: Float64Array
    constant: float
    with_noise: bool

    @classmethod
    def of(cls, space: DataSpace, energy: float, with_noise: bool) -> Likelihood:
        """Make both covariances diagonal."""
        root = np.linalg.cholesky(space.noise)
        scaled = scipy.linalg.solve_triangular(
            root, np.diag(np.sqrt(energy * space.variance)), lower=True
        )
        shares, ways = np.linalg.eigh(scaled @ scaled.T)
        differences = ways.T @ scipy.linalg.solve_triangular(root, space.residual, lower=True)
        constant = -float(np.log(np.diag(root)).sum()) - len(shares) / 2 * math.log(2 * math.pi)
        return cls(np.maximum(shares, 0), differences**2, constant, with_noise)

    def value(self, strain: Logarithm, noise: Logarithm) -> Float64Array:
        """Return the logarithm of the likelihood of logarithms of factors, one or an array."""
        variances = np.multiply.outer(np.exp(2 * np.asarray(strain)), self.shares)
        variances = variances + np.exp(2 * np.asarray(noise))[..., np.newaxis]
        return np.asarray(-0.5 * (np.log(variances) + self.squares / variances).sum(axis=-1))

    def most_likely(self) -> float:
        """Return the logarithm of the most likely factor on the strain."""
        if not self.with_noise:
            return _argmax(lambda strain: self.value(strain, 0.0))
        return _argmax(np.vectorize(self.profile_strain))

    def noise_at(self, strain: float) -> float:
        """Return the logarithm of the most likely factor on the errors, at a given strain."""
        return _argmax(lambda noise: self.value(strain, noise)) if self.with_noise else 0.0

    def profile_strain(self, strain: float) -> float:
        """Return the largest value at a given strain."""
        return float(self.value(strain, self.noise_at(strain)))

    def profile_noise(self, noise: float) -> float:
        """Return the largest value at a given factor on the errors."""
        return float(self.value(_argmax(lambda strain: self.value(strain, noise)), noise))

    def interval(self, profile: Callable[[float], float], best: float) -> tuple[float, float]:
        """Return the factors at which a profile is smaller than its maximum by `_DROP`."""
        target = profile(best) - _DROP

        def above(value: float) -> float:
            return profile(value) - target

        low = 0.0
        if above(_LOW) < 0:
            low = math.exp(scipy.optimize.brentq(above, _LOW, best, xtol=1e-3))
        high = math.inf
        if above(_HIGH) < 0:
            high = math.exp(scipy.optimize.brentq(above, best, _HIGH, xtol=1e-3))
        return low, high


def _argmax(function: Callable[[Logarithm], Float64Array]) -> float:
    """Return the logarithm of a factor at which a function is largest."""
    values = np.linspace(_LOW, _HIGH, _COUNT)
    best = int(np.argmax(function(values)))
    ends = values[max(best - 1, 0)], values[min(best + 1, _COUNT - 1)]
    found = scipy.optimize.minimize_scalar(
        lambda value: -float(function(value)), bounds=ends, method="bounded"
    )
    return float(found.x)
