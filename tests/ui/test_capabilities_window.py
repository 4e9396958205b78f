"""Tests of the capabilities of the window, by the texts that the user reads."""

from dataclasses import replace

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QFileDialog, QTableView

from napari_hmrf import Solution, read_study
from napari_hmrf.contributions import open_solution, phantom_layers, write_solution
from napari_hmrf.field.warp import warp
from napari_hmrf.io.material_tables import read_preset
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, sample
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing, Stroke
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.ui.messages import MODELS
from napari_hmrf.ui.soft_tissue import SoftTissue
from napari_hmrf.ui.tissue_tables import BoundaryTable
from tests.support.docks import dock_in, quick
from tests.support.person import Person
from tests.support.screen import Screen, head
from tests.support.timeouts import LONG_MS

GEL = "gel"


@pytest.fixture
def viewer():
    from napari.components import ViewerModel

    return ViewerModel()


@pytest.fixture
def dock_without_live_mode(viewer, qtbot):
    """Return the dock with live mode off, and its visible texts."""
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    dock.settings = replace(dock.settings, device="cpu")
    dock.live = False
    return dock, Screen(dock)


@pytest.fixture
def pulling_dock(viewer, qtbot, wait_for):
    """Return the dock with the *Pull* tool active beside a chequered image, and its texts."""
    rows, cols = np.indices((48, 56))
    viewer.add_image((120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8), name="MR")
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    screen = Screen(dock)
    screen.press("Pull")
    assert dock.active
    wait_for(lambda: not dock.busy)
    return dock, screen


@pytest.fixture
def draw_and_wait(wait_for):
    """Return a function that draws marks, waits and returns the displacement field."""

    def draw(dock, *marks):
        seen = []
        dock.deformation_changed.connect(seen.append)
        if marks:
            dock.drawing = Drawing(marks)
        wait_for(lambda: bool(seen) and not dock.busy)
        dock.deformation_changed.disconnect(seen.append)
        return seen[-1].solution.displacement

    return draw


@pytest.fixture
def dock_with_result(dock_without_live_mode, viewer, small_sample, run, wait_for):
    """Return the dock with a result, a block of gel pushed 3 px right, and its texts."""
    small_sample(viewer)
    dock, screen = dock_without_live_mode
    run(dock)
    wait_for(lambda: not dock.busy)
    return dock, screen


def layer(viewer, beginning):
    (found,) = (each for each in viewer.layers if each.name.startswith(beginning))
    return found


# The dock


def test_one_dock_contains_tissue_motion_and_result(
    unstyled, without_controls, make_napari_viewer, qtbot
):
    viewer = make_napari_viewer(show=True)
    _, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    qtbot.waitUntil(dock.native.isVisible, timeout=LONG_MS)
    screen = Screen(dock)
    for words in (
        "Pull",
        "Play",
        "Solve precisely",
        "Tissue and stiffness",
        "Edges, rules, gravity",
        "Model",
        "Advanced",
    ):
        assert screen.button(words).isVisible(), words
    _, again = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    assert again is dock


# Tissue


def test_layers_to_paint_on_are_made_and_a_click_on_a_row_starts_painting(
    dock_without_live_mode, viewer
):
    dock, screen = dock_without_live_mode
    image = viewer.add_image(np.zeros((30, 40)), name="T1", scale=(0.5, 2.0))
    screen.press("New tissue layer")
    tissue, boundary = viewer.layers["Tissue"], viewer.layers["Boundary"]
    for made in (tissue, boundary):
        assert made.data.shape == image.data.shape
        np.testing.assert_array_equal(made.scale, image.scale)
    for row, painted in (("holds", boundary), ("tumour", tissue), ("grows", boundary)):
        screen.click_row(row)
        assert viewer.layers.selection.active is painted
        assert painted.mode == "paint"
        rows = (*dock.materials, *dock.rules)
        assert painted.selected_label == next(each.label for each in rows if each.name == row)
    screen.press("Add tissue")
    assert viewer.layers.selection.active is tissue
    assert tissue.selected_label == dock.materials[-1].label


def test_a_valid_number_in_a_table_is_accepted_and_an_invalid_number_is_reset(
    dock_without_live_mode, viewer, small_sample, wait_for
):
    dock, screen = dock_without_live_mode
    small_sample(viewer)
    screen.cell(GEL, "Stiffness").write("12,5")
    assert dock.materials[1].stiffness == 12.5
    for nonsense in ("stiff", "-3", "nan", "1e39", ""):
        screen.cell(GEL, "Stiffness").write(nonsense)
        assert screen.cell(GEL, "Stiffness").text() == "12.5"
        assert "The value is still 12.5" in screen.words
    screen.cell(GEL, "Stiffness").write("rigid")
    assert dock.materials[1].is_rigid
    screen.choose(MODELS["paper"])
    refused = f"has rigid tissue ('{GEL}'), which is not supported by the paper's model"
    wait_for(lambda: refused in screen.words)
    screen.choose(MODELS["elastic"])
    wait_for(lambda: refused not in screen.words)


def test_stiffness_has_a_unit_only_if_the_unit_is_known(dock_without_live_mode, viewer):
    dock, screen = dock_without_live_mode
    viewer.add_image(np.full((30, 40), 200, np.uint8), name="MR")
    screen.press("New tissue layer")
    table = dock.native.findChildren(QTableView)[0]
    assert head(table, 2) == "Stiffness\n(x normal)"
    dock.take_materials(next(each for each in PRESETS if each.unit == "kPa"))
    assert head(table, 2) == "Stiffness\n(kPa)"
    dock.undo()
    assert head(table, 2) == "Stiffness\n(x normal)"
    dock.take_materials(next(each for each in PRESETS if "Seiler" in each.name))
    assert head(table, 2) == "Stiffness\n(relative)", (
        "the paper's 20, 10 and 40 are ratios without a unit"
    )
    for name in PHANTOM_NAMES:
        _, (_, tissue, _), _ = phantom_layers(sample(name))
        assert "unit" not in tissue["metadata"][METADATA]


def test_dark_surroundings_are_void_unless_the_option_is_off(dock_without_live_mode, viewer, run):
    dock, screen = dock_without_live_mode
    picture = np.zeros((30, 40), np.uint8)
    picture[8:22, 10:30] = 200
    viewer.add_image(picture, name="CT")
    dock.drawing = Drawing((Arrow((15, 20), (0, 2), 3.0),))
    np.testing.assert_array_equal(run(dock).solution.tissue, picture > 0)
    screen.press("New tissue layer")
    viewer.layers["Tissue"].data[2:4, 2:4] = dock.materials[1].label
    counted = run(dock).solution.tissue
    assert counted[2:4, 2:4].all(), "painted dark pixels are void"
    assert counted[8:22, 10:30].all()
    assert not counted[5, 15]
    screen.tick("Ignore dark background", False)
    assert run(dock).solution.tissue.all()


def test_one_button_derives_tissue_from_brightness(dock_without_live_mode, viewer, wait_for):
    dock, screen = dock_without_live_mode
    rows, cols = np.indices((24, 30))
    inside = np.hypot((rows - 12) / 10, (cols - 15) / 12) < 1
    viewer.add_image(np.where(inside, 60 + 5 * cols, 2).astype(np.uint8), name="MR")
    screen.press("Tissue from brightness")
    stiffness = layer(viewer, "MR stiffness")
    assert dock.tissue == "brightness"
    np.testing.assert_array_equal(stiffness.data > 0, inside)
    assert (np.diff(stiffness.data[12, 5:25]) >= 0).all(), "a brighter pixel is softer"
    screen.choose("smooth, linear")
    assert (dock.curve.between, dock.curve.logarithmic) == ("smooth", False)
    expected = dock.curve(viewer.layers["MR"].data)
    wait_for(lambda: np.array_equal(stiffness.data, expected))
    np.testing.assert_array_equal(Ground.of(dock.study).stiffness, expected)


def test_materials_are_copied_from_layers_and_files_and_saved(
    dock_without_live_mode, viewer, small_sample, monkeypatch, tmp_path
):
    dock, screen = dock_without_live_mode
    small_sample(viewer)
    tissue, before = dock.tissue, dock.materials
    path = str(tmp_path / "table.json")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (path, ""))
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_: (path, ""))
    screen.entry("Materials", "Save to file").trigger()
    assert read_preset(path).materials == before
    viewer.add_labels(np.ones((20, 24), int), name="other")
    dock.tissue = viewer.layers["other"]
    dock.materials = (Material(1, "jelly", 7.0),)
    dock.tissue = tissue
    screen.entry("Materials", "Load from layer", "other").trigger()
    assert dock.materials[1] == Material(1, "jelly", 7.0)
    screen.entry("Materials", "Load from file").trigger()
    assert dock.materials == before
    screen.entry("Materials", "Liver 5.4").trigger()
    assert dock.materials[1] == Material(1, "liver", 5.4, 0.49)


def test_materials_of_a_result_are_copied(
    dock_without_live_mode, viewer, small_sample, run, tmp_path
):
    dock, _ = dock_without_live_mode
    small_sample(viewer)
    arrows = run(dock).layers["arrows"]
    (path,) = write_solution(str(tmp_path / "gel.npz"), arrows.data, arrows.attributes)
    viewer.layers.clear()
    small_sample(viewer)
    dock.materials = (Material(0, "x", 1.0), Material(1, "y", 2.0))
    (again,) = open_solution(path)(path)
    dock.take_materials(viewer.add_vectors(again[0], **again[1]))
    assert dock.materials[1] == Material(1, GEL, 20.0)


# Boundary conditions


def test_live_mode_follows_the_table_of_boundaries(
    dock_without_live_mode, viewer, small_sample, wait_for
):
    dock, screen = dock_without_live_mode
    small_sample(viewer)
    screen.tick("Live")
    wait_for(lambda: dock.solution is not None and not dock.busy)
    pushed = viewer.layers["Boundary"].data == 2
    assert np.abs(dock.solution.displacement[pushed] - (0, 3)).max() < 1e-3
    screen.cell("2", "down").write("2")
    screen.cell("2", "right").write("0")
    wait_for(lambda: not dock.busy)
    assert np.abs(dock.solution.displacement[pushed] - (2, 0)).max() < 1e-3


@pytest.fixture
def points(dock_without_live_mode, viewer, small_sample):
    """Return two layers of points on the sample: landmarks and their targets."""
    small_sample(viewer)
    where = viewer.add_points([[8.0, 8.0], [14.0, 14.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0], [14.0, 15.0]], name="ought", size=1)
    return where, should


def test_pairs_of_points_become_landmarks_and_a_missing_partner_is_reported(
    dock_without_live_mode, points, viewer, wait_for
):
    where, should = points
    dock, screen = dock_without_live_mode
    screen.tick("Live")
    screen.choose("is")
    screen.press("Use as landmarks")
    wait_for(lambda: dock.solution is not None and not dock.busy)
    assert dock.solution.displacement[8, 8] == pytest.approx((2, 0), abs=0.02)
    where.add([5.0, 5.0])
    screen.press("Use as landmarks")
    assert "'ought' has 2 points, but 'is' has 3" in dock.status
    assert dock.status in screen.words
    should.add([6.0, 6.0])
    screen.press("Use as landmarks")
    wait_for(lambda: not dock.busy)
    assert dock.solution.displacement[5, 5] == pytest.approx((1, 1), abs=0.02)
    assert "but 'is' has 3" not in screen.words
    screen.press("Undo")
    wait_for(lambda: not dock.busy)
    assert len(dock.drawing.marks) == 2


# The result


def test_live_mode_is_off_for_a_large_image(viewer, qtbot, wait_for):
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    viewer.add_image(np.zeros((1200, 1200), np.uint8), name="MR")
    wait_for(lambda: not dock.busy)
    assert dock.live
    viewer.layers.clear()
    viewer.add_image(np.zeros((1201, 1200), np.uint8), name="MR")
    wait_for(lambda: not dock.live)


# Pulling


def test_a_click_pins_tissue_and_space_moves_the_view(without_controls, pulling, settle):
    person, widget = pulling
    seen = person.where(0, 0)
    person.drag((30, 30), (30, 30))
    assert person.where(0, 0) == seen
    QTest.keyPress(person.canvas, Qt.Key.Key_Space)
    person.drag((50, 50), (54, 54))
    QTest.keyRelease(person.canvas, Qt.Key.Key_Space)
    assert person.where(0, 0) != seen
    settle(widget)
    (mark,) = widget.drawing.marks
    assert mark.at == pytest.approx((30, 30), abs=1)
    assert mark.by == pytest.approx((0, 0), abs=1e-9)


def test_the_edge_of_the_tissue_is_fixed_unless_the_option_is_off(
    pulling_dock, draw_and_wait, wait_for
):
    dock, screen = pulling_dock
    pull, hold = Arrow((24, 28), (0, 4), 4.0), Arrow((10, 10), (0, 0), 2.0)
    moved = draw_and_wait(dock, pull, hold)
    assert np.abs(moved[24, -1]).max() < 1e-6
    screen.tick("Fix outer edge", False)
    assert draw_and_wait(dock)[24, -1, 1] > 1


def test_a_painted_boundary_is_combined_with_pulled_tissue(
    pulling_dock, draw_and_wait, viewer, wait_for
):
    dock, _ = pulling_dock
    walls = np.zeros((48, 56), np.uint8)
    walls[:, 38:41] = 1
    walls[24:30, 8:12] = 1
    dock.boundary = viewer.add_labels(walls, name="Walls")
    wait_for(lambda: not dock.busy)
    moved = draw_and_wait(dock, Arrow((24, 28), (0, 4), 4.0), Arrow((27, 10), (2, 0), 4.0))
    assert np.abs(moved[walls > 0][:, 1]).max() < 1e-4
    assert moved[27, 10] == pytest.approx((2, 0), abs=1e-3), (
        "the arrow does not replace the painted boundary"
    )
    assert np.abs(moved[4:-4, 36]).max() > 0.05


def test_all_marks_are_removed_by_one_button_and_restored_by_undo(pulling_dock, draw_and_wait):
    dock, screen = pulling_dock
    draw_and_wait(dock, Arrow((24, 28), (0, 4), 4.0), Stroke("pin", (((10, 10), (10, 20)),), 2.0))
    drawing = dock.drawing
    screen.press("Remove all")
    assert not dock.drawing.marks
    assert not screen.button("Remove all").isEnabled()
    screen.press("Undo")
    assert dock.drawing == drawing


def test_points_of_two_layers_are_combined_with_pulled_tissue(pulling_dock, draw_and_wait, viewer):
    dock, _ = pulling_dock
    draw_and_wait(dock, Arrow((8, 44), (0, 2), 2.0))
    viewer.add_points([[20, 20], [30, 34]], name="is")
    viewer.add_points([[23, 20], [30, 36]], name="ought")
    dock.take_landmarks(viewer.layers["is"], viewer.layers["ought"])
    moved = draw_and_wait(dock)
    assert moved[20, 20] == pytest.approx((3, 0), abs=0.02)
    assert moved[30, 34] == pytest.approx((0, 2), abs=0.02)
    assert moved[8, 44] == pytest.approx((0, 2), abs=0.02)


def test_a_pulled_result_is_saved_with_its_drawing(
    pulling_dock, draw_and_wait, viewer, wait_for, tmp_path
):
    dock, _ = pulling_dock
    moved = draw_and_wait(dock, Arrow((24, 28), (0, 4), 4.0))
    wait_for(lambda: any(each.name.startswith("MR arrows, elastic") for each in viewer.layers))
    arrows = layer(viewer, "MR arrows, elastic")
    attributes = {"name": arrows.name, "metadata": arrows.metadata}
    (path,) = write_solution(str(tmp_path / "pulled.npz"), arrows.data, attributes)
    (again,) = open_solution(path)(path)
    solution = again[1]["metadata"]["napari-hmrf"]["solution"]
    np.testing.assert_array_equal(solution.displacement, moved)
    assert Drawing.from_dict(solution.frame["drawing"]) == dock.drawing


def test_a_result_with_held_patches_is_saved_with_a_short_record_of_the_drawing(
    pulling_dock, draw_and_wait, viewer, wait_for, tmp_path
):
    dock, _ = pulling_dock
    motion = PatchMotion((8, 8), 1, (33, 33), np.linspace(0, 1, 2 * 33**2))
    moved = draw_and_wait(dock, *[Arrow((24, 28), (0, 0), 14.0, motion=motion)] * 40)
    wait_for(lambda: any(each.name.startswith("MR arrows, elastic") for each in viewer.layers))
    arrows = layer(viewer, "MR arrows, elastic")
    attributes = {"name": arrows.name, "metadata": arrows.metadata}
    (path,) = write_solution(str(tmp_path / "held.npz"), arrows.data, attributes)
    solution = Solution.read(path)
    np.testing.assert_array_equal(solution.displacement, moved)
    marks = solution.frame["drawing"]["marks"]
    assert [mark["motion"]["shape"] for mark in marks] == [[33, 33]] * 40
    dock.save_study(tmp_path / "held.study")
    study, solved = read_study(tmp_path / "held.study")
    assert study.motion.drawing == dock.drawing
    np.testing.assert_array_equal(solved.displacement, moved)


def test_edits_of_tables_and_drawings_are_undone_in_one_order(
    dock_without_live_mode, viewer, small_sample, wait_for
):
    dock, screen = dock_without_live_mode
    small_sample(viewer)
    screen.cell(GEL, "Stiffness").write("33")
    dock.drawing = Drawing((Arrow((10, 12), (1, 0), 3.0),))
    screen.cell(GEL, "Stiffness").write("44")
    wait_for(lambda: "changed label 1" in screen.button("Undo").toolTip())
    screen.press("Undo")
    assert (dock.materials[1].stiffness, len(dock.drawing.marks)) == (33, 1)
    assert "Undid: changed label 1" in screen.words
    screen.press("Undo")
    assert (dock.materials[1].stiffness, len(dock.drawing.marks)) == (33, 0)
    screen.press("Undo")
    assert dock.materials[1].stiffness == 20
    assert "changed label 1" in screen.button("Redo").toolTip()
    screen.press("Redo")
    screen.press("Redo")
    assert (dock.materials[1].stiffness, len(dock.drawing.marks)) == (33, 1)


# Display


def test_a_slider_shows_a_part_of_the_deformation(dock_with_result, viewer, wait_for):
    dock, screen = dock_with_result
    solution = layer(viewer, "MR arrows").metadata["napari-hmrf"]["solution"]
    assert "100 %: tissue moved up to 3 px" in screen.words
    screen.slider.setValue(50)
    wait_for(lambda: not dock.busy)
    assert dock.percent == 50
    half = warp(
        viewer.layers["MR"].data, solution.displacement / 2, spacing=1, tissue=solution.tissue
    )
    shown = layer(viewer, "MR deformed").data
    assert np.abs(shown[4:16, 4:20].astype(int) - half[4:16, 4:20]).max() <= 1
    assert "50 %: tissue moved up to 1.5 px" in screen.words


def test_the_deformation_is_played_until_it_is_paused(dock_with_result, viewer, wait_for):
    dock, screen = dock_with_result
    moved = layer(viewer, "MR deformed")
    whole = moved.data.copy()
    screen.press("Play")
    assert dock.playing
    wait_for(lambda: dock.percent < 60)
    screen.press("Pause")
    assert not dock.playing
    wait_for(lambda: not dock.busy)
    assert dock.percent < 100
    assert not np.array_equal(moved.data, whole)
    assert f"{dock.percent} %: tissue moved" in screen.words


def test_a_pressed_button_shows_the_undeformed_image(dock_with_result, viewer):
    _, screen = dock_with_result
    image, moved, arrows = viewer.layers["MR"], layer(viewer, "MR deformed"), layer(viewer, "MR a")
    screen.hold("Compare")
    assert (image.visible, moved.visible, arrows.visible) == (True, False, False)
    screen.let_go("Compare")
    assert moved.visible
    assert arrows.visible


def test_inputs_are_shown_as_layers(dock_with_result, viewer, wait_for):
    dock, screen = dock_with_result
    given = {}
    for words, kind in (
        ("input: stiffness", "stiffness (kPa)"),
        ("input: motion", "given motion"),
        ("input: confidence", "confidence (0 to 1)"),
    ):
        screen.choose(words)
        wait_for(lambda: not dock.busy)
        found = layer(viewer, f"MR {kind}")
        given[words.removeprefix("input: ")] = found.data
    stiffness, confidence = given["stiffness"], given["confidence"]
    assert set(np.unique(stiffness[np.isfinite(stiffness)])) == {0, 20}, (
        "the stiffness is not that of air and gel"
    )
    assert set(np.unique(confidence[np.isfinite(confidence)])) == {0, 1}
    assert given["motion"][:, 1].max() == 3
    screen.choose("none")
    wait_for(lambda: not any("MR confidence" in layer.name for layer in viewer.layers))


def test_the_first_image_can_be_pulled_without_pressing_a_button(
    unstyled, without_controls, make_napari_viewer, chequered, qtbot, at_rest
):
    viewer = make_napari_viewer(show=True)
    viewer.add_image(chequered, name="MR")
    dock = dock_in(viewer)
    at_rest.until(lambda: dock.active and not dock.busy)
    person = Person(viewer, qtbot)
    person.drag((30, 30), (34, 34), (36, 36))
    at_rest.until(lambda: dock.solution is not None and not dock.busy)
    assert dock.solution.displacement[30, 30] == pytest.approx((6, 6), abs=0.7)
    assert not dock.solution.displacement[0].any(), "the edge moves"


def test_a_painted_region_is_pushed_by_a_drag(open_beside, settle):
    touch, dock = open_beside(np.full((64, 64), 100, np.uint8))
    settle(dock)
    Screen(dock).press("Push")
    touch.paint((30, 28), (30, 30), (30, 32))
    settle(dock)
    touch.paint((30, 30), (32, 33), (34, 36))
    settle(dock)
    assert dock.solution.displacement[30, 30] == pytest.approx((4, 6), abs=0.7)
    assert len(dock.drawing.marks) == 1


def test_all_columns_of_the_table_of_boundaries_are_visible(
    make_napari_viewer, small_sample, at_rest
):
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(1300, 800)
    dock = quick(dock_in(viewer))
    small_sample(viewer)
    dock.rules = (*dock.rules, BoundaryRule(3, "expand", amount=-2.5))
    at_rest(thread=False)
    for section in dock._form.sections.values():
        section.expand(animate=False)
    table = dock.native.findChild(BoundaryTable)
    seen = [at for at in range(table.columnCount()) if not table.isColumnHidden(at)]
    assert len(seen) == 7
    at_rest.until(lambda: table.columnWidth(1) < 60)
    assert table.horizontalScrollBar().maximum() == 0
