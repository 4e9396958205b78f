"""Poses of rigid bodies in large motion: a translation and an arbitrarily large rotation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites

Float64Array = npt.NDArray[np.float64]
# Index of the sites of a body: components, rows and columns of planes.
_Index = tuple[slice, npt.NDArray[np.intp], npt.NDArray[np.intp]]

# Largest number of iterations for a pose, and change, in pixels, at which the iteration ends.
_STEPS, _EXACT = 30, 1e-12
# Largest rotation of a body in one step, in radians.
_TURN = 0.25
# Singular value, relative to the largest, below which a motion is free.
_NOTHING = 1e-9
# Largest distance of observations from a rigid motion: in pixels, and relative to the largest
# observed value.
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """Sites of a body, their positions relative to its centre, and its constrained components."""

    at: _Index
    places: Float64Array
    held: npt.NDArray[np.bool_]


class Poses:
    """Poses of all rigid bodies.

    Parameters
    ----------
    bodies : list of tuple of ndarray
        Indices of each body's sites along each axis.
    sides : tuple of float
        Size of a pixel along the row axis and the column axis, in the solver's unit of length.
    held : ndarray of bool, planes
        Mask of the constrained components.
    """

    def __init__(self, bodies: list[BodySites], sides: tuple[float, ...], held: HeldPlanes) -> None:
        self._bodies = []
        for row, col in bodies:
            places = np.stack([row, col]) * np.array(sides)[:, None]
            at = (slice(None), row + 2, col + 2)
            self._bodies.append(_Body(at, places - places.mean(axis=1, keepdims=True), held[at]))

    def hold(self, y: Planes, held: HeldPlanes) -> None:
        """Constrain all components of each body whose pose is already determined, in place.

        The constrained components in `y` are replaced by the values of the fitted pose.

        Raises
        ------
        ProblemError
            If no rigid motion satisfies the constraints of a body.
        """
        for number, body in enumerate(self._bodies):
            if not body.held.any():
                continue
            wanted = body.places + y[body.at]
            sites = body.held.all(axis=0)
            begin = _nearest(body.places[:, sites], wanted[:, sites], body.places)
            found = _fit_pose(body.places, begin, wanted, body.held, nearest=False)
            off = float(np.abs(found - wanted)[body.held].max())
            if off > _OFF + _PART * float(np.abs(y[body.at])[body.held].max()):
                row, col = (float(index.mean() - 2) for index in body.at[1:])
                raise ProblemError(
                    "observed",
                    f"moves pixels of the rigid body around ({row:.0f}, {col:.0f}) relative to "
                    f"each other, by {off:.2g} px. Hold or move the body in one place only, move "
                    "all of it by one rotation and translation, or give it a finite stiffness.",
                )
            stops = np.linalg.svd(_motions(found)[body.held.ravel()], compute_uv=False)
            if len(stops) == 3 and stops[-1] > _NOTHING * stops[0]:
                held[body.at] = True
                self._bodies[number] = body._replace(held=np.ones_like(body.held))
            y[body.at] = np.where(held[body.at], found - body.places, y[body.at])

    def make_rigid(self, d: Planes) -> None:
        """Move each body to the pose nearest to `d`, in place; keep constrained components."""
        for body in self._bodies:
            wanted = body.places + d[body.at]
            found = _nearest(body.places, wanted, body.places)
            if body.held.any() and not body.held.all():
                found = _fit_pose(body.places, found, wanted, body.held)
                found = np.where(body.held, wanted, found)
            d[body.at] = found - body.places

    def aim(self, d: Planes, y: Planes) -> Planes:
        """Return a displacement between `d` and `y`, with a limited rotation of each body.

        Fully constrained bodies rotate by at most 0.25 radians and remain rigid on the way.

        Parameters
        ----------
        d, y : ndarray, planes
            Current and final displacement, in pixels.

        Returns
        -------
        ndarray, planes
            Displacement in pixels; `y` itself if no body has to rotate further.
        """
        made = y
        for body in self._bodies:
            if not body.held.all():
                continue
            here, there = body.places + d[body.at], body.places + y[body.at]
            middle, goal = here.mean(axis=1, keepdims=True), there.mean(axis=1, keepdims=True)
            angle = _angle(here - middle, there - goal)
            if abs(angle) > _TURN:
                made = y.copy() if made is y else made
                share = _TURN / abs(angle)
                found = middle + share * (goal - middle) + _turn(share * angle) @ (here - middle)
                made[body.at] = found - body.places
        return made

    def extend(self, gap: Planes) -> Planes:
        """Extend a displacement of constrained components to all components of their bodies.

        Other components of a partly constrained body receive the small rigid motion that is nearest
        to the displacement of the constrained components.
        """
        made = gap.copy()
        for body in self._bodies:
            if body.held.any() and not body.held.all():
                motions = _motions(body.places)
                some = motions[body.held.ravel()]
                shares = np.linalg.lstsq(some, gap[body.at][body.held], rcond=_NOTHING)[0]
                way = (motions @ shares).reshape(body.places.shape)
                made[body.at] = np.where(body.held, gap[body.at], way)
        return made


def _nearest(some: Float64Array, wanted: Float64Array, places: Float64Array) -> Float64Array:
    """Return all positions after the rigid motion that moves `some` nearest to their targets."""
    if not some.size:
        return places
    middle, goal = some.mean(axis=1, keepdims=True), wanted.mean(axis=1, keepdims=True)
    return np.asarray(goal + _turn(_angle(some - middle, wanted - goal)) @ (places - middle))


def _angle(places: Float64Array, goals: Float64Array) -> float:
    """Return the rotation around 0, in radians, that moves positions nearest to their targets."""
    (row, col), (to_row, to_col) = places, goals
    across, along = (row * to_col - col * to_row).sum(), (row * to_row + col * to_col).sum()
    return float(np.arctan2(across, along))


def _turn(angle: float) -> Float64Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _fit_pose(
    places: Float64Array,
    begin: Float64Array,
    wanted: Float64Array,
    held: npt.NDArray[np.bool_],
    nearest: bool = True,
) -> Float64Array:
    """Return the positions in a pose that moves the constrained components to their targets.

    The search starts at the positions `begin`. If `nearest`, the other components are as near to
    their targets as possible.
    """
    now, stopped = begin, held.ravel()
    for _ in range(_STEPS):
        motions, left = _motions(now), (wanted - now).ravel()
        some = motions[stopped]
        step = np.linalg.lstsq(some, left[stopped], rcond=_NOTHING)[0]
        if nearest:
            _, stops, ways = np.linalg.svd(some)
            free = ways[np.count_nonzero(stops > _NOTHING * stops[0]) :].T
            rest = left - motions @ step
            step = step + free @ np.linalg.lstsq(motions @ free, rest, rcond=None)[0]
        goal = now + (motions @ step).reshape(now.shape)
        now, before = _nearest(places, goal, places), now
        if np.abs(now - before).max() < _EXACT:
            break
    return now


def _motions(places: Float64Array) -> Float64Array:
    """Return the two translations and the rotation around the centre, as columns.

    The rows of the result are the row components of all sites, followed by the column components.
    """
    row, col = places - places.mean(axis=1, keepdims=True)
    ones, none = np.ones_like(row), np.zeros_like(row)
    size = max(float(np.hypot(row, col).max()), 1e-300)
    made = np.stack([[ones, none], [none, ones], [-col / size, row / size]])
    return made.reshape(3, -1).T
