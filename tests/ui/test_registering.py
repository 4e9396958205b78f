"""Registration of two images in the window, by its buttons."""

import threading

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import Arrow, Drawing, read_study, warp
from napari_hmrf.ui import registering
from tests.support.screen import Screen
from tests.support.timeouts import LONG, LONG_MS

SHAPE = (64, 72)
SIZE = (0.5, 0.5)


def texture(seed, shape=SHAPE):
    image = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2)
    return (255 * (image - image.min()) / np.ptp(image)).astype(np.float32)


def bend(shape=SHAPE, size=1.0):
    place = np.indices(shape) / np.reshape(np.array(shape) - 1, (-1, *(1,) * len(shape)))
    wave = np.prod(np.sin(np.pi * place), axis=0)
    return size * np.stack([wave * (-1) ** axis for axis in range(len(shape))], axis=-1)


def pair_of(shape, size):
    before, truth = texture(0, shape), bend(shape)
    return before, warp(before, truth, spacing=size), truth


@pytest.fixture
def window(frame, wait_for):
    """Return a function that opens two images of one tissue in a dock."""

    def make(shape=SHAPE, **second):
        size = (0.5,) * len(shape)
        before, after, truth = pair_of(shape, size)
        viewer, dock = frame.viewer, frame.open()
        place = {"scale": size, "units": ("mm",) * len(shape)}
        first = viewer.add_image(before, name="before", **place)
        after = viewer.add_image(after, name="after", visible=False, **{**place, **second})
        dock.image = first
        dock.compare_with = after
        wait_for(lambda: not dock.busy)
        return dock, truth

    return make


def error(dock, truth):
    inside = (slice(6, -6),) * (truth.ndim - 1)
    return np.linalg.norm(dock.solution.displacement - truth, axis=-1)[inside].mean()


def register(dock, wait_for):
    Screen(dock).press("Register")
    wait_for(lambda: not dock.busy and dock.study.motion.measured is not None)
    wait_for(lambda: not dock.busy and dock.solution is not None)


def test_a_press_moves_the_tissue_to_the_second_image(window, wait_for):
    dock, truth = window()
    assert dock.study.motion.hold_edge
    register(dock, wait_for)
    assert error(dock, truth) < 0.1
    assert not dock.study.motion.hold_edge, "a fixed edge would contradict the images"
    assert "outer edge is no longer fixed" in dock.status
    assert "Registered to 'after'. Agreement when registered: " in Screen(dock).words
    dock.undo()
    wait_for(lambda: not dock.busy and dock.solution is None)
    assert dock.study.motion.hold_edge
    assert dock.study.motion.measured is None
    dock.redo()
    wait_for(lambda: not dock.busy and dock.solution is not None)
    Screen(dock).press("Unregister")
    wait_for(lambda: not dock.busy and dock.solution is None)
    assert dock.study.motion.hold_edge, "as before the registration"
    assert "The registration was removed" in dock.status


def test_tissue_without_counterpart_is_shown_corrected_and_saved(frame, wait_for, tmp_path):
    shape = (160, 160)
    before, truth = ndimage.gaussian_filter(texture(3, shape), 2), bend(shape, 2.0)
    far = np.hypot(*(np.indices(shape) - 80))
    after = warp(np.where(far < 16, 0, before), truth, spacing=1)
    viewer, dock = frame.viewer, frame.open()
    dock.image = viewer.add_image(before, name="before", scale=(0.5, 0.5))
    dock.compare_with = viewer.add_image(after, name="after", scale=(0.5, 0.5))
    wait_for(lambda: not dock.busy)
    register(dock, wait_for)
    assert ") was not compared: correct it in the layer" in Screen(dock).words
    shown = viewer.layers["before without counterpart"]
    assert np.allclose(shown.scale, 0.5)
    assert shown.data[80, 80] == 1
    assert shown.data[far > 24].sum() == 0
    first = dock.solution.displacement
    assert dock.tissue is None, "the layer is no tissue"
    shown.data = (far < 40).astype(np.uint8)
    Screen(dock).press("Register again")
    wait_for(lambda: not dock.busy and dock.solution.displacement is not first)
    assert not np.allclose(dock.solution.displacement, first, atol=0.01)
    assert (shown.data == (far < 40)).all()
    path = dock.save_study(tmp_path / "registered")
    viewer.layers.clear()
    dock.open_study(path)
    wait_for(lambda: not dock.busy and dock.solution is not None)
    again = viewer.layers["before without counterpart"]
    assert (again.data == (far < 40)).all()
    assert np.allclose(again.scale, 0.5)


def test_a_registration_has_error_bars(window, wait_for):
    dock, _ = window()
    register(dock, wait_for)
    dock.overlay = "uncertainty"
    wait_for(lambda: not dock.busy and "One more landmark helps most there" in dock.status)


def test_a_pull_corrects_the_registration(window, wait_for):
    dock, truth = window()
    register(dock, wait_for)
    dock.drawing = Drawing((Arrow((32.0, 36.0), (0.0, -2.0), radius=2.0),))
    wait_for(lambda: not dock.busy and dock.solution.displacement[32, 36, 1] < -1.9)
    far = np.linalg.norm(dock.solution.displacement - truth, axis=-1)
    assert far[8:16, 8:16].mean() < 0.1, "tissue far from the pull follows the images as before"


def test_held_tissue_stays_while_the_rest_is_registered(window, wait_for):
    dock, truth = window()
    dock.drawing = Drawing((Arrow((32.0, 36.0), (0.0, 0.0), radius=2.0),))
    wait_for(lambda: not dock.busy)
    register(dock, wait_for)
    assert np.abs(dock.solution.displacement[32, 36]).max() < 1e-3
    far = np.linalg.norm(dock.solution.displacement - truth, axis=-1)
    assert far[8:20, 8:20].mean() < 0.1


def test_a_registration_starts_from_the_elastic_model_that_large_motion_has_replaced(
    window, wait_for
):
    dock, truth = window()
    dock.session.unfold()  # as where an earlier registration has folded
    register(dock, wait_for)
    assert dock.model == "elastic"
    assert error(dock, truth) < 0.1
    dock.undo()
    assert dock.model == "large motion"


def test_a_registered_study_is_saved_and_opened_again(window, wait_for, tmp_path):
    dock, truth = window()
    register(dock, wait_for)
    solution = dock.solution
    path = dock.save_study(tmp_path / "registered")
    assert read_study(path).study.motion.measured is not None
    viewer = dock._viewer
    viewer.layers.clear()
    dock.open_study(path)
    wait_for(lambda: not dock.busy and dock.solution is not None)
    assert np.array_equal(dock.solution.displacement, solution.displacement)
    assert "Registered to 'after'" in Screen(dock).words
    assert not Screen(dock).button("Unregister").parent().isHidden()
    assert dock.compare_with.name == "after"
    register(dock, wait_for)
    assert error(dock, truth) < 0.1, "the images are compared again"
    Screen(dock).press("Unregister")
    assert dock.study.motion.hold_edge, "as before the first registration"


def test_an_image_on_another_grid_is_registered_by_its_place(window, wait_for):
    _, after, truth = pair_of(SHAPE, SIZE)
    finer = ndimage.zoom(after, 2, order=1, grid_mode=True, mode="nearest")
    dock, _ = window()
    viewer = dock._viewer
    place = {"scale": (0.25, 0.25), "translate": (-0.125, -0.125), "units": ("mm", "mm")}
    dock.compare_with = viewer.add_image(finer, name="finer", visible=False, **place)
    register(dock, wait_for)
    assert error(dock, truth) < 0.15


def test_a_volume_is_registered_over_several_levels(window, wait_for):
    dock, truth = window((24, 28, 50))
    Screen(dock).choose("the whole volume")
    wait_for(lambda: not dock.busy)
    register(dock, wait_for)
    assert error(dock, truth) < 0.2


def test_cancel_stops_a_registration_and_changes_nothing(window, wait_for):
    dock, _ = window((24, 28, 32))
    Screen(dock).choose("the whole volume")
    wait_for(lambda: not dock.busy)
    Screen(dock).press("Register")
    Screen(dock).press("Cancel")
    assert "cancelled" in dock.status
    wait_for(lambda: not dock.busy)
    assert dock.study.motion.measured is None
    assert dock.study.motion.hold_edge


def test_an_edit_waits_for_a_registration_and_names_it_until_cancel(
    window, wait_for, monkeypatch, qtbot
):
    dock, _ = window()
    begun, over = threading.Event(), threading.Event()

    def wait(*_, **__):
        begun.set()
        assert over.wait(LONG)

    monkeypatch.setattr(registering, "register_study", wait)
    Screen(dock).press("Register")
    assert begun.wait(LONG)
    dock.drawing = Drawing((Arrow((32.0, 36.0), (0.0, -2.0), radius=2.0),))
    qtbot.waitUntil(lambda: "waiting for a registration" in dock.status, timeout=LONG_MS)
    Screen(dock).press("Cancel")
    assert "The registration was cancelled" in dock.status
    over.set()
    wait_for(lambda: not dock.busy)
    assert dock.study.motion.measured is None


def test_a_second_image_elsewhere_is_refused(window):
    dock, _ = window(translate=(1000.0, 0.0))
    Screen(dock).press("Register")
    assert "'after' does not cover the image" in dock.status
    assert not dock.busy


def test_a_registration_belongs_to_the_slice_in_which_it_was_started(frame, wait_for):
    before, after, truth = pair_of(SHAPE, SIZE)
    viewer, dock = frame.viewer, frame.open()
    stack = viewer.add_image(np.stack([before, before]), name="before", scale=(1, *SIZE))
    both = np.stack([after, after])
    other = viewer.add_image(both, name="after", visible=False, scale=(1, *SIZE))
    dock.image = stack
    dock.compare_with = other
    wait_for(lambda: not dock.busy)
    viewer.dims.set_current_step(0, 0)
    wait_for(lambda: not dock.busy)
    Screen(dock).press("Register")
    viewer.dims.set_current_step(0, 1)
    wait_for(lambda: not dock.busy)
    assert dock.study.motion.measured is None
    viewer.dims.set_current_step(0, 0)
    wait_for(lambda: not dock.busy and dock.solution is not None)
    assert error(dock, truth) < 0.1


def test_an_aligned_image_moves_to_the_registered_place(window, wait_for):
    pytest.importorskip("SimpleITK")
    before, _, _ = pair_of(SHAPE, SIZE)
    dock, _ = window()
    viewer = dock._viewer
    place = {"scale": SIZE, "units": ("mm", "mm"), "translate": (1.5, -2.0)}
    other = viewer.add_image(ndimage.gaussian_filter(before, 1), name="shifted", **place)
    dock.compare_with = other
    Screen(dock).choose("shift and turn")
    register(dock, wait_for)
    corner = np.asarray(other.data_to_world((0, 0)))
    assert np.abs(corner).max() < 0.4, "the image is where the tissue of the first image is"
    assert np.abs(dock.solution.displacement[8:-8, 8:-8]).max() < 0.5
    assert "'shifted' was moved to fit" in dock.status


def test_cancel_leaves_no_preview(window, wait_for):
    dock, _ = window((24, 28, 50))
    Screen(dock).choose("the whole volume")
    wait_for(lambda: not dock.busy)
    shown = []
    dock._controller.pointer.show, show = shown.append, dock._controller.pointer.show
    Screen(dock).press("Register")
    wait_for(lambda: bool(shown) or not dock.busy)
    for moved in shown:
        show(moved)
    dock._controller.pointer.show = show
    if dock.busy:
        Screen(dock).press("Cancel")
        wait_for(lambda: not dock.busy)
        assert not any("deformed" in layer.name for layer in dock._viewer.layers)


def test_images_that_agree_poorly_are_reported(window, wait_for):
    dock, _ = window()
    noise = np.random.default_rng(5).normal(size=SHAPE)
    dock.compare_with = dock._viewer.add_image(noise, name="other", scale=SIZE, units=("mm", "mm"))
    register(dock, wait_for)
    assert "agree poorly" in Screen(dock).words
