"""Fit of the tissues of a saved study to a second image file, or to its landmarks."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from napari_hmrf.errors import HmrfError, ProblemError, naming
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.registration_files import grey_image, relative_place
from napari_hmrf.io.study_file import read_study, write_study
from napari_hmrf.posterior.study_fit import StudyFit, fit_study
from napari_hmrf.registration.register import on_grid
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.solver.solve import Progress
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.boundary_rules import Material


def fit_file(
    path: Path,
    out: Path | None = None,
    *,
    second: Path | None = None,
    stiffness: Iterable[str] = (),
    growth: Iterable[str] = (),
    poisson: Iterable[str] = (),
    load: bool = False,
    backend: str = "auto",
    overwrite: bool = True,
    progress: Progress | None = None,
) -> StudyFit:
    """Fit the tissues of a study, and write the study with the fitted values.

    Parameters
    ----------
    path : Path
        Study with its image.
    out : Path, optional
        Study to write, with its field.
    second : Path, optional
        Image of the tissue after the motion, at its position in the world; by default, the
        landmarks of the study with a standard deviation are used.
    stiffness, growth, poisson : iterable of str
        Names or labels of the tissues whose property is fitted.
    load, backend, progress
        As for `fit_study`.
    overwrite : bool
        True if an existing file may be replaced.

    Returns
    -------
    StudyFit

    Raises
    ------
    HmrfError
        If a file is invalid, a tissue is unknown, or a property cannot be fitted.
    OSError
        If a file cannot be opened or written.
    """
    if out is not None:
        refuse_overwriting([out], overwrite=overwrite)
    study = read_study(path).study
    rows = study.tissue.materials
    with naming(**{"second image": "--second"}):
        found = fit_study(
            study,
            None if second is None else _second_picture(path, study, second),
            stiffness=_labels(rows, stiffness),
            growth=_labels(rows, growth),
            poisson=_labels(rows, poisson),
            load=load,
            backend=backend,
            progress=progress,
        )
    if out is not None:
        write_study(out, found.study, solve_study(found.study, backend=backend))
    return found


def _labels(rows: Iterable[Material], names: Iterable[str]) -> list[int]:
    """Return the labels of tissues that are given by their names or labels.

    Raises
    ------
    HmrfError
        If a tissue is not in the table.
    """
    known = {row.name.casefold(): row.label for row in rows if row.name}
    labels = {str(row.label): row.label for row in rows}
    found = []
    for name in names:
        label = known.get(name.casefold(), labels.get(name))
        if label is None:
            tissues = ", ".join(f"'{row.name or row.label}'" for row in rows)
            raise HmrfError(f"'{name}' is not a tissue of the study. Its tissues are {tissues}.")
        found.append(label)
    return found


def _second_picture(path: Path, study: Study, second: Path) -> SecondPicture:
    """Read an image, and interpolate it on the grid of a study."""
    other = read_case(Case(second))
    grid, moving = study.grid, other.grid
    axes = len(grid.shape)
    if len(moving.shape) != axes:
        raise ProblemError(
            second.name,
            f"has {len(moving.shape)} axes, but the study has {axes}. Give an image or volume like "
            "that of the study.",
        )
    matrix, _ = relative_place((path.name, second.name), study, other)
    grey = grey_image(other)
    known = np.isfinite(grey)
    every = np.ones(grid.shape, np.bool_)
    pair = on_grid(
        np.zeros(grid.shape, np.float32),
        np.where(known, grey, np.float32(0)),
        (every, known),
        grid.spacing,
        moving.spacing,
        matrix,
    )
    return SecondPicture(pair.moving, pair.counted[1], second.name)
