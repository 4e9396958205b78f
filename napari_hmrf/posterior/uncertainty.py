"""Standard deviations of displacements: means over patches, and means over labels."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.checks import Positive, Samples, Seed, Words, convert
from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.image_errors import PATCH, image_errors
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.sampling import Sampler, checked_prior, energy_of
from napari_hmrf.posterior.tissue_box import TissueBox
from napari_hmrf.real_arrays import as_numbers, whole_numbers
from napari_hmrf.solver.operator import Operator
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments
from napari_hmrf.solver.uncertain_landmarks import StrainScale

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

_Count = Annotated[
    Literal[0] | Samples, Words("a whole number of at least 2, or 0 for labels only")
]
#: Side of a patch by default, relative to the longest side of the image.
_PATCH = 0.05
# Number of samples if only the error bars of labels are required.
_FOR_LABELS = 10


@dataclass(frozen=True, eq=False)
class MeanDisplacement:
    """Mean displacement of the tissue of a label.

    Attributes
    ----------
    mean : ndarray, shape (n,)
        Mean displacement along each axis, in the unit of `spacing`.
    covariance : ndarray, shape (n, n)
        Covariance of the mean displacement, exact up to the accuracy of the solver.
    length : float
        Mean length of the displacement, in the unit of `spacing`. It is longer than `mean` if parts
        of the tissue move in different directions, as in a tumour that grows.
    along : float
        Standard deviation of the mean displacement along the motion, whose direction is that of the
        most likely displacement of each site: the error bar of `length`. It does not include that
        the tissue may also move sideways, which makes the true length larger if the displacement is
        not much longer than its error bar. For tissue that does not move, the largest standard
        deviation of a component.
    """

    mean: Float64Array
    covariance: Float64Array
    length: float
    along: float

    @property
    def sd(self) -> Float64Array:
        """Standard deviation along each axis, shape (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def __repr__(self) -> str:
        parts = (f"{d:.3g} +- {sd:.2g}" for d, sd in zip(self.mean, self.sd, strict=True))
        length = f"length {self.length:.3g} +- {self.along:.2g}"
        return f"MeanDisplacement({', '.join(parts)}, {length})"


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations of the displacement of patches of tissue.

    Attributes
    ----------
    solution : Solution
        Most likely field, the mean of the posterior.
    sd : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Standard deviation of the mean displacement of the patch around each site, along each axis,
        in the unit of `spacing`; 0 in void. The relative standard error is ``1 / sqrt(2 n)``. NaN
        in tissue if `n` is 0.
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
        if not self.n:
            return f"Uncertainty({len(self.labels)} labels, no samples)"
        most = float(self.sd.max(initial=0.0))
        return f"Uncertainty(patches of {self.patch:.3g}, {self.n} samples, sd up to {most:.3g})"

    def at(self, points: npt.ArrayLike) -> Float64Array:
        """Return the standard deviation of the displacement of the patches around points.

        Parameters
        ----------
        points : array_like, shape (N, n)
            Positions before the motion, in pixels, in the order of the axes. The value is that of
            the nearest site of the grid.

        Returns
        -------
        ndarray, shape (N, n), float64
            Standard deviations along each axis, in the unit of `spacing`; NaN for points in void.

        Raises
        ------
        ProblemError
            If the points have another number of axes, or if there are no samples.
        """
        self.require_samples()
        tissue = self.solution.tissue
        places = np.array(as_numbers("points", points), np.float64)
        if places.ndim != 2 or places.shape[1] != tissue.ndim or not np.isfinite(places).all():
            raise ProblemError(
                "points",
                f"has shape {places.shape} or infinite values. Pass finite positions of shape "
                f"(N, {tissue.ndim}).",
            )
        last = np.array(tissue.shape) - 1
        sites = tuple(np.rint(np.clip(places, 0, last)).astype(np.intp).T)
        return np.where(tissue[sites][:, None], self.sd[sites].astype(np.float64), np.nan)

    def least_sure(self, where: npt.ArrayLike | None = None) -> tuple[int, ...]:
        """Return the site with the longest error bar, where one more landmark helps most.

        The information that a measurement of a patch gives about the whole displacement increases
        with the variance of this patch.

        Parameters
        ----------
        where : array_like of bool, shape (H, W) or (D, H, W), optional
            Sites that count, such as the visible surface of an organ; by default all tissue.

        Returns
        -------
        tuple of int
            Index of the site, at which `along` is largest.

        Raises
        ------
        ProblemError
            If there are no samples, or `where` contains no tissue or has another shape.
        """
        self.require_samples()
        sites = self.solution.tissue
        if where is not None:
            mask = np.asarray(as_numbers("where", where)) != 0
            if mask.shape != sites.shape:
                raise ProblemError(
                    "where",
                    f"has shape {mask.shape}, but the tissue has shape {sites.shape}. Use the same "
                    "pixel grid for both.",
                )
            sites = sites & mask
        if not sites.any():
            raise ProblemError("where", "contains no tissue. Mark the sites that can be measured.")
        longest = int(np.where(sites, self.along, -1).argmax())
        return tuple(int(index) for index in np.unravel_index(longest, sites.shape))

    def require_samples(self) -> None:
        """Raise an error if the standard deviations were not sampled.

        Raises
        ------
        ProblemError
            If there are no samples.
        """
        if not self.n:
            raise ProblemError(
                "n", "is 0, so the standard deviations of patches are unknown. Pass 2 or more."
            )


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
    over labels are computed without samples, from a few solves for each label and axis.

    Parameters
    ----------
    problem, scale, seed, backend, progress, cancel
        As for `sample_posterior`.
    prior : ElasticPrior, optional
        Prior of the tissue; its posterior must be a normal distribution.
    n : int
        Number of samples, 2 or more. With 30 samples, a standard deviation is accurate to 13 %. 0
        computes only the means over labels: `sd` and `along` are then NaN in tissue.
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
    >>> tissue = np.ones((40, 40))
    >>> result = uncertainty(Problem(observed=0 * held, confidence=held, stiffness=tissue))
    >>> bool(result.sd[20, 2, 0] < result.sd[20, 39, 0])  # held tissue is certain
    True
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    n, seed = convert(_Count, n, "n"), convert(Seed, seed, "seed")
    longest = max(size * step for size, step in zip(problem.shape, problem.spacing, strict=True))
    side = convert(Positive, _PATCH * longest if patch is None else patch, "patch")
    numbers = None if labels is None else checked_labels(labels, problem)
    elastic, energy = checked_prior(problem, prior), energy_of(problem, scale)
    box = TissueBox.of(problem, elastic)
    solution = box.solve(backend, cancel)
    moved = solution.displacement[box.sites]
    operator = Operator(box.problem, box.prior, backend)
    means = _LabelMeans(
        None if numbers is None else numbers[box.sites],
        moved,
        box.problem.tissue,
        partial(operator.solve, cancel=cancel),
        energy,
    )
    steps = max(1, n + len(means.labels))
    report = progress or (lambda _: None)
    if n:
        noise = PosteriorNoise(operator.problem, operator.prior, energy)
        sampler = Sampler(operator, noise, seed, cancel)
        sd, along = map(
            box.whole,
            _of_patches(
                _Patches.of_side(box.problem, side),
                moved,
                sampler,
                n,
                lambda number: report(Monitor(f"sample {number + 1} of {n}", number / steps)),
            ),
        )
    else:
        along = np.where(problem.tissue, np.float32(np.nan), np.float32(0))
        sd = np.repeat(along[..., None], along.ndim, axis=-1)
    found = {}
    for done, label in enumerate(means.labels):
        report(Monitor(f"label {done + 1} of {len(means.labels)}", (n + done) / steps))
        found[label] = means.of(label)
    report(Monitor(f"{n} samples" if n else f"{len(found)} labels", 1.0))
    return Uncertainty(solution, sd, along, side, n, found)


def image_uncertainty(
    problem: Problem,
    prior: Prior | None = None,
    n: int = 30,
    *,
    labels: npt.ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Uncertainty:
    """Estimate how sure a displacement is that images observe, as after a registration.

    Where the images show nothing, the error bars are longer. Held-out images determine their scale
    (`image_errors`), which is known for patches of seven pixels. Errors are alike over larger
    distances: the error bar of a label is the mean of those of its patches, and rather too long.

    Parameters
    ----------
    problem : Problem
        Tissue with the precision of images (`Registration.problem`).
    prior, labels, seed, backend, progress, cancel
        As for `uncertainty`.
    n : int
        Number of samples. 0 stands for 10, which suffice for labels.

    Returns
    -------
    Uncertainty

    Raises
    ------
    ArgumentError, ProblemError, Cancelled
        As for `uncertainty`, or if the images show too little tissue.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import ndimage
    >>> from napari_hmrf.posterior import image_uncertainty
    >>> from napari_hmrf.registration import register
    >>> before = ndimage.gaussian_filter(np.random.default_rng(0).random((64, 64)), 2)
    >>> found = register(before, np.roll(before, 2, axis=1), spacing=1)
    >>> bars = image_uncertainty(found.problem, found.prior)
    >>> bars.along.shape
    (64, 64)
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    n, seed = convert(_Count, n, "n") or _FOR_LABELS, convert(Seed, seed, "seed")
    numbers = None if labels is None else checked_labels(labels, problem)
    if problem.precision is None:
        raise ProblemError("precision", "is missing. Pass the problem of a registration.")
    box = TissueBox.of(problem, checked_prior(problem, prior))
    report = progress or (lambda _: None)
    report(Monitor("prediction of held-out images", 0.0))
    solution = box.solve(backend, cancel)
    errors = image_errors(box.problem, box.prior, backend=backend, cancel=cancel)
    operator = Operator(errors.problem, box.prior, backend)
    energy = energy_of(errors.problem, errors.scale)
    sampler = Sampler(operator, PosteriorNoise(operator.problem, box.prior, energy), seed, cancel)
    sd, along = map(
        box.whole,
        _of_patches(
            _Patches(box.problem.tissue, [PATCH] * len(problem.shape)),
            solution.displacement[box.sites],
            sampler,
            n,
            lambda number: report(Monitor(f"sample {number + 1} of {n}", (number + 1) / (n + 1))),
        ),
    )
    found = {}
    for label in _present(numbers, problem.tissue):
        sites = (numbers == label) & problem.tissue
        own, covariance = solution.displacement[sites], np.diag(sd[sites].mean(axis=0) ** 2)
        mean, length = own.mean(axis=0, dtype=np.float64), np.linalg.norm(own, axis=-1).mean()
        found[label] = MeanDisplacement(mean, covariance, float(length), float(along[sites].mean()))
    report(Monitor(f"{n} samples", 1.0))
    return Uncertainty(solution, sd, along, PATCH * problem.unit, n, found)


def _present(numbers: npt.NDArray[Any] | None, tissue: npt.NDArray[np.bool_]) -> list[int]:
    """Return the labels with tissue, in ascending order; 0 is no label."""
    if numbers is None:
        return []
    return [int(number) for number in np.unique(numbers[(numbers != 0) & tissue])]


def _of_patches(
    patches: _Patches,
    displacement: npt.NDArray[Any],
    sampler: Sampler,
    n: int,
    report: Callable[[int], None],
) -> tuple[Float32Array, Float32Array]:
    """Return the standard deviations of patches, along each axis and along their motion.

    `report` is called with the number of each sample before the sample is computed.
    """
    means = patches.means(displacement)
    lengths = np.sqrt((means**2).sum(axis=-1, keepdims=True))
    ways = np.divide(means, lengths, out=np.zeros_like(means), where=lengths > 0)
    squares = np.zeros_like(means)
    squares_along = np.zeros(means.shape[:-1], np.float32)
    for number in range(n):
        report(number)
        moved = patches.means(sampler.deviation(number))
        squares += moved**2
        squares_along += (moved * ways).sum(axis=-1) ** 2
    # The mean of the deviations is 0, and need not be estimated.
    sd = np.sqrt(squares / n)
    along = np.where(lengths[..., 0] > 0, np.sqrt(squares_along / n), sd.max(axis=-1))
    return sd, along


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

    def __init__(self, tissue: npt.NDArray[np.bool_], sizes: Sequence[int]) -> None:
        self._tissue, self._sizes = tissue, sizes
        self._share = self._smooth(tissue.astype(np.float32))

    @classmethod
    def of_side(cls, problem: Problem, side: float) -> _Patches:
        """Return patches whose side is given in the unit of the spacing."""
        # The number of sites is odd, so that the box is centred. No box needs to be larger than one
        # that contains all sites from each of them.
        sizes = [
            1 + 2 * min(math.floor(side / step / 2), count - 1)
            for step, count in zip(problem.spacing, problem.shape, strict=True)
        ]
        return cls(problem.tissue, sizes)

    def _smooth(self, values: npt.NDArray[Any]) -> Float32Array:
        smooth = scipy.ndimage.uniform_filter(values, self._sizes, np.float32, mode="constant")
        return np.asarray(smooth)

    def means(self, field: npt.NDArray[Any]) -> Float32Array:
        """Return the mean of a field, (..., n), over the tissue around each site; 0 in void."""
        means = np.zeros(field.shape, np.float32)

        def smooth(axis: int) -> None:
            values = np.where(self._tissue, field[..., axis], np.float32(0))
            np.divide(self._smooth(values), self._share, out=means[..., axis], where=self._tissue)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(smooth, range(field.shape[-1])))
        return means


class _LabelMeans:
    """Mean displacements of labels, with their covariance.

    The response of the tissue to forces that are the weights of a mean is the inverse of the matrix
    times these weights.

    Parameters
    ----------
    numbers : ndarray of int, optional
        Label of each site; 0 is no label.
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Most likely displacement.
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
    response : callable
        Returns the displacement of the tissue due to forces.
    energy : float
        Unit of energy.
    """

    def __init__(
        self,
        numbers: npt.NDArray[Any] | None,
        displacement: npt.NDArray[Any],
        tissue: npt.NDArray[np.bool_],
        response: Callable[[Float64Array], npt.NDArray[np.floating]],
        energy: float,
    ) -> None:
        self._numbers = np.zeros(tissue.shape, int) if numbers is None else numbers
        self._displacement, self._tissue = displacement, tissue
        self._response, self._energy = response, energy
        #: Labels with tissue, in ascending order.
        self.labels = _present(numbers, tissue)

    def of(self, label: int) -> MeanDisplacement:
        """Return the mean displacement of a label."""
        d = self._displacement
        axes = d.shape[-1]
        sites = (self._numbers == label) & self._tissue
        share = sites / np.float64(sites.sum())
        covariance = np.zeros((axes, axes))
        for axis in range(axes):
            moved = self._response(share[..., None] * np.eye(axes)[axis])
            covariance[axis] = self._mean(moved * share[..., None])
        covariance = (covariance + covariance.T) / 2
        lengths = np.sqrt((d.astype(np.float64) ** 2).sum(axis=-1, keepdims=True))
        length = float(lengths[sites].mean())
        along = float(np.sqrt(np.diag(covariance).max()))
        if length:
            ways = np.divide(d, lengths, out=np.zeros(d.shape), where=lengths > 0)
            weights = ways * share[..., None]
            variance = float(self._mean(self._response(weights) * weights).sum())
            along = math.sqrt(max(0.0, variance))
        mean = d[sites].mean(axis=0, dtype=np.float64)
        return MeanDisplacement(mean, covariance, length, along)

    def _mean(self, products: Float64Array) -> Float64Array:
        """Return the sum over all sites, in the unit of a variance."""
        sites = tuple(range(products.ndim - 1))
        return np.asarray(self._energy * products.sum(axis=sites, dtype=np.float64))
