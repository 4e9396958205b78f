"""Trial run that compiles the loops and shaders of a drag before the first drag.

Compiled code is cached on disk, so compilation takes time only once per computer. Without the
trial run, the first drag would wait for the compiler.
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
from napari_hmrf.solver.solve import CancelFlag, Progress, solve

#: Number of sites along each axis of the small problem.
_SIZE = 24


def rehearse(
    prior: Prior,
    image: npt.NDArray[Any],
    spacing: tuple[float, ...],
    report: Progress,
    left: CancelFlag,
    more: bool = False,
) -> None:
    """Solve a small problem and warp a small image, to compile the code that a drag uses.

    Call on the compute thread only.

    Parameters
    ----------
    prior : Prior
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, channels)
        Image that the drag will warp; only a corner of it is used here.
    spacing : tuple of float, shape (n,)
        Size of a pixel of the image along each axis.
    report, left
        As `progress` and `cancel` of `solve`.
    more : bool
        If True, also compile code that only some drawings require: for constraints that may slip,
        painted labels, and confidence.
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
        slips = more and n == 2  # constraints of volumes do not slip
        prior = replace(prior, penalty=1.0 if slips else math.inf)
    y, c = np.zeros((2, *shape, n))
    c[0] = c[-1] = 1
    y[-1] = min(spacing)
    problem = Problem(observed=y, confidence=c, stiffness=np.ones(shape), spacing=spacing)
    small = prior.rehearsal(problem.shape)
    solve(problem, small, optimizer=Multigrid(TOLERANCE), progress=report, cancel=left)
    tissue = np.ones(np.shape(pictures[0].image)[:n], dtype=bool)
    # The tissue of a solution is read-only, and numba compiles separate loops for such arrays.
    tissue.setflags(write=False)
    for picture in pictures:
        Warper(picture, spacing=spacing)(np.zeros((*tissue.shape, n), np.float32), tissue)
