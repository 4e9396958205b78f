"""Tests that an image and slice have one result, which is the newest."""

from dataclasses import replace

import numpy as np
import pytest
from napari.utils.colormaps import AVAILABLE_COLORMAPS
from qtpy.QtCore import Qt

from napari_hmrf.field.strain import fold_mask
from napari_hmrf.layers.compat import scale_bar_of
from napari_hmrf.layers.metadata import BOUNDARY, metadata_of, rows_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.motion.tools import TOOLS
from tests.support.person import CTRL
from tests.support.screen import Screen
from tests.support.windowless import Touch


def without_live_mode(dock):
    """Set the dock to the elastic model on the CPU, without live mode; return the dock."""
    dock.device = "cpu"
    dock.live = False
    return dock


@pytest.fixture
def pointer_and_dock(frame, small_sample, at_rest):
    """Return a simulated pointer on a small sample without a window, and the dock."""
    small_sample(frame.viewer, (48, 64))
    dock = without_live_mode(frame.open())
    at_rest()
    return Touch(frame.viewer), dock


def grab(dock):
    if not dock.active:
        Screen(dock).press("Pull")
    assert dock.active


def drag_a_patch(person, dock, settle):
    """Activate *Pull*, drag a patch and wait for the result."""
    grab(dock)
    settle(dock)
    person.drag((24, 30), (26, 33))
    settle(dock)


def visible_names(viewer):
    """Return the names of the visible layers except the image."""
    return {layer.name for layer in viewer.layers if layer.visible} - {"MR"}


def deformed_images(viewer):
    """Return the names of the layers that show the deformed image."""
    return [layer.name for layer in viewer.layers if metadata_of(layer).get("kind") == "image"]


DEFORMED = {"MR deformed, elastic"}


def parts(viewer, kind):
    """Return the layers of a kind."""
    return [layer for layer in viewer.layers if metadata_of(layer).get("kind") == kind]


def test_pulling_continues_from_the_deformed_result(pointer_and_dock, run, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    run(dock)
    assert visible_names(viewer) >= DEFORMED
    grab(dock)
    settle(dock)
    assert visible_names(viewer) == {*DEFORMED, "Motion"}, "visible paint tints the result"
    person.drag((24, 30), (28, 36))
    settle(dock)
    assert visible_names(viewer) == {*DEFORMED, "Motion"}


def test_the_newer_of_a_pulled_and_a_deformed_result_is_displayed(pointer_and_dock, run, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    picture = viewer.layers["MR deformed, elastic"]
    pulled = picture.data.copy()
    dock.rules = (dock.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    outputs = run(dock)
    assert np.array_equal(picture.data, outputs.layers["image"].data)
    assert not np.array_equal(picture.data, pulled)
    person.drag((24, 20), (20, 20))
    settle(dock)
    assert len(dock.drawing.marks) == 2
    assert np.array_equal(picture.data, dock._pointer.display.moved.image)
    assert not np.array_equal(picture.data, outputs.layers["image"].data)
    assert parts(viewer, "image") == [picture], "two results are shown for one image"
    assert len(parts(viewer, "arrows")) == 1


def test_activating_the_motion_layer_activates_the_tool(pointer_and_dock, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    pulled = viewer.layers["MR deformed, elastic"].data.copy()
    viewer.layers.selection = {viewer.layers["MR"]}
    assert not dock.active
    viewer.layers.selection = {viewer.layers["Motion"]}
    assert dock.active
    assert np.array_equal(viewer.layers["MR deformed, elastic"].data, pulled)


def test_the_status_bar_reads_the_displayed_result_while_pulling(pointer_and_dock, run, settle):
    person, dock = pointer_and_dock
    run(dock)
    settle(dock)
    assert dock.at((24.0, 40.0)).displacement[0] == pytest.approx(0, abs=0.05)
    drag_a_patch(person, dock, settle)
    assert dock.result is person.viewer.layers["MR arrows, elastic"]
    moved = dock.solution.displacement
    assert dock.at((28.0, 33.0)).displacement == pytest.approx(moved[26, 30], abs=0.6)
    dock.clear()
    settle(dock)
    assert dock.at((24.0, 40.0)).displacement[0] == pytest.approx(0, abs=0.05)


@pytest.fixture
def pulled(pointer_and_dock, run, settle):
    """Return the viewer and the dock after a deformation and a pull."""
    person, dock = pointer_and_dock
    run(dock)
    drag_a_patch(person, dock, settle)
    return person.viewer, dock


def test_a_pulled_image_can_be_shown_before_its_motion(pulled):
    viewer, dock = pulled
    dock.before = True
    assert visible_names(viewer) <= {"Motion"}
    dock.before = False
    assert viewer.layers["MR deformed, elastic"].visible


def test_overlays_of_a_pulled_result_are_named_after_the_image(pulled, settle):
    viewer, dock = pulled
    dock.overlay = "squeeze"
    settle(dock)
    assert "MR maximum elastic compression (%), elastic" in viewer.layers
    assert dock.image is viewer.layers["MR"]


def test_overlays_are_updated_for_a_new_result_and_removed_if_switched_off(pulled, run, settle):
    viewer, dock = pulled
    dock.overlay = "magnitude"
    settle(dock)
    (colours,) = parts(viewer, "magnitude")
    before = colours.data.copy()
    dock.rules = (dock.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    run(dock)
    settle(dock)
    assert colours.visible
    assert not np.array_equal(colours.data, before, equal_nan=True)
    dock.overlay = "nothing"
    run(dock)
    settle(dock)
    assert not parts(viewer, "magnitude")


def test_an_overlay_is_never_displayed_over_a_newer_image(pulled, run, settle):
    viewer, dock = pulled
    name = "labels"
    dock.overlay = name
    settle(dock)
    (layer,) = parts(viewer, name)
    assert layer.visible
    seen_over_another = []
    for shown in (dock.deformation_changed, dock.result_drawn):
        shown.connect(lambda _: seen_over_another.append(layer.visible))
    dock.rules = (dock.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    run(dock)
    settle(dock)
    assert seen_over_another
    assert not any(seen_over_another)
    assert parts(viewer, name) == [layer]
    assert layer.visible, "the overlay of the new result is not displayed"


@pytest.fixture
def two_images(pointer_and_dock, settle):
    """Return the viewer and the dock with two pulled images."""
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    dock.image = viewer.add_image(viewer.layers["MR"].data // 2, name="CT")
    settle(dock)
    drag_a_patch(person, dock, settle)
    return viewer, dock


def test_a_selected_result_shows_only_its_own_overlays(two_images, settle):
    viewer, dock = two_images
    for name, kinds in (("MR", ("magnitude", "grid")), ("CT", ("grid", "stiffness")), ("MR", ())):
        viewer.layers.selection.active = viewer.layers[f"{name} arrows, elastic"]
        assert dock.result is viewer.layers.selection.active
        for kind in kinds or (dock.overlay,):
            dock.overlay = kind
            settle(dock)
            shown = [layer for layer in parts(viewer, kind) if layer.visible]
            assert [metadata_of(layer)["source"] for layer in shown] == [name]
    dock.result = None
    settle(dock)
    assert not any(layer.visible for layer in parts(viewer, "stiffness"))


def test_removing_an_image_removes_its_result_layers(two_images, settle, wait_for):
    viewer, dock = two_images
    dock.overlay = "magnitude"
    settle(dock)
    assert len([layer for layer in viewer.layers if metadata_of(layer).get("source") == "CT"]) == 3
    viewer.layers["MR arrows, elastic"].name = "mine"
    viewer.layers.remove("CT")
    wait_for(lambda: not any(metadata_of(layer).get("source") == "CT" for layer in viewer.layers))
    assert "MR deformed, elastic" in viewer.layers
    viewer.layers.remove("MR")
    wait_for(lambda: "MR deformed, elastic" not in viewer.layers)
    assert "mine" in viewer.layers, "a layer renamed by the user was removed"


def test_all_layers_can_be_removed_at_once(two_images, settle, wait_for):
    viewer, dock = two_images
    dock.overlay = "magnitude"
    settle(dock)
    viewer.layers.selection = {viewer.layers["MR"], viewer.layers["CT"]}
    viewer.layers.remove_selected()
    wait_for(lambda: not any("source" in metadata_of(layer) for layer in viewer.layers))
    viewer.layers.clear()
    settle(dock)
    assert dock.result is None


def test_a_new_pull_resets_a_partial_motion_to_the_full_motion(pointer_and_dock, settle, wait_for):
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    dock.percent, dock.overlay = 50, "grid"
    picture = viewer.layers["MR deformed, elastic"]
    wait_for(lambda: not dock.busy and metadata_of(picture).get("percent") == 50)
    before = viewer.layers["MR grid, elastic"].data.copy()
    person.drag((24, 20), (20, 20))
    wait_for(lambda: dock.percent == 100)
    settle(dock)
    assert np.array_equal(picture.data, dock._pointer.display.moved.image)
    grid = viewer.layers["MR grid, elastic"]
    assert grid.visible
    assert grid.data.shape != before.shape or (grid.data != before).any()


def test_layers_hidden_by_the_user_remain_hidden(pointer_and_dock, run, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    run(dock)
    viewer.layers["MR arrows, elastic"].visible = False
    drag_a_patch(person, dock, settle)
    dock.rules = (dock.rules[0], BoundaryRule(2, "move", vector=(0.0, 2.0)))
    run(dock)
    assert visible_names(viewer) == {"MR deformed, elastic", "Motion"}


def test_a_new_result_does_not_change_results_of_other_slices(frame, small_sample, run, settle):
    viewer = frame.viewer
    small_sample(viewer, (3, 20, 24))
    dock = without_live_mode(frame.open())
    viewer.dims.set_current_step(0, 0)
    run(dock)
    before = visible_names(viewer) - {"Boundary", "Tissue"}
    viewer.dims.set_current_step(0, 2)
    assert dock.start()
    dock.drawing = Drawing().with_mark(Arrow((10, 12), (2, 2), 3))
    settle(dock)
    assert visible_names(viewer) >= before
    dock.clear()
    settle(dock)
    assert visible_names(viewer) >= before


def test_the_result_of_the_displayed_slice_is_selected(frame, small_sample, run, settle):
    viewer = frame.viewer
    small_sample(viewer, (3, 20, 24))
    dock = without_live_mode(frame.open())
    for number in (0, 2):
        viewer.dims.set_current_step(0, number)
        run(dock)
    for number in (0, 2):
        viewer.dims.set_current_step(0, number)
        settle(dock)
        assert metadata_of(dock.result)["slice"] == f"slice {number}"


def test_a_reopened_dock_continues_with_results_tables_and_edits_made_meanwhile(
    frame, small_sample, run, settle, wait_for, at_rest
):
    viewer = frame.viewer
    small_sample(viewer, (48, 64))
    first = without_live_mode(frame.open())
    run(first)
    first.overlay = "magnitude"
    first.unfolds = False
    first.drawing = Drawing().with_mark(Arrow((30, 20), (0, 30), 4))
    run(first)
    settle(first)
    assert "folds" in first.warning
    first.tool = "pin"
    frame.close(first)
    assert not first.warning
    viewer.layers["Tissue"].data[38:42] = 0
    told, old = [], first.rules
    first.deformation_changed.connect(told.append)
    second = frame.open()
    assert second.live
    assert "Paint tissue to hold" not in second.status, "an earlier message is shown"
    screen = Screen(second)
    assert not any(screen.button(tool.title).isChecked() for tool in TOOLS)
    settle(second)
    assert "folds" in second.warning, "the warning about folds is missing after reopening"
    assert second.overlay == "magnitude"
    assert not second.solution.tissue[39, 30]
    boundary = viewer.layers["Boundary"]
    boundary.data[20:24, 40:44] = 5
    boundary.events.data()  # a hidden layer emits no event when it is refreshed
    wait_for(lambda: len(second.rules) > len(old))
    at_rest()
    settle(second)
    assert first.rules == old, "the closed dock followed an edit"
    assert not told
    assert rows_of(boundary, BOUNDARY) == second.rules
    assert deformed_images(viewer) == ["MR deformed, elastic"]
    assert len(parts(viewer, "magnitude")) == 1
    assert not any("[1]" in layer.name for layer in viewer.layers)


# Layers of earlier results


def pull(widget, by):
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, by)))


@pytest.fixture
def folding(widget, small_sample, run):
    """Return the dock with a result that has folds."""
    small_sample(widget._viewer)
    widget.settings = replace(widget.settings, sweeps=60)
    pull(widget, -40.0)
    assert run(widget).folds > 5
    return widget


def test_folds_are_marked_on_request_and_cleared_with_a_result_without_folds(folding, run, settle):
    assert "folds" in folding.warning
    assert "MR folds, paper" not in folding._viewer.layers
    Screen(folding).button("⚠").click()
    assert folding.status == folding.warning
    settle(folding)
    layer = folding._viewer.layers["MR folds, paper"]
    solution = folding.solution
    folded = fold_mask(solution.displacement, spacing=solution.spacing, tissue=solution.tissue)
    seen = np.argwhere(folded) + solution.displacement[folded] / solution.spacing
    places = {tuple(place) for place in np.rint(seen).astype(int) if min(place) >= 0}
    assert {*map(tuple, np.argwhere(layer.data))} == places
    folding.percent = 0
    settle(folding)
    assert np.array_equal(layer.data != 0, folded), (
        "folds are not marked at the origin of the tissue"
    )
    folding.percent = 100
    pull(folding, 1.0)
    assert not run(folding).folds
    settle(folding)
    assert not folding.warning
    assert not parts(folding._viewer, "folds")
    pull(folding, -40.0)
    outputs = run(folding)
    settle(folding)
    (layer,) = parts(folding._viewer, "folds")
    assert layer.visible
    assert 0 < layer.data.sum() <= outputs.folds


def test_an_overlay_that_was_switched_off_shows_no_earlier_result(folding, run, settle):
    viewer = folding._viewer
    folding.overlay = "labels"
    settle(folding)
    (labels,) = parts(viewer, "labels")
    assert labels.visible
    before = labels.data.copy()
    folding.overlay = "nothing"
    pull(folding, 1.0)
    run(folding)
    assert "MR deformed, paper" in visible_names(viewer)
    assert not parts(viewer, "labels")
    folding.overlay = "labels"
    settle(folding)
    (labels,) = parts(viewer, "labels")
    assert labels.visible
    assert (labels.data != before).any()


# Messages about pulled tissue


@pytest.fixture
def folded(pulling_beside, settle):
    """Return a simulated user and the dock after a pull that folds the tissue."""
    person, widget = pulling_beside
    widget.unfolds = False
    widget.drawing = Drawing().with_mark(Arrow((30, 20), (0, 30), 4))
    settle(widget)
    assert "folds" in widget.warning
    return person, widget


def test_a_warning_about_folds_is_shown_only_while_the_result_has_folds(folded, settle):
    _, widget = folded
    widget.clear()
    settle(widget)
    assert (widget.warning, widget.status) == ("", "Removed all marks. Press Undo to restore them.")
    widget.undo()
    settle(widget)
    assert "folds" in widget.warning
    assert "Undid" in widget.status
    widget.drawing = Drawing().with_mark(Arrow((30, 20), (0, 1), 4))
    settle(widget)
    assert not widget.warning


def test_the_status_is_shown_besides_a_warning(folded, settle):
    person, widget = folded
    person.press(50, 30)
    person.move(52, 30)
    person.key(Qt.Key.Key_Escape)
    settle(widget)
    assert "Cancelled" in widget.status
    widget.tool = "pin"
    assert widget.status == "Paint tissue to hold it at its original place."
    assert "folds" in widget.warning


def test_a_new_action_replaces_the_status(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 30), (33, 30))
    person.key(Qt.Key.Key_Z, CTRL)
    settle(widget)
    assert "Undid" in widget.status
    person.drag((30, 30), (33, 30))
    settle(widget)
    assert widget.status.startswith("Drag tissue")
    person.pick(33, 30)
    assert widget.status.startswith("Mark selected")
    person.key(Qt.Key.Key_Delete)
    settle(widget)
    assert widget.status.startswith("Removed")
    person.drag((30, 30), (33, 30))
    person.pick(33, 30)
    person.key(Qt.Key.Key_Escape)
    assert widget.status.startswith("Drag tissue")


def test_pulling_starts_only_on_request_and_with_an_image(frame, small_sample, at_rest):
    viewer, widget = frame.viewer, without_live_mode(frame.open())
    Screen(widget).press("Pull")
    assert "image" in widget.status
    small_sample(viewer)
    at_rest()
    assert not widget.active, "pulling started without a request"
    assert "Motion" not in viewer.layers


# Painting


def test_painting_shows_the_image_before_its_motion(pointer_and_dock, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    Screen(dock).click_row("gel")
    assert not any(viewer.layers[name].visible for name in deformed_images(viewer))
    assert viewer.layers["MR"].visible
    grab(dock)
    settle(dock)
    assert viewer.layers["MR deformed, elastic"].visible


def test_a_new_result_is_not_displayed_during_a_stroke(pointer_and_dock, settle):
    person, dock = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, dock, settle)
    dock.live = True
    Screen(dock).click_row("air")
    found = []
    dock.result_drawn.connect(found.append)
    person.press(20, 20)
    person.move(20, 30)
    settle(dock)  # The result is ready and the mouse does not move.
    assert found, "there is no new result"
    assert dock.before
    assert not any(viewer.layers[name].visible for name in deformed_images(viewer))
    person.release(20, 30)
    settle(dock)
    assert dock.before
    dock.tissue.mode = "pan_zoom"
    assert viewer.layers["MR deformed, elastic"].visible, (
        "the moved image is not displayed after painting"
    )


def test_clicking_a_cell_to_type_a_number_activates_no_brush(pointer_and_dock, settle):
    person, dock = pointer_and_dock
    drag_a_patch(person, dock, settle)
    Screen(dock).cell("gel", "Stiffness").click()
    assert dock.active, "the tool was deactivated"
    Screen(dock).click_row("gel")
    assert not dock.active


def test_undo_of_a_pull_leaves_neither_arrows_nor_a_scale_key(pulling_beside, settle):
    person, dock = pulling_beside
    person.drag((20, 20), (20, 20))
    person.drag((40, 40), (45, 48))
    settle(dock)
    bar = scale_bar_of(person.viewer)
    assert dock.result.data[:, 1].any()
    dock.arrows = True
    assert bar.visible
    dock.undo()
    settle(dock)
    assert "moved up to 0 px" in Screen(dock).words
    assert not dock.result.data[:, 1].any()
    assert not bar.visible
    dock.redo()
    settle(dock)
    assert bar.visible


def test_undo_of_the_only_pull_removes_the_result(pointer_and_dock, settle):
    person, dock = pointer_and_dock
    dock.boundary = dock.tissue = None
    drag_a_patch(person, dock, settle)
    assert dock.at((28, 36)) is not None
    assert Screen(dock).button("Play").isEnabled()
    dock.undo()
    settle(dock)
    assert dock.result is None
    assert dock.at((28, 36)) is None
    assert not Screen(dock).button("Play").isEnabled()
    assert "moved up to" not in Screen(dock).words
    dock.redo()
    settle(dock)
    assert dock.at((28, 36)) is not None


def test_new_layers_to_paint_on_do_not_change_the_result(pulling_beside, settle):
    person, dock = pulling_beside
    person.drag((24, 30), (28, 36))
    settle(dock)
    before = dock.solution
    Screen(dock).press("New tissue layer")
    settle(dock)
    assert dock.tissue is person.viewer.layers["Tissue"]
    assert np.array_equal(dock.solution.tissue, before.tissue)
    assert dock.solution.displacement == pytest.approx(before.displacement, abs=0.01)


def test_the_drawing_may_change_while_its_layer_is_hidden(pointer_and_dock, settle):
    person, puller = pointer_and_dock
    viewer = person.viewer
    drag_a_patch(person, puller, settle)
    puller.tool = "move"
    person.paint((20, 20), (24, 26), (30, 30))
    settle(puller)
    drawn = len(viewer.layers["Motion"].data)
    viewer.layers["Motion"].visible = False
    puller.drawing = Drawing(
        puller.drawing.marks[1:]
    )  # With fewer lines than before, code of napari failed here.
    settle(puller)
    assert len(viewer.layers["Motion"].data) < drawn
    puller.drawing = Drawing((Arrow((20, 20), (2, 2), 6.0),))
    viewer.layers["Motion"].visible = True
    settle(puller)
    arrows = viewer.layers["Motion"]
    assert len(arrows.edge_color) == len(arrows.data)


def test_the_status_bar_is_not_changed_without_a_pointer_on_the_canvas(
    pointer_and_dock, run, settle
):
    person, dock = pointer_and_dock
    run(dock)
    settle(dock)
    person.viewer.mouse_over_canvas = False
    person.viewer.status = "Brain"
    assert person.viewer.status == "Brain"


def test_a_status_of_any_length_has_three_lines_and_its_tooltip_has_all_of_it(pointer_and_dock):
    _, dock = pointer_and_dock
    footer = dock._form.footer
    label = footer._status
    for count in (1, 40, 5):
        footer.show_status("\n".join(["word"] * count))
        assert round(label.height() / label.fontMetrics().lineSpacing()) == 3
        assert footer._status.is_elided == (count == 40)
        assert label.toolTip().count("word") == count, (
            "the tool tip does not contain the whole status"
        )


def test_pixels_without_a_value_hide_the_undeformed_image(frame, at_rest, settle):
    pixels = np.full((48, 64), 50, np.float32)
    pixels[20:24, 30:34] = np.nan
    image = frame.viewer.add_image(pixels, name="MR", colormap="gray")
    dock = without_live_mode(frame.open())
    at_rest()
    drag_a_patch(Touch(frame.viewer), dock, settle)
    (deformed,) = parts(frame.viewer, "image")
    assert np.isnan(deformed.data).any()
    np.testing.assert_array_equal(deformed.colormap.map([np.nan])[0], (0, 0, 0, 1))
    np.testing.assert_allclose(deformed.colormap.map([0.5]), image.colormap.map([0.5]))
    assert image.colormap.nan_color[3] == AVAILABLE_COLORMAPS["gray"].nan_color[3] == 0
