"""What *Look at the result* can be set to, by hand or from Python."""

from __future__ import annotations

from typing import Any, get_args

from napari_hmrf.layers.result_lookup import FoundResult, can_be_source, result_of
from napari_hmrf.layers.strain_layers import Quantity
from napari_hmrf.ui.forms import Part
from napari_hmrf.ui.look.look_form import LookFace
from napari_hmrf.ui.look.look_messages import NOTHING
from napari_hmrf.ui.look.scene import Scene
from napari_hmrf.ui.viewer_dock import Dock


class LookControls(Dock):
    """The choices; what follows from them comes on top.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    result : napari.layers.Vectors or None
        The arrows that hold the result.
    image : napari.layers.Image or None
        What is moved.
    percent : int
        How much of the deformation is seen, from 0 to 100.
    playing : bool
        Whether it goes back and forth by itself.
    grid, arrows : bool
        Whether the deformation grid is drawn, and whether arrows are.
    arrow_count : int
        How many arrows are drawn, roughly.
    arrow_length : float
        How many times longer than true arrows are drawn.
    status : str
        The sentence at the bottom.
    point : str
        What is said of the tissue under the cursor.
    """

    result = Part[Any]("_face.result.value")
    image = Part[Any]("_face.image.value")
    percent = Part[int]("_face.slider.value")
    playing = Part[bool]("_scene.player.playing")
    grid = Part[bool]("_face.grid.value")
    arrows = Part[bool]("_face.arrows.value")
    arrow_count = Part[int]("_face.count.value")
    arrow_length = Part[float]("_face.length.value")
    status = Part[str]("_face.status.value")
    point = Part[str]("_face.point.value")

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._taken: FoundResult | None = None
        self._face = LookFace(self, self._layers, self._is_result, self._is_source)
        self._scene = Scene(self, self._viewer, self._face)

    @property
    def before(self) -> bool:
        """Whether the image is seen as it was, and nothing of the result."""
        return self._scene.shown.held

    @before.setter
    def before(self, hold: bool) -> None:
        if hold:
            self._scene.shown.hold_before()
        else:
            self._scene.shown.release()

    @property
    def colours(self) -> str:
        """What colours show: "nothing", "magnitude", "jacobian", "equivalent", ... (`Quantity`)."""
        return str(self._face.colours.value)

    @colours.setter
    def colours(self, quantity: str) -> None:
        known = (NOTHING, *get_args(Quantity))
        if quantity not in known:
            raise ValueError(f"there are no colours {quantity!r}; take one of {list(known)}")
        self._face.colours.value = quantity

    def _is_result(self, layer: Any) -> bool:
        return result_of(layer) is not None

    def _is_source(self, layer: Any) -> bool:
        return self._taken is not None and can_be_source(layer, self._taken)
