"""Conversion of marks between a slice and the volume that contains the slice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from napari_hmrf.tissue.drawing.marks import Components, Landmark, Mark, Point, Stroke
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion

#: Axis of the volume that a mark of one component prescribes.
_AXES: dict[Components, int] = {"row": 1, "col": 2}


@dataclass(frozen=True)
class SliceInVolume:
    """Position of a slice in a volume.

    Attributes
    ----------
    axes : (int, int)
        Axes of the volume that are the rows and columns of the slice.
    index : int
        Position of the slice along the other axis of the volume.
    """

    axes: tuple[int, int]
    index: int

    @classmethod
    def of(cls, plane: Sequence[int], index: Sequence[int], volume: Sequence[int]) -> SliceInVolume:
        """Return the position of a slice of a layer.

        Parameters
        ----------
        plane : sequence of int, shape (2,)
            Axes of the layer that are the axes of the slice.
        index : sequence of int, shape (D,)
            Position of the slice along each axis of the layer.
        volume : sequence of int, shape (3,)
            Axes of the layer that are the axes of the volume.

        Returns
        -------
        SliceInVolume
        """
        axes = [*volume]
        rows, cols = (axes.index(axis) for axis in plane)
        (across,) = {*volume} - {*plane}
        return cls((rows, cols), int(index[across]))

    @property
    def across(self) -> int:
        """Axis of the volume across the slice."""
        return 3 - sum(self.axes)

    def to_volume(self, mark: Mark) -> Mark:
        """Return a mark of the slice as a mark of the volume, without motion across the slice."""
        components = _components(mark)
        if components != "both":
            axis = self.axes[0 if components == "row" else 1]
            components = next((name for name, at in _AXES.items() if at == axis), "both")
        motion = partial(PatchMotion.to_volume, axes=self.axes, index=self.index)
        return _converted(mark, self._raise(self.index), self._raise(0.0), motion, components)

    def to_slice(self, mark: Mark) -> Mark | None:
        """Return a mark of the volume as a mark of the slice, without motion across the slice.

        Returns
        -------
        Mark or None
            None if the mark is not drawn on the slice, or prescribes only motion across the slice.
        """
        places = [place for line in mark.lines for place in line]
        if any(round(place[self.across]) != self.index for place in places):
            return None
        components = _components(mark)
        if components != "both":
            axis = _AXES[components]
            if axis not in self.axes:
                return None
            components = "row" if axis == self.axes[0] else "col"
        motion = partial(PatchMotion.to_slice, axes=self.axes, index=self.index)
        return _converted(mark, self._lower, self._lower, motion, components)

    def _raise(self, depth: float) -> Callable[[Point], Point]:
        def raised(place: Point) -> Point:
            parts = dict(zip(self.axes, place, strict=True))
            return tuple(parts.get(axis, float(depth)) for axis in range(3))

        return raised

    def _lower(self, place: Point) -> Point:
        return tuple(place[axis] for axis in self.axes)


def _components(mark: Mark) -> Components:
    return "both" if isinstance(mark, Landmark) else mark.components


def _converted(
    mark: Mark,
    place: Callable[[Point], Point],
    step: Callable[[Point], Point],
    motion: Callable[[PatchMotion], PatchMotion],
    components: Components,
) -> Mark:
    """Return a mark with converted positions and displacements."""
    of_patch = None if mark.motion is None else motion(mark.motion)
    if not isinstance(mark, Stroke):
        if isinstance(mark, Landmark):
            source, target = place(mark.source), place(mark.target)
            return replace(mark, source=source, target=target, motion=of_patch)
        at, by = place(mark.at), step(mark.by)
        return replace(mark, at=at, by=by, components=components, motion=of_patch)
    lines = tuple(tuple(map(place, line)) for line in mark.lines)
    by = step(mark.by) if mark.action == "move" else mark.by
    return replace(mark, lines=lines, by=by, components=components, motion=of_patch)
