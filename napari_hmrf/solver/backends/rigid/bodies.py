"""Rigid tissue: bodies that move as one, as a constraint on displacements.

A body's sites are those of all elements that have an infinitely stiff corner; what touches is one
body. Of its motions (along each axis, and small turns: three, in a volume six) some may be held. A
linear system is solved among the displacements that are left: what a body's sites would do each on
their own is replaced by the motion of the body that is nearest to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.solver.priors.elements import ElasticMaterial

Float64Array = npt.NDArray[np.float64]
BodySites = tuple[npt.NDArray[np.intp], ...]

# Bodies whose motions have fields of their own, at most, and values of all these fields together.
_MOST_BODIES, _MOST_VALUES = 8, 4e7

# Least support of a motion that counts; and the distance, in pixels and as a part of itself, that
# the observations of a body may have from a motion of it.
_NOTHING = 1e-9
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """A body's components of flat planes, all its motions there, and those that nothing holds."""

    # Motions are orthonormal; `single` is the free ones in single precision, and `ways` is what
    # makes them of steps along the axes, and of turns around `centre`.

    at: npt.NDArray[np.intp]
    held: npt.NDArray[np.bool_]
    motions: Float64Array
    free: Float64Array
    single: npt.NDArray[np.float32]
    centre: tuple[float, ...]
    ways: Float64Array


class Motion(NamedTuple):
    """A free motion of a body: its components of flat planes, and how far it moves each.

    Each point moves by `step`, and by `turn` times how far it is from `centre`.
    """

    at: npt.NDArray[np.intp]
    moved: npt.NDArray[np.float32]
    centre: tuple[float, ...]
    step: Float64Array
    turn: Float64Array

    def of(self, *sites: npt.NDArray[np.intp]) -> Float64Array:
        """Return the displacement of some points, real or possible: (components, points)."""
        from_centre = np.stack(sites) - np.array(self.centre)[:, None]
        return np.asarray(self.step[:, None] + self.turn @ from_centre)


class Bodies:
    """The rigid bodies of a tissue, with what is held of them.

    Parameters
    ----------
    sites : list of tuple of ndarray
        Indices of each body's sites along each axis, as `bodies_of` finds them.
    material : ElasticMaterial
    held : ndarray of bool, planes
    moved : ndarray, planes, optional
        Where they have got to; by default they are where they were drawn.
    """

    def __init__(
        self,
        sites: list[BodySites],
        material: ElasticMaterial,
        held: HeldPlanes,
        moved: Planes | None = None,
    ) -> None:
        self._sites, grid = sites, held.shape[1:]
        self._sides = np.array(material.shape.sides)
        #: True if cycles hold the bodies, and fields of their motions make up for it.
        self.entrain = few(sites, material.m.shape)
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
        """All rigid motions of some points, as columns: components of all points, one by one."""
        count, axes = places.shape
        made = [np.repeat(axis, count) for axis in np.eye(axes)]
        for turn in _turns(axes):
            made.append((turn @ places.T).ravel())
        return np.stack(made, axis=1)

    def hold(self, held: HeldPlanes) -> HeldPlanes:
        """Return what is held if all bodies are."""
        all_held = held.copy()
        for body in self._bodies:
            all_held.reshape(-1)[body.at] = True
        return all_held

    @property
    def freedom(self) -> int:
        """The number of free motions of all bodies."""
        return sum(body.free.shape[1] for body in self._bodies)

    @property
    def motions(self) -> Iterator[tuple[BodySites, list[Motion]]]:
        """The sites and the free motions of each body."""
        axes = len(self._sides)
        for sites, body in zip(self._sites, self._bodies, strict=True):
            motions = []
            for way, moved in zip(body.ways.T, body.single.T, strict=True):
                turns = zip(way[axes:], _turns(axes), strict=True)
                turn = sum(share * matrix for share, matrix in turns) * self._sides
                motions.append(Motion(body.at, moved, body.centre, way[:axes], turn))
            yield sites, motions

    def settle(self, d: Planes) -> None:
        """Move each body as one, in place: by what is held of it, and else nearest to `d`.

        Raises
        ------
        ProblemError
            If what was observed of a body is no motion of it.
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
                    f"moves pixels of what is rigid around ({around}) otherwise than as one, by "
                    f"{off:.2g} px. Hold or move it in one place only, move all of it evenly, or "
                    "give it a stiffness.",
                )
            moved = body.motions @ shares
            flat[body.at] = moved + body.free @ (body.free.T @ (flat[body.at] - moved))

    def project(self, vector: npt.NDArray[Any]) -> None:
        """Replace displacements or forces by those of bodies that move as one, in place."""
        flat = vector.reshape(-1)
        for body in self._bodies:
            free = body.free if vector.dtype == np.float64 else body.single
            flat[body.at] = free @ (free.T @ flat[body.at])

    def carry(self, forces: Planes) -> None:
        """Let the held components of each body carry its whole load, in place.

        The shares within a rigid body are not determined: they are as even as possible.
        """
        flat = forces.reshape(-1)
        for body in self._bodies:
            needed = body.motions.T @ flat[body.at]
            flat[body.at] = 0
            holds = body.motions[body.held].T
            flat[body.at[body.held]] = np.linalg.lstsq(holds, needed, rcond=1e-9)[0]


def bodies_of(m: npt.NDArray[np.float32]) -> list[BodySites]:
    """Find rigid bodies: indices of the sites of each, along each axis."""
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


def few(bodies: list[BodySites], shape: tuple[int, ...]) -> bool:
    """Return whether there are few enough bodies for a field of each of their motions."""
    # Three motions, of each the field and its forces, of two components. A volume's would be six.
    values = 3 * 2 * 2 * len(bodies) * math.prod(shape)
    return len(shape) == 2 and len(bodies) <= _MOST_BODIES and values <= _MOST_VALUES


def rigid_sites(m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return the sites of rigid bodies: those of elements with an infinite corner."""
    return np.asarray(around_sites(_rigid(m), np.logical_or))


def rigid_elements(m: npt.NDArray[np.float32], bodies: list[BodySites]) -> npt.NDArray[np.int32]:
    """Return the number of the body that each element belongs to, from 1; 0 if to none."""
    numbers = np.zeros(m.shape, dtype=np.int32)
    for number, sites in enumerate(bodies, 1):
        numbers[sites] = number
    return np.where(_rigid(m), numbers[(slice(None, -1),) * m.ndim], 0)


def _rigid(m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return the elements with an infinite corner."""
    return np.asarray(in_elements(m) & of_corners(np.isinf(m), np.logical_or))


def _turns(axes: int) -> list[Float64Array]:
    """The matrix of each small turn: what it makes of a place is how far that moves."""
    made = []
    for first, second in combinations(range(axes), 2):
        turn = np.zeros((axes, axes))
        turn[first, second], turn[second, first] = -1.0, 1.0
        made.append(turn)
    return made
