"""What a dock widget has to know: the viewer it is in, and whether it is there."""

from __future__ import annotations

import math
from typing import Any

from magicgui.widgets import Container

from napari_hmrf.layers.compat import camera_of, clear_middle, unwrapped
from napari_hmrf.layers.viewer_results import ResultLayers
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.ui.dock_life import Life
from napari_hmrf.ui.timers import single_shot

#: Until the canvas has the size that a new dock leaves it, in milliseconds.
_LAID_OUT = 50
#: The middle of a view is the same if it is not further away, in pixels of the screen.
_NEAR = 20


class Dock(Container):
    """Knows its viewer; an image that was seen whole is seen whole beside it, too.

    Parameters
    ----------
    napari_viewer : napari.Viewer
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(labels=False)
        self._viewer = unwrapped(napari_viewer)
        self._life = Life(self, self._on_docked, self._on_closed, self._on_end)
        self._results = shared(self._viewer, ResultLayers)
        # napari may be in the middle of removing more layers than the one.
        self._sweeping = single_shot(self.native, 0, self._results.remove_orphans)
        self._results.orphaned.connect(self._on_orphaned)
        self._fitting = single_shot(self.native, _LAID_OUT, self._viewer.reset_view)
        clear_middle(self._viewer)

    @property
    def away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""
        return self._life.away

    @property
    def docked(self) -> bool:
        """Whether there is a dock around this, in a window."""
        return self._life.docked

    def _on_orphaned(self) -> None:
        if not self._life.over:
            self._sweeping.start()

    def _on_docked(self) -> None:
        if sees_all(self._viewer):
            self._fitting.start()
        self._on_opened()

    def _on_opened(self) -> None:
        """There is a dock around this."""

    def _on_closed(self) -> None:
        """The dock was closed."""

    def _on_end(self) -> None:
        """The window is gone: listen to nothing any more."""


def sees_all(viewer: Any) -> bool:
    """Whether a viewer shows its layers about as its home button does, in two dimensions."""
    if not viewer.layers or viewer.dims.ndisplay != 2:
        return False
    camera = camera_of(viewer)
    center, zoom = camera.center, camera.zoom
    viewer.reset_view()
    # napari fits a first layer before it knows how wide the controls beside it are.
    same = math.isclose(zoom, camera.zoom, rel_tol=0.1)
    for one, other in zip(center[-2:], camera.center[-2:], strict=True):
        same = same and abs(one - other) * zoom < _NEAR
    if not same:
        camera.center, camera.zoom = center, zoom
    return same
