"""Which way the rows and columns of a slice run on the screen."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.place import Frame

#: Beyond this tilt, in degrees, nobody can tell which way of the screen is the nearest to an axis.
_TILT = 44.0
_OPPOSITE = {"down": "up", "up": "down", "right": "left", "left": "right", "": ""}


class Directions(NamedTuple):
    """Where a step of one pixel goes, as it is seen: the nearest way of the screen; "" halfway.

    Components of a displacement keep the order and the sign of the pixels: a medical image that is
    stored mirrored is seen mirrored back, and its columns then run to the left.

    Attributes
    ----------
    rows, cols : {"down", "up", "right", "left", ""}
    """

    rows: str = "down"
    cols: str = "right"

    @classmethod
    def of(cls, frame: Frame, viewer: Any = None) -> Directions:
        """Those of a slice in a viewer, which may itself be turned upside down.

        Parameters
        ----------
        frame : Frame
        viewer : napari.Viewer or ViewerModel, optional
        """
        axes = list(frame.plane)
        linear = np.array(frame.matrix)[:-1, :-1][np.ix_(axes, axes)]
        # Where the world's rows and columns run on the canvas.
        down, right = ("down", "right") if viewer is None else camera_of(viewer).orientation2d
        ways = str(down), str(right)
        seen = []
        for step in linear.T:
            main = int(np.abs(step).argmax())
            straight = abs(step[1 - main]) <= np.tan(np.radians(_TILT)) * abs(step[main])
            way = ways[main] if step[main] > 0 else _OPPOSITE[ways[main]]
            seen.append(way if straight else "")
        rows, cols = seen
        upright = {"down", "up"}
        if "" in seen or (rows in upright) == (cols in upright):
            return cls("", "")
        return cls(rows, cols)

    def about(self, axis: int) -> str:
        """What a number along an axis says: "How far down, along the rows; below 0: up"."""
        along = ("the rows", "the columns")[axis]
        if not self[axis]:
            return f"How far along {along}, in the order of the pixels"
        return f"How far {_to(self[axis])}, along {along}; below 0: {_to(_OPPOSITE[self[axis]])}"

    def label(self, axis: int) -> str:
        """Of numbers along the rows (0) or the columns (1): "down", "right"."""
        return self[axis] or ("along rows", "along columns")[axis]

    def only(self, axis: int) -> str:
        """Speaking of one axis alone: "up and down only (rows)"."""
        name, both = ("rows", "columns")[axis], self.both(axis)
        return f"{both} only ({name})" if both else f"{name} only"

    def both(self, axis: int) -> str:
        """An axis without a sense: "up and down"; "" halfway."""
        if not self[axis]:
            return ""
        return "up and down" if self[axis] in ("up", "down") else "left and right"

    def step(self, by: tuple[float, float]) -> str:
        """A step in words: "5 down, 10 right"."""
        if not all(self):
            return f"({by[0]:g}, {by[1]:g})"
        parts = [
            f"{abs(length):g} {way if length > 0 else _OPPOSITE[way]}"
            for length, way in zip(by, self, strict=True)
            if length
        ]
        return ", ".join(parts) or "0"


def _to(way: str) -> str:
    return f"to the {way}" if way in ("right", "left") else way
