"""Application of a displacement field to images, labels and landmarks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import HmrfError, ProblemError
from napari_hmrf.field.deformation import count_folds
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.resample import unknown_values, without_removed
from napari_hmrf.field.units import unit_factor
from napari_hmrf.field.warp import warp
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.fields import placed, read_field, write_field
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.io.landmark_files import (
    POINT_SUFFIXES,
    read_points,
    write_points,
)
from napari_hmrf.io.landmark_frames import geometry_for, refuse_stored_axes
from napari_hmrf.io.study_file import is_study_file, read_solved
from napari_hmrf.real_arrays import grid_in_words, sites_in_words, whole_numbers
from napari_hmrf.results.observation import PixelField
from napari_hmrf.solver.solution import Solution, is_solution_file

Pixels = npt.NDArray[Any]

#: Displacement, in mm, below which a component in a file is considered to be zero.
_ROUNDING = 1e-4
#: Sentence about fields without a position in world coordinates.
_NO_PLACE = " Its image has no position in world coordinates, so the field is at the origin{}."
_NO_SIZE = ", and its spacing is assumed to be in mm"
#: An image may contain labels if it has at most so many distinct values, or if at most this share
#: of the pixels with a value differ from the next pixel.
_MOST_LABELS, _UNEVEN = 64, 0.3
#: Largest distance between a point and the centre of its slice, in slices.
_IN_SLICE = 0.5 + 1e-3


class Applied(NamedTuple):
    """Path of the written file, and a note for the user (a clause, or "" if there is none)."""

    path: Path
    note: str = ""


@dataclass(frozen=True, eq=False)
class FieldFile:
    """Displacement field from a file of any kind, with the place of its grid.

    Attributes
    ----------
    field : Field
    tissue : ndarray of bool or None
        Mask of the deformable tissue; None if the file has no mask, in which case all pixels move.
    is_placed : bool
        False if the file stores no place. The grid is then at the origin, aligned with the axes.
    removed : ndarray of bool or None
        Mask of removed tissue, which moved images do not show; None if no tissue is removed.
    parts : ndarray of int or None
        Label of the sliding part of each site; None if all tissue is connected.
    file_axes : tuple of int
        Axis of the image file for each axis of the grid.
    number : int
        Index of a slice along the first axis of the grid.
    unit_length : float
        Length of the unit of the image in the unit of the grid.
    """

    field: Field
    tissue: npt.NDArray[np.bool_] | None = None
    is_placed: bool = True
    removed: npt.NDArray[np.bool_] | None = None
    parts: npt.NDArray[np.int32] | None = None
    file_axes: tuple[int, ...] = (0, 1, 2)
    number: int = 0
    unit_length: float = 1.0

    @classmethod
    def of(cls, solution: Solution) -> FieldFile:
        """Return the displacement field of a solution, with the place of its image."""
        d, geometry = placed(solution)
        frame = solution.place
        across = frame.others[-1:] if len(frame.plane) == 2 else ()
        axes = (*across, *frame.plane)
        return cls(
            Field(d, geometry),
            solution.tissue,
            bool(solution.frame),
            solution.removed,
            solution.parts,
            tuple(frame.file_axes[axis] if frame.file_axes else axis for axis in axes)
            if frame.ndim == 3
            else (0, 1, 2),
            frame.index[across[0]] if across else 0,
            geometry.spacing[-1] / solution.spacing[-1],
        )

    @property
    def geometry(self) -> Geometry:
        """Grid of the field; for a slice of a volume, a volume of one slice."""
        return self.field.geometry

    @property
    def in_patient(self) -> Geometry | None:
        """Grid in patient coordinates, or None if the pixel size is unknown."""
        return self.geometry if self.geometry.unit == "millimeter" else None

    @property
    def in_pixels(self) -> PixelField:
        """Field in pixels, with one component per axis of its grid, as stored in layers."""
        field, frame = self.field.to_pixels(), Frame.of_geometry(self.geometry)
        if len(field.shape) == 2:
            field = Field.in_pixels(frame.put_field(field.displacement))
        return PixelField(field, frame)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of pixels along each axis of the grid."""
        return self.field.shape

    @property
    def spacing(self) -> Sequence[float]:
        """Pixel size along each axis of the displacement field."""
        return self.field.spacing

    @property
    def displacement(self) -> npt.NDArray[Any]:
        """Material displacement at every site; a backward field is inverted."""
        return self.field.displacement


def read_field_file(path: str | os.PathLike[str], *, forward: bool = False) -> FieldFile:
    """Read the displacement field of a solved study, a saved result, or another tool's file.

    Parameters
    ----------
    path : str or path-like
    forward : bool
        True if a field from another tool maps original to new positions, but its file does not
        state the direction.

    Raises
    ------
    FileFormatError
        If the file does not contain a valid displacement field.
    HmrfError
        If `forward` is True for a study or a result; or as for `read_field`.
    OSError
        If the file cannot be opened.
    """
    if is_solution_file(path) or is_study_file(path):
        if forward:
            raise HmrfError(
                f"{Path(path).name} is a result, so the direction of its field is known. Leave out "
                "the direction (`forward=True`)."
            )
        return FieldFile.of(read_solved(path)[1])
    field = read_field(path, forward=forward)
    across = field.vectors[..., 0]
    if across.ndim == 3 and len(across) == 1 and np.abs(across).max() < _ROUNDING:  # a single slice
        field = replace(field, vectors=field.vectors[0, ..., 1:])
    return FieldFile(field)


def write_field_file(
    path: str | os.PathLike[str], field: FieldFile, *, forward: bool = False
) -> str:
    """Write a field with `write_field`, and return a message for the user.

    Returns
    -------
    str
        Sentences on the direction of the written field, the accuracy of the inverse, and folds.

    Raises
    ------
    HmrfError, OSError
        As for `write_field`.
    """
    name, d = Path(path).name, field.displacement
    residual = write_field(path, d, **field.geometry.as_itk, tissue=field.tissue, forward=forward)
    place_note = _note_on_place(field)
    if forward:
        return f"Saved {name}: the forward field, which moves points.{place_note}"
    sentence = (
        f"Saved {name}: the backward field, which moves images. Accuracy of the inverse: "
        f"{residual:.2g} px at the centres of the pixels that tissue moved to; between pixels and "
        "at the edge of the tissue, the error may be larger."
    )
    folded = count_folds(d, spacing=field.spacing, tissue=field.tissue, parts=field.parts)
    sentence += place_note
    if not folded:
        return sentence
    sites = sites_in_words(folded, len(field.shape))
    return (
        f"{sentence} However, the tissue folds over itself at {sites}, where no inverse "
        "exists: the image will show only one of the overlapping parts. Reduce the motion there."
    )


def _note_on_place(field: FieldFile) -> str:
    """Return a sentence about the place of a field whose image has none, or ""."""
    assumed = _NO_SIZE if field.geometry.unit == "pixel" else ""
    return "" if field.is_placed else _NO_PLACE.format(assumed)


def apply_field(
    field: FieldFile,
    path: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    labels: bool,
    resample: bool = False,
) -> Applied:
    """Deform the image or landmarks in a file, and write the result to another file.

    A field of a volume deforms the whole volume. A field of a slice deforms only this slice of a
    volume, and only the landmarks in this slice. A stack of pictures without a place, such as the
    frames of a film in a .tif, is deformed in all slices.

    Parameters
    ----------
    field : FieldFile
    path : str or path-like
        Image or landmark file.
    target : str or path-like
        File to write, in the same format.
    labels : bool
        True if the image contains labels, which must not be interpolated.
    resample : bool
        True to resample an image whose axes are not at right angles.

    Raises
    ------
    ProblemError
        If the size or place of the image differs from that of the field; if the image would be
        overwritten; if the image is a volume and the field does not state its slice; or if a label
        is not a whole number.
    FileFormatError, HmrfError, OSError
        As for `read_image`, `write_image`, `read_points` and `write_points`.
    """
    name = Path(path).name
    if Path(target).exists() and Path(target).samefile(path):
        raise ProblemError(name, "would be overwritten. Choose another folder for the moved files.")
    if name.lower().endswith(POINT_SUFFIXES):
        return _move_landmarks(field, path, target, resample)
    image = read_image(path, resample=resample, labels=labels)
    n, straightened = len(field.shape), image.resampled
    if labels:
        whole_numbers(name, image.pixels)
    order = 0 if labels else 1
    blended = "" if labels else _note_on_labels(image.pixels, name)
    if n == 2 and image.is_of_volume and (image.ndim == 3 or field.geometry.ndim == 3):
        moved_slice = write_image(target, _move_slice(field, image, name, order))
        return Applied(moved_slice, "; ".join(filter(None, (straightened, blended))))
    if n == 3:
        image = image.laid_as(field.in_patient, field.file_axes)
    pixels = image.pixels
    sizes = pixels.shape[: image.ndim]
    if sizes[-n:] != field.shape:
        raise ProblemError(
            name,
            f"is {grid_in_words(sizes)}, but the field is {grid_in_words(field.shape)}. Give an "
            "image of the same size.",
        )
    if n == image.ndim:
        image.refuse_elsewhere(field.in_patient, name, "the field")
        if not image.resolution:  # --spacing may have replaced it
            _refuse_other_size(field, image, name)
    note = ""
    if n == image.ndim:
        moved = _warp_pixels(field, pixels, order)
    else:
        moved = pixels.copy()
        for number in range(len(pixels)):
            moved[number] = _warp_pixels(field, pixels[number], order)
        if len(pixels) > 1:
            note = (
                f"{name} has no position in world coordinates, so all {len(pixels)} slices were "
                "moved in the same way"
            )
    notes = filter(None, (straightened, note, blended, unknown_values(pixels, image.ndim, name)))
    image = image._replace(pixels=moved)
    if n == 3 and image.geometry is None:
        image = image.laid_as(None, tuple(np.argsort(field.file_axes).tolist()))
    return Applied(write_image(target, image), "; ".join(notes))


def _refuse_other_size(field: FieldFile, image: ImageFile, name: str) -> None:
    """Raise an error if a picture and a field state different sizes of their pixels."""
    if not image.sizes or field.geometry.unit == "pixel":
        return
    own = image.grid.scaled(unit_factor(image.unit, "millimeter"))
    if not own.same_as(Geometry.at_origin(field.shape, field.spacing)):
        sizes = (grid_in_words(each.spacing) for each in (own, field))
        raise ProblemError(
            name,
            "has pixels of {} mm, but the field has pixels of {} mm. Give an image on the grid of "
            "the field.".format(*sizes),
        )


def _note_on_labels(pixels: Pixels, name: str) -> str:
    """Return a warning if an interpolated image probably contains labels, and "" otherwise.

    Labels are whole numbers; there are few of them, or most pixels have that of the next pixel.
    """
    kind = pixels.dtype.kind
    if not pixels.size or not (
        kind in "iu" or (kind == "f" and np.array_equal(pixels, np.rint(pixels)))
    ):
        return ""
    values = np.unique(pixels)
    if values[0] < 0 or values[-1] <= 1:
        return ""
    lines = pixels.squeeze()
    one, other = lines[..., 1:], lines[..., :-1]
    inside = (one != 0) & (other != 0)
    differ = float((one != other)[inside].mean()) if inside.any() else 0.0
    if len(values) > _MOST_LABELS and differ > _UNEVEN:
        return ""
    return (
        f"{name} contains only {len(values)} whole numbers, up to {values[-1]:.0f}, and was "
        "interpolated; if the numbers are labels, use --labels"
    )


def _warp_pixels(field: FieldFile, pixels: Pixels, order: int) -> Pixels:
    if field.field.back:
        return _sample_backward(field, pixels, order)
    remaining, d = without_removed(pixels, field.removed, 0), field.displacement
    where: dict[str, Any] = {"tissue": field.tissue, "parts": field.parts}
    return warp(remaining, d, spacing=field.spacing, order=order, **where)


def _sample_backward(field: FieldFile, pixels: Pixels, order: int) -> Pixels:
    """Warp an image with a backward field, without inverting the field."""
    steps = field.field.backward / field.spacing
    origins = np.moveaxis(steps, -1, 0) + np.indices(steps.shape[:-1])
    if pixels.ndim > len(field.shape):
        parts = [_sample_at(pixels[..., part], origins, order) for part in range(pixels.shape[-1])]
        return np.stack(parts, axis=-1)
    return _sample_at(pixels, origins, order)


def _sample_at(pixels: Pixels, origins: Pixels, order: int) -> Pixels:
    """Return the values of an image at the given pixels; 0 outside of its outermost pixels."""
    last = np.reshape(pixels.shape, (-1, *(1,) * pixels.ndim)) - 1
    near = np.floor(origins + 0.5).astype(int)
    inside = ((near >= 0) & (near <= last)).all(axis=0)
    if order == 0:
        sampled: Pixels = pixels[tuple(np.clip(near, 0, last))]
    else:
        sampled = scipy.ndimage.map_coordinates(
            pixels.astype(float), origins, order=1, mode="nearest"
        )
        if pixels.dtype.kind in "biu":
            sampled = np.rint(sampled)
    sampled[~inside] = 0
    return sampled.astype(pixels.dtype, copy=False)


def _move_slice(field: FieldFile, image: ImageFile, name: str, order: int) -> ImageFile:
    """Return a volume in which only the slice of the field is deformed.

    The order of the axes is unchanged.

    Raises
    ------
    ProblemError
        If the slice of the field is unknown, or is not a slice of the volume.
    """
    of_slice = field.in_patient
    if of_slice is None or of_slice.ndim < 3:
        raise ProblemError(
            name,
            f"is a volume of {len(image.pixels)} slices, but the field belongs to one slice and "
            "does not state which one. Solve that slice of the volume (--slice, or "
            "grid_of_image(volume, slice=...) in Python), or give an image of that slice only.",
        )
    pixels = image.pixels_in_place.copy()
    for axes in permutations(range(3)):
        reordered = image._replace(pixels=pixels).reordered(axes)
        index = _find_slice(of_slice, reordered)
        if index is not None and reordered.pixels.shape[1:3] == field.shape:
            reordered.pixels[index] = _warp_pixels(field, reordered.pixels[index], order)
            return image._replace(pixels=pixels.reshape(image.pixels.shape))
    raise ProblemError(
        name,
        f"has no slice at the place of the field, which is a slice of {grid_in_words(field.shape)} "
        "pixels. Give an image of the same patient, on the same grid.",
    )


def _find_slice(of_slice: Geometry, image: ImageFile) -> int | None:
    """Return the index, along the first axis of a volume, of the slice on a grid, or None."""
    volume = image.geometry
    assert volume is not None
    number = round(float(volume.to_pixels(of_slice.to_world(np.zeros(3)))[0]))
    is_found = 0 <= number < len(image.pixels) and of_slice.same_as(volume.slice_at(number))
    return number if is_found else None


def _move_landmarks(
    field: FieldFile,
    path: str | os.PathLike[str],
    target: str | os.PathLike[str],
    resample: bool,
) -> Applied:
    file, name, n = read_points(path), Path(path).name, len(field.shape)
    if resample:
        refuse_stored_axes(file, name)
    geometry, points = field.geometry, file.points
    # BigWarp's coordinates are in the unit of the image.
    geometry = geometry if file.unit else geometry.scaled(1 / field.unit_length)
    geometry = geometry_for(file, geometry, name, n)
    # Coordinates from the first voxel of a volume are along the axes of its file, except those of
    # napari, which shows a volume along the axes of the field.
    from_first = file.unit != "mm" and points.shape[1] == 3
    order = (0, 1, 2) if n == 3 and file.unit else field.file_axes
    if from_first:
        points = points[:, order]
    at = geometry.to_pixels(points)
    if from_first and n == 2:
        at[:, 0] -= field.number
    # Points in other slices are unchanged, like the other slices of an image.
    in_slice = np.abs(at[:, :-n]).max(axis=1, initial=0.0) <= _IN_SLICE
    beyond = (at[:, -n:] < -0.5) | (at[:, -n:] > np.array(field.shape) - 0.5)
    outside = np.count_nonzero(in_slice & beyond.any(axis=1))
    at[in_slice, -n:] += field.field.at(at[in_slice, -n:]) / field.spacing
    elsewhere = np.count_nonzero(~in_slice)
    notes = [f"{elsewhere} of {len(at)} points are in other slices, so they were not moved"] * bool(
        elsewhere
    )
    if outside:
        notes.append(
            f"{outside} of {len(at)} points are outside the image, so they were moved like its edge"
        )
    if from_first and n == 2:
        at[:, 0] += field.number
    moved = geometry.to_world(at)
    if from_first:
        moved = moved[:, np.argsort(order)]
    written = write_points(target, moved, file.targets, names=file.names, sd=file.sd)
    return Applied(written, "; ".join(notes))
