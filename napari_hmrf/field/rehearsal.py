"""Compiling what tissue that follows the mouse will need, before the mouse is pressed.

Whatever was compiled on a machine once is there for good, so this mostly takes no time; where it
does, the first drag would wait for it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import CancelFlag, Progress, run_here

_SIZE = 24


def rehearse(
    prior: Prior,
    image: npt.NDArray[Any],
    spacing: tuple[float, ...],
    report: Progress,
    left: CancelFlag,
    more: bool = False,
) -> None:
    """Solve something small, and move a corner of a picture; on the compute thread only.

    Parameters
    ----------
    prior : Prior
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, channels)
        Will move.
    spacing : tuple of float, shape (n,)
        Of its pixels.
    report, left
        As `progress` and `cancel` of `solve`.
    more : bool
        Have ready what not every drawing needs: holds that may slip, paint, and confidence.
    """
    if left.is_set():
        return
    n = len(spacing)
    corner, shape = (slice(_SIZE),) * n, (_SIZE,) * n
    pictures = [Picture(image[corner], fill=emptiness(image, n))]
    if more:
        kinds = (np.uint8, np.float32)
        pictures = [Picture(np.zeros(shape, kind), order=0) for kind in kinds]
    if isinstance(prior, Elastic) and prior.penalty in (None, math.inf):
        slips = more and n == 2  # in volumes nothing does
        prior = replace(prior, penalty=1.0 if slips else math.inf)
    y, c = np.zeros((2, *shape, n))
    c[0] = c[-1] = 1
    y[-1] = min(spacing)
    problem = Problem(y, c, np.ones(shape), spacing=spacing)
    small = prior.rehearsal(problem.shape)
    run_here(problem, small, Multigrid(TOLERANCE), "auto", report, left)
    tissue = np.ones(np.shape(pictures[0].image)[:n], dtype=bool)
    tissue.setflags(write=False)  # as a solution's, which to numba is a type of its own
    for picture in pictures:
        Warper(picture, spacing=spacing)(np.zeros((*tissue.shape, n), np.float32), tissue)
