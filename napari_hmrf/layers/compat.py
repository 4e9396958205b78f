"""What we need of napari and vispy and they do not offer, and what napari has moved.

Private names of others stand here and nowhere else; a test of each says when it can go.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt


def unwrapped(viewer: Any) -> Any:
    """The viewer itself: plugins get a proxy, whose layers are other objects at every look."""
    return getattr(viewer, "__wrapped__", viewer)


def camera_of(viewer: Any) -> Any:
    """A viewer's camera; napari 0.9 has moved it to the scene."""
    return getattr(viewer, "scene", viewer).camera


def text_of(viewer: Any) -> Any:
    """The text in a corner of the canvas; napari 0.9 has moved it to the canvas."""
    overlay = _overlay(viewer, "text")
    return viewer.text_overlay if overlay is None else overlay


def show_name(layer: Any, corner: str) -> None:
    """Have a layer's name be read on the canvas, beside its bar; napari before 0.9 has no such."""
    title = getattr(layer, "name_overlay", None)
    if title is not None:
        title.position, title.visible = corner, True


def clear_middle(viewer: Any) -> None:
    """Let what is pointed at be seen through the circle around the cursor."""
    # Private: napari 0.9 puts a small square there, in the colour of the canvas and meant for the
    # background of words; it stays behind when the circle goes. Others of its overlays are public.
    circle = _overlay(viewer, "_brush_circle")
    if getattr(circle, "box", False):
        circle.box = False


def paint_steps(layer: Any, name: str) -> Collection[Any] | None:
    """What a Labels layer can "undo" or "redo" of what was painted; None if it does not say."""
    # Private: the keys are shared with our edits, and napari does not say if it has any to undo.
    steps: Collection[Any] | None = getattr(layer, f"_{name}_history", None)
    return steps


def thin_thumbnail(layer: Any, most: int) -> None:
    """Draw so many lines in a Vectors layer's thumbnail at most."""
    # Private: a thumbnail of all lines takes longer to draw than they do, and none can be had.
    layer._max_vectors_thumbnail = most


def drawn_node(viewer: Any, layer: Any) -> Any:
    """What draws a layer in vispy; None without a window, or where there is no such way."""
    # Private: napari's window does not offer its canvas, nor the canvas' nodes.
    try:
        return viewer.window._qt_viewer.canvas.layer_to_visual[layer].node
    except (AttributeError, KeyError):
        return None


class CanvasContext:
    """Has the textures of a layer that goes be deleted where they are drawn.

    Of a viewer there is one (`shared`). vispy deletes them in whichever OpenGL context is current,
    which may be Qt's own, and Mesa's software rasteriser then crashes in what it draws next.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = weakref.ref(viewer)
        viewer.layers.events.removing.connect(self._make_current)

    def _make_current(self, _: Any) -> None:
        # Private: as for `drawn_node`.
        with suppress(AttributeError, RuntimeError):  # there is no window, or no more
            self._viewer().window._qt_viewer.canvas.native.makeCurrent()  # type: ignore[union-attr]


def compile_once(mesh: Any) -> bool:
    """Have a mesh of vispy's keep its program when it is given other data; whether it does."""
    # Private: meshes make the function that takes up their colours anew with all data they are
    # given, and so have their program composed, compiled and linked again.
    build = getattr(mesh, "_build_color_transform", None)
    if build is None:
        return False
    made: dict[tuple[int, ...], Any] = {}

    def build_once(colours: npt.NDArray[np.float32]) -> Any:
        # One function for a colour of all, and one for a colour of each; values are none of ours.
        kind = (colours.ndim, colours.shape[-1])
        if kind[1] != 4:
            return build(colours)
        if kind not in made:
            made[kind] = build(colours)
        return made[kind]

    mesh.unfreeze()
    mesh._build_color_transform = build_once
    mesh.freeze()
    return True


def is_quitting(window: Any) -> bool:
    """Whether a window of napari's is closed to quit, which closes all others as well."""
    # Private: the others are closed without being asked, so that all have to be asked before.
    return bool(getattr(window, "_quit_app", False))


def stop_quitting(window: Any) -> None:
    """Have a window that stays after all not quit when it is closed the next time."""
    # Private: napari asks before it decides to quit, and has no way back from there.
    if is_quitting(window):
        window._quit_app = False


def _overlay(viewer: Any, name: str) -> Any:
    """One of the canvas' overlays; None before napari 0.9, which has no such."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return getattr(overlays, name, None)
