"""Conversion of an image to a `Grid`: its shape, spacing and place."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from napari_hmrf.arguments import is_whole, shown
from napari_hmrf.errors import ArgumentError, ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.decoded import Unreadable
from napari_hmrf.io.images import read_image
from napari_hmrf.io.nifti import MILLIMETRES, check_places, lps_geometry
from napari_hmrf.study.study import Grid

_NO_PLACE = (
    "its header states no place (the codes of its qform and sform are 0), and ITK does not centre "
    "such an image as nibabel does. Set the place: image.set_sform(image.affine, code=1)"
)


def grid_of_image(
    image: Any,
    *,
    slice: int | None = None,  # noqa: A002
    axis: int = 0,
) -> Grid:
    """Return the grid of an image, or of one slice of a volume, including its place.

    Parameters
    ----------
    image : path-like, SimpleITK image or nibabel image
        Path of a NIfTI, MetaImage or NRRD file, a folder of DICOM files, or a picture; or an image
        object. The axes are ordered as in the array: ([z,] y, x) for a file or SimpleITK's
        ``GetArrayFromImage``, and (x, y, z) for nibabel's ``dataobj``.
    slice : int, optional
        Index of a slice of a volume; by default, the grid of the whole image is returned, which for
        a volume of one slice is that of this slice.
    axis : int
        Axis of the volume's array perpendicular to the slice.

    Returns
    -------
    Grid

    Raises
    ------
    ArgumentError
        If `image` has an unsupported type, or does not have the requested slice.
    ProblemError
        If the axes of the image are not orthogonal.
    HmrfError, OSError
        As for `read_image`, if `image` is a path.
    """
    if isinstance(image, str | os.PathLike):
        geometry = _of_file(image, None if slice is None else axis)
    elif hasattr(image, "GetDirection"):
        geometry = _of_simpleitk(image)
    elif hasattr(image, "affine") and hasattr(image, "dataobj"):
        geometry = _of_nibabel(image)
    else:
        raise ArgumentError(
            f"image is {shown(image)}, of type {type(image).__name__}. Pass a path, a SimpleITK "
            "image or a nibabel image. For an array, which has no position in world coordinates, "
            "use Grid(shape, spacing)."
        )
    shape, n = geometry.shape, geometry.ndim
    is_placed = geometry.unit == "millimeter"
    if is_placed:
        geometry = _right_angled(geometry)
        frame = Frame.of_geometry(geometry, volume=n == 3)
    else:
        frame = Frame.at(geometry.spacing, (geometry.unit,) * n, volume=n == 3)
    grid = Grid(shape, frame.spacing, geometry.unit, frame if is_placed else None)
    if slice is None and n == 3 and 1 in shape:  # a volume of one slice
        return _slice_of(grid, frame, 0, shape.index(1))
    if slice is None:
        return grid
    return _slice_of(grid, frame, slice, axis)


def _slice_of(grid: Grid, frame: Frame, number: int, axis: int) -> Grid:
    if len(grid.shape) != 3:
        raise ArgumentError(f"slice is {number}, but the image has 2 axes. Leave slice out.")
    if not (is_whole(axis) and -3 <= axis < 3):
        raise ArgumentError(f"axis is {shown(axis)}. Pass 0, 1 or 2: an axis of the volume.")
    axis = int(axis) % 3
    count = grid.shape[axis]
    if not (is_whole(number) and 0 <= number < count):
        raise ArgumentError(
            f"slice is {shown(number)}, but the volume has {count} slices along axis {axis}. "
            f"Pass 0 to {count - 1}."
        )
    return replace(
        grid,
        shape=(*grid.shape[:axis], *grid.shape[axis + 1 :]),
        spacing=(*grid.spacing[:axis], *grid.spacing[axis + 1 :]),
        # Also set for a stack without a place, to store the index of the slice.
        place=frame.plane_at(axis, int(number)),
    )


def _of_file(path: str | os.PathLike[str], across: int | None) -> Geometry:
    """Return the grid of an image file, of which one slice may be used."""
    image = read_image(path)
    if across != 0:  # a slice along the first axis of a stack is an image
        image.refuse_as_volume(Path(path).name)
    return image.grid


def _right_angled(geometry: Geometry) -> Geometry:
    try:
        return geometry.right_angled()
    except ValueError as error:
        raise ProblemError(
            "image",
            f"is no grid of pixels: {error}. Resample it, for example with "
            "nibabel.processing.resample_to_output(image), or its file with napari-hmrf resample.",
        ) from None


def _of_simpleitk(image: Any) -> Geometry:
    n = image.GetDimension()
    if n not in (2, 3):
        raise ArgumentError(f"image has {n} axes. Pass an image with 2 axes, or a volume with 3.")
    spacing, origin = image.GetSpacing()[::-1], image.GetOrigin()
    return Geometry.of_itk(image.GetSize()[::-1], spacing, origin, image.GetDirection())


def _of_nibabel(image: Any) -> Geometry:
    """Return the grid, with the axes in the order of `dataobj` (usually x, y, z)."""
    shape = tuple(int(size) for size in image.dataobj.shape)
    affine = np.asarray(image.affine, dtype=float)
    if len(shape) > 3 and set(shape[3:]) == {1}:
        shape = shape[:3]
    if len(shape) == 2:
        shape = (*shape, 1)
    if len(shape) != 3:
        raise ArgumentError(f"image has shape {shape}. Pass an image with 2 or 3 axes.")
    if affine.shape != (4, 4):
        raise ArgumentError(
            f"image has the affine {shown(image.affine)}. Pass an image with a 4 x 4 affine."
        )
    header = image.header
    try:
        if hasattr(header, "get_qform") and hasattr(header, "get_sform"):  # NIfTI
            codes = int(header["qform_code"]), int(header["sform_code"])
            if not any(codes):
                raise Unreadable(_NO_PLACE)
            if all(codes):
                check_places(header.get_qform(), header.get_sform(), codes[1], shape)
        return lps_geometry(affine, shape[::-1], _millimetres(image)).reordered((2, 1, 0))
    except Unreadable as error:
        raise ProblemError("image", f"cannot be used: {error}.") from None


def _millimetres(image: Any) -> float:
    """Return the length in mm of the unit of a nibabel image's affine."""
    # Only the headers of NIfTI images state a unit; other formats of nibabel use millimetres.
    units = getattr(image.header, "get_xyzt_units", lambda: ("mm",))()
    if units[0] not in MILLIMETRES:
        raise ProblemError(
            "image",
            f"has the unit {shown(units[0])} in its header. Set millimetres: "
            'image.header.set_xyzt_units("mm").',
        )
    return MILLIMETRES[units[0]]
