"""Forces at sites due to weight, pressure, traction, and the contents of a cavity.

The surface of the tissue consists of the faces (in an image, the edges) that belong to a single
element. A force per volume or area is distributed equally to the corners of the element or face, as
in finite elements. The pressure of a fluid varies linearly on a face, so each corner bears the part
that its shape function weighs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import real, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners, pairs
from napari_hmrf.real_arrays import as_float32, as_mask, check_finite, checked_spacing
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.problem import check_each_stiffness

Float64Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Standard deviation of the Gaussian that smooths a surface to estimate its slope, in pixels.
_SMOOTHING = 2.0


def weight(
    stiffness: npt.ArrayLike,
    acceleration: npt.ArrayLike,
    *,
    density: npt.ArrayLike = 1.0,
    spacing: float | Sequence[float],
) -> Loads:
    """Return the loads due to the weight of the tissue or another body force.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Stiffness of the problem; above 0 in tissue.
    acceleration : sequence of float, shape (n,)
        Acceleration vector, with components in the order of the axes. Its product with the density
        is a force per volume, in the unit of stiffness per unit of length; for water, it is 0.00981
        kPa / mm.
    density : float or array_like, shape (H, W) or (D, H, W)
        Density of all tissue or of each site.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    vector = _vector("acceleration", acceleration, tissue.shape, of_sites=False)
    density_of_sites = _of_sites("density", density, tissue.shape)
    elements = in_elements(tissue)
    if not elements.any():
        raise ProblemError(
            "stiffness",
            "has no tissue that is two pixels wide, so its weight has no effect. Make the "
            "tissue wider.",
        )
    share = math.prod(size) / 2**tissue.ndim
    mean = of_corners(density_of_sites, np.add) / 2**tissue.ndim
    mass = share * around_sites(np.where(elements, mean, 0.0), np.add)
    return Loads(force=mass[..., None] * vector, spacing=size)


def pressure(
    stiffness: npt.ArrayLike,
    surface: npt.ArrayLike,
    amount: npt.ArrayLike,
    *,
    spacing: float | Sequence[float],
) -> Loads:
    """Return the loads due to a pressure on a marked part of the tissue's surface.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Stiffness of the problem; above 0 in tissue.
    surface : array_like of bool, shape (H, W) or (D, H, W)
        Mask of marked sites. The pressure acts on each face of the surface with all corners marked;
        other marked sites have no effect. The surface includes the edge of the image.
    amount : float or array_like, shape (H, W) or (D, H, W)
        Force per area, in the unit of stiffness. Positive values push into the tissue; negative
        values pull outwards.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
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
    """Return the loads due to a traction on a marked part of the tissue's surface.

    The traction may have any direction. On the pixel grid, an oblique surface is a staircase of
    faces with a larger total area. The area of each face is therefore multiplied by the cosine of
    the angle between the face and the smoothed surface.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Stiffness of the problem; above 0 in tissue.
    surface : array_like of bool, shape (H, W) or (D, H, W)
        Mask of marked sites, as for `pressure`.
    vector : array_like, shape (n,), (H, W, 2) or (D, H, W, 3)
        Force per area, in the unit of stiffness, with components in the order of the axes: one
        vector for the whole surface, or one vector for each site.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    pulls = _vector("vector", vector, tissue.shape, of_sites=True)
    force = np.zeros((*tissue.shape, tissue.ndim))
    for faces, area in _areas(_surface(tissue, surface), size):
        for along in range(tissue.ndim):
            force[..., along] += faces.corners(area * faces.mean(pulls[..., along]))
    return Loads(force=force, spacing=size)


def cavity(
    stiffness: npt.ArrayLike,
    removed: npt.ArrayLike,
    *,
    spacing: float | Sequence[float],
    pressure: float = 0.0,
    fluid: npt.ArrayLike | None = None,
    level: float = 1.0,
) -> Loads:
    """Return the loads on the surface that appears where tissue is removed.

    This surface consists of the faces between a removed element and a remaining element. An element
    is removed if any of its corners is removed. At height z, the load is the pressure
    ``pressure + |fluid| max(0, z_level - z)``, along the normal of the face into the tissue. On a
    face, the pressure is interpolated linearly between its values at the corners.

    Parameters
    ----------
    stiffness : array_like, shape (H, W) or (D, H, W)
        Stiffness of the problem: above 0 in the remaining tissue. Values at removed sites are
        ignored.
    removed : array_like of bool, shape (H, W) or (D, H, W)
        Mask of the removed tissue.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel, as in the problem; a single number applies to all axes.
    pressure : float
        Constant pressure in the cavity, in the unit of stiffness. Negative values are suction.
    fluid : sequence of float, shape (n,), optional
        Weight of the fluid per volume: its density times the acceleration due to gravity, as a
        vector that points downwards, in the order of the axes and in the unit of stiffness per
        length. By default there is no fluid.
    level : float
        Height of the fluid, as a fraction of the height of the surface: 0 at its lowest site, 1 at
        its highest site. Values above 1 mean fluid that stands above the cavity.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """
    tissue, size = _tissue(stiffness), _size(stiffness, spacing)
    hole = _sites_of("removed", removed, tissue)
    remaining = tissue & ~hole
    if not (hole.any() and remaining.any()):
        what = "all of the tissue" if hole.any() else "no removed tissue"
        raise ProblemError("removed", f"has {what}. Mark the pixels of the cavity.")
    if not (math.isfinite(real(pressure)) and 0 <= real(level) < math.inf):
        raise ProblemError(
            "cavity",
            f"has the pressure {shown(pressure)} and the level {shown(level)}. Pass a finite "
            "pressure, and a level of 0 (empty) or more.",
        )
    faces_of_axes = [*_new_faces(remaining, hole)]
    presses = np.full(tissue.shape, float(pressure))
    if fluid is not None:
        down = _vector("fluid", fluid, tissue.shape, of_sites=False)
        presses += _fluid_pressure(faces_of_axes, down, level, size)
    force = np.zeros((*tissue.shape, tissue.ndim))
    for faces in faces_of_axes:
        area = math.prod(size) / size[faces.axis]
        force[..., faces.axis] -= area * faces.consistent(presses)
    return Loads(force=force, spacing=size)


def _new_faces(remaining: Mask, hole: Mask) -> Iterator[_Faces]:
    """Yield the faces between remaining and removed elements, for each axis."""
    elements = in_elements(remaining)
    gone = in_elements(remaining | hole) & ~elements
    for axis, (first, last) in enumerate(pairs(remaining.ndim)):
        ends = [(1 if along == axis else 0,) * 2 for along in range(remaining.ndim)]
        around, holes = np.pad(elements, ends), np.pad(gone, ends)
        before, after = around[first] & holes[last], around[last] & holes[first]
        yield _Faces(axis, before.astype(np.int8) - after.astype(np.int8))


def _fluid_pressure(
    faces_of_axes: list[_Faces], down: Float64Array, level: float, size: tuple[float, ...]
) -> Float64Array:
    """Return the pressure of a fluid at each site, given its weight per volume as a vector."""
    heaviness = float(np.linalg.norm(down))
    shape = np.add(faces_of_axes[0].outward.shape, [int(axis != 0) for axis in range(len(size))])
    if heaviness == 0:
        return np.zeros(shape)
    lines = np.ix_(*(np.arange(count) * length for count, length in zip(shape, size, strict=True)))
    depth = sum(line * part / heaviness for line, part in zip(lines, down, strict=True))
    at_surface = np.zeros(shape, dtype=bool)
    for faces in faces_of_axes:
        at_surface |= faces.corners((faces.outward != 0).astype(np.float64)) > 0
    if not at_surface.any():
        return np.zeros(shape)
    highest, lowest = depth[at_surface].min(), depth[at_surface].max()
    return np.asarray(heaviness * np.maximum(depth - (lowest - level * (lowest - highest)), 0))


class _Faces(NamedTuple):
    """Faces of a grid perpendicular to one axis, with the sign of their outward normal."""

    axis: int
    # Sign of the outward normal along the axis; 0 for faces that are not part of the surface.
    outward: npt.NDArray[np.int8]

    def mean(self, values: npt.NDArray[Any]) -> Float64Array:
        """Return the mean of the site values at the corners of each face."""
        total = _across(values.astype(np.float64, copy=False), self.axis, np.add)
        return np.asarray(total / 2 ** (values.ndim - 1))

    def corners(self, values: Float64Array) -> Float64Array:
        """Distribute the value of each face equally to its corners."""
        padding = [(0 if along == self.axis else 1,) * 2 for along in range(values.ndim)]
        total = _across(np.pad(values, padding), self.axis, np.add)
        return np.asarray(total / 2 ** (values.ndim - 1))

    def consistent(self, values: Float64Array) -> Float64Array:
        """Distribute a normal traction, given at sites, to the corners of each face.

        Returns the integrals of the traction times the shape function of each site, along the
        outward normal and for faces of area 1, for bilinear shape functions: the weight of one
        corner for another corner is 1/3 for each axis on which they agree, and 1/6 for others.
        """
        total = np.zeros(values.shape)
        corners = [*product((0, 1), repeat=values.ndim - 1)]
        for corner in corners:
            borne = np.zeros(self.outward.shape)
            for other in corners:
                apart = sum(map(int.__ne__, corner, other))
                share = 1 / (3 ** (values.ndim - 1 - apart) * 6**apart)
                borne += share * values[self._at(other)]
            total[self._at(corner)] += self.outward * borne
        return total

    def _at(self, corner: tuple[int, ...]) -> tuple[slice, ...]:
        """Return the index of the sites at a corner, which is 0 or 1 for each axis of a face."""
        ends = [*corner]
        ends.insert(self.axis, 0)
        sizes = zip(ends, self.outward.shape, strict=True)
        return tuple(slice(end, end + size) for end, size in sizes)


def _across(
    values: npt.NDArray[Any], axis: int, combine: Callable[[Any, Any], Any]
) -> npt.NDArray[Any]:
    """Combine the values at the corners of each face perpendicular to an axis."""
    for along, (first, last) in enumerate(pairs(values.ndim)):
        if along != axis:
            values = combine(values[first], values[last])
    return values


def _surface(tissue: Mask, surface: npt.ArrayLike) -> list[_Faces]:
    """Return the marked faces of the tissue's surface, for each axis."""
    mask, elements, faces_of_axes = _sites_of("surface", surface, tissue), in_elements(tissue), []
    for axis, (first, last) in enumerate(pairs(tissue.ndim)):
        ends = [(1 if along == axis else 0,) * 2 for along in range(tissue.ndim)]
        around = np.pad(elements, ends).astype(np.int8)
        outward = (around[first] - around[last]) * _across(mask, axis, np.logical_and)
        faces_of_axes.append(_Faces(axis, outward))
    if not any(faces.outward.any() for faces in faces_of_axes):
        raise ProblemError(
            "surface",
            "covers no face of the tissue's surface, neither next to void nor at the edge of the "
            "image. Paint all sites along a part of the surface.",
        )
    return faces_of_axes


def _areas(surface: list[_Faces], size: tuple[float, ...]) -> Iterator[tuple[_Faces, Float64Array]]:
    """Yield the faces perpendicular to each axis, with areas corrected for the staircase effect."""
    axes = len(size)
    sigma = [_SMOOTHING * max(size) / length for length in size]
    # Smoothed area at each site, for each axis and sign of the normal.
    around = {}
    for faces in surface:
        area = math.prod(size) / size[faces.axis]
        for sign in (1, -1):
            at_sites = area * faces.corners((faces.outward == sign).astype(np.float64))
            smoothed = scipy.ndimage.gaussian_filter(at_sites, sigma, mode="constant")
            around[faces.axis, sign] = smoothed
    largest = [np.maximum(around[axis, 1], around[axis, -1]) for axis in range(axes)]
    for faces in surface:
        total = np.zeros(faces.outward.shape)
        for sign in (1, -1):
            own = faces.mean(around[faces.axis, sign])
            squares = sum(
                faces.mean(largest[axis]) ** 2 for axis in range(axes) if axis != faces.axis
            )
            slope = np.sqrt(own**2 + squares)
            facing = faces.outward == sign
            total[facing] = math.prod(size) / size[faces.axis] * own[facing] / slope[facing]
        yield faces, total


def _sites_of(name: str, mask: npt.ArrayLike, tissue: Mask) -> Mask:
    """Return a validated mask on the grid of the tissue."""
    sites = as_mask(name, mask)
    if sites.shape != tissue.shape:
        raise ProblemError(
            name,
            f"has shape {sites.shape}, but stiffness has shape {tissue.shape}. Use the same pixel "
            "grid for both.",
        )
    return sites


def _tissue(stiffness: npt.ArrayLike) -> Mask:
    m = as_float32("stiffness", stiffness)
    if m.ndim not in (2, 3):
        raise ProblemError(
            "stiffness",
            f"has shape {m.shape}, but a 2-D image (H, W) or a volume (D, H, W) is needed.",
        )
    check_each_stiffness(m)
    return m > 0


def _size(stiffness: npt.ArrayLike, spacing: float | Sequence[float]) -> tuple[float, ...]:
    return checked_spacing(spacing, np.ndim(stiffness))


def _of_sites(name: str, values: npt.ArrayLike, grid: tuple[int, ...]) -> Float64Array:
    """Return one number, or one number for each site, as a validated array on the grid."""
    array = as_float32(name, values)
    if array.shape not in ((), grid):
        raise ProblemError(
            name, f"has shape {array.shape}. Pass one number, or one for each site {grid}."
        )
    check_finite(name, array)
    return np.broadcast_to(array.astype(np.float64), grid)


def _vector(
    name: str, values: npt.ArrayLike, grid: tuple[int, ...], of_sites: bool
) -> Float64Array:
    """Return a validated vector; with `of_sites`, one vector for each site of the grid."""
    array, axes = as_float32(name, values), len(grid)
    if array.shape != (axes,) and not (of_sites and array.shape == (*grid, axes)):
        or_field = f", or a vector for each site, {(*grid, axes)}" if of_sites else ""
        raise ProblemError(
            name,
            f"is {shown(values)}, of shape {array.shape}. Pass {axes} components in the order of "
            f"the axes{or_field}.",
        )
    check_finite(name, array)
    vectors = array.astype(np.float64)
    return np.broadcast_to(vectors, (*grid, axes)) if of_sites else vectors
