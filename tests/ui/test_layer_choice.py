"""What the widget makes of the layers around it: the chosen, its own, and those that fail."""

import dask.array as da
import numpy as np
import pytest
from napari.layers import Labels, Layer

from napari_hmrf.contributions import volume_layers
from napari_hmrf.data import head_phantom
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.study.ground import build_problem
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.ui.messages import CHOOSE
from tests.support.docks import viewer_of
from tests.support.screen import Screen


class Breakable:
    """An array whose reader breaks, as only it knows how."""

    ndim = 2

    def __init__(self, data):
        self.data, self.shape, self.dtype = data, data.shape, data.dtype
        self.broken = False

    def __getitem__(self, key):
        if self.broken:
            raise AssertionError("block 7 is corrupt.")
        return self.data[key]

    def __array__(self, dtype=None, copy=None):
        return self[:]


# Confidence


@pytest.mark.parametrize("shown", [False, True], ids=["hidden", "shown"])
def test_the_confidence_counts_whether_or_not_the_dock_is_on_screen(widget, small_sample, shown):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.native.setVisible(shown)
    widget.boundary = viewer.add_vectors(np.array([[(5, 3), (0, 0)], [(5, 20), (0, 2)]], float))
    widget.confidence = viewer.add_image(np.full((20, 24), 0.5), name="sure")
    c = build_problem(widget.study).problem.confidence
    assert set(np.unique(c)) == {0.0, 0.5}
    widget.boundary = viewer.layers["Boundary"]
    assert build_problem(widget.study).problem.confidence.max() == 1, "of paint it says nothing"


# Which image


def test_no_image_stays_no_image_whatever_is_added(widget, small_sample, run):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.image = None
    for _ in range(2):
        assert run(widget) is None
        assert widget.image is None
        assert widget.status == CHOOSE
    viewer.add_image(np.zeros((20, 24)), name="another")
    assert widget.image is None


def test_no_image_chosen_in_the_menu_is_a_choice_too(widget, small_sample):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget._form.image.value = None
    viewer.add_image(np.zeros((20, 24)), name="another")
    assert widget.image is None


def test_the_image_in_front_is_chosen_until_somebody_chooses(widget):
    viewer = viewer_of(widget)
    viewer.add_labels(np.ones((20, 24), int))
    first = viewer.add_image(np.zeros((20, 24)), name="first")
    assert widget.image is first
    second = viewer.add_image(np.zeros((20, 24)), name="second")
    assert widget.image is second
    widget.image = first
    viewer.add_image(np.zeros((20, 24)), name="third")
    assert widget.image is first


def test_in_place_of_an_image_that_is_gone_comes_the_next(widget):
    viewer = viewer_of(widget)
    first = viewer.add_image(np.zeros((20, 24)), name="first")
    assert widget.image is first
    viewer.layers.remove(first)
    assert widget.image is None
    second = viewer.add_image(np.zeros((20, 24)), name="second")
    third = viewer.add_image(np.zeros((20, 24)), name="third")
    widget.image = second
    viewer.layers.remove(second)
    assert widget.image is third


def test_a_result_of_before_is_not_taken_for_an_image(widget):
    viewer = viewer_of(widget)
    viewer.add_image(np.zeros((20, 24)), metadata={METADATA: {"kind": "magnitude"}})
    assert widget.image is None
    mine = viewer.add_image(np.zeros((20, 24)))
    assert widget.image is mine


# Units


@pytest.mark.parametrize("unit", ["mm", "um"])
def test_the_motion_is_as_long_as_the_table_says_whatever_the_units(widget, small_sample, unit):
    """3 mm of motion on pixels of 0.5 x 2 mm, whichever unit the boundary layer counts in."""
    viewer = viewer_of(widget)
    small_sample(viewer, scale=(0.5, 2.0), units=("mm", "mm"))
    factor = {"mm": 1, "um": 1000}[unit]
    viewer.layers["Boundary"].scale = (0.5 * factor, 2.0 * factor)
    viewer.layers["Boundary"].units = (unit, unit)
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(1.0, 3.0)))
    problem = build_problem(widget.study).problem
    np.testing.assert_allclose(problem.observed[10, -3] / problem.spacing, (2, 1.5))


# Layers that cannot be read


def broken_labels(widget, small_sample):
    small_sample(viewer_of(widget))
    old = viewer_of(widget).layers["Boundary"]
    data = Breakable(np.array(old.data))
    lazy = Labels(da.from_array(old.data), name="lazy", metadata=old.metadata)
    widget.boundary = viewer_of(widget).add_layer(lazy)
    lazy._data = data  # behind napari's back: it draws from what it has read
    return data


def test_a_layer_that_breaks_while_painting_is_named_and_nothing_is_raised(
    widget, small_sample, wait_for
):
    data = broken_labels(widget, small_sample)
    widget.live = True
    data.broken = True
    widget.schedule_refresh()
    before = widget.rules
    widget._form.motion.boundary.table.refresh()
    assert widget.rules == before
    widget.boundary.events.data()
    wait_for(lambda: "could not be read: block 7 is corrupt. Check" in widget.status)
    assert "'lazy'" in widget.status


def test_a_field_that_cannot_be_found_for_any_reason_is_told(
    widget, small_sample, wait_for, monkeypatch
):
    small_sample(viewer_of(widget))
    widget.live = True

    def fail(*_, **__):
        raise ZeroDivisionError("no such arrow")

    monkeypatch.setattr("napari_hmrf.study.ground.boundary_images", fail)
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(1.0, 0.0)))
    wait_for(lambda: "no such arrow" in widget.status)


def test_a_layer_that_breaks_during_the_solve_does_not_cost_the_result(
    widget, small_sample, busy_thread, wait_for
):
    data = broken_labels(widget, small_sample)
    said = []
    widget.finished.connect(said.append)
    widget.deform()
    data.broken = True
    busy_thread.set()
    wait_for(lambda: bool(said))
    assert said[0] is not None
    widget.boundary.events.data()
    wait_for(lambda: "'lazy' could not be read" in widget.status)
    assert widget.status.endswith("The last result is still shown.")
    assert widget.solution is said[0].solution


def test_whatever_goes_wrong_in_looking_again_is_told_and_the_result_stays(
    widget, small_sample, run, wait_for, monkeypatch
):
    small_sample(viewer_of(widget))
    outputs = run(widget)

    def fail(*_, **__):
        raise ZeroDivisionError("no such slice")

    with monkeypatch.context() as broken:
        broken.setattr("napari_hmrf.ui.study_reader.study_from_layers", fail)
        widget.schedule_refresh()
        wait_for(lambda: "no such slice The last result is still shown." in widget.status)
    assert widget.solution is outputs.solution
    widget.schedule_refresh()
    wait_for(lambda: widget.status.startswith("Tissue moved up to"))


def test_nothing_is_said_to_have_changed_if_nothing_has(widget, small_sample, run):
    small_sample(viewer_of(widget))
    outputs = run(widget)
    assert "Changed" not in widget.status
    for made in outputs.layers.values():
        assert made.attributes["metadata"][METADATA]["inputs_changed"] is False


# Results


def test_a_part_that_has_moved_onto_another_is_told_and_marked(widget, small_sample, run, settle):
    """The right part is pushed 6.5 pixels to the left, over 2 pixels of air."""
    _, tissue, boundary = small_sample(viewer_of(widget))
    tissue.data[:, 11:13] = 0
    boundary.data[2:-2, 2:-2] = 1
    boundary.data[2:-2, 13:] = 2
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -6.5)))
    outputs = run(widget)
    assert (
        outputs.overlaps == 16 * 4
    )  # its sites from column 13 come to columns 6.5 and on; up to column 10
    assert "at 64 pixels one part of the tissue has moved onto another" in widget.warning
    Screen(widget).press("⚠  Overlaps at 64 pixels: show where")
    settle(widget)
    (rows, cols) = np.nonzero(viewer_of(widget).layers["MR overlaps, paper"].data)
    assert len(rows) == 64
    assert {*cols} == {7, 8, 9, 10}
    widget.percent = 0
    settle(widget)
    (_, cols) = np.nonzero(viewer_of(widget).layers["MR overlaps, paper"].data)
    assert {*cols} == {7, 8, 9, 10, 13, 14, 15, 16, 17}, "both parts, before they move"
    widget.percent = 100
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -1.0)))
    assert run(widget).overlaps == 0
    assert "onto another" not in widget.warning
    settle(widget)
    assert "MR overlaps, paper" not in viewer_of(widget).layers


def test_the_chip_shows_folds_and_then_overlaps_and_then_neither(widget, small_sample, run, settle):
    _, tissue, boundary = small_sample(viewer_of(widget))
    tissue.data[:, 11:13] = 0
    boundary.data[2:-2, 2:-2] = 1
    boundary.data[2:-2, 13:] = 2
    boundary.data[2:-2, 4] = 3
    rules = (BoundaryRule(2, "move", vector=(0.0, -6.5)), BoundaryRule(3, "move", vector=(0, 3)))
    widget.rules = (widget.rules[0], *rules)
    outputs = run(widget)
    words = (
        f"Folds at {outputs.folds} pixels: show where",
        f"Overlaps at {outputs.overlaps} pixels: show where",
        "Hide the overlaps",
    )
    for said, shown in zip(words * 2, ("folds", "overlaps", "nothing") * 2, strict=True):
        Screen(widget).press(f"⚠  {said}")
        settle(widget)
        assert widget.overlay == shown


def test_results_of_an_image_go_with_it_and_the_next_has_its_own(
    widget, small_sample, run, wait_for
):
    viewer = viewer_of(widget)
    image, tissue, _ = small_sample(viewer)
    widget.tissue = tissue
    run(widget)
    first = viewer.layers["MR deformed, paper"]
    viewer.layers.remove(image)
    wait_for(lambda: first not in viewer.layers)
    widget.image = viewer.add_image(image.data, name="MR")
    run(widget)
    assert [layer.name for layer in viewer.layers].count("MR deformed, paper") == 1


@pytest.mark.parametrize("opened", ["before", "after"])
def test_the_sample_of_a_volume_is_deformed_whole(widget, opened):
    viewer = viewer_of(widget)
    made = [Layer.create(*data) for data in volume_layers(head_phantom(24))]
    if opened == "before":
        viewer.add_image(np.ones((8, 9)), name="other")
    for layer in made:
        viewer.add_layer(layer)
    assert (widget.extent, widget.tissue, widget.boundary) == ("volume", *made[1:])
    assert {layer.n_edit_dimensions for layer in made[1:]} == {3}
    assert widget.study.grid.shape == made[0].data.shape
    widget.image = viewer.add_image(np.ones((8, 9)), name="flat")
    assert widget.extent == "slice"


def test_what_is_painted_for_one_image_is_not_taken_over_by_another(widget):
    viewer = viewer_of(widget)
    first = viewer.add_image(np.zeros((20, 24)), name="first")
    widget.make_layers()
    tissue, boundary = widget.tissue, widget.boundary
    second = viewer.add_image(np.ones((20, 24)), name="second")
    widget.image = second
    assert (widget.tissue, widget.boundary) == (None, None)
    widget.image = first
    assert (widget.tissue, widget.boundary) == (tissue, boundary)
