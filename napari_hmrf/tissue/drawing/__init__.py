"""What was drawn on an image: arrows, landmarks and brush strokes, as values that do not change.

A `Drawing` is marks in their order; `Rendering` puts it on top of the images of a problem. Nothing
here needs Qt or napari.
"""

from napari_hmrf.tissue.drawing.canvas import Canvas
from napari_hmrf.tissue.drawing.drawing import Drawing, Hit, Rendering
from napari_hmrf.tissue.drawing.marks import Arrow, Landmark, Mark, Stroke

__all__ = [
    "Arrow",
    "Canvas",
    "Drawing",
    "Hit",
    "Landmark",
    "Mark",
    "Rendering",
    "Stroke",
]
