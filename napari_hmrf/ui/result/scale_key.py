"""Scale key of the arrows of a result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.compat import scale_bar_of
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.result.moving_layers import MovingLayers

#: Corner of the key; the other corners of the canvas contain legends and the name of the tool.
_CORNER = "bottom_left"
#: Largest relative error of arrows that count as drawn to scale.
_TRUE = 0.01


class ScaleKey:
    """Scale bar of napari as the scale key, visible while the arrows are drawn to scale.

    A scale bar that the user has switched on or off is left unchanged.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    shown : callable
        Returns the displayed result, or None.
    """

    #: Emitted when the displayed length of the arrows has changed.
    length_changed = Signal()

    def __init__(self, viewer: Any, shown: Callable[[], MovingLayers | None]) -> None:
        self._bar, self._shown = scale_bar_of(viewer), shown
        # Visibility that this object has set; None before the first change.
        self._set: bool | None = None
        self._corner = self._bar.position
        self._events = EventConnections((viewer.layers.events, self._on_layers))

    @property
    def is_true(self) -> bool:
        """True if arrows are visible and as long as the displacement in the image."""
        shown = self._shown()
        if shown is None or not shown.has_arrows:
            return False
        return abs(shown.times_as_long - 1) < _TRUE

    def refresh(self) -> None:
        """Show or hide the key."""
        bar, visible = self._bar, self.is_true
        if bar.visible != bool(self._set) or bar.visible == visible:
            return  # the user has switched the bar, or it is correct
        bar.position = _CORNER if visible else self._corner
        bar.visible = self._set = visible

    def release(self) -> None:
        """Disconnect from all events."""
        self._events.release()

    def hide(self) -> None:
        """Hide the key, because the dock is closing."""
        if self._set and self._bar.visible:
            self._bar.visible, self._bar.position = False, self._corner

    def _on_layers(self, event: Any) -> None:
        if event.type in ("visible", "length", "removed"):
            self.refresh()
        if event.type == "length":
            self.length_changed.emit()
