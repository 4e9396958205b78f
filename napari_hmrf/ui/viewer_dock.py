"""What all dock widgets of ours have in common: the viewer they are in, and whether they are."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import Container

from napari_hmrf.layers.compat import unwrapped
from napari_hmrf.layers.viewer_results import ResultLayers
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.ui.brush_circle import clear_middle
from napari_hmrf.ui.dock_life import Life
from napari_hmrf.ui.tabs import Tabs
from napari_hmrf.ui.timers import single_shot


class Dock(Container):
    """Knows its viewer; opens as a tab beside others of ours, and is told when it is closed.

    Parameters
    ----------
    napari_viewer : napari.Viewer
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(labels=False)
        self._viewer = unwrapped(napari_viewer)
        self._life = Life(self, self._on_opened, self._on_closed, self._on_end)
        self._results = shared(self._viewer, ResultLayers)
        # napari may be in the middle of removing more layers than the one.
        self._sweeping = single_shot(self.native, 0, self._results.remove_orphans)
        self._results.orphaned.connect(self._on_orphaned)
        Tabs(self, self._viewer)
        clear_middle(self._viewer)

    @property
    def away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""
        return self._life.away

    def _layers(self) -> list[Any]:
        return list(self._viewer.layers)

    def _on_orphaned(self) -> None:
        if not self._life.over:
            self._sweeping.start()

    def _on_opened(self) -> None:
        """There is a dock around this."""

    def _on_closed(self) -> None:
        """The dock was closed."""

    def _on_end(self) -> None:
        """The window is gone: listen to nothing any more."""
