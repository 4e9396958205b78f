"""Tests of editing the stiffness curve and the materials by mouse and keyboard."""

from dataclasses import replace

import dask.array as da
import numpy as np
import pytest
from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
from qtpy.QtCore import QPoint, QPointF, Qt
from qtpy.QtGui import QMouseEvent, QShowEvent
from qtpy.QtWidgets import QApplication, QFileDialog

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.brightness import luminance
from napari_hmrf.io.tables import read_preset
from napari_hmrf.layers.metadata import METADATA, TISSUE, layer_metadata
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.curve.editor import CurveEditor
from tests.support.docks import quick
from tests.support.screen import Cell

CURVE = StiffnessCurve(((50, 10), (100, 20), (200, 40)), void_below=20, unit="kPa")


class Person:
    """Simulated user with a mouse over the plot."""

    def __init__(self, qtbot, editor):
        self.qtbot, self.plot = qtbot, editor.plot
        self.changed, self.settled = [], []
        self.plot.edited.connect(self.changed.append)
        self.plot.settled.connect(self.settled.append)

    def at(self, point):
        """Return the canvas position, in pixels, of a point (intensity, stiffness)."""
        (axes,), ratio = self.canvas.figure.axes, self.canvas.device_pixel_ratio
        across, up = axes.transData.transform(point) / ratio
        return QPointF(across, self.canvas.height() - up).toPoint()

    @property
    def canvas(self):
        return self.plot.canvas

    def move(self, place):
        """Send a mouse move with the button pressed, which `QTest` does not support."""
        event = QMouseEvent(
            QMouseEvent.Type.MouseMove,
            QPointF(place),
            QPointF(self.canvas.mapToGlobal(place)),
            Qt.MouseButton.NoButton,
            Qt.MouseButton.LeftButton,
            Qt.KeyboardModifier.NoModifier,
        )
        QApplication.sendEvent(self.canvas, event)

    def drag(self, start, *ways):
        self.qtbot.mousePress(self.canvas, Qt.MouseButton.LeftButton, pos=start)
        for way in ways:
            self.move(way)
        self.qtbot.mouseRelease(self.canvas, Qt.MouseButton.LeftButton, pos=ways[-1])


@pytest.fixture
def editor(qtbot):
    made = CurveEditor(CURVE)
    qtbot.addWidget(made.native)
    made.native.resize(400, 400)
    made.native.show()
    made.plot.show_intensities(np.linspace(0, 255, 10_000).reshape(100, 100))
    QApplication.processEvents()
    yield made
    QApplication.processEvents()  # Finish pending drawing before the editor is deleted.


@pytest.fixture
def person(qtbot, editor):
    return Person(qtbot, editor)


# The plot and the table


def test_the_curve_follows_a_dragged_point(editor, person):
    start = person.at((100, 20))
    person.drag(start, start + QPoint(10, -10), start + QPoint(30, -25))
    intensity, stiffness = editor.curve.points[1]
    assert intensity > 105
    assert stiffness > 25
    assert editor.curve.points[::2] == CURVE.points[::2]
    assert len(person.changed) == 2
    assert person.settled == [editor.curve]
    assert editor.points.value == f"50: 10; {intensity:g}: {stiffness:g}; 200: 40"


def test_a_dragged_point_remains_under_the_mouse(editor, person):
    editor.curve = replace(CURVE, logarithmic=False)
    QApplication.processEvents()
    start = person.at((100, 20))
    person.qtbot.mousePress(person.canvas, Qt.MouseButton.LeftButton, pos=start)
    person.move(start + QPoint(30, -25))
    QApplication.processEvents()
    place = person.at(editor.curve.points[1])
    assert place.x() == pytest.approx(start.x() + 30, abs=1.5)
    assert place.y() == pytest.approx(start.y() - 25, abs=1.5)


def test_a_dragged_point_may_pass_another_point_but_remains_on_the_axes(editor, person):
    start = person.at((100, 20))
    person.drag(start, QPoint(2000, -2000))
    intensities = [intensity for intensity, _ in editor.curve.points]
    assert intensities == [50, 200, 255]
    person.drag(start, QPoint(20, 20))
    assert len(person.changed) == 1, "a drag without a point changed the curve"
    QApplication.processEvents()
    person.drag(person.at(editor.curve.points[2]), QPoint(-2000, 2000))
    assert editor.curve.points[0][0] == 0
    assert editor.curve.points[0][1] > 0


def test_a_click_does_not_change_the_curve(editor, person, qtbot):
    qtbot.mouseClick(person.canvas, Qt.MouseButton.LeftButton, pos=person.at((200, 40)))
    assert person.changed == []


def test_a_double_click_adds_a_point_and_a_right_click_removes_the_point(editor, person, qtbot):
    place = person.at((150, 15))
    qtbot.mouseDClick(person.canvas, Qt.MouseButton.LeftButton, pos=place)
    assert len(editor.curve.points) == 4
    assert editor.curve.points[2] == (pytest.approx(150, abs=1), pytest.approx(15, rel=0.05))
    QApplication.processEvents()
    right = Qt.MouseButton.RightButton
    qtbot.mouseClick(person.canvas, right, pos=person.at(editor.curve.points[2]))
    assert editor.curve == CURVE
    assert len(person.settled) == 2
    for _ in range(2):
        qtbot.mouseClick(person.canvas, right, pos=person.at(editor.curve.points[0]))
        QApplication.processEvents()
    assert editor.curve.points == CURVE.points[1:], "fewer than two points remain"


def type_text(qtbot, field, text):
    """Type a text and Return into a field; return the new value of the field."""
    field.native.clear()
    qtbot.keyClicks(field.native, text)
    qtbot.keyClick(field.native, Qt.Key.Key_Return)
    return field.value


def test_fields_show_and_edit_the_curve(editor, person, qtbot):
    said = []
    editor.refusal.connect(said.append)
    assert editor.points.value == "50: 10; 100: 20; 200: 40"
    assert (editor.void_below.value, editor.unit.value) == ("20", "kPa")
    type_text(qtbot, editor.points, "50:10;200 : 40 ; 100: 30,5;0:0.001")
    assert editor.curve.points == ((0, 0.001), (50, 10), (100, 30.5), (200, 40))
    for text, void_below in (("7", 7), ("", None), ("7,5", 7.5)):
        type_text(qtbot, editor.void_below, text)
        assert editor.curve.void_below == void_below
    type_text(qtbot, editor.unit, "MPa")
    assert editor.curve.unit == "MPa"
    editor.joined.value = "smooth", False
    assert (editor.curve.between, editor.curve.logarithmic) == ("smooth", False)
    assert person.settled == person.changed
    assert len(person.settled) == 6
    assert not said


#: Texts that describe no curve.
INVALID = "50: 10; 100: 0", "50: 10; 100: soft", "50: 10", "50: 10; 50: 20", "50: 10; 100: 20;"


def test_an_invalid_curve_is_refused_and_the_field_is_reset(editor, person, qtbot):
    said = []
    editor.refusal.connect(said.append)
    for text in INVALID:
        assert type_text(qtbot, editor.points, text) == "50: 10; 100: 20; 200: 40"
    assert type_text(qtbot, editor.void_below, "x") == "20"
    assert len(said) == len(INVALID) + 1
    assert person.changed == []


def test_return_in_an_unchanged_field_does_not_change_the_curve(editor, person, qtbot):
    fine = StiffnessCurve(((1 / 3, 1e-7), (2 / 3, 1e7)), void_below=1e-9)
    editor.curve = fine
    for field in (editor.points, editor.void_below, editor.unit):
        qtbot.keyClick(field.native, Qt.Key.Key_Return)
    assert editor.curve == fine
    assert person.changed == []


def test_setting_a_curve_emits_no_edit(editor, person):
    editor.curve = replace(CURVE, points=CURVE.points[:2])
    assert (person.changed, person.settled) == ([], [])


def test_any_array_of_intensities_can_be_plotted(editor, qtbot):
    for values in (np.full((4, 4), np.nan), np.zeros((4, 4), np.uint8), np.array([[0, np.inf]])):
        editor.plot.show_intensities(values)
        editor.curve = StiffnessCurve(((-1e9, 1e-6), (1e9, 1e9)), void_below=2e9)
        QApplication.processEvents()
        assert not editor.native.grab().isNull()


def test_the_plot_is_not_made_before_it_is_visible(qtbot):
    editor = CurveEditor(CURVE)
    qtbot.addWidget(editor.native)
    editor.plot.show_intensities(np.arange(100.0).reshape(10, 10))
    editor.curve = replace(CURVE, void_below=None)
    assert not editor.native.findChildren(FigureCanvasQTAgg)
    editor.native.show()
    assert editor.native.findChildren(FigureCanvasQTAgg) == [editor.plot.canvas]


# Tissue from the curve


def grey(shape=(24, 30)):
    rows, cols = np.indices(shape[-2:])
    inside = np.hypot((rows - 12) / 10, (cols - 15) / 12) < 1
    one = np.where(inside, 60 + 5 * cols, 2 + cols % 3).astype(np.uint8)
    return np.broadcast_to(one, shape).copy()


def show_stiffness(widget, pixels=None, **place):
    viewer = widget._viewer
    image = viewer.add_image(grey() if pixels is None else pixels, name="MR", **place)
    widget._form.intensity.native.click()
    return viewer, image, stiffness_layer(viewer)


def stiffness_layer(viewer):
    """Return the layer that shows the stiffness of an image, or None if there is none."""
    return next((layer for layer in viewer.layers if "stiffness" in layer.name), None)


def test_one_button_derives_tissue_from_brightness_and_shows_its_stiffness(widget):
    viewer, image, layer = show_stiffness(widget, scale=(0.5, 0.5), units="mm")
    assert [each.name for each in viewer.layers] == ["MR", "MR stiffness (relative)"]
    assert widget.image is image
    assert widget.tissue == "brightness"
    assert not widget._form.tissue.editor.native.isHidden()
    assert (layer.data[0] == 0).all(), "air is not void"
    assert (layer.data[12, 10:20] > 0).all()
    assert "Drag the points" in widget.status
    assert widget.curve.unit == "", "a guessed stiffness has a unit"
    assert widget._form.tissue.editor.unit.value == ""
    curve = widget.curve
    widget._form.intensity.native.click()
    assert len(viewer.layers) == 2
    assert widget.curve == curve, "the existing curve was replaced"


def test_stiffness_is_shown_at_the_place_of_its_image_with_transparent_air(widget):
    shape = (4, 24, 30)
    place = {
        "scale": (3.0, 0.5, 0.7),
        "translate": (1.0, 2.0, 3.0),
        "units": ("s", "mm", "mm"),
        "axis_labels": ("t", "y", "x"),
    }
    viewer, image, layer = show_stiffness(widget, grey(shape), rotate=20.0, **place)
    corner = (0, 23, 29)
    viewer.dims.set_current_step(0, 0)
    widget.tissue_from_intensity()
    np.testing.assert_allclose(layer.data_to_world(corner), image.data_to_world(corner))
    assert layer.units == image.units
    low, high = layer.contrast_limits
    drawn = layer.colormap.map((layer.data.ravel() - low) / (high - low))
    np.testing.assert_array_equal(drawn[:, 3], layer.data.ravel() > 0)


def test_dragging_a_point_updates_the_stiffness_layer_and_is_one_undo_step(widget, qtbot, wait_for):
    _, image, layer = show_stiffness(widget)
    person = Person(qtbot, widget._form.tissue.editor)
    QApplication.sendEvent(person.plot, QShowEvent())
    first = widget.curve
    start = person.at(first.points[1])
    qtbot.mousePress(person.canvas, Qt.MouseButton.LeftButton, pos=start)
    before = layer.data.copy()
    for up in (10, 20):
        person.move(start - QPoint(0, up))
        wait_for(lambda before=before: (layer.data != before).any())
        before = layer.data.copy()
    assert person.settled == [], "the curve is settled although the button is down"
    qtbot.mouseRelease(person.canvas, Qt.MouseButton.LeftButton, pos=start - QPoint(0, 20))
    assert person.settled == [widget.curve]
    np.testing.assert_array_equal(layer.data, widget.curve(image.data))
    widget.undo()
    assert widget.curve == first
    wait_for(lambda: np.array_equal(layer.data, first(image.data)))


def test_the_stiffness_layer_follows_the_curve_and_retains_its_appearance(widget, wait_for):
    _, image, layer = show_stiffness(widget)
    layer.opacity, layer.colormap = 0.9, "gray"
    widget.curve = softer = StiffnessCurve(((0, 1), (255, 10)))
    wait_for(lambda: np.array_equal(layer.data, softer(image.data)))
    assert (layer.opacity, layer.colormap.name) == (0.9, "gray")
    assert layer.contrast_limits[1] == 10
    image.data = grey()[:, ::-1].copy()
    wait_for(lambda: np.array_equal(layer.data, softer(image.data)))


def test_the_stiffness_layer_is_not_updated_for_an_unchanged_slice_and_curve(widget, wait_for):
    _, _, layer = show_stiffness(widget)
    told = []
    layer.events.data.connect(told.append)
    widget.live = True
    widget.start()
    for down in (1.0, 2.0):
        widget.drawing = Drawing((Arrow((12, 15), (0, down), 2.0),))
        wait_for(lambda: widget.solution is not None and not widget.busy)
    assert told == []


def test_the_stiffness_layer_is_removed_if_tissue_is_chosen_from_another_layer(widget, wait_for):
    viewer, image, _ = show_stiffness(widget)
    labels = viewer.add_labels(np.ones((24, 30), np.uint8), name="painted")
    curve = widget.curve
    for other in (labels, image, None):
        widget.tissue = other
        assert widget.curve is None
        assert widget._form.tissue.editor.native.isHidden()
        wait_for(lambda: stiffness_layer(viewer) is None)
        widget.tissue = "brightness"
        assert widget.curve == curve
        wait_for(lambda: stiffness_layer(viewer) is not None)
    widget.curve = None
    assert widget.tissue is None
    viewer.layers.remove(image)
    wait_for(lambda: len(viewer.layers) == 1)


def test_each_image_has_its_own_curve(widget, wait_for):
    viewer, image, _ = show_stiffness(widget)
    first = widget.curve
    other = viewer.add_image(255 - grey(), name="CT")
    widget.image = other
    assert widget.curve is None
    wait_for(lambda: stiffness_layer(viewer) is None)
    widget.curve = CURVE
    wait_for(lambda: stiffness_layer(viewer) is not None)
    assert stiffness_layer(viewer).name == "CT stiffness (kPa)"
    widget.image = image
    assert widget.curve == first
    wait_for(lambda: stiffness_layer(viewer).name == "MR stiffness (relative)")
    assert [each.name for each in viewer.layers] == ["MR", "MR stiffness (relative)", "CT"]
    widget.image = other
    assert widget.curve == CURVE


def test_a_closed_dock_leaves_no_stiffness_layer(frame):
    closed = quick(frame.open())
    viewer, _, _ = show_stiffness(closed)
    frame.close(closed)
    assert stiffness_layer(viewer) is None


def test_tissue_from_intensity_is_deformed(widget, run, wait_for):
    viewer, _, layer = show_stiffness(widget)
    widget._form.make.native.click()
    assert [each.name for each in viewer.layers] == ["MR", "MR stiffness (relative)", "Boundary"]
    assert widget.tissue == "brightness", "the tissue was replaced by a layer to paint on"
    widget.boundary.data[12, 6] = 1
    widget.boundary.data[12, 24] = 2
    widget.rules = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 2.0)))
    widget.settings = replace(widget.settings, sweeps=50)
    first = run(widget).solution.displacement.copy()
    assert first[12, 24, 1] == pytest.approx(2, abs=0.05)
    assert not layer.visible, "the stiffness layer tints the deformed image"
    low, high = (at for at, _ in widget.curve.points[::2])
    widget.curve = StiffnessCurve(((low, 1000), (high, 1)))
    wait_for(lambda: widget.status.startswith("The inputs have changed"))
    second = run(widget).solution.displacement
    assert np.abs(second - first).max() > 0.1


def test_pulled_tissue_follows_a_change_of_its_curve(widget, wait_for):
    image = widget._viewer.add_image(grey(), name="MR")
    curve = widget.tissue_from_intensity()
    layer = stiffness_layer(widget._viewer)
    widget.live = True
    widget.start()
    assert not layer.visible
    widget.drawing = Drawing((Arrow((12, 15), (0, 2), 2.0),))
    wait_for(lambda: widget.solution is not None and not widget.busy)
    np.testing.assert_array_equal(widget.solution.tissue, curve(image.data) > 0)
    first = widget.solution.displacement
    assert first[12, 15] == pytest.approx((0, 2), abs=0.2)
    widget.curve = other = StiffnessCurve(((60, 1000), (180, 1)), void_below=70)
    wait_for(lambda: not widget.busy and widget.shown.tissue.curve == other)
    np.testing.assert_array_equal(widget.solution.tissue, image.data >= 70)
    assert np.abs(widget.solution.displacement - first).max() > 0.01


@pytest.mark.parametrize(
    ("dtype", "lazy", "shape"),
    [
        (np.uint8, False, (24, 30)),
        (np.float32, False, (3, 24, 30)),
        (np.uint8, False, (24, 30, 3)),
        (np.float32, True, (24, 30, 3)),
        (np.int16, True, (2, 3, 24, 30)),
    ],
)
def test_the_stiffness_of_a_slice_of_any_image_follows_its_pixels(widget, dtype, lazy, shape):
    coloured = shape[-1] == 3
    pixels = np.repeat(grey()[..., None], 3, axis=-1) if coloured else grey(shape)
    pixels = pixels / 255 if coloured and dtype != np.uint8 else pixels
    pixels = pixels.astype(np.float32 if coloured and dtype == np.int16 else dtype)
    if image_axes := pixels.ndim - 2 - coloured:
        pixels[(0,) * image_axes] //= 2
    viewer = widget._viewer
    given = da.from_array(pixels, chunks=2) if lazy else pixels
    viewer.add_image(given, name="MR", rgb=coloured)
    for axis in range(image_axes):
        viewer.dims.set_current_step(axis, 1)
    curve = widget.tissue_from_intensity()
    seen = luminance(pixels) if coloured else pixels[(1,) * image_axes]
    np.testing.assert_array_equal(np.squeeze(stiffness_layer(viewer).data), curve(seen))
    np.testing.assert_array_equal(Ground.of(widget.study).stiffness, curve(seen))


def test_the_stiffness_of_the_displayed_slice_of_a_stack_is_shown(widget, wait_for):
    stack = grey((3, 24, 30))
    stack[1] = 255 - stack[1]
    viewer, _, layer = show_stiffness(widget, stack)
    for number in (1, 2):
        viewer.dims.set_current_step(0, number)
        expected = widget.curve(stack[number])
        wait_for(lambda expected=expected: np.array_equal(layer.data[0], expected))
        assert layer.data_to_world((0, 0, 0))[0] == number
    widget.curve = CURVE
    np.testing.assert_array_equal(Ground.of(widget.study).stiffness, CURVE(stack[2]))


def test_the_initial_curve_is_derived_from_the_displayed_slice(widget):
    viewer = widget._viewer
    viewer.add_image(np.stack([grey(), grey() // 4]), name="MR")
    viewer.dims.set_current_step(0, 1)
    assert widget.tissue_from_intensity().points[-1][0] < 64
    viewer.dims.set_current_step(0, 0)
    widget._form.tissue.editor.guess.native.click()
    assert widget.curve.points[-1][0] > 100


def test_a_script_sets_and_reads_the_curve(widget):
    image = widget._viewer.add_image(grey(), name="MR")
    with pytest.raises(ValueError, match="not a valid choice"):
        widget.tissue = "brightness"
    assert widget.tissue_from_intensity(CURVE) == CURVE
    assert widget.curve == CURVE
    np.testing.assert_array_equal(Ground.of(widget.study).stiffness, CURVE(image.data))
    other = replace(CURVE, void_below=None)
    assert widget.tissue_from_intensity(other) == other
    assert widget.curve == other
    widget.tissue = None
    assert widget.curve is None
    widget.curve = CURVE
    assert widget.tissue == "brightness"


def test_a_stiffness_layer_of_an_earlier_version_is_an_image_of_stiffness(widget):
    viewer = widget._viewer
    kept = {METADATA: {"role": TISSUE, "curve": CURVE.as_dict(), "source": "MR", "unit": "kPa"}}
    viewer.add_image(grey(), name="MR")
    layer = viewer.add_image(CURVE(grey()), name="from a file", metadata=kept)
    assert widget.tissue is layer
    assert widget.curve is None
    np.testing.assert_array_equal(Ground.of(widget.study).stiffness, layer.data)


def test_a_missing_image_causes_an_error_with_a_hint(widget):
    with pytest.raises(HmrfError, match=r"[Oo]pen an image"):
        widget.tissue_from_intensity()
    with pytest.raises(HmrfError, match=r"[Oo]pen an image"):
        widget.curve = CURVE
    assert not widget._form.intensity.enabled
    widget._viewer.add_image(np.zeros((9, 9)), name="flat")
    widget._form.intensity.native.click()
    assert "has a single intensity" in widget.status
    assert not [layer for layer in widget._viewer.layers if layer.name != "flat"]


def test_the_stiffness_layer_is_not_offered_in_menus(widget):
    _, image, layer = show_stiffness(widget)
    for choice in (widget._form.image, widget._form.tissue.choice):
        assert layer not in choice.offered
        assert image in choice.offered


# Materials


def entries(menu):
    menu.fill()
    return {action.text(): action for action in menu.menu().actions() if action.text()}


def test_every_preset_is_offered_with_its_source(widget, small_sample):
    small_sample(widget._viewer)
    found = entries(widget._form.tissue.menu)
    for preset in PRESETS:
        about = found[f"{preset.name} {preset.unit}".rstrip()].toolTip()
        assert preset.source.replace("&", "&amp;") in about
    found["Liver 5.4, carcinoma 70 kPa"].trigger()
    assert widget.materials[1] == Material(1, "liver", 5.4, 0.49)
    assert widget._form.tissue.table.contents.unit == "kPa"
    said = "Materials: Liver 5.4, carcinoma 70. 'gel' is now liver."
    assert widget.status == said


def test_materials_are_copied_from_another_layer(widget, small_sample):
    viewer = widget._viewer
    small_sample(viewer)
    rows = (Material(1, "jelly", 7.0), Material(2, "bone", 900.0))
    tissue = widget.tissue
    viewer.add_labels(
        np.ones((20, 24), int), name="other", metadata=layer_metadata(TISSUE, rows, "Pa")
    )
    viewer.add_labels(np.ones((20, 24), int), name="nothing")
    widget.tissue = tissue
    taken = entries(widget._form.tissue.menu)["Load from layer"].menu()
    assert [action.text() for action in taken.actions()] == ["other"]
    taken.actions()[0].trigger()
    assert widget.materials[1:] == rows
    assert tissue.metadata[METADATA]["unit"] == "Pa"
    assert widget.materials[0].stiffness == 0, "air became tissue"
    with pytest.raises(HmrfError, match="'nothing' has no table"):
        widget.take_materials(viewer.layers["nothing"])


def test_materials_are_saved_to_a_file_and_loaded_again(
    widget, small_sample, monkeypatch, tmp_path
):
    small_sample(widget._viewer)
    path = str(tmp_path / "table.json")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (path, ""))
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (path, ""))
    entries(widget._form.tissue.menu)["Save to file ..."].trigger()
    before = widget.materials
    widget.materials = (Material(0, "x", 1.0), Material(1, "y", 2.0))
    entries(widget._form.tissue.menu)["Load from file ..."].trigger()
    assert widget.materials == before
    assert read_preset(path).unit == "kPa"
    widget.materials = (Material(0, "x", 1.0), Material(1, "y", 2.0))
    widget.take_materials(path)
    assert widget.materials == before
    with open(path, "w", encoding="utf-8") as file:
        file.write("{}")
    entries(widget._form.tissue.menu)["Load from file ..."].trigger()
    assert widget.status.startswith("table.json contains no label names. Give a material file")
    assert widget.materials == before


def test_a_saved_table_names_the_source_of_its_values(widget, small_sample, tmp_path):
    small_sample(widget._viewer)
    preset = PRESETS[1]
    widget.take_materials(preset)
    found = read_preset(widget.save_materials(tmp_path / "own.json"))
    assert (found.name, found.source) == (preset.name, preset.source)
    widget.materials = (*widget.materials[:-1], replace(widget.materials[-1], stiffness=123.0))
    widget.materials = (*widget.materials[:-1], replace(widget.materials[-1], stiffness=124.0))
    changed = read_preset(widget.save_materials(tmp_path / "changed.json"))
    assert changed.name == preset.name
    assert changed.source == f"changed since taken from: {preset.source}"
    widget.undo()
    widget.undo()
    again = read_preset(widget.save_materials(tmp_path / "again.json"))
    assert again.source == preset.source


def test_a_table_emits_one_change_per_edit(widget, small_sample):
    small_sample(widget._viewer)
    table = widget._form.tissue.table
    said = []
    table.changed.connect(lambda _: said.append(table.contents))
    before = table.contents
    widget.take_materials(PRESETS[1])
    assert said == [table.contents]
    Cell(widget._form.tissue.table, 1, 2).write("3")
    assert said[1:] == [table.contents]
    table.contents = before
    assert said[2:] == [before]
    assert hash(before) == hash(table.contents)


def test_a_table_with_only_void_is_not_saved(widget, small_sample, tmp_path):
    small_sample(widget._viewer)
    widget.materials = (Material(0, "air", 0.0), Material(1, "hole", 0.0))
    with pytest.raises(HmrfError, match="above 0"):
        widget.save_materials(tmp_path / "void.json")


# Saved results


def test_materials_of_a_saved_result_are_copied_to_another_image(
    widget, small_sample, run, tmp_path
):
    from napari_hmrf.contributions import open_solution, write_solution

    viewer = widget._viewer
    small_sample(viewer)
    arrows = run(widget).layers["arrows"]
    (path,) = write_solution(str(tmp_path / "gel.npz"), arrows.data, arrows.attributes)
    viewer.layers.clear()
    small_sample(viewer)
    widget.materials = (Material(0, "x", 1.0), Material(1, "y", 2.0))
    (again,) = open_solution(path)(path)
    result = viewer.add_vectors(again[0], **again[1])
    assert result not in widget._form.tissue.choice.offered
    widget.take_materials(result)
    assert widget.materials[1] == Material(1, "gel", 20.0)


def test_a_result_stores_the_curve_of_its_tissue(widget, run):
    show_stiffness(widget)
    widget.make_layers()
    widget.boundary.data[12, 6] = 1
    widget.boundary.data[12, 24] = 2
    curve = widget.curve
    kept = run(widget).solution.provenance.parameters["tissue"]
    widget.curve = CURVE
    assert StiffnessCurve.from_dict(kept["curve"]) == curve
    assert kept["source"] == "MR"


def test_the_status_bar_shows_the_stiffness_derived_from_intensity(widget, run, wait_for):
    viewer, *_ = show_stiffness(widget, grey((3, 24, 30)))
    widget.make_layers()
    widget.boundary.data[..., 12, 6] = 1
    widget.boundary.data[..., 12, 24] = 2
    widget.rules = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 0.5)))
    run(widget)
    said = f"relative stiffness {float(widget.curve(grey()[12, 6])):.3g}"
    at = (*viewer.dims.point[:-2], 12.0, 6.0)
    wait_for(lambda: said in widget._view.cursor.line_at(at))
