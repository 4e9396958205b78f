"""Of an image and a slice there is one result, whoever made it: the newest, which is seen."""

import numpy as np
import pytest
from conftest import quick
from napari_hmrf.ui.motion.grab_dock import GrabAndPull
from person import CTRL, Person
from qtpy.QtCore import Qt

from napari_hmrf.layers.edit_history import steps_of
from napari_hmrf.layers.metadata import BOUNDARY, known_of, rows_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.motion.motion_messages import START


@pytest.fixture
def at_hand(make_napari_viewer, small_sample, qtbot, at_rest):
    """A person before a small sample, and a way to open docks."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer, (48, 64))

    def opened(title):
        _, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", title)
        at_rest()
        return quick(dock) if title == "Deform tissue" else dock

    return Person(viewer, qtbot), opened


def grab(dock):
    dock.form.grab.native.click()
    assert dock.active


def drag_a_patch(person, dock, settle):
    """Grab, drag a patch, and wait for the tissue."""
    grab(dock)
    person.drag((24, 30), (28, 36))
    settle(dock)


def seen(viewer):
    """The names of the layers that are seen, but for the image."""
    return {layer.name for layer in viewer.layers if layer.visible} - {"MR"}


def pictures(viewer):
    """The layers that show the image moved, by their names."""
    return [layer.name for layer in viewer.layers if known_of(layer).get("kind") == "image"]


DEFORMED = {"MR deformed", "MR arrows"}
PULLED = {"MR deformed, elastic", "Arrows"}


def parts(viewer, kind):
    """The layers of a kind."""
    return [layer for layer in viewer.layers if known_of(layer).get("kind") == kind]


def test_nothing_deformed_before_covers_the_image_that_is_pulled(at_hand, run, settle):
    person, opened = at_hand
    viewer = person.viewer
    run(opened("Deform tissue"))
    assert seen(viewer) >= DEFORMED
    puller = opened("Grab and pull")
    grab(puller)
    assert seen(viewer) == {"Arrows"}
    person.drag((24, 30), (28, 36))
    settle(puller)
    assert seen(viewer) == PULLED


def test_of_a_pull_and_a_deformation_of_an_image_the_one_made_last_is_seen(at_hand, run, settle):
    person, opened = at_hand
    viewer = person.viewer
    puller, deform = opened("Grab and pull"), opened("Deform tissue")
    drag_a_patch(person, puller, settle)
    picture = viewer.layers["MR deformed, elastic"]
    run(deform)
    assert seen(viewer) == DEFORMED
    person.drag((24, 20), (20, 20))
    settle(puller)
    assert len(puller.drawing.marks) == 2
    assert seen(viewer) == PULLED
    assert np.array_equal(picture.data, puller._pointer.display.moved.image)
    outputs = run(deform)
    assert seen(viewer) == DEFORMED
    assert np.array_equal(picture.data, outputs.layers["image"].data)
    assert parts(viewer, "image") == [picture], "one result takes the place of the other"
    assert len(parts(viewer, "arrows")) == 1


def test_choosing_the_layer_goes_on_pulling(at_hand, run, settle):
    person, opened = at_hand
    viewer = person.viewer
    puller, deform = opened("Grab and pull"), opened("Deform tissue")
    drag_a_patch(person, puller, settle)
    pulled = viewer.layers["MR deformed, elastic"].data.copy()
    run(deform)
    viewer.layers.selection = {viewer.layers["MR"]}
    viewer.layers.selection = {viewer.layers["Arrows"]}
    assert seen(viewer) == PULLED, "what is taken hold of is what is seen"
    assert np.array_equal(viewer.layers["MR deformed, elastic"].data, pulled)


def test_arrows_of_a_pull_are_seen_when_they_are_asked_for(at_hand, settle):
    person, opened = at_hand
    viewer = person.viewer
    puller = opened("Grab and pull")
    drag_a_patch(person, puller, settle)
    arrows = viewer.layers["MR arrows, elastic"]
    assert not arrows.visible
    arrows.visible = True
    person.drag((24, 20), (20, 20))
    settle(puller)
    assert arrows.visible, "an eye that is opened stays open"


def test_what_was_deformed_is_pulled_on_with_the_value_of_what_is_seen(
    at_hand, run, settle, wait_for
):
    person, opened = at_hand
    viewer = person.viewer
    puller, deform = opened("Grab and pull"), opened("Deform tissue")
    run(deform)
    look = opened("Look at the result")
    drag_a_patch(person, puller, settle)
    wait_for(lambda: look.idle and not look._scene.outdated)
    assert look.result is viewer.layers["MR arrows, elastic"]
    moved = puller._puller.display.seen.solution.displacement
    assert look.at((30.0, 36.0)).displacement == pytest.approx(moved[26, 30], abs=0.6)
    run(deform)
    wait_for(lambda: look.idle and not look._scene.outdated)
    assert look.at((24.0, 40.0)).displacement[0] == pytest.approx(0, abs=0.05)


@pytest.fixture
def two_results(at_hand, run, settle):
    """What was deformed, and then pulled, which is seen; a look that is opened now."""
    person, opened = at_hand
    puller, deform = opened("Grab and pull"), opened("Deform tissue")
    run(deform)
    drag_a_patch(person, puller, settle)
    return person.viewer, opened("Look at the result"), deform


def test_what_was_pulled_is_seen_as_it_was_too(two_results):
    viewer, look, _ = two_results
    look.before = True
    assert seen(viewer) <= {"Arrows"}
    look.before = False
    assert viewer.layers["MR deformed, elastic"].visible


def test_colours_of_what_was_pulled_are_named_after_the_image(two_results, wait_for):
    viewer, look, _ = two_results
    look.colours = "squeeze"
    wait_for(lambda: look.idle)
    assert "MR largest squeeze (%), elastic" in viewer.layers
    assert look.image is viewer.layers["MR"]


def test_colours_of_a_result_are_gone_with_it_and_there_for_the_next(two_results, run, wait_for):
    viewer, look, deform = two_results
    look.colours = "magnitude"
    wait_for(lambda: look.idle)
    (colours,) = parts(viewer, "magnitude")
    before = colours.data.copy()
    run(deform)
    wait_for(lambda: look.idle and not look._scene.outdated)
    assert colours.visible
    assert not np.array_equal(colours.data, before, equal_nan=True)
    look.colours = "nothing"
    run(deform)
    wait_for(lambda: look.idle and not look._scene.outdated)
    assert not colours.visible


@pytest.fixture
def two_images(at_hand, settle, wait_for):
    """Two images that were pulled; a look that is opened now."""
    person, opened = at_hand
    viewer = person.viewer
    puller = opened("Grab and pull")
    drag_a_patch(person, puller, settle)
    puller.image = viewer.add_image(viewer.layers["MR"].data // 2, name="CT")
    settle(puller)
    drag_a_patch(person, puller, settle)
    return viewer, opened("Look at the result")


def test_a_result_that_is_chosen_has_its_colours_alone(two_images, wait_for):
    viewer, look = two_images
    for name in ("MR", "CT", "MR"):
        look.result = viewer.layers[f"{name} arrows, elastic"]
        look.colours, look.grid = "magnitude", True
        wait_for(lambda: look.idle)
        assert look.grid
        for kind in ("magnitude", "grid"):
            shown = [layer for layer in parts(viewer, kind) if layer.visible]
            assert [known_of(layer)["source"] for layer in shown] == [name]
    look.result = None
    wait_for(lambda: look.idle)
    assert not any(layer.visible for layer in parts(viewer, "magnitude"))
    assert look.status == "Choose a result above to look at it."


def test_nothing_of_an_image_that_is_deleted_stays(two_images, wait_for):
    viewer, look = two_images
    look.colours, look.grid = "magnitude", True
    wait_for(lambda: look.idle)
    assert len([layer for layer in viewer.layers if known_of(layer).get("source") == "CT"]) == 4
    viewer.layers["MR arrows, elastic"].name = "mine"
    viewer.layers.remove("CT")
    wait_for(lambda: not any(known_of(layer).get("source") == "CT" for layer in viewer.layers))
    assert "MR deformed, elastic" in viewer.layers
    viewer.layers.remove("MR")
    wait_for(lambda: "MR deformed, elastic" not in viewer.layers)
    assert "mine" in viewer.layers, "what somebody has named is theirs"


def test_all_layers_can_be_deleted_at_once(two_images, wait_for):
    viewer, look = two_images
    look.colours = "magnitude"
    wait_for(lambda: look.idle)
    viewer.layers.selection = {viewer.layers["MR"], viewer.layers["CT"]}
    viewer.layers.remove_selected()
    wait_for(lambda: not any("source" in known_of(layer) for layer in viewer.layers))
    viewer.layers.clear()
    wait_for(lambda: look.idle)
    assert look.result is None


def test_a_part_that_is_looked_at_makes_way_for_the_next_pull(at_hand, settle, wait_for):
    person, opened = at_hand
    viewer = person.viewer
    puller = opened("Grab and pull")
    drag_a_patch(person, puller, settle)
    look = opened("Look at the result")
    wait_for(lambda: look.idle)
    look.percent, look.grid = 50, True
    picture = viewer.layers["MR deformed, elastic"]
    wait_for(lambda: look.idle and known_of(picture).get("percent") == 50)
    before = viewer.layers["MR grid, elastic"].data.copy()
    person.drag((24, 20), (20, 20))
    wait_for(lambda: look.percent == 100)
    settle(puller)
    wait_for(lambda: look.idle and not look._scene.outdated)
    assert np.array_equal(picture.data, puller._pointer.display.moved.image)
    grid = viewer.layers["MR grid, elastic"]
    assert grid.visible
    assert grid.data.shape != before.shape or (grid.data != before).any()
    look.percent = 40
    wait_for(lambda: look.idle and known_of(picture).get("percent") == 40)
    viewer.window.remove_dock_widget(look.native)
    assert np.array_equal(picture.data, puller._pointer.display.moved.image), "put back"


def test_what_was_hidden_by_hand_stays_hidden(at_hand, run, settle):
    person, opened = at_hand
    viewer = person.viewer
    deform, puller = opened("Deform tissue"), opened("Grab and pull")
    run(deform)
    viewer.layers["MR arrows"].visible = False
    drag_a_patch(person, puller, settle)
    deform.rules = (deform.rules[0], BoundaryRule(2, "move", vector=(0.0, 2.0)))
    run(deform)
    assert seen(viewer) == {"MR deformed"}


def test_results_of_another_slice_stay_as_they_are(
    make_napari_viewer, small_sample, run, settle, qtbot
):
    viewer = make_napari_viewer()
    small_sample(viewer, (3, 20, 24))
    _, deform = viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    viewer.dims.set_current_step(0, 0)
    run(quick(deform))
    before = seen(viewer)
    _, puller = viewer.window.add_plugin_dock_widget("napari-hmrf", "Grab and pull")
    viewer.dims.set_current_step(0, 2)
    assert puller.start()
    puller.drawing = Drawing().with_mark(Arrow((10, 12), (2, 2), 3))
    settle(puller)
    assert seen(viewer) >= before - {"Boundary", "Tissue"}


def test_a_result_that_only_follows_the_slice_covers_nothing_that_is_pulled(
    make_napari_viewer, small_sample, run, settle, wait_for, at_rest
):
    viewer = make_napari_viewer()
    small_sample(viewer, (3, 20, 24))
    _, deform = viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    viewer.dims.set_current_step(0, 0)
    run(quick(deform))
    deform.live = True
    _, puller = viewer.window.add_plugin_dock_widget("napari-hmrf", "Grab and pull")
    assert puller.start()
    puller.drawing = Drawing().with_mark(Arrow((10, 12), (2, 2), 3))
    settle(puller)

    def settle_both():
        at_rest.until(lambda: not deform.following)
        settle(puller)

    viewer.dims.set_current_step(0, 2)
    settle_both()
    assert viewer.layers["Arrows"].visible
    assert not any(", elastic" not in name for name in seen(viewer) if "slice 2" in name)
    deform.rules = (deform.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    settle_both()
    assert viewer.layers["MR deformed (slice 2)"].visible, "an edit is seen"
    assert not viewer.layers["Arrows"].visible


def test_a_reopened_dock_goes_on_with_the_result_that_is_there(
    at_hand, run, settle, wait_for, qtbot
):
    person, opened = at_hand
    viewer = person.viewer
    first = opened("Deform tissue")
    run(first)
    viewer.window.remove_dock_widget(first.native)
    second = opened("Deform tissue")
    run(second)
    assert pictures(viewer) == ["MR deformed"]
    viewer.window.remove_dock_widget(second.native)
    assert "boundary preview" not in [layer.name for layer in viewer.layers]
    third = opened("Deform tissue")
    run(third)
    assert pictures(viewer) == ["MR deformed"]


def test_a_reopened_dock_has_tissue_follow_edits_as_the_closed_one_did(
    at_hand, run, settle, wait_for
):
    person, _ = at_hand
    viewer = person.viewer
    viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    (first,) = viewer.window.dock_widgets.values()
    first.settings.device.value = "cpu"
    run(first)
    said = first.status
    viewer.window.remove_dock_widget(first.native)
    _, second = viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    assert second.live
    assert second.status == said
    before = viewer.layers["MR deformed"].data.copy()
    second.rules = (second.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    wait_for(lambda: not second.following and (viewer.layers["MR deformed"].data != before).any())
    assert pictures(viewer) == ["MR deformed"]


def test_a_result_that_was_edited_while_no_dock_was_open_is_not_taken_for_new(at_hand, run):
    person, opened = at_hand
    viewer = person.viewer
    first = opened("Deform tissue")
    run(first)
    viewer.window.remove_dock_widget(first.native)
    viewer.layers["Tissue"].data[30:40] = 0
    assert opened("Deform tissue").solution is None


def test_a_closed_dock_pulls_nothing_and_the_next_goes_on_with_its_layers(at_hand, settle, qtbot):
    person, opened = at_hand
    viewer = person.viewer
    first = opened("Grab and pull")
    grab(first)
    person.drag((24, 30), (28, 36))
    settle(first)
    told = []
    first.seen.connect(told.append)
    viewer.window.remove_dock_widget(first.native)
    second = opened("Grab and pull")
    grab(second)
    assert len(second.drawing.marks) == 1
    settle(second)
    second.tool = "pin"
    person.paint((24, 12), (24, 20))
    settle(second)
    assert not told
    assert pictures(viewer) == ["MR deformed, elastic"]
    names = [layer.name for layer in viewer.layers]
    assert len(names) == len({name.partition(" [")[0] for name in names}), names
    person.key(Qt.Key.Key_Z, CTRL)
    settle(second)
    assert not told


def test_a_closed_dock_that_looked_leaves_no_second_colours(at_hand, run, wait_for):
    person, opened = at_hand
    viewer = person.viewer
    run(opened("Deform tissue"))
    for _ in range(2):
        look = opened("Look at the result")
        look.colours = "magnitude"
        wait_for(lambda look=look: look.idle)
        viewer.window.remove_dock_widget(look.native)
    assert len(parts(viewer, "magnitude")) <= 1
    assert np.unique([layer.name for layer in viewer.layers]).size == len(viewer.layers)
    assert not any("[1]" in layer.name for layer in viewer.layers)


def test_the_tables_of_a_closed_dock_are_no_longer_those_of_the_layers(at_hand, qtbot, at_rest):
    person, opened = at_hand
    first = opened("Deform tissue")
    old = first.rules
    person.viewer.window.remove_dock_widget(first.native)
    second = opened("Deform tissue")
    second.rules = (second.rules[0],)
    person.viewer.layers["Boundary"].data[20:24, 30:34] = 5
    person.viewer.layers["Boundary"].refresh()
    qtbot.waitUntil(lambda: len(second.rules) > 1)
    at_rest()
    assert first.rules == old
    assert rows_of(person.viewer.layers["Boundary"], BOUNDARY) == second.rules
    person.viewer.window.remove_dock_widget(second.native)
    person.viewer.window.add_dock_widget(first.native)
    assert first.rules == second.rules


# What an earlier result leaves behind


def pull(widget, by):
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, by)))


@pytest.fixture
def folding(widget, small_sample, run):
    """A result with folds, which are shown."""
    small_sample(widget._viewer)
    widget.outputs = ("image", "folds", "grid")
    widget.settings.sweeps.value = 60
    pull(widget, -40.0)
    assert run(widget).folds > 5
    return widget


def test_folds_are_gone_with_what_folded(folding, run):
    layer = folding._viewer.layers["MR folds"]
    assert "'folds' shows where" in folding.status
    assert "tick" not in folding.status
    pull(folding, 1.0)
    assert not run(folding).folds
    assert not layer.visible
    pull(folding, -40.0)
    outputs = run(folding)
    assert layer.visible
    assert layer.data.sum() == outputs.folds


def test_what_is_no_longer_ticked_shows_no_earlier_result(folding, run):
    grid = folding._viewer.layers["MR grid"]
    folding.outputs = ("image",)
    pull(folding, 1.0)
    run(folding)
    assert "MR deformed" in seen(folding._viewer)
    assert not grid.visible
    folding.outputs = ("image", "grid")
    run(folding)
    assert grid.visible


def test_folds_are_asked_for_where_there_are_none(widget, small_sample, run, wait_for):
    small_sample(widget._viewer)
    pull(widget, 1.0)
    run(widget)
    widget.outputs = (*widget.outputs, "folds")
    assert "Nothing folds" in widget.status


def test_the_boxes_of_a_look_say_which_layers_are_seen(at_hand, run, wait_for):
    person, opened = at_hand
    run(opened("Deform tissue"))
    look = opened("Look at the result")
    wait_for(lambda: look.idle)
    for seen_or_not in (False, True):
        person.viewer.layers["MR arrows"].visible = seen_or_not
        assert look.arrows == seen_or_not


# What Grab and pull says


@pytest.fixture
def folded(pulling, settle):
    """Somebody who has pushed tissue through itself."""
    person, widget = pulling
    widget.drawing = Drawing().with_mark(Arrow((30, 20), (0, 30), 4))
    settle(widget)
    assert "folds" in widget.warning
    return person, widget


def test_a_warning_of_folds_stays_as_long_as_they_are_seen_and_no_longer(folded, settle):
    _, widget = folded
    widget.clear()
    settle(widget)
    assert (widget.warning, widget.status) == ("", "Removed all; undo brings it back.")
    widget.undo()
    settle(widget)
    assert "folds" in widget.warning
    assert "Took back" in widget.status
    widget.drawing = Drawing().with_mark(Arrow((30, 20), (0, 1), 4))
    settle(widget)
    assert not widget.warning


def test_a_dock_that_is_put_back_says_nothing_of_what_was(folded, settle, at_rest):
    person, widget = folded
    widget.tool = "pin"
    window = person.viewer.window
    window.remove_dock_widget(widget.native)
    window.add_dock_widget(widget.native, name="Grab and pull")
    at_rest()
    assert (widget.warning, widget.status) == ("", START)
    assert not any(button.native.isChecked() for button in widget.form.tools.values())
    assert widget.start()
    settle(widget)
    assert "folds" in widget.warning, "it does again"


def test_beside_a_warning_it_is_said_what_was_done(folded, settle):
    person, widget = folded
    person.press(50, 30)
    person.move(52, 30)
    person.key(Qt.Key.Key_Escape)
    settle(widget)
    assert "Cancelled" in widget.status
    widget.tool = "pin"
    assert widget.status == "Paint what does not move."
    assert "folds" in widget.warning


def test_what_was_said_is_over_when_the_next_thing_is_done(pulling, settle):
    person, widget = pulling
    person.drag((30, 30), (33, 30))
    person.key(Qt.Key.Key_Z, CTRL)
    settle(widget)
    assert "Took back" in widget.status
    person.drag((30, 30), (33, 30))
    settle(widget)
    assert widget.status.startswith("Drag tissue")
    person.pick(33, 30)
    assert widget.status.startswith("Selected")
    person.key(Qt.Key.Key_Delete)
    settle(widget)
    assert widget.status.startswith("Removed")
    person.drag((30, 30), (33, 30))
    person.pick(33, 30)
    person.key(Qt.Key.Key_Escape)
    assert widget.status.startswith("Drag tissue")


def test_pulling_begins_when_it_is_asked_for_on_an_image(make_napari_viewer, small_sample, at_rest):
    viewer = make_napari_viewer(show=True)
    _, widget = viewer.window.add_plugin_dock_widget("napari-hmrf", "Grab and pull")
    Screen(widget).press("Pull")
    assert "image" in widget.status
    small_sample(viewer)
    at_rest()
    assert not widget.active
    assert not widget.busy
    assert not pictures(viewer)
    assert widget.status == START


# What is painted on


def test_paint_is_put_on_the_image_as_it_was(at_hand, settle, run):
    person, opened = at_hand
    viewer = person.viewer
    puller, deform = opened("Grab and pull"), opened("Deform tissue")
    drag_a_patch(person, puller, settle)
    deform._face.make.native.click()
    assert not any(viewer.layers[name].visible for name in pictures(viewer))
    grab(puller)
    settle(puller)
    assert viewer.layers["MR deformed, elastic"].visible
    deform._face.boundary.table.picked.emit(1)
    assert "hidden meanwhile" in deform.status
    assert not viewer.layers["MR deformed, elastic"].visible


def test_layers_made_to_paint_on_do_not_change_what_is_drawn_on(open_window, settle):
    person, puller = open_window()
    grab(puller)
    person.drag((24, 30), (28, 36))
    settle(puller)
    assert puller.tissue is None
    _, deform = person.viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    deform._face.make.native.click()
    settle(puller)
    assert deform.tissue is person.viewer.layers["Tissue"]
    assert puller.tissue is None, "the background would be tissue all at once"


def test_what_is_drawn_may_change_while_it_is_hidden(at_hand, settle):
    person, opened = at_hand
    viewer = person.viewer
    puller = opened("Grab and pull")
    drag_a_patch(person, puller, settle)
    puller.tool = "move"
    person.paint((20, 20), (24, 26), (30, 30))
    settle(puller)
    drawn = len(viewer.layers["Arrows"].data)
    viewer.layers["Arrows"].visible = False
    puller.drawing = Drawing(puller.drawing.marks[1:])  # napari's own code ran out of lines here
    settle(puller)
    assert len(viewer.layers["Arrows"].data) < drawn
    puller.drawing = Drawing((Arrow((20, 20), (2, 2), 6.0),))
    viewer.layers["Arrows"].visible = True
    settle(puller)
    arrows = viewer.layers["Arrows"]
    assert len(arrows.edge_color) == len(arrows.data)


def test_painting_is_spoken_of_as_long_as_somebody_paints(widget, small_sample, run):
    image, tissue, _ = small_sample(widget._viewer)
    widget.hand_brush(tissue)
    name = next(row.name for row in widget.materials if row.label == tissue.selected_label)
    assert widget.status.startswith(f"Painting '{name}' (label {tissue.selected_label}) in ")
    widget._viewer.layers.selection = {image}
    assert widget.status == "Press Deform."
    run(widget)
    said = widget.status
    widget.hand_brush(tissue)
    widget._viewer.layers.selection = {image}
    assert widget.status == said


def test_nothing_is_said_of_a_point_before_anybody_points(at_hand, run, wait_for):
    person, opened = at_hand
    run(opened("Deform tissue"))
    look = opened("Look at the result")
    wait_for(lambda: look.idle)
    person.viewer.mouse_over_canvas = False
    person.viewer.status = "Brain"
    assert look.point.startswith("Point at the tissue")


def test_words_of_a_result_are_cut_between_lines(at_hand, qtbot):
    _, opened = at_hand
    footer = opened("Deform tissue").footer
    label = footer._status
    room = label.parent().parent().height() - label.y()
    heights = []
    for more in (0, 6):
        footer.say("word\n" * (5 + more) + "word")
        heights.append(label.sizeHint().height())
    six = heights[1] - heights[0]
    assert six <= room < six * 13 / 12


# Whose steps are taken back


def test_a_dock_that_takes_back_what_was_done_in_another_says_so(widget, small_sample, qtbot):
    viewer = widget._viewer
    small_sample(viewer, (48, 64))
    puller = GrabAndPull(viewer)
    qtbot.addWidget(puller.native)
    puller.start()
    puller.drawing = Drawing((Arrow((24, 30), (28, 36), 4.0),))
    widget.footer.steps.undo.native.click()
    assert puller.drawing == Drawing()
    assert widget.status == "Took back: took over a drawing, in 'Grab and pull'."
    assert puller.status == "Took back: took over a drawing."
    widget.redo()
    assert widget.status == "Did again: took over a drawing, in 'Grab and pull'."
    puller.undo()
    assert widget.status.startswith("Did again"), "each dock speaks of what was done there"


def test_a_dock_that_ends_what_was_half_done_in_another_says_so(widget, small_sample):
    small_sample(widget._viewer)

    class Half:
        def interrupt(self):
            return True

    half = Half()
    steps_of(widget._viewer).bind_keys(half)
    widget.undo()
    assert widget.status == "Took back what was half done, in 'Grab and pull'."
