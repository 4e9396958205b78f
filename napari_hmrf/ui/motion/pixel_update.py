"""What makes drawing cheap while tissue is dragged: nothing is compiled, nobody is told."""

from __future__ import annotations

import logging
from typing import Any

from napari_hmrf.layers.compat import compile_once, drawn_node

_log = logging.getLogger("napari_hmrf")


def spare_compiling(viewer: Any, layer: Any) -> None:
    """Have the lines of a Vectors layer be drawn by one program, compiled once.

    Else more than all the rest of drawing a canvas goes into compiling one for each update. Where
    there is no way to the mesh any more, lines are drawn slowly, and well.
    """
    if not compile_once(drawn_node(viewer, layer)):
        _log.debug("the lines of %s are compiled anew each time", layer)


class Hush:
    """While tissue is dragged the status bar stays as it is.

    For every step of the cursor a thread of napari's reads what is below it, which takes Python
    from the window's thread, and the whole window is put together anew to show it. napari can stop
    that for all viewers and for good only, so here the cursor's position is not told meanwhile.
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._on = False

    def begin(self) -> None:
        """A drag begins."""
        if not self._on:
            self._viewer.cursor.events.position.block()
            self._on = True

    def end(self) -> None:
        """It is over, if there was one."""
        if self._on:
            self._on = False
            cursor = self._viewer.cursor
            cursor.events.position.unblock()
            cursor.events.position(value=cursor.position)
