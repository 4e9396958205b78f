"""A case in files: a study, or an image with its tissue and how it moves; solved into a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import HmrfError, ProblemError
from napari_hmrf.field.brightness import at_edges
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.measurement import Measurement, measure
from napari_hmrf.field.observation import PixelField
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import warp
from napari_hmrf.io.apply import load_field, place_for
from napari_hmrf.io.fields import Place, place_of
from napari_hmrf.io.images import ImageFile, load_image, save_image
from napari_hmrf.io.landmark_files import POINT_SUFFIXES, load_points
from napari_hmrf.io.material_tables import load_materials
from napari_hmrf.io.study_file import (
    Saved,
    is_study_file,
    load_solved,
    load_study,
    save_study,
)
from napari_hmrf.io.tables import read_materials, read_rules
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.usual_lengths import usual_radius

#: How far, in voxels, two volumes may lie apart and be the same.
_SAME = 0.01


@dataclass(frozen=True)
class Case:
    """What a command line says of one case.

    Attributes
    ----------
    image : Path
        An image, or a study's file, which needs nothing else.
    labels, materials : Path, optional
        An image of tissue labels and a table of materials, .csv or .json.
    maps : sequence of Path
        Instead of `labels`: how likely each tissue is, an image for each. Where one of them is more
        likely than not, its place in this list, from 1 on, is the label.
    boundary : Path, optional
        How tissue moves: an image of labels with a table of `rules`; pairs of landmarks in a .csv;
        or a displacement field, such as a registration's.
    rules : Path, optional
        A .csv.
    confidence : Path or "edges", optional
        How sure a field is: an image from 0 to 1 or a mask; or 1 at the edges of the image and 0
        elsewhere. By default 1 wherever there is a field.
    slice : int, optional
        Of a volume along its first axis; by default all of a volume is deformed.
    hold_edge : bool
        Whether the outer edge of the tissue stays where it is.
    model : str
    """

    image: Path
    labels: Path | None = None
    materials: Path | None = None
    maps: Sequence[Path] = ()
    boundary: Path | None = None
    rules: Path | None = None
    confidence: Path | Literal["edges"] | None = None
    slice: int | None = None
    hold_edge: bool = False
    model: str = "elastic"


def read_case(case: Case) -> Study:
    """Make a study of files.

    Raises
    ------
    ProblemError
        If images are of different size, or lie in different places, or a volume has no such slice.
    FileFormatError, HmrfError, OSError
        If a file cannot be read, by its name.
    """
    if is_study_file(case.image):
        return load_study(case.image).study
    whole = load_image(case.image)
    image, place = _part(whole, case)
    grid = _grid(image, whole, case)
    materials = () if case.materials is None else _materials(case.materials)
    labels = None if case.labels is None else _pixels(case, case.labels, whole, labels=True)
    if case.maps:
        labels = _most_likely([_pixels(case, each, whole) for each in case.maps])
    motion = replace(_motion(case, grid, place, whole), hold_edge=case.hold_edge)
    return Study(
        grid,
        Tissue(labels=labels, materials=materials),
        motion,
        model=case.model,
        pictures=Pictures(image.pixels, labels, case.image.name.partition(".")[0]),
    )


def solve_case(case: Case, folder: Path, *, backend: str = "auto") -> Saved:
    """Solve a case and write the study with its field, and the image as it is seen after.

    Raises
    ------
    HmrfError, OSError
        As of `read_case`, `solve_study` and `save_study`.
    """
    study = read_case(case)
    solution = solve_study(study, backend=backend)
    folder.mkdir(parents=True, exist_ok=True)
    name = case.image.name.partition(".")[0]
    image = study.pictures.image
    if image is not None:
        moved = warp(image, solution.displacement, spacing=solution.spacing, tissue=solution.tissue)
        where = None if study.grid.unit == "pixel" else place_of(solution)
        written = ImageFile(moved, where, colours=moved.ndim > len(study.grid.shape))
        save_image(folder / f"{name} deformed{'.nrrd' if where else '.tif'}", written)
    save_study(folder / f"{name}.study", study, solution)
    return Saved(study, solution)


class Measured(NamedTuple):
    """What happened to each tissue, in which unit, and whether it has a volume for an area."""

    rows: tuple[Measurement, ...]
    unit: str
    of_volume: bool


def measured(path: Path, labels: Path | None = None) -> Measured:
    """Measure what happened to each tissue of a study or result.

    Parameters
    ----------
    path : Path
    labels : Path, optional
        An image of labels; by default those of the study.

    Raises
    ------
    HmrfError, OSError
        If a file cannot be read; or if it holds no field, or no labels and none are given.
    """
    study, solution = load_solved(path)
    tissue = None if study is None else study.tissue
    names = {} if tissue is None else {row.label: row.name for row in tissue.materials}
    image = None if tissue is None else tissue.labels
    if labels is not None:
        image = _on_grid(labels, solution)
    if image is None:
        raise HmrfError(f"{path.name}: the file holds no tissue labels. Give --labels.")
    unit = unit_symbol(Frame.of_solution(solution).unit)
    return Measured(measure(solution, image, names=names), unit, solution.tissue.ndim == 3)


def image_of(path: Path, image: Path | None = None) -> tuple[Solution, npt.NDArray[Any]]:
    """The field of a study or result, and its image, or another that is given.

    Raises
    ------
    HmrfError, OSError
        If a file cannot be read; or if it holds no field, or no image and none is given.
    """
    study, solution = load_solved(path)
    pixels = None if study is None else study.pictures.image
    if image is not None:
        pixels = _on_grid(image, solution)
    if pixels is None:
        raise HmrfError(f"{path.name}: the image is not in the file. Give --image.")
    return solution, pixels


def _on_grid(path: Path, solution: Solution) -> npt.NDArray[Any]:
    """The pixels of a file; of a volume in the order of the solution's axes."""
    image, volume = load_image(path), solution.tissue.ndim == 3
    return (image.laid_as(place_of(solution)) if volume else image).pixels


def _part(image: ImageFile, case: Case) -> tuple[ImageFile, Place | None]:
    """The slice that is meant, and its place in the volume; or all of a volume, upright."""
    place, number = image.place, case.slice
    if image.ndim == 2:
        return image, place
    if number is None:
        return image.upright, image.upright.place
    count = len(image.pixels)
    if not 0 <= number < count:
        raise ProblemError(
            case.image.name, f"is a volume of {count} slices. Give --slice 0 to {count - 1}."
        )
    if place is not None:
        (first,) = place.to_space(np.array([[number, 0.0, 0.0]]))
        place = place._replace(origin=tuple(first[::-1].tolist()))
    return image._replace(pixels=image.pixels[number]), place


def _grid(part: ImageFile, whole: ImageFile, case: Case) -> Grid:
    """The slice that is meant, which knows its number and the place of the volume; or a volume."""
    n, number = part.ndim, case.slice if whole.ndim > 2 and case.slice is not None else 0
    shape = part.pixels.shape[:n]
    if whole.place is None and n == whole.ndim == 2:
        return Grid(shape, (1.0, 1.0))
    unit, place = "millimeter", part.place
    if place is None:
        unit, place = "pixel", Place((1.0,) * 3, (0.0,) * 3, np.eye(3))
    frame = place.frame(number, unit)
    if n == 3:
        frame = replace(frame, plane=(0, 1, 2))
    return Grid(shape, place.spacing[-n:], unit, frame)


def _materials(path: Path) -> tuple[Material, ...]:
    if path.suffix.lower() == ".csv":
        return read_materials(path)
    return load_materials(path).materials


def _pixels(case: Case, path: Path, whole: ImageFile, labels: bool = False) -> npt.NDArray[Any]:
    """A grey image on the same pixels; of a volume the same slice."""
    there, image = _part(whole, case)[0], load_image(path)
    if there.ndim == 3 and image.place is None:
        image = image._replace(place=whole.place)
    image, _ = _part(image, replace(case, image=path))
    pixels, shape = image.pixels, there.pixels.shape[: there.ndim]
    if pixels.shape != shape:
        raise ProblemError(
            path.name,
            f"is {grid_in_words(pixels.shape)}, but the image {grid_in_words(shape)}. Give one of "
            "the same pixels.",
        )
    if there.ndim == 3 and _apart(image.place, there.place) > _SAME:
        raise ProblemError(path.name, "lies elsewhere than the image. Give one of the same voxels.")
    if labels and pixels.dtype.kind == "f" and (pixels == np.rint(pixels)).all():
        pixels = pixels.astype(np.int32)  # as some tools keep labels
    if labels and pixels.dtype.kind not in "iu":
        raise ProblemError(path.name, f"holds {pixels.dtype} values. Give labels: whole numbers.")
    return pixels


def _apart(one: Place | None, other: Place | None) -> float:
    """How far the voxels of two volumes lie apart, in voxels; 0 if one of them lies nowhere."""
    if one is None or other is None:
        return 0.0
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return float(np.abs(one.to_pixels(other.to_space(corners)) - corners).max())


def _most_likely(maps: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.uint8]:
    """The labels of tissues that are more likely than not; 0 where none is."""
    likely = np.stack(maps).astype(float)
    sure = max(1.0, float(likely.max()))  # 1, 100 or 255, as tools have it
    found = np.where(likely.max(axis=0) > sure / 2, 1 + likely.argmax(axis=0), 0)
    return found.astype(np.uint8)


def _motion(case: Case, grid: Grid, place: Place | None, whole: ImageFile) -> Motion:
    path = case.boundary
    if path is None:
        return Motion()
    if path.name.lower().endswith(POINT_SUFFIXES):
        return Motion(drawing=_landmarks(case, path, grid, whole))
    if case.rules is not None:
        labels = _pixels(case, path, whole, labels=True)
        return Motion(labels=labels, rules=read_rules(case.rules))
    field, counts = load_field(path), _counts(case, whole)
    if len(field.shape) == 3 and grid.place is not None:  # of the volume that the slice lies in
        found = PixelField(field.field.to_pixels(), field.place.frame())
        try:
            there = found.on(grid.place, grid.shape)
        except ProblemError as error:
            raise ProblemError(path.name, error.message) from None
        return Motion(observed=there.displacement, confidence=np.where(there.known, counts, 0))
    if field.shape != grid.shape:
        raise ProblemError(
            path.name,
            f"is {grid_in_words(field.shape)}, but the image {grid_in_words(grid.shape)}. Give a "
            "field on the same pixels, or --rules if it is an image of labels.",
        )
    return Motion(observed=field.displacement, confidence=counts)


def _counts(case: Case, whole: ImageFile) -> npt.NDArray[Any]:
    part, _ = _part(whole, case)
    if case.confidence is None:
        return np.ones(part.pixels.shape[: part.ndim], np.float32)
    if case.confidence == "edges":
        return at_edges(part.pixels, axes=part.ndim)
    counts = _pixels(case, case.confidence, whole).astype(np.float32)
    return counts / counts.max() if counts.max() > 1 else counts


def _landmarks(case: Case, path: Path, grid: Grid, whole: ImageFile) -> Drawing:
    file, n = load_points(path), len(grid.shape)
    if file.targets is None:
        raise ProblemError(
            path.name, "says where things are, not where they should be. Give pairs, as BigWarp."
        )
    _, place = _part(whole, case)
    # Points of BigWarp's are in the order of the file's axes, which are turned upright afterwards.
    first = whole.place if n == 3 else place
    where = place_for(file, first, path.name, n)
    ends = [where.to_pixels(points) for points in (file.points, file.targets)]
    if first is not None and place is not None and n == 3:
        ends = [place.to_pixels(first.to_space(at)) for at in ends]
    if where is not first and n == 2 and case.slice is not None:
        ends = [at - [*[case.slice] * (at.shape[1] - 2), 0, 0] for at in ends]  # of the volume
    if any((abs(at[:, :-n]) > 0.5).any() for at in ends):
        raise ProblemError(path.name, "holds points that lie on other slices than the image.")
    radius = usual_radius(grid.shape, grid.spacing)
    pairs = zip(*(each[:, -n:].tolist() for each in ends), strict=True)
    return Drawing(tuple(Landmark(tuple(at), tuple(to), radius) for at, to in pairs))
