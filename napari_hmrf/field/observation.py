"""What is known of a displacement on the pixels of a slice or volume: by a field, or by arrows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.frame import Frame
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.solver.solution import Solution

#: How far beyond the middle of its outermost pixels a field reaches, in pixels.
_REACH = 0.5 + 1e-3


class Observation(NamedTuple):
    """What is known of a displacement on the pixels of a slice or volume.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        In the slice's unit; 0 where it is not known.
    known : ndarray of bool, shape ([D,] H, W)
        Where a field reaches, or an arrow starts.
    out : float
        How far a field leads out of the slice at most, or how many arrows point straight out of it,
        which do not count: the displacement does not say so. Nothing leads out of a volume.
    note : str
        What was taken for granted of units, as a clause; "" if nothing.
    """

    displacement: npt.NDArray[np.float32]
    known: npt.NDArray[np.bool_]
    out: float
    note: str = ""


class PixelField(NamedTuple):
    """A field, and where its grid lies.

    Attributes
    ----------
    field : DisplacementField
        In the pixels of its grid, along all of its axes.
    frame : Frame
        Of the grid, at its first site.
    """

    field: DisplacementField
    frame: Frame

    @classmethod
    def of(cls, solution: Solution, place: Frame) -> PixelField:
        """The field of a solution on the pixels of its slice or volume."""
        pixels = place.put_field(solution.displacement / solution.spacing)
        return cls(DisplacementField.in_pixels(pixels), place)

    def on(self, frame: Frame, shape: tuple[int, ...]) -> Observation:
        """Look the field up at the pixels of a slice or volume, wherever these lie.

        Where the world of either has no unit of length, pixels are taken for pixels.

        Raises
        ------
        ProblemError
            If the field reaches no pixel of the slice, or pixels cannot be taken for pixels.
        """
        own, more = self.field.shape, self.frame.ndim - frame.ndim
        if min(frame.plane) + more < 0 or max((1, *own[: max(more, 0)])) > 1:
            raise ProblemError(
                "observed",
                f"is {grid_in_words(own)}, and the image is no slice of that. Give both the same "
                "axes.",
            )
        to, back = self.frame.from_pixels_of(frame), frame.from_pixels_of(self.frame)
        if to is None or back is None:
            return self._by_pixels(frame, shape)
        sites = np.zeros((*shape, frame.ndim)) + frame.index
        sites[..., list(frame.plane)] = np.moveaxis(np.indices(shape), 0, -1)
        at = sites.reshape(-1, frame.ndim) @ to[:, :-1].T + to[:, -1] - self.frame.index
        known = ((at > -_REACH) & (at < np.array(own) - 1 + _REACH)).all(axis=1)
        if not known.any():
            raise ProblemError("observed", "lies elsewhere than the image. Give both one place.")
        steps = np.zeros((len(at), frame.ndim))
        steps[known] = self.field.at(at[known]) @ back[:, :-1].T
        sizes = np.linalg.norm(np.array(frame.matrix)[:-1, :-1], axis=0)
        out = np.abs(steps * sizes)[:, list(frame.others)].max(initial=0.0)
        d = (steps[:, list(frame.plane)] * frame.spacing).reshape(*shape, len(shape))
        return Observation(d.astype(np.float32), known.reshape(shape), float(out))

    def _by_pixels(self, frame: Frame, shape: tuple[int, ...]) -> Observation:
        own = self.field.shape
        axes = [axis - frame.ndim for axis in frame.plane]
        if tuple(own[axis] for axis in axes) != shape or math.prod(own) != math.prod(shape):
            raise ProblemError(
                "observed",
                f"is {grid_in_words(own)} in {self.frame.unit}, but the image "
                f"{grid_in_words(shape)} in {frame.unit}. Give the image its place in units of "
                "length, or take a field on its pixels.",
            )
        ends, last = [axis - 1 for axis in axes], range(-len(axes) - 1, -1)
        ordered = np.moveaxis(self.field.displacement, ends, tuple(last))
        d = ordered.reshape(*shape, -1)[..., axes] * frame.spacing
        note = (
            f"is in {self.frame.unit} and the image in {frame.unit}: a pixel of the one was taken "
            "for a pixel of the other. Give the image its unit of length if that is wrong"
        )
        return Observation(d.astype(np.float32), np.ones(shape, bool), 0.0, note)


def arrow_observation(
    vectors: npt.NDArray[np.float64],
    own: Frame,
    spacing: tuple[float, ...],
    shape: tuple[int, ...],
) -> Observation:
    """What arrows say, each counting for the pixel it starts in.

    Parameters
    ----------
    vectors : ndarray, shape (N, 2, D)
        Of a Vectors layer, in the pixels of the image.
    own : Frame
        The layer's slice or volume.
    spacing : tuple of float, shape (n,)
        Size of a pixel along each axis of the grid, in the unit of the displacement.
    shape : tuple of int, shape (n,)
        The grid.

    Raises
    ------
    ProblemError
        By the arrow's number, if it starts outside the grid, disagrees with another in its pixel,
        or holds NaN.
    """
    bad = np.flatnonzero(~np.isfinite(vectors).all(axis=(1, 2)))
    if len(bad):
        raise ProblemError("observed", f"has NaN or infinity in vector {bad[0]}. Remove it.")
    others, here = list(own.others), own.has(vectors[:, 0])
    inward = vectors[:, 1][:, list(own.plane)].any(axis=1)
    outward = vectors[:, 1][:, others].any(axis=1) & ~inward
    rows = np.flatnonzero(here & ~outward)
    arrows = vectors[rows][:, :, list(own.plane)]
    at = np.rint(arrows[:, 0]).astype(int)
    outside = np.flatnonzero(((at < 0) | (at >= shape)).any(axis=1))
    if len(outside):
        first = outside[0]
        raise ProblemError(
            "observed",
            f"has {len(outside)} vectors that start outside the image of {grid_in_words(shape)} "
            f"pixels, the first being vector {rows[first]} at {tuple(at[first].tolist())}. "
            "Remove them.",
        )
    y = np.zeros((*shape, len(shape)), dtype=np.float32)
    known = np.zeros(shape, dtype=bool)
    steps = (arrows[:, 1] * spacing).astype(np.float32)
    y[tuple(at.T)] = steps
    known[tuple(at.T)] = True
    conflict = np.flatnonzero((y[tuple(at.T)] != steps).any(axis=1))
    if len(conflict):
        first = conflict[0]
        raise ProblemError(
            "observed",
            f"has vectors that start in the same pixel and differ, as vector {rows[first]} at "
            f"{tuple(at[first].tolist())}. Keep one for each pixel.",
        )
    return Observation(y, known, int((here & outward).sum()))
