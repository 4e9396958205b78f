"""Standard deviations of displacements: means over patches, and means over labels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import is_whole, real, refuse_unless
from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.response import Response
from napari_hmrf.posterior.sampling import Sampler, checked_prior, energy_of
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem, whole_numbers
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments, solve
from napari_hmrf.solver.uncertain_landmarks import StrainScale

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Side of a patch by default, relative to the longest side of the image.
_PATCH = 0.05


@dataclass(frozen=True, eq=False)
class MeanDisplacement:
    """Mean displacement of the tissue of a label.

    Attributes
    ----------
    mean : ndarray, shape (n,)
        Mean displacement along each axis, in the unit of `spacing`.
    covariance : ndarray, shape (n, n)
        Covariance of the mean displacement, exact up to the accuracy of the solver.
    """

    mean: Float64Array
    covariance: Float64Array

    @property
    def sd(self) -> Float64Array:
        """Standard deviation along each axis, shape (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def __repr__(self) -> str:
        parts = (f"{d:.3g} +- {sd:.2g}" for d, sd in zip(self.mean, self.sd, strict=True))
        return f"MeanDisplacement({', '.join(parts)})"


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of the displacement of patches of tissue.

    Attributes
    ----------
    solution : Solution
        Most likely field, the mean of the posterior.
    sd : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Standard deviation of the mean displacement of the patch around each site, along each axis,
        in the unit of `spacing`; 0 in void. The relative standard error is ``1 / sqrt(2 n)``.
    along : ndarray, shape (H, W) or (D, H, W), float32
        Standard deviation along the mean displacement of the patch: the error bar of its length. At
        patches that do not move, the largest standard deviation of a component.
    patch : float
        Side of a patch, in the unit of `spacing`.
    n : int
        Number of samples.
    labels : mapping from int to MeanDisplacement
        Mean displacement of each label; empty if no labels were passed.
    """

    solution: Solution
    sd: Float32Array
    along: Float32Array
    patch: float
    n: int
    labels: Mapping[int, MeanDisplacement]

    def __repr__(self) -> str:
        most = float(self.sd.max(initial=0.0))
        return f"Uncertainty(patches of {self.patch:.3g}, {self.n} samples, sd up to {most:.3g})"


def uncertainty(
    problem: Problem,
    prior: Prior | None = None,
    n: int = 30,
    *,
    patch: float | None = None,
    labels: npt.ArrayLike | None = None,
    scale: StrainScale | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Uncertainty:
    """Estimate how sure the displacement of the tissue is.

    Standard deviations are those of means over patches, square in an image and cubic in a volume,
    and are estimated from samples of the posterior (see `sample_posterior`). The displacement of a
    single point in a volume has no finite variance in the limit of small voxels. Those of means
    over labels are computed without samples, with one solve for each label and axis.

    Parameters
    ----------
    problem, prior, scale, seed, backend, progress, cancel
        As for `sample_posterior`.
    n : int
        Number of samples, 2 or more. With 30 samples, a standard deviation is accurate to 13 %.
    patch : float, optional
        Side of a patch, in the unit of `spacing`; by default 5 % of the longest side of the image.
        The number of pixels along an axis is odd. Only the tissue in a patch counts.
    labels : array_like of int, shape (H, W) or (D, H, W), optional
        Labels whose mean displacements are returned; 0 is no label.

    Returns
    -------
    Uncertainty

    Raises
    ------
    ArgumentError, ProblemError, Cancelled
        As for `sample_posterior`, or if `labels` has another shape than the tissue.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_hmrf import Problem
    >>> from napari_hmrf.posterior import uncertainty
    >>> held = np.zeros((40, 40, 2))
    >>> held[:, 0] = 1
    >>> result = uncertainty(Problem(np.zeros_like(held), held, np.ones((40, 40))))
    >>> bool(result.sd[20, 2, 0] < result.sd[20, 39, 0])  # held tissue is certain
    True
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    refuse_unless(is_whole(n) and n >= 2, "n", n, "a number of samples, 2 or more")
    refuse_unless(is_whole(seed) and seed >= 0, "seed", seed, "a whole number, 0 or more")
    longest = max(size * step for size, step in zip(problem.shape, problem.spacing, strict=True))
    side = _PATCH * longest if patch is None else real(patch)
    refuse_unless(0 < side < math.inf, "patch", patch, "a positive length, or None")
    numbers = None if labels is None else checked_labels(labels, problem)
    elastic, energy = checked_prior(problem, prior), energy_of(problem, scale)
    report = progress or (lambda _: None)
    solution = solve(problem, elastic, backend=backend, cancel=cancel)
    response = Response(problem, elastic, backend, cancel)
    noise = PosteriorNoise(problem, elastic, energy)
    sampler = Sampler(response, noise, seed)
    patches = _Patches(problem, side)
    means = patches.means(solution.displacement)
    lengths = np.sqrt((means**2).sum(axis=-1, keepdims=True))
    ways = np.divide(means, lengths, out=np.zeros_like(means), where=lengths > 0)
    squares = np.zeros_like(means)
    squares_along = np.zeros(problem.shape, np.float32)
    for number in range(n):
        report(Monitor(f"sample {number + 1} of {n}", number / n))
        moved = patches.means(sampler.deviation(number))
        squares += moved**2
        squares_along += (moved * ways).sum(axis=-1) ** 2
    # The mean of the deviations is 0, and need not be estimated.
    sd = np.sqrt(squares / n)
    along = np.where(lengths[..., 0] > 0, np.sqrt(squares_along / n), sd.max(axis=-1))
    found = {} if numbers is None else _label_means(numbers, solution, response, energy)
    report(Monitor(f"{n} samples", 1.0))
    return Uncertainty(solution, sd, along, side, n, found)


def checked_labels(labels: npt.ArrayLike, problem: Problem) -> npt.NDArray[Any]:
    """Return labels as whole numbers, and check that they match a problem."""
    numbers = whole_numbers("labels", labels)
    if numbers.shape != problem.shape:
        raise ProblemError(
            "labels",
            f"has shape {numbers.shape}, but stiffness has shape {problem.shape}. Use the same "
            "pixel grid for both.",
        )
    return numbers


class _Patches:
    """Means over the tissue in a box around each site."""

    def __init__(self, problem: Problem, side: float) -> None:
        self._tissue = problem.tissue
        # The number of sites is odd, so that the box is centred.
        self._sizes = [1 + 2 * max(0, math.floor(side / step / 2)) for step in problem.spacing]
        self._share = self._smooth(problem.tissue.astype(np.float32))

    def _smooth(self, values: npt.NDArray[Any]) -> Float32Array:
        smooth = scipy.ndimage.uniform_filter(values, self._sizes, np.float32, mode="constant")
        return np.asarray(smooth)

    def means(self, field: npt.NDArray[Any]) -> Float32Array:
        """Return the mean of a field, (..., n), over the tissue around each site; 0 in void."""
        means = np.zeros(field.shape, np.float32)
        for axis in range(field.shape[-1]):
            values = np.where(self._tissue, field[..., axis], 0).astype(np.float32)
            np.divide(self._smooth(values), self._share, out=means[..., axis], where=self._tissue)
        return means


def _label_means(
    labels: npt.NDArray[Any], solution: Solution, response: Response, energy: float
) -> dict[int, MeanDisplacement]:
    """Return the mean displacement of each label, with its covariance."""
    found = {}
    for number in np.unique(labels[(labels != 0) & solution.tissue]):
        sites = (labels == number) & solution.tissue
        axes = solution.displacement.shape[-1]
        share = sites / np.float64(sites.sum())
        covariance = np.zeros((axes, axes))
        for axis in range(axes):
            force = np.zeros(solution.displacement.shape)
            force[..., axis] = share
            # The response to a force on the mean is the inverse of the matrix times its weights.
            moved = response.moved_by(force)
            covariance[axis] = energy * (moved * share[..., None]).sum(
                axis=tuple(range(axes)), dtype=np.float64
            )
        mean = solution.displacement[sites].mean(axis=0, dtype=np.float64)
        found[int(number)] = MeanDisplacement(mean, (covariance + covariance.T) / 2)
    return found
