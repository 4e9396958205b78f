"""Directions of the rows and columns of a slice, in the patient or on the screen.

Directions in the patient are known if the axes of the layer, study or result are named after
patient axes, as in medical scans.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from napari_hmrf.field.drawn_slice import nearest_axes, rotation_of
from napari_hmrf.field.frame import PATIENT_AXES, Frame, as_tuples

#: Smallest cosine between a pixel axis and its direction; below it, no directions are named.
_ASIDE = 0.5
#: Pairs of opposite directions.
_PAIRS = (
    ("up", "down"),
    ("left", "right"),
    ("S", "I"),
    ("A", "P"),
    ("R", "L"),
    ("deeper", "shallower"),
)
_OPPOSITE = {way: other for pair in _PAIRS for way, other in (pair, pair[::-1])} | {"": ""}
#: Side of the patient for each letter.
_SIDES = {"S": "head", "I": "feet", "A": "front", "P": "back", "R": "right", "L": "left"}


class Directions(NamedTuple):
    """Named directions, in the patient or on the screen, nearest to the pixel axes.

    For an image in patient coordinates the directions are letters, as at the edges of the canvas,
    because the left of the patient is not the left of the screen. For strongly sheared pixels the
    directions are "".

    Components of a displacement have the order and sign of the pixel axes. A medical image that is
    stored mirrored is displayed unmirrored, so its column numbers increase to the left. If a layer
    is rotated, within its slices or out of them, the displayed components are along the directions
    of the screen or of the patient.

    Attributes
    ----------
    rows, cols : {"down", "up", "right", "left", "S", "I", "A", "P", "R", "L", ""}
        Direction of increasing row and column numbers.
    deep : str
        Direction of increasing slice numbers in a volume; "" for a slice.
    order : tuple of int
        Axes of the displacement, in the order ([deep,] rows, columns).
    turn : nested tuple of float, shape (n, n)
        Matrix that rotates components along the axes, ordered as in `order`, to components along
        the named directions; empty if the axes are not rotated.
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
        """Return the directions of a slice, or of a volume that is displayed as slices.

        Parameters
        ----------
        frame : Frame
        drawn : sequence of int, shape (2,), optional
            Axes of the frame that are displayed as rows and columns; by default its last two.
        canvas : (str, str)
            Directions of rows and columns on the screen, for axes without a patient direction.

        Returns
        -------
        Directions
        """
        axes = list(frame.plane[-2:] if drawn is None else drawn)
        across = [axis for axis in frame.plane if axis not in axes]
        axes = [*across, *axes]
        order = tuple(frame.plane.index(axis) for axis in axes)
        # Names of the two directions of each world axis, in the patient or on the canvas.
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

    def to_display(self, by: tuple[float, ...]) -> tuple[float, ...]:
        """Return the components of a displacement along the named directions.

        Parameters
        ----------
        by : tuple of float
            Displacement in axis order; missing leading components are 0.

        Returns
        -------
        tuple of float
            Components along ([deep,] rows, columns).
        """
        padded = (*(0.0,) * (len(self.order) - len(by)), *by)[-len(self.order) :]
        seen = tuple(padded[axis] for axis in self.order)
        return as_tuples(np.array(self.turn) @ seen) if self.turn else seen

    def from_display(self, seen: tuple[float, ...]) -> tuple[float, ...]:
        """Return the displacement, in axis order, from its components along named directions.

        This is the inverse of `to_display`. A missing component perpendicular to the slices is 0.
        """
        back = (*(0.0,) * (len(self.order) - len(seen)), *seen)
        if self.turn:
            back = as_tuples(np.array(self.turn).T @ back)
        return tuple(back[self.order.index(axis)] for axis in range(len(back)))

    @property
    def steps(self) -> list[tuple[str, tuple[float, ...]]]:
        """Label and unit step, in axis order, of each named direction."""
        size, found = len(self.order), []
        for number, way in enumerate((self.deep, self.rows, self.cols)[-size:]):
            for sign, word in ((1.0, way), (-1.0, _OPPOSITE[way])):
                step = tuple(sign * (axis == number) + 0.0 for axis in range(size))
                along = tuple(round(part, 9) + 0.0 for part in self.from_display(step))
                found.append((_to(word) if word else f"{step}", along))
        return found

    def nearest(self, step: tuple[float, ...]) -> tuple[float, ...]:
        """Return the step in `steps` that equals `step` up to rounding, or `step` itself."""
        same = (each for _, each in self.steps if np.shape(each) == np.shape(step))
        return next((each for each in same if np.allclose(each, step, atol=1e-6)), step)

    def steps_with(self, step: tuple[float, ...]) -> list[tuple[str, tuple[float, ...]]]:
        """Return `steps`, followed by the given step if it is neither empty nor included."""
        steps = self.steps
        if step and step not in [each for _, each in steps]:
            steps.append((self.step(tuple(round(part, 2) for part in self.to_display(step))), step))
        return steps

    def about(self, axis: int) -> str:
        """Return the tooltip of a distance along the row axis (0) or the column axis (1).

        An example is "Distance down, along the row axis; below 0: up".
        """
        along, way = ("the row axis", "the column axis")[axis], self[:2][axis]
        if not way:
            return f"Distance along {along}, in pixel order"
        along = "as displayed, however the layer is rotated" if self.turn else f"along {along}"
        return f"Distance {_to(way)}, {along}; below 0: {_to(_OPPOSITE[way])}"

    def label(self, axis: int) -> str:
        """Return the label of the row axis (0) or column axis (1): "down", "right", "to R"."""
        way = self[:2][axis] or ("along rows", "along columns")[axis]
        return f"to {way}" if way in _SIDES else way

    def only(self, axis: int) -> str:
        """Return the label of the option to constrain one axis only, such as "A-P only (rows)"."""
        name, both = ("rows", "columns")[axis], self.both(axis)
        return f"{both} only ({name})" if both else f"across the image's {name} only"

    def both(self, axis: int) -> str:
        """Return both directions of an axis, such as "up and down" or "A-P"; "" if rotated."""
        way = self[:2][axis]
        if not way or self.turn:
            return ""
        return ("-" if way in _SIDES else " and ").join(next(p for p in _PAIRS if way in p))

    def step(self, seen: tuple[float, ...]) -> str:
        """Describe a step by its components, such as "5 down, 10 right" or "5 P, 10 R"."""
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
