"""The layers that show tissue while it is pulled."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from napari.layers import Layer

from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.study.ground import Ground
from napari_hmrf.ui.grab.pixel_update import overwrite
from napari_hmrf.ui.grab.tissue_view import Seen
from napari_hmrf.ui.result_turns import sign, take_turn
from napari_hmrf.ui.viewer_layers import same_selection, still_there, update_layer

PICTURE, ARROWS = "Deformed image", "Displacement"


class LiveLayers:
    """*Deformed image* above the image, and *Displacement*, which is hidden until it is asked for.

    A layer that was deleted is made again; one that was renamed keeps its name. A dock that is
    opened after another was closed goes on with those of the other: have them `shared`.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer_ref = weakref.ref(viewer)
        self._picture: Any = None
        self._arrows: Any = None
        self._frame: Frame | None = None
        #: The image it shows; none yet.
        self._of: Callable[[], Any] = lambda: None
        self._hidden = False
        #: What the picture's layer shows, if nobody else holds it.
        self._own: Any = None

    @property
    def _viewer(self) -> Any:
        return self._viewer_ref()

    @property
    def picture(self) -> Any:
        """The *Deformed image*, if there is one in the viewer."""
        return still_there(self._viewer, self._picture)

    @property
    def arrows(self) -> Any:
        """The *Displacement*, if there is one in the viewer."""
        return still_there(self._viewer, self._arrows)

    def show(self, seen: Seen, image: Any, quick: bool = False) -> None:
        """Bring the layers up to date.

        Parameters
        ----------
        seen : Seen
        image : napari.layers.Image
            What is deformed.
        quick : bool
            Whether more will follow soon, and only the canvas counts.
        """
        self._show_picture(seen, image, quick)
        if seen.outputs is not None:
            made = sign(seen.outputs.layers["arrows"], "grab")
            made.attributes["name"] = ARROWS
            made.attributes["metadata"][METADATA]["source"] = seen.ground.study.pictures.name
            layer = self.arrows
            if layer is None or layer.ndim != seen.ground.study.grid.place.ndim:
                self._arrows = self._add(made, len(self._viewer.layers), visible=False)
            else:
                update_layer(layer, made)
                layer.visible = layer.visible or self._hidden
            self._hidden = False
        else:
            self.outdate()

    def take_turn(self, ground: Ground) -> None:
        """Have these layers seen, and no other result of the slice."""
        take_turn(
            self._viewer, "grab", ground.study.pictures.name, ground.study.grid.place.slice_name
        )

    def outdate(self) -> None:
        """The displacement is not that of what is seen: hide it until it is."""
        layer = self.arrows
        if layer is not None and layer.visible:
            layer.visible, self._hidden = False, True

    def _show_picture(self, seen: Seen, image: Any, quick: bool) -> None:
        frame, layer = seen.ground.study.grid.place, self.picture
        data = frame.put_image(seen.picture)
        rgb = seen.picture.ndim == 3
        if layer is not None and (layer.ndim, layer.rgb) == (frame.ndim, rgb):
            same = known_of(layer).get("source") == seen.ground.study.pictures.name
            if same and frame == self._frame:
                # Whoever takes the layer's data is told of others, and may write to them.
                if quick and layer.data is self._own and overwrite(self._viewer, layer, data):
                    return
                layer.data = self._own = np.array(data) if quick else data
            else:
                update_layer(layer, LayerData(data, self._attributes(seen.ground, rgb), "image"))
                if self._of() is not image:  # nobody has chosen yet how that one is drawn
                    for name, value in seen.ground.study.pictures.look.items():
                        setattr(layer, name, value)
        else:
            made = LayerData(data, self._attributes(seen.ground, rgb), "image")
            layers = self._viewer.layers
            above = layers.index(image) + 1 if image in layers else len(layers)
            self._picture = self._add(made, above)
        self._frame, self._of = frame, weakref.ref(image)

    def _attributes(self, ground: Ground, rgb: bool) -> dict[str, Any]:
        facts = {"kind": "image", "by": "grab", "source": ground.study.pictures.name}
        place = {"slice": ground.study.grid.place.slice_name, "unit": ground.study.grid.place.unit}
        return {
            **ground.study.pictures.look,
            **ground.study.grid.place.placement(image=True),
            "rgb": rgb,
            "name": PICTURE,
            "metadata": {METADATA: {**facts, **place}},
        }

    def _add(self, made: LayerData, at: int, visible: bool = True) -> Any:
        layer = Layer.create(*made)
        layer.visible = visible
        with same_selection(self._viewer):
            self._viewer.layers.insert(at, layer)
        return layer
