"""Obstruction of a pull: the pulled regions that fold the elements which limit the pull."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.planes import Planes

Mask = npt.NDArray[np.bool_]
# Smallest mean Jacobian of an element that is divided by.
_TINY = 1e-300


def folding(d: Planes, way: Planes, sides: tuple[float, ...], elements: Mask) -> Planes:
    """Return weights by which a displacement folds elements, relative to a step.

    The sum of all weights times displacements is the rate at which the areas or volumes of the
    elements shrink, each divided by its rate along the step `way`. Along `way` itself, the sum is
    the number of elements that shrink.

    Parameters
    ----------
    d, way : ndarray, planes
        Displacement and step, in pixels.
    sides : tuple of float
        Size of a pixel or voxel along each axis.
    elements : ndarray of bool, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
        Elements that limit the step.

    Returns
    -------
    ndarray, planes
    """
    at = np.nonzero(elements)
    field, step = host.inside(d), host.inside(way)
    gradients = np.zeros((len(at[0]), len(sides), len(sides)))
    rates = np.zeros_like(gradients)
    for corner, slopes in _corners(at):
        gradients += _outer(field[(slice(None), *corner)], slopes)
        rates += _outer(step[(slice(None), *corner)], slopes)
    gradients += np.diag(sides)
    volumes = np.linalg.det(gradients)
    cofactors = np.linalg.inv(gradients).swapaxes(-1, -2) * volumes[:, np.newaxis, np.newaxis]
    shrinking = -np.einsum("eij,eij->e", cofactors, rates)
    shares = np.where(shrinking > 0, 1 / np.maximum(shrinking, _TINY), 0.0)
    weights = np.zeros_like(d)
    inner = host.inside(weights)
    for corner, slopes in _corners(at):
        pushes = -shares * np.einsum("eij,j->ie", cofactors, slopes)
        for component, push in zip(inner, pushes, strict=True):
            np.add.at(component, corner, push)
    return weights


def _corners(at: tuple[npt.NDArray[Any], ...]) -> Iterator[tuple[Any, npt.NDArray[np.float64]]]:
    """Yield the sites at each corner of elements, and their part of the mean gradient."""
    for ends in product((0, 1), repeat=len(at)):
        corner = tuple(index + end for index, end in zip(at, ends, strict=True))
        yield corner, (2.0 * np.array(ends) - 1) / 2 ** (len(at) - 1)


def _outer(values: npt.NDArray[Any], slopes: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the products of each component of each element with each slope."""
    return np.asarray(values.T[:, :, np.newaxis] * slopes)
