"""Weight, and what presses or pulls at surfaces, as forces at sites.

Tissue ends where its elements do: its surface is made of the faces (in an image, the edges) that
belong to one element only. A force per volume or per area counts in equal parts at the corners of
an element or a face, as it does in finite elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.neighbours import around_sites, in_elements, of_corners, pairs
from napari_hmrf.solver.problem import checked_spacing
from napari_hmrf.solver.real_arrays import as_float32, check_finite

Float64Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Over how far the faces of a surface tell its slope, in pixels.
_SMOOTHING = 2.0


def weight(
    stiffness: npt.ArrayLike,
    acceleration: npt.ArrayLike,
    *,
    density: npt.ArrayLike = 1.0,
    spacing: float | Sequence[float],
) -> Loads:
    """Return the forces of the tissue's weight, or of another body force.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Of the problem: where it is above 0 there is tissue.
    acceleration : sequence of float, shape (n,)
        With its direction, components in the order of the axes. Times density it is a force per
        volume, in the unit of stiffness per length: water's weight is 0.00981 kPa / mm.
    density : float or array_like, shape (H, W) or (D, H, W)
        Of all tissue, or of each site.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        Naming the input at fault and what to do about it.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    way = _vector("acceleration", acceleration, tissue.shape, of_sites=False)
    heavy = _of_sites("density", density, tissue.shape)
    elements = in_elements(tissue)
    if not elements.any():
        raise ProblemError("stiffness", "has tissue nowhere two pixels wide, which has no weight.")
    share = math.prod(size) / 2**tissue.ndim
    mean = of_corners(heavy, np.add) / 2**tissue.ndim
    heaviness = share * around_sites(np.where(elements, mean, 0.0), np.add)
    return Loads(force=heaviness[..., None] * way, spacing=size)


def pressure(
    stiffness: npt.ArrayLike,
    surface: npt.ArrayLike,
    amount: npt.ArrayLike,
    *,
    spacing: float | Sequence[float],
) -> Loads:
    """Return the forces of a pressure on a painted part of the tissue's surface.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Of the problem: where it is above 0 there is tissue.
    surface : array_like of bool, shape (H, W) or (D, H, W)
        What is painted. A face of the surface is pressed if all its corners are in it; what is
        painted beside the surface does not matter. Tissue ends at the edge of the image, too.
    amount : float or array_like, shape (H, W) or (D, H, W)
        Force per area, in the unit of stiffness: above 0 it presses into the tissue, below 0 it
        sucks.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        Naming the input at fault and what to do about it.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    presses = _of_sites("amount", amount, tissue.shape)
    force = np.zeros((*tissue.shape, tissue.ndim))
    for faces in _surface(tissue, surface):
        area = math.prod(size) / size[faces.axis]
        inwards = -area * faces.outward * faces.mean(presses)
        force[..., faces.axis] += faces.corners(inwards)
    return Loads(force=force, spacing=size)


def traction(
    stiffness: npt.ArrayLike,
    surface: npt.ArrayLike,
    vector: npt.ArrayLike,
    *,
    spacing: float | Sequence[float],
) -> Loads:
    """Return the forces of a force per area, in any direction, on a painted part of the surface.

    A surface that is oblique is a staircase of faces, whose areas add up to more than its own: each
    face counts by how far it faces as the surface around it does.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Of the problem: where it is above 0 there is tissue.
    surface : array_like of bool, shape (H, W) or (D, H, W)
        What is painted, as for `pressure`.
    vector : array_like, shape (n,), (H, W, 2) or (D, H, W, 3)
        Force per area, in the unit of stiffness, components in the order of the axes: of all of the
        surface, or of each site.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        Naming the input at fault and what to do about it.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    pulls = _vector("vector", vector, tissue.shape, of_sites=True)
    force = np.zeros((*tissue.shape, tissue.ndim))
    for faces, area in _areas(_surface(tissue, surface), size):
        for along in range(tissue.ndim):
            force[..., along] += faces.corners(area * faces.mean(pulls[..., along]))
    return Loads(force=force, spacing=size)


class _Faces(NamedTuple):
    """The faces of a surface across one axis: all that there could be, of which some are there."""

    axis: int
    # 1 where tissue ends in the direction of the axis, -1 where it ends against it, 0 where not.
    outward: npt.NDArray[np.int8]

    def mean(self, values: npt.NDArray[Any]) -> Float64Array:
        """Return the mean over the corners of each face."""
        made = _across(values.astype(np.float64, copy=False), self.axis, np.add)
        return np.asarray(made / 2 ** (values.ndim - 1))

    def corners(self, values: Float64Array) -> Float64Array:
        """Spread the value of each face over its corners, in equal parts."""
        beside = [(0 if along == self.axis else 1,) * 2 for along in range(values.ndim)]
        made = _across(np.pad(values, beside), self.axis, np.add)
        return np.asarray(made / 2 ** (values.ndim - 1))


def _across(
    values: npt.NDArray[Any], axis: int, combine: Callable[[Any, Any], Any]
) -> npt.NDArray[Any]:
    """Combine the values at the corners of each face across an axis."""
    for along, (first, last) in enumerate(pairs(values.ndim)):
        if along != axis:
            values = combine(values[first], values[last])
    return values


def _surface(tissue: Mask, surface: npt.ArrayLike) -> list[_Faces]:
    """The painted faces of tissue's surface, for each axis."""
    painted = as_float32("surface", surface)
    if painted.shape != tissue.shape:
        raise ProblemError(
            "surface",
            f"has shape {painted.shape}, but stiffness has shape {tissue.shape}. Give both on the "
            "same pixel grid.",
        )
    mask, elements, found = painted > 0, in_elements(tissue), []
    for axis, (first, last) in enumerate(pairs(tissue.ndim)):
        ends = [(1 if along == axis else 0,) * 2 for along in range(tissue.ndim)]
        around = np.pad(elements, ends).astype(np.int8)
        outward = (around[first] - around[last]) * _across(mask, axis, np.logical_and)
        found.append(_Faces(axis, outward))
    if not any(faces.outward.any() for faces in found):
        raise ProblemError(
            "surface",
            "covers no face of tissue's surface, neither beside what is no tissue nor at the edge "
            "of the image. Paint all sites along a part of it.",
        )
    return found


def _areas(surface: list[_Faces], size: tuple[float, ...]) -> Iterator[tuple[_Faces, Float64Array]]:
    """The faces across each axis, each with its part of the area of a surface without steps."""
    axes = len(size)
    sigma = [_SMOOTHING * max(size) / each for each in size]
    # Area around each site that faces along an axis, or against it.
    around = {}
    for faces in surface:
        area = math.prod(size) / size[faces.axis]
        for way in (1, -1):
            there = area * faces.corners((faces.outward == way).astype(np.float64))
            around[faces.axis, way] = scipy.ndimage.gaussian_filter(there, sigma, mode="constant")
    most = [np.maximum(around[axis, 1], around[axis, -1]) for axis in range(axes)]
    for faces in surface:
        total = np.zeros(faces.outward.shape)
        for way in (1, -1):
            own = faces.mean(around[faces.axis, way])
            squares = sum(faces.mean(most[axis]) ** 2 for axis in range(axes) if axis != faces.axis)
            slope = np.sqrt(own**2 + squares)
            here = faces.outward == way
            total[here] = math.prod(size) / size[faces.axis] * own[here] / slope[here]
        yield faces, total


def _tissue(stiffness: npt.ArrayLike) -> Mask:
    m = as_float32("stiffness", stiffness)
    if m.ndim not in (2, 3):
        raise ProblemError(
            "stiffness",
            f"has shape {m.shape}, but a 2-D image (H, W) or a volume (D, H, W) is needed.",
        )
    return m > 0


def _size(stiffness: npt.ArrayLike, spacing: float | Sequence[float]) -> tuple[float, ...]:
    return checked_spacing(spacing, np.ndim(stiffness))


def _of_sites(name: str, values: npt.ArrayLike, grid: tuple[int, ...]) -> Float64Array:
    """One number for each site."""
    array = as_float32(name, values)
    if array.shape not in ((), grid):
        raise ProblemError(
            name, f"has shape {array.shape}. Give one number, or one for each site {grid}."
        )
    check_finite(name, array)
    return np.broadcast_to(array.astype(np.float64), grid)


def _vector(
    name: str, values: npt.ArrayLike, grid: tuple[int, ...], of_sites: bool
) -> Float64Array:
    """One vector, or one for each site."""
    array, axes = as_float32(name, values), len(grid)
    if array.shape != (axes,) and not (of_sites and array.shape == (*grid, axes)):
        each = f", or one for each site, {(*grid, axes)}" if of_sites else ""
        raise ProblemError(
            name,
            f"is {shown(values)}, of shape {array.shape}. Give {axes} components in the order of "
            f"the axes{each}.",
        )
    check_finite(name, array)
    made = array.astype(np.float64)
    return np.broadcast_to(made, (*grid, axes)) if of_sites else made
