"""Poses of rigid bodies in large motion: a translation and an arbitrarily large rotation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites, small_rotations

Float64Array = npt.NDArray[np.float64]
# Index of the sites of a body in planes.
_Index = tuple[Any, ...]

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
        Size of a pixel or voxel along each axis, in the solver's unit of length.
    held : ndarray of bool, planes
        Mask of the constrained components.
    """

    def __init__(
        self, bodies: Sequence[BodySites], sides: tuple[float, ...], held: HeldPlanes
    ) -> None:
        #: Size of a pixel or voxel along each axis, in the solver's unit of length.
        self.sides = sides
        self._bodies = []
        for sites in bodies:
            places = np.stack(sites) * np.array(sides)[:, None]
            at: _Index = (slice(None), *(index + 2 for index in sites))
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
                around = ", ".join(f"{index.mean() - 2:.0f}" for index in body.at[1:])
                raise ProblemError(
                    "observed",
                    f"moves pixels of the rigid body around ({around}) relative to each other, by "
                    f"{off:.2g} px. Hold or move the body in one place only, move all of it by one "
                    "rotation and translation, or give it a finite stiffness.",
                )
            stops = np.linalg.svd(_motions(found)[body.held.ravel()], compute_uv=False)
            axes = len(body.places)
            is_fixed = len(stops) == axes * (axes + 1) // 2
            if is_fixed and stops[-1] > _NOTHING * stops[0]:
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
            angles = _angles(here - middle, there - goal)
            angle = float(np.linalg.norm(angles))
            if angle > _TURN:
                made = y.copy() if made is y else made
                share = _TURN / angle
                found = middle + share * (goal - middle) + _turn(share * angles) @ (here - middle)
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
    return np.asarray(goal + _turn(_angles(some - middle, wanted - goal)) @ (places - middle))


def _angles(places: Float64Array, goals: Float64Array) -> Float64Array:
    """Return the rotation around 0, in radians, that moves positions nearest to their targets.

    It is a single angle in an image, and a rotation vector in a volume.
    """
    if len(places) == 2:
        (row, col), (to_row, to_col) = places, goals
        across, along = (row * to_col - col * to_row).sum(), (row * to_row + col * to_col).sum()
        return np.array([np.arctan2(across, along)])
    from scipy.spatial.transform import Rotation  # heavy: scipy

    # Orthogonal polar factor of the correlation (Kabsch, Acta Cryst. A32, 1976).
    left, _, right = np.linalg.svd(goals @ places.T)
    left[:, -1] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    return np.asarray(Rotation.from_matrix(left @ right).as_rotvec())


def _turn(angles: Float64Array) -> Float64Array:
    """Return the matrix of a rotation from `_angles`."""
    if len(angles) == 1:
        cos, sin = np.cos(angles[0]), np.sin(angles[0])
        return np.array([[cos, -sin], [sin, cos]])
    from scipy.spatial.transform import Rotation  # heavy: scipy

    return np.asarray(Rotation.from_rotvec(angles).as_matrix())


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
    """Return the translations and the small rotations around the centre, as columns.

    The rows of the result are the first component of all sites, then the second, and so on.
    """
    centred = places - places.mean(axis=1, keepdims=True)
    size = max(float(np.linalg.norm(centred, axis=0).max()), 1e-300)
    axes, count = places.shape
    made = [np.repeat(axis, count) for axis in np.eye(axes)]
    made += [(turn @ centred / size).ravel() for turn in small_rotations(axes)]
    return np.stack(made, axis=1)
