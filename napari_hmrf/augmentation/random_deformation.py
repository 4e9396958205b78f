"""Random deformations of a case, computed as sums of unit solutions.

Linear elasticity allows superposition: the displacement due to two pulls is the sum of the
displacements due to each pull. Therefore one unit solution is computed for each cause of motion,
and each random field is a random linear combination of the unit solutions, which is as accurate as
a solve.
A combination that would compress tissue too much is scaled down, so tissue does not fold.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from napari_hmrf.archive import Archive
from napari_hmrf.arguments import real, reals, refuse_unless, tuple_of
from napari_hmrf.augmentation.fold_limit import largest_scale
from napari_hmrf.augmentation.unit_solutions import (
    WRONG,
    Array,
    Causes,
    MovableTissue,
    UnitSolutions,
    control_patches,
    solve_units,
)
from napari_hmrf.checks import Count, NotNegative, Positive, Words, convert
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ArgumentError, ProblemError
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.moved_points import moved_points, refuse_outside
from napari_hmrf.field.resample import as_image, emptiness
from napari_hmrf.real_arrays import as_numbers, checked_spacing, whole_numbers
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.optimizers.base import Convergence
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.solution import SUM, Provenance, Solution
from napari_hmrf.study.study import Grid, Study
from napari_hmrf.tissue.boundary_rules import (
    Material,
    poisson_image,
    sliding_parts,
    stiffness_image,
)
from napari_hmrf.tissue.painted_loads import growth_loads
from napari_hmrf.tissue.usual_lengths import usual_radius

#: Argument of `numpy.random.default_rng`: a seed, or a generator, which is advanced.
Seed = int | Sequence[int] | np.random.Generator | None
_Jacobian = Annotated[float, Field(gt=0, lt=1), Words("a number above 0 and below 1")]

# Default number of control patches in an image (two unit solutions per patch) and in a volume
# (three unit solutions per patch).
_PATCHES = {2: 12, 3: 8}
# Default largest pull, as a fraction of the mean distance between neighbouring patches.
_REACH = {2: 1 / 4, 3: 1 / 8}
_MOVING = "pictures to deform"
_log = logging.getLogger("napari_hmrf")
#: Kind of the files that `RandomDeformation.write` writes.
_DEFORMATIONS = Archive("napari-hmrf random deformation", UnitSolutions)


@dataclass(frozen=True, eq=False)
class RandomSample:
    """Random deformation of a case.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Material displacement in the order of the axes, in the unit of `spacing`: the tissue at X
        moves to X + d(X). 0 outside tissue.
    tissue : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue that moves.
    spacing : tuple of float
        Size of a pixel along each axis.
    causes : Causes
        Pulls, growth and weight that cause the motion, already multiplied by `scale`.
    scale : float
        Factor, at most 1, by which the drawn deformation was multiplied to limit the
        compression of tissue.
    case : MovableTissue
        Tissue that was deformed.
    """

    displacement: npt.NDArray[np.float32]
    tissue: npt.NDArray[np.bool_]
    spacing: tuple[float, ...]
    causes: Causes
    scale: float
    case: MovableTissue

    def __repr__(self) -> str:
        farthest = float(np.linalg.norm(self.displacement, axis=-1).max(initial=0.0))
        return f"RandomSample(moved up to {farthest:.3g}, scale {self.scale:.3g})"

    @property
    def amplitude(self) -> float:
        """Largest pull of a control patch after scaling, in the unit of `spacing`."""
        return float(np.linalg.norm(self.causes.pulls, axis=1).max())

    @cached_property
    def study(self) -> Study:
        """Study that has this displacement as its solution, for `solve_study` and `write_study`."""
        return self.case.study(self.causes)

    @cached_property
    def solution(self) -> Solution:
        """Displacement as a `Solution`, for its methods and for `write_study`."""
        study, labels = self.study, self.case.labels
        rows, grown = study.tissue.materials, growth_loads(labels, study.tissue.materials)
        elasticity = Elasticity(
            stiffness_image(labels, rows),
            ElasticPrior(poisson_image(labels, rows)).poisson,
            growth=None if grown is None else grown.growth,
        )
        return Solution(
            displacement=self.displacement,
            energy=np.zeros(1),
            levels=(),
            tissue=self.tissue,
            spacing=self.spacing,
            provenance=Provenance(
                backend=SUM,
                renderer="a sum of unit solutions",
                parameters={
                    "prior": study.prior.parameters,
                    "optimizer": study.optimizer.parameters,
                },
            ),
            convergence=Convergence(WRONG, 0.0),
            elasticity=elasticity,
            unit=study.grid.unit,
        )

    def pictures(self, *pictures: Picture) -> list[npt.NDArray[Any]]:
        """Warp several pictures together, which is faster than separate calls.

        Parameters
        ----------
        *pictures : Picture

        Returns
        -------
        list of ndarray
            Warped images, each with the shape and dtype of its picture.

        Raises
        ------
        ProblemError
            If a picture is not on the grid of the labels.
        """
        images = [as_image(each.image, self.tissue.shape) for each in pictures]
        # Pixels outside the box do not move, but splines of order 2 or more need the whole image.
        smooth = any(each.order > 1 for each in pictures)
        box = (slice(None),) * self.tissue.ndim if smooth else self._box
        parts = [
            replace(each, image=image[box]) for each, image in zip(pictures, images, strict=True)
        ]

        def moved() -> list[npt.NDArray[Any]]:
            return Warper(parts, spacing=self.spacing)(self.displacement[box], self.tissue[box])

        whole = []
        for image, part in zip(images, compute_thread.result_of(moved, _MOVING), strict=True):
            whole.append(image.copy())
            whole[-1][box] = part
        return whole

    @cached_property
    def _box(self) -> tuple[slice, ...]:
        """Bounding box of the tissue before and after the motion, with a margin of one pixel."""
        sides, n = [], self.tissue.ndim
        for axis in range(n):
            others = tuple({*range(n)} - {axis})
            rows = np.flatnonzero(self.tissue.any(axis=others))
            along = self.displacement[..., axis] / self.spacing[axis]
            first = min(0.0, float((rows + along.min(axis=others)[rows]).min()) - rows[0])
            last = max(0.0, float((rows + along.max(axis=others)[rows]).max()) - rows[-1])
            begin = int(rows[0]) + math.floor(first) - 1
            sides.append(slice(max(0, begin), int(rows[-1]) + math.ceil(last) + 2))
        return tuple(sides)

    def image(self, image: npt.ArrayLike, *, order: int = 1) -> npt.NDArray[Any]:
        """Warp an image with the tissue.

        Parameters
        ----------
        image : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
        order : int
            Order of interpolation, as for `warp`.

        Returns
        -------
        ndarray, shape and dtype of the image
            Warped image. Pixels that tissue has left are black in colour images; in other images,
            they have the lowest value of the image, which is air in CT.
        """
        pixels = as_numbers("image", image)
        fill = emptiness(pixels, self.tissue.ndim)
        return self.pictures(Picture(pixels, order=order, fill=fill))[0]

    def labels(self, labels: npt.ArrayLike, *, fill: int = 0) -> npt.NDArray[Any]:
        """Warp a label image, shape ([D,] H, W); pixels that tissue has left become `fill`."""
        pixels = whole_numbers("labels", labels)
        return self.pictures(Picture(pixels, order=0, fill=fill))[0]

    def points(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Move points with the tissue: shape (N, n), in pixels, in the order of the axes."""
        refuse_outside(points, self.tissue.shape)
        return moved_points(points, self.displacement, spacing=self.spacing)


class RandomDeformation:
    """Generator of random deformations of the tissue in a label image.

    The constructor computes all unit solutions: two for each patch (three in a volume), one for
    each tissue that grows, and one for the weight along each axis. After that, each sample is only
    a weighted sum.

    Parameters
    ----------
    labels : array_like of int, shape (H, W) or (D, H, W)
        Label of the tissue at each pixel.
    materials : iterable of Material
        Materials for all values in `labels`, including 0. A stiffness of 0 means void. Rigid
        tissue moves as a rigid body. Tissue with growth grows by a random fraction of its growth.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a single number applies to all axes.
    unit : str
        Unit of all lengths.
    amplitude : float or (float, float), optional
        Largest pull of a control patch, in the unit of `spacing`: one length for all samples, or
        bounds (low, high) of a uniform distribution. The default is (0, r), where r is the mean
        distance between neighbouring patches, divided by 4 in an image and by 8 in a volume. A
        sample that would compress tissue too much is scaled down. `RandomSample.amplitude` is the
        actual largest pull; if it is below the lower bound, a warning is logged.
    patches : int, optional
        Maximum number of control patches; fewer are used if the tissue does not have enough room.
        The default is 12 in an image and 8 in a volume.
    radius : float, optional
        Radius of a control patch, in the unit of `spacing`. The default is 1/32 of the shortest
        side in an image and 1/16 in a volume.
    smoothness : float, optional
        Correlation length of the pulls of patches, in the unit of `spacing`. The default is the
        mean distance between neighbouring patches.
    weight : float
        Largest body force, in a random direction, in the unit of stiffness per length. The force
        models the weight of the tissue in other postures. 0 means no body force.
    hold_edge : bool
        If True, the outer edge of the tissue is fixed.
    least_jacobian : float
        Smallest allowed ratio of the deformed to the original area or volume, at every corner of
        every pixel. It is above 0, so tissue does not fold.
    memory : float, optional
        Maximum memory of the unit solutions, in bytes. The default is half of the free memory.
    backend : str
        As for `solve`.
    progress : callable, optional
        Function called after each solve with the number of finished solves and the total.

    Raises
    ------
    ArgumentError
        If an argument has the wrong type or is out of range.
    ProblemError
        If the labels and materials do not define a valid problem, if tissue slides along other
        tissue, if the tissue does not have room for a patch, or if the unit solutions require more
        than `memory`.
    ConvergenceError, BackendError
        As for `solve`.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_hmrf import Material
    >>> from napari_hmrf.random import RandomDeformation
    >>> labels = np.ones((48, 48), int)
    >>> labels[20:28, 20:28] = 2
    >>> materials = [Material(1, "muscle", 10.0), Material(2, "bone", float("inf"))]
    >>> deformation = RandomDeformation(labels, materials, spacing=1, amplitude=2, patches=4)
    >>> sample = deformation.sample(seed=1)
    >>> sample.displacement.shape, sample.labels(labels).shape
    ((48, 48, 2), (48, 48))
    """

    def __init__(
        self,
        labels: npt.ArrayLike,
        materials: Iterable[Material],
        *,
        spacing: float | Sequence[float],
        unit: str = "pixel",
        amplitude: float | tuple[float, float] | None = None,
        patches: int | None = None,
        radius: float | None = None,
        smoothness: float | None = None,
        weight: float = 0.0,
        hold_edge: bool = True,
        least_jacobian: float = 0.2,
        memory: float | None = None,
        backend: str = "auto",
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        image = whole_numbers("labels", labels).copy()
        given = tuple(materials) if isinstance(materials, Iterable) else materials
        rows = tuple_of(Material, "materials", given, '(Material(1, "brain", 3.0),)')
        m = stiffness_image(image, rows)  # validates the labels and materials
        if sliding_parts(image, rows, m) is not None:
            raise ProblemError(
                "materials",
                "have tissue that slides along other tissue, which random deformations do not "
                "support. Let no tissue slide (`slides=False`).",
            )
        n = image.ndim
        sizes = checked_spacing(spacing, n)
        radius = convert(Positive | None, radius, "radius")
        smoothness = convert(Positive | None, smoothness, "smoothness")
        memory = convert(Positive | None, memory, "memory")
        count = convert(Count, _PATCHES[n] if patches is None else patches, "patches")
        usual = usual_radius(image.shape, sizes)
        # A pulled ball compresses the surrounding tissue more than a disc of the same radius, and a
        # larger radius reduces the compression. Therefore patches are larger in volumes.
        size = usual * (n - 1) / 2 if radius is None else radius
        where, centres = control_patches(
            image, rows, sizes, count=count, radius=size, hold_edge=hold_edge
        )
        apart = _distance_to_next(centres, 4 * usual)
        case = MovableTissue(
            Grid(image.shape, sizes, unit),
            image,
            rows,
            hold_edge,
            where,
            centres,
            _range(amplitude, _REACH[n] * apart),
            apart if smoothness is None else smoothness,
            convert(NotNegative, weight, "weight"),
            convert(_Jacobian, least_jacobian, "least_jacobian"),
        )
        self._set_solutions(solve_units(case, backend=backend, memory=memory, progress=progress))

    def _set_solutions(self, solutions: UnitSolutions) -> None:
        """Set the unit solutions of all samples."""
        self._solutions, self._case, self._has_warned = solutions, solutions.case, False
        self._factor = _factor(self._case.centres, self._case.smoothness)

    @property
    def tissue(self) -> npt.NDArray[np.bool_]:
        """Mask of the tissue that moves, ([D,] H, W)."""
        return self._solutions.tissue

    @property
    def nbytes(self) -> int:
        """Memory of the unit solutions, in bytes."""
        return self._solutions.displacements.nbytes

    @property
    def amplitude(self) -> tuple[float, float]:
        """Bounds, (low, high), of the largest pull of a sample."""
        return self._case.amplitude

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the unit solutions and their case to an .npz file, atomically.

        Parameters
        ----------
        path : str or path-like
            Path of the file; ".npz" is appended if the name has no suffix.

        Returns
        -------
        Path
            Path of the written file.

        Raises
        ------
        OSError
            If the file cannot be written; the message names the file.
        """
        return _DEFORMATIONS.write(path, self._solutions)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> RandomDeformation:
        """Read a file that `write` has written, without solving again.

        The same seed yields bit-identical samples before writing and after reading.

        Parameters
        ----------
        path : str or path-like
            Path of the file.

        Returns
        -------
        RandomDeformation

        Raises
        ------
        FileFormatError
            If the file is damaged or has another format.
        OSError
            If the file cannot be opened.
        """
        deformation = cls.__new__(cls)
        deformation._set_solutions(_DEFORMATIONS.read(path))
        return deformation

    def __repr__(self) -> str:
        case, (low, high) = self._case, self.amplitude
        return (
            f"RandomDeformation({' x '.join(map(str, case.grid.shape))} sites, "
            f"{len(case.centres)} patches pulled from {low:.3g} to {high:.3g}, "
            f"{len(case.growing)} tissues that grow, {self.nbytes / 2**20:.3g} MiB)"
        )

    def sample(self, seed: Seed = None) -> RandomSample:
        """Draw a deformation.

        Parameters
        ----------
        seed : int, sequence of int or numpy.random.Generator, optional
            Seed of the random numbers: the same seed yields a bit-identical displacement for the
            same unit solutions. A generator is advanced. The default is an unpredictable seed.

        Returns
        -------
        RandomSample

        Raises
        ------
        ArgumentError
            If the seed is invalid.
        """
        drawn = self._draw(_generator(seed))
        displacement, case = self._solutions.field(drawn), self._case
        scale = largest_scale(displacement, case.grid.spacing, self.tissue, case.least_jacobian)
        if scale < 1:
            displacement *= np.float32(scale)
        sample = RandomSample(
            displacement, self.tissue, case.grid.spacing, drawn * scale, scale, case
        )
        self._warn_if_small(sample)
        return sample

    def _warn_if_small(self, sample: RandomSample) -> None:
        """Log a warning, only once, if the amplitude of a sample is below the lower bound."""
        least = self.amplitude[0]
        if self._has_warned or sample.amplitude >= least * (1 - 1e-6):
            return
        self._has_warned = True
        _log.warning(
            "the smallest amplitude is %.3g, but a sample has only %.3g: a larger pull would "
            "compress tissue to less than %.3g of its size (`least_jacobian`). Use a smaller "
            "amplitude or fewer patches (`amplitude, patches`). This warning is logged once.",
            least,
            sample.amplitude,
            self._case.least_jacobian,
        )

    def _draw(self, random: np.random.Generator) -> Causes:
        """Return random pulls, growth and weight for one sample."""
        case, n = self._case, len(self._case.grid.shape)
        pulls = self._factor @ random.standard_normal(case.centres.shape)
        pulls *= random.uniform(*self.amplitude) / np.linalg.norm(pulls, axis=1).max()
        growth = random.uniform(size=len(case.growing))
        way = random.standard_normal(n)
        weight = case.weight * random.uniform() * way / np.linalg.norm(way)
        return Causes(pulls, growth, weight)


def _generator(seed: Seed) -> np.random.Generator:
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"seed must be a non-negative whole number or a Generator, not {seed!r}"
        ) from error


def _range(amplitude: Any, usual: float) -> tuple[float, float]:
    """Return the bounds of the largest pull."""
    if amplitude is None:
        return 0.0, usual
    given = reals(amplitude, 2) if np.ndim(amplitude) else (real(amplitude),) * 2
    low, high = given[0], given[-1]
    right = 0 <= low <= high < math.inf and high > 0
    refuse_unless(right, "amplitude", amplitude, "a length above 0, or two lengths, (low, high)")
    return low, high


def _distance_to_next(centres: Array, alone: float) -> float:
    """Return the mean distance between nearest patches, or `alone` for a single patch."""
    if len(centres) == 1:
        return alone
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(apart.min(axis=1).mean())


def _factor(centres: Array, smoothness: float) -> Array:
    """Return the Cholesky factor of the covariance of the pulls of patches.

    The product of this factor and independent normal numbers has the correlation length
    `smoothness`.
    """
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    covariance = np.exp(-0.5 * (distances / smoothness) ** 2)
    # Without the diagonal term, fully correlated patches would make the matrix singular.
    factor: Array = np.linalg.cholesky(covariance + 1e-6 * np.eye(len(centres)))
    return factor
