"""Several images in a viewer: each keeps what goes with it, whichever comes, goes or is chosen."""

import numpy as np
import pytest

from napari_hmrf.contributions import phantom_layers, volume_layers
from napari_hmrf.data import head_phantom
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.tissue.drawing import Arrow, Drawing, Stroke
from napari_hmrf.ui.messages import CHOOSE
from tests.support.docks import open_sample, quick
from tests.support.screen import Screen

MARKS = Drawing((Arrow((10, 12), (1, 1), 4.0),))
MARKS_OF_VOLUME = Drawing((Arrow((5, 10, 12), (0, 1, 1), 4.0),))


@pytest.fixture
def viewer(frame):
    return frame.viewer


@pytest.fixture
def widget(frame):
    """A dock beside a viewer in which there is nothing yet."""
    return quick(frame.open())


def brain(viewer, size=32):
    return open_sample(viewer, phantom_layers(phantom("expansion", size)))


def chosen(widget):
    return [widget.image, widget.tissue, widget.boundary]


def test_a_sample_that_comes_leaves_the_one_that_is_drawn_on_its_own(viewer, widget, settle):
    head = open_sample(viewer, volume_layers(head_phantom(24)))
    settle(widget)
    widget.drawing = MARKS_OF_VOLUME
    flat = brain(viewer)
    settle(widget)
    assert (chosen(widget), widget.extent, widget.drawing) == (head, "volume", MARKS_OF_VOLUME)
    widget.image = flat[0]
    settle(widget)
    assert (chosen(widget), widget.extent) == (flat, "slice")
    assert widget.study.grid.shape == (32, 32)
    widget.image = head[0]
    settle(widget)
    assert (chosen(widget), widget.extent, widget.drawing) == (head, "volume", MARKS_OF_VOLUME)
    widget.undo()
    assert (chosen(widget), widget.drawing) == (head, Drawing()), "no choice was a step"


@pytest.mark.parametrize("size", [32, 40])
def test_of_two_samples_each_has_its_own_paint_and_edge(viewer, widget, settle, size):
    first = brain(viewer)
    widget.drawing = MARKS
    widget.boundary = None
    assert widget.hold_edge
    second = brain(viewer, size)
    assert chosen(widget) == [*first[:2], None], "nothing of another sample takes its place"
    for _ in range(2):
        widget.image = second[0]
        settle(widget)
        assert (chosen(widget), widget.hold_edge) == (second, False)
        assert not widget.drawing.marks
        widget.image = first[0]
        settle(widget)
        assert (chosen(widget), widget.hold_edge) == ([*first[:2], None], True)
        assert widget.drawing == MARKS
    widget.undo()
    widget.undo()
    assert chosen(widget) == first


@pytest.mark.parametrize("which", [0, 1])
def test_a_dock_that_is_opened_later_finds_the_paint_of_the_image_in_front(frame, which):
    both = [brain(frame.viewer) for _ in range(2)]
    frame.viewer.layers.selection.active = both[which][0]
    dock = frame.open()
    assert chosen(dock) == both[which]
    dock.image = both[1 - which][0]
    assert chosen(dock) == both[1 - which]


def test_what_lies_elsewhere_goes_with_an_image_that_is_gone(viewer, widget, settle):
    first = brain(viewer)
    viewer.layers.remove(first[0])
    settle(widget)
    assert chosen(widget) == [None, *first[1:]]
    same = viewer.add_image(np.ones((32, 32)), name="same")
    assert chosen(widget) == [same, *first[1:]], "an image that was made anew has its paint"
    widget.drawing = MARKS
    other = viewer.add_image(np.ones((40, 40)), name="other")
    assert widget.image is same
    viewer.layers.remove(same)
    settle(widget)
    assert (chosen(widget), widget.hold_edge) == ([other, None, None], True)
    assert widget.study.grid.shape == (40, 40)


def test_a_layer_that_was_chosen_and_lies_elsewhere_is_refused_with_the_cure(
    viewer, widget, settle
):
    viewer.add_image(np.ones((40, 40)), name="MR")
    widget.boundary = viewer.add_labels(np.ones((32, 32), int), name="wall")
    settle(widget)
    widget.start()
    assert "'wall' lies elsewhere than 'MR'" in widget.status
    assert "----- for none" in widget.status
    widget.boundary = None
    assert widget.start()


@pytest.mark.parametrize("place", [{}, {"translate": (9, 12)}], ids=["whole", "in part"])
def test_an_image_that_somebody_chooses_is_seen(viewer, widget, place):
    image = viewer.add_image(np.ones((20, 24)), name="MR", visible=False)
    over = viewer.add_image(np.ones((64, 48)), name="photo", **place)
    beside = viewer.add_image(np.ones((20, 24)), name="beside", translate=(0, 70))
    through = viewer.add_image(np.ones((20, 24)), name="through", opacity=0.5)
    widget.image = image
    assert [each.visible for each in (image, over, beside, through)] == [True, False, True, True]
    assert widget.status.startswith("Hidden, so that 'MR' is visible: 'photo'. Click the eye")
    widget.image = over
    assert (over.visible, image.visible) == (True, True)
    assert widget.status == widget.invitation


def test_without_an_image_nothing_is_worked_on_and_no_result_is_seen(
    viewer, widget, small_sample, run, settle
):
    image, *paint = small_sample(viewer)
    run(widget)
    settle(widget)
    result = widget.result
    seen = [layer for layer in viewer.layers if layer.visible]
    widget.image = None
    settle(widget)
    assert widget.status.startswith("No image is chosen.")
    assert chosen(widget) == [None] * 3
    assert (result.visible, viewer.layers["MR deformed, paper"].visible) == (False, False)
    assert run(widget) is None
    assert widget.status == CHOOSE
    widget.image = image
    settle(widget)
    assert (chosen(widget), widget.result) == ([image, *paint], result)
    assert [layer for layer in viewer.layers if layer.visible] == seen
    assert widget.solution is not None


def test_the_result_of_an_image_is_seen_while_that_is_chosen(
    viewer, widget, small_sample, run, settle
):
    image, *_ = small_sample(viewer)
    run(widget)
    settle(widget)
    moved = viewer.layers["MR deformed, paper"]
    other = viewer.add_image(np.ones((20, 24)), name="other", translate=(0, 30))
    assert moved.visible
    widget.image = other
    assert not moved.visible
    widget.image = image
    assert moved.visible


def test_tissue_that_a_brush_has_painted_is_measured_and_seen_as_what_it_became(
    viewer, frame, settle
):
    brain(viewer, 64)
    widget = frame.open()
    settle(widget)
    before = {each.name: each for each in widget.more.measure()}
    tumour = next(row.label for row in widget.materials if row.name == "tumour")
    widget.drawing = Drawing((Stroke("tissue", (((30, 16), (30, 20)),), radius=3.0, label=tumour),))
    settle(widget)
    now = {each.name: each for each in widget.more.measure()}
    more = now["tumour"].pixels - before["tumour"].pixels
    assert more > 20
    assert before["normal tissue"].pixels - now["normal tissue"].pixels == more
    widget.overlay = "labels"
    settle(widget)
    (shown,) = (each for each in viewer.layers if each.name == "Tissue deformed, elastic")
    assert (shown.data == tumour).sum() > before["tumour"].pixels


def test_what_is_undone_on_another_image_is_seen(viewer, widget, settle):
    first, second = brain(viewer), brain(viewer)
    widget.image = first[0]
    settle(widget)
    widget.drawing = MARKS
    settle(widget)
    widget.image = second[0]
    settle(widget)
    widget.undo()
    settle(widget)
    assert widget.image is first[0]
    assert first[0].visible
    assert not second[0].visible
    assert widget.status.startswith(f"Undid on '{first[0].name}': replaced the drawing.")


def test_layers_to_paint_on_are_called_by_the_names_they_have(viewer, widget):
    brain(viewer)
    viewer.add_image(np.ones((20, 24)), name="photo", translate=(0, 300))
    widget.image = viewer.layers["photo"]
    Screen(widget).press("Layers to paint on")
    assert widget.status.startswith("Paint in 'Tissue [1]' and 'Boundary [1]': click a row")


def test_what_is_drawn_is_seen_again_when_its_image_is_chosen_again(viewer, widget, settle):
    image, *_ = brain(viewer)
    settle(widget)
    widget.start()
    widget.drawing = MARKS
    settle(widget)
    drawn = viewer.layers["Motion"].data
    widget.image = None
    settle(widget)
    assert "Motion" not in viewer.layers
    widget.image = image
    settle(widget)
    np.testing.assert_array_equal(viewer.layers["Motion"].data, drawn)
    assert not widget.active
    assert widget.status.startswith("To continue drawing, press a tool")


@pytest.mark.parametrize("sample", [False, True])
def test_an_image_that_is_opened_is_chosen_until_work_has_begun(viewer, widget, settle, sample):
    def another():
        return brain(viewer)[0] if sample else viewer.add_image(np.ones((20, 24)), name="photo")

    for _ in range(2):
        newest = another()
        settle(widget)
        assert widget.image is newest
    widget.plane = "strain"
    assert widget.image is newest
    later = another()
    later.opacity = 0.5
    settle(widget)
    assert widget.image is newest
    later = viewer.add_image(np.ones((20, 24)), name="later", translate=(0, 300))
    assert widget.status.startswith("'later' was not chosen, because another image is in use")
    widget.image = later
    settle(widget)
    assert widget.image is later


def test_an_image_that_is_chosen_and_lies_elsewhere_is_gone_to(viewer, widget, settle):
    near = viewer.add_image(np.ones((20, 24)), name="near")
    far = viewer.add_image(np.ones((20, 24)), name="far", translate=(0, 300))
    widget.image = near
    camera_of(viewer).zoom = 10
    camera_of(viewer).center = (0, 12, 11)
    widget.image = far
    assert camera_of(viewer).center[-1] == pytest.approx((far.extent.world[1, 1]) / 2, abs=1)
    camera_of(viewer).zoom = 10
    camera_of(viewer).center = (0, 12, 311)
    widget.image = near
    camera_of(viewer).zoom = 10
    camera_of(viewer).center = (0, 4, 4)
    widget.image = None
    widget.image = near
    assert camera_of(viewer).zoom == 10, "what is seen already stays as it is"
    settle(widget)


def test_what_is_painted_on_a_second_image_is_seen_above_it(viewer, widget, settle):
    first = brain(viewer)
    widget.drawing = MARKS
    settle(widget)
    second = brain(viewer, 40)
    widget.image = second[0]
    strokes = (Stroke("pin", (((20, 20),),), 4.0), Stroke("confidence", (((20, 20),),), 6.0))
    widget.drawing = Drawing((*MARKS.marks, *strokes))
    settle(widget)
    names = [layer.name for layer in viewer.layers]
    painted = [at for at, name in enumerate(names) if name.startswith(("Motion, p", "Confidence"))]
    assert len(painted) == 2
    assert min(painted) > viewer.layers.index(second[0]) > viewer.layers.index(first[0])
