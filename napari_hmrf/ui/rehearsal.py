"""Compiling what tissue that follows the mouse will need, before the mouse is pressed.

Whatever was compiled on a machine once is there for good, so this mostly takes no time; where it
does, the first drag would wait for it.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from napari_hmrf.errors import Cancelled
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import CancelFlag, Progress, run_here
from napari_hmrf.study.study import Study

_SIZE = 24
_log = logging.getLogger("napari_hmrf")
#: Of this process.
_moved: set[str] = set()
_solved: set[tuple[str, bool]] = set()


def rehearse(study: Study, report: Progress | None, left: CancelFlag) -> None:
    """Solve something small, and move a corner of the picture; on the compute thread only."""
    picture = study.pictures.image
    _solve(study, study.prior, report, left)
    if left.is_set() or picture is None:
        return
    _move(Picture(picture[:_SIZE, :_SIZE], fill=emptiness(picture)))


def rehearse_the_rest(study: Study, left: CancelFlag) -> None:
    """The same with what not every drawing needs: holds that may slip, paint, and confidence."""
    if left.is_set():
        return
    prior = study.prior
    if isinstance(prior, ElasticPrior) and prior.penalty == math.inf:
        _solve(study, replace(prior, penalty=1.0), None, left)
    for kind in (np.uint8, np.float32):
        _move(Picture(np.zeros((_SIZE, _SIZE), kind), order=0))


def _solve(study: Study, prior: Prior, report: Progress | None, left: CancelFlag) -> None:
    spacing = study.grid.spacing
    key = (prior.kernels, len(set(spacing)) == 1)
    if key in _solved:
        return
    y, c = np.zeros((2, _SIZE, _SIZE, 2))
    c[0] = c[-1] = 1
    y[-1] = min(spacing)
    problem = Problem(y, c, np.ones((_SIZE, _SIZE)), spacing=spacing)
    small = prior.rehearsal(problem.shape)
    try:
        run_here(problem, small, Multigrid(TOLERANCE), "auto", report, left)
    except Cancelled:
        return
    except Exception:  # noqa: BLE001 - whoever draws is told of it
        _log.debug("a rehearsal failed", exc_info=True)
    _solved.add(key)


def _move(picture: Picture) -> None:
    image = np.asarray(picture.image)
    key = f"{image.dtype.str} {picture.order}"
    if key in _moved:
        return
    try:
        tissue = np.ones(image.shape[:2], dtype=bool)
        tissue.setflags(write=False)  # as a solution's, which to numba is a type of its own
        Warper(picture)(np.zeros((*tissue.shape, 2), np.float32), tissue)
    except Exception:  # noqa: BLE001 - whoever draws is told of it
        _log.debug("a rehearsal failed", exc_info=True)
    _moved.add(key)
