"""Tests of the layers that the dock selects, and of layers that cannot be read."""

import dask.array as da
import numpy as np
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
    """Array whose reader raises an error on request."""

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


def test_the_confidence_is_applied_if_the_dock_is_hidden(widget, small_sample):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.boundary = viewer.add_vectors(np.array([[(5, 3), (0, 0)], [(5, 20), (0, 2)]], float))
    widget.confidence = viewer.add_image(np.full((20, 24), 0.5), name="sure")
    c = build_problem(widget.study).problem.confidence
    assert set(np.unique(c)) == {0.0, 0.5}
    widget.boundary = viewer.layers["Boundary"]
    assert build_problem(widget.study).problem.confidence.max() == 1, (
        "the confidence was applied to a painted boundary"
    )


# The image


def test_no_image_remains_selected_after_another_image_is_added(widget, small_sample, run):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.image = None
    for _ in range(2):
        assert run(widget) is None
        assert widget.image is None
        assert widget.status == CHOOSE
    viewer.add_image(np.zeros((20, 24)), name="another")
    assert widget.image is None


def test_tissue_alone_is_not_deformed_after_its_image_is_removed(widget, small_sample, run):
    viewer = viewer_of(widget)
    image, tissue, _ = small_sample(viewer)
    assert run(widget) is not None
    viewer.layers.remove(image)
    assert (widget.image, widget.tissue) == (None, tissue)
    assert run(widget) is None
    assert widget.status == CHOOSE


def test_a_removed_image_is_replaced_by_the_next_image(widget):
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


def test_an_earlier_result_is_not_selected_as_an_image(widget):
    viewer = viewer_of(widget)
    viewer.add_image(np.zeros((20, 24)), metadata={METADATA: {"kind": "magnitude"}})
    assert widget.image is None
    mine = viewer.add_image(np.zeros((20, 24)))
    assert widget.image is mine


# Units


def test_the_length_of_a_motion_does_not_depend_on_the_unit_of_the_boundary(widget, small_sample):
    """Move pixels of 0.5 x 2 mm by 3 mm, with a boundary layer in um."""
    viewer = viewer_of(widget)
    small_sample(viewer, scale=(0.5, 2.0), units=("mm", "mm"))
    viewer.layers["Boundary"].scale = (500.0, 2000.0)
    viewer.layers["Boundary"].units = ("um", "um")
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
    lazy._data = data  # Without an event, because napari draws from data that it has already read.
    return data


def test_an_error_in_a_layer_during_painting_is_reported_by_name(widget, small_sample, wait_for):
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


def test_an_error_in_a_layer_during_the_solve_does_not_discard_the_result(
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


def test_an_unexpected_error_during_a_refresh_is_reported_and_the_result_remains(
    widget, small_sample, run, wait_for, monkeypatch
):
    small_sample(viewer_of(widget))
    outputs = run(widget)

    def fail(*_, **__):
        raise ZeroDivisionError("no such slice")

    with monkeypatch.context() as broken:
        broken.setattr("napari_hmrf.layers.read.study_from_layers", fail)
        widget.schedule_refresh()
        wait_for(lambda: "no such slice The last result is still shown." in widget.status)
    assert widget.solution is outputs.solution
    widget.schedule_refresh()
    wait_for(lambda: widget.status.startswith("Tissue moved up to"))


# Results


def test_overlapping_tissue_is_reported_and_marked(widget, small_sample, run, settle):
    """Push the right part to the left by 6.5 pixels, across 2 pixels of air."""
    _, tissue, boundary = small_sample(viewer_of(widget))
    tissue.data[:, 11:13] = 0
    boundary.data[2:-2, 2:-2] = 1
    boundary.data[2:-2, 13:] = 2
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -6.5)))
    outputs = run(widget)
    assert (
        outputs.overlaps == 16 * 4
    )  # Sites from column 13 move to column 6.5, and cover sites up to column 10.
    assert "at 64 pixels one part of the tissue has moved onto another" in widget.warning
    Screen(widget).press("⚠  64 overlaps: show")
    settle(widget)
    (rows, cols) = np.nonzero(viewer_of(widget).layers["MR folds, paper"].data)
    assert len(rows) == 64
    assert {*cols} == {7, 8, 9, 10}
    widget.percent = 0
    settle(widget)
    (_, cols) = np.nonzero(viewer_of(widget).layers["MR folds, paper"].data)
    assert {*cols} == {7, 8, 9, 10, 13, 14, 15, 16, 17}, (
        "the marks before the motion do not show both parts"
    )
    widget.percent = 100
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -1.0)))
    assert run(widget).overlaps == 0
    assert "onto another" not in widget.warning
    settle(widget)
    assert "MR folds, paper" not in viewer_of(widget).layers


def test_the_warning_button_shows_folds_and_overlaps_together_and_then_neither(
    widget, small_sample, run, settle
):
    _, tissue, boundary = small_sample(viewer_of(widget))
    tissue.data[:, 11:13] = 0
    boundary.data[2:-2, 2:-2] = 1
    boundary.data[2:-2, 13:] = 2
    boundary.data[2:-2, 4] = 3
    rules = (BoundaryRule(2, "move", vector=(0.0, -6.5)), BoundaryRule(3, "move", vector=(0, 3)))
    widget.rules = (widget.rules[0], *rules)
    outputs = run(widget)
    words = f"{outputs.folds} folds: show", "Hide the folds"
    for said, shown in zip(words * 2, ("folds", "nothing") * 2, strict=True):
        Screen(widget).press(f"⚠  {said}")
        settle(widget)
        assert widget.overlay == shown


def test_results_are_removed_with_their_image_and_a_new_image_has_its_own(
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
    widget.model = "paper"
    run(widget)
    assert [layer.name for layer in viewer.layers].count("MR deformed, paper") == 1


def test_the_sample_of_a_volume_is_deformed_as_a_whole(widget):
    viewer = viewer_of(widget)
    made = [Layer.create(*data) for data in volume_layers(head_phantom(24))]
    viewer.add_image(np.ones((8, 9)), name="other")
    for layer in made:
        viewer.add_layer(layer)
    assert (widget.extent, widget.tissue, widget.boundary) == ("volume", *made[1:])
    assert {layer.n_edit_dimensions for layer in made[1:]} == {3}
    assert widget.study.grid.shape == made[0].data.shape
    widget.image = viewer.add_image(np.ones((8, 9)), name="flat")
    assert widget.extent == "slice"
