"""What *Look at the result* can be set to, by hand or from Python."""

from __future__ import annotations

from typing import Any, get_args

from napari_hmrf.layers.result_lookup import FoundResult, can_be_source, result_of
from napari_hmrf.layers.strain_layers import Quantity
from napari_hmrf.ui.look.look_form import LookFace
from napari_hmrf.ui.look.look_messages import NOTHING
from napari_hmrf.ui.look.scene import Scene
from napari_hmrf.ui.viewer_dock import Dock


class LookControls(Dock):
    """The choices; what follows from them comes on top.

    Parameters
    ----------
    napari_viewer : napari.Viewer
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._taken: FoundResult | None = None
        self._face = LookFace(self, self._layers, self._is_result, self._is_source)
        self._scene = Scene(self, self._viewer, self._face, self._results)

    @property
    def result(self) -> Any:
        """The layer of arrows that holds the result, or None."""
        return self._face.result.value

    @result.setter
    def result(self, layer: Any) -> None:
        self._face.result.choose(layer)

    @property
    def image(self) -> Any:
        """The image that is moved, or None."""
        return self._face.image.value

    @image.setter
    def image(self, layer: Any) -> None:
        self._face.image.choose(layer)

    @property
    def percent(self) -> int:
        """How much of the deformation is seen, from 0 to 100."""
        return int(self._face.slider.value)

    @percent.setter
    def percent(self, percent: int) -> None:
        self._face.slider.value = percent

    @property
    def playing(self) -> bool:
        """Whether it goes back and forth by itself."""
        return self._scene.player.playing

    @property
    def before(self) -> bool:
        """Whether the image is seen as it was, and nothing of the result."""
        return self._scene.is_before

    @before.setter
    def before(self, hold: bool) -> None:
        self._scene.show_before(hold)

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

    @property
    def grid(self) -> bool:
        """Whether the deformation grid is drawn."""
        return bool(self._face.grid.value)

    @grid.setter
    def grid(self, drawn: bool) -> None:
        self._face.grid.value = drawn

    @property
    def arrows(self) -> bool:
        """Whether arrows are drawn."""
        return bool(self._face.arrows.value)

    @arrows.setter
    def arrows(self, drawn: bool) -> None:
        self._face.arrows.value = drawn

    @property
    def arrow_count(self) -> int:
        """How many arrows are drawn, roughly."""
        return int(self._face.count.value)

    @arrow_count.setter
    def arrow_count(self, about: int) -> None:
        self._face.count.value = about

    @property
    def arrow_length(self) -> float:
        """How many times longer than true arrows are drawn."""
        return float(self._face.length.value)

    @arrow_length.setter
    def arrow_length(self, times: float) -> None:
        self._face.length.value = times

    @property
    def status(self) -> str:
        """The sentence at the bottom."""
        return str(self._face.status.value)

    @property
    def point(self) -> str:
        """What is said of the tissue under the cursor."""
        return str(self._face.point.value)

    def _is_result(self, layer: Any) -> bool:
        return result_of(layer) is not None

    def _is_source(self, layer: Any) -> bool:
        return self._taken is not None and can_be_source(layer, self._taken)
