"""Arrows that show, while painting, what the boundary will do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from napari.layers import Layer

from napari_hmrf.annotation import BoundaryRule
from napari_hmrf.layers.colours import PREVIEW
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.observations import PREVIEW_LARGEST, preview_arrows
from napari_hmrf.layers.outputs import LayerData
from napari_hmrf.layers.view import View, layer_extents
from napari_hmrf.widgets.viewer_layers import same_selection, still_there, update_layer

NAME = "boundary preview"


class BoundaryPreview:
    """A Vectors layer of its own, which follows the paint and the table.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._layer: Any = None
        self._shown: Any = None

    @property
    def layer(self) -> Any:
        """The Vectors layer, if there is one in the viewer."""
        return still_there(self._viewer, self._layer)

    @staticmethod
    def too_large(boundary: Any) -> bool:
        """Whether arrows for a slice would take longer than a stroke of the brush."""
        return math.prod(layer_extents(boundary)[-2:]) > PREVIEW_LARGEST

    def update(
        self,
        boundary: Any,
        rules: tuple[BoundaryRule, ...],
        view: View | None,
        reference: Frame | None = None,
    ) -> None:
        """Draw what the rules say now.

        Parameters
        ----------
        boundary : napari.layers.Labels
        rules, view, reference
            As in `preview_arrows`.

        Raises
        ------
        ProblemError
            If they say nothing that can be drawn; the arrows are then those of before.
        """
        frame, arrows = preview_arrows(boundary, rules, view, reference)
        layer = self.layer
        if layer is None and not len(arrows):
            return
        pixels = [layer_extents(boundary)[axis] for axis in frame.plane]
        attributes = {
            **frame.placement(),
            "name": NAME,
            "vector_style": "arrow",
            "edge_color": PREVIEW,
            "edge_width": max(pixels) / 400,
            "opacity": 1.0,
            "metadata": {METADATA: {"kind": "preview", "slice": frame.slice_name}},
        }
        made = LayerData(frame.put_vectors(arrows), attributes, "vectors")
        if layer is not None and layer.ndim == frame.ndim:
            if self._shown is not None and np.array_equal(self._shown, made.data):
                return
            update_layer(layer, made)
            layer.visible = True
            self._raise_above(boundary)
        else:
            self.remove()
            self._layer = Layer.create(*made)
            with same_selection(self._viewer):
                self._viewer.add_layer(self._layer)
        self._shown = made.data

    def _raise_above(self, boundary: Any) -> None:
        layers = self._viewer.layers
        if boundary in layers and layers.index(self._layer) < layers.index(boundary):
            layers.move(layers.index(self._layer), len(layers))

    def hide(self) -> None:
        """Make way for the result; the next edit shows the preview again."""
        if self.layer is not None:
            self.layer.visible = False

    def remove(self) -> None:
        """Take the layer out of the viewer."""
        if self.layer is not None:
            self._viewer.layers.remove(self._layer)
        self._layer = self._shown = None
