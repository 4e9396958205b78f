"""Solution of a preview, which is computed on every n-th pixel, on all pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.resample import BoolArray
from napari_hmrf.solver.solution import Solution


def on_finer_grid(solution: Solution, tissue: BoolArray, step: int) -> Solution:
    """Interpolate a solution on every `step`-th pixel linearly to all pixels.

    Parameters
    ----------
    solution : Solution
        Solution on the coarser grid, ([d,] h, w).
    tissue : ndarray of bool, shape ([D,] H, W)
        Tissue on the finer grid, including tissue that is removed.
    step : int
        Distance between neighbouring sites of the solution along each axis, in pixels.

    Returns
    -------
    Solution
        Solution on the finer grid, ([D,] H, W).
    """
    parts = np.moveaxis(solution.displacement, -1, 0)
    scale, shape = (1 / step,) * tissue.ndim, tissue.shape
    finer = [
        scipy.ndimage.affine_transform(part, scale, output_shape=shape, order=1, mode="nearest")
        for part in parts
    ]
    d = np.where(tissue[..., None], np.stack(finer, axis=-1), np.float32(0))
    spacing = tuple(size / step for size in solution.spacing)
    nearest = _nearest_sites(solution.tissue.shape, shape, step)
    elasticity = solution.elasticity and solution.elasticity.mapped(lambda each: each[nearest])
    removed = None if solution.removed is None else solution.removed[nearest] & tissue
    if removed is not None:
        tissue = tissue & ~removed
        d[removed] = 0
    return replace(
        solution,
        displacement=d,
        tissue=tissue,
        spacing=spacing,
        elasticity=elasticity,
        removed=removed,
    )


def mask_on_finer_grid(mask: BoolArray, shape: tuple[int, ...], step: int) -> BoolArray:
    """Return a mask on every `step`-th pixel, repeated for all pixels of a finer grid."""
    finer: BoolArray = mask[_nearest_sites(mask.shape, shape, step)]
    return finer


def _nearest_sites(
    sites: tuple[int, ...], shape: tuple[int, ...], step: int
) -> tuple[npt.NDArray[np.intp], ...]:
    """Return the index of the nearest site of a coarser grid for each pixel of a finer grid."""
    lines = (
        np.minimum(np.rint(np.arange(size) / step).astype(np.intp), last - 1)
        for size, last in zip(shape, sites, strict=True)
    )
    return np.ix_(*lines)
