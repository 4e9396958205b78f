"""Results read from files: measurements of tissue, labels, and images with their fields."""

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
    """Measurements of each tissue.

    Attributes
    ----------
    rows : tuple of Measurement
    unit : str
        Unit of lengths.
    of_volume : bool
        True if the size of tissue is a volume instead of an area.
    note : str
        Reason why the strain is not the elastic strain, as a clause; "" if it is.
    """

    rows: tuple[Measurement, ...]
    unit: str
    of_volume: bool
    note: str = ""


def measured(path: Path, labels: Path | None = None) -> Measured:
    """Measure the deformation of each tissue of a study or result.

    Parameters
    ----------
    path : Path
        A study with its field, or a saved result.
    labels : Path, optional
        An image of labels; by default those of the study, or one label for all tissue.

    Raises
    ------
    HmrfError, OSError
        If a file cannot be read, or has no field.
    """
    study, solution = read_solved(path)
    tissue = None if study is None else study.tissue
    names = {} if tissue is None else {row.label: row.name for row in tissue.materials}
    image = None if tissue is None else tissue.labels
    if labels is not None:
        image = labels_of(_on_grid(labels, solution), labels)
    if image is None:  # without labels, all tissue has one label
        image, names = np.ones(solution.tissue.shape, np.int32), {1: "tissue"}
    unit = unit_symbol(Frame.of_solution(solution).unit)
    rows, of_volume = solution.measure(image, names=names), solution.tissue.ndim == 3
    return Measured(rows, unit, of_volume, strain_note(solution))


def labels_in(path: Path) -> tuple[int, ...]:
    """Return the different labels in an image file.

    Raises
    ------
    HmrfError, OSError
        If the file cannot be read, or holds no labels.
    """
    return tuple(np.unique(labels_of(read_image(path), path)).tolist())


def image_of(path: Path, image: Path | None = None) -> tuple[Solution, npt.NDArray[Any]]:
    """Return the field of a study or result, and its image or the given image.

    Raises
    ------
    HmrfError, OSError
        If a file cannot be read or has no field, or if there is no image.
    """
    study, solution = read_solved(path)
    pixels = None if study is None else study.pictures.image
    if image is not None:
        pixels = _on_grid(image, solution).pixels
    if pixels is None:
        raise HmrfError(f"{path.name}: the image is not in the file. Give --image.")
    return solution, pixels


def _on_grid(path: Path, solution: Solution) -> ImageFile:
    """Return the image in a file; a volume has the order of the solution's axes."""
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
