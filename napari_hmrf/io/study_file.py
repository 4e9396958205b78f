"""Study files: a study and, optionally, its displacement field, which can be reproduced.

A study file is an archive of plain arrays and a text header (`napari_hmrf.archive`). Reading a
study file never executes code from the file, and study files are written atomically. The page
`docs/reference/files.md` lists all arrays.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.archive import STORED, Archive, is_foreign
from napari_hmrf.arguments import checked_target, require_kind
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.solver.solution import SUM, Solution
from napari_hmrf.solver.solve import Progress
from napari_hmrf.study.ground import build_problem, solve_study
from napari_hmrf.study.study import Study, Tissue

#: Suffix of study files.
SUFFIX = ".study"
#: Key of the record of the drawing in `Solution.frame`.
_DRAWING = "drawing"


@dataclass(frozen=True, eq=False)
class SavedStudy:
    """All that a study file contains; `StudyFile` is the part that scripts need.

    Attributes
    ----------
    study : Study
    solution : Solution or None
    digest : str
        Digest of the image, or "".
    overlay : str
        Name of the overlay in the window, or "".
    second : SecondPicture or None
        Second image on the grid of the study.
    arrows : bool or None
        Whether the window shows the arrows of the result; None if the file does not say.
    """

    __pydantic_config__ = STORED

    study: Study
    solution: Solution | None = None
    digest: str = ""
    overlay: str = ""
    second: SecondPicture | None = None
    arrows: bool | None = None

    def __post_init__(self) -> None:
        grid, second = self.study.grid, self.second
        if self.solution is not None:
            grid.require_grid_of(self.solution, "Use the solution of this study.")
        if second is not None and not second.pixels.shape == second.known.shape == grid.shape:
            raise ProblemError(
                "second image",
                f"has pixels of shape {second.pixels.shape}, but the study has the shape "
                f"{grid.shape}. Use a second image on the grid of the study.",
            )


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
    second: SecondPicture | None = None,
    arrows: bool | None = None,
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
    second : SecondPicture, optional
        Second image on the grid of the study, which the window opens with the study.
    arrows : bool, optional
        True if the window shows the arrows of the result when it opens the file. By default, the
        window keeps its own choice.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    ArgumentError
        If `study` is not a Study, `solution` is not a Solution, or `path` does not name a file.
    ProblemError
        If the shape, spacing or place of the solution, or the shape of the second image, differs
        from that of the study.
    OSError
        If the folder does not exist or the file cannot be written; the message names the file.
    TypeError, ValueError
        If a part of the study cannot be saved, such as an image of complex numbers.
    """
    require_kind(Study, "study", study, "Study(grid, tissue, motion)")
    if solution is not None:
        require_kind(Solution, "solution", solution, "the result of solve_study()")
        solution = _without_drawing(solution)
    target = Path(checked_target(path))
    if not target.suffix:
        target = target.with_name(target.name + SUFFIX)
    pictures = study.pictures
    digest = "" if pictures.image is None else _digest(pictures.image)
    if not image:
        study = replace(study, pictures=replace(pictures, image=None))
    return _STUDIES.write(target, SavedStudy(study, solution, digest, overlay, second, arrows))


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
    saved = read_saved(path)
    study, solution = saved.study, saved.solution
    if saved.digest and study.pictures.image is None and image is not None:
        if _digest(image) != saved.digest:
            raise FileFormatError(
                f"{Path(path).name}: the study was created from another image. Give the original "
                f"image '{study.pictures.name}'."
            )
        study = replace(study, pictures=replace(study.pictures, image=image))
    return StudyFile(study, solution)


def read_saved(path: str | os.PathLike[str]) -> SavedStudy:
    """Read all that a study file contains, with what only the window uses.

    Raises
    ------
    FileFormatError
        If the file is damaged or not a study file.
    OSError
        If the file cannot be opened.
    """
    saved = _STUDIES.read(path)
    solution = saved.solution
    if solution is None or solution.unit:
        return saved
    return replace(saved, solution=replace(solution, unit=saved.study.grid.unit))


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
    if is_foreign(path):
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
    """Return whether a file is a study file, according to its suffix .study or its header.

    The result is also True if the file is damaged, so that reading the file reports the error.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    bool
    """
    return os.fsdecode(path).lower().endswith(SUFFIX) or bool(_STUDIES.header(path))


def image_named_in(path: str | os.PathLike[str]) -> str:
    """Return the image name in the header of a study file, or "" if it cannot be read."""
    value: Any = _STUDIES.header(path)
    for key in ("study", "pictures", "name"):
        value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, str) else ""


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


def _is_of_image(tissue: Tissue) -> bool:
    return tissue.labels is None and tissue.stiffness is None


def _digest(image: npt.NDArray[Any]) -> str:
    plain = np.ascontiguousarray(image, dtype=np.asarray(image).dtype.newbyteorder("<"))
    return hashlib.sha256(f"{plain.dtype.str} {plain.shape}".encode() + plain.tobytes()).hexdigest()


def _without_drawing(solution: Solution) -> Solution:
    """Return a solution without its record of the drawing, which the study contains."""
    frame = {key: value for key, value in (solution.frame or {}).items() if key != _DRAWING}
    return replace(solution, frame=frame or None)


#: Kind of study files.
_STUDIES = Archive("napari-hmrf study", SavedStudy)
