"""Initial field of large motion from the solution on a grid of half the resolution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import NeoHookeanPrior
from napari_hmrf.solver.problem import Problem

Values = npt.NDArray[Any]

# Displacement, in pixels, up to which a coarser grid does not save any work.
_SHORT = 4.0
# Number of sites along the shortest axis up to which a grid is not made coarser.
_SMALL = 40


def takes_coarse_start(problem: Problem) -> bool:
    """Return whether a solution on a coarser grid is a good initial field for a problem.

    Rigid tissue, loads, data and sliding parts are not converted to coarser grids.
    """
    has_more = problem.loads is not None or problem.has_data or problem.coupling is not None
    if has_more or problem.has_rigid or min(problem.shape) <= _SMALL:
        return False
    return float(np.abs(problem.observed).max()) > _SHORT * problem.unit


def coarse_problem(problem: Problem, prior: NeoHookeanPrior) -> tuple[Problem, NeoHookeanPrior]:
    """Return a problem on a grid of half the resolution; coarse site i coincides with site 2 i.

    A coarse site is tissue if any site around it is, and has the mean properties of this tissue. It
    is observed if the coinciding site is. Around held tissue, all coarse sites are held, so that it
    stays in place on the finer grid. Other observations, such as those of thin lines, move to the
    next coarse site, unless a neighbouring coarse site coincides with an observation.
    """
    tissue = problem.tissue
    stiffness = _means(problem.stiffness, tissue)
    ndim = len(problem.shape)
    observed, confidence = np.zeros((2, *stiffness.shape, ndim))
    for axis in range(ndim):
        known, values = _injected(problem.known[..., axis], problem.observed[..., axis])
        observed[..., axis], confidence[..., axis] = values, known
    coarse = Problem(
        observed=observed,
        confidence=confidence,
        stiffness=stiffness,
        spacing=tuple(2 * size for size in problem.spacing),
    )
    if np.ndim(prior.poisson):
        ratios = np.asarray(prior.poisson, dtype=np.float64)
        prior = replace(prior, poisson=_means(ratios, tissue).astype(np.float32))
    return coarse, prior


def _injected(known: Values, values: Values) -> tuple[Values, Values]:
    """Return mask and values of the coarse sites with an observation of one component."""
    shape = tuple(size // 2 + 1 for size in known.shape)
    every = (slice(None, None, 2),) * known.ndim
    # Pulled regions of more than one site are extended, so that all of their sites have the
    # observed displacement.
    inner = np.zeros(shape, dtype=bool)
    inner[tuple(slice(size) for size in known[every].shape)] = known[every]
    pulled = known & _refined(inner, known.shape, np.logical_or) & (values != 0)
    mask, coarse = _extrapolated(known, values)
    mask, coarse = mask[every].copy(), coarse[every].copy()
    near = _refined(mask, known.shape, np.logical_or)
    held = (_around(known & (values == 0)) > 0) & ~mask
    coarse[held] = 0
    mask |= held
    count = _around(pulled)
    beside = (count > 0) & ~mask
    coarse[beside] = _around(np.where(pulled, values, 0))[beside] / count[beside]
    mask |= beside
    lost = np.nonzero(known & ~near)
    to = tuple((index + 1) // 2 for index in lost)
    total, count = np.zeros((2, *shape))
    np.add.at(total, to, values[lost])
    np.add.at(count, to, 1)
    added = (count > 0) & ~mask
    coarse[added] = total[added] / count[added]
    mask |= added
    return mask, np.where(mask, coarse, 0)


def _extrapolated(known: Values, values: Values) -> tuple[Values, Values]:
    """Append a site along each axis of even size, because the last coarse site lies beyond it."""
    for axis, size in enumerate(known.shape):
        if size % 2 == 0:
            known, values = np.moveaxis(known, axis, 0), np.moveaxis(values, axis, 0)
            linear = np.where(known[-2], 2 * values[-1] - values[-2], values[-1])
            known = np.moveaxis(np.concatenate([known, known[-1:]]), 0, axis)
            values = np.moveaxis(np.concatenate([values, linear[None]]), 0, axis)
    return known, values


def _refined(values: Values, shape: tuple[int, ...], combine: Any) -> Values:
    """Return coarse values on the finer grid; `combine` merges two neighbours in between."""
    for axis, size in enumerate(shape):
        every = np.moveaxis(values, axis, 0)
        fine = np.empty((2 * len(every) - 1, *every.shape[1:]), dtype=every.dtype)
        fine[::2], fine[1::2] = every, combine(every[:-1], every[1:])
        values = np.moveaxis(fine[:size], 0, axis)
    return np.ascontiguousarray(values)


def prolonged(coarse: Values, shape: tuple[int, ...]) -> Values:
    """Interpolate a displacement linearly to the finer grid, in pixels of the finer grid.

    Linear interpolation preserves the signs of Jacobians, because it does not change the field
    within the coarse elements.

    Parameters
    ----------
    coarse : ndarray, shape (h, w, 2) or (d, h, w, 3)
        Displacement, in pixels of the coarse grid.
    shape : tuple of int
        Shape of the finer grid.
    """
    return _refined(2.0 * coarse, shape, lambda one, two: (one + two) / 2)


def _around(values: Values) -> Values:
    """Return the sums over the sites within one pixel of each coarse site, along all axes."""
    for axis, size in enumerate(values.shape):
        every = np.moveaxis(values, axis, 0)
        padded = np.zeros((2 * (size // 2 + 1) + 1, *every.shape[1:]))
        padded[1 : size + 1] = every
        values = np.moveaxis(padded[:-2:2] + padded[1:-1:2] + padded[2::2], 0, axis)
    return values


def _means(values: Values, mask: Values) -> Values:
    """Return the mean over the masked sites around each coarse site; 0 if there are none."""
    count = _around(mask)
    total = _around(np.where(mask, values, 0))
    return np.where(count > 0, total / np.maximum(count, 1), 0)
