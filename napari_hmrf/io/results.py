"""Evaluation of saved results: tissue measurements, labels, and the image of a result."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import HmrfError, ProblemError
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.io.case import labels_of
from napari_hmrf.io.fields import geometry_of
from napari_hmrf.io.images import PICTURE_SUFFIXES, ImageFile, read_image
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.study_file import read_solved
from napari_hmrf.io.uncertainty_files import uncertainty_paths, write_uncertainty
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.posterior.study_landmarks import LandmarkTest, examine_landmarks
from napari_hmrf.posterior.study_uncertainty import ground_uncertainty
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.results.measurement import Measurement, measure
from napari_hmrf.solver.elastic_strain import strain_note
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import Progress
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.study import Study

#: Note on images without a place.
_NO_PLACE = (
    "the image has no position in world coordinates, so the uncertainty is at the origin, and its "
    "spacing is assumed to be in mm"
)


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
    notes : tuple of str
        Clauses: how the labels were resampled, and why the reported strain is not the elastic
        strain.
    """

    rows: tuple[Measurement, ...]
    unit: str
    of_volume: bool
    notes: tuple[str, ...] = ()


def measured(
    path: Path,
    labels: Path | None = None,
    *,
    uncertainty: bool = False,
    resample: bool = False,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Measured:
    """Measure the deformation of each tissue in a solved study or saved result.

    Parameters
    ----------
    path : Path
        Solved study, or saved result.
    labels : Path, optional
        Label image. By default, the labels of the study are used, or the same label for all tissue
        if there are no labels.
    uncertainty : bool
        True to estimate the error bar of the mean displacement of each tissue.
    resample : bool
        True to resample a label image whose axes are not at right angles.
    backend, progress
        As for `study_uncertainty`.

    Raises
    ------
    HmrfError
        If a file is invalid, or contains no displacement field, or if the uncertainty of the result
        is unknown.
    OSError
        If a file cannot be opened.
    """
    study, solution = read_solved(path)
    if uncertainty:
        refuse_without_study(path, study)
    tissue = None if study is None else study.tissue
    names = {} if tissue is None else {row.label: row.name for row in tissue.materials}
    image, resampled = None if tissue is None else tissue.labels, ""
    if labels is not None:
        file = read_image(labels, resample=resample, labels=True)
        image, resampled = labels_of(_on_grid(labels, file, solution), labels), file.resampled
    if image is None:
        image, names = np.ones(solution.tissue.shape, np.int32), {1: "tissue"}
    unit = unit_symbol(solution.place.unit)
    found = None
    if study is not None and uncertainty:
        try:
            ground = Ground.of(study)
            found = ground_uncertainty(
                ground,
                ground.statement(),
                0,
                labels=image,
                where=solution.tissue,
                backend=backend,
                progress=progress,
            )
        except ProblemError as error:
            raise HmrfError(f"--uncertainty is not possible for {path.name}: {error}") from error
    rows = measure(solution, image, names=names, uncertainty=found)
    notes = tuple(filter(None, (resampled, strain_note(solution))))
    return Measured(rows, unit, solution.tissue.ndim == 3, notes)


def refuse_without_study(path: Path, study: Study | None) -> None:
    """Raise an error if a saved result, from which no uncertainty follows, is not a study."""
    if study is None:
        raise HmrfError(
            f"{path.name} is a saved result, which does not contain the inputs from which an "
            "uncertainty is estimated. Give a study (.study)."
        )


class EstimatedFile(NamedTuple):
    """Uncertainty of a study, with its files.

    Attributes
    ----------
    found : Uncertainty
    least_sure : tuple of int
        Site where one more landmark helps most.
    unit : str
        Symbol of the unit of length.
    paths : tuple of Path
        Written files; empty if no path was given.
    note : str
        Note for the user, a clause; "" if there is none.
    landmarks : LandmarkTest, optional
    """

    found: Uncertainty
    least_sure: tuple[int, ...]
    unit: str
    paths: tuple[Path, ...] = ()
    note: str = ""
    landmarks: LandmarkTest | None = None

    def described(self) -> tuple[str, ...]:
        """Return the size of the error bars and the site of the next landmark, as clauses."""
        found, site, unit = self.found, self.least_sure, self.unit
        bars = found.along[found.solution.tissue]
        median, most = f"{float(np.median(bars)):.2g} {unit}", f"{float(bars.max()):.2g} {unit}"
        size = (
            f"estimated: patches of {found.patch:.3g} {unit}, {found.n} samples, ± {median} in the "
            f"median, up to ± {most}"
        )
        place = (
            f"least sure: ± {float(found.along[site]):.2g} {unit} at pixel "
            f"({', '.join(map(str, site))}), where one more landmark helps most"
        )
        return size, place


def estimate_uncertainty(
    path: Path,
    out: Path | None = None,
    *,
    n: int = 30,
    patch: float | None = None,
    within: Path | None = None,
    landmarks: bool = False,
    backend: str = "auto",
    overwrite: bool = True,
    progress: Progress | None = None,
) -> EstimatedFile:
    """Estimate the uncertainty of the displacement of a study, and write it as images.

    Parameters
    ----------
    path : Path
        Solved study.
    out : Path, optional
        Image to write, as for `write_uncertainty`.
    n, patch, backend, progress
        As for `study_uncertainty`.
    within : Path, optional
        Mask of the sites where a landmark can be, for `Uncertainty.least_sure`.
    landmarks : bool
        True to test the landmarks of the study, too.
    overwrite : bool
        True if existing images may be replaced.

    Raises
    ------
    HmrfError
        If the file is not a study, or if the uncertainty is not defined or not implemented.
    OSError
        If a file cannot be opened or written.
    """
    study, solution = read_solved(path)
    refuse_without_study(path, study)
    assert study is not None
    mask = None
    if within is not None:
        mask = labels_of(_on_grid(within, read_image(within), solution), within)
    if out is not None:
        refuse_overwriting(uncertainty_paths(out, len(study.grid.shape)), overwrite=overwrite)
    nowhere = np.zeros(study.grid.shape, np.bool_)  # labels are measured by `measured`
    try:
        ground = Ground.of(study)
        stated, tested = ground.statement(), None
        if landmarks:
            tested = examine_landmarks(ground, stated, backend=backend, progress=progress)
        found = ground_uncertainty(
            ground,
            stated,
            n,
            patch=patch,
            where=nowhere,
            backend=backend,
            progress=progress,
        )
    except ProblemError as error:
        raise HmrfError(f"the uncertainty of {path.name} is unknown: {error}") from error
    place = found.least_sure(mask)
    unit = unit_symbol(found.solution.place.unit)
    if out is None:
        return EstimatedFile(found, place, unit, landmarks=tested)
    is_placed = bool(found.solution.frame)
    paths = write_uncertainty(out, found, placed=is_placed)
    note = "" if is_placed or out.name.lower().endswith(PICTURE_SUFFIXES) else _NO_PLACE
    return EstimatedFile(found, place, unit, paths, note, tested)


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
        pixels = _on_grid(image, read_image(image), solution).pixels
    if pixels is None:
        raise HmrfError(f"{path.name}: the file does not contain the image. Give --image.")
    return solution, pixels


def _on_grid(path: Path, image: ImageFile, solution: Solution) -> ImageFile:
    """Return an image on the grid of a solution; the axes of a volume are reordered to match."""
    frame = solution.place
    geometry = geometry_of(solution) if solution.frame and frame.unit != "pixel" else None
    if solution.tissue.ndim == 3:
        image = image.laid_as(geometry, frame.file_axes or (0, 1, 2))
    elif 1 in image.pixels.shape[: image.ndim]:  # a volume of one slice
        image = image.laid_out
    sizes, shape = image.pixels.shape[: image.ndim], solution.tissue.shape
    if sizes != shape:
        raise ProblemError(
            path.name,
            f"is {grid_in_words(sizes)}, but the field is {grid_in_words(shape)}. Give an image of "
            "the same size.",
        )
    image.refuse_elsewhere(geometry, path.name, "the field")
    return image
