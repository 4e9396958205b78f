"""Agreement of observations with the model: a chi-squared test of all, and of each landmark.

The differences r between observations and the motion of the tissue without them have the covariance
``S = T C + R`` if the model is right (see `data_space`). Their squared size in units of S,

    chi^2 = r^T S^-1 r

then has a chi-squared distribution. The difference between an observation and its prediction by all
other observations is ``(S^-1 r)_i / (S^-1)_ii``, with the variance ``1 / (S^-1)_ii``.

R. Christensen, L. Pearson, W. Johnson: Case-deletion diagnostics for mixed models. Technometrics
34, 1992.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.posterior.data_space import DataSpace, data_space
from napari_hmrf.posterior.sampling import checked_prior, energy_of
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments
from napari_hmrf.solver.uncertain_landmarks import StrainScale

Float64Array = npt.NDArray[np.float64]

#: Smallest part of a landmark that other observations must predict, relative to its precision.
_PREDICTED = 1e-6


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreement of uncertain observations with the tissue, the scale and the stated errors.

    Attributes
    ----------
    chi_squared : float
        Squared size of the differences from the motion without observations, in units of their
        covariance; about `freedom` if the model is right.
    freedom : int
        Degrees of freedom: number of observed components, without rigid motions that only the
        observations determine.
    p_value : float
        Probability of a larger value if the model is right. Below 0.05, the observations do not
        agree with the model at the level of 5 %. Close to 1, they agree better than their stated
        errors allow.
    residuals : ndarray, shape (n, 2) or (n, 3)
        Difference of each component of each landmark from its prediction by all other observations,
        in standard deviations of this difference; NaN if it cannot be predicted. Its distribution
        is standard normal if the model is right.
    landmark_p_values : ndarray, shape (n,)
        Probability of larger differences of all components of a landmark from their prediction by
        the other observations, if the model is right. One of n landmarks is suspicious if its value
        is below ``0.05 / n``.
    """

    chi_squared: float
    freedom: int
    p_value: float
    residuals: Float64Array
    landmark_p_values: Float64Array

    def __repr__(self) -> str:
        return (
            f"Agreement(chi-squared {self.chi_squared:.3g} with {self.freedom} degrees of freedom, "
            f"p {self.p_value:.2g})"
        )


def check_agreement(
    problem: Problem,
    prior: Prior | None = None,
    *,
    scale: StrainScale | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Agreement:
    """Test whether landmarks and other uncertain observations agree with the model.

    The model includes the held tissue, the loads, the stiffness, the typical strain, and the
    standard deviations of the observations. The test cannot tell which of them is wrong, but it
    shows which landmark differs most from its prediction by all others.

    Parameters
    ----------
    problem : Problem
        Problem with landmarks or a precision, without a drift or doubted observations.
    prior, scale, backend, cancel
        As for `sample_posterior`.
    progress : callable, optional
        As for `solve`. Each observed component takes one solve.

    Returns
    -------
    Agreement

    Raises
    ------
    ArgumentError
        If an argument is invalid.
    ProblemError
        If there are no observations, too few, or more than 3000 components; or for the reasons of
        `sample_posterior`.
    Cancelled
        If `cancel` was set.

    Examples
    --------
    One of six landmarks was assigned to a wrong target:

    >>> import numpy as np
    >>> from napari_hmrf import Problem
    >>> from napari_hmrf.landmarks import Landmarks, StrainScale
    >>> from napari_hmrf.posterior import check_agreement
    >>> held = np.zeros((32, 32, 2))
    >>> held[0] = 1
    >>> points = np.array([(8, 8), (8, 24), (16, 16), (24, 8), (24, 24), (30, 16)], float)
    >>> targets = points + (0.2, 0)
    >>> targets[3] = (14, 14)
    >>> marks = Landmarks(points, targets, sd=0.2, scale=StrainScale(0.1))
    >>> given = {"observed": 0 * held, "confidence": held, "stiffness": np.ones((32, 32))}
    >>> agreement = check_agreement(Problem(**given, landmarks=marks))
    >>> agreement.p_value < 0.001, int(agreement.landmark_p_values.argmin())
    (True, 3)
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    elastic, energy = checked_prior(problem, prior), energy_of(problem, scale)
    space = data_space(problem, elastic, energy, backend, progress, cancel)
    count = 0 if problem.landmarks is None else len(problem.landmarks)
    return agreement_in(space, energy, count, len(problem.shape))


def agreement_in(space: DataSpace, energy: float, landmarks: int, axes: int) -> Agreement:
    """Test the observations of a data space.

    Parameters
    ----------
    space : DataSpace
    energy : float
        Unit of energy, T in the equations.
    landmarks, axes : int
        Number of landmarks, whose components are the first observations, and number of axes.
    """
    inverse = np.linalg.inv(np.diag(energy * space.variance) + space.noise)
    weighted = inverse @ space.residual
    chi_squared, freedom = float(space.residual @ weighted), len(space.residual)
    rows = space.basis[: landmarks * axes].reshape(landmarks, axes, freedom)
    pulls, precisions = rows @ weighted, rows @ inverse @ rows.swapaxes(-1, -2)
    least = _PREDICTED / space.sd[: landmarks * axes].reshape(landmarks, axes) ** 2
    own = np.diagonal(precisions, axis1=-2, axis2=-1)
    residuals = _divided(pulls, np.sqrt(np.where(own > least, own, 0)))
    sizes, ways = np.linalg.eigh(precisions)
    known = sizes > least.min(axis=-1, keepdims=True)
    along = np.einsum("nij,ni->nj", ways, pulls)
    squares = np.nan_to_num(_divided(along**2, np.where(known, sizes, 0))).sum(axis=-1)
    predicted = known.sum(axis=-1)
    p_values = scipy.stats.chi2.sf(squares, np.where(predicted > 0, predicted, np.nan))
    p_value = float(scipy.stats.chi2.sf(chi_squared, freedom))
    return Agreement(chi_squared, freedom, p_value, residuals, np.asarray(p_values))


def _divided(values: Float64Array, by: Float64Array) -> Float64Array:
    """Return quotients, and NaN where the divisor is 0."""
    quotients = np.full(values.shape, np.nan)
    np.divide(values, by, out=quotients, where=by > 0)
    return quotients
