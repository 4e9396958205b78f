"""Study files: a study and, optionally, its displacement field, which can be reproduced.

A study file is an archive of plain arrays and a text header (`napari_hmrf.array_file`). Reading a
study file never executes code from the file, and study files are written atomically. The page
`docs/reference/files.md` lists all arrays.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter

from napari_hmrf import array_file
from napari_hmrf.arguments import checked_target, require_kind
from napari_hmrf.array_file import Invalid, Kind
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.solver.parameters import optimizer_from_dict, prior_from_dict
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.solution import SOLUTION_FORMAT, SUM, Solution
from napari_hmrf.solver.solve import Progress
from napari_hmrf.study.ground import build_problem, solve_study
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.study import SWITCHES, Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import MATERIALS, RULES
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.tissue.drawing.record import drawing_of, held_motion, record_of
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve

#: Suffix of study files.
SUFFIX = ".study"
#: Data types of label arrays in a file.
LABEL_TYPES = ("|u1", "<u2", "<u4", "<u8", "|i1", "<i2", "<i4", "<i8")
#: Data types of other arrays in a file.
_NUMBERS = ("|b1", *LABEL_TYPES, "<f2", "<f4", "<f8")
#: Key of the record of the drawing in `Solution.frame`.
_DRAWING = "drawing"
#: Prefix of the names of the solution's arrays.
_OF_SOLUTION = "solution_"
#: Penalties of an elastic prior that are stored as words: derived from the confidence, and exact.
_PENALTIES = {None: "inf", math.inf: "exact"}
#: Validators of values in the header.
_PRESET = TypeAdapter(Preset)
_SHAPE = TypeAdapter(tuple[int, ...])
_LENGTHS = TypeAdapter(tuple[float, ...])


class StudyFile(NamedTuple):
    """Content of a study file.

    Attributes
    ----------
    study : Study
    solution : Solution or None
        Solution of the study; None if the study was saved without a solution.
    """

    study: Study
    solution: Solution | None = None


def write_study(
    path: str | os.PathLike[str],
    study: Study,
    solution: Solution | None = None,
    *,
    image: bool = True,
    overlay: str = "",
    second: str = "",
) -> Path:
    """Write a study to a file atomically, optionally with its solution.

    Display settings of layers, such as colormaps, are not saved.

    Parameters
    ----------
    path : str or path-like
        Path of the file; ".study" is appended if the name has no suffix. An existing file is
        replaced when the new file is complete.
    study : Study
    solution : Solution, optional
        Solution of the study.
    image : bool
        True to save the image of the study. Otherwise, only the name and a digest of the image are
        saved, and the image must be passed to `read_study`.
    overlay : str, optional
        Name of the overlay that the window shows when it opens the file, such as "equivalent" (see
        `SoftTissue.overlay`). By default, the window keeps its own choice.
    second : str, optional
        Name of the second image, which is not in the file. The window asks for this image when it
        opens the file.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    ArgumentError
        If `study` is not a Study, `solution` is not a Solution, or `path` does not name a file.
    ProblemError
        If the shape, spacing or place of the solution differs from that of the study.
    OSError
        If the folder does not exist or the file cannot be written; the message names the file.
    TypeError, ValueError
        If a part of the study cannot be saved, such as an image of complex numbers.
    """
    require_kind(Study, "study", study, "Study(grid, tissue, motion)")
    if solution is not None:
        require_kind(Solution, "solution", solution, "the result of solve_study()")
        study.grid.require_grid_of(solution, "Use the solution of this study.")
    target = Path(checked_target(path))
    if not target.suffix:
        target = target.with_name(target.name + SUFFIX)
    return array_file.write(
        target, STUDY_FORMAT, _Content(study, solution, image, overlay=overlay, second=second)
    )


def read_study(path: str | os.PathLike[str], *, image: npt.NDArray[Any] | None = None) -> StudyFile:
    """Read a study file.

    Parameters
    ----------
    path : str or path-like
    image : ndarray, optional
        Image of the study, if the file contains only its name and digest.

    Returns
    -------
    StudyFile
        Named tuple of the `study` and its `solution`, which is None if the file contains no
        solution.

    Raises
    ------
    FileFormatError
        If the file is damaged or not a study file, or if `image` is not the image of the study.
    OSError
        If the file cannot be opened.
    """
    content = array_file.read(path, STUDY_FORMAT)
    study = content.study
    if content.digest and study.pictures.image is None and image is not None:
        if _digest(image) != content.digest:
            raise FileFormatError(
                f"{Path(path).name}: the study was created from another image. Give the original "
                f"image '{study.pictures.name}'."
            )
        study = replace(study, pictures=replace(study.pictures, image=image))
    return StudyFile(study, content.solution)


def read_solved(path: str | os.PathLike[str]) -> tuple[Study | None, Solution]:
    """Read a solved study or a saved result.

    Returns
    -------
    study : Study or None
        Study; None for a saved result.
    solution : Solution

    Raises
    ------
    FileFormatError
        If the file is neither a study nor a saved result, if it is damaged, or if the study was
        saved without its solution.
    OSError
        If the file cannot be opened.
    """
    if array_file.is_foreign(path):
        raise FileFormatError(
            f"{Path(path).name} is neither a study nor a result. Give a solved study ({SUFFIX}) or "
            "a saved result (.npz)."
        )
    if not is_study_file(path):
        return None, Solution.read(path)
    study, solution = read_study(path)
    if solution is None:
        raise FileFormatError(
            f"{Path(path).name}: the study was saved without its field. Solve it first."
        )
    return study, solution


def is_study_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a study file, according to its header.

    Only the header is read, so the result is also True if other parts of the file are damaged.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    bool
    """
    return array_file.claims_to_be(path, STUDY_FORMAT)


def image_named_in(path: str | os.PathLike[str]) -> str:
    """Return the image name in the header of a study file, or "" if it cannot be read."""
    pictures = array_file.header_of(path).get("pictures")
    return str(pictures.get("name", "")) if isinstance(pictures, dict) else ""


def overlay_named_in(path: str | os.PathLike[str]) -> str:
    """Return the name of the overlay in the header of a study file, or "" if there is none."""
    return _view_in(path, "overlay")


def second_image_named_in(path: str | os.PathLike[str]) -> str:
    """Return the name of the second image in the header of a study file, or ""."""
    return _view_in(path, "second")


def _view_in(path: str | os.PathLike[str], name: str) -> str:
    view = array_file.header_of(path).get("view")
    return str(view.get(name, "")) if isinstance(view, dict) else ""


def replay(
    path: str | os.PathLike[str],
    *,
    image: npt.NDArray[Any] | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Solve a saved study again, with the backend that computed its saved solution.

    The new solution is not compared with the saved solution; only the shell command `replay`
    compares them.

    If the saved field was computed with a cold start, as with `solve_study` or *Deform*, it is
    reproduced bit by bit on the same machine and with the same version, for any number of threads.
    If it was updated during edits in the window, it was computed with a warm start; the two fields
    then agree within the sum of their `convergence.error`. If it was computed before the loops were
    compiled, the last digits differ. The solution of a random deformation is a sum of solutions; it
    agrees within the same distance with the new solution, which the default backend computes.

    Parameters
    ----------
    path, image
        As for `read_study`.
    progress : callable, optional
        As for `solve`.

    Returns
    -------
    Solution
        New solution of the study.

    Raises
    ------
    HmrfError
        As for `read_study` and `solve_study`; or if the tissue is derived from the image, and the
        image is neither in the file nor passed.
    """
    study, solution = read_study(path, image=image)
    tissue = study.tissue
    if (
        study.pictures.image is None
        and study.pictures.name
        and (tissue.curve is not None or tissue.without_border or _is_of_image(tissue))
    ):
        raise HmrfError(
            f"{Path(path).name}: the tissue is derived from the image '{study.pictures.name}', "
            "which is not in the file. Give the image."
        )
    backend = "auto" if solution is None else solution.provenance.backend
    backend = "auto" if backend == SUM else backend
    return solve_study(study, stated=build_problem(study), backend=backend, progress=progress)


class _Content(NamedTuple):
    """Content of a file: study, solution, and names of the overlay and second image in the window.

    `image` is True if the image is included; `digest` is the digest of the image.
    """

    study: Study
    solution: Solution | None = None
    image: bool = True
    digest: str = ""
    overlay: str = ""
    second: str = ""


def _is_of_image(tissue: Tissue) -> bool:
    return tissue.labels is None and tissue.stiffness is None


def _digest(image: npt.NDArray[Any]) -> str:
    plain = np.ascontiguousarray(image, dtype=np.asarray(image).dtype.newbyteorder("<"))
    return hashlib.sha256(f"{plain.dtype.str} {plain.shape}".encode() + plain.tobytes()).hexdigest()


def _describe(content: _Content) -> tuple[array_file.Header, array_file.Arrays]:
    study, tissue, motion = content.study, content.study.tissue, content.study.motion
    pictures = study.pictures
    curve, preset, image = tissue.curve, tissue.preset, pictures.image
    header: dict[str, Any] = {
        "grid": {
            "shape": list(study.grid.shape),
            "spacing": list(study.grid.spacing),
            "unit": study.grid.unit,
            "place": study.grid.place and study.grid.place.as_dict(),
        },
        "tissue": {
            "materials": MATERIALS.dump_python(tissue.materials, mode="json"),
            "curve": None if curve is None else curve.as_dict(),
            "preset": None if preset is None else _PRESET.dump_python(preset, mode="json"),
            "unit": tissue.unit,
            "record": dict(tissue.record),
            "without_border": tissue.without_border,
        },
        "motion": {
            **{each.name: bool(getattr(motion, each.name)) for each in SWITCHES},
            "rules": RULES.dump_python(motion.rules, mode="json"),
            "drawing": record_of(motion.drawing),
            "weight": list(motion.weight),
            "typical_strain": motion.typical_strain,
            "drift": bool(motion.drift),
            "measured": None if motion.measured is None else dict(motion.measured.record),
        },
        "prior": _prior_as_dict(study.prior),
        "optimizer": study.optimizer.parameters,
        "pictures": {
            "name": pictures.name,
            "labels_name": pictures.labels_name,
            "digest": "" if image is None else _digest(image),
        },
        "names": dict(study.names),
        "notes": list(study.notes),
        "solution": None,
    }
    if motion.cavity != Cavity():
        header["motion"]["cavity"] = asdict(motion.cavity)
    view = {"overlay": content.overlay, "second": content.second}
    if any(view.values()):
        header["view"] = {name: value for name, value in view.items() if value}
    poisson = study.prior.poisson if isinstance(study.prior, Elastic) else 0.0
    arrays: dict[str, Any] = {
        "tissue_labels": tissue.labels,
        "stiffness": tissue.stiffness,
        "poisson": poisson if np.ndim(poisson) else None,
        "boundary_labels": motion.labels,
        "observed": motion.observed,
        "counts": motion.confidence,
        "patch_motion": held_motion(motion.drawing),
        "measured": None if motion.measured is None else motion.measured.displacement,
        "precision": None if motion.measured is None else motion.measured.packed(),
        "image": image if content.image else None,
        "labels": pictures.labels,
    }
    if content.solution is not None:
        header["solution"], of_solution = SOLUTION_FORMAT.describe(
            _without_drawing(content.solution)
        )
        arrays |= {_OF_SOLUTION + name: array for name, array in of_solution.items()}
    return header, {name: array for name, array in arrays.items() if array is not None}


def _without_drawing(solution: Solution) -> Solution:
    """Return a solution without its record of the drawing, which the study contains."""
    frame = solution.frame or {}
    if _DRAWING not in frame:
        return solution
    return replace(solution, frame={key: frame[key] for key in frame if key != _DRAWING} or None)


def _parse(header: array_file.Header, arrays: array_file.Arrays) -> _Content:
    tissue, motion = header["tissue"], header["motion"]
    pictures, curve, preset = header["pictures"], tissue["curve"], tissue["preset"]
    grid, place = header["grid"], header["grid"]["place"]
    try:
        place = None if place is None else Frame.from_dict(place)
    except ValueError as error:
        raise Invalid(str(error)) from None
    try:
        study = Study(
            Grid(
                _SHAPE.validate_python(grid["shape"]),
                _LENGTHS.validate_python(grid["spacing"]),
                grid["unit"],
                place,
            ),
            Tissue(
                labels=arrays.get("tissue_labels"),
                materials=MATERIALS.validate_python(tissue["materials"]),
                stiffness=arrays.get("stiffness"),
                curve=None if curve is None else StiffnessCurve.from_dict(curve),
                preset=None if preset is None else _PRESET.validate_python(preset),
                unit=str(tissue["unit"]),
                record=dict(tissue["record"]),
                without_border=bool(tissue["without_border"]),
            ),
            Motion(
                **{each.name: bool(motion[each.name]) for each in SWITCHES},
                labels=arrays.get("boundary_labels"),
                rules=RULES.validate_python(motion["rules"]),
                observed=arrays.get("observed"),
                confidence=arrays.get("counts"),
                drawing=drawing_of(motion["drawing"], arrays.get("patch_motion")),
                weight=_LENGTHS.validate_python(motion["weight"]),
                typical_strain=float(motion["typical_strain"]),
                drift=bool(motion["drift"]),
                cavity=Cavity(**motion.get("cavity", {})),
                measured=_measured_in(motion["measured"], arrays),
            ),
            prior=_prior_from_dict(header["prior"], arrays.get("poisson")),
            optimizer=optimizer_from_dict(header["optimizer"]),
            pictures=Pictures(
                image=arrays.get("image"),
                labels=arrays.get("labels"),
                name=str(pictures["name"]),
                labels_name=str(pictures["labels_name"]),
            ),
            names={part: str(name) for part, name in header["names"].items()},
            notes=tuple(str(note) for note in header["notes"]),
        )
    except HmrfError as error:
        raise Invalid(str(error)) from None
    solution, count = None, len(_OF_SOLUTION)
    if header["solution"] is not None:
        of_solution = {
            name[count:]: array for name, array in arrays.items() if name.startswith(_OF_SOLUTION)
        }
        solution = SOLUTION_FORMAT.parse(header["solution"], of_solution)
        try:
            study.grid.require_grid_of(solution, "Use the solution of this study.")
        except ProblemError as error:
            raise Invalid(f"its {error}") from None
        solution = replace(solution, unit=solution.unit or study.grid.unit)
    return _Content(study, solution, "image" in arrays, str(pictures["digest"]))


def _prior_as_dict(prior: Prior) -> dict[str, Any]:
    parameters = prior.parameters
    if isinstance(prior, Elastic) and prior.penalty in _PENALTIES:
        parameters["penalty"] = _PENALTIES[prior.penalty]
    return parameters


def _prior_from_dict(values: Mapping[str, Any], poisson: Any) -> Prior:
    words = {word: penalty for penalty, word in _PENALTIES.items()}
    penalty = values.get("penalty")
    if isinstance(penalty, str) and penalty in words:
        values = {**values, "penalty": words[penalty]}
    return prior_from_dict(values, poisson)


def _measured_in(record: Any, arrays: array_file.Arrays) -> MeasuredMotion | None:
    """Return the measured motion of a file; None if there is none."""
    if record is None:
        return None
    return MeasuredMotion.from_packed(arrays["measured"], arrays["precision"], dict(record))


#: Format of study files.
STUDY_FORMAT: array_file.Format[_Content] = array_file.Format(
    name="napari-hmrf study",
    schema=1,
    kind_name="napari-hmrf study",
    arrays={
        "tissue_labels": Kind(LABEL_TYPES, (2, 3), optional=True),
        "stiffness": Kind(_NUMBERS, (2, 3), optional=True),
        "poisson": Kind(("<f4",), (2, 3), optional=True),
        "boundary_labels": Kind(LABEL_TYPES, (2, 3), optional=True),
        "observed": Kind(_NUMBERS, (3, 4), optional=True),
        "counts": Kind(_NUMBERS, (2, 3, 4), optional=True),
        "patch_motion": Kind(("<f4",), (1,), optional=True),
        "measured": Kind(("<f4",), (3, 4), optional=True),
        "precision": Kind(("<f4",), (3, 4), optional=True),
        "image": Kind(_NUMBERS, (2, 3, 4), optional=True),
        "labels": Kind(LABEL_TYPES, (2, 3), optional=True),
    }
    | {
        _OF_SOLUTION + name: kind._replace(optional=True)
        for name, kind in SOLUTION_FORMAT.arrays.items()
    },
    describe=_describe,
    parse=_parse,
    precheck=_parse,
)
