"""Functions for scripts, which warn of the notes that a script does not show.

The package itself calls the functions without warnings: the window and the shell show notes in
their own words.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import ParamSpec

from napari_hmrf.errors import NoteWarning
from napari_hmrf.io import study_file
from napari_hmrf.solver import solve as solving
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study import ground

P = ParamSpec("P")


def warning_of_notes(solve: Callable[P, Solution]) -> Callable[P, Solution]:
    """Return a function that also warns of each note of the solution it computes.

    Parameters
    ----------
    solve : callable
        Function that returns a `Solution`.
    """

    @functools.wraps(solve)
    def public(*args: P.args, **kwargs: P.kwargs) -> Solution:
        solution = solve(*args, **kwargs)
        for note in solution.notes:
            warnings.warn(note, NoteWarning, stacklevel=2)
        return solution

    public.__module__ = "napari_hmrf"
    return public


solve = warning_of_notes(solving.solve)
solve_study = warning_of_notes(ground.solve_study)
replay = warning_of_notes(study_file.replay)
