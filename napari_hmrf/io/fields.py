"""Displacement fields in files of other tools: NIfTI, MetaImage, NRRD, and ITK's HDF5.

All of them follow ITK's convention: at each point P of the moved image, the vector u(P) leads back
to P + u(P), the original position of the tissue seen at P. Vectors are in millimetres along the
physical axes left, posterior, superior (LPS), not along the axes of the image. ITK's tools assume
no motion outside the grid of a field.

SimpleITK, in the extra ``medical``, reads and writes the files.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, require_flag, require_kind, shown
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import ArgumentError, FileFormatError, ProblemError
from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.units import SAME_SPACING, UNKNOWN_UNITS, has_same_spacing, unit_factor
from napari_hmrf.field.warp import as_field
from napari_hmrf.io.itk_files import (
    ItkImage,
    Unreadable,
    encode,
    holds_vectors,
    read_itk_vectors,
    require_simpleitk,
)
from napari_hmrf.solver.problem import as_numbers, grid_in_words
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.study import Grid

#: Endings of the files that a field can be written to.
FIELD_SUFFIXES = (".nii.gz", ".nii", ".mha", ".nrrd", ".h5")
#: Slicer's key for the direction of a field, and its values for backward and forward.
_SLICER, _BACKWARD, _FORWARD = "displacement field type", "resampling", "modeling"
#: Name of NIfTI's free text, which replaces such keys, as ITK writes and as ITK reads it.
_NOTES, _DESCRIPTION = "ITK_FileNotes", "descrip"
_NIFTI = (".nii", ".nii.gz")
#: Format without such metadata: all tools assume that it holds a backward field.
_NO_METADATA = ".h5"
#: Largest distance of corresponding corners of equal grids, in pixels, which files round.
_SAME_PLACE = 0.05
#: Largest deviation of a direction matrix from a rotation.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Field:
    """A displacement field and the place of its grid.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float64
        Material displacement: tissue at X moves to X + d(X). Components in the order of the axes,
        in mm along them. A field that the file stores backward is inverted on first access.
    residual : float
        Largest deviation, in pixels, of `displacement` from the exact inverse of the stored field;
        0 if the file stores the forward field.
    spacing : tuple of float, shape (n,)
        Size of a pixel along each axis, in mm; [z,] y, x.
    field : DisplacementField
        The field as stored, in either direction; it can be evaluated at points.
    origin : tuple of float, shape (n,)
        Middle of the first pixel, in mm, in ITK's convention: x, y[, z] in LPS.
    direction : ndarray, shape (n, n)
        In ITK's convention: the columns are the directions of the image's axes x, y[, z].
    """

    field: DisplacementField
    origin: tuple[float, ...]
    direction: npt.NDArray[np.float64]

    def __repr__(self) -> str:
        sizes = f"{grid_in_words(self.field.vectors.shape[:-1])} sites"
        return f"Field({sizes} of {grid_in_words(self.spacing)} mm)"

    @property
    def displacement(self) -> npt.NDArray[np.float64]:
        """Material displacement at every site; a backward field is inverted on first access."""
        return self.field.displacement.astype(np.float64, copy=False)

    @property
    def spacing(self) -> tuple[float, ...]:
        """Size of a pixel along each axis, in mm; [z,] y, x."""
        return tuple(self.field.spacing)

    @property
    def residual(self) -> float:
        """Largest deviation, in pixels, of `displacement` from the inverse of the stored field."""
        return self.field.residual


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
    """Write a displacement field that ITK, SimpleITK, ANTs, elastix and Slicer read.

    A field of one slice with three spacings lies in a volume. As NIfTI it is written as three equal
    slices, because no tool reads a NIfTI field of one slice correctly; the other formats hold the
    single slice.

    Parameters
    ----------
    path : str or path-like
        Ends in one of `FIELD_SUFFIXES`. An earlier file stays until the new one is complete. The
        file carries a digest, by which `read_field` detects damage; other tools skip it.
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement: tissue at X moves to X + d(X). Components in the order of the axes,
        in mm along them, as in `Solution.displacement`.
    spacing : sequence of float, shape (n,), or of 3 for a slice of a volume
        Size of a pixel in mm; [z,] y, x.
    origin : sequence of float, optional
        Middle of the first pixel, in mm, in ITK's convention: x, y[, z] in LPS. By default 0.
    direction : array_like, shape (n, n), optional
        Directions of the image's axes as columns, in ITK's convention. By default the identity.
    forward : bool
        True to write the forward field, which maps old positions of tissue to new ones and moves
        points. By default the backward field is written, which moves images.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the moving tissue for the inversion, such as `Solution.tissue`.

    Returns
    -------
    float
        Largest deviation, in pixels, of the written inverse from an exact inverse; 0 if `forward`.

    Raises
    ------
    ProblemError
        Naming the invalid input.
    FileFormatError
        If the name has no ending of a field file; or for a forward field as .h5, which cannot store
        the direction, so that other tools would read it as a backward field.
    HmrfError
        If SimpleITK is not installed.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_path(path))
    suffix = next((each for each in FIELD_SUFFIXES if target.name.lower().endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{target.name}: fields are not written in such a format. End the name in one of "
            f"{', '.join(FIELD_SUFFIXES)}."
        )
    if forward and suffix == _NO_METADATA:
        raise FileFormatError(
            f"{target.name}: this format does not store the direction of a field, so a forward "
            "field would be read as a backward one. End the name in .mha, .nrrd or .nii.gz."
        )
    _refuse_ambiguous_name(target, suffix)
    require_flag("forward", forward)
    require_simpleitk()
    d = as_field(displacement).astype(np.float64)
    n = d.shape[-1]
    if not np.isfinite(d).all():
        raise ProblemError("displacement", "holds NaN or infinite values. Replace those vectors.")
    size = _lengths("spacing", spacing, (n, 3))
    if not (size > 0).all():
        raise ProblemError("spacing", f"is {shown(tuple(spacing))}. Give lengths above 0.")
    back, residual = d, 0.0
    if not forward:
        back, residual = inverse_displacement(d, spacing=tuple(size[-n:]), tissue=tissue)
    if len(size) > n:  # a slice in a volume: no motion along the third axis
        back = np.concatenate([np.zeros((*back.shape[:-1], 1)), back], axis=-1)[np.newaxis]
    start = np.zeros(len(size)) if origin is None else _lengths("origin", origin, (len(size),))
    turn = np.eye(len(size)) if direction is None else check_rotation(direction, len(size))
    if suffix in _NIFTI and len(back) == 1 and len(size) == 3:
        back = np.repeat(back, 3, axis=0)
        start = start - turn[:, 2] * size[0]
    field_type = _FORWARD if forward else _BACKWARD
    metadata = {_NOTES: f"{_SLICER}: {field_type}"} if suffix in _NIFTI else {_SLICER: field_type}
    image = ItkImage(
        back[..., ::-1] @ turn.T,
        len(size),
        tuple(size[::-1].tolist()),
        tuple(start.tolist()),
        turn,
        {} if suffix == _NO_METADATA else metadata,
    )
    content = encode(target, image, suffix, transform=suffix == _NO_METADATA, sealed=True)
    write_whole(target, content)
    return residual


def read_field(path: str | os.PathLike[str], *, forward: bool = False) -> Field:
    """Read a displacement field that this package, ITK, ANTs or elastix wrote.

    Parameters
    ----------
    path : str or path-like
        An image of vectors (.nii.gz, .mha, .mhd, .nrrd), or an ITK transform that holds a field.
    forward : bool
        True if the file stores the forward field. By default it is read as a backward field, as
        registration tools write it, and is inverted. A direction stored in the file, as by
        `write_field` and in Slicer's .nrrd, takes precedence.

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
    field_type = _stated_type(image.metadata) or (_FORWARD if forward else _BACKWARD)
    n, vectors = image.ndim, image.pixels
    if n not in (2, 3) or image.components != n:
        raise FileFormatError(
            f"{source.name}: not a displacement field: {n} axes need {n} numbers per pixel, but "
            f"the file has {image.components}. Give a field, a study or a saved result."
        )
    if vectors.dtype != np.float32:
        vectors = vectors.astype(np.float64)
    if not np.isfinite(vectors).all():
        raise FileFormatError(f"{source.name}: the field holds NaN or infinite values.")
    along = (vectors @ image.direction.astype(vectors.dtype))[..., ::-1]
    field = DisplacementField(along, image.spacing[::-1], back=field_type != _FORWARD)
    return Field(field, image.origin, image.direction)


def is_field_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file holds a displacement field.

    Also True for a damaged file, so that `read_field` reports the error; False if SimpleITK is not
    installed.
    """
    source = Path(path)
    if not source.name.lower().endswith((*FIELD_SUFFIXES, ".mhd")) or not source.is_file():
        return False
    return holds_vectors(source)


class Place(NamedTuple):
    """Place of a grid in ITK's convention: in mm, or in pixels if no unit is known.

    Attributes
    ----------
    spacing : tuple of float, shape (n,)
        Size of a pixel along each axis; [z,] y, x.
    origin : tuple of float, shape (n,)
        Middle of the first pixel; x, y[, z] in LPS.
    direction : ndarray, shape (n, n)
        Its columns are the directions of the image's axes x, y[, z].
    """

    spacing: tuple[float, ...]
    origin: tuple[float, ...]
    direction: npt.NDArray[np.float64]

    def to_pixels(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Convert points (N, n) in mm, ([z,] y, x) in the patient, to pixels of the grid."""
        offsets: npt.NDArray[np.float64] = points - self.origin[::-1]
        return offsets @ self.direction[::-1, ::-1] / self.spacing

    def to_space(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Convert pixels of the grid to points in mm; the inverse of `to_pixels`."""
        offsets: npt.NDArray[np.float64] = (pixels * self.spacing) @ self.direction[::-1, ::-1].T
        return offsets + self.origin[::-1]

    def frame(self, number: int = 0, unit: str = "millimeter", *, volume: bool = False) -> Frame:
        """Return the place as a frame of layers; inverts `place_of`.

        Parameters
        ----------
        number : int
            Number of the slice of a volume.
        unit : str
        volume : bool
            True for the frame of a whole volume.
        """
        n = len(self.spacing)
        turn = np.eye(n + 1)
        turn[:n, :n], turn[:n, n] = self.direction[::-1, ::-1], self.origin[::-1]
        return Frame.at(
            self.spacing,
            (unit,) * n,
            index=(number, *(0,) * (n - 1)) if n > 2 else None,
            affine=turn,
            axis_labels=tuple(PATIENT_AXES) if n == 3 else ("y", "x"),
            volume=volume,
        )


def place_of(solution: Solution) -> Place:
    """Return the place of a solution; for a slice of a volume, its place in the volume.

    The world of its layers is assumed to be the patient: the axes z, y, x run towards superior,
    posterior and left, as in the medical files that this package opens.

    Raises
    ------
    ProblemError
        If the pixels are not rectangular, or the axes have no unit of length in common.
    """
    frame = solution.frame or {}
    if "matrix" not in frame:
        n = solution.tissue.ndim
        return Place(solution.spacing, (0.0,) * n, np.eye(n))
    matrix, plane = np.array(frame["matrix"]), list(frame["plane"])
    # Millimetres per unit of each world axis: 1 for pixels, 0 if the unit is no length.
    mm = [1.0 if unit == "pixel" else unit_factor(unit, "millimeter") for unit in frame["units"]]
    sizes = np.nan_to_num(mm)
    others = [axis for axis in np.flatnonzero(sizes).tolist() if axis not in plane]
    axes = plane if len(plane) == 3 else [*others[-1:], *plane]
    if not sizes[axes].all():
        units = ", ".join(str(unit) for unit in frame["units"])
        raise ProblemError(
            "displacement", f"is measured in {units}. Give the image a unit of length, such as mm."
        )
    # Rows: axes of the world, z first. Columns: axes of the image.
    world = sorted(axes)
    steps = matrix[np.ix_(world, axes)] * sizes[world][:, None]
    first = (matrix @ [*frame["index"], 1.0])[world] * sizes[world]
    spacing = np.linalg.norm(steps, axis=0)
    turn = (steps / spacing)[::-1, ::-1]
    return Place(
        tuple(spacing.tolist()), tuple(first[::-1].tolist()), check_rotation(turn, len(axes))
    )


def placed(solution: Solution) -> tuple[npt.NDArray[np.floating], Place]:
    """Return the displacement of a solution in the unit of its place, and the place.

    Raises
    ------
    ProblemError
        As for `place_of`, or if the place contradicts the spacing or the unit of the solution.
    """
    place, n = place_of(solution), solution.tissue.ndim
    factors = np.array(place.spacing[-n:]) / solution.spacing
    is_known = solution.unit not in UNKNOWN_UNITS
    expected = unit_factor(solution.unit, "millimeter") if is_known else factors[0]
    if solution.frame and not np.allclose(factors, expected, rtol=SAME_SPACING, atol=0):
        raise ProblemError(
            "displacement",
            f"has pixels of {grid_in_words(solution.spacing)} {solution.unit}".rstrip()
            + f", but its place has pixels of {grid_in_words(place.spacing[-n:])} mm. Solve on the "
            "grid of the image.",
        )
    return solution.displacement * factors, place


def export_field(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    forward: bool = False,
    grid: Grid | None = None,
    placed: bool = True,
) -> float:
    """Write a solution's field for other tools, at the place of its image.

    Parameters
    ----------
    path, forward
        As for `write_field`.
    solution : Solution
    grid : Grid, optional
        Grid of the image, as returned by `Grid.from_image`; needed if the solution has no place,
        because it comes from a `Problem`, or from a study whose grid has no place.
    placed : bool
        If False, a solution without a place is written at the origin, along the axes, with its
        spacing converted to mm; an unknown unit counts as 1 mm. Other tools place a picture (.png,
        .tif) in the same way.

    Returns
    -------
    float
        As for `write_field`.

    Raises
    ------
    ArgumentError
        If `solution` is not a Solution, or `grid` is not a Grid.
    ProblemError
        If the place is unknown, or the format of the file cannot hold it; or if the grid has
        another shape, spacing or place than the solution.
    HmrfError, OSError
        As for `write_field`.
    """
    if isinstance(solution, np.ndarray):
        raise ArgumentError(
            "solution is an array. Give a Solution, or write an array with write_field(path, "
            "displacement, spacing=...)."
        )
    require_kind(Solution, "solution", solution, "the result of solve()")
    require_flag("placed", placed)
    if grid is not None:
        require_kind(Grid, "grid", grid, "Grid.from_image(image)")
    displacement, place = _place_solution(solution, grid, placed)
    return write_field(
        path,
        displacement,
        **place._asdict(),
        forward=forward,
        tissue=solution.tissue,
    )


def _not_a_field(source: Path, error: Unreadable) -> str:
    """Return the message for a file without a readable field, with the reason if known."""
    reason = f": {error}" if str(error) else ""
    return f"{source.name}: not a displacement field that can be read{reason}."


def _place_solution(
    solution: Solution, grid: Grid | None, placed_only: bool
) -> tuple[npt.NDArray[np.floating], Place]:
    """Return the displacement and place of a solution, placed by a grid if it has no place."""
    if grid is not None:
        if grid.shape != solution.tissue.shape:
            raise ProblemError(
                "grid",
                f"is {grid_in_words(grid.shape)}, but the field is "
                f"{grid_in_words(solution.tissue.shape)}. Give the grid of its image.",
            )
        if not has_same_spacing(solution.spacing, solution.unit, grid.spacing, grid.unit):
            sizes = f"{grid_in_words(solution.spacing)} {solution.unit}".rstrip()
            raise ProblemError(
                "grid",
                f"has pixels of {grid_in_words(grid.spacing)} {grid.unit}, but the field has "
                f"pixels of {sizes}. Solve on the grid of the image.",
            )
        if grid.place is not None:
            on_grid = replace(solution, frame=grid.place.as_dict())
            shape = solution.tissue.shape
            if solution.frame and not _is_at(place_of(solution), place_of(on_grid), shape):
                raise ProblemError(
                    "grid",
                    "lies elsewhere than the field, which has a place. Leave grid out, or solve "
                    "on this grid.",
                )
            solution = on_grid
        elif placed_only and not solution.frame:
            raise ProblemError(
                "grid",
                "has no place, because a picture (.png, .tif) has none. Give the grid of a medical "
                "image, or placed=False to place the field at the origin.",
            )
    if placed_only and not solution.frame:
        raise ProblemError(
            "displacement",
            "has no place, because the place of its image is unknown. Make the study with "
            "Grid.from_image(image), or give that grid here as grid=. For a picture (.png, .tif), "
            "which has no place, give placed=False to place the field at the origin.",
        )
    displacement, place = placed(solution)
    if solution.frame or solution.unit in UNKNOWN_UNITS:
        return displacement, place
    factor = unit_factor(solution.unit, "millimeter")
    if not np.isfinite(factor):
        raise ProblemError(
            "displacement",
            f"is in {shown(solution.unit)}, which is no unit of length. Give the grid of the study "
            'a unit of length, such as "mm".',
        )
    in_mm = tuple(size * factor for size in place.spacing)
    return displacement * factor, place._replace(spacing=in_mm)


def _is_at(one: Place, other: Place, shape: tuple[int, ...]) -> bool:
    """Return whether the corners of a grid are at the same points in both places."""
    n = len(one.spacing)
    if len(other.spacing) != n:
        return False
    corners = np.zeros((2 ** len(shape), n))
    corners[:, -len(shape) :] = [*product(*((0, size - 1) for size in shape))]
    return bool(np.abs(one.to_pixels(other.to_space(corners)) - corners).max() <= _SAME_PLACE)


def _stated_type(metadata: Mapping[str, str]) -> str:
    """Return the type of a field (backward or forward) stated by its metadata; "" if none."""
    if _SLICER in metadata:
        return metadata[_SLICER].strip()
    key, _, field_type = metadata.get(_DESCRIPTION, "").partition(":")
    return field_type.strip() if key == _SLICER else ""


def _refuse_ambiguous_name(target: Path, suffix: str) -> None:
    """Refuse a name for which ITK's NIfTI reader would read the vectors of another file."""
    other = {".nii": ".nii.gz", ".nii.gz": ".nii"}.get(suffix)
    if other is None:
        return
    twin = target.with_name(target.name[: -len(suffix)] + other)
    if twin.exists():
        raise FileFormatError(
            f"{target.name}: {twin.name} is in the same folder, and ITK's tools would read one "
            "instead of the other. Choose another name, or remove that file."
        )


def _lengths(name: str, values: Sequence[float], counts: tuple[int, ...]) -> npt.NDArray[Any]:
    given = as_numbers(name, values).astype(np.float64)
    if given.ndim != 1 or len(given) not in counts or not np.isfinite(given).all():
        needed = " or ".join(map(str, sorted({*counts})))
        raise ProblemError(name, f"is {shown(values)}. Give {needed} lengths.")
    return given


def check_rotation(direction: npt.ArrayLike, n: int) -> npt.NDArray[np.float64]:
    """Return the directions of n axes as a matrix; refuse a matrix that is not orthogonal."""
    turn = as_numbers("direction", direction).astype(np.float64)
    turn = turn.reshape(n, n) if turn.size == n * n else turn
    if turn.shape != (n, n) or not np.allclose(turn @ turn.T, np.eye(n), atol=_ROUNDING):
        raise ProblemError(
            "direction",
            f"is {shown(direction)}. Give {n} x {n} numbers whose columns are the directions of "
            "the image's axes, at right angles and of length 1.",
        )
    return turn
