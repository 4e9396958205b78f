"""Access to private APIs of napari and vispy, and workarounds for differences between versions.

Private names of other packages are used only in this module. Each workaround has a test that fails
when the workaround is no longer needed.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.arrow_mesh import outlined


def unwrapped(viewer: Any) -> Any:
    """Return the viewer without the proxy that napari passes to plugins.

    Each access to a layer through the proxy returns a new object, so layers cannot be compared.
    """
    return getattr(viewer, "__wrapped__", viewer)


def camera_of(viewer: Any) -> Any:
    """Return the camera of a viewer (in napari 0.9 or later, of its scene)."""
    return getattr(viewer, "scene", viewer).camera


def sight_of(viewer: Any) -> Any:
    """Return the direction from the camera to the cursor in a 3-D view; None in a 2-D view.

    The direction is a vector in world coordinates.
    """
    dims = viewer.dims
    if dims.ndisplay == 2:
        return None
    # Private attribute: the public direction of the camera does not include the perspective.
    direction = getattr(viewer.cursor, "_view_direction", None)
    if direction is None:  # the mouse has not been on the canvas
        camera = camera_of(viewer)
        direction = camera.calculate_nd_view_direction(dims.ndim, tuple(dims.displayed))
    return direction


def shorter_side_of(viewer: Any) -> float:
    """Return the length of the shorter side of the canvas, in screen pixels."""
    canvas = getattr(viewer, "canvas", None)
    # Private attribute: before napari 0.9, the size of the canvas is not public.
    size = viewer._canvas_size if canvas is None else canvas.size
    return float(min(size))


def text_of(viewer: Any) -> Any:
    """Return the text overlay of a viewer (in napari 0.9 or later, of its canvas)."""
    overlay = _overlay(viewer, "text")
    return viewer.text_overlay if overlay is None else overlay


def scale_bar_of(viewer: Any) -> Any:
    """Return the scale bar of a viewer (in napari 0.9 or later, of its canvas)."""
    overlay = _overlay(viewer, "scale_bar")
    return viewer.scale_bar if overlay is None else overlay


def show_name(layer: Any, corner: str) -> None:
    """Show the name of a layer next to its colour bar (napari 0.9 or later).

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
    # Private attribute: napari 0.9 draws a small square there, as the background of a text label.
    # The square stays visible when the circle is hidden, and no public attribute hides it.
    circle = _overlay(viewer, "_brush_circle")
    if getattr(circle, "box", False):
        circle.box = False


def hide_circle_in_corner(viewer: Any) -> None:
    """Move the brush circle out of the canvas until the mouse moves on the canvas."""
    # Private: without a move of the mouse, napari draws the circle at its default position.
    circle = _overlay(viewer, "_brush_circle")
    if circle is not None and tuple(circle.position) == (0, 0):
        circle.position = (-1000, -1000)


def paint_steps(layer: Any, name: str) -> Collection[Any] | None:
    """Return the strokes that a Labels layer can undo or redo, or None if not accessible.

    Parameters
    ----------
    layer : napari.layers.Labels
    name : {"undo", "redo"}
    """
    # Private attribute: the undo and redo keys also apply to edits of the study, and napari has no
    # public API to check whether there is a stroke to undo or redo.
    steps: Collection[Any] | None = getattr(layer, f"_{name}_history", None)
    return steps


def thin_thumbnail(layer: Any, most: int) -> None:
    """Limit the number of lines in the thumbnail of a Vectors layer to `most`."""
    # Private attribute: drawing a thumbnail of all lines takes longer than drawing the lines on the
    # canvas, and thumbnails cannot be disabled.
    layer._max_vectors_thumbnail = most


def drawn_node(viewer: Any, layer: Any) -> Any:
    """Return the vispy node that draws a layer, or None if there is no window or node."""
    # Private attribute: napari has no public API for the canvas of a window and its nodes.
    try:
        return viewer.window._qt_viewer.canvas.layer_to_visual[layer].node
    except (AttributeError, KeyError):
        return None


def hide_in_list(viewer: Any, layer: Any) -> None:
    """Remove the row of a helper layer from the layer list; the layer stays in the viewer."""
    # Private: napari has neither groups of layers nor a public way to omit a row. The row stays
    # hidden when other rows are added, moved or removed.
    with suppress(AttributeError):  # there is no window
        rows = viewer.window._qt_viewer.layers
        model = rows.model()
        index = model.sourceModel().index(viewer.layers.index(layer), 0)
        rows.setRowHidden(model.mapFromSource(index).row(), True)


@contextmanager
def without_stray_windows() -> Iterator[None]:
    """Add layers inside the block without windows that appear for a moment.

    When the controls of a Vectors layer are created, napari 0.9 shows two of their widgets before
    the widgets have a parent, so that each of them opens a window.
    """
    # Private: the controls are created while the layer is inserted.
    module = sys.modules.get("napari._qt.layer_controls.widgets._vectors.qt_edge_color")
    control = getattr(module, "QtEdgeColorFeatureControl", None)
    show = getattr(control, "_update_edge_color_gui", None)
    if show is None:  # there is no window, or this version of napari has other controls
        yield
        return

    def hide(self: Any, mode: str) -> None:
        """Hide the widgets that the mode does not use; the others appear with their parent."""
        is_direct = mode == "direct"
        by_feature = self.color_feature_box, self.edge_feature_label
        for part in by_feature if is_direct else (self.edge_color_edit, self.edge_color_label):
            part.setHidden(True)

    control._update_edge_color_gui = hide  # type: ignore[union-attr]
    try:
        yield
    finally:
        control._update_edge_color_gui = show  # type: ignore[union-attr]


def fade(viewer: Any, layer: Any, share: float) -> None:
    """Draw a layer with a share of its opacity, without changing its settings.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    layer : napari.layers.Layer
    share : float
        From 0 (invisible) to 1.
    """
    # Private: a change of `layer.opacity` would be shown in napari's controls and be saved.
    node = drawn_node(viewer, layer)
    if node is not None:
        node.opacity = share * layer.opacity
        node.update()


def outline_arrows(viewer: Any, layer: Any) -> None:
    """Draw the arrows or lines of a Vectors layer with a dark outline, and heads of a minimum size.

    Layers of triangles, and layers in a 3-D view, are drawn as napari draws them.
    """
    # Private: napari has no public setting for the outline and the heads of arrows, so the
    # triangles are replaced on their way from napari to vispy.
    node = drawn_node(viewer, layer)
    set_data = getattr(node, "set_data", None)
    if set_data is None:
        return

    def set_outlined(**given: Any) -> None:
        made = outlined(given["vertices"], given["faces"], np.asarray(given["face_colors"]))
        names = ("vertices", "faces", "face_colors")
        set_data(**(given if made is None else dict(zip(names, made, strict=True))))

    node.unfreeze()
    node.set_data = set_outlined
    node.freeze()
    layer.refresh(thumbnail=False, extent=False)


class CanvasContext:
    """Guard that makes the OpenGL context of the canvas current before a layer is removed.

    Otherwise, vispy would delete the textures of the layer in the context that happens to be
    current. If that context belongs to Qt, Mesa's software rasterizer crashes at its next draw
    call. `shared` returns the guard of a viewer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = weakref.ref(viewer)
        viewer.layers.events.removing.connect(self._make_current)

    def _make_current(self, _: Any) -> None:
        # Private attribute: see `drawn_node`.
        with suppress(AttributeError, RuntimeError):  # there is no window, or it has been closed
            self._viewer().window._qt_viewer.canvas.native.makeCurrent()  # type: ignore[union-attr]


def compile_once(mesh: Any) -> bool:
    """Prevent a vispy mesh from rebuilding its shader program when its data change.

    Returns
    -------
    bool
        False if this version of vispy does not support the workaround.
    """
    # Private attribute: when its data change, a mesh creates a new function for its colours. As a
    # result, the shader program is composed, compiled and linked again.
    build = getattr(mesh, "_build_color_transform", None)
    if build is None:
        return False
    functions: dict[tuple[int, ...], Any] = {}

    def build_once(colours: npt.NDArray[np.float32]) -> Any:
        # Cache one function for a uniform colour and one for colours per vertex. Functions for
        # scalar values are not cached, because the meshes of this package have no scalar values.
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
    """Return whether closing a napari window will quit the application and close all windows."""
    # Private attribute: napari closes the other windows without confirmation, so all windows must
    # be checked for unsaved work first.
    return bool(getattr(window, "_quit_app", False))


def stop_quitting(window: Any) -> None:
    """Reset the quit request of a window that stays open.

    Otherwise, napari would quit when the window is closed later.
    """
    # Private attribute: napari sets the request before a window is closed, and never resets it.
    if is_quitting(window):
        window._quit_app = False


def _overlay(viewer: Any, name: str) -> Any:
    """Return an overlay of the canvas, or None before napari 0.9 (no canvas overlays)."""
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", None)
    return getattr(overlays, name, None)
