"""Access to private parts of napari and vispy, and to parts that differ between versions of napari.

All private names of other packages are used in this module only. Each has a test that fails when
the workaround is no longer needed.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt


def unwrapped(viewer: Any) -> Any:
    """Return the viewer behind the proxy that plugins receive.

    The proxy returns another object for a layer at each access, so layers cannot be compared.
    """
    return getattr(viewer, "__wrapped__", viewer)


def camera_of(viewer: Any) -> Any:
    """Return the camera of a viewer, which belongs to the scene since napari 0.9."""
    return getattr(viewer, "scene", viewer).camera


def text_of(viewer: Any) -> Any:
    """Return the text in a corner of the canvas, which belongs to the canvas since napari 0.9."""
    overlay = _overlay(viewer, "text")
    return viewer.text_overlay if overlay is None else overlay


def show_name(layer: Any, corner: str) -> None:
    """Show the name of a layer on the canvas, next to its colour bar; needs napari 0.9.

    Parameters
    ----------
    layer : napari.layers.Layer
    corner : str
        Position on the canvas, such as "top_left".
    """
    title = getattr(layer, "name_overlay", None)
    if title is not None:
        title.position, title.visible = corner, True


def clear_middle(viewer: Any) -> None:
    """Hide the square that napari draws in the middle of the brush circle."""
    # Private: napari 0.9 draws a small square there in the colour of the canvas, meant as the
    # background of text; it stays when the circle is hidden. No public attribute removes it.
    circle = _overlay(viewer, "_brush_circle")
    if getattr(circle, "box", False):
        circle.box = False


def paint_steps(layer: Any, name: str) -> Collection[Any] | None:
    """Return the strokes that a Labels layer can undo or redo; None if napari does not store them.

    Parameters
    ----------
    layer : napari.layers.Labels
    name : {"undo", "redo"}
    """
    # Private: the keys are shared with the edits of the study, and napari has no public way to
    # find out whether there is a stroke to undo.
    steps: Collection[Any] | None = getattr(layer, f"_{name}_history", None)
    return steps


def thin_thumbnail(layer: Any, most: int) -> None:
    """Limit the number of lines in the thumbnail of a Vectors layer to `most`."""
    # Private: a thumbnail of all lines takes longer to draw than the lines, and it cannot be
    # switched off.
    layer._max_vectors_thumbnail = most


def drawn_node(viewer: Any, layer: Any) -> Any:
    """Return the vispy node that draws a layer; None without a window, or if it is not found."""
    # Private: the window of napari has no public access to its canvas and nodes.
    try:
        return viewer.window._qt_viewer.canvas.layer_to_visual[layer].node
    except (AttributeError, KeyError):
        return None


class CanvasContext:
    """Guard for the OpenGL textures of removed layers.

    It makes the context of the canvas current before the textures of a layer are deleted. Without
    it, vispy deletes them in whichever context is current. If that is the context of Qt, Mesa's
    software rasteriser crashes when it draws next. `shared` returns the guard of a viewer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = weakref.ref(viewer)
        viewer.layers.events.removing.connect(self._make_current)

    def _make_current(self, _: Any) -> None:
        # Private: for the reason given in `drawn_node`.
        with suppress(AttributeError, RuntimeError):  # there is no window, or it was closed
            self._viewer().window._qt_viewer.canvas.native.makeCurrent()  # type: ignore[union-attr]


def compile_once(mesh: Any) -> bool:
    """Make a vispy mesh keep its shader program when its data change; return whether it does."""
    # Private: with new data, a mesh also builds a new function for its colours, so that its
    # program is composed, compiled and linked again.
    build = getattr(mesh, "_build_color_transform", None)
    if build is None:
        return False
    functions: dict[tuple[int, ...], Any] = {}

    def build_once(colours: npt.NDArray[np.float32]) -> Any:
        # One function for a common colour, and one for a colour per vertex. Meshes here have no
        # scalar values, so those are not cached.
        kind = (colours.ndim, colours.shape[-1])
        if kind[1] != 4:
            return build(colours)
        if kind not in functions:
            functions[kind] = build(colours)
        return functions[kind]

    mesh.unfreeze()
    mesh._build_color_transform = build_once
    mesh.freeze()
    return True


def is_quitting(window: Any) -> bool:
    """Return whether a closing napari window quits the application, which closes all windows."""
    # Private: napari closes the other windows without a question, so the unsaved work of all
    # windows must be checked first.
    return bool(getattr(window, "_quit_app", False))


def stop_quitting(window: Any) -> None:
    """Reset the quit request of a window that stays open; else closing it later would quit."""
    # Private: napari sets the request before the window is closed and never resets it.
    if is_quitting(window):
        window._quit_app = False


def _overlay(viewer: Any, name: str) -> Any:
    """Return an overlay of the canvas; None before napari 0.9, where the canvas has none."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return getattr(overlays, name, None)
