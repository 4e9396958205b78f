"""Rigid or affine alignment of two images, before tissue is deformed.

Turns and shifts are searched on large pixels (`turns`). SimpleITK refines the best of them, and
maps without a turn, by mutual information. The result is accepted only if it makes the images more
similar at sites that neither the search nor the refinement has used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import HmrfError
from napari_hmrf.extras import how_to_install
from napari_hmrf.registration.turns import Counted, best_turns

Kind = Literal["rigid", "affine"]
Float64Array = npt.NDArray[np.float64]
FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]

#: Number of pixels along the longest axis on which turns are searched, by number of axes.
_SEARCHED = {2: 64, 3: 24}
#: Number of turned starts that are refined, and smallest angle between them in degrees.
_STARTS, _APART = 4, 15.0
#: Number of brightness classes of the mutual information, on coarser levels and on the finest.
_CLASSES = 24, 32
#: Last length of a step on coarser levels and on the finest, in pixels of the level.
_LAST_STEPS = 1e-2, 1e-3
#: Largest number of sites that are compared, and seed of their choice.
_SITES, _SEED = 2**14, 1
#: Largest number of steps on each level, and their first length, in pixels of the level.
_ITERATIONS, _FIRST_STEP = 300, 0.5
#: Factor by which the step is shortened where the direction reverses.
_RELAXATION = 0.7
#: Number of blocks along the longest axis in which images are compared; 1 of `_EVERY` is held out.
_BLOCKS, _EVERY = 10, 3
#: Largest number of pixels on which blocks are compared.
_COMPARED = 2**17
#: Smallest part of a block that must count.
_LEAST_PART = 0.25
#: Contrast of a block that counts half, relative to the standard deviation of the image.
_WEAK = 0.02
#: Number of standard errors by which a similarity must rise.
_SURE = 3.0
#: Difference of two maps that does not matter, in pixels of the fixed image.
_SAME = 0.5
#: Factor between the pixels of two levels, and largest number of pixels of the finest.
_FINER, _FINEST = 4.0, 2**20
#: Width of the smoothing before pixels are left out, in larger pixels; weight of no pixel.
_SMOOTHED, _NOTHING = 0.5, 1e-3
_NOT_ALIGNED = (
    "the images were not aligned, because no {} alignment makes them clearly more similar: check "
    "that they show the same tissue, or give the matrix of an alignment"
)


class Alignment(NamedTuple):
    """Map from positions in the fixed image to positions in the moving image.

    Attributes
    ----------
    matrix : ndarray, shape (n + 1, n + 1)
        Homogeneous matrix, for coordinates in the unit of the spacing and in the order of the axes;
        the first pixel of each image is at the origin. The start if no other map was accepted.
    notes : tuple of str
        Note for the user if the images were not aligned.
    """

    matrix: Float64Array
    notes: tuple[str, ...]


def align(
    kind: Kind,
    fixed: FloatArray,
    moving: FloatArray,
    *,
    spacing: Sequence[float],
    moving_spacing: Sequence[float],
    masks: tuple[BoolArray, BoolArray],
    start: Float64Array | None = None,
) -> Alignment:
    """Return the map from positions in the fixed image to positions in the moving image.

    Finds turns by any angle, and shifts after which a quarter of the smaller image still overlaps.
    The images need not have the same contrast; mirror images are not searched. A turned map must be
    clearly better than one without a turn, and the result clearly better than the start; otherwise
    it is the start, with a note.

    Parameters
    ----------
    kind : {"rigid", "affine"}
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing, moving_spacing : sequence of float
        Size of a pixel of each image along each axis.
    masks : tuple of ndarray of bool
        Pixels of `fixed` and `moving` that count.
    start : ndarray, shape (n + 1, n + 1), optional
        Map before the alignment; by default the identity. It is returned unchanged where the result
        would differ by less than half a pixel.

    Returns
    -------
    Alignment

    Raises
    ------
    HmrfError
        If SimpleITK is not installed.
    """
    sitk: Any
    try:
        import SimpleITK as sitk  # optional: SimpleITK
    except ImportError:
        raise HmrfError(
            f"a {kind} alignment requires SimpleITK: {how_to_install('medical')}. Or pass the "
            "matrix of the alignment"
        ) from None
    pictures = (
        _Picture(fixed, masks[0].astype(np.float32), np.array(spacing, np.float64)),
        _Picture(moving, masks[1].astype(np.float32), np.array(moving_spacing, np.float64)),
    )
    start = np.eye(fixed.ndim + 1) if start is None else start
    found = _best(sitk, kind, *pictures, start)
    if _distance(found, start, pictures[0].extent) < _SAME * pictures[0].spacing.min():
        return Alignment(start, ())
    similar = _Similarity(*pictures)
    if _rises(similar.held_out(start), similar.held_out(found)):
        return Alignment(found, ())
    return Alignment(start, (_NOT_ALIGNED.format(kind),))


class _Picture(NamedTuple):
    """Image with the weights of its pixels, from 0 to 1, and the size of a pixel along each axis.

    Attributes
    ----------
    pixels, weights : ndarray, shape (H, W) or (D, H, W), float32
    spacing : ndarray, shape (n,)
    """

    pixels: FloatArray
    weights: FloatArray
    spacing: Float64Array

    @property
    def extent(self) -> Float64Array:
        """Size of the image along each axis, in the unit of the spacing."""
        return np.array(self.pixels.shape) * self.spacing

    def with_pixels(self, size: float, *, square: bool = False) -> _Picture:
        """Return the image with pixels of at least a size, or of exactly this size.

        Parameters
        ----------
        size : float
            Size of a pixel, in the unit of the spacing.
        square : bool
            True to enlarge images whose pixels are longer than the size.
        """
        spacing = np.full_like(self.spacing, size) if square else np.maximum(size, self.spacing)
        factor = spacing / self.spacing
        if np.allclose(factor, 1):
            return self
        shape = [
            int((n - 1) / each + 1e-6) + 1
            for n, each in zip(self.pixels.shape, factor, strict=True)
        ]
        widths = _SMOOTHED * np.sqrt(np.maximum(factor**2 - 1, 0))
        weights = scipy.ndimage.gaussian_filter(self.weights, widths)
        pixels = scipy.ndimage.gaussian_filter(self.pixels * self.weights, widths)
        pixels = np.divide(pixels, weights, out=np.zeros_like(pixels), where=weights > _NOTHING)
        pixels, weights = (
            scipy.ndimage.affine_transform(
                each, factor, output_shape=tuple(shape), order=1, mode="nearest"
            )
            for each in (pixels, weights)
        )
        return _Picture(pixels, weights, spacing)

    def blocks(self, size: float) -> npt.NDArray[np.intp]:
        """Return the index of the block of each pixel along each axis, shape (n, [D,] H, W)."""
        places: tuple[npt.NDArray[np.intp], ...] = np.indices(self.pixels.shape, sparse=True)
        along = [
            (at * step / size).astype(np.intp)
            for at, step in zip(places, self.spacing, strict=True)
        ]
        return np.stack(np.broadcast_arrays(*along))


def _is_held_out(blocks: npt.NDArray[np.intp]) -> BoolArray:
    """Return a mask of the blocks that neither search nor refinement may use."""
    return np.asarray(blocks.sum(axis=0) % _EVERY == 0)


def _best(
    sitk: Any, kind: Kind, fixed: _Picture, moving: _Picture, start: Float64Array
) -> Float64Array:
    """Return the best map by the sites that are not held out."""
    axes, block = fixed.pixels.ndim, _block(fixed)
    longest = fixed.extent.max()
    # The search in a moving image that is much larger must not take minutes.
    longest = max(longest, math.sqrt(longest * moving.extent.max()))
    coarse = max(longest / _SEARCHED[axes], fixed.spacing.min())

    def training(size: float, *, square: bool = False) -> tuple[_Picture, _Picture]:
        level = fixed.with_pixels(size, square=square)
        weights = np.where(_is_held_out(level.blocks(block)), np.float32(0), level.weights)
        return level._replace(weights=weights), moving.with_pixels(size, square=square)

    level = training(coarse, square=True)
    first, second = (Counted(each.pixels, each.weights) for each in level)
    starts = best_turns(first, second, _STARTS, _APART)
    straight, turned = (
        [_in_positions(each.matrix, coarse) for each in some]
        for some in ([starts.straight], starts.turned)
    )
    straight += [start, _centred(*level)]
    similar = _Similarity(fixed, moving)

    def best(maps: list[Float64Array]) -> Float64Array:
        refined = [_refined(sitk, kind, *level, each, 0) for each in maps]
        return max([*refined, *maps], key=lambda each: float(similar.trained(each).sum()))

    found, other = best(straight), best(turned)
    # Symmetric tissue is nearly as similar after half a turn.
    if _rises(similar.trained(found), similar.trained(other)):
        found = other
    *between, finest = _sizes(fixed, coarse)
    for size in between:
        found = _refined(sitk, kind, *training(size), found, 0)
    return _refined(sitk, kind, *training(finest), found, 1)


def _sizes(fixed: _Picture, coarse: float) -> list[float]:
    """Return the sizes of the pixels of the levels that are finer than the coarsest."""
    volume = float(fixed.extent.prod())
    finest = max(fixed.spacing.min(), (volume / _FINEST) ** (1 / fixed.pixels.ndim))
    sizes = []
    while (coarse := coarse / _FINER) > 1.5 * finest:
        sizes.append(coarse)
    return [*sizes, finest]


def _block(fixed: _Picture) -> float:
    return float(fixed.extent.max() / _BLOCKS)


def _centred(fixed: _Picture, moving: _Picture) -> Float64Array:
    """Return the map that moves the centre of mass of one image to that of the other."""
    matrix = np.eye(fixed.pixels.ndim + 1)
    centres = []
    for each in (fixed, moving):
        counted = each.weights > 0.5
        bright = np.where(counted, each.pixels - each.pixels[counted].min(initial=np.inf), 0)
        if not bright.any():  # the same brightness everywhere
            return matrix
        centres.append(np.array(scipy.ndimage.center_of_mass(bright)) * each.spacing)
    matrix[:-1, -1] = centres[1] - centres[0]
    return matrix


def _refined(
    sitk: Any, kind: Kind, fixed: _Picture, moving: _Picture, start: Float64Array, number: int
) -> Float64Array:
    """Return a map that is refined by mutual information; the start if this is not possible.

    Parameters
    ----------
    sitk : module
    kind : {"rigid", "affine"}
    fixed, moving : _Picture
    start : ndarray, shape (n + 1, n + 1)
        Map between positions.
    number : int
        0 for coarser levels, 1 for the finest.
    """
    axes = fixed.pixels.ndim
    images: list[Any] = []
    masks: list[Any] = []
    for each in (fixed, moving):
        counted = (each.weights > 0.5).astype(np.uint8)
        for made, pixels in ((images, each.pixels), (masks, counted)):
            image = sitk.GetImageFromArray(pixels)
            image.SetSpacing(each.spacing[::-1].tolist())
            made.append(image)
    # A small map before the start is refined, so that no angle of a turn is far from 0.
    if kind == "affine":
        small = sitk.AffineTransform(axes)
    else:
        small = sitk.Euler2DTransform() if axes == 2 else sitk.Euler3DTransform()
    small.SetCenter((fixed.extent / 2)[::-1].tolist())
    before = sitk.AffineTransform(axes)
    before.SetMatrix(start[:axes, :axes][::-1, ::-1].ravel().tolist())
    before.SetTranslation(start[:axes, axes][::-1].tolist())
    method = sitk.ImageRegistrationMethod()
    method.SetNumberOfWorkUnits(1)  # several threads add up the metric in any order
    method.SetMetricAsMattesMutualInformation(_CLASSES[number])
    share = _SITES / fixed.pixels.size
    if share < 1:
        method.SetMetricSamplingStrategy(method.REGULAR)
        method.SetMetricSamplingPercentage(share, _SEED)
    method.SetMetricFixedMask(masks[0])
    method.SetMetricMovingMask(masks[1])
    method.SetInterpolator(sitk.sitkLinear)
    size = float(fixed.spacing.min())
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=_FIRST_STEP * size,
        minStep=_LAST_STEPS[number] * size,
        numberOfIterations=_ITERATIONS,
        relaxationFactor=_RELAXATION,
        gradientMagnitudeTolerance=1e-8,
    )
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetMovingInitialTransform(before)
    method.SetInitialTransform(small, inPlace=True)
    try:
        method.Execute(*images)
    except RuntimeError:  # the images hardly overlap, or have no contrast
        return start
    found = np.asarray(start @ _matrix(small.TransformPoint, axes))
    return found if np.isfinite(found).all() else start


class _Similarity:
    """Squared correlation of two images in each block of the fixed image.

    The square does not depend on the sign of the contrast, which may differ between blocks.

    Parameters
    ----------
    fixed, moving : _Picture
    """

    def __init__(self, fixed: _Picture, moving: _Picture) -> None:
        size = (float(fixed.extent.prod()) / _COMPARED) ** (1 / fixed.pixels.ndim)
        self._fixed, self._moving = fixed.with_pixels(size), moving.with_pixels(size)
        self._counted = self._fixed.weights > 0.5
        self._known = (self._moving.weights > 0.5).astype(np.float32)
        blocks = self._fixed.blocks(_block(fixed))
        shape = tuple(int(each.max()) + 1 for each in blocks)
        self._block = np.ravel_multi_index(tuple(blocks), shape)
        self._count = math.prod(shape)
        sites = self._sums(self._counted)
        enough = sites > _LEAST_PART * np.bincount(self._block.ravel(), minlength=self._count)
        held = _is_held_out(np.indices(shape)).ravel()
        self._held, self._trained = enough & held, enough & ~held
        self._sites = np.maximum(sites, 1)

    def held_out(self, matrix: Float64Array) -> Float64Array:
        """Return the similarity of each block that is held out, from 0 to 1."""
        return self._of(matrix)[self._held]

    def trained(self, matrix: Float64Array) -> Float64Array:
        """Return the similarity of each other block, from 0 to 1."""
        return self._of(matrix)[self._trained]

    def _sums(self, values: npt.NDArray[Any]) -> Float64Array:
        values = values.ravel().astype(np.float64)
        return np.asarray(np.bincount(self._block.ravel(), values, self._count), np.float64)

    def _of(self, matrix: Float64Array) -> Float64Array:
        """Return the similarity of each block, where pixels outside of an image count 0."""
        axes = self._fixed.pixels.ndim
        sides = [each.spacing.tolist() for each in (self._fixed, self._moving)]
        pixels = matrix_in_pixels(matrix, *sides)
        moved, known = (
            scipy.ndimage.affine_transform(
                image,
                pixels[:axes, :axes],
                pixels[:axes, axes],
                output_shape=self._fixed.pixels.shape,
                order=1,
                mode=mode,
            )
            for image, mode in ((self._moving.pixels, "nearest"), (self._known, "constant"))
        )
        counted = self._counted & (known > 0.99)
        values = [np.where(counted, each, 0) for each in (self._fixed.pixels, moved)]
        sites = self._sums(counted)
        least = np.maximum(sites, 1)
        means = [self._sums(each) / least for each in values]
        apart = [
            np.where(counted, each - mean[self._block], 0)
            for each, mean in zip(values, means, strict=True)
        ]
        first, second = (
            self._sums(each**2) / least
            + np.float64(_WEAK**2) * (each**2).sum() / max(1, counted.sum())
            + np.finfo(np.float32).tiny
            for each in apart
        )
        common = self._sums(apart[0] * apart[1]) / least
        return np.asarray(common**2 / (first * second) * sites / self._sites)


def _rises(before: Float64Array, after: Float64Array) -> bool:
    """Return whether the similarity of blocks rises clearly.

    Parameters
    ----------
    before, after : ndarray, shape (N,)
        Similarity of the same blocks with two maps.
    """
    rise = after - before
    if len(rise) < 2:
        return False
    return float(rise.mean()) > _SURE * float(rise.std(ddof=1)) / math.sqrt(len(rise))


def _distance(first: Float64Array, second: Float64Array, extent: Float64Array) -> float:
    """Return the largest distance between the positions of a corner of an image by two maps."""
    sides = np.stack([np.zeros_like(extent), extent], axis=-1)
    corners = np.stack(np.meshgrid(*sides, [1.0], indexing="ij")).reshape(len(extent) + 1, -1)
    return float(np.linalg.norm((first - second) @ corners, axis=0).max())


def matrix_in_pixels(
    matrix: Float64Array, spacing: Sequence[float], moving_spacing: Sequence[float]
) -> Float64Array:
    """Return an alignment as a matrix from pixels of the fixed image to those of the moving image.

    Parameters
    ----------
    matrix : ndarray, shape (n + 1, n + 1)
        Matrix of an `Alignment`, in the unit of the spacing.
    spacing, moving_spacing : sequence of float
        Size of a pixel of each image along each axis.
    """
    before, after = np.array([*spacing, 1.0]), np.array([*moving_spacing, 1.0])
    return np.asarray(matrix * before / after[:, None])


def _in_positions(matrix: Float64Array, size: float) -> Float64Array:
    """Return the map between positions by one between square pixels of the same size."""
    scaled = matrix.copy()
    scaled[:-1, -1] *= size
    return scaled


def _matrix(transform: Callable[[tuple[float, ...]], Any], axes: int) -> Float64Array:
    """Return the matrix of an affine map of points (x, y[, z]), for points in axis order."""
    origin = np.array(transform((0.0,) * axes))
    columns = [np.array(transform(tuple(unit))) - origin for unit in np.eye(axes)]
    matrix = np.eye(axes + 1)
    matrix[:axes, :axes] = np.stack(columns, axis=1)[::-1, ::-1]
    matrix[:axes, axes] = origin[::-1]
    return matrix
