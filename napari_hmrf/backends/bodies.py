"""Rigid tissue: bodies that move as one, as a constraint on displacements.

A body's sites are those of all elements that have an infinitely stiff corner; what touches is one
body. Of its three motions (along rows, along columns, a small turn) some may be held. A linear
system is solved among the displacements that are left: what a body's sites would do each on their
own is replaced by the motion of the body that is nearest to it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.backends.planes import HeldPlanes, Planes
from napari_hmrf.errors import ProblemError
from napari_hmrf.priors.elements import ElasticMaterial

Float64Array = npt.NDArray[np.float64]

# What holds a motion less than this does not; and how far, in pixels and as a part of itself, what
# was observed of a body may be from a motion of it.
_NOTHING = 1e-9
_OFF, _PART = 1e-3, 1e-5


class _Body(NamedTuple):
    """A body's components of flat planes, all its motions there, and those that nothing holds.

    The latter are orthonormal; `single` is the same in single precision.
    """

    at: npt.NDArray[np.intp]
    held: npt.NDArray[np.bool_]
    motions: Float64Array
    free: Float64Array
    single: npt.NDArray[np.float32]


class Bodies:
    """The rigid bodies of a tissue, with what is held of them.

    Parameters
    ----------
    material : ElasticMaterial
    held : ndarray of bool, planes
    """

    def __init__(self, material: ElasticMaterial, held: HeldPlanes) -> None:
        sites = rigid_sites(material.m)
        (box,) = ndimage.find_objects(sites.astype(np.int8))[:1] or [(slice(0, 0), slice(0, 0))]
        labels, count = ndimage.label(sites[box], structure=np.ones((3, 3)))
        aspect = (material.shape.cols / material.shape.rows) ** 0.25
        _, height, width = held.shape
        self._bodies = []
        for number in range(1, count + 1):
            i, j = np.nonzero(labels == number)
            i, j = i + box[0].start, j + box[1].start
            at = (i + 2) * width + j + 2
            at = np.concatenate([at, at + height * width])
            row, col = (i - i.mean()) * aspect, (j - j.mean()) / aspect
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
            motions /= np.sqrt(np.einsum("sm,sm->m", motions, motions))
            stopped = held.ravel()[at]
            some = motions[stopped]
            stops, ways = np.linalg.eigh(some.T @ some)
            free = motions @ ways[:, stops < _NOTHING / len(at)]
            self._bodies.append(_Body(at, stopped, motions, free, free.astype(np.float32)))

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
                    "y",
                    f"moves sites of the rigid body around ({i.mean() - 2:.0f}, {j.mean() - 2:.0f})"
                    f" otherwise than as one, by {off:.2g} px. Observe it in a single place, move "
                    "it evenly, or give it a stiffness.",
                )
            moved = body.motions @ shares
            flat[body.at] = moved + body.free @ (body.free.T @ (flat[body.at] - moved))

    def project(self, vector: npt.NDArray[Any]) -> None:
        """Replace displacements or forces by those of bodies that move as one, in place."""
        flat = vector.reshape(-1)
        for body in self._bodies:
            free = body.free if vector.dtype == np.float64 else body.single
            flat[body.at] = free @ (free.T @ flat[body.at])


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
