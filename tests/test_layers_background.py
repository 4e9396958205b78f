"""Which part of an image is the air around it."""

import numpy as np
import pytest

from napari_hmrf.layers.edit_history import steps_of
from napari_hmrf.layers.metadata import TISSUE, rows_of
from napari_hmrf.samples.phantoms import sample
from napari_hmrf.tissue.surroundings import (
    air_that_is_tissue,
    background_of,
    between_air_and_tissue,
)
from napari_hmrf.ui.soft_tissue import SoftTissue


def head(dtype=np.float32, low=0.0, high=1.0):
    """A bright disc with a dark hole that does not reach the edge, in noise."""
    row, col = np.indices((60, 80))
    radius = np.hypot(row - 30, col - 40)
    inside = radius < 25
    noise = np.random.default_rng(0).normal(0, 0.05, inside.shape)
    bright = inside & (radius > 6)
    return (low + (high - low) * np.clip(bright + noise, 0, 1)).astype(dtype), inside


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [(np.float32, 0, 1), (np.int16, -1000, 300), (np.uint8, 3, 250)]
)
def test_air_is_the_dark_that_reaches_the_edge(dtype, low, high):
    picture, inside = head(dtype, low, high)
    np.testing.assert_array_equal(background_of(picture), ~inside)


def test_colours_and_holes_in_the_numbers_do_not_matter():
    picture, inside = head()
    np.testing.assert_array_equal(background_of(np.stack([picture] * 3, axis=-1)), ~inside)
    picture[0, :9] = np.nan
    np.testing.assert_array_equal(background_of(picture), ~inside)


def test_fat_beneath_the_skin_is_no_air():
    # A CT in Hounsfield units: air, a rim of fat, organs.
    picture, inside = head(np.int16, -1000, 60)
    row, col = np.indices(inside.shape)
    rim = inside & (np.hypot(row - 30, col - 40) > 18)
    picture[rim] = -100 + picture[rim] % 7
    np.testing.assert_array_equal(background_of(picture), ~inside)
    # Stretched for the screen, as in a PNG, fat is dark as well.
    shown = np.clip((picture.astype(float) + 250) / 2, 0, 255).astype(np.uint8)
    shown[rim] = 70
    np.testing.assert_array_equal(background_of(shown), ~inside)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-1000, 300)])
def test_a_threshold_between_air_and_tissue(low, high):
    picture, inside = head(low=low, high=high)
    picture[np.hypot(*(np.indices(inside.shape) - np.array([30, 40])[:, None, None])) < 7] = high
    threshold = between_air_and_tissue(picture)
    np.testing.assert_array_equal(picture > threshold, inside)
    assert between_air_and_tissue(picture[20:40, 30:50]) is None, "it fills the picture"


def test_the_sample_brain_lies_in_air():
    found = background_of(sample("mass-effect").image)
    void = ~sample("mass-effect").problem.tissue
    assert (found != void).mean() < 0.01


@pytest.mark.parametrize("value", [0.0, 7.0, np.nan])
def test_an_image_of_one_value_has_no_background(value):
    assert not background_of(np.full((5, 6), value)).any()


def test_one_press_of_the_button_is_one_undo(widget, wait_for):
    picture = np.zeros((30, 40), np.uint8)
    picture[8:22, 10:30] = 200
    widget._viewer.add_image(picture, name="CT")
    widget.make_layers()
    tissue, rows = widget.tissue, widget.materials
    tissue.data_setitem((np.array([0]), np.array([0])), 1)
    before = tissue.data.copy()
    assert "Undo at the bottom takes it back" in widget._form.tissue.background.toolTip()
    widget.mark_background()
    (void,) = set(widget.materials) - set(rows)
    assert void.stiffness == 0
    assert (tissue.data == void.label).sum() > 500
    assert "background" in steps_of(widget._viewer).undo_tooltip
    tissue.data[1, 1] = 2
    widget.undo()
    before[1, 1] = 2
    wait_for(lambda: not widget._form.tissue.painted._timer.isActive())
    np.testing.assert_array_equal(tissue.data, before, "what was painted since stays")
    assert widget.materials == rows, "and no row comes back for paint that is gone"
    widget.redo()
    wait_for(lambda: not widget._form.tissue.painted._timer.isActive())
    assert widget.materials == (*rows, void)
    assert (tissue.data == void.label).sum() > 500
    assert tissue.data[1, 1] == 2
    widget.undo()
    assert widget.materials == rows
    assert widget.history.edits.edits.next_undo is None


def tissue_rows(layer):
    return rows_of(layer, TISSUE)


@pytest.fixture
def scanned(widget):
    """The dock with a bright block in air, and a layer of tissue to paint on."""
    picture = np.zeros((30, 40), np.uint8)
    picture[8:22, 10:30] = 200
    widget._viewer.add_image(picture, name="CT")
    widget.make_layers()
    return widget


def test_no_tissue_that_was_painted_elsewhere_stays_no_tissue(scanned):
    tissue, rows = scanned.tissue, scanned.materials
    scanned.mark_background()
    (void,) = set(scanned.materials) - set(rows)
    tissue.data_setitem((np.array([15]), np.array([15])), void.label)
    scanned.undo()
    scanned._form.tissue.painted.look()
    assert (tissue.data == void.label).sum() == 1
    assert void in scanned.materials, "its label is still used"
    tissue.data_setitem((np.array([15]), np.array([15])), 0)
    scanned.redo()
    scanned.undo()
    assert scanned.materials == rows
    tissue.data_setitem((np.array([15]), np.array([15])), void.label)
    scanned._form.tissue.painted.look()
    assert void not in scanned.materials, "a tissue of its own by then"
    scanned.redo()
    assert void in scanned.materials


def test_a_background_is_taken_back_whatever_is_chosen_or_closed(scanned):
    tissue, rows = scanned.tissue, scanned.materials
    scanned.mark_background()
    scanned.tissue = scanned._viewer.add_labels(np.ones((30, 40), np.uint8), name="other")
    scanned.undo()
    assert not tissue.data.any()
    scanned.tissue = tissue
    assert scanned.materials == rows
    scanned.redo()
    scanned._on_closed()
    other = SoftTissue(scanned._viewer)
    other.tissue = tissue
    assert other.materials == tissue_rows(tissue) != rows
    other.undo()
    assert not tissue.data.any()
    assert other.materials == tissue_rows(tissue) == rows


def test_a_script_marks_the_background_in_a_closed_dock(scanned):
    tissue, rows = scanned.tissue, scanned.materials
    scanned._on_closed()
    scanned.mark_background()
    (void,) = set(tissue_rows(tissue)) - set(rows)
    assert (tissue.data == void.label).sum() > 500
    scanned.undo()
    assert not tissue.data.any()
    assert tissue_rows(tissue) == rows


@pytest.mark.parametrize("turned", [{"order": (2, 0, 1)}, {"ndisplay": 3}])
def test_a_background_of_a_stack_is_taken_back_though_its_tissue_is_hidden(widget, turned):
    picture = np.zeros((9, 30, 40), np.uint8)
    picture[:, 8:22, 10:30] = 200
    viewer = widget._viewer
    viewer.add_image(picture, name="CT")
    widget.make_layers()
    tissue, rows = widget.tissue, widget.materials
    viewer.dims.set_current_step(0, 4)
    widget.mark_background()
    painted = tissue.data.copy()
    tissue.visible = False
    viewer.dims.update(turned)
    widget.undo()
    assert not tissue.data.any()
    assert widget.materials == rows
    widget.redo()
    np.testing.assert_array_equal(tissue.data, painted)
    assert len(widget.materials) == len(rows) + 1
    tissue.undo()
    assert not tissue.data.any(), "napari has it as a stroke, too"


def test_air_that_was_taken_for_tissue_is_spoken_of():
    picture, inside = head()
    everywhere = np.ones_like(inside)
    assert "dark surroundings" in air_that_is_tissue(picture, everywhere)[0]
    assert air_that_is_tissue(picture, inside) == ()
    assert air_that_is_tissue(picture[20:40, 30:50], everywhere[20:40, 30:50]) == ()
