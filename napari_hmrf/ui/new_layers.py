"""Empty layers for painting, with default tables for the first labels."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from napari.layers import Labels

from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.layers.slice_view import View, fits, frame_of, layer_extents, plane_shape
from napari_hmrf.layers.viewer_layers import layers_of
from napari_hmrf.tissue.boundary_rules import NAMES_OF_ACTIONS, UNPAINTED, BoundaryRule, Material
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.material_presets import Palette, Preset
from napari_hmrf.tissue.usual_lengths import usual_step

#: Largest number of pixels in a new Labels layer; for a larger image, the layer covers one slice.
_LARGEST = 2**30


def add_missing(
    viewer: Any,
    image: Any,
    tissue: Any,
    boundary: Any,
    view: View,
    preset: Preset,
    drawing: Drawing,
) -> tuple[Any, Any]:
    """Add the missing layers for painting, and select a brush in one of the layers.

    Unpainted pixels are normal tissue. The first label of the boundary holds tissue in place, and
    the second label pushes tissue outward.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    image : napari.layers.Image
    tissue, boundary : napari.layers.Layer or None
        Chosen layers, which may belong to another image.
    view : View
    preset : Preset
        Materials of a new tissue layer: those with which the drawing paints without a layer.
    drawing : Drawing
        Drawing, which may paint rigid tissue. A new layer then lists this tissue, too.

    Returns
    -------
    tissue, boundary : napari.layers.Layer
        The chosen layers if they fit the image, else new layers.

    Raises
    ------
    ProblemError
        If the image has no pixels in the visible slice.
    """
    has_tissue, has_boundary = (
        layer is not None and fits(layer, image, view) for layer in (tissue, boundary)
    )
    layers, blank = layers_of(viewer), partial(_blank, image, view)
    if not has_tissue:
        first = Material(0, UNPAINTED, preset.materials[0].stiffness)
        materials = (first, *preset.materials, *_painted_rows(drawing, preset))
        tissue = blank("Tissue", layer_metadata(TISSUE, materials, preset.unit), opacity=0.4)
        # Insert below the boundary, which must stay visible.
        layers.add(tissue, viewer.layers.index(boundary) if has_boundary else None)
    if not has_boundary:
        frame = frame_of(image, view)
        push = usual_step(plane_shape(image, frame), frame.spacing)
        holds = BoundaryRule(1, "fixed", name=NAMES_OF_ACTIONS["fixed"])
        grows = BoundaryRule(2, "expand", amount=push, name=NAMES_OF_ACTIONS["expand"])
        description = layer_metadata(BOUNDARY, (holds, grows))
        boundary = blank("Boundary", description, colormap=boundary_colours())
        layers.add(boundary)
    paints_boundary = not isinstance(tissue, Labels) or (has_tissue and not has_boundary)
    first = boundary if paints_boundary else tissue
    viewer.layers.selection = {first}
    if isinstance(first, Labels):
        first.selected_label, first.mode = 2 if first is tissue else 1, "paint"
    return tissue, boundary


def _painted_rows(drawing: Drawing, preset: Preset) -> tuple[Material, ...]:
    """Return the materials that a drawing paints and a preset does not list, such as bone."""
    listed = {0, *(row.label for row in preset.materials)}
    painted = {mark.label for mark in drawing.marks if isinstance(mark, Stroke)} - listed
    return tuple(row for row in Palette.of_preset(preset).materials if row.label in painted)


def _blank(image: Any, view: View, name: str, description: dict[str, Any], **look: Any) -> Labels:
    """Create an empty Labels layer on the pixel grid of an image."""
    frame, shape = frame_of(image, view), layer_extents(image)
    place = frame.placement()
    if math.prod(shape) > _LARGEST:
        shape = tuple(size if axis in frame.plane else 1 for axis, size in enumerate(shape))
        place = frame.placement(image=True)
    layer = Labels(np.zeros(shape, np.uint8), name=name, metadata=description, **look, **place)
    layer.brush_size = max(3, round(max(plane_shape(image, frame)) / 40))
    layer.n_edit_dimensions = len(frame.plane)  # for a volume, the brush is a ball
    return layer
