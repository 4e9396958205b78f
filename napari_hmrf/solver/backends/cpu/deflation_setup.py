"""Fields of moving rigid bodies, computed on a small level and interpolated to the finest level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import vectors
from napari_hmrf.solver.backends.cpu.deflation import CpuDeflation
from napari_hmrf.solver.backends.cpu.level import Vector
from napari_hmrf.solver.backends.linear import Steps
from napari_hmrf.solver.backends.rigid.bodies import Bodies

# Number of cycles on the small level. Approximate fields suffice, because deflation is exact for
# any field in which the body moves rigidly.
_CYCLES = 2
# Side length below which a body is treated as small, in sites of the small level.
_SMALL_BODY = 4


def build_deflation(
    bodies: Bodies,
    levels: Sequence[Any],
    small: Any | None,
    steps: Steps,
    coarsest: Steps,
    memory: Vector,
) -> CpuDeflation | None:
    """Return the deflation by the fields of all free motions, or None if there are none.

    Parameters
    ----------
    bodies : Bodies
        Rigid bodies and their free motions.
    levels : sequence of CpuElasticLevel
        Levels from the finest to the small level.
    small : CpuElasticLevel or None
        Copy of the small level with all bodies constrained, or None if the model has no small
        level.
    steps, coarsest : Steps
        Smoothing steps on all levels but the coarsest, and on the coarsest level.
    memory : ndarray, shape (2 * motions, 2, H + 4, W + 4)
        Memory for the fields, followed by their forces.
    """
    finest, above, number = levels[0], levels[-2:0:-1], len(levels) - 1
    shape = levels[-1].inverse.shape
    around = [_around(i, j, number, shape) for (i, j), _ in bodies.motions]
    close = bool((np.sum(around, axis=0) > 1).any())
    fields, forces = np.split(memory, 2)
    lengths: Vector = np.zeros(len(fields), dtype=np.float32)
    count = 0
    between = [level.vector() for level in above]
    for (sites, motions), touched in zip(bodies.motions, around, strict=True):
        # The small level resolves neither small bodies nor the gap between close bodies.
        rough = close or small is None or len(sites[0]) < (_SMALL_BODY << number) ** 2
        at_row, at_col = np.nonzero(touched)
        for motion in motions:
            field, force = fields[count], forces[count]
            field.fill(0)
            force.fill(0)
            d: Vector = np.zeros(shape, dtype=np.float32)
            d[:, at_row, at_col] = motion.of((at_row - 2) << number, (at_col - 2) << number)
            for _ in range(_CYCLES):
                if small is not None:
                    small.apply(d, small.load)
                    small.finish(steps, coarsest)
                    d -= small.correction
            lengths[count] = max(np.abs(d).max(), np.abs(motion.moved).max())
            for level, finer in zip(above, between, strict=True):
                finer.fill(0)
                vectors.interpolate(d, finer, level.inverse)
                d = finer
            if small is not None:
                vectors.interpolate(d, field, finest.inverse)
            field.reshape(-1)[motion.at] = motion.moved
            finest.apply(field, force)
            if rough:
                finest.load = force
                finest.relax(steps, from_zero=True)
                np.subtract(field, finest.correction, out=field)
                lengths[count] = np.abs(field).max()
                finest.apply(field, force)
            bodies.project(force)
            count += 1
    for level, vector in zip(above, between, strict=True):
        level.free(vector)
    return CpuDeflation(fields, forces, lengths, close) if count else None


def _around(
    i: npt.NDArray[np.intp], j: npt.NDArray[np.intp], number: int, shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Return the mask, with border, of coarse sites with basis functions that touch a body."""
    there: npt.NDArray[np.bool_] = np.zeros(shape[1:], dtype=np.bool_)
    size = (1 << number) - 1
    for row in (i >> number, (i + size) >> number):
        for col in (j >> number, (j + size) >> number):
            there[row + 2, col + 2] = True
    return there
