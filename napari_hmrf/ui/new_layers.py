"""Empty layers to paint on, with tables that make sense from the first stroke."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from napari.layers import Labels

from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, described
from napari_hmrf.layers.slice_view import View, fits, frame_of, layer_extents, plane_shape
from napari_hmrf.tissue.boundary_rules import UNPAINTED, BoundaryRule, Material
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.tissue.usual_lengths import usual_step

#: Beyond this many pixels a whole stack of labels would not fit; one slice then does.
_LARGEST = 2**30


def add_missing(viewer: Any, image: Any, tissue: Any, boundary: Any, view: View) -> tuple[Any, Any]:
    """Add what an image lacks to be painted on, and put a brush into the user's hand.

    What stays unpainted is normal tissue; the boundary's first two labels hold and push.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    image : napari.layers.Image
    tissue, boundary : napari.layers.Layer or None
        What is chosen, of this image or another.
    view : View

    Returns
    -------
    tissue, boundary : napari.layers.Layer
        Those that were there, and those that are new.

    Raises
    ------
    ProblemError
        If the slice that is shown is none of the image's.
    """
    tissue_there, boundary_there = (
        layer is not None and fits(layer, image, view) for layer in (tissue, boundary)
    )
    layers, blank = viewer.layers, partial(_blank, image, view)
    if not tissue_there:
        paper = PRESETS[0]
        materials = (Material(0, UNPAINTED, paper.materials[0].stiffness), *paper.materials)
        tissue = blank("Tissue", described(TISSUE, materials, paper.unit), opacity=0.4)
        # What holds is to be seen on top.
        layers.insert(layers.index(boundary) if boundary_there else len(layers), tissue)
    if not boundary_there:
        frame = frame_of(image, view)
        push = usual_step(plane_shape(image, frame), frame.spacing)
        holds = BoundaryRule(1, "fixed", name="holds")
        grows = BoundaryRule(2, "expand", amount=push, name="grows")
        known = described(BOUNDARY, (holds, grows))
        boundary = blank("Boundary", known, colormap=boundary_colours())
        layers.append(boundary)
    lacking = not isinstance(tissue, Labels) or (tissue_there and not boundary_there)
    first = boundary if lacking else tissue
    viewer.layers.selection = {first}
    if isinstance(first, Labels):
        first.selected_label, first.mode = 2 if first is tissue else 1, "paint"
    return tissue, boundary


def _blank(image: Any, view: View, name: str, known: dict[str, Any], **look: Any) -> Labels:
    """A layer on an image's pixels, in its place, of which nothing is painted."""
    frame, shape = frame_of(image, view), layer_extents(image)
    place = frame.placement()
    if math.prod(shape) > _LARGEST:
        shape = tuple(size if axis in frame.plane else 1 for axis, size in enumerate(shape))
        place = frame.placement(image=True)
    layer = Labels(np.zeros(shape, np.uint8), name=name, metadata=known, **look, **place)
    layer.brush_size = max(3, round(max(plane_shape(image, frame)) / 40))
    layer.n_edit_dimensions = len(frame.plane)  # of a volume the brush is a ball
    return layer
