"""Reading cases from files, solving the cases, and writing the results to a folder.

A case is a saved study, or an image with files that define its tissue and its motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.field.brightness import edge_confidence
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import has_volume_loops
from napari_hmrf.io.apply import read_field_file
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.fields import geometry_of
from napari_hmrf.io.images import (
    ImageFile,
    is_segmentation,
    read_image,
    read_picture_as,
    result_suffix,
    shape_of,
    stem_of,
    write_image,
)
from napari_hmrf.io.landmark_files import POINT_SUFFIXES, read_pairs
from napari_hmrf.io.landmark_frames import in_pixels
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.segmentation_tables import tissue_table
from napari_hmrf.io.study_file import is_study_file, read_study, write_study
from napari_hmrf.io.sweeps import Change, changed, with_ratio
from napari_hmrf.io.tables import read_rules
from napari_hmrf.real_arrays import check_int32, grid_in_words, whole_numbers
from napari_hmrf.results.landmark_pairs import LandmarkPairs
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.solver.model_names import ELASTIC, MODELS, as_word
from napari_hmrf.solver.optimizers import ICM, Monitor, Multigrid
from napari_hmrf.solver.priors import Elastic, NeoHookeanPrior, Prior
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import Progress
from napari_hmrf.solver.volume_memory import STUDY, WARP, make_room, require_memory
from napari_hmrf.study.ground import Ground, solve_statement
from napari_hmrf.study.models import parts_of
from napari_hmrf.study.shortcomings import shortcomings
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import (
    UNPAINTED,
    USUAL_POISSON,
    Material,
    default_material,
    unlisted,
)
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.tissue_maps import MapRange, most_likely, scale_in_words, scale_of
from napari_hmrf.tissue.usual_lengths import largest_spread, usual_radius

#: Remedy for a segmentation of another size: 3D Slicer crops it to its segments.
_OF_SLICER = ": export it in 3D Slicer as a labelmap, with this image as the reference volume"
#: Number of distinct values, and share of pixels that differ from the next pixel in the row, above
#: which an image is not accepted as labels. The share is 40 % to 90 % in photographs, and at most
#: 10 % in label images.
_MANY, _UNEVEN = 64, 0.3


def read_case(case: Case) -> Study:
    """Read the files of a case, and return the study that they define.

    Raises
    ------
    ProblemError
        If the images differ in size or place, or the volume does not have the requested slice.
    HmrfError
        If an option has no effect, or a file is invalid; the message names the option or the file.
    OSError
        If a file cannot be opened.
    """
    if is_study_file(case.image):
        if case.options:
            raise HmrfError(
                f"{case.image.name} is a study, which already contains its settings. Leave out "
                f"{', '.join(case.options)}, or give an image."
            )
        return read_study(case.image).study
    if case.slice is None:
        require_memory(shape_of(case.image), STUDY, case.image.name)
    whole = read_picture_as(case.image, case.spacing, case.resample)
    _refuse_unused(case, whole.ndim == 2)
    image = _part(whole, case)
    image.refuse_as_volume(case.image.name)
    grid = _grid(image, whole, case)
    labels = None if case.labels is None else _pixels(case, case.labels, whole, labels=True)
    scale = 1.0
    if case.maps:
        labels, scale = _most_likely(case, whole)
    materials, unit, notes = _materials(case.materials, labels)
    notes = (
        *filter(None, [whole.resampled, whole.resolution]),
        *notes,
        *filter(None, [scale_in_words(scale)]),
    )
    motion = replace(
        _motion(case, grid, whole),
        hold_edge=case.hold_edge,
        weight=_weight_of(case, grid),
        cavity=case.cavity or Cavity(),
    )
    prior, optimizer = energy_of(case, volume=len(grid.shape) == 3)
    tissue = Tissue(labels=labels, materials=materials, unit=unit)
    if case.poisson is not None and labels is not None:
        notes = (*notes, *_notes_on_ratio(case, tissue))
        tissue = with_ratio(tissue, case.poisson)
    return Study(
        grid,
        tissue,
        motion,
        prior=prior,
        optimizer=optimizer,
        pictures=Pictures(image.pixels, labels, stem_of(case.image)),
        names=_names(case),
        notes=notes,
    )


def energy_of(case: Case, *, volume: bool = False) -> tuple[Prior, ICM | Multigrid]:
    """Return the prior and the optimizer selected by the options of a case.

    Parameters
    ----------
    case : Case
    volume : bool
        True if a whole volume is solved.

    Raises
    ------
    HmrfError
        If an option has no effect on the model; the message states the option and the reason.
    ArgumentError
        If the value of an option is invalid.
    """
    name = MODELS[as_word(case.model or "elastic")]
    prior, optimizer = parts_of(name)
    elastic = name in ELASTIC
    for given, option, is_valid, why in (
        (
            case.poisson is not None,
            "--poisson",
            elastic,
            "the paper's model has no Poisson's ratio",
        ),
        (
            case.plane is not None,
            "--plane",
            elastic,
            "the paper's model has neither plane stress nor plane strain",
        ),
        (
            case.plane is not None,
            "--plane",
            not volume,
            "plane stress and plane strain are defined for slices only",
        ),
        (bool(case.weight), "--weight", elastic, "the paper's model does not support forces"),
        (bool(case.cavity), "--cavity", elastic, "the paper's model does not support forces"),
        (
            case.tolerance is not None,
            "--tolerance",
            isinstance(optimizer, Multigrid),
            "the paper's schedule has a fixed length; --model paper-converged has a tolerance",
        ),
        (
            case.budget is not None,
            "--budget",
            isinstance(prior, NeoHookeanPrior),
            "only large motion has a budget",
        ),
    ):
        if given and not is_valid:
            raise HmrfError(f"{option} has no effect: {why}. Leave {option} out.")
    if isinstance(prior, Elastic):
        prior = replace(
            prior,
            poisson=prior.poisson if case.poisson is None else case.poisson,
            plane=case.plane or prior.plane,
        )
    if case.penalty is not None:
        prior = replace(prior, penalty=case.penalty)
    if case.tolerance is not None:
        optimizer = Multigrid(case.tolerance)
    if case.budget is not None and isinstance(optimizer, Multigrid):
        optimizer = replace(optimizer, budget=case.budget if case.budget < math.inf else None)
    return prior, optimizer


def _weight_of(case: Case, grid: Grid) -> tuple[float, ...]:
    """Return the weight of a case; raise an error if it does not have one number per grid axis."""
    if case.weight and len(case.weight) != len(grid.shape):
        axes = "plane, row and col" if len(grid.shape) == 3 else "row and col"
        raise HmrfError(
            f"--weight has {len(case.weight)} numbers, but the grid has {len(grid.shape)} axes. "
            f"Give the weight along {axes}."
        )
    return case.weight


def _notes_on_ratio(case: Case, tissue: Tissue) -> tuple[str, ...]:
    """Return notes on replaced Poisson's ratios, and on labels that are not in the table.

    Parameters
    ----------
    case : Case
    tissue : Tissue
        Labels of the tissue, and materials of the table.
    """
    notes = []
    if any(row.poisson not in (case.poisson, USUAL_POISSON) for row in tissue.materials):
        table = "the table" if case.materials is None else case.materials.name
        notes.append(f"--poisson {case.poisson:g} replaces the Poisson's ratios of {table}")
    labels = tissue.labels
    missing = [] if labels is None or tissue.materials else unlisted(labels, ())
    added = [default_material(label, ()) for label in missing]
    notes += [
        f"label {row.label} is not in the table, so its stiffness was set to {row.stiffness:g}"
        for row in added
    ]
    return tuple(notes)


def _refuse_unused(case: Case, is_planar: bool) -> None:
    """Raise an error if an option has no effect."""
    path = case.boundary
    marks = path is not None and path.name.lower().endswith(POINT_SUFFIXES)
    field = path is not None and not marks and case.rules is None
    for unused, option, why in (
        (not (case.labels or case.maps), "--materials", "requires --labels or --maps"),
        (bool(case.maps), "--labels", "cannot be used with --maps: both define the tissue"),
        (path is None or marks, "--rules", "requires a --boundary that is a label image"),
        (not marks, "--targets", "requires a --boundary with landmarks"),
        (not field, "--confidence", "requires a --boundary that is a field"),
        (not field, "--forward", "requires a --boundary that is a field"),
        (is_planar, "--slice", f"requires a volume, but {case.image.name} is not a volume"),
    ):
        if unused and option in case.options:
            raise HmrfError(f"{option} {why}. Leave {option} out, or give the required input.")


def _names(case: Case) -> dict[str, str]:
    """Return the names of the parts of a study: file names, without the suffix for the image."""
    confidence = case.confidence if isinstance(case.confidence, Path) else None
    tissue = case.labels or next(iter(case.maps), None)
    parts = {"tissue": tissue, "boundary": case.boundary, "confidence": confidence}
    files = {part: path.name for part, path in parts.items() if path is not None}
    return {"image": stem_of(case.image), **files}


class SolvedCase(NamedTuple):
    """Result of a case.

    Attributes
    ----------
    study : Study
    solution : Solution
    folds : int
        Number of sites at which the tissue folds over itself, which is physically impossible.
    notes : tuple of str
        Notes for the user on the interpretation of the input files and on shortcomings of the
        result; each note is a clause.
    """

    study: Study
    solution: Solution
    folds: int
    notes: tuple[str, ...]


def _files_of(case: Case, folder: Path) -> tuple[Path, ...]:
    """Return the paths of all files that `solve_case` may write to a folder."""
    name, suffix = stem_of(case.image), result_suffix(case.image)
    suffixes = (".nrrd", ".tif") if is_study_file(case.image) else (suffix,)
    images = (f"{name} deformed{suffix}" for suffix in suffixes)
    return tuple(folder / each for each in (f"{name}.study", *images))


def solve_case(
    case: Case,
    folder: Path,
    *,
    backend: str = "auto",
    changes: Sequence[Change] = (),
    overwrite: bool = True,
    progress: Progress | None = None,
) -> SolvedCase:
    """Solve a case, and write the solved study and the deformed image to a folder.

    Parameters
    ----------
    case : Case
    folder : Path
        Output folder, which is created if it does not exist.
    backend : str
        As for `solve`.
    changes : sequence of Change
        Changes to numbers in the files of the case.
    overwrite : bool
        True if existing files in the folder may be replaced.
    progress : callable, optional
        As for `solve`.

    Raises
    ------
    HmrfError, OSError
        As for `read_case`, `changed`, `solve_study` and `write_study`.
    """
    study = changed(read_case(case), changes)
    if case.boundary is None and not case.hold_edge and not is_study_file(case.image):
        if study.bears_loads:
            raise HmrfError(
                "no part of the tissue is fixed. Give --hold-edge to fix its outer edge, or a "
                "--boundary that fixes a part of it."
            )
        raise HmrfError(
            "no motion of the tissue is given. Give a --boundary that moves tissue, and "
            "--hold-edge if the outer edge is fixed."
        )
    refuse_overwriting(_files_of(case, folder), overwrite=overwrite)
    ground = Ground.of(study)
    stated = ground.statement()
    try:
        ground.refuse_motionless(stated)
    except ProblemError as error:  # omit the name of the image: the cause is a missing option
        is_study = is_study_file(case.image)
        remedy = "" if is_study else " Use --boundary, --weight, or growth in --materials."
        raise HmrfError(f"{error.message}{remedy}") from None
    folder.mkdir(parents=True, exist_ok=True)  # before the solve, so that errors occur early
    notes = (*ground.unused(stated), *ground.notes_on(stated))
    del ground  # its images need as much memory as the problem
    solution = solve_statement(study, stated, backend=backend, progress=progress)
    folds = solution.count_folds()
    caveats = tuple(shortcomings(solution, study.grid.unit, folds, stated.problem, stated.edge))
    solution = replace(solution, notes=(*caveats, *solution.notes))
    name = stem_of(case.image)
    image = study.pictures.image
    if image is not None:
        if progress is not None and len(study.grid.shape) == 3 and not has_volume_loops():
            progress(Monitor(PREPARING, 0.9))
        make_room(study.grid.shape, WARP)
        suffix = result_suffix(case.image)
        if is_study_file(case.image) and study.grid.unit == "pixel":
            suffix = ".tif"
        file = result_image(solution.warp(image), solution, suffix)
        write_image(folder / f"{name} deformed{suffix}", file)
    write_study(folder / f"{name}.study", study, solution)
    notes = (*caveats, *drift_clauses(solution), *notes)
    return SolvedCase(study, solution, folds, notes)


def result_image(pixels: npt.NDArray[Any], solution: Solution, suffix: str) -> ImageFile:
    """Return an image on the grid of a solution, for a file with a suffix of `result_suffix`."""
    colours = pixels.ndim > solution.tissue.ndim
    if suffix != ".tif":
        return ImageFile(pixels, geometry_of(solution), colours)
    is_known = solution.unit != "pixel" or len({*solution.spacing}) > 1
    sizes = tuple(solution.spacing) if is_known else ()
    return ImageFile(pixels, colours=colours, sizes=sizes, unit=solution.unit)


def _part(image: ImageFile, case: Case) -> ImageFile:
    """Return the selected slice, or the whole volume with reordered axes."""
    geometry, number = image.geometry, case.slice
    if image.ndim == 2:
        return image
    if number is None:
        return image.laid_out
    count = len(image.pixels)
    if not 0 <= number < count:
        raise ProblemError(
            case.image.name, f"is a volume of {count} slices. Give --slice 0 to {count - 1}."
        )
    part = None if geometry is None else geometry.slice_at(number)
    return image._replace(pixels=image.pixels[number], geometry=part)


def _grid(part: ImageFile, whole: ImageFile, case: Case) -> Grid:
    """Return the grid of a slice or a volume, with its place in space."""
    n, is_slice = part.ndim, whole.ndim > 2 and case.slice is not None
    shape = part.pixels.shape[:n]
    geometry, number = (whole.grid, case.slice) if is_slice else (part.grid, 0)
    if whole.geometry is None and n == whole.ndim == 2:
        return Grid(shape, geometry.spacing, geometry.unit)
    frame = replace(Frame.of_geometry(geometry, number or 0), file_axes=part.order)
    if n == 3:
        frame = replace(frame, plane=(0, 1, 2))
    return Grid(shape, geometry.spacing[-n:], geometry.unit, frame)


def _materials(
    path: Path | None, labels: npt.NDArray[Any] | None
) -> tuple[tuple[Material, ...], str, tuple[str, ...]]:
    """Return the materials in a table, the unit of stiffness, and notes on looked-up values."""
    if path is None or labels is None:
        return (), "", ()
    table = tissue_table(path)
    if isinstance(table, Preset):
        return table.materials, table.unit, ()
    present, unknown = set(np.unique(labels).tolist()), table.unknown
    named = ", ".join(f"{label} ({unknown[label]})" for label in unknown if label in present)
    # Tables of names often lack the background.
    others = {0: UNPAINTED} if 0 in unlisted(labels, table.materials) else {}
    others |= {label: name for label, name in unknown.items() if label in present}
    assumed = default_material(0, table.materials)
    rows = [replace(assumed, label=label, name=name) for label, name in others.items()]
    first = next((row.name for row in table.materials if row.is_deformable), "")
    note = f"no stiffness is known for {named}: that of {first} is used" if named else ""
    notes = table.published(present), note
    return (
        (*table.materials, *rows),
        table.unit,
        tuple(f"{path.name}: {note}" for note in notes if note),
    )


def _most_likely(case: Case, whole: ImageFile) -> tuple[npt.NDArray[np.integer], float]:
    """Return the label of the most likely tissue of each pixel, and the scale of the maps.

    The scale is derived from the complete files, so that it is the same for all slices.
    """
    maps: dict[str, npt.NDArray[Any]] = {}
    ranges: dict[str, MapRange] = {}
    names = [path.name for path in case.maps]
    for path in case.maps:
        name = path.name if names.count(path.name) == 1 else str(path)
        if name in maps:
            raise ProblemError(name, "is given twice in --maps. Give it once.")
        image = read_image(path, resample=case.resample)
        maps[name], ranges[name] = _on_pixels(case, path, whole, image), MapRange.of(image.pixels)
    scale = scale_of(ranges, fix="")
    return most_likely(maps, scale), scale


def _pixels(case: Case, path: Path, whole: ImageFile, labels: bool = False) -> npt.NDArray[Any]:
    """Return the pixels of a grey or label image; for a volume, the pixels of the case's slice."""
    image = read_image(path, resample=case.resample, labels=labels)
    pixels = _on_pixels(case, path, whole, image)
    return as_labels(pixels, path) if labels else pixels


def _on_pixels(case: Case, path: Path, whole: ImageFile, image: ImageFile) -> npt.NDArray[Any]:
    """Return the pixels of an image or its slice, after checking that it fits the case's image.

    Raises
    ------
    ProblemError
        If the image has colours, or differs in size or place from the image of the case.
    """
    reference = _part(whole, case)
    if image.ndim == 3 and image.geometry is None and case.slice is None:
        image = image._replace(geometry=whole.geometry)
    image = _part(image, replace(case, image=path))
    if image.ndim == 3:
        image = image.laid_as(reference.geometry)
    pixels, shape = image.pixels, reference.pixels.shape[: reference.ndim]
    refuse_colours(image, path)
    if pixels.shape != shape:
        raise ProblemError(
            path.name,
            f"is {grid_in_words(pixels.shape)}, but the image is {grid_in_words(shape)}. Give a "
            f"file of the same size{_OF_SLICER if is_segmentation(path) else ''}.",
        )
    image.refuse_elsewhere(reference.geometry, path.name, "the image")
    return pixels


def refuse_colours(image: ImageFile, path: Path) -> None:
    """Raise an error if an image has colours where one value per pixel is required."""
    if image.colours:
        raise ProblemError(path.name, "has colours. Give an image with one value per pixel.")


def labels_of(image: ImageFile, path: Path) -> npt.NDArray[Any]:
    """Return the pixels of an image as labels; raise `ProblemError` if it has colours."""
    refuse_colours(image, path)
    return as_labels(image.pixels, path)


def as_labels(pixels: npt.NDArray[Any], path: Path) -> npt.NDArray[Any]:
    """Return pixels as labels; whole numbers that are stored as floats are converted."""
    check_int32(path.name, pixels)
    pixels = pixels.astype(np.int32) if pixels.dtype.kind == "b" else pixels
    pixels = whole_numbers(path.name, pixels)
    if pixels.dtype.kind not in "iu":
        raise ProblemError(
            path.name, f"contains {pixels.dtype} values. Give labels, which are whole numbers."
        )
    differ = pixels[..., 1:] != pixels[..., :-1]
    if differ.size and differ.mean() > _UNEVEN and (count := len(np.unique(pixels))) > _MANY:
        raise ProblemError(
            path.name,
            f"is probably not a label image: it has {count} values, and {differ.mean():.0%} of its "
            "pixels differ from the next pixel. Give an image with a whole number for each tissue.",
        )
    return pixels


def _motion(case: Case, grid: Grid, whole: ImageFile) -> Motion:
    path = case.boundary
    if path is None:
        return Motion()
    if path.name.lower().endswith(POINT_SUFFIXES):
        return Motion(drawing=_landmarks(case, path, grid, whole))
    if case.rules is not None:
        labels = _pixels(case, path, whole, labels=True)
        rules, n = read_rules(case.rules), len(grid.shape)
        if any(len(rule.vector) > n for rule in rules):
            raise ProblemError(
                case.rules.name, "has a column 'plane', but the case is a slice. Remove the column."
            )
        return Motion(labels=labels, rules=rules)
    try:
        field = read_field_file(path, forward=case.forward).in_pixels
    except FileFormatError as error:
        raise FileFormatError(f"{error} If it is a label image, also give --rules.") from None
    confidence, frame = _confidence_of(case, whole), grid.place
    # A file with a 2-D field does not state a place in a volume, so pixels are matched by index.
    if frame is None or field.frame.ndim < frame.ndim:
        n = len(grid.shape)
        frame = Frame.at(grid.spacing, ("pixel",) * n, volume=n == 3)
    try:
        on_grid = field.on(frame, grid.shape)
    except ProblemError as error:
        raise ProblemError(path.name, error.message) from None
    return Motion(observed=on_grid.displacement, confidence=np.where(on_grid.known, confidence, 0))


def _confidence_of(case: Case, whole: ImageFile) -> npt.NDArray[Any]:
    part = _part(whole, case)
    if case.confidence is None:
        return np.ones(part.pixels.shape[: part.ndim], np.float32)
    if case.confidence == "edges":
        return edge_confidence(part.pixels, axes=part.ndim)
    confidence = _pixels(case, case.confidence, whole).astype(np.float32)
    return confidence / confidence.max() if confidence.max() > 1 else confidence


def _landmarks(case: Case, path: Path, grid: Grid, whole: ImageFile) -> Drawing:
    (file, targets), n = read_pairs(path, case.targets), len(grid.shape)
    ends = [
        in_pixels(file, points, whole, path.name, case.slice) for points in (file.points, targets)
    ]
    if any((abs(at[:, :-n]) > 0.5).any() for at in ends):
        raise ProblemError(
            path.name, "contains points that are not in the slice of the image. Remove them."
        )
    sources, last = ends[0][:, -n:], np.array(grid.shape) - 1
    if not len(sources):
        raise ProblemError(
            path.name, "contains no active landmarks. Give at least one active pair."
        )
    exact = sources if file.sd is None else sources[file.sd == 0]
    pixels, counts = np.unique(np.rint(exact), axis=0, return_counts=True)
    if counts.max(initial=0) > 1:
        repeated = " ".join(f"{at:g}" for at in pixels[counts.argmax()])
        raise ProblemError(
            path.name, f"has two landmarks in one pixel ({repeated}). Remove one of them."
        )
    outside = int(((sources < -0.5) | (sources > last + 0.5)).any(axis=1).sum())
    if outside:
        raise ProblemError(
            path.name,
            f"has {outside} of {len(sources)} landmarks outside the image. Check that the "
            f"coordinates have the unit of {case.image.name} ({unit_symbol(grid.unit)}) and are "
            "along its axes, and remove landmarks outside the image.",
        )
    most = largest_spread(grid.shape, grid.spacing)
    if file.sd is not None and (file.sd > most).any():
        raise ProblemError(
            path.name,
            f"has a standard deviation of {file.sd.max():.4g}. Use at most {most:g} in the unit of "
            "the image, the diagonal of the image.",
        )
    pairs = LandmarkPairs(np.arange(len(sources)), sources, ends[1][:, -n:], file.sd)
    # Pairs are in the unit of the image, which is also the unit of the grid.
    radii = pairs.radii(usual_radius(grid.shape, grid.spacing), grid.spacing)
    return Drawing.from_landmarks(pairs.at, pairs.to, radius=radii, sd=pairs.sd)
