"""Rigid bodies and their rigid motions, as a constraint on displacements.

The sites of a body are the corners of all elements that have an infinitely stiff corner. Adjacent
sites belong to the same body. A body has three rigid motions in an image and six in a volume: a
translation along each axis, and small rotations. Constrained components may prevent some of these
motions. To solve a linear system under this constraint, the displacement of a body's sites is
projected orthogonally onto the free rigid motions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.priors.elements import ElasticMaterial

Float64Array = npt.NDArray[np.float64]
BodySites = tuple[npt.NDArray[np.intp], ...]

# Largest number of bodies for which deflation is used, and largest number of values in all
# deflation fields.
_MOST_BODIES, _MOST_VALUES = 8, 4e7

# Eigenvalue, times the number of components of the body, below which a motion is free.
_NOTHING = 1e-9
# Part of a force that no distribution within the limits carries and that is rounding error.
_MISSING = 1e-6
# Largest distance of observations from a rigid motion: in pixels, and relative to the largest
# observed value.
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """Components of a body as indices into flattened planes, and its rigid and free motions."""

    # The columns of `motions` are orthonormal. `free` and `single` contain the free motions in
    # double and in single precision. `ways` contains the coefficients of the free motions with
    # respect to the translations along the axes and the rotations around `centre`.

    at: npt.NDArray[np.intp]
    held: npt.NDArray[np.bool_]
    motions: Float64Array
    free: Float64Array
    single: npt.NDArray[np.float32]
    centre: tuple[float, ...]
    ways: Float64Array


class Motion(NamedTuple):
    """Free motion of a body: indices of its components in flattened planes, and displacements.

    The displacement of a point x is ``step + turn @ (x - centre)``.
    """

    at: npt.NDArray[np.intp]
    moved: npt.NDArray[np.float32]
    centre: tuple[float, ...]
    step: Float64Array
    turn: Float64Array

    def of(self, *sites: npt.NDArray[np.intp]) -> Float64Array:
        """Return the displacement, shape (axes, points), of arbitrary points."""
        from_centre = np.stack(sites) - np.array(self.centre)[:, None]
        return np.asarray(self.step[:, None] + self.turn @ from_centre)


class Bodies:
    """Rigid bodies of a tissue under given constraints.

    Parameters
    ----------
    sites : list of tuple of ndarray
        Indices of each body's sites along each axis, as returned by `bodies_of`.
    material : ElasticMaterial
    held : ndarray of bool, planes
        Mask of the constrained components.
    moved : ndarray, planes, optional
        Current displacement of the bodies, in pixels; by default zero.
    """

    def __init__(
        self,
        sites: Sequence[BodySites],
        material: ElasticMaterial,
        held: HeldPlanes,
        moved: Planes | None = None,
    ) -> None:
        self._sites, grid = sites, held.shape[1:]
        self._sides = np.array(material.shape.sides)
        #: True if cycles keep the bodies fixed and deflation moves them.
        self.is_deflated = can_deflate(sites, material.m.shape)
        self._bodies = []
        for of_body in sites:
            first = np.ravel_multi_index(tuple(index + 2 for index in of_body), grid)
            at = np.concatenate([first + k * math.prod(grid) for k in range(len(grid))])
            centre = tuple(float(index.mean()) for index in of_body)
            places = self._sides * (np.stack(of_body, axis=-1) - centre)
            if moved is not None:
                places = places + moved.reshape(-1)[at].reshape(len(grid), -1).T
                places -= places.mean(axis=0)
            steps_and_turns = self._steps_and_turns(places)
            motions, mix = np.linalg.qr(steps_and_turns)
            stopped = held.ravel()[at]
            some = motions[stopped]
            stops, ways = np.linalg.eigh(some.T @ some)
            ways = ways[:, stops < _NOTHING / len(at)]
            free = motions @ ways
            single = free.astype(np.float32)
            made_of = np.linalg.solve(mix, ways)
            self._bodies.append(_Body(at, stopped, motions, free, single, centre, made_of))

    @staticmethod
    def _steps_and_turns(places: Float64Array) -> Float64Array:
        """Return all rigid motions of points as columns, grouped by component."""
        count, axes = places.shape
        made = [np.repeat(axis, count) for axis in np.eye(axes)]
        for turn in small_rotations(axes):
            made.append((turn @ places.T).ravel())
        return np.stack(made, axis=1)

    def hold(self, held: HeldPlanes) -> HeldPlanes:
        """Return a copy of a mask of constrained components that includes all bodies."""
        all_held = held.copy()
        for body in self._bodies:
            all_held.reshape(-1)[body.at] = True
        return all_held

    @property
    def freedom(self) -> int:
        """Total number of free motions of all bodies."""
        return sum(body.free.shape[1] for body in self._bodies)

    @property
    def motions(self) -> Iterator[tuple[BodySites, list[Motion]]]:
        """Sites and free motions of each body."""
        axes = len(self._sides)
        for sites, body in zip(self._sites, self._bodies, strict=True):
            motions = []
            for way, moved in zip(body.ways.T, body.single.T, strict=True):
                turns = zip(way[axes:], small_rotations(axes), strict=True)
                turn = sum(share * matrix for share, matrix in turns) * self._sides
                motions.append(Motion(body.at, moved, body.centre, way[:axes], turn))
            yield sites, motions

    def make_rigid(self, d: Planes) -> None:
        """Replace the displacement of each body by the nearest rigid motion, in place.

        The motion satisfies the constraints of the body.

        Raises
        ------
        ProblemError
            If no rigid motion satisfies the constraints of a body.
        """
        flat = d.reshape(-1)
        for body in self._bodies:
            seen, some = flat[body.at[body.held]], body.motions[body.held]
            shares = np.linalg.lstsq(some, seen, rcond=1e-9)[0]
            off = float(np.abs(some @ shares - seen).max(initial=0.0))
            if off > _OFF + _PART * float(np.abs(seen).max(initial=0.0)):
                around = ", ".join(f"{index:.0f}" for index in body.centre)
                raise ProblemError(
                    "observed",
                    f"moves pixels of the rigid body around ({around}) relative to each other, by "
                    f"{off:.2g} px. Hold or move the body in one place only, move all of it "
                    "evenly, or give it a finite stiffness.",
                )
            moved = body.motions @ shares
            flat[body.at] = moved + body.free @ (body.free.T @ (flat[body.at] - moved))

    def project(self, vector: npt.NDArray[Any]) -> None:
        """Project displacements or forces onto the free rigid motions of bodies, in place."""
        flat = vector.reshape(-1)
        for body in self._bodies:
            free = body.free if vector.dtype == np.float64 else body.single
            flat[body.at] = free @ (free.T @ flat[body.at])

    def carry(self, forces: Planes, limits: Planes | None = None) -> None:
        """Transfer the total force on each body to its constrained components, in place.

        Many distributions of the force are equivalent for a rigid body; the result has the smallest
        norm, unless this exceeds the limits and another distribution does not.

        Parameters
        ----------
        forces : ndarray, planes
        limits : ndarray, planes, optional
            Largest force of each component; 0 or infinite where there is no limit.
        """
        flat = forces.reshape(-1)
        for body in self._bodies:
            needed = body.motions.T @ flat[body.at]
            flat[body.at] = 0
            at, holds = body.at[body.held], body.motions[body.held].T
            carried = np.linalg.lstsq(holds, needed, rcond=1e-9)[0]
            if limits is not None and len(at):
                most = limits.reshape(-1)[at]
                most = np.where(most > 0, most, np.inf)
                if (np.abs(carried) > most).any():
                    within = scipy.optimize.lsq_linear(holds, needed, (-most, most), "bvls").x
                    missing = np.abs(holds @ within - needed).max()
                    if missing <= _MISSING * np.abs(needed).max():
                        carried = within
            flat[at] = carried


def bodies_of(m: npt.NDArray[np.float32]) -> list[BodySites]:
    """Find the rigid bodies, which are connected regions of infinite stiffness.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness.

    Returns
    -------
    list of tuple of ndarray
        Indices of the sites of each body along each axis.
    """
    rigid = np.isinf(m)
    box = scipy.ndimage.find_objects(rigid.astype(np.uint8))
    if not box:
        return []
    first = [max(along.start - 1, 0) for along in box[0]]
    here = tuple(slice(begin, along.stop + 1) for begin, along in zip(first, box[0], strict=True))
    sites = rigid_sites(m[here])
    labels, _ = scipy.ndimage.label(sites, structure=np.ones((3,) * m.ndim))
    found = []
    for number, part in enumerate(scipy.ndimage.find_objects(labels), 1):
        inside = np.nonzero(labels[part] == number)
        begins = (begin + along.start for begin, along in zip(first, part, strict=True))
        found.append(tuple(index + begin for index, begin in zip(inside, begins, strict=True)))
    return found


def can_deflate(bodies: Sequence[BodySites], shape: tuple[int, ...]) -> bool:
    """Return whether deflation is affordable for these bodies and this grid; False in volumes."""
    # Each body has three motions; each motion needs a displacement field and a force field, with
    # two components each.
    values = 3 * 2 * 2 * len(bodies) * math.prod(shape)
    return len(shape) == 2 and len(bodies) <= _MOST_BODIES and values <= _MOST_VALUES


def rigid_sites(m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return a mask of the sites of rigid bodies, which are the corners of rigid elements."""
    return np.asarray(around_sites(_rigid(m), np.logical_or))


def rigid_elements(
    m: npt.NDArray[np.float32], bodies: Sequence[BodySites]
) -> npt.NDArray[np.int32]:
    """Return the number of each element's body.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness.
    bodies : list of tuple of ndarray
        Result of `bodies_of`.

    Returns
    -------
    ndarray of int, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
        Number of the body, counted from 1; 0 if the element is not rigid.
    """
    numbers = np.zeros(m.shape, dtype=np.int32)
    for number, sites in enumerate(bodies, 1):
        numbers[sites] = number
    return np.where(_rigid(m), numbers[(slice(None, -1),) * m.ndim], 0)


def _rigid(m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return a mask of the elements with an infinitely stiff corner."""
    return np.asarray(in_elements(m) & of_corners(np.isinf(m), np.logical_or))


def small_rotations(axes: int) -> list[Float64Array]:
    """Return the matrix of each small rotation, which maps a position to its displacement."""
    made = []
    for first, second in combinations(range(axes), 2):
        turn = np.zeros((axes, axes))
        turn[first, second], turn[second, first] = -1.0, 1.0
        made.append(turn)
    return made
