"""Poses of rigid bodies in large motion: a step and a turn, which may be large."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites

Float64Array = npt.NDArray[np.float64]
# Sites of a body, rows and columns of planes.
_Index = tuple[slice, npt.NDArray[np.intp], npt.NDArray[np.intp]]

# Steps to a pose, and when it is exact, in pixels.
_STEPS, _EXACT = 30, 1e-12
# Largest turn of a body in one step.
_TURN = 0.25
# Relative support below which a motion counts as free.
_NOTHING = 1e-9
# Distance that observations may have from a motion of a body, in pixels and as a part of it.
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """Sites, their places around the middle of all of them, and which components are held."""

    at: _Index
    places: Float64Array
    held: npt.NDArray[np.bool_]


class Poses:
    """The poses of all bodies.

    Parameters
    ----------
    bodies : list of tuple of ndarray
        Indices of each body's sites along each axis.
    sides : tuple of float
        Of a pixel.
    held : ndarray of bool, planes
    """

    def __init__(self, bodies: list[BodySites], sides: tuple[float, ...], held: HeldPlanes) -> None:
        self._bodies = []
        for row, col in bodies:
            places = np.stack([row, col]) * np.array(sides)[:, None]
            at = (slice(None), row + 2, col + 2)
            self._bodies.append(_Body(at, places - places.mean(axis=1, keepdims=True), held[at]))

    def hold(self, y: Planes, held: HeldPlanes) -> None:
        """Hold all of a body of which so much is held that it cannot move, in place.

        Raises
        ------
        ProblemError
            If what was observed of a body is no motion of it.
        """
        for number, body in enumerate(self._bodies):
            if not body.held.any():
                continue
            wanted = body.places + y[body.at]
            sites = body.held.all(axis=0)
            begin = _nearest(body.places[:, sites], wanted[:, sites], body.places)
            found = _fitted(body.places, begin, wanted, body.held, nearest=False)
            off = float(np.abs(found - wanted)[body.held].max())
            if off > _OFF + _PART * float(np.abs(y[body.at])[body.held].max()):
                row, col = (float(index.mean() - 2) for index in body.at[1:])
                raise ProblemError(
                    "observed",
                    f"moves pixels of what is rigid around ({row:.0f}, {col:.0f}) otherwise than "
                    f"as one, by {off:.2g} px. Hold or move it in one place only, move all of it "
                    "as it turns, or give it a stiffness.",
                )
            stops = np.linalg.svd(_motions(found)[body.held.ravel()], compute_uv=False)
            if len(stops) == 3 and stops[-1] > _NOTHING * stops[0]:
                held[body.at] = True
                self._bodies[number] = body._replace(held=np.ones_like(body.held))
            y[body.at] = np.where(held[body.at], found - body.places, y[body.at])

    def settle(self, d: Planes) -> None:
        """Move each body to the pose nearest to `d`, in place; what is held of it stays."""
        for body in self._bodies:
            wanted = body.places + d[body.at]
            found = _nearest(body.places, wanted, body.places)
            if body.held.any() and not body.held.all():
                found = _fitted(body.places, found, wanted, body.held)
                found = np.where(body.held, wanted, found)
            d[body.at] = found - body.places

    def aim(self, d: Planes, y: Planes) -> Planes:
        """Return the next step towards `y`: bodies turn along an arc, not through themselves.

        It is `y` itself if no body has far to turn.
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
        """Return a way of held components that bodies can go, at least to begin with."""
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
    """All places, by the pose that brings some of them nearest to where they are wanted."""
    if not some.size:
        return places
    middle, goal = some.mean(axis=1, keepdims=True), wanted.mean(axis=1, keepdims=True)
    return np.asarray(goal + _turn(_angle(some - middle, wanted - goal)) @ (places - middle))


def _angle(places: Float64Array, goals: Float64Array) -> float:
    """The turn around 0 that brings places nearest to their goals."""
    (row, col), (to_row, to_col) = places, goals
    across, along = (row * to_col - col * to_row).sum(), (row * to_row + col * to_col).sum()
    return float(np.arctan2(across, along))


def _turn(angle: float) -> Float64Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _fitted(
    places: Float64Array,
    begin: Float64Array,
    wanted: Float64Array,
    held: npt.NDArray[np.bool_],
    nearest: bool = True,
) -> Float64Array:
    """A pose, found from another, in which what is held is where it is wanted."""
    # If `nearest`, of such poses that in which the rest is nearest to where it is wanted.
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
    """Both steps, and the turn around their middle, of all rows and then all columns."""
    row, col = places - places.mean(axis=1, keepdims=True)
    ones, none = np.ones_like(row), np.zeros_like(row)
    size = max(float(np.hypot(row, col).max()), 1e-300)
    made = np.stack([[ones, none], [none, ones], [-col / size, row / size]])
    return made.reshape(3, -1).T
