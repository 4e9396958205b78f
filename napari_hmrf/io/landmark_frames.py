"""Conversion of the points of landmark files to pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.images import ImageFile
from napari_hmrf.io.landmark_files import LandmarkFile

Points = npt.NDArray[np.float64]


def in_pixels(
    file: LandmarkFile,
    points: Points,
    image: ImageFile,
    name: str,
    number: int | None = None,
) -> Points:
    """Convert points of a landmark file to pixels of an image, as it is solved.

    Coordinates in BigWarp's files are along the axes of the image file, from its first pixel; those
    in other files are positions in the patient.

    Parameters
    ----------
    file : LandmarkFile
    points : ndarray, shape (N, n)
        Its points or targets.
    image : ImageFile
        Image as it is stored.
    name : str
        Name of the landmark file, for error messages.
    number : int, optional
        Index of the slice that is solved; by default, the whole image is solved.

    Returns
    -------
    ndarray, shape (N, n)
        Points in pixels. A slice of a volume may have three coordinates, the first across the
        slice.

    Raises
    ------
    ProblemError
        If the number or the unit of the coordinates is not that of the image, or the image was
        resampled and they are along the axes of its file.
    """
    if image.resampled:
        refuse_stored_axes(file, name)
    whole, solved = image.grid, image.laid_out
    if number is not None:
        whole, solved = whole.slice_at(number), image
    n = 2 if number is not None else solved.ndim
    of_points = geometry_for(file, whole, name, n)
    at = of_points.to_pixels(points)
    if number is None:
        if image.ndim == 3:
            at = solved.grid.to_pixels(whole.to_world(at))
    elif of_points is not whole:
        at -= [*[number] * (at.shape[1] - 2), 0, 0]
    return at


def refuse_stored_axes(file: LandmarkFile, name: str) -> None:
    """Raise an error for coordinates along the axes of an image file, which was resampled."""
    if file.unit != "mm":
        raise ProblemError(
            name,
            "has coordinates along the axes of the image, which is resampled. Give positions in "
            "the patient (.mrk.json or .fcsv of 3D Slicer), or use the image written by "
            "napari-hmrf resample.",
        )


def geometry_for(file: LandmarkFile, geometry: Geometry, name: str, n: int) -> Geometry:
    """Return the grid used to convert the points of a landmark file to pixels.

    Parameters
    ----------
    file : LandmarkFile
    geometry : Geometry
        Grid of the image.
    name : str
        Name of the file, for error messages.
    n : int
        Number of axes of the field.

    Returns
    -------
    Geometry
        Grid with the axes and the unit of the points.

    Raises
    ------
    ProblemError
        If the number of coordinates is neither the number of axes of the field nor that of the
        image, or the points are in patient coordinates and the image is not.
    """
    if file.unit == "mm" and geometry.unit != "millimeter":
        raise ProblemError(
            name,
            "contains positions in the patient, but the image has none. Give an image with a "
            "position, such as .nii.gz or .nrrd, or landmarks of BigWarp.",
        )
    axes, image_axes = file.points.shape[1], geometry.ndim
    if axes not in (n, image_axes):
        raise ProblemError(
            name,
            f"contains points with {axes} coordinates, but the image has {image_axes} axes. Give "
            f"points with {image_axes} coordinates.",
        )
    if file.unit == "mm" and axes == image_axes:
        return geometry
    spacing = () if file.unit == "pixel" else geometry.spacing[-axes:]
    return Geometry.at_origin((1,) * axes, spacing)
