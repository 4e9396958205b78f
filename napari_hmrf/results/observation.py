"""Prescribed displacement on the pixels of a slice or volume, from a field or from arrows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.solver.solution import Solution

#: Distance, in pixels, by which a field extends beyond the centres of its outermost pixels.
_REACH = 0.5 + 1e-3


class Observation(NamedTuple):
    """Displacement that is known at some pixels of a slice or volume.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Displacement in the unit of the slice; 0 at unknown pixels.
    known : ndarray of bool, shape ([D,] H, W)
        Mask of the pixels that a field covers, or at which an arrow starts.
    out : float
        For a field, the largest component perpendicular to the slice, which `displacement` does
        not contain; for arrows, the number of arrows perpendicular to the slice, which are
        ignored. 0 for a volume.
    note : str
        Assumption about units, as a clause; "" if there is none.
    """

    displacement: npt.NDArray[np.float32]
    known: npt.NDArray[np.bool_]
    out: float
    note: str = ""


class PixelField(NamedTuple):
    """Displacement field in pixels, and the frame of its grid.

    Attributes
    ----------
    field : Field
        Field in the pixels of its grid, with one component for each axis of the grid.
    frame : Frame
        Frame of the grid, which defines the position of its first site.
    """

    field: Field
    frame: Frame

    @classmethod
    def of(cls, solution: Solution, place: Frame) -> PixelField:
        """Create the field of a solution on the pixels of its slice or volume."""
        pixels = place.put_field(solution.displacement / solution.spacing)
        return cls(Field.in_pixels(pixels), place)

    def on(self, frame: Frame, shape: tuple[int, ...]) -> Observation:
        """Resample the field to the pixels of a slice or volume, using world coordinates.

        If only one of the two grids has a unit of length, their pixels are assumed to correspond
        one to one.

        Parameters
        ----------
        frame : Frame
            Frame of the slice or volume.
        shape : tuple of int
            Shape of the slice or volume.

        Returns
        -------
        Observation

        Raises
        ------
        ProblemError
            If the field covers no pixel of the slice, or if the units cannot be converted and the
            grids have different shapes.
        """
        own, more = self.field.shape, self.frame.ndim - frame.ndim
        if min(frame.plane) + more < 0 or max((1, *own[: max(more, 0)])) > 1:
            raise ProblemError(
                "observed",
                f"is {grid_in_words(own)}, and the image is not a slice of this grid. Use the "
                "same axes for both.",
            )
        to, back = self.frame.from_pixels_of(frame), frame.from_pixels_of(self.frame)
        if to is None or back is None:
            return self._by_pixels(frame, shape)
        sites = np.zeros((*shape, frame.ndim)) + frame.index
        sites[..., list(frame.plane)] = np.moveaxis(np.indices(shape), 0, -1)
        at = sites.reshape(-1, frame.ndim) @ to[:, :-1].T + to[:, -1] - self.frame.index
        known = ((at > -_REACH) & (at < np.array(own) - 1 + _REACH)).all(axis=1)
        if not known.any():
            raise ProblemError(
                "observed", "does not overlap the image. Use the same position for both."
            )
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
                f"is {grid_in_words(own)} in {self.frame.unit}, but the image is "
                f"{grid_in_words(shape)} in {frame.unit}. Set the scale of the image in a unit of "
                "length, or use a field on the pixels of the image.",
            )
        ends, last = [axis - 1 for axis in axes], range(-len(axes) - 1, -1)
        ordered = np.moveaxis(self.field.displacement, ends, tuple(last))
        d = ordered.reshape(*shape, -1)[..., axes] * frame.spacing
        note = (
            f"is in {self.frame.unit} and the image in {frame.unit}: the pixels of both are "
            "assumed to be the same. If they are not, set the unit of length of the image"
        )
        return Observation(d.astype(np.float32), np.ones(shape, bool), 0.0, note)


def arrow_observation(
    vectors: npt.NDArray[np.float64],
    own: Frame,
    spacing: tuple[float, ...],
    shape: tuple[int, ...],
) -> Observation:
    """Return the displacement that arrows prescribe at the pixels in which they start.

    Parameters
    ----------
    vectors : ndarray, shape (N, 2, D)
        Arrows of a Vectors layer as (start, step), in the pixels of the image.
    own : Frame
        Frame of the slice or volume in the layer.
    spacing : tuple of float, shape (n,)
        Size of a pixel along each axis of the grid, in the unit of the displacement.
    shape : tuple of int, shape (n,)
        Shape of the grid.

    Returns
    -------
    Observation

    Raises
    ------
    ProblemError
        If an arrow starts outside the grid, differs from another arrow in the same pixel, or
        contains NaN or infinity; the error names its number.
    """
    bad = np.flatnonzero(~np.isfinite(vectors).all(axis=(1, 2)))
    if len(bad):
        raise ProblemError(
            "observed", f"has NaN or infinity in vector {bad[0]}. Remove the vector."
        )
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
            "Remove these vectors.",
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
            f"has different vectors that start in the same pixel, such as vector {rows[first]} at "
            f"{tuple(at[first].tolist())}. Keep one vector for each pixel.",
        )
    return Observation(y, known, int((here & outward).sum()))
