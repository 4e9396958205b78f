"""Layers that come, change and go in the viewer while the user is at work with others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.layers.transform import PLACE

#: Viewers whose selection will be as it was.
_kept: list[Any] = []


def still_there(viewer: Any, layer: Any) -> Any:
    """A layer if it is in the viewer; None if somebody removed it, or there is none."""
    return layer if layer is not None and layer in viewer.layers else None


def update_layer(layer: Any, made: LayerData) -> None:
    """Give a layer other data and place; how the user had it drawn stays."""
    layer.data = made.data
    for name in PLACE:
        setattr(layer, name, made.attributes[name])
    layer.metadata = made.attributes["metadata"]
    if made.attributes["metadata"][METADATA]["kind"] == "magnitude":
        layer.contrast_limits = made.attributes["contrast_limits"]


@contextmanager
def same_selection(viewer: Any) -> Iterator[None]:
    """Add layers without taking the brush out of the user's hand."""
    selected, active = set(viewer.layers.selection), viewer.layers.selection.active
    _kept.append(viewer)
    try:
        yield
        viewer.layers.selection = {layer for layer in selected if layer in viewer.layers}
        if active in viewer.layers:
            viewer.layers.selection.active = active
    finally:
        _kept.pop()


def is_selection_kept(viewer: Any) -> bool:
    """Whether the selection changes only until a layer of ours is added."""
    return any(each is viewer for each in _kept)
