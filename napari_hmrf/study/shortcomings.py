"""Shortcomings of a solution: folds, and motion or growth that was applied only in part."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.units import unit_symbol
from napari_hmrf.notes import Note
from napari_hmrf.real_arrays import sites_in_words
from napari_hmrf.solver.caveats import in_the_way, shortfall, touching
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: Kind of the note about folds.
FOLDS = "folds"


def shortcomings(
    solution: Solution,
    unit: str,
    folds: int,
    problem: Problem | None = None,
    edge: npt.NDArray[np.bool_] | None = None,
) -> Iterator[str]:
    """Yield the shortcomings of a solution as clauses for the user.

    Parameters
    ----------
    solution : Solution
    unit : str
        Name of the unit of lengths.
    folds : int
        Number of sites that fold, as returned by `count_folds`; 0 if folds were not counted.
    problem : Problem, optional
        Problem of the solution, in which to look for the cause.
    edge : ndarray of bool, shape ([D,] H, W), optional
        Outer edge of the tissue, if it is held.

    Yields
    ------
    str
    """
    if folds:
        sites = sites_in_words(folds, solution.tissue.ndim)
        yield Note(
            f"the tissue folds over itself at {sites}, which is impossible: move it less",
            kind=FOLDS,
        )
    # `unit_symbol` imports pint, which is slow, so call it for large motion only.
    short = shortfall(solution.reach, unit_symbol(unit)) if solution.reach is not None else ""
    has_stopped = solution.reach is not None and solution.reach.stopped
    cause = ""
    if problem is not None and (short or folds):
        cause = touching(problem, edge)
        if not cause and solution.reach is not None:
            cause = in_the_way(problem, solution.reach, edge)
    # More work comes first where it helps, because it may move the tissue all the way.
    yield from filter(None, (short, cause) if has_stopped else (cause, short))
