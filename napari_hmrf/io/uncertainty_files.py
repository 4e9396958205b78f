"""Images of the uncertainty of a displacement."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from napari_hmrf.arguments import checked_path
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.fields import place_solution
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.study.study import Grid

#: Suffixes of images with real numbers, and of those without a position.
IMAGE_SUFFIXES = (".nii.gz", ".nii", ".mha", ".nrrd", ".tif", ".tiff")
_WITHOUT_PLACE = (".tif", ".tiff")
#: Names of the axes, from the last to the first.
_AXES = ("col", "row", "plane")


def uncertainty_paths(path: str | os.PathLike[str], axes: int) -> tuple[Path, ...]:
    """Return the paths of the images of an uncertainty: along the motion, and along each axis.

    Parameters
    ----------
    path : str or path-like
        File of the standard deviation along the motion.
    axes : int
        Number of axes of the displacement.

    Raises
    ------
    FileFormatError
        If the suffix is not that of an image with real numbers.
    """
    target = Path(checked_path(path))
    suffix = next((each for each in IMAGE_SUFFIXES if target.name.lower().endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{target.name}: standard deviations cannot be written in this format. Use one of the "
            f"suffixes {', '.join(IMAGE_SUFFIXES)}."
        )
    stem, ending = target.name[: -len(suffix)], target.name[-len(suffix) :]
    parts = (target.with_name(f"{stem}-{axis}{ending}") for axis in _AXES[:axes][::-1])
    return target, *parts


def write_uncertainty(
    path: str | os.PathLike[str],
    found: Uncertainty,
    *,
    grid: Grid | None = None,
    placed: bool = True,
) -> tuple[Path, ...]:
    """Write the standard deviations of patches as images, at the position of the image.

    The images have the grid of `Solution.displacement`: each pixel shows the error bar of the
    tissue that was there before the motion, and 0 outside tissue. Values are in mm; in a .tif, they
    are in the unit of `spacing`.

    Parameters
    ----------
    path : str or path-like
        File of the standard deviation along the motion, `along`: .nii.gz, .nii, .mha or .nrrd,
        which require SimpleITK, or .tif, which does not store a position. The standard deviations
        along each axis are written beside it, such as ``sd-row.nii.gz`` and ``sd-col.nii.gz`` for
        ``sd.nii.gz``, and in a volume also ``sd-plane.nii.gz``.
    found : Uncertainty
    grid, placed
        As for `export_field`; ignored for .tif.

    Returns
    -------
    tuple of Path
        The written files, in the order of `uncertainty_paths`; the first one is `path`.

    Raises
    ------
    ProblemError
        If there are no samples; or as for `export_field`.
    HmrfError, OSError
        As for `export_field`.
    """
    found.require_samples()
    solution = found.solution
    paths = uncertainty_paths(path, solution.tissue.ndim)
    if paths[0].name.lower().endswith(_WITHOUT_PLACE):
        place, factor = None, 1.0
    else:
        _, place = place_solution(solution, grid, placed)
        factor = place.spacing[-1] / solution.spacing[-1]
    for target, values in zip(paths, (found.along, *np.moveaxis(found.sd, -1, 0)), strict=True):
        in_mm = np.where(solution.tissue, values * np.float32(factor), np.float32(0))
        write_image(target, ImageFile(in_mm, place))
    return paths
