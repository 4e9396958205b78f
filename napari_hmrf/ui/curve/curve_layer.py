"""Layer that shows the stiffness assigned to image pixels by a curve."""

from __future__ import annotations

from typing import Any

from napari.layers import Layer

from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.label_colours import stiffness_colours
from napari_hmrf.layers.metadata import TISSUE
from napari_hmrf.layers.result_layers import layer_on
from napari_hmrf.layers.viewer_layers import layers_of, shared, still_there
from napari_hmrf.study.study import Study
from napari_hmrf.ui.curve.editor import CurveEditor


class CurveLayer:
    """Display of a study's stiffness curve: a stiffness layer for the slice, and a histogram.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    editor : CurveEditor

    Attributes
    ----------
    layer : napari.layers.Image or None
        Display-only layer above the image and its deformed copies; None if there is no curve.
    """

    def __init__(self, viewer: Any, editor: CurveEditor) -> None:
        self._viewer, self._layers, self._editor = viewer, layers_of(viewer), editor
        self._study: Study | None = None
        self._image: Any = None
        self.layer: Any = None

    def show(self, study: Study | None, image: Any = None) -> None:
        """Show the curve of a study, or remove the layer if there is no curve."""
        before, self._study = self._study, study
        curve = None if study is None else study.tissue.curve
        image = None if curve is None else image
        if image is not self._image:
            layer, self.layer, self._image, before = self.layer, None, image, None
            if still_there(self._viewer, layer):
                self._layers.remove(layer)
        if study is None or curve is None:
            return
        intensities = study.intensities
        assert intensities is not None
        if before is None or before.pictures.image is not study.pictures.image:
            self._editor.plot.show_intensities(intensities)
        elif before.tissue.curve == curve and before.grid == study.grid:
            return
        place, (softest, stiffest) = study.grid.known_place, curve.range
        metadata = {"kind": "curve", "role": TISSUE, "unit": curve.unit}
        name = f"{image.name} stiffness ({curve.unit or 'relative'})"
        look = {"colormap": stiffness_colours(), "opacity": 0.5}
        layer_data = layer_on(place, curve(intensities), name, metadata, look)
        if still_there(self._viewer, self.layer):
            self._layers.update(self.layer, layer_data)
        else:
            self.layer = Layer.create(*layer_data)
            pictures = shared(self._viewer, ResultLayers).pictures_of(image)
            self._layers.add(self.layer, self._layers.above(image, *pictures))
        # Set the lower limit below the softest tissue, so that only void pixels fall below it.
        self.layer.contrast_limits = min(softest / 2, stiffest / 256), stiffest
