"""Left and right of the patient: which way the world's axes run in the body, where that is known.

Scans say so. Layers carry it in the names of their axes, and so do studies and results.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from napari.layers import Image, Labels

from napari_hmrf.field.frame import Frame
from napari_hmrf.io.fields import PATIENT_AXES
from napari_hmrf.layers.compat import camera_of

#: Where an axis leads to, and where it comes from, as letters at the edges of a picture.
_LETTERS = dict(zip(PATIENT_AXES, (("S", "I"), ("P", "A"), ("L", "R")), strict=True))
#: What is less than this is not worth saying, in mm.
_LEAST = 0.005


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
                if label in _LETTERS:
                    known[axis + dims.ndim - layer.ndim] = _LETTERS[label]
        ends = [known.get(axis, ("", "")) for axis in dims.displayed]
        down, right = (str(way) for way in camera_of(viewer).orientation2d)
        bottom, top = ends[0] if down == "down" else ends[0][::-1]
        end, begin = ends[1] if right == "right" else ends[1][::-1]
        return cls(top, bottom, begin, end)


def step_in_patient(frame: Frame, step: tuple[float, float]) -> str:
    """A step along rows and columns by the sides it leads to, "1.2 A, 0.5 R"; "" if unknown."""
    if not all(frame.axis_labels[axis] in _LETTERS for axis in frame.plane):
        return ""
    sides = np.array(frame.matrix)[:-1, list(frame.plane)]
    parts = sides / np.linalg.norm(sides, axis=0) @ step
    said = [
        f"{abs(part):.3g} {_LETTERS[label][int(part < 0)]}"
        for label, part in zip(frame.axis_labels, parts.tolist(), strict=True)
        if label in _LETTERS and abs(part) >= _LEAST
    ]
    return ", ".join(said)
