"""Rigid tissue: bodies that move as one, as a constraint on displacements.

A body's sites are those of all elements that have an infinitely stiff corner; what touches is one
body. Of its three motions (along rows, along columns, a small turn) some may be held. A linear
system is solved among the displacements that are left: what a body's sites would do each on their
own is replaced by the motion of the body that is nearest to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.priors.elements import ElasticMaterial

Float64Array = npt.NDArray[np.float64]
BodySites = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]

# Bodies whose motions have fields of their own, at most, and values of all these fields together.
_MOST_BODIES, _MOST_VALUES = 8, 4e7

# What holds a motion less than this does not; and how far, in pixels and as a part of itself, what
# was observed of a body may be from a motion of it.
_NOTHING = 1e-9
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """A body's components of flat planes, all its motions there, and those that nothing holds."""

    # The latter are orthonormal; `single` is the same in single precision, and `ways` is what makes
    # them of steps along rows and columns, and a turn around `centre`.

    at: npt.NDArray[np.intp]
    held: npt.NDArray[np.bool_]
    motions: Float64Array
    free: Float64Array
    single: npt.NDArray[np.float32]
    centre: tuple[float, float]
    ways: Float64Array


class Motion(NamedTuple):
    """A free motion of a body: its components of flat planes, and how far it moves each.

    Each point moves by `step`, and by `turn` times how far it is from `centre` the other way.
    """

    at: npt.NDArray[np.intp]
    moved: npt.NDArray[np.float32]
    centre: tuple[float, float]
    step: tuple[float, float]
    turn: tuple[float, float]

    def of(self, i: npt.NDArray[np.intp], j: npt.NDArray[np.intp]) -> Float64Array:
        """How far it moves, or would move, some points: (2, points)."""
        row = self.step[0] + self.turn[0] * (j - self.centre[1])
        col = self.step[1] + self.turn[1] * (i - self.centre[0])
        return np.stack([row, col])


class Bodies:
    """The rigid bodies of a tissue, with what is held of them.

    Parameters
    ----------
    sites : list of tuple of ndarray
        Rows and columns of each body's sites, as `bodies_of` finds them.
    material : ElasticMaterial
    held : ndarray of bool, planes
    """

    def __init__(self, sites: list[BodySites], material: ElasticMaterial, held: HeldPlanes) -> None:
        aspect = (material.shape.cols / material.shape.rows) ** 0.25
        self._sites, self._aspect = sites, aspect
        _, height, width = held.shape
        #: Whether cycles hold them, and fields of their motions make up for it.
        self.entrain = few(sites, material.m.shape)
        self._bodies = []
        for i, j in sites:
            at = (i + 2) * width + j + 2
            at = np.concatenate([at, at + height * width])
            centre = float(i.mean()), float(j.mean())
            row, col = (i - centre[0]) * aspect, (j - centre[1]) / aspect
            nothing, one = np.zeros_like(row), np.ones_like(row)
            motions = np.stack(
                [
                    np.concatenate([one, nothing]),
                    np.concatenate([nothing, one]),
                    np.concatenate([-col, row]),
                ],
                axis=1,
            )
            # Around its centre, a body's turn is orthogonal to where it goes.
            lengths = np.sqrt(np.einsum("sm,sm->m", motions, motions))
            motions /= lengths
            stopped = held.ravel()[at]
            some = motions[stopped]
            stops, ways = np.linalg.eigh(some.T @ some)
            ways = ways[:, stops < _NOTHING / len(at)]
            free = motions @ ways
            ways /= lengths[:, None]
            single = free.astype(np.float32)
            self._bodies.append(_Body(at, stopped, motions, free, single, centre, ways))

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
    def motions(self) -> Iterator[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], list[Motion]]]:
        """Rows, columns, and free motions of each body."""
        for (i, j), body in zip(self._sites, self._bodies, strict=True):
            motions = []
            for (row, col, turn), moved in zip(body.ways.T, body.single.T, strict=True):
                turns = -turn / self._aspect, turn * self._aspect
                motions.append(Motion(body.at, moved, body.centre, (row, col), turns))
            yield i, j, motions

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
                i, j = np.divmod(body.at[: len(body.at) // 2], d.shape[2])
                raise ProblemError(
                    "observed",
                    f"moves pixels of what is rigid around ({i.mean() - 2:.0f}, {j.mean() - 2:.0f})"
                    f" otherwise than as one, by {off:.2g} px. Hold or move it in one place only, "
                    "move all of it evenly, or give it a stiffness.",
                )
            moved = body.motions @ shares
            flat[body.at] = moved + body.free @ (body.free.T @ (flat[body.at] - moved))

    def project(self, vector: npt.NDArray[Any]) -> None:
        """Replace displacements or forces by those of bodies that move as one, in place."""
        flat = vector.reshape(-1)
        for body in self._bodies:
            free = body.free if vector.dtype == np.float64 else body.single
            flat[body.at] = free @ (free.T @ flat[body.at])


def bodies_of(m: npt.NDArray[np.float32]) -> list[BodySites]:
    """Find rigid bodies: rows and columns of the sites of each."""
    rigid = np.isinf(m)
    rows, cols = (np.flatnonzero(rigid.any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return []
    row, col = max(rows[0] - 1, 0), max(cols[0] - 1, 0)
    sites = rigid_sites(m[row : rows[-1] + 2, col : cols[-1] + 2])
    labels, _ = scipy.ndimage.label(sites, structure=np.ones((3, 3)))
    found = []
    for number, box in enumerate(scipy.ndimage.find_objects(labels), 1):
        i, j = np.nonzero(labels[box] == number)
        found.append((i + row + box[0].start, j + col + box[1].start))
    return found


def few(bodies: list[BodySites], shape: tuple[int, ...]) -> bool:
    """Whether there are few enough for each of their motions to have a field of its own."""
    # Three motions, of each the field and its forces, of two components.
    values = 3 * 2 * 2 * len(bodies) * shape[0] * shape[1]
    return len(bodies) <= _MOST_BODIES and values <= _MOST_VALUES


def rigid_sites(m: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Which sites (H, W) are part of a rigid body: those of elements with an infinite corner."""
    rigid = np.isinf(m)
    elements = np.zeros((m.shape[0] + 1, m.shape[1] + 1), dtype=np.bool_)
    whole = (m[:-1, :-1] > 0) & (m[1:, :-1] > 0) & (m[:-1, 1:] > 0) & (m[1:, 1:] > 0)
    corner = rigid[:-1, :-1] | rigid[1:, :-1] | rigid[:-1, 1:] | rigid[1:, 1:]
    elements[1:-1, 1:-1] = whole & corner
    found: npt.NDArray[np.bool_] = (
        elements[1:, 1:] | elements[:-1, 1:] | elements[1:, :-1] | elements[:-1, :-1]
    )
    return found
