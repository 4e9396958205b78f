"""napari's circle around the cursor, where something is painted or taken hold of."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.layers.compat import brush_circle_of


def clear_middle(viewer: Any) -> None:
    """Let what is pointed at be seen through the middle of the circle.

    napari 0.9 puts a small square there, in the colour of the canvas and meant for the background
    of words; it stays behind when the circle goes.
    """
    circle = brush_circle_of(viewer)
    if getattr(circle, "box", False):
        circle.box = False


@contextmanager
def no_circle(viewer: Any) -> Iterator[None]:
    """Draw no circle meanwhile, as for a picture of the canvas."""
    circle = brush_circle_of(viewer)
    visible = circle is not None and circle.visible
    if visible:
        circle.visible = False
    try:
        yield
    finally:
        if visible:
            circle.visible = True
