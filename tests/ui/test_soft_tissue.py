"""Tests of the dock *Soft tissue*: painting, tables, Deform, messages and cancellation."""

import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.utils.notifications import notification_manager
from npe2 import PluginManager
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QLabel, QLineEdit

from napari_hmrf import (
    ICM,
    Arrow,
    Drawing,
    ElasticPrior,
    HmrfError,
    Landmark,
    Multigrid,
    ProblemError,
    SeilerPrior,
)
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.contributions import phantom_layers
from napari_hmrf.layers.metadata import METADATA, metadata_of
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, sample
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.study.ground import build_problem
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.ui.messages import MODELS
from tests.support.docks import viewer_of
from tests.support.screen import Cell, Screen, head
from tests.support.timeouts import LONG


def names(viewer):
    return [layer.name for layer in viewer.layers]


def state(viewer):
    """Return the name, identity and data of each layer, which an error must not change."""
    return [(layer.name, id(layer), np.array(layer.data).tobytes()) for layer in viewer.layers]


def by_name(widget, name):
    return viewer_of(widget).layers[name]


def results_of(widget):
    """Return the layers of results, lowest first."""
    return [layer for layer in viewer_of(widget).layers if "provenance" in metadata_of(layer)]


@pytest.fixture
def notified():
    """Return a list of napari's notifications during the test."""
    found = []
    notification_manager.notification_ready.connect(found.append)
    yield found
    notification_manager.notification_ready.disconnect(found.append)


# Deform


def test_a_sample_is_deformed_by_one_button(widget, run, at_rest):
    PluginManager.instance().discover()  # A window discovers plugins at its start.
    viewer = viewer_of(widget)
    viewer.open_sample("napari-hmrf", "bar")
    at_rest()
    assert widget.status == "Press Deform."
    assert [material.stiffness for material in widget.materials if material.label] != []
    widget.settings = replace(widget.settings, sweeps=1)
    outputs = run(widget)
    assert outputs is not None
    added = set(names(viewer)) - {"Tissue", "Boundary"}
    assert any(layer.endswith("arrows, paper") for layer in added)
    assert any(layer.endswith("deformed, paper") for layer in added)
    assert widget.status.startswith("Tissue moved up to ")
    assert "iterations in" in widget.details


def test_tissue_and_image_move_in_the_direction_of_the_pushed_boundary(widget, small_sample, run):
    small_sample(viewer_of(widget))
    widget.settings = replace(widget.settings, sweeps=200)
    outputs = run(widget)
    moved = outputs.solution.displacement
    assert moved[10, -3, 1] == pytest.approx(3, abs=0.05)
    assert 0.5 < moved[10, 12, 1] < 2.5
    arrows = by_name(widget, "MR arrows, paper").data
    assert (arrows[:, 1, 1] > -0.05).all()
    tissue_before = (by_name(widget, "Tissue").data == 1)[10].nonzero()[0]
    picture = by_name(widget, "MR deformed, paper").data[10]
    assert picture[tissue_before.max() + 2] != 0 or picture[tissue_before.max() + 3] != 0


def show_all(widget, at_rest):
    """Show an overlay and wait until it is drawn."""
    widget.overlay = "magnitude"
    at_rest.until(lambda: not widget.busy)


def test_a_second_press_of_deform_updates_the_layers_in_place(widget, small_sample, run, at_rest):
    small_sample(viewer_of(widget))
    run(widget)
    show_all(widget, at_rest)
    before = state(viewer_of(widget))
    arrows = by_name(widget, "MR arrows, paper")
    arrows.edge_color = "red"
    arrows.name = "mine"
    longest = arrows.data[:, 1].max()
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, 6.0)))
    run(widget)
    at_rest.until(lambda: not widget.busy)
    after = state(viewer_of(widget))
    assert [identity for _, identity, _ in after] == [identity for _, identity, _ in before]
    assert arrows.data[:, 1].max() > 1.5 * longest
    assert arrows.name == "mine"
    np.testing.assert_allclose(arrows.edge_color[0], (1, 0, 0, 1))
    assert by_name(widget, "MR displacement (px), paper").contrast_limits[1] > 4


def test_deform_shows_the_result_and_painting_shows_the_original_image(widget, small_sample, run):
    viewer = viewer_of(widget)
    _, tissue, boundary = small_sample(viewer)
    viewer.layers.selection.active = tissue
    run(widget)
    assert viewer.layers.selection.active.name == "MR", "a hidden layer to paint in is active"
    deformed = by_name(widget, "MR deformed, paper")
    assert (deformed.visible, tissue.visible, boundary.visible) == (True, False, False)
    assert names(viewer).index("MR deformed, paper") < names(viewer).index("Tissue")
    assert names(viewer)[-1] == "MR arrows, paper"
    widget._form.tissue.table.add()
    assert (deformed.visible, tissue.visible, tissue.mode) == (False, True, "paint")
    assert "hidden while you paint" in widget.status
    run(widget)
    assert (deformed.visible, tissue.visible) == (True, False)


def test_motion_without_an_image_is_shown_as_arrows(widget, small_sample, run):
    _, tissue, boundary = small_sample(ViewerModel())
    for layer in (tissue, boundary):
        viewer_of(widget).add_layer(layer)
    run(widget)
    assert "Tissue arrows, paper" in names(viewer_of(widget))


# Tables


def test_a_newly_painted_label_is_added_to_the_table(widget, small_sample, wait_for):
    _, tissue, boundary = small_sample(viewer_of(widget))
    assert [material.label for material in widget.materials] == [0, 1]
    tissue.brush_size = 3
    tissue.paint((8, 8), 5)
    wait_for(lambda: 5 in [material.label for material in widget.materials])
    wait_for(lambda: "New in 'Tissue': label 5" in widget.status)
    boundary.paint((8, 8), 4)
    wait_for(lambda: 4 in [rule.label for rule in widget.rules])
    assert widget.rules[-1].action == "fixed"


def test_a_label_painted_directly_before_deform_is_used(widget, small_sample, run):
    _, tissue, _ = small_sample(viewer_of(widget))
    tissue.paint((8, 8), 5)
    assert run(widget) is not None


def test_tables_belong_to_their_layer(widget, small_sample):
    viewer = viewer_of(widget)
    _, tissue, _ = small_sample(viewer)
    other = viewer.add_labels(np.full((20, 24), 3, np.uint8), name="other")
    widget.materials = (Material(0, "air", 0.0), Material(1, "gel", 33.0))
    widget.tissue = other
    assert [material.label for material in widget.materials] == [3]
    widget.tissue = tissue
    assert widget.materials[1].stiffness == 33.0
    assert tissue.metadata[METADATA]["materials"][1]["stiffness"] == 33.0


def test_a_valid_stiffness_is_accepted_and_an_invalid_stiffness_is_reset(widget, small_sample):
    small_sample(viewer_of(widget))
    table = widget._form.tissue.table
    Cell(table, 1, 2).write("12,5")
    assert widget.materials[1].stiffness == 12.5
    for nonsense in ("stiff", "-3", "1e39"):
        Cell(table, 1, 2).write(nonsense)
        assert widget.materials[1].stiffness == 12.5
        assert Cell(table, 1, 2).text() == "12.5"
        assert widget.status.startswith("Stiffness must be a number from 0 to")
        assert widget.status.endswith(f"not {nonsense!r}. The value is still 12.5.")
    Cell(table, 1, 1).write("jelly")
    assert widget.materials[1].name == "jelly"


def test_rigid_is_typed_and_shown_as_a_word(widget, small_sample):
    small_sample(viewer_of(widget))
    widget.model = "elastic"  # The paper's model has no Poisson's ratios.
    table = widget._form.tissue.table

    def shown():
        """Return stiffness, Poisson's ratio and whether the ratio can be edited."""
        stiffness, poisson = Cell(table, 1, 2), Cell(table, 1, 3)
        return stiffness.text(), poisson.text(), poisson.can_be_typed()

    for typed in ("rigid", " Rigid", "inf"):
        Cell(table, 1, 2).write(typed)
        assert widget.materials[1].is_rigid, typed
        assert shown() == ("rigid", "", False)
        Cell(table, 1, 2).write("12")
        assert shown() == ("12", "0.45", True)


def test_cells_of_a_boundary_depend_on_its_action(widget, small_sample):
    small_sample(viewer_of(widget))
    table = widget._form.motion.boundary.table
    assert [Cell(table, 1, column).text() for column in (3, 4)] == ["0", "3"]
    action = Cell(table, 1, 2)
    assert (action.text(), action.chosen()) == ("moves", "moves")
    action.choose("expands")
    assert widget.rules[1].action == "expand"
    assert [Cell(table, 1, column).text() for column in (3, 4, 5)] == ["", "", "0"]
    Cell(table, 1, 5).write("-2")
    assert widget.rules[1].amount == -2.0
    Cell(table, 1, 6).write("0.5 / 1")
    Cell(table, 1, 6).write("2")  # Out of range, so the value is reset.
    assert widget.rules[1].confidence == (0.5, 1.0)
    assert widget.status.startswith("Confidence must be numbers from 0 to 1")
    assert widget.status.endswith("The value is still 0.5 / 1.")
    Cell(table, 1, 6).write("0.25")
    assert widget.rules[1].confidence == (0.25, 0.25)
    Cell(table, 1, 1).write("rim")
    assert widget.rules[1].name == "rim"


def highlighted(table):
    return sorted({index.row() for index in table.selectedIndexes()})


def test_a_click_on_a_row_activates_its_label_as_brush(widget, small_sample):
    viewer = viewer_of(widget)
    _, tissue, boundary = small_sample(viewer)
    tissues, boundaries = widget._form.tissue.table, widget._form.motion.boundary.table
    for table, layer, row, label in [
        (tissues, tissue, 1, 1),
        (boundaries, boundary, 1, 2),
        (boundaries, boundary, 0, 1),
        (tissues, tissue, 1, 1),  # This row was the current row before the click.
    ]:
        layer.visible = False
        Cell(table, row).click()
        assert viewer.layers.selection.active is layer
        assert (layer.selected_label, layer.mode, layer.visible) == (label, "paint", True)
        assert highlighted(table) == [row]
    assert widget._form.motion.boundary.table.add() == 3
    assert viewer.layers.selection.active is boundary
    assert boundary.selected_label == 3


def test_selecting_a_label_highlights_its_row(widget, small_sample):
    _, tissue, _ = small_sample(viewer_of(widget))
    table = widget._form.tissue.table
    for label, rows in ((0, [0]), (1, [1]), (9, [])):
        tissue.selected_label = label
        assert highlighted(table) == rows


def test_editing_a_cell_selects_its_label_and_hides_no_layer(widget, small_sample, run):
    viewer = viewer_of(widget)
    _, tissue, _ = small_sample(viewer)
    run(widget)
    table = widget._form.tissue.table
    Cell(table, 1, 2).click()
    assert (highlighted(table), tissue.selected_label) == ([1], 1)
    assert (tissue.visible, tissue.mode) == (False, "pan_zoom")


def test_a_boundary_moves_at_most_by_the_longest_side_of_the_image(widget, small_sample, at_rest):
    small_sample(viewer_of(widget))
    at_rest()
    for typed, used in (("24", 24), ("25", 24), ("-1e9", 24)):
        Cell(widget._form.motion.boundary.table, 1, 4).write(typed)
        assert widget.rules[1].vector == (0, used), typed
        assert ("a number from -24 to 24 px" in widget.status) == (typed != "24")


def test_letters_typed_after_a_click_on_a_row_do_not_edit_its_name(widget, small_sample):
    small_sample(viewer_of(widget))
    table = widget._form.tissue.table
    name = Cell(table, 1)
    name.click()
    before = name.text()
    QTest.keyClicks(table, "]]")
    assert name.text() == before
    assert not table.viewport().findChildren(QLineEdit)
    name.write("liver")
    assert name.text() == "liver"


def test_an_edited_cell_keeps_the_brush_and_ends_a_comparison(widget, small_sample, run, wait_for):
    small_sample(viewer_of(widget))
    run(widget)
    Cell(widget._form.tissue.table, 1).click()
    assert widget.before
    Cell(widget._form.tissue.table, 1, 2).write("7")
    assert widget.tissue.mode == "paint"
    assert widget.before
    viewer_of(widget).layers.selection.active = widget.image
    widget.before = True
    Cell(widget._form.tissue.table, 1, 2).write("8")
    assert not widget.before


def test_rows_have_the_colour_of_their_label(widget, small_sample):
    _, tissue, _ = small_sample(viewer_of(widget))
    label = Cell(widget._form.tissue.table, 1, 0)
    for selected in (False, True):
        shown = label.colour(selected)
        np.testing.assert_allclose(shown, tissue.get_color(1)[:3], atol=0.01)


def test_a_preset_replaces_all_stiffnesses_and_shows_its_unit(widget, small_sample):
    small_sample(viewer_of(widget))
    before = (*widget.materials, Material(9, "odd", 1e6))
    for preset in (PRESETS[0], PRESETS[-1]):
        widget.materials = before
        widget.take_materials(preset)
        by_label = {material.label: material for material in widget.materials}
        assert by_label[0].stiffness == 0, preset  # Void remains void.
        assert by_label[1] == preset.materials[0]
        # Values of different units must not be mixed.
        assert by_label[9].stiffness == preset.materials[0].stiffness, preset
        assert preset.unit in head(widget._form.tissue.table, 2), preset


def test_stiffness_has_a_unit_only_if_the_unit_is_known(widget):
    viewer_of(widget).add_image(np.full((30, 40), 200, np.uint8), name="MR")
    widget.make_layers()
    table = widget._form.tissue.table
    assert head(table, 2) == "Stiffness\n(x normal)"
    widget.take_materials(next(each for each in PRESETS if each.unit == "kPa"))
    assert head(table, 2) == "Stiffness\n(kPa)"
    widget.take_materials(next(each for each in PRESETS if "Seiler" in each.name))
    assert head(table, 2) == "Stiffness\n(relative)", (
        "the paper's 20, 10 and 40 are ratios without a unit"
    )
    for name in PHANTOM_NAMES:
        _, (_, tissue, _), _ = phantom_layers(sample(name))
        assert "unit" not in tissue["metadata"][METADATA]


def test_dark_surroundings_are_void_unless_the_option_is_off(widget, run):
    viewer = viewer_of(widget)
    picture = np.zeros((30, 40), np.uint8)
    picture[8:22, 10:30] = 200
    viewer.add_image(picture, name="CT")
    widget.drawing = Drawing((Arrow((15, 20), (0, 2), 3.0),))
    np.testing.assert_array_equal(run(widget).solution.tissue, picture > 0)
    Screen(widget).press("New tissue layer")
    viewer.layers["Tissue"].data[2:4, 2:4] = widget.materials[1].label
    counted = run(widget).solution.tissue
    assert counted[2:4, 2:4].all(), "painted dark pixels are void"
    assert counted[8:22, 10:30].all()
    assert not counted[5, 15]
    Screen(widget).tick("Ignore dark background", False)
    assert run(widget).solution.tissue.all()


def test_new_layers_to_paint_on_have_the_place_of_the_image_and_the_brush_active(widget, run):
    viewer = viewer_of(widget)
    viewer.add_image(
        np.random.default_rng(0).random((30, 40)), name="T1", scale=(0.5, 2), units=("mm", "mm")
    )
    widget.make_layers()
    tissue, boundary = widget.tissue, widget.boundary
    assert (tissue.data.shape, boundary.data.shape) == ((30, 40), (30, 40))
    np.testing.assert_array_equal(tissue.scale, (0.5, 2))
    assert tissue.units == viewer.layers["T1"].units
    assert viewer.layers.selection.active is tissue
    assert tissue.mode == "paint"
    assert widget.materials[0] == Material(0, "everything unpainted", 20.0)
    assert [rule.action for rule in widget.rules] == ["fixed", "expand"]
    boundary.data[:, :2] = 1
    boundary.data[10:20, 20:25] = 2
    boundary.refresh()
    assert run(widget) is not None
    assert "mm" in head(widget._form.motion.boundary.table, 3)


def test_only_the_missing_layer_to_paint_on_is_made(widget, small_sample):
    viewer = viewer_of(widget)
    _, _, boundary = small_sample(viewer)
    viewer.layers.remove("Tissue")
    widget.make_layers()
    assert sorted(names(viewer)) == ["Boundary", "MR", "Tissue"]
    made = widget.tissue
    assert widget.boundary is boundary
    assert boundary.data.any()
    assert not made.data.any()
    assert viewer.layers.selection.active is made
    assert made.mode == "paint"
    assert names(viewer)[-1] == "Boundary", "the boundary is not the topmost layer"
    widget.make_layers()
    assert len(viewer.layers) == 3


def test_paint_of_another_image_is_not_selected(widget, small_sample):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.image = viewer.add_image(np.ones((30, 40)), name="T1")
    widget.make_layers()
    assert (widget.tissue.data.shape, widget.boundary.data.shape) == ((30, 40), (30, 40))


def test_layers_to_paint_on_require_an_image(widget, run):
    assert not widget._form.make.enabled
    with pytest.raises(HmrfError, match=r"^Open an image first \(File > Open\), or a sample"):
        widget.make_layers()
    assert run(widget) is None
    assert widget.status.startswith("Open an image first (File > Open), or a sample")
    assert names(viewer_of(widget)) == []


def test_an_invalid_boundary_is_reported_while_painting(widget, small_sample, wait_for):
    small_sample(viewer_of(widget))
    widget.live = True
    widget.rules = (widget.rules[0], BoundaryRule(2, "expand", amount=1.0))
    wait_for(lambda: "open line" in widget.status)


# Choices


def test_removed_layers_are_deselected(widget, small_sample):
    viewer = viewer_of(widget)
    small_sample(viewer)
    viewer.add_image(np.zeros((20, 24)), name="another")
    viewer.layers.remove("MR")
    assert widget.image is viewer.layers["another"]
    viewer.layers.remove("Tissue")
    assert widget.tissue is None
    viewer.layers.clear()
    assert (widget.image, widget.boundary, widget.confidence) == (None, None, None)


def test_an_invalid_choice_is_refused(widget, small_sample):
    viewer = viewer_of(widget)
    small_sample(viewer)
    with pytest.raises(ValueError, match="not a valid choice"):
        widget.boundary = viewer.add_points([(1, 1)])


def test_images_and_arrows_can_replace_painted_layers(widget, small_sample, run):
    viewer = viewer_of(widget)
    small_sample(viewer)
    m = viewer.add_image(np.ones((20, 24)), name="stiffness")
    arrows = np.array([[(5, 3), (0, 0)], [(5, 20), (0, 2)]], float)
    y = viewer.add_vectors(arrows, name="observed")
    c = viewer.add_image(np.full((20, 24), 0.5), name="sure")
    widget.tissue, widget.boundary, widget.confidence = m, y, c
    widget.model = "paper"
    outputs = run(widget)
    assert outputs.solution.displacement[5, 20, 1] == pytest.approx(2, abs=0.01)


def test_settings_determine_prior_and_optimizer(widget):
    widget.settings = replace(
        widget.settings,
        reading="blanket",
        method="closed form",
        energy_change=1e-3,
        penalty=500.0,
        sweeps=12,
    )
    chosen = widget.session.model
    assert chosen.prior == SeilerPrior(penalty=500, conditional="blanket")
    assert chosen.optimizer == ICM(12, steps=None, energy_change=1e-3)
    assert widget.device == "cpu"
    form = widget._form.model.in_detail
    assert "Borders of stiff and soft tissue hardly move" in form["reading"].tooltip
    for words in ("candidate steps", "never early", "OpenGL, fragment"):
        Screen(widget).choose(words)
    assert widget.session.model.optimizer == ICM(12)
    assert widget.device == "opengl:fragment"


def test_every_device_is_offered(widget):
    assert set(widget._form.model.in_detail.device.choices) == set(BACKEND_NAMES)


def test_the_default_settings_are_elastic_and_one_click_selects_the_paper_model(frame):
    widget = frame.open()
    chosen = widget.session.model
    assert (chosen.prior, chosen.optimizer) == (ElasticPrior(), Multigrid())
    Screen(widget).choose(MODELS["paper"])
    chosen = widget.session.model
    assert (chosen.prior, chosen.optimizer) == (SeilerPrior(), ICM())
    assert widget.device == "auto"


# Place


def test_results_have_the_place_and_the_units_of_the_image(widget, small_sample, run, at_rest):
    place = {
        "scale": (0.5, 2.0),
        "translate": (3.0, 4.0),
        "rotate": 20.0,
        "units": ("mm", "mm"),
        "axis_labels": ("row", "col"),
    }
    image, _, _ = small_sample(viewer_of(widget), **place)
    outputs = run(widget)
    show_all(widget, at_rest)
    assert outputs.solution.spacing == pytest.approx((0.5, 2.0))
    farthest = widget.status.partition(". Hidden over")[0]
    assert farthest.endswith(" mm"), "a length in pixels is undefined for non-square pixels"
    assert "px" not in farthest
    for layer in results_of(widget):
        assert layer.units == image.units
        assert layer.axis_labels == image.axis_labels
        np.testing.assert_allclose(layer.data_to_world((4, 5)), image.data_to_world((4, 5)))
    arrows = by_name(widget, "MR arrows, paper").data
    assert arrows[:, 1, 1].max() < 3.1 / 2.0 + 0.1  # 3 mm are 1.5 pixels.


def test_the_displayed_slice_of_a_stack_is_deformed_and_named(widget, small_sample, run, wait_for):
    viewer = viewer_of(widget)
    small_sample(viewer, (5, 20, 24), scale=(4.0, 1.0, 1.0), axis_labels=("z", "y", "x"))
    viewer.dims.set_current_step(0, 3)
    run(widget)
    assert widget.status.startswith("z = 3: tissue moved up to")
    arrows = viewer.layers["MR arrows, paper (z = 3)"]
    assert (arrows.data[:, 0, 0] == 3).all()
    deformed = viewer.layers["MR deformed, paper (z = 3)"]
    assert deformed.data.shape == (1, 20, 24)
    assert deformed.data_to_world((0, 0, 0)) == (12, 0, 0)
    said = widget.status.partition(" Hidden over")[0]
    viewer.layers["Boundary"].data[1] = 0
    viewer.dims.set_current_step(0, 1)
    wait_for(lambda: widget.status.startswith("The inputs have changed"))
    viewer.dims.set_current_step(0, 3)
    wait_for(lambda: widget.status == said)
    viewer.dims.set_current_step(0, 1)
    viewer.layers["Boundary"].data[1] = viewer.layers["Boundary"].data[3]
    run(widget)
    assert "MR arrows, paper (z = 1)" in names(viewer)
    assert "MR arrows, paper (z = 3)" in names(viewer)


# Messages


def test_boundary_outside_tissue_and_folds_are_reported(widget, small_sample, run, wait_for):
    _, _, boundary = small_sample(viewer_of(widget))
    boundary.data[0, :5] = 1
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -40.0)))
    widget.settings = replace(widget.settings, sweeps=60)
    outputs = run(widget)
    assert "5 boundary pixels outside tissue were ignored." in widget.warning
    assert outputs.folds > 0
    assert f"at {outputs.folds} pixels the tissue folds" in widget.warning
    # All is listed on the chip; folds can be seen, without solving again.
    chip = Screen(widget).button(f"⚠  {outputs.folds} folds: show")
    assert chip.toolTip() == widget.warning
    chip.click()
    assert "5 boundary pixels" in widget.status
    wait_for(lambda: "MR folds, paper" in names(viewer_of(widget)))
    assert 0 < by_name(widget, "MR folds, paper").data.sum() <= outputs.folds
    chip.click()
    assert widget.overlay == "nothing"


def test_an_error_names_the_mark_or_layer_with_too_large_a_motion(widget, small_sample):
    small_sample(viewer_of(widget))
    widget.drawing = Drawing((Landmark((10, 12), (10, 900), 2.0),))
    with pytest.raises(ProblemError, match="'Landmark' moves tissue by up to 888"):
        build_problem(widget.study)
    widget.drawing = Drawing((Landmark((10, 12), (10, 13), 2.0),))
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, 900.0)))
    with pytest.raises(ProblemError, match="'Boundary' moves tissue by up to 900"):
        build_problem(widget.study)


def test_painting_during_a_solve_marks_the_result_as_outdated(
    widget, small_sample, busy_thread, wait_for
):
    viewer = viewer_of(widget)
    _, tissue, _ = small_sample(viewer)
    widget.deform()
    assert not widget.idle
    tissue.data[5:9, 5:9] = 0
    tissue.refresh()
    busy_thread.set()
    wait_for(lambda: widget.idle)
    said = "The inputs have changed since the last result. Press Deform. Hidden over the deformed"
    wait_for(lambda: widget.status.startswith(said))
    assert viewer.layers["MR arrows, paper"].metadata[METADATA]["inputs_changed"]


def test_the_message_of_a_result_is_shown_while_the_result_is_current(
    widget, small_sample, run, wait_for
):
    viewer = viewer_of(widget)
    _, _, boundary = small_sample(viewer)
    run(widget)
    said, _, hidden = widget.status.partition(" Hidden over the deformed image, because paint does")
    assert "'Tissue', 'Boundary'." in hidden
    boundary.visible = True
    boundary.paint((8, 8), 1)
    wait_for(
        lambda: widget.status == "The inputs have changed since the last result. Press Deform."
    )
    boundary.undo()
    wait_for(lambda: widget.status == said)
    widget.settings = replace(widget.settings, sweeps=4)
    wait_for(
        lambda: widget.status == "The inputs have changed since the last result. Press Deform."
    )
    run(widget)
    before = widget.solution
    widget.overlay = "labels"
    wait_for(lambda: "Tissue deformed, paper" in names(viewer))  # Drawn from the same solution.
    assert widget.solution.provenance == before.provenance
    while viewer.layers:
        viewer.layers.pop()
    wait_for(lambda: widget.status.startswith("Open an image first"))
    assert widget.solution is None


# Errors


def test_missing_boundary_conditions_are_reported_without_a_boundary_layer(
    widget, small_sample, run, at_rest
):
    viewer = viewer_of(widget)
    small_sample(viewer)
    viewer.layers.remove("Boundary")
    at_rest()  # the removal is reported first
    widget.hold_edge = False
    assert run(widget) is None
    assert widget.status.startswith("'Motion' is 0 everywhere: nothing determines how tissue moves")
    widget.hold_edge = True
    assert not run(widget).solution.displacement.any()
    assert widget.status.startswith("Nothing moves yet")


def test_a_painted_boundary_releases_the_edge_and_a_new_boundary_fixes_it(widget, small_sample):
    viewer = viewer_of(widget)
    viewer.add_image(np.ones((8, 9)), name="T1")
    assert widget.hold_edge
    small_sample(viewer)
    assert not widget.hold_edge
    viewer.layers.remove("Boundary")
    assert widget.hold_edge
    widget.make_layers()
    assert widget.hold_edge


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda v: v.layers["Boundary"].data.fill(0), "'Boundary'"),
        (lambda v: v.layers["Tissue"].data.fill(0), "'Tissue'"),
        (lambda v: setattr(v.layers["Tissue"], "scale", (2, 1)), "is not on the grid"),
        (lambda v: setattr(v.layers["MR"], "data", np.zeros((9, 9))), "9 x 9"),
    ],
    ids=["unpainted", "all void", "elsewhere", "image size"],
)
def test_invalid_input_causes_one_error_and_changes_no_layer(
    widget, small_sample, run, spoil, said, notified
):
    viewer = viewer_of(widget)
    small_sample(viewer)
    run(widget)
    spoil(viewer)
    before = state(viewer)
    assert run(widget) is None
    assert [each.severity for each in notified] == ["warning"], (
        "the notification is not a warning, which disappears by itself"
    )
    assert said in widget.status
    assert widget.idle
    assert state(viewer) == before


def test_an_error_during_the_solve_is_reported_and_changes_no_layer(
    widget, small_sample, run, monkeypatch, notified
):
    viewer = viewer_of(widget)
    small_sample(viewer)
    before = state(viewer)

    def fail(*_, **__):
        raise MemoryError("no room")

    monkeypatch.setattr("napari_hmrf.solver.live_solver.solve", fail)
    assert run(widget) is None
    assert "MemoryError: no room" in widget.status
    assert [each.severity for each in notified] == ["error"], (
        "the notification is not an error, which remains"
    )
    assert state(viewer) == before


def test_progress_is_described_with_a_percentage_or_the_state_of_the_preparation():
    from napari_hmrf.solver.optimizers import Monitor
    from napari_hmrf.ui.messages import progress

    preparing = Monitor("preparing (the first run compiles its kernels, once)", 0.0)
    assert progress(preparing) == "Deforming ..."
    preparing = Monitor(f"{PREPARING}: about 20 s left", 0.3)
    edit = "Updating"
    assert progress(Monitor("cycle 8, 0.0032 px to go", 0.6), edit) == f"{edit} ... 60 %"
    assert progress(Monitor("cycle 9, 0.0009 px to go", 1.0), edit) == f"{edit} ... 99 %"
    assert progress(preparing) == (
        "Preparing for this computer, once: about 20 s left, then deforming."
    )


def test_progress_is_shown_in_per_cent_with_details_in_the_tool_tip(widget, small_sample, wait_for):
    small_sample(viewer_of(widget))
    widget.settings = replace(widget.settings, sweeps=100_000)
    widget.deform()
    labels = widget.native.findChildren(QLabel)
    percent = re.compile(r"Deforming \.\.\. \d+ %")
    sweep = re.compile(r"level \d+ \(.*\), sweep \d+")
    wait_for(
        lambda: (
            bool(percent.fullmatch(widget.status))
            and any(
                sweep.match(label.toolTip().splitlines()[-1]) for label in labels if label.toolTip()
            )
        )
    )
    widget.cancel()


@pytest.fixture
def slow_layers(monkeypatch):
    """Make the layers of a result wait until the event is set."""
    from napari_hmrf.ui import solving

    go, complete = threading.Event(), solving.complete_result

    def wait_and_complete(*arguments):
        assert go.wait(LONG)
        return complete(*arguments)

    monkeypatch.setattr(solving, "complete_result", wait_and_complete)
    yield go
    go.set()


def test_progress_is_shown_until_the_layers_of_an_edit_have_changed(
    widget, small_sample, run, wait_for, slow_layers
):
    slow_layers.set()
    small_sample(viewer_of(widget))
    run(widget)
    slow_layers.clear()
    cancel = Screen(widget).button("Cancel")
    widget.live = True
    widget.drawing = Drawing((Arrow((10, 12), (2, 0), 2),))
    wait_for(lambda: widget.status == "Updating: drawing the result.")
    assert cancel.isEnabled()
    slow_layers.set()
    wait_for(lambda: not widget.busy)
    assert "drawing" not in widget.status
    assert not cancel.isEnabled()


def test_cancel_also_stops_the_drawing_of_a_result(
    widget, small_sample, run, wait_for, slow_layers, at_rest
):
    slow_layers.set()
    small_sample(viewer_of(widget))
    run(widget)
    slow_layers.clear()
    before = widget.solution
    widget.live = True
    widget.drawing = Drawing((Arrow((10, 12), (2, 0), 2),))
    wait_for(lambda: widget.status == "Updating: drawing the result.")
    Screen(widget).press("Cancel")
    assert "Cancelled" in widget.status
    slow_layers.set()
    at_rest()
    assert widget.solution is before


def test_progress_is_shown_while_an_overlay_is_drawn_but_cannot_be_cancelled(
    widget, small_sample, run, wait_for, monkeypatch
):
    from napari_hmrf.ui.result import result_view

    go, draw = threading.Event(), result_view.overlay_of

    def wait_and_draw(*arguments):
        assert go.wait(LONG)
        return draw(*arguments)

    monkeypatch.setattr(result_view, "overlay_of", wait_and_draw)
    small_sample(viewer_of(widget))
    widget._form.result.overlay.value = "magnitude"
    run(widget)
    wait_for(lambda: widget.status == "Deforming: drawing the overlay.")
    assert not Screen(widget).button("Cancel").isEnabled()
    go.set()
    wait_for(lambda: not widget.busy)
    assert "drawing" not in widget.status


# Cancelling, removing and closing


def test_cancel_has_an_immediate_effect_while_the_thread_is_busy(
    widget, small_sample, busy_thread, wait_for, at_rest
):
    viewer = viewer_of(widget)
    small_sample(viewer)
    before = state(viewer)
    widget.deform()
    assert not widget.idle
    assert not widget._form.footer.deform.enabled
    assert widget._form.footer.cancel.enabled
    widget.cancel()
    assert not busy_thread.is_set()
    assert widget.idle
    assert widget._form.footer.deform.enabled
    assert not widget._form.footer.cancel.enabled
    assert "Cancelled" in widget.status
    busy_thread.set()
    at_rest()
    assert state(viewer) == before


def test_cancel_stops_a_long_solve_early(widget, small_sample, run, wait_for, monkeypatch):
    from napari_hmrf.solver.backends.cpu import kernels

    swept, sweep = [], kernels.sweeps.in_turns

    def counted(*arguments):
        sweep(*arguments)
        swept.append(len(arguments[-1]))

    monkeypatch.setattr(kernels.sweeps, "in_turns", counted)
    viewer = viewer_of(widget)
    small_sample(viewer)
    run(widget)
    before = state(viewer)
    widget.settings = replace(widget.settings, sweeps=100_000)
    swept.clear()
    widget.deform()
    wait_for(lambda: bool(swept))
    widget.cancel()
    compute_thread.submit(lambda: None).result(timeout=LONG)
    assert sum(swept) < 100_000, "all sweeps of a level were computed"
    assert state(viewer) == before


def test_a_second_press_of_deform_during_a_solve_has_no_effect(
    widget, small_sample, busy_thread, wait_for
):
    small_sample(viewer_of(widget))
    said = []
    widget.finished.connect(said.append)
    widget.deform()
    widget.deform()
    busy_thread.set()
    wait_for(lambda: widget.idle)
    assert len(said) == 1


def test_removing_a_layer_during_a_solve_cancels_the_solve(
    widget, small_sample, busy_thread, at_rest
):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.deform()
    viewer.layers.remove("Tissue")
    assert widget.idle
    assert widget.status.startswith("Cancelled")
    busy_thread.set()
    at_rest()
    assert not any("arrows" in name for name in names(viewer))


def test_delete_in_a_table_does_not_delete_points_of_a_layer(widget, small_sample, at_rest):
    viewer = viewer_of(widget)
    small_sample(viewer)
    points = viewer.add_points([[5.0, 5.0], [9.0, 9.0]], name="points")
    points.selected_data = {0, 1}
    table = widget._form.tissue.table
    table.selectRow(0)
    QTest.keyClick(table, Qt.Key.Key_Delete)
    at_rest()
    assert len(points.data) == 2
