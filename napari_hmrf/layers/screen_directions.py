"""Which way the rows and columns of a slice run: on the screen, or in the patient where known.

Scans say how they lie in the patient. Layers carry it in the names of their axes, and so do studies
and results.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from napari.layers import Image, Labels

from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.layers.compat import camera_of

#: Columns whose direction is less than this aside from that of the rows have no way of their own.
_ASIDE = 0.5
#: Ways that are opposite.
_PAIRS = (
    ("up", "down"),
    ("left", "right"),
    ("S", "I"),
    ("A", "P"),
    ("R", "L"),
    ("deeper", "shallower"),
)
_OPPOSITE = {way: other for pair in _PAIRS for way, other in (pair, pair[::-1])} | {"": ""}
#: Which side of the patient a letter stands for.
_SIDES = {"S": "head", "I": "feet", "A": "front", "P": "back", "R": "right", "L": "left"}


class Directions(NamedTuple):
    """Where a step of one pixel goes: the nearest way of the patient, or of the screen.

    Of an image that knows how it lies in the patient ways are letters, as at the edges of the
    canvas: its left is not that of the screen. They are "" if the pixels are sheared.

    Components of a displacement keep the order and the sign of the pixels: a medical image that is
    stored mirrored is seen mirrored back, and its columns then run to the left. Of a layer that is
    turned by an angle, people read and type the components along the ways of the screen itself.

    Attributes
    ----------
    rows, cols : {"down", "up", "right", "left", "S", "I", "A", "P", "R", "L", ""}
    deep : str
        Likewise across the slices of a volume; "" of a slice.
    order : tuple of int
        The axes of the displacements, in the order ([deep,] rows, columns).
    turn : float
        By how much the rows are turned from the way they have the name of, towards that of the
        columns, in radians.
    """

    rows: str = "down"
    cols: str = "right"
    turn: float = 0.0
    deep: str = ""
    order: tuple[int, ...] = (0, 1)

    @classmethod
    def of(cls, frame: Frame, viewer: Any = None) -> Directions:
        """Those of a slice in a viewer, which may itself be turned upside down.

        Parameters
        ----------
        frame : Frame
        viewer : napari.Viewer or ViewerModel, optional
        """
        axes = list(frame.plane[-2:])
        if len(frame.plane) == 3 and viewer is not None:
            missing = viewer.dims.ndim - frame.ndim
            axes = [axis - missing for axis in viewer.dims.displayed[-2:]]
        across = [axis for axis in frame.plane if axis not in axes]
        order = tuple(frame.plane.index(axis) for axis in (*across, *axes))
        deep = "".join(_way_across(frame, axis) for axis in across)
        linear = np.array(frame.matrix)[:-1, :-1][np.ix_(axes, axes)]
        linear = linear / np.linalg.norm(linear, axis=0)
        # Where the world's rows and columns run in the patient, or on the canvas.
        names = [frame.axis_labels[axis] for axis in axes]
        if all(name in PATIENT_AXES for name in names):
            ways = [PATIENT_AXES[name][0] for name in names]
        else:
            canvas = ("down", "right") if viewer is None else camera_of(viewer).orientation2d
            ways = [str(way) for way in canvas]
        main = int(np.abs(linear[:, 0]).argmax())
        seen = linear[[main, 1 - main]]
        if abs(seen[1, 1]) < _ASIDE:
            return cls("", "", deep=deep, order=order)
        forward = np.sign(np.diag(seen))
        rows, cols = (
            ways[at] if sign > 0 else _OPPOSITE[ways[at]]
            for at, sign in zip((main, 1 - main), forward, strict=True)
        )
        seen = seen * forward[:, None]
        turn = math.atan2(seen[1, 0] - seen[0, 1], seen[0, 0] + seen[1, 1])
        return cls(rows, cols, round(turn, 9) + 0.0, deep, order)

    def seen(self, by: tuple[float, ...]) -> tuple[float, ...]:
        """A displacement by its components along the ways named, ([deep,] rows, columns).

        One of fewer axes says nothing across the slices.
        """
        known = (*(0.0,) * (len(self.order) - len(by)), *by)[-len(self.order) :]
        *deep, row, col = (known[axis] for axis in self.order)
        if self.turn:
            cosine, sine = math.cos(self.turn), math.sin(self.turn)
            row, col = cosine * row - sine * col, sine * row + cosine * col
        return (*deep, row, col)

    def along(self, seen: tuple[float, ...]) -> tuple[float, ...]:
        """The inverse of `seen`; of two components there is none across the slices."""
        known = (*(0.0,) * (len(self.order) - len(seen)), *seen)
        back = self._replace(turn=-self.turn, order=tuple(range(len(known)))).seen(known)
        return tuple(back[self.order.index(axis)] for axis in range(len(back)))

    def about(self, axis: int) -> str:
        """What a number along an axis says: "How far down, along the rows; below 0: up"."""
        along, way = ("the rows", "the columns")[axis], self[:2][axis]
        if not way:
            return f"How far along {along}, in the order of the pixels"
        along = (
            "as it is seen, whichever way the layer is turned" if self.turn else f"along {along}"
        )
        return f"How far {_to(way)}, {along}; below 0: {_to(_OPPOSITE[way])}"

    def label(self, axis: int) -> str:
        """Of numbers along the rows (0) or the columns (1): "down", "right", "to R"."""
        way = self[:2][axis] or ("along rows", "along columns")[axis]
        return f"to {way}" if way in _SIDES else way

    def only(self, axis: int) -> str:
        """Speaking of one axis alone, which is the image's: "A-P only (rows)"."""
        name, both = ("rows", "columns")[axis], self.both(axis)
        return f"{both} only ({name})" if both else f"across the image's {name} only"

    def both(self, axis: int) -> str:
        """An axis without a sense: "up and down", "A-P"; "" at an angle."""
        way = self[:2][axis]
        if not way or self.turn:
            return ""
        return ("-" if way in _SIDES else " and ").join(next(p for p in _PAIRS if way in p))

    def step(self, seen: tuple[float, ...]) -> str:
        """A step along the ways named in words: "5 down, 10 right", "5 P, 10 R"."""
        if not self.rows:
            return f"({', '.join(f'{length:g}' for length in seen)})"
        ways = (self.deep, self.rows, self.cols)[-len(seen) :]
        parts = [
            f"{abs(length):g} {way if length > 0 else _OPPOSITE[way]}"
            for length, way in zip(seen, ways, strict=True)
            if length
        ]
        return ", ".join(parts) or "0"


def _way_across(frame: Frame, axis: int) -> str:
    """Which way of a patient the slices across an axis follow each other, or deeper."""
    names = PATIENT_AXES.get(frame.axis_labels[axis])
    backwards = frame.matrix[axis][axis] < 0
    return "deeper" if names is None else names[int(backwards)]


def _to(way: str) -> str:
    if way in _SIDES:
        return f"to {way}, the patient's {_SIDES[way]}"
    return f"to the {way}" if way in ("right", "left") else way


class Sides(NamedTuple):
    """The side of the patient beyond each edge of the canvas: a letter, or "" if unknown."""

    top: str = ""
    bottom: str = ""
    left: str = ""
    right: str = ""

    @classmethod
    def of(cls, viewer: Any) -> Sides:
        """Those of the slice that a viewer shows, however it is turned; none in 3-D."""
        dims = viewer.dims
        if dims.ndisplay != 2:
            return cls()
        known: dict[int, tuple[str, str]] = {}
        pictures = (each for each in viewer.layers if isinstance(each, Image | Labels))
        for layer in filter(lambda each: each.visible, pictures):
            for axis, label in enumerate(layer.axis_labels):
                if label in PATIENT_AXES:
                    known[axis + dims.ndim - layer.ndim] = PATIENT_AXES[label]
        ends = [known.get(axis, ("", "")) for axis in dims.displayed]
        down, right = (str(way) for way in camera_of(viewer).orientation2d)
        bottom, top = ends[0] if down == "down" else ends[0][::-1]
        end, begin = ends[1] if right == "right" else ends[1][::-1]
        return cls(top, bottom, begin, end)
