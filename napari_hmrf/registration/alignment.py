"""Rigid or affine alignment of two images with SimpleITK, before tissue is deformed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import HmrfError
from napari_hmrf.extras import how_to_install

Kind = Literal["rigid", "affine"]
Float64Array = npt.NDArray[np.float64]

#: Number of brightness classes of the mutual information, and fraction of pixels that are compared.
_CLASSES, _SHARE = 32, 0.2
#: Seed of the choice of pixels, so that an alignment is reproducible.
_SEED = 1
#: Largest number of steps on each level, and their first and last length, in pixels of the level.
_ITERATIONS, _FIRST_STEP, _LAST_STEP = 300, 0.5, 1e-3
#: Factor by which the step is shortened where the direction reverses.
_RELAXATION = 0.7
#: Number of pixels along the longest axis below which there is no coarser level.
_LEAST_PIXELS = 32


def align(
    kind: Kind,
    fixed: npt.NDArray[np.float32],
    moving: npt.NDArray[np.float32],
    *,
    spacing: Sequence[float],
    moving_spacing: Sequence[float],
    masks: tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]],
) -> Float64Array:
    """Return the map from positions in the fixed image to positions in the moving image.

    Maximizes the mutual information of both images, which need not have the same contrast. Mutual
    information has many local maxima. Therefore, on images with large pixels, the iteration starts
    with the centres of mass at the same position, and again with the largest correlation of both
    images; the better result is refined.

    Parameters
    ----------
    kind : {"rigid", "affine"}
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing, moving_spacing : sequence of float
        Size of a pixel of each image along each axis.
    masks : tuple of ndarray of bool
        Pixels of `fixed` and `moving` that count.

    Returns
    -------
    ndarray, shape (n + 1, n + 1)
        Homogeneous matrix, for coordinates in the unit of the spacing and in the order of the axes;
        the first pixel of each image is at the origin.

    Raises
    ------
    HmrfError
        If SimpleITK is not installed, or the images could not be aligned.
    """
    sitk: Any
    try:
        import SimpleITK as sitk  # optional: SimpleITK
    except ImportError:
        raise HmrfError(
            f"a {kind} alignment requires SimpleITK: {how_to_install('medical')}. Or pass the "
            "matrix of the alignment"
        ) from None
    images = []
    for pixels, sizes in ((fixed, spacing), (moving, moving_spacing)):
        image = sitk.GetImageFromArray(pixels)
        image.SetSpacing([float(size) for size in reversed(sizes)])
        images.append(image)
    counted = []
    for mask, image in zip(masks, images, strict=True):
        each = sitk.GetImageFromArray(mask.astype(np.uint8))
        each.CopyInformation(image)
        counted.append(each)
    axes = fixed.ndim
    factors = [size for size in (16, 8, 4, 2, 1) if max(fixed.shape) / size >= _LEAST_PIXELS]
    factors = factors or [1]
    coarse, fine = factors[:2], factors[2:]

    def improved(transform: Any, by: str, levels: list[int]) -> tuple[float, Any]:
        """Return the metric at the end of an iteration over levels, and the transform."""
        method = sitk.ImageRegistrationMethod()
        method.SetNumberOfWorkUnits(1)  # several threads add up the metric in any order
        if by == "correlation":
            method.SetMetricAsCorrelation()
        else:
            method.SetMetricAsMattesMutualInformation(_CLASSES)
        method.SetMetricSamplingStrategy(method.REGULAR)
        method.SetMetricSamplingPercentage(_SHARE, _SEED)
        method.SetMetricFixedMask(counted[0])
        method.SetMetricMovingMask(counted[1])
        method.SetInterpolator(sitk.sitkLinear)
        method.SetOptimizerAsRegularStepGradientDescent(
            learningRate=_FIRST_STEP * levels[0] * min(spacing),
            minStep=_LAST_STEP * min(spacing),
            numberOfIterations=_ITERATIONS,
            relaxationFactor=_RELAXATION,
            gradientMagnitudeTolerance=1e-8,
        )
        method.SetOptimizerScalesFromPhysicalShift()
        method.SetShrinkFactorsPerLevel(levels)
        method.SetSmoothingSigmasPerLevel([size / 2 if size > 1 else 0 for size in levels])
        method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOff()
        moved = type(transform)(transform)
        method.SetInitialTransform(moved, inPlace=True)
        method.Execute(*images)
        return float(method.GetMetricValue()), moved

    try:
        start = _centred(sitk, kind, images)
        _, correlated = improved(start, "correlation", coarse)
        both = [improved(each, "information", coarse) for each in (start, correlated)]
        _, best = min(both, key=lambda found: found[0])
        if fine:
            _, best = improved(best, "information", fine)
    except RuntimeError as error:
        raise HmrfError(
            f"the images could not be aligned ({_reason(error)}). Align them before, or pass the "
            "matrix of the alignment"
        ) from error
    return _matrix(best.TransformPoint, axes)


def _centred(sitk: Any, kind: Kind, images: list[Any]) -> Any:
    """Return the transform that moves the centre of mass of one image to that of the other."""
    axes = images[0].GetDimension()
    if kind == "affine":
        start = sitk.AffineTransform(axes)
    else:
        start = sitk.Euler2DTransform() if axes == 2 else sitk.Euler3DTransform()
    how = sitk.CenteredTransformInitializerFilter.MOMENTS
    centred = sitk.CenteredTransformInitializer(*images, start, how)
    return type(start)(centred)


def matrix_in_pixels(
    matrix: Float64Array, spacing: Sequence[float], moving_spacing: Sequence[float]
) -> Float64Array:
    """Return an alignment as a matrix from pixels of the fixed image to those of the moving image.

    Parameters
    ----------
    matrix : ndarray, shape (n + 1, n + 1)
        Result of `align`, in the unit of the spacing.
    spacing, moving_spacing : sequence of float
        Size of a pixel of each image along each axis.
    """
    before, after = np.array([*spacing, 1.0]), np.array([*moving_spacing, 1.0])
    return np.asarray(matrix * before / after[:, None])


def _matrix(transform: Callable[[tuple[float, ...]], Any], axes: int) -> Float64Array:
    """Return the matrix of an affine map of points (x, y[, z]), for points in axis order."""
    origin = np.array(transform((0.0,) * axes))
    columns = [np.array(transform(tuple(unit))) - origin for unit in np.eye(axes)]
    matrix = np.eye(axes + 1)
    matrix[:axes, :axes] = np.stack(columns, axis=1)[::-1, ::-1]
    matrix[:axes, axes] = origin[::-1]
    return matrix


def _reason(error: RuntimeError) -> str:
    """Return the last line of an error of SimpleITK."""
    return str(error).strip().splitlines()[-1].strip().rstrip(".")
