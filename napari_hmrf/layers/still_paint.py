"""Painted layers of tissue and boundaries, which do not move with the deformed image."""

from __future__ import annotations

from typing import Any

from napari.layers import Labels

from napari_hmrf.layers.compat import fade
from napari_hmrf.layers.field_layer import MOVED
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, metadata_of, role_of

#: Modes in which napari paints.
BRUSHES = ("paint", "erase", "fill", "polygon")


def lies_still(layer: Any) -> bool:
    """Return whether a layer shows tissue or boundaries at their undeformed positions."""
    return role_of(layer) in (TISSUE, BOUNDARY) and metadata_of(layer).get("kind") != MOVED


def is_painted(viewer: Any, layer: Any) -> bool:
    """Return whether a brush of napari is selected in a layer."""
    is_active = isinstance(layer, Labels) and layer is viewer.layers.selection.active
    return is_active and layer.mode in BRUSHES


def is_deformed(viewer: Any) -> bool:
    """Return whether a deformed image is visible."""
    return any(each.visible and metadata_of(each).get("kind") == "image" for each in viewer.layers)


def hide_still_paint(viewer: Any) -> list[Any]:
    """Hide painted layers while a deformed image is visible, and return the hidden layers.

    Over a deformed image, the paint would look like an error of the deformation. A layer in which a
    brush is selected stays in use and is not drawn until the undeformed image is visible again.
    """
    deformed, hidden = is_deformed(viewer), []
    for layer in viewer.layers:
        if not (lies_still(layer) and layer.visible):
            continue
        in_use = is_painted(viewer, layer)
        fade(viewer, layer, 0.0 if deformed and in_use else 1.0)
        if deformed and not in_use:
            layer.visible = False
            hidden.append(layer)
    return hidden
