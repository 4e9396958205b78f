"""Evaluation of saved results: tissue measurements, labels, and the image of a result."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import HmrfError, ProblemError
from napari_hmrf.field.elastic_strain import strain_note
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.measurement import Measurement
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.io.case import labels_of
from napari_hmrf.io.fields import place_of
from napari_hmrf.io.images import ImageFile, read_image
from napari_hmrf.io.study_file import read_solved
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.solver.solution import Solution


class Measured(NamedTuple):
    """Measurements of a result.

    Attributes
    ----------
    rows : tuple of Measurement
        Measurements of each tissue.
    unit : str
        Unit of length.
    of_volume : bool
        True if tissue sizes are volumes, False if they are areas.
    note : str
        Reason, as a clause, why the reported strain is not the elastic strain; "" if it is the
        elastic strain.
    """

    rows: tuple[Measurement, ...]
    unit: str
    of_volume: bool
    note: str = ""


def measured(path: Path, labels: Path | None = None) -> Measured:
    """Measure the deformation of each tissue in a solved study or saved result.

    Parameters
    ----------
    path : Path
        Solved study, or saved result.
    labels : Path, optional
        Label image. By default, the labels of the study are used, or the same label for all tissue
        if there are no labels.

    Raises
    ------
    HmrfError
        If a file is invalid, or contains no displacement field.
    OSError
        If a file cannot be opened.
    """
    study, solution = read_solved(path)
    tissue = None if study is None else study.tissue
    names = {} if tissue is None else {row.label: row.name for row in tissue.materials}
    image = None if tissue is None else tissue.labels
    if labels is not None:
        image = labels_of(_on_grid(labels, solution), labels)
    if image is None:
        image, names = np.ones(solution.tissue.shape, np.int32), {1: "tissue"}
    unit = unit_symbol(Frame.of_solution(solution).unit)
    rows, of_volume = solution.measure(image, names=names), solution.tissue.ndim == 3
    return Measured(rows, unit, of_volume, strain_note(solution))


def labels_in(path: Path) -> tuple[int, ...]:
    """Return the distinct labels in an image file, in ascending order.

    Raises
    ------
    HmrfError
        If the file is not a label image.
    OSError
        If the file cannot be opened.
    """
    return tuple(np.unique(labels_of(read_image(path), path)).tolist())


def image_of(path: Path, image: Path | None = None) -> tuple[Solution, npt.NDArray[Any]]:
    """Read the solution of a solved study or saved result, and its image.

    Parameters
    ----------
    path : Path
        Solved study, or saved result.
    image : Path, optional
        Image to use instead of the image in the study; required for a saved result.

    Raises
    ------
    HmrfError
        If a file is invalid or contains no displacement field, or if there is no image.
    OSError
        If a file cannot be opened.
    """
    study, solution = read_solved(path)
    pixels = None if study is None else study.pictures.image
    if image is not None:
        pixels = _on_grid(image, solution).pixels
    if pixels is None:
        raise HmrfError(f"{path.name}: the file does not contain the image. Give --image.")
    return solution, pixels


def _on_grid(path: Path, solution: Solution) -> ImageFile:
    """Read an image on the grid of a solution; the axes of a volume are reordered to match."""
    is_unplaced = Frame.of_solution(solution).unit == "pixel"
    image, place = read_image(path), None if is_unplaced else place_of(solution)
    if solution.tissue.ndim == 3:
        image = image.laid_as(place)
    sizes, shape = image.pixels.shape[: image.ndim], solution.tissue.shape
    if sizes != shape:
        raise ProblemError(
            path.name,
            f"is {grid_in_words(sizes)}, but the field is {grid_in_words(shape)}. Give an image of "
            "the same size.",
        )
    image.refuse_elsewhere(place, path.name, "the field")
    return image
