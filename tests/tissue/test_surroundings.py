"""Tests of the background of an image: the air around the tissue."""

import numpy as np
import pytest

from napari_hmrf import Grid, Study, Tissue
from napari_hmrf.samples.phantoms import sample
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.study import Pictures
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.surroundings import (
    air_that_is_tissue,
    background_of,
    void_threshold,
)
from tests.support.screen import Screen


def head(dtype=np.float32, low=0.0, high=1.0):
    """Return a noisy picture of a bright disc with a dark hole, and the mask of the disc."""
    row, col = np.indices((60, 80))
    radius = np.hypot(row - 30, col - 40)
    inside = radius < 25
    noise = np.random.default_rng(0).normal(0, 0.05, inside.shape)
    bright = inside & (radius > 6)
    return (low + (high - low) * np.clip(bright + noise, 0, 1)).astype(dtype), inside


@pytest.mark.parametrize(
    ("dtype", "low", "high"), [(np.float32, 0, 1), (np.int16, -1000, 300), (np.uint8, 3, 250)]
)
def test_background_is_the_dark_region_connected_to_the_image_edge(dtype, low, high):
    picture, inside = head(dtype, low, high)
    np.testing.assert_array_equal(background_of(picture), ~inside)


def test_colours_and_nan_pixels_do_not_change_the_background():
    picture, inside = head()
    np.testing.assert_array_equal(background_of(np.stack([picture] * 3, axis=-1)), ~inside)
    picture[0, :9] = np.nan
    np.testing.assert_array_equal(background_of(picture), ~inside)


def test_fat_beneath_the_skin_is_not_background():
    # A CT in Hounsfield units: air, a rim of fat, organs.
    picture, inside = head(np.int16, -1000, 60)
    row, col = np.indices(inside.shape)
    rim = inside & (np.hypot(row - 30, col - 40) > 18)
    picture[rim] = -100 + picture[rim] % 7
    np.testing.assert_array_equal(background_of(picture), ~inside)
    # In a PNG with a narrow window, fat is dark as well.
    shown = np.clip((picture.astype(float) + 250) / 2, 0, 255).astype(np.uint8)
    for grey in (60, 70):
        shown[rim] = grey
        np.testing.assert_array_equal(background_of(shown), ~inside)


@pytest.mark.parametrize("padding", [-1024, -2000, -3024])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_padding_below_the_air_of_a_ct_is_background_together_with_the_air(padding, dtype):
    picture, inside = head(dtype, -1000, 60)
    row, col = np.indices(inside.shape)
    picture[np.hypot(row - 30, col - 40) > 29] = padding
    np.testing.assert_array_equal(background_of(picture), ~inside)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-1000, 300)])
def test_the_void_threshold_separates_air_from_tissue(low, high):
    picture, inside = head(low=low, high=high)
    picture[np.hypot(*(np.indices(inside.shape) - np.array([30, 40])[:, None, None])) < 7] = high
    threshold = void_threshold(picture)
    assert (picture > threshold)[inside].all()
    assert (picture > threshold)[~inside].mean() < 0.02
    assert void_threshold(picture[20:40, 30:50]) is None, "a threshold for a picture without air"
    volume = np.stack([np.full_like(picture, low), *(3 * [picture]), np.full_like(picture, low)])
    assert low < void_threshold(volume) < high, "a volume was read as a colour picture"


def test_the_background_of_the_sample_brain_is_its_void():
    found = background_of(sample("mass-effect").image)
    void = ~sample("mass-effect").problem.tissue
    assert (found != void).mean() < 0.01


@pytest.mark.parametrize("value", [0.0, 7.0, np.nan])
def test_an_image_of_one_value_has_no_background(value):
    assert not background_of(np.full((5, 6), value)).any()


# Void surroundings


def air_and_block(inside=False):
    """Return a picture of a bright block in dark air, optionally with a dark hole, and its mask."""
    picture = np.zeros((30, 40), np.uint8)
    picture[8:22, 10:30] = 200
    if inside:
        picture[13:16, 18:22] = 0
    return picture, picture > 0


def of_labels(labels, without_border=True, picture=None):
    """Return a study with labels painted on the block in air."""
    return Study(
        Grid(labels.shape, (1.0, 1.0)),
        Tissue(
            labels=labels,
            materials=(Material(0, "everything unpainted", 20.0), Material(2, "fat", 5.0)),
            without_border=without_border,
        ),
        pictures=Pictures(image=air_and_block()[0] if picture is None else picture),
    )


def test_the_unpainted_dark_border_is_void_unless_the_option_is_off():
    block = air_and_block()[1]
    unpainted = np.zeros(block.shape, np.uint8)
    np.testing.assert_array_equal(Ground.of(of_labels(unpainted)).stiffness, 20.0 * block)
    assert (Ground.of(of_labels(unpainted, without_border=False)).stiffness == 20).all()


def test_painted_dark_pixels_are_tissue():
    painted = np.zeros((30, 40), np.uint8)
    painted[:3, :3] = 2
    found = Ground.of(of_labels(painted)).stiffness
    assert (found[:3, :3] == 5).all()
    assert not found[:3, 3:].any()


def test_dark_pixels_inside_the_tissue_are_tissue():
    picture, _ = air_and_block(inside=True)
    found = Ground.of(of_labels(np.zeros((30, 40), np.uint8), picture=picture)).stiffness
    assert (found[13:16, 18:22] == 20).all()
    assert not found[0].any()


def test_a_photograph_with_shadows_at_its_edge_is_tissue_everywhere():
    picture = np.full((30, 40), 200, np.uint8)
    picture[:10, :12] = 0
    found = Ground.of(of_labels(np.zeros((30, 40), np.uint8), picture=picture)).stiffness
    assert (found == 20).all()


@pytest.fixture
def scanned(widget):
    """Return the dock with a bright block in air; painted boundary labels push the block."""
    widget._viewer.add_image(air_and_block()[0], name="CT")
    widget.make_layers()
    widget.boundary.data[8:22, 10] = 1
    widget.boundary.data[8:22, 29] = 3
    widget.rules = (*widget.rules, BoundaryRule(3, "move", vector=(0.0, 2.0)))
    return widget


def test_air_around_the_image_moves_only_if_the_option_is_off(scanned, run):
    block = air_and_block()[1]
    moved = run(scanned).solution
    np.testing.assert_array_equal(moved.tissue, block)
    assert "dark surroundings" not in scanned.warning
    Screen(scanned).tick("Ignore dark background", on=False)
    assert not scanned.without_border
    moved = run(scanned).solution
    assert moved.tissue.all()
    assert "The dark surroundings of the image move like tissue" in scanned.warning
    scanned.without_border = True
    np.testing.assert_array_equal(run(scanned).solution.tissue, block)


def test_live_mode_applies_a_change_of_the_air_option(scanned, settle):
    scanned.live = True
    settle(scanned)
    assert not scanned.solution.tissue[0, 0]
    scanned.without_border = False
    settle(scanned)
    assert scanned.solution.tissue[0, 0]


def test_paint_in_the_air_makes_tissue_and_undo_removes_the_tissue(scanned, settle):
    scanned.live = True
    settle(scanned)
    tissue = scanned.tissue
    tissue.data_setitem((np.array([8, 8]), np.array([30, 31])), 1)
    settle(scanned)
    assert scanned.solution.tissue[8, 30:32].all()
    tissue.undo()
    settle(scanned)
    assert not scanned.solution.tissue[8, 30:32].any()


def test_each_image_has_its_own_air_option(scanned):
    first = scanned.image
    scanned.without_border = False
    scanned.image = scanned._viewer.add_image(np.ones((12, 14)), name="gel")
    assert scanned.without_border
    scanned.image = first
    assert not scanned.without_border


def test_each_slice_has_its_own_air(widget, run):
    picture = np.zeros((9, 30, 40), np.uint8)
    picture[:, 8:22, 10:30] = 200
    picture[6, 4:26, 5:35] = 200
    viewer = widget._viewer
    viewer.add_image(picture, name="CT")
    widget.make_layers()
    widget.boundary.data[:, 8:22, 10] = 1
    for at in (4, 6):
        viewer.dims.set_current_step(0, at)
        found = run(widget).solution
        np.testing.assert_array_equal(found.tissue, picture[at] > 0)


def test_a_warning_reports_air_that_moves_like_tissue():
    picture, inside = head()
    everywhere = np.ones_like(inside)
    assert "dark surroundings" in air_that_is_tissue(picture, everywhere)
    assert air_that_is_tissue(picture, inside) == ""
    assert air_that_is_tissue(picture[20:40, 30:50], everywhere[20:40, 30:50]) == ""
