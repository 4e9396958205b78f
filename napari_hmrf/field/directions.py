"""Which way the rows and columns of a slice run: on the screen, or in the patient where known.

Scans say how they lie in the patient. Layers carry it in the names of their axes, and so do studies
and results.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from napari_hmrf.field.drawn_slice import nearest_axes, rotation_of
from napari_hmrf.field.frame import PATIENT_AXES, Frame, as_tuples

#: Pixels that step less than this along the way they would have the name of have none.
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
    turned by an angle, within its slices or out of them, people read and type the components along
    the ways of the screen, or of the patient, themselves.

    Attributes
    ----------
    rows, cols : {"down", "up", "right", "left", "S", "I", "A", "P", "R", "L", ""}
    deep : str
        Likewise across the slices of a volume; "" of a slice.
    order : tuple of int
        The axes of the displacements, in the order ([deep,] rows, columns).
    turn : n x n numbers
        The rotation of the axes, in this order, from the ways they have the names of; nothing
        where they are not turned.
    """

    rows: str = "down"
    cols: str = "right"
    turn: tuple[tuple[float, ...], ...] = ()
    deep: str = ""
    order: tuple[int, ...] = (0, 1)

    @classmethod
    def of(
        cls,
        frame: Frame,
        drawn: Sequence[int] | None = None,
        canvas: tuple[str, str] = ("down", "right"),
    ) -> Directions:
        """Those of a slice, or of a volume that is seen in slices.

        Parameters
        ----------
        frame : Frame
        drawn : sequence of int, shape (2,), optional
            Which of the frame's axes are seen as rows and columns; by default its last two.
        canvas : (str, str)
            Which ways rows and columns run on the screen where no patient is known.
        """
        axes = list(frame.plane[-2:] if drawn is None else drawn)
        across = [axis for axis in frame.plane if axis not in axes]
        axes = [*across, *axes]
        order = tuple(frame.plane.index(axis) for axis in axes)
        # Where the world's axes run in the patient, or on the canvas.
        pairs = [PATIENT_AXES.get(frame.axis_labels[axis], ()) for axis in axes]
        if not all(pairs[-2:]):
            pairs[-2:] = [(way, _OPPOSITE[way]) for way in canvas]
        pairs = [pair or ("deeper", "shallower") for pair in pairs]
        main, seen = nearest_axes(np.array(frame.matrix)[:-1, :-1][np.ix_(axes, axes)])
        forward = np.sign(np.diag(seen))
        ways = [pairs[at][int(sign < 0)] for at, sign in zip(main, forward, strict=True)]
        deep, rows, cols = ("", *ways)[-3:]
        if np.abs(np.diag(seen)).min() < _ASIDE:
            return cls("", "", deep=deep, order=order)
        turn = as_tuples(rotation_of(seen * forward[:, None]))
        return cls(rows, cols, turn, deep, order)

    def seen(self, by: tuple[float, ...]) -> tuple[float, ...]:
        """A displacement by its components along the ways named, ([deep,] rows, columns).

        One of fewer axes says nothing across the slices.
        """
        known = (*(0.0,) * (len(self.order) - len(by)), *by)[-len(self.order) :]
        seen = tuple(known[axis] for axis in self.order)
        return as_tuples(np.array(self.turn) @ seen) if self.turn else seen

    def along(self, seen: tuple[float, ...]) -> tuple[float, ...]:
        """The inverse of `seen`; of two components there is none across the slices."""
        back = (*(0.0,) * (len(self.order) - len(seen)), *seen)
        if self.turn:
            back = as_tuples(np.array(self.turn).T @ back)
        return tuple(back[self.order.index(axis)] for axis in range(len(back)))

    @property
    def steps(self) -> list[tuple[str, tuple[float, ...]]]:
        """Each way in words, with a step of 1 along it in the order of the axes."""
        size, found = len(self.order), []
        for number, way in enumerate((self.deep, self.rows, self.cols)[-size:]):
            for sign, word in ((1.0, way), (-1.0, _OPPOSITE[way])):
                step = tuple(sign * (axis == number) + 0.0 for axis in range(size))
                along = tuple(round(part, 9) + 0.0 for part in self.along(step))
                found.append((_to(word) if word else f"{step}", along))
        return found

    def nearest(self, step: tuple[float, ...]) -> tuple[float, ...]:
        """The step of `steps` that this one is, to a rounding; itself, if it is none of them."""
        same = (each for _, each in self.steps if np.shape(each) == np.shape(step))
        return next((each for each in same if np.allclose(each, step, atol=1e-6)), step)

    def steps_with(self, step: tuple[float, ...]) -> list[tuple[str, tuple[float, ...]]]:
        """The ways of `steps`, and that of another step if it is none of them, nor ()."""
        steps = self.steps
        if step and step not in [each for _, each in steps]:
            steps.append((self.step(tuple(round(part, 2) for part in self.seen(step))), step))
        return steps

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


def _to(way: str) -> str:
    if way in _SIDES:
        return f"to {way}, the patient's {_SIDES[way]}"
    return f"to the {way}" if way in ("right", "left") else way
