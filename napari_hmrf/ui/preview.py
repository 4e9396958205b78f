"""Arrows that show, while painting, what the boundary will do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Layer

from napari_hmrf.layers.label_colours import PREVIEW
from napari_hmrf.layers.landmarks import LandmarkLayers, read_landmarks
from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.observed_arrows import PREVIEW_LARGEST, preview_arrows
from napari_hmrf.layers.pixel_copy import plane_shape
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.layers.slice_view import View, layer_extents
from napari_hmrf.layers.viewer_layers import same_selection, still_there, update_layer
from napari_hmrf.tissue.boundary_rules import BoundaryRule

FloatArray = npt.NDArray[np.float32]

NAME = "boundary preview"
_KIND = "preview"
LANDMARKS = "landmark preview"


class Preview:
    """A Vectors layer of its own, which shows arrows until there is a result.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    name : str
        Of the layer.
    width : float
        Of its arrows, beside the usual.
    """

    def __init__(self, viewer: Any, name: str, width: float = 1.0) -> None:
        self._viewer, self._name, self._width = viewer, name, width
        self._layer: Any = None
        self._shown: Any = None

    @property
    def layer(self) -> Any:
        """The Vectors layer, if there is one in the viewer."""
        return still_there(self._viewer, self._layer)

    def show(self, frame: Frame, arrows: FloatArray, of: Any, above: Any) -> None:
        """Draw arrows.

        Parameters
        ----------
        frame : Frame
        arrows : ndarray, shape (N, 2, 2)
            (start, step) in pixels of the slice.
        of, above : napari.layers.Layer
            Whose pixels these are, and what the arrows are drawn above.
        """
        layer = self.layer
        if layer is None and not len(arrows):
            return
        pixels = [layer_extents(of)[axis] for axis in frame.plane]
        attributes = {
            **frame.placement(),
            "name": self._name,
            "vector_style": "arrow",
            "edge_color": PREVIEW,
            "edge_width": self._width * max(pixels) / 400,
            "opacity": 1.0,
            "metadata": {METADATA: {"kind": _KIND, "slice": frame.slice_name}},
        }
        made = LayerData(frame.put_vectors(arrows), attributes, "vectors")
        if layer is not None and layer.ndim == frame.ndim:
            if self._shown is not None and np.array_equal(self._shown, made.data):
                return
            update_layer(layer, made)
            layer.visible = True
            self._raise_above(above)
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


class BoundaryPreview(Preview):
    """Arrows that follow the paint and the table.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        super().__init__(viewer, NAME)

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
        self.show(frame, arrows, boundary, boundary)


class LandmarkPreview(Preview):
    """Arrows from where things are to where they should be: they show which points are a pair.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        super().__init__(viewer, LANDMARKS, 2.0)

    def update(self, pair: LandmarkLayers, image: Any, view: View | None) -> None:
        """Draw the pairs.

        Parameters
        ----------
        pair : LandmarkLayers
        image : napari.layers.Image or napari.layers.Labels
            In whose pixels they count.
        view : View, optional

        Raises
        ------
        ProblemError
            If they are no pairs; the arrows are then those of before.
        """
        frame = Frame.of(image, view)
        marks = read_landmarks(pair, frame, plane_shape(image, frame), view)[0].marks
        ends = np.array([(mark.source, mark.target) for mark in marks], dtype=np.float32)
        arrows = np.stack([ends[:, 0], ends[:, 1] - ends[:, 0]], axis=1)
        self.show(frame, arrows, image, pair.where if pair.should is None else pair.should)


def is_preview(layer: Any) -> bool:
    """Whether a layer is a preview of a boundary, whichever dock made it."""
    return known_of(layer).get("kind") == _KIND
