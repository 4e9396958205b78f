"""Tests of tissue that slides along other tissue, in the dock."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Layer

from napari_hmrf import Arrow, Drawing, Material
from napari_hmrf.contributions import phantom_layers
from napari_hmrf.data import chest_phantom
from napari_hmrf.layers.metadata import TISSUE, layer_metadata
from tests.support.screen import Screen
from tests.support.windowless import Touch

ROWS, COLS = np.indices((48, 48)) - 23.5
LUNG = np.hypot(ROWS / 18, COLS / 12) < 1
MATERIALS = Material(1, "muscle", 1.0), Material(2, "lung", 1.0)


@pytest.fixture
def dock(frame, wait_for):
    """Return a dock beside an elliptical lung in muscle, with a fixed edge."""
    viewer, dock = frame.viewer, frame.open()
    viewer.add_image(np.where(LUNG, 0.9, 0.5), name="Chest")
    viewer.add_labels(1 + LUNG, name="Organs", metadata=layer_metadata(TISSUE, MATERIALS))
    dock.image, dock.tissue = viewer.layers["Chest"], viewer.layers["Organs"]
    wait_for(lambda: not dock.busy)
    return dock


def slip(dock):
    """Return how far the side of the lung moves down along the muscle beside it."""
    down = dock.solution.displacement[24, :, 0]
    side = np.flatnonzero(LUNG[24])[-1]
    return down[side - 1] - down[side + 2]


def test_a_lung_that_is_chosen_to_slide_slips_and_is_undone_in_one_step(dock, wait_for):
    screen = Screen(dock)
    dock.drawing = Drawing((Arrow((24, 24), (3, 0), 4),))
    wait_for(lambda: not dock.busy)
    stuck = slip(dock)
    screen.cell("lung", "slides").choose("yes")
    assert dock.materials[1].slides
    wait_for(lambda: not dock.busy)
    assert slip(dock) > 3 * stuck > 0
    dock.undo()
    wait_for(lambda: not dock.busy)
    assert screen.cell("lung", "slides").chosen() == "no"
    assert slip(dock) == pytest.approx(stuck, abs=0.02)


def test_a_lung_that_slides_follows_a_drag(frame, dock, wait_for):
    Screen(dock).cell("lung", "slides").choose("yes")
    wait_for(lambda: not dock.busy)
    Screen(dock).press("Pull")
    wait_for(lambda: not dock.busy)
    Touch(frame.viewer, frame).drag((24, 24), (25, 24), (26, 24), (27, 24))
    wait_for(lambda: not dock.busy)
    assert dock.solution.displacement[24, 24, 0] == pytest.approx(3, abs=0.3)
    assert slip(dock) > 1


def test_other_models_name_the_tissue_that_slides(dock, wait_for):
    dock.drawing = Drawing((Arrow((24, 24), (3, 0), 4),))
    Screen(dock).cell("lung", "slides").choose("yes")
    dock.model = "paper"
    wait_for(lambda: not dock.busy)
    assert "'Organs' has tissue that slides along other tissue ('lung')" in dock.status


def test_large_motion_of_sliding_tissue_is_offered_for_its_folds(dock, wait_for):
    offer, dock.unfolds = dock._form.footer.other, False
    dock.drawing = Drawing((Arrow((20, 24), (9, 0), 2), Arrow((30, 24), (-9, 0), 2)))
    wait_for(lambda: not dock.busy)
    assert "the tissue folds" in dock.warning
    assert not offer.isHidden()
    Screen(dock).cell("lung", "slides").choose("yes")
    wait_for(lambda: not dock.busy)
    assert dock.solution.parts is not None
    assert "the tissue folds" in dock.warning
    assert not offer.isHidden()
    dock.settings, dock.model = replace(dock.settings, budget=20.0), "large motion"
    wait_for(lambda: not dock.busy)
    assert dock.solution.parts is not None
    assert dock.solution.reach.least_jacobian > 0
    assert "the tissue folds" not in dock.warning


def test_the_breath_of_the_sample_shows_neither_a_warning_nor_folds(frame, wait_for):
    dock = frame.open()
    for data in phantom_layers(chest_phantom(128)):
        frame.viewer.add_layer(Layer.create(*data))
    dock.deform()
    wait_for(lambda: not dock.busy and dock.solution is not None)
    assert not dock.warning
    assert dock.solution.parts is not None
    dock.overlay = "folds"
    wait_for(lambda: not dock.busy)
    assert dock.status == "The tissue does not fold, and no part of it has moved onto another part."
