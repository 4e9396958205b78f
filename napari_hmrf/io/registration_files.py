"""Registration of two image files, and the files of its result.

Both images are read with their positions in space. The registration starts from these positions,
or from an alignment.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import HmrfError, ProblemError, naming
from napari_hmrf.extras import how_to_install
from napari_hmrf.field.brightness import luminance
from napari_hmrf.field.units import unit_factor, unit_symbol
from napari_hmrf.io.case import read_case, result_image
from napari_hmrf.io.case_options import Case, RegistrationCase
from napari_hmrf.io.fields import placed, write_mapping
from napari_hmrf.io.images import read_picture_as, result_suffix, shape_of, stem_of, write_image
from napari_hmrf.io.itk_files import has_simpleitk
from napari_hmrf.io.landmark_files import read_pairs
from napari_hmrf.io.landmark_frames import in_pixels
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.study_file import is_study_file, write_study
from napari_hmrf.io.sweeps import with_ratio
from napari_hmrf.real_arrays import grid_in_words, sites_in_words
from napari_hmrf.registration.alignment import Alignment, align
from napari_hmrf.registration.register import register
from napari_hmrf.registration.result import Registration, relation_in_words
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import Progress
from napari_hmrf.solver.uncertain_landmarks import Landmarks, are_outside
from napari_hmrf.solver.volume_memory import REGISTRATION, require_memory
from napari_hmrf.study.ground import Ground, solve_statement
from napari_hmrf.study.study import Grid, Study, Tissue

Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Standard deviation of an exact landmark, and default of a file without one, in pixels.
_EXACT, _USUAL_SD = 0.01, 1.0
#: Largest sine of the angle between two slices that are registered.
_TILT = 0.01
#: Largest deviation of a matrix from the identity, for axes that are parallel.
_PARALLEL = 1e-6
#: Distance between the registered field and that of the study, in pixels, above which a note states
#: the distance.
_APART = 0.05
#: Fraction of the progress at the end of the registration.
_REGISTERED = 0.9
#: Similarity above which images need not become more similar.
_ALIKE = 0.95
#: Number of decimals of a similarity.
_DECIMALS = 4


class RegisteredFiles(NamedTuple):
    """Result of a registration of two files.

    Attributes
    ----------
    study : Study
        Study that moves the tissue of the fixed image as the registration does.
    registration : Registration
        Registration, with a solution at the place of the fixed image.
    report : dict
        Content of the report file.
    notes : tuple of str
        Notes for the user, as clauses.
    """

    study: Study
    registration: Registration
    report: dict[str, Any]
    notes: tuple[str, ...]


def register_files(
    case: RegistrationCase,
    folder: Path,
    *,
    overwrite: bool = True,
    progress: Progress | None = None,
) -> RegisteredFiles:
    """Register two image files, and write the results to a folder.

    Parameters
    ----------
    case : RegistrationCase
    folder : Path
        Output folder, which is created if it does not exist.
    overwrite : bool
        True if existing files in the folder may be replaced.
    progress : callable, optional
        As for `solve`.

    Returns
    -------
    RegisteredFiles

    Raises
    ------
    HmrfError
        If a file is invalid, the images cannot be registered, or SimpleITK is required and not
        installed; the message names the file or the option.
    OSError
        If a file cannot be opened or written.
    """
    started = time.perf_counter()
    names = _Names.of(case)
    refuse_overwriting([folder / name for name in names], overwrite=overwrite)
    if case.alignment is not None and not has_simpleitk():
        raise HmrfError(
            f"--{case.alignment} requires SimpleITK, which is not installed: "
            f"{how_to_install('medical')}. Or leave --{case.alignment} out."
        )
    pair = _Pair.read(case)
    folder.mkdir(parents=True, exist_ok=True)  # before the work, so that errors occur early
    report = progress or (lambda monitor: None)
    matrix = pair.positions
    aligned: tuple[str, ...] = ()
    if case.alignment is not None:
        report(Monitor(f"aligning the images ({case.alignment})", 0.0))
        matrix, aligned = _aligned(case.alignment, pair)
    marks = None if case.landmarks is None else _landmarks(case, pair, matrix)
    with naming(
        fixed=case.fixed.name,
        moving=case.moving.name,
        stiffness="--labels" if case.labels is None else case.labels.name,
        landmarks="--landmarks" if case.landmarks is None else case.landmarks.name,
    ):
        found = register(
            pair.fixed,
            pair.moving,
            spacing=pair.spacing,
            moving_spacing=pair.moving_spacing,
            stiffness=pair.stiffness,
            masks=pair.masks,
            landmarks=marks,
            initial=matrix,
            smoothness=case.smoothness,
            similarity=case.similarity,
            compare_all=case.compare_all,
            progress=lambda monitor: report(
                Monitor(monitor.message, _REGISTERED * monitor.fraction)
            ),
        )
    place = pair.study.grid.place
    frame, unit = None if place is None else place.as_dict(), pair.study.grid.unit
    found = replace(found, solution=replace(found.solution, frame=frame, unit=unit))
    report(Monitor("solving the study", _REGISTERED))
    study = _study_of(case, pair, found)
    solution = solve_statement(study, Ground.of(study).statement())
    notes = [*pair.notes, *aligned, *_notes_on(found, solution, pair, marks)]
    report(Monitor("writing the results", 1.0))
    write_study(folder / names.study, study, solution)
    if found.missing is not None:
        sites = sites_in_words(int(found.missing.sum()), found.missing.ndim)
        notes.append(
            f"tissue at {sites} has no counterpart in {case.moving.name} and was not compared; see "
            f"{names.missing}, or use --compare-all"
        )
    notes += _write_images(folder, names, pair, found, result_suffix(case.fixed))
    content = _report_of(case, pair, found, time.perf_counter() - started)
    if found.similarity <= min(found.similarity_before, _ALIKE):
        notes.append(
            "the images are not more similar than before: check that they show the same tissue, "
            "or use --rigid or --affine"
        )
    text = json.dumps(content, indent=2, allow_nan=False)
    write_whole(folder / names.report, f"{text}\n".encode())
    return RegisteredFiles(study, found, content, tuple(notes))


class _Names(NamedTuple):
    """Names of the written files."""

    study: str
    deformed: str
    registered: str
    jacobian: str
    missing: str
    field: str
    report: str

    @classmethod
    def of(cls, case: RegistrationCase) -> _Names:
        fixed, moving = (stem_of(path) for path in (case.fixed, case.moving))
        suffix = result_suffix(case.fixed)
        return cls(
            f"{fixed}.study",
            f"{fixed} deformed{suffix}",
            f"{moving} registered{suffix}",
            f"{fixed} jacobian{suffix}",
            f"{fixed} missing{suffix}",
            f"{fixed} to {moving} field.mha",
            f"{fixed} registration.json",
        )


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two images, with their grids, masks and tissue.

    Attributes
    ----------
    study, other : Study
        Studies of `fixed`, with its tissue, and of `moving`.
    fixed, moving : ndarray, shape (H, W) or (D, H, W), float32
        Grey images.
    spacing, moving_spacing : tuple of float
    stiffness : ndarray, shape (H, W) or (D, H, W), float32
    masks : tuple
        Masks of `fixed` and `moving`; None for all pixels.
    positions : ndarray, shape (n + 1, n + 1)
        Homogeneous matrix from positions in `fixed` to positions in `moving`, from the places of
        both images.
    notes : tuple of str
    """

    study: Study
    other: Study
    fixed: npt.NDArray[np.float32]
    moving: npt.NDArray[np.float32]
    spacing: tuple[float, ...]
    moving_spacing: tuple[float, ...]
    stiffness: npt.NDArray[np.float32]
    masks: tuple[BoolArray | None, BoolArray | None]
    positions: Float64Array
    notes: tuple[str, ...]

    @classmethod
    def read(cls, case: RegistrationCase) -> _Pair:
        """Read the files of a case, and check that the images can be registered."""
        for path in (case.fixed, case.moving):
            if is_study_file(path):
                raise HmrfError(f"{path.name} is a study. Give an image.")
            require_memory(shape_of(path), REGISTRATION, path.name)
        study = read_case(
            Case(
                case.fixed,
                labels=case.labels,
                materials=case.materials,
                maps=case.maps,
                spacing=case.spacing,
                resample=case.resample,
            )
        )
        other = read_case(Case(case.moving, spacing=case.spacing, resample=case.resample))
        _refuse_other_dimension(case, study, other)
        growing = [row for row in study.tissue.materials if row.grows]
        if growing:
            table = "--materials" if case.materials is None else case.materials.name
            raise ProblemError(
                table,
                f"has growth for label {growing[0].label}, which is not used in a registration: "
                "the images determine the motion. Remove the column growth.",
            )
        # The registration assumes a Poisson's ratio of 0, and the study must agree.
        tissue = with_ratio(study.tissue, 0.0)
        if tissue.labels is None:
            tissue = Tissue(stiffness=np.ones(study.grid.shape, np.float32))
        study = replace(study, tissue=tissue)
        masks = (
            _mask(case, case.fixed, case.mask),
            _mask(case, case.moving, case.moving_mask),
        )
        positions, notes = relative_place((case.fixed.name, case.moving.name), study, other)
        return cls(
            study,
            other,
            grey_image(study),
            grey_image(other),
            study.grid.spacing,
            other.grid.spacing,
            Ground.of(study).stiffness,
            masks,
            positions,
            (*study.notes, *other.notes, *notes),
        )

    @property
    def counted(self) -> tuple[BoolArray, BoolArray]:
        """Masks of the pixels that count, without NaN and infinite pixels."""
        first, second = (
            np.isfinite(image) if mask is None else np.isfinite(image) & mask
            for image, mask in zip((self.fixed, self.moving), self.masks, strict=True)
        )
        return first, second

    @property
    def finite(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Images with 0 in place of NaN and infinite pixels."""
        first, second = (
            np.where(np.isfinite(image), image, np.float32(0))
            for image in (self.fixed, self.moving)
        )
        return first, second


def grey_image(study: Study) -> npt.NDArray[np.float32]:
    """Return the brightness of the image of a study, shape (H, W) or (D, H, W)."""
    image = study.pictures.image
    assert image is not None
    if image.ndim > len(study.grid.shape):
        image = luminance(image)
    return image.astype(np.float32)


def _mask(case: RegistrationCase, image: Path, mask: Path | None) -> BoolArray | None:
    """Return a mask on the pixels of an image; None without a file."""
    if mask is None:
        return None
    labels = read_case(Case(image, labels=mask, resample=case.resample)).tissue.labels
    assert labels is not None
    if not labels.any():
        raise ProblemError(
            mask.name, "is 0 everywhere, so that no pixel counts. Give a mask of the tissue."
        )
    return np.asarray(labels != 0)


def _refuse_other_dimension(case: RegistrationCase, study: Study, other: Study) -> None:
    words = {2: "an image with two axes", 3: "a volume with three axes"}
    axes = [len(each.grid.shape) for each in (study, other)]
    if axes[0] != axes[1]:
        raise HmrfError(
            f"{case.fixed.name} is {words[axes[0]]}, but {case.moving.name} is {words[axes[1]]}. "
            "Give two images or two volumes."
        )


def _is_placed(grid: Grid) -> bool:
    return grid.place is not None and grid.unit == "millimeter"


def relative_place(
    names: tuple[str, str], study: Study, other: Study
) -> tuple[Float64Array, tuple[str, ...]]:
    """Return the matrix from positions in the fixed to the moving image, and notes.

    Parameters
    ----------
    names : (str, str)
        Names of the files of `study` and `other`, for messages.
    study, other : Study
        Studies of the fixed and the moving image.

    Raises
    ------
    ProblemError
        If only one image has a place, if the units differ, or if slices are not parallel.
    """
    grid, moving = study.grid, other.grid
    n = len(grid.shape)
    placed = _is_placed(grid), _is_placed(moving)
    if placed[0] != placed[1]:
        placed_one, without = names
        if placed[1]:
            without, placed_one = placed_one, without
        raise ProblemError(
            without,
            f"has no position in world coordinates, but {placed_one} has one. Give two images with "
            "positions, or two images without.",
        )
    if not placed[0]:
        if grid.unit != moving.unit:
            raise ProblemError(
                names[1],
                f"has pixels of {grid_in_words(moving.spacing)} {moving.unit}, but those of "
                f"{names[0]} are {grid_in_words(grid.spacing)} {grid.unit}. Save both images with "
                "the size of a pixel, in the same unit, or give --spacing.",
            )
        return np.eye(n + 1), ()
    if unit_factor(moving.unit, grid.unit) != 1:
        raise ProblemError(
            names[1],
            f"has lengths in {moving.unit}, but {names[0]} has lengths in {grid.unit}. Give both "
            "images in the same unit.",
        )
    here, there = (each.known_place.geometry(each.shape) for each in (grid, moving))
    if here.ndim != there.ndim:
        raise ProblemError(
            names[1],
            f"has a position in {there.ndim} dimensions, but that of {names[0]} has {here.ndim}. "
            "Save both images in the same way.",
        )
    turn, moving_turn = here.directions[:, -n:], there.directions[:, -n:]
    back = np.linalg.pinv(moving_turn)
    tilt = np.linalg.norm(turn - moving_turn @ back @ turn, axis=0).max()
    if tilt > _TILT:
        raise ProblemError(
            names[1],
            f"is a slice that is tilted against {names[0]}. Give parallel slices, or volumes.",
        )
    offset = (here.affine - there.affine)[:-1, -1]
    apart = float(np.linalg.norm(offset - moving_turn @ back @ offset))
    matrix = np.eye(n + 1)
    matrix[:n, :n] = back @ turn
    matrix[:n, n] = back @ offset * unit_factor("millimeter", grid.unit)
    # Rounding in file headers must not blur images that have the same grid.
    matrix = np.where(np.abs(matrix - np.rint(matrix)) < _PARALLEL, np.rint(matrix), matrix)
    notes = (f"the slices are {apart:.3g} mm apart, which was ignored",) if apart > _TILT else ()
    return matrix, notes


def _aligned(kind: Literal["rigid", "affine"], pair: _Pair) -> Alignment:
    """Return the alignment from positions in the fixed image to positions in the moving image.

    If the axes of the images are not parallel, the moving image is first resampled along the axes
    of the fixed image, because the alignment does not search mirror images, and prefers maps
    without a turn.
    """
    fixed, moving = pair.finite
    masks = pair.counted
    n = fixed.ndim
    turn = pair.positions[:n, :n]
    if np.abs(turn - np.eye(n)).max() < _PARALLEL:
        return align(
            kind,
            fixed,
            moving,
            spacing=pair.spacing,
            moving_spacing=pair.moving_spacing,
            masks=masks,
            start=pair.positions,
        )
    back = np.linalg.inv(turn)
    sizes = np.asarray(pair.moving_spacing)
    corners = np.array(np.meshgrid(*[(0, n - 1) for n in moving.shape], indexing="ij"))
    along = (corners.reshape(n, -1).T * sizes) @ back.T
    spacing = (back**2 @ sizes) / (back**2).sum(axis=1)
    start = along.min(axis=0)
    shape = tuple(np.ceil((along.max(axis=0) - start) / spacing - 1e-6).astype(int) + 1)

    def resampled(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        out = np.empty(shape, np.float32)
        scipy.ndimage.affine_transform(
            image.astype(np.float32),
            turn * spacing / sizes[:, None],
            turn @ start / sizes,
            output=out,
            order=1,
        )
        return out

    matrix = np.eye(n + 1)
    matrix[:n, :n], matrix[:n, n] = turn, turn @ start
    before = np.linalg.inv(matrix) @ pair.positions
    found = align(
        kind,
        fixed,
        resampled(moving),
        spacing=pair.spacing,
        moving_spacing=tuple(spacing.tolist()),
        masks=(masks[0], resampled(masks[1]) > 0.5),
        start=before,
    )
    if np.array_equal(found.matrix, before):
        return Alignment(pair.positions, found.notes)  # without rounding
    return Alignment(matrix @ found.matrix, found.notes)


def _landmarks(case: RegistrationCase, pair: _Pair, matrix: Float64Array) -> Landmarks:
    """Read landmarks; the alignment is removed from their targets."""
    assert case.landmarks is not None
    (file, there), name = read_pairs(case.landmarks, case.targets), case.landmarks.name
    n, sizes = len(pair.spacing), np.asarray(pair.spacing)
    points, targets = (
        in_pixels(file, points, read_picture_as(image, case.spacing, case.resample), name)[:, -n:]
        for image, points in ((case.fixed, file.points), (case.moving, there))
    )
    if not len(points):
        raise ProblemError(name, "contains no active landmarks. Give at least one active pair.")
    outside = int(are_outside(points, pair.study.grid.shape).sum())
    if outside:
        raise ProblemError(
            name,
            f"has {outside} of {len(points)} landmarks outside {case.fixed.name}. The first "
            "position of each pair is in this image, in the unit of the image. Remove landmarks "
            "outside the image.",
        )
    back = np.linalg.inv(matrix)
    there = targets * np.asarray(pair.moving_spacing)
    before = (there @ back[:n, :n].T + back[:n, n]) / sizes
    pixel = float(np.exp(np.log(sizes).mean()))
    sd = np.full(len(points), _USUAL_SD * pixel if case.landmark_sd is None else case.landmark_sd)
    if file.sd is not None:
        sd = np.where(file.sd > 0, file.sd, _EXACT * pixel)
    return Landmarks(points, before, sd=sd)


def _study_of(case: RegistrationCase, pair: _Pair, found: Registration) -> Study:
    """Return a study that moves tissue as the registration does."""
    motion = found.motion()
    assert motion.measured is not None
    origin = {"second image": stem_of(case.moving), "alignment": case.alignment or ""}
    # Once the registration is removed, the edge is held, as that of a new image.
    measured = replace(motion.measured, record=origin | found.record, frees_edge=True)
    motion = replace(motion, measured=measured)
    names = {**pair.study.names, "registration": case.moving.name}
    return replace(pair.study, motion=motion, prior=found.prior, names=names)


def _notes_on(
    found: Registration, solution: Solution, pair: _Pair, marks: Landmarks | None
) -> list[str]:
    """Return notes on contrast, folds, and the difference between study and registration."""
    notes = [] if found.relation == "same" else [relation_in_words(found.relation)]
    if found.folds:
        sites = sites_in_words(found.folds, solution.tissue.ndim)
        notes.append(f"the tissue folds over itself at {sites}")
    difference = np.abs(found.displacement - solution.displacement) / np.asarray(solution.spacing)
    if (apart := float(difference[solution.tissue].max(initial=0))) > _APART:
        reason = ""
        if np.isinf(pair.stiffness).any():
            reason = ", because rigid tissue turns exactly in the registration only"
        elif marks is not None:
            reason = (
                ": where the images contradict a landmark, the study follows the landmark more. "
                "Check the landmarks, or give them a larger --landmark-sd"
            )
        notes.append(
            f"the field of the study differs from the registered field by up to {apart:.2g} px"
            f"{reason}"
        )
    return notes


def _write_images(
    folder: Path, names: _Names, pair: _Pair, found: Registration, suffix: str
) -> list[str]:
    """Write images and field; return notes about files that were not written."""
    solution = found.solution
    image, other = pair.study.pictures.image, pair.other.pictures.image
    assert image is not None
    assert other is not None
    pictures = {
        names.deformed: solution.warp(image),
        names.registered: found.resample(other),
        names.jacobian: solution.jacobian(),
    }
    if found.missing is not None:
        pictures[names.missing] = found.missing.astype(np.uint8)
    for name, pixels in pictures.items():
        write_image(folder / name, result_image(pixels, solution, suffix))
    if not has_simpleitk():
        return [f"{names.field} was not written, because SimpleITK is not installed"]
    whole = replace(solution, displacement=_whole_displacement(pair, found))
    displacement, geometry = placed(whole)
    write_mapping(folder / names.field, displacement, **geometry.as_itk)
    return []


def _whole_displacement(pair: _Pair, found: Registration) -> npt.NDArray[np.floating]:
    """Return the displacement from the fixed to the moving image, including an alignment."""
    n = len(pair.spacing)
    total = np.linalg.inv(pair.positions) @ found.matrix
    if np.array_equal(pair.positions, found.matrix):
        return found.displacement
    sites = np.moveaxis(np.indices(pair.study.grid.shape), 0, -1) * np.asarray(pair.spacing)
    return np.asarray((sites + found.displacement) @ total[:n, :n].T + total[:n, n] - sites)


def _report_of(
    case: RegistrationCase, pair: _Pair, found: Registration, seconds: float
) -> dict[str, Any]:
    """Return the report of a registration, in JSON types."""
    grid = pair.study.grid
    tissue = found.solution.tissue
    largest = np.linalg.norm(found.displacement, axis=-1)[tissue].max(initial=0)
    return {
        "fixed": case.fixed.name,
        "moving": case.moving.name,
        "alignment": case.alignment,
        "matrix": found.matrix.tolist(),
        "smoothness": case.smoothness,
        "similarity": case.similarity,
        "relation": found.relation,
        "missing_sites": 0 if found.missing is None else int(found.missing.sum()),
        "similarity_before": round(found.similarity_before, _DECIMALS),
        "similarity_after": round(found.similarity, _DECIMALS),
        "largest_displacement": float(f"{largest:.4g}"),
        "sd": float(f"{found.sd:.3g}") if np.isfinite(found.sd) else None,
        "unit": unit_symbol(grid.unit),
        "folds": found.folds,
        "steps": len(found.history),
        "seconds": round(seconds, 2),
    }
