"""Tests of the private parts of napari and vispy that `compat` uses."""

import gc

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Labels, Vectors
from napari.utils._proxies import PublicOnlyProxy
from qtpy.QtCore import QEvent, QObject
from qtpy.QtWidgets import QApplication, QLabel, QWidget

from napari_hmrf.layers import compat
from napari_hmrf.layers.viewer_layers import layers_of


def test_the_viewer_behind_a_proxy_is_found():
    viewer = ViewerModel()
    image = viewer.add_image(np.zeros((4, 4)))
    proxy = PublicOnlyProxy(viewer)
    assert compat.unwrapped(proxy) is compat.unwrapped(viewer) is viewer
    assert compat.unwrapped(proxy).layers[0] is image


def test_the_camera_and_the_overlays_are_found_in_any_napari_version():
    viewer = ViewerModel()
    compat.camera_of(viewer).zoom = 3.0
    assert compat.camera_of(viewer).zoom == 3.0
    assert compat.text_of(viewer).text == ""
    assert not compat.scale_bar_of(viewer).visible
    if hasattr(viewer, "canvas"):
        assert compat.camera_of(viewer) is viewer.scene.camera
        assert compat.text_of(viewer) is viewer.canvas.overlays.text
        assert compat.scale_bar_of(viewer) is viewer.canvas.overlays.scale_bar


def test_the_direction_at_the_cursor_defaults_to_that_of_the_camera():
    viewer = ViewerModel()
    viewer.add_image(np.zeros((3, 4, 5)))
    assert compat.sight_of(viewer) is None
    viewer.dims.ndisplay = 3
    assert tuple(compat.sight_of(viewer)) == compat.camera_of(viewer).view_direction
    viewer.cursor._view_direction = np.array([0.6, 0.8, 0.0])
    assert compat.sight_of(viewer) is viewer.cursor._view_direction


def test_the_brush_circle_has_no_box():
    viewer = ViewerModel()
    compat.clear_middle(viewer)
    if not hasattr(viewer, "canvas"):
        return
    circle = viewer.canvas.overlays._brush_circle
    circle.box = True
    compat.clear_middle(viewer)
    assert not circle.box


def test_the_undoable_paint_of_a_layer_is_found():
    layer = Labels(np.zeros((8, 8), np.uint8))
    for name in ("undo", "redo"):
        assert compat.paint_steps(layer, name) is not None
        assert not compat.paint_steps(layer, name)
    layer.paint((4, 4), 1)
    assert len(compat.paint_steps(layer, "undo")) == 1
    layer.undo()
    assert not compat.paint_steps(layer, "undo")
    assert len(compat.paint_steps(layer, "redo")) == 1
    assert compat.paint_steps(Vectors(ndim=2), "undo") is None


def test_a_thumbnail_of_vectors_shows_a_limited_number(monkeypatch):
    layer = Vectors(np.ones((30, 2, 2)))
    drawn = []
    monkeypatch.setattr(np.random, "randint", lambda low, high, size: drawn.append(size) or [0])
    layer.refresh()
    assert drawn == [], "few lines should all be drawn"
    compat.thin_thumbnail(layer, 8)
    layer.refresh()
    assert drawn == [8]


class Windows(QObject):
    """Counter of the windows that appear."""

    def __init__(self):
        super().__init__()
        self.count = 0
        QApplication.instance().installEventFilter(self)

    def eventFilter(self, watched, event):
        if event.type() == QEvent.Type.Show and isinstance(watched, QWidget):
            self.count += watched.isWindow()
        return False


def test_no_window_appears_for_a_moment_with_a_new_vectors_layer(unstyled, make_napari_viewer):
    viewer, windows = make_napari_viewer(), Windows()
    viewer.add_vectors(np.ones((3, 2, 2)))
    stray = windows.count  # as napari adds layers
    layer = Vectors(np.ones((3, 2, 2)), edge_color="red")
    layers_of(viewer).add(layer, select=True)
    assert windows.count == stray
    assert bool(stray) == hasattr(viewer, "canvas"), "napari has changed: see the workaround"
    controls = viewer.window._qt_viewer.controls.widgets[layer]
    shown = {label.text() for label in controls.findChildren(QLabel) if not label.isHidden()}
    assert "edge color:" in shown
    assert "edge feature:" not in shown


def test_nodes_of_layers_are_found_outlined_and_faded_in_a_window(unstyled, make_napari_viewer):
    viewer = make_napari_viewer()
    data = np.array([[[0.0, 0.0], [4.0, 4.0]]])
    layer = viewer.add_vectors(data, vector_style="arrow")
    mesh = compat.drawn_node(viewer, layer)
    assert compat.drawn_node(ViewerModel(), layer) is None
    assert compat.drawn_node(viewer, Vectors(ndim=2)) is None

    def corners():
        return len(mesh.mesh_data.get_vertices())

    assert corners() == 7
    compat.outline_arrows(viewer, layer)
    assert corners() == 14
    layer.vector_style = "line"
    assert corners() == 8
    layer.vector_style = "triangle"
    assert corners() == 3
    compat.outline_arrows(ViewerModel(), layer)  # without a window, nothing is drawn

    one, each = np.zeros(4, np.float32), np.zeros((3, 4), np.float32)

    def reuses_program(colours):
        build = mesh._build_color_transform
        return build(colours) is build(colours + 1)

    assert not reuses_program(each), (
        "vispy's meshes reuse their programs, so compile_once can be removed"
    )
    assert compat.compile_once(mesh)
    assert reuses_program(one)
    assert reuses_program(each)
    values = np.zeros((3, 1), np.float32)
    assert not reuses_program(values), "the function contains the limits of the values"
    assert not compat.compile_once(None)
    assert not compat.compile_once(object())

    image = viewer.add_image(np.eye(8), opacity=0.5)
    compat.fade(viewer, image, 0.2)
    assert image.opacity == 0.5
    assert compat.drawn_node(viewer, image).opacity == pytest.approx(0.1)
    compat.fade(viewer, image, 1.0)
    assert compat.drawn_node(viewer, image).opacity == 0.5
    compat.fade(ViewerModel(), image, 0.2)  # without a window, nothing is drawn


def test_layers_are_hidden_in_the_list(unstyled, make_napari_viewer):
    viewer = make_napari_viewer()
    names = ["a", "helper", "b"]
    first, helper, last = (viewer.add_image(np.eye(4), name=name) for name in names)
    compat.hide_in_list(viewer, helper)
    rows = viewer.window._qt_viewer.layers

    def listed():
        model = rows.model()
        shown = [row for row in range(model.rowCount()) if not rows.isRowHidden(row)]
        return [model.index(row, 0).data() for row in shown]

    assert listed() == ["b", "a"]
    viewer.add_image(np.eye(4), name="c")
    assert listed() == ["c", "b", "a"]
    viewer.layers.move(3, 0)
    viewer.layers.remove(first)
    assert listed() == ["b", "c"]
    assert helper in viewer.layers
    compat.hide_in_list(ViewerModel(), last)  # without a window, there is no list


def test_textures_of_a_removed_layer_are_deleted_in_their_context(
    unstyled, make_napari_viewer, monkeypatch, at_rest
):
    from napari._vispy import canvas as napari_canvas
    from qtpy.QtGui import QOpenGLContext
    from vispy.gloo.glir import GlirTexture2D

    monkeypatch.setattr(napari_canvas, "gc", gc)  # Collect all garbage, as for users.
    viewer = make_napari_viewer(show=True)
    canvas = viewer.window._qt_viewer.canvas.native
    below, above = (viewer.add_image(np.eye(8) * number) for number in (1, 2))
    at_rest()
    contexts = []
    delete = GlirTexture2D.delete
    monkeypatch.setattr(
        GlirTexture2D,
        "delete",
        lambda texture: contexts.append(QOpenGLContext.currentContext()) or delete(texture),
    )

    def remove(layer):
        contexts.clear()
        canvas.doneCurrent()  # Qt leaves no context or another one current.
        viewer.layers.remove(layer)
        at_rest()
        return contexts

    assert remove(above) != [canvas.context()] * 2, (
        "the context is current, so CanvasContext can be removed"
    )
    viewer.add_image(np.eye(8))
    at_rest()
    context = compat.CanvasContext(viewer)
    assert remove(below) == [canvas.context()] * 2
    del context
