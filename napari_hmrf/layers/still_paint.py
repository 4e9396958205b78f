"""Painted layers of tissue and boundaries, which do not move with the deformed image."""

from __future__ import annotations

from typing import Any

from napari.layers import Labels

from napari_hmrf.layers.field_layer import MOVED
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, metadata_of, role_of
from napari_hmrf.layers.viewer_layers import ViewerLayers

#: Modes for painting in Labels layers, with the mode that picks a label from the image.
BRUSHES = ("paint", "erase", "fill", "polygon", "pick")


def lies_still(layer: Any) -> bool:
    """Return whether a layer shows tissue or boundaries at their undeformed positions."""
    return role_of(layer) in (TISSUE, BOUNDARY) and metadata_of(layer).get("kind") != MOVED


def is_painted(viewer: Any, layer: Any) -> bool:
    """Return whether a brush of napari is selected in a layer."""
    is_active = isinstance(layer, Labels) and layer is viewer.layers.selection.active
    return is_active and layer.mode in BRUSHES


def layer_painted(viewer: Any) -> Any:
    """Return the tissue or boundary layer in which a brush of napari is selected, or None."""
    active = viewer.layers.selection.active
    return active if is_painted(viewer, active) and lies_still(active) else None


def put_brush_away(viewer: Any) -> None:
    """Let the mouse move the view again if a brush is selected in a tissue or boundary layer."""
    if (layer := layer_painted(viewer)) is not None:
        layer.mode = "pan_zoom"


def is_deformed(viewer: Any) -> bool:
    """Return whether a deformed image is visible."""
    return any(each.visible and metadata_of(each).get("kind") == "image" for each in viewer.layers)


def hide_still_paint(layers: ViewerLayers) -> list[Any]:
    """Hide painted layers while a deformed image is visible, and return the hidden layers.

    Over a deformed image, the paint would look like an error of the deformation. A layer in which a
    brush is selected stays visible.
    """
    viewer = layers.viewer
    if not is_deformed(viewer):
        return []
    shown = [each for each in viewer.layers if lies_still(each) and each.visible]
    hidden = [each for each in shown if not is_painted(viewer, each)]
    layers.want(*hidden, wanted=False)
    return hidden
