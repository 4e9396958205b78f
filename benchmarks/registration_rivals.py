"""Other registration programs, with the conventions of this package.

Each function returns the displacement from the fixed image to the moving image on the grid of the
fixed image, in the unit of the spacing, with components in the order of the axes. The settings
were chosen on seeds 0 and 1 of the known deformations.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Register = Callable[[Array, Array, tuple[float, ...]], Array]

#: Pixel sizes of the levels of demons, and numbers of iterations.
_DEMONS_LEVELS = ((4, 100), (2, 60), (1, 30))
#: Iterations and compared points of elastix on each of its four levels.
_ELASTIX_STEPS, _ELASTIX_POINTS = 500, 4000
#: Weight of the bending energy in elastix; without it, knots 12 mm apart follow the noise.
_BENDING = 1.0

#: Pixel size of the grid on which the bias is estimated, and brightness that is added because the
#: method takes logarithms.
_N4_SHRINK, _POSITIVE = 3, 0.1


class Rival(NamedTuple):
    """Another registration program with its settings.

    Attributes
    ----------
    module : str
        Module that must be importable.
    package : str
        Name for pip.
    register : callable
        Function of the fixed image, the moving image and the spacing.
    """

    module: str
    package: str
    register: Register

    @property
    def available(self) -> bool:
        """True if the program is installed."""
        return importlib.util.find_spec(self.module) is not None


def demons(fixed: Array, moving: Array, spacing: tuple[float, ...], sigma: float) -> Array:
    """Return the displacement by symmetric demons of SimpleITK, on three levels.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    sigma : float
        Standard deviation of the smoothing of the displacement, in pixels of the level.
    """
    import SimpleITK as sitk

    images = [sitk.GetImageFromArray(each.astype(np.float32)) for each in (fixed, moving)]
    for image in images:
        image.SetSpacing([float(size) for size in reversed(spacing)])
    images[1] = sitk.HistogramMatching(images[1], images[0], 1024, 7, True)
    field = None
    for size, count in _DEMONS_LEVELS:
        level = images
        if size > 1:
            widths = [float(size * side / 2) for side in reversed(spacing)]
            level = [
                sitk.Shrink(sitk.SmoothingRecursiveGaussian(image, widths), [size] * fixed.ndim)
                for image in images
            ]
        method = sitk.FastSymmetricForcesDemonsRegistrationFilter()
        method.SetNumberOfIterations(count)
        method.SetSmoothDisplacementField(True)
        method.SetStandardDeviations(sigma)
        if field is None:
            field = method.Execute(*level)
        else:
            kind, still = sitk.sitkVectorFloat64, sitk.Transform(fixed.ndim, sitk.sitkIdentity)
            start = sitk.Resample(field, level[0], still, sitk.sitkLinear, 0.0, kind)
            field = method.Execute(*level, start)
    return np.asarray(sitk.GetArrayFromImage(field)[..., ::-1])


def elastix(
    fixed: Array, moving: Array, spacing: tuple[float, ...], gap: float, **settings: str
) -> Array:
    """Return the displacement by B-splines of elastix.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    gap : float
        Distance of the knots on the finest level, in the unit of the spacing.
    **settings : str
        Further parameters of elastix, with values separated by spaces.
    """
    import itk

    images = []
    for each in (fixed, moving):
        image = itk.image_view_from_array(np.ascontiguousarray(each, np.float32))
        image.SetSpacing([float(size) for size in reversed(spacing)])
        images.append(image)
    parameters = itk.ParameterObject.New()
    values = parameters.GetDefaultParameterMap("bspline", 4, float(gap))
    wanted = {
        "Registration": "MultiMetricMultiResolutionRegistration",
        "Metric": "AdvancedNormalizedCorrelation TransformBendingEnergyPenalty",
        "Metric0Weight": "1",
        "Metric1Weight": str(_BENDING),
        "MaximumNumberOfIterations": str(_ELASTIX_STEPS),
        "NumberOfSpatialSamples": str(_ELASTIX_POINTS),
        "WriteResultImage": "false",
        **settings,
    }
    for name, value in wanted.items():
        values[name] = value.split()
    parameters.AddParameterMap(values)
    _, found = itk.elastix_registration_method(
        *images, parameter_object=parameters, log_to_console=False
    )
    with tempfile.TemporaryDirectory() as folder:
        field = itk.transformix_deformation_field(images[1], found, output_directory=folder)
        return np.array(itk.array_from_image(field))[..., ::-1]


def syn(
    fixed: Array, moving: Array, spacing: tuple[float, ...], metric: str, step: float = 0.2
) -> Array:
    """Return the displacement by SyN of ANTs.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    metric : {"mattes", "CC"}
    step : float
        Length of a step of the gradient descent, in pixels.
    """
    import ants

    images = [
        ants.from_numpy(each.astype(np.float32), spacing=[float(size) for size in spacing])
        for each in (fixed, moving)
    ]
    with tempfile.TemporaryDirectory() as folder:
        found = ants.registration(
            *images,
            type_of_transform="SyNOnly",
            initial_transform="Identity",
            outprefix=str(Path(folder) / "syn"),
            syn_metric=metric,
            grad_step=step,
            syn_sampling=4 if metric == "CC" else 32,
            reg_iterations=(40, 20, 10) if metric == "CC" else (100, 70, 30),
        )
        field = next(name for name in found["fwdtransforms"] if name.endswith(".nii.gz"))
        return np.array(ants.image_read(field).numpy())


def without_bias(image: Array) -> Array:
    """Return an image without its smooth bias, by N4 of SimpleITK on a coarser grid."""
    import SimpleITK as sitk

    whole = sitk.GetImageFromArray(image.astype(np.float32) + _POSITIVE)
    mask = sitk.OtsuThreshold(whole, 0, 1)
    coarse = [sitk.Shrink(each, [_N4_SHRINK] * image.ndim) for each in (whole, mask)]
    correction = sitk.N4BiasFieldCorrectionImageFilter()
    correction.SetMaximumNumberOfIterations([50] * 4)
    correction.Execute(*coarse)
    bias = sitk.Exp(correction.GetLogBiasFieldAsImage(whole))
    return sitk.GetArrayFromImage(whole / bias) - _POSITIVE


def rivals(gaps: tuple[float, float], sigmas: tuple[float, float]) -> dict[str, Rival]:
    """Return all programs by name.

    Parameters
    ----------
    gaps : tuple of float
        Distances of the knots of elastix.
    sigmas : tuple of float
        Standard deviations of demons, in pixels.
    """
    found = {}
    for sigma in sigmas:
        run = partial(demons, sigma=sigma)
        found[f"demons-{sigma:g}"] = Rival("SimpleITK", "SimpleITK", run)
    for gap in gaps:
        found[f"elastix-{gap:g}"] = Rival("itk", "itk-elastix", partial(elastix, gap=gap))
    for metric in ("mattes", "CC"):
        found[f"syn-{metric.lower()}"] = Rival("ants", "antspyx", partial(syn, metric=metric))
    short = partial(syn, metric="mattes", step=0.1)
    found["syn-mattes-short-steps"] = Rival("ants", "antspyx", short)
    return found
