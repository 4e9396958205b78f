"""What makes drawing cheap while tissue is dragged: nothing is compiled, nobody is told."""

from __future__ import annotations

import logging
from typing import Any

import numpy.typing as npt

_log = logging.getLogger("napari_hmrf")


def spare_compiling(viewer: Any, layer: Any) -> None:
    """Have the lines of a Vectors layer be drawn by one program, compiled once.

    vispy's meshes make the function that takes up their colours anew with all data they are given,
    and so have their program composed, compiled and linked again: more than all the rest of
    drawing a canvas takes. There is no public way to the mesh; where the way there is another one
    day, lines are drawn slowly, and well.
    """
    try:
        mesh = viewer.window._qt_viewer.canvas.layer_to_visual[layer].node
        build = mesh._build_color_transform
        mesh.unfreeze()
    except (AttributeError, KeyError):  # no window, or another version of napari or vispy
        _log.debug("the lines of %s are compiled anew each time", layer)
        return
    made: dict[tuple[int, ...], Any] = {}

    def build_once(colours: npt.NDArray[Any]) -> Any:
        # One function for a colour of all, and one for a colour of each; values are none of ours.
        kind = (colours.ndim, colours.shape[-1])
        if kind[1] != 4:
            return build(colours)
        if kind not in made:
            made[kind] = build(colours)
        return made[kind]

    mesh._build_color_transform = build_once
    mesh.freeze()


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
