"""Displacement of the sites of a patch, for a mark that holds displaced tissue as it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import is_whole, real, reals
from napari_hmrf.errors import ProblemError

Point = tuple[float, ...]
Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]
#: Function that returns the displacements, (N, n), of undeformed points, (N, n) in pixels, in the
#: unit of the spacing; NaN outside tissue.
PresentMotion = Callable[[Array], Array]

#: Largest number of nodes of a lattice; on larger patches, the nodes are more than a pixel apart.
_NODES = 4096
#: Differences of displacement that are not stored, and rounding of stored displacements, as
#: fractions of a pixel. The error of the solver in the window is up to 0.01 pixels.
_UNIFORM, _ROUNDING = 0.01, 1e-4
_FIELDS = ("start", "step", "shape", "values")


@dataclass(frozen=True, eq=False)
class PatchMotion:
    """Displacement at the nodes of a regular lattice; between the nodes it is linear.

    Beyond the lattice, the displacement is that of the nearest node. The values are a read-only
    array, which copies of a mark and the steps of undo share.

    Attributes
    ----------
    start : tuple of float
        Position of the first node, (row, col) or (plane, row, col) in pixels.
    step : float
        Distance between neighbouring nodes along each axis, in pixels.
    shape : tuple of int
        Number of nodes along each axis.
    values : ndarray, float32
        Displacements in the unit of the pixel spacing, as a flat array in the order of an array of
        shape (*shape, n). Other numbers are rounded to float32, as in `Canvas.observed`.

    Raises
    ------
    ProblemError
        If the values do not form such a lattice.
    """

    start: Point
    step: float
    shape: tuple[int, ...]
    values: Values = field(repr=False)

    def __post_init__(self) -> None:
        axes = 3 if np.shape(self.start) == (3,) else 2
        start, step = reals(self.start, axes), real(self.step)
        shape = tuple(int(size) if is_whole(size) else 0 for size in self.shape)
        values = _read_only(self.values)
        is_lattice = len(shape) == axes and all(size > 0 for size in shape) and step > 0
        is_complete = values.shape == (math.prod(shape) * axes,)
        if not (is_lattice and is_complete and np.isfinite([*start, step, *_limits(values)]).all()):
            raise ProblemError(
                "drawing",
                "has a mark with an invalid motion. Use a PatchMotion with a value for each node "
                "and component.",
            )
        for name, value in zip(_FIELDS, (tuple(start), step, shape, values), strict=True):
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PatchMotion):
            return NotImplemented
        same = self.values is other.values or np.array_equal(self.values, other.values)
        return same and self._lattice == other._lattice

    def __hash__(self) -> int:
        return hash((self._lattice, self.values.tobytes()))

    @property
    def _lattice(self) -> tuple[Any, ...]:
        return self.start, self.step, self.shape

    @property
    def array(self) -> Array:
        """Displacements as an array of shape (*shape, n)."""
        return self.values.astype(float).reshape(*self.shape, len(self.shape))

    def on(self, box: Sequence[slice]) -> Array:
        """Return the displacement at each pixel of a box, as an array of shape (*box, n)."""
        values = self.array
        for axis, (side, begin) in enumerate(zip(box, self.start, strict=True)):
            last = self.shape[axis] - 1
            at = np.clip((np.arange(side.start, side.stop) - begin) / self.step, 0, last)
            low = np.minimum(np.floor(at).astype(int), max(last - 1, 0))
            part = (at - low).reshape([-1 if each == axis else 1 for each in range(values.ndim)])
            high = np.minimum(low + 1, last)
            values = (1 - part) * values.take(low, axis) + part * values.take(high, axis)
        return values

    def scaled(self, factor: float) -> PatchMotion:
        """Return the motion with positions multiplied by a factor, for another pixel grid."""
        start = tuple(at * factor for at in self.start)
        return replace(self, start=start, step=self.step * factor)

    def to_volume(self, axes: tuple[int, int], index: float) -> PatchMotion:
        """Return the motion of a slice as a motion of the volume; see `SliceInVolume`."""
        across = 3 - sum(axes)
        values, start = np.zeros((*self.shape, 1, 3)), [index] * 3
        values[..., 0, list(axes)] = self.array
        for axis, at in zip(axes, self.start, strict=True):
            start[axis] = at
        return self._with(start, np.moveaxis(values, (0, 1, 2), (*axes, across)))

    def to_slice(self, axes: tuple[int, int], index: float) -> PatchMotion:
        """Return the motion of a volume as a motion of the slice; see `SliceInVolume`."""
        across = 3 - sum(axes)
        node = round((index - self.start[across]) / self.step)
        node = min(max(node, 0), self.shape[across] - 1)
        values = np.moveaxis(self.array, (*axes, across), (0, 1, 2))[:, :, node, list(axes)]
        return self._with([self.start[axis] for axis in axes], values)

    def _with(self, start: Sequence[float], values: npt.NDArray[Any]) -> PatchMotion:
        return PatchMotion(tuple(start), self.step, values.shape[:-1], values.ravel())


def present_motion(
    box: Sequence[slice], spacing: Sequence[float], motion: PresentMotion
) -> PatchMotion | None:
    """Return the present motion of the sites in a box.

    Parameters
    ----------
    box : sequence of slice
        Pixels of the patch.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    motion : callable
        Returns the displacements of points; see `PresentMotion`.

    Returns
    -------
    PatchMotion or None
        None if the tissue in the box moves as a block, or if there is no tissue.
    """
    lengths = [side.stop - side.start for side in box]
    step, pixel = 1, min(spacing)
    while math.prod(shape := [-(-(length - 1) // step) + 1 for length in lengths]) > _NODES:
        step += 1
    start = [side.start for side in box]
    sites = np.moveaxis(np.indices(shape), 0, -1) * float(step) + start
    values = motion(sites.reshape(-1, len(shape))).reshape(sites.shape)
    outside = np.isnan(values).any(axis=-1)
    if outside.all() or np.ptp(values[~outside], axis=0).max() < _UNIFORM * pixel:
        return None
    nearest = scipy.ndimage.distance_transform_edt(
        outside, return_distances=False, return_indices=True
    )
    decimals = math.ceil(-math.log10(_ROUNDING * pixel))
    filled = np.round(values[tuple(nearest)], decimals) + 0.0
    return PatchMotion(tuple(start), step, tuple(shape), filled.ravel())


def _read_only(values: npt.ArrayLike) -> Values:
    """Return values as a read-only array, which is a copy of an array that can be changed."""
    with np.errstate(over="ignore"):
        array = np.asarray(values, dtype=np.float32)
    if array.flags.writeable:
        array = array.copy() if array is values or array.base is not None else array
        array.setflags(write=False)
    return array


def _limits(values: Values) -> tuple[float, ...]:
    """Return the smallest and the largest value; NaN if a value is NaN."""
    return (float(values.min()), float(values.max())) if values.size else ()
