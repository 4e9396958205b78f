"""Displacement fields in the file formats of other tools: NIfTI, MetaImage, NRRD and ITK's HDF5.

All formats use ITK's convention for backward fields: the tissue at point P of the deformed image
was originally at P + u(P), where u is the stored field. The vectors are in millimetres along the
physical axes left, posterior, superior (LPS), not along the axes of the image. ITK's tools assume
that u is zero outside the grid of the field.

The files are read and written by nibabel and SimpleITK, which the extra ``medical`` installs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, require_flag, require_kind, shown
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import ArgumentError, FileFormatError, ProblemError
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.units import UNKNOWN_UNITS, has_same_spacing, is_length, unit_factor
from napari_hmrf.field.warp import as_field
from napari_hmrf.geometry import Geometry, is_orthogonal
from napari_hmrf.io.decoded import Decoded, Unreadable
from napari_hmrf.io.itk_files import (
    encode,
    holds_vectors,
    read_itk_vectors,
    require_simpleitk,
)
from napari_hmrf.real_arrays import as_numbers, grid_in_words
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.study import Grid

#: Suffixes of the file formats to which a field can be written.
FIELD_SUFFIXES = (".nii.gz", ".nii", ".mha", ".nrrd", ".h5")
#: Metadata key of 3D Slicer for the direction of a field, and its values for backward and forward.
_SLICER, _BACKWARD, _FORWARD = "displacement field type", "resampling", "modeling"
#: ITK's metadata keys for the free text of a NIfTI header, when writing and when reading. The text
#: stores the direction, because NIfTI has no other metadata.
_NOTES, _DESCRIPTION = "ITK_FileNotes", "descrip"
_NIFTI = (".nii", ".nii.gz")
#: Suffix of the format without metadata; all tools assume that it contains a backward field.
_NO_METADATA = ".h5"


def write_field(
    path: str | os.PathLike[str],
    displacement: npt.ArrayLike,
    *,
    spacing: Sequence[float],
    origin: Sequence[float] | None = None,
    direction: npt.ArrayLike | None = None,
    forward: bool = False,
    tissue: npt.ArrayLike | None = None,
) -> float:
    """Write a displacement field for ITK, SimpleITK, ANTs, elastix and 3D Slicer.

    A 2-D field with three spacings is a slice of a volume. In NIfTI files, it is written as three
    identical slices, because no tool reads a NIfTI field of a single slice correctly. In files of
    other formats, it is written as a single slice.

    Parameters
    ----------
    path : str or path-like
        Path with one of the suffixes in `FIELD_SUFFIXES`. An existing file is replaced when the new
        file is complete.
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement d, in mm: tissue at X moves to X + d(X). The components are along the
        axes of the image, in the same order, as in `Solution.displacement`.
    spacing : sequence of float, shape (n,), or (3,) for a slice of a volume
        Pixel size along each axis, in mm, in the order [z,] y, x.
    origin : sequence of float, optional
        Centre of the first pixel, in mm, in ITK's convention: x, y[, z] in LPS. By default, zeros.
    direction : array_like, shape (n, n), optional
        Direction matrix in ITK's convention: its columns are the directions of the image axes
        x, y[, z]. By default, the identity matrix.
    forward : bool
        If True, write the forward field, which maps original to new positions and is used to move
        points. By default, the backward field is written, which is used to warp images.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the deformable tissue for the inversion, such as `Solution.tissue`.

    Returns
    -------
    float
        Largest error of the written field as an inverse, in pixels; 0 if `forward` is True.

    Raises
    ------
    ProblemError
        If an argument is invalid; the message names the argument.
    FileFormatError
        If the suffix is not in `FIELD_SUFFIXES`; or if a forward field is written as .h5, which
        cannot store the direction.
    HmrfError
        If SimpleITK is not installed.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_path(path))
    suffix = _suffix_of(target)
    if forward and suffix == _NO_METADATA:
        raise FileFormatError(
            f"{target.name}: this format does not store the direction of a field, so a forward "
            "field would be read as a backward field. Use .mha, .nrrd or .nii.gz."
        )
    _refuse_ambiguous_name(target, suffix)
    require_flag("forward", forward)
    require_simpleitk()
    d, geometry = _checked_field(displacement, spacing, origin, direction)
    back, residual = d, 0.0
    if not forward:
        size = geometry.spacing[-d.shape[-1] :]
        back, residual = inverse_displacement(d, spacing=size, tissue=tissue)
    _write_vectors(target, suffix, back, geometry, forward=forward)
    return residual


def write_mapping(
    path: str | os.PathLike[str],
    displacement: npt.ArrayLike,
    *,
    spacing: Sequence[float],
    origin: Sequence[float] | None = None,
    direction: npt.ArrayLike | None = None,
) -> None:
    """Write the displacement from each position of an image to the same tissue in another image.

    ITK, SimpleITK and ANTs resample the other image to the grid of this image with the file, as
    with the field of any registration. `read_field` reads it as a backward field.

    Parameters
    ----------
    path, spacing, origin, direction
        As for `write_field`.
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Displacement in mm, along the axes of the image.

    Raises
    ------
    ProblemError, FileFormatError, HmrfError, OSError
        As for `write_field`.
    """
    target = Path(checked_path(path))
    suffix = _suffix_of(target)
    _refuse_ambiguous_name(target, suffix)
    require_simpleitk()
    vectors, geometry = _checked_field(displacement, spacing, origin, direction)
    _write_vectors(target, suffix, vectors, geometry, forward=False)


def _suffix_of(target: Path) -> str:
    suffix = next((each for each in FIELD_SUFFIXES if target.name.lower().endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{target.name}: fields cannot be written in this format. Use one of the suffixes "
            f"{', '.join(FIELD_SUFFIXES)}."
        )
    return suffix


def _checked_field(
    displacement: npt.ArrayLike,
    spacing: Sequence[float],
    origin: Sequence[float] | None,
    direction: npt.ArrayLike | None,
) -> tuple[npt.NDArray[np.float64], Geometry]:
    """Return a finite displacement, and its grid."""
    d = as_field(displacement).astype(np.float64)
    if not np.isfinite(d).all():
        raise ProblemError(
            "displacement", "contains NaN or infinite values. Replace these vectors."
        )
    size = _lengths("spacing", spacing, (d.shape[-1], 3))
    if not (size > 0).all():
        raise ProblemError("spacing", f"is {shown(tuple(spacing))}. Pass positive lengths.")
    n = len(size)
    start = np.zeros(n) if origin is None else _lengths("origin", origin, (n,))
    turn = np.eye(n) if direction is None else check_rotation(direction, n)
    shape = (1,) * (n - d.shape[-1]) + d.shape[:-1]
    return d, Geometry.of_itk(shape, size.tolist(), start.tolist(), turn)


def _write_vectors(
    target: Path,
    suffix: str,
    back: npt.NDArray[np.float64],
    geometry: Geometry,
    *,
    forward: bool,
) -> None:
    """Write vectors along the axes of an image as vectors along the physical axes."""
    n = geometry.ndim
    if n > back.shape[-1]:  # a slice of a volume does not move perpendicular to the slice
        back = np.concatenate([np.zeros((*back.shape[:-1], 1)), back], axis=-1)[np.newaxis]
    if suffix in _NIFTI and len(back) == 1 and n == 3:
        back = np.repeat(back, 3, axis=0)
        geometry = replace(geometry.slice_at(-1), shape=back.shape[:n])
    field_type = _FORWARD if forward else _BACKWARD
    metadata = {_NOTES: f"{_SLICER}: {field_type}"} if suffix in _NIFTI else {_SLICER: field_type}
    along_world = back[..., ::-1] @ geometry.direction.T
    image = Decoded(along_world, n, geometry, {} if suffix == _NO_METADATA else metadata)
    content = encode(target, image, suffix, transform=suffix == _NO_METADATA)
    write_whole(target, content)


def read_field(path: str | os.PathLike[str], *, forward: bool = False) -> Field:
    """Read a displacement field written by this package, ITK, ANTs or elastix.

    Parameters
    ----------
    path : str or path-like
        Image of vectors (.nii.gz, .mha, .mhd, .nrrd), or ITK transform that contains a field.
    forward : bool
        True if the file contains a forward field. By default, the field is assumed to be a backward
        field, as written by registration tools. If the file states the direction, as files of
        `write_field` and 3D Slicer do, this argument is ignored.

    Returns
    -------
    Field

    Raises
    ------
    FileFormatError
        If the file is not a displacement field, or is damaged.
    HmrfError
        If SimpleITK is not installed.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    try:
        image = read_itk_vectors(source)
    except Unreadable as error:
        raise FileFormatError(_not_a_field(source, error)) from None
    try:
        geometry = image.geometry.right_angled()
    except ValueError as error:
        raise FileFormatError(
            f"{_not_a_field(source, error)} Compute the field on a grid at right angles."
        ) from None
    field_type = _stated_type(image.metadata) or (_FORWARD if forward else _BACKWARD)
    n, vectors = image.ndim, image.pixels
    if n == 4 and image.components == 1:
        raise FileFormatError(
            f"{source.name}: not a displacement field: it has 4 axes, as fields of FSL, whose "
            "vectors are not in patient coordinates. Convert it for ITK, for example with "
            "wb_command -convert-warpfield."
        )
    if n not in (2, 3) or image.components != n:
        raise FileFormatError(
            f"{source.name}: not a displacement field: {n} axes require {n} numbers per pixel, but "
            f"the file has {image.components}. Give a field, a study or a saved result."
        )
    if vectors.dtype != np.float32:
        vectors = vectors.astype(np.float64)
    if not np.isfinite(vectors).all():
        raise FileFormatError(f"{source.name}: the field contains NaN or infinite values.")
    along = (vectors @ geometry.direction.astype(vectors.dtype))[..., ::-1]
    return Field(along, geometry, back=field_type != _FORWARD)


def is_field_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file contains a displacement field.

    Only the header of the file is read. The result is False if the package that reads it is not
    installed.
    """
    source = Path(path)
    if not source.name.lower().endswith((*FIELD_SUFFIXES, ".mhd")) or not source.is_file():
        return False
    return holds_vectors(source)


def geometry_of(solution: Solution) -> Geometry:
    """Return the grid of a solution; for a slice of a volume, as a volume of one slice.

    Raises
    ------
    ProblemError
        If the pixels are not rectangular, or the unit of an axis is not a unit of length.
    """
    if not solution.frame:
        factor = unit_factor(solution.unit, "millimeter")
        geometry = Geometry.at_origin(solution.tissue.shape, solution.spacing)
        return replace(geometry.scaled(factor), unit="mm") if np.isfinite(factor) else geometry
    geometry = solution.place.geometry(solution.tissue.shape)
    check_rotation(geometry.direction, geometry.ndim)
    return geometry


def placed(solution: Solution) -> tuple[npt.NDArray[np.floating], Geometry]:
    """Return the displacement of a solution in the unit of its geometry, and the geometry.

    Raises
    ------
    ProblemError
        As for `geometry_of`; or if the frame of the solution is inconsistent with its spacing or
        its unit.
    """
    geometry, shape = geometry_of(solution), solution.tissue.shape
    sizes = geometry.spacing[-len(shape) :]
    # A solution without a unit has that of its frame.
    unit = solution.place.unit if solution.unit in UNKNOWN_UNITS else solution.unit
    if solution.frame and not has_same_spacing(shape, solution.spacing, unit, sizes, geometry.unit):
        raise ProblemError(
            "displacement",
            f"has pixels of {grid_in_words(solution.spacing)} {solution.unit}".rstrip()
            + f", but its place has pixels of {grid_in_words(sizes)} mm. Solve on the grid of the "
            "image.",
        )
    return solution.displacement * (np.array(sizes) / solution.spacing), geometry


def export_field(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    forward: bool = False,
    grid: Grid | None = None,
    placed: bool = True,
) -> float:
    """Write the displacement field of a solution for other tools, at the place of its image.

    Parameters
    ----------
    path, forward
        As for `write_field`.
    solution : Solution
    grid : Grid, optional
        Grid of the image, as returned by `grid_of_image`. Required if the solution has no place,
        as is the case for solutions of a `Problem`, or of a study whose grid has no place.
    placed : bool
        If False, a solution without a place is written at the origin, aligned with the axes, and
        its spacing is converted to mm (an unknown unit is assumed to be mm). Other tools treat
        pictures (.png, .tif) in the same way.

    Returns
    -------
    float
        As for `write_field`.

    Raises
    ------
    ArgumentError
        If `solution` is not a Solution, or `grid` is not a Grid.
    ProblemError
        If the place is unknown or cannot be stored in the file, or if the shape, spacing or place
        of the grid differs from that of the solution.
    HmrfError, OSError
        As for `write_field`.
    """
    if isinstance(solution, np.ndarray):
        raise ArgumentError(
            "solution is an array. Pass a Solution, or write an array with write_field(path, "
            "displacement, spacing=...)."
        )
    require_kind(Solution, "solution", solution, "the result of solve()")
    require_flag("placed", placed)
    if grid is not None:
        require_kind(Grid, "grid", grid, "grid_of_image(image)")
    displacement, geometry = place_solution(solution, grid, placed)
    return write_field(
        path,
        displacement,
        **geometry.as_itk,
        forward=forward,
        tissue=solution.tissue,
    )


def _not_a_field(source: Path, error: Exception) -> str:
    """Return the error message for a file without a readable field, with the reason if known."""
    reason = f": {error}" if str(error) else ""
    return f"{source.name}: not a displacement field that can be read{reason}."


def place_solution(
    solution: Solution, grid: Grid | None, placed_only: bool
) -> tuple[npt.NDArray[np.floating], Geometry]:
    """Return the displacement of a solution in mm, and its geometry, or that of a grid.

    Parameters
    ----------
    solution : Solution
    grid : Grid or None
        Grid of the image.
    placed_only : bool
        If True, a solution without a place raises an error.

    Raises
    ------
    ProblemError
        As for `export_field`.
    """
    if grid is not None:
        grid.require_grid_of(solution, "Pass the grid of its image.")
        if grid.place is not None:
            solution = replace(solution, frame=grid.place.as_dict())
        elif placed_only and not solution.frame:
            raise ProblemError(
                "grid",
                "has no position in world coordinates, as is the case for pictures (.png, .tif). "
                "Pass the grid of a medical image, or placed=False to write the field at the "
                "origin.",
            )
    if placed_only and not solution.frame:
        raise ProblemError(
            "displacement",
            "has no position in world coordinates, because the position of its image is unknown. "
            "Create the study with grid_of_image(image), or pass this grid as grid=. For "
            "pictures (.png, .tif), which have no position, pass placed=False to write the field "
            "at the origin.",
        )
    if not solution.frame and not is_length(solution.unit):
        raise ProblemError(
            "displacement",
            f"is in {shown(solution.unit)}, which is not a unit of length. Set the unit of the "
            'study\'s grid to a unit of length, such as "mm".',
        )
    return placed(solution)


def _stated_type(metadata: Mapping[str, str]) -> str:
    """Return the direction stated in the metadata of a field, as Slicer's value, or ""."""
    if _SLICER in metadata:
        return metadata[_SLICER].strip()
    key, _, field_type = metadata.get(_DESCRIPTION, "").partition(":")
    return field_type.strip() if key == _SLICER else ""


def _refuse_ambiguous_name(target: Path, suffix: str) -> None:
    """Raise an error if ITK's NIfTI reader could confuse the file with an existing file."""
    other = {".nii": ".nii.gz", ".nii.gz": ".nii"}.get(suffix)
    if other is None:
        return
    twin = target.with_name(target.name[: -len(suffix)] + other)
    if twin.exists():
        raise FileFormatError(
            f"{target.name}: {twin.name} is in the same folder, and ITK's tools would confuse the "
            f"two files. Choose another name, or remove {twin.name}."
        )


def _lengths(name: str, values: Sequence[float], counts: tuple[int, ...]) -> npt.NDArray[Any]:
    given = as_numbers(name, values).astype(np.float64)
    if given.ndim != 1 or len(given) not in counts or not np.isfinite(given).all():
        needed = " or ".join(map(str, sorted({*counts})))
        raise ProblemError(name, f"is {shown(values)}. Pass {needed} lengths.")
    return given


def check_rotation(direction: npt.ArrayLike, n: int) -> npt.NDArray[np.float64]:
    """Return a direction matrix as an (n, n) array; raise an error if it is not orthogonal."""
    turn = as_numbers("direction", direction).astype(np.float64)
    turn = turn.reshape(n, n) if turn.size == n * n else turn
    if turn.shape != (n, n) or not is_orthogonal(turn):
        raise ProblemError(
            "direction",
            f"is {shown(direction)}. Pass an orthogonal {n} x {n} matrix, with the directions of "
            "the image axes as its columns.",
        )
    return turn
