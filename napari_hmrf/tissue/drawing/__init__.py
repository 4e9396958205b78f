"""Drawings on an image: arrows, landmarks and brush strokes, as immutable values.

A `Drawing` is a sequence of marks; a `Rendering` applies a drawing to the images of a problem. This
package does not import Qt or napari.
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
