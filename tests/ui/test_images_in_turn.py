"""Tests of several images in one viewer, each with its own layers, settings and drawing."""

import numpy as np
import pytest

from napari_hmrf.contributions import phantom_layers, volume_layers
from napari_hmrf.data import head_phantom
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.metadata import TISSUE, layer_metadata
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.study.ground import build_problem
from napari_hmrf.tissue.boundary_rules import Material, default_rigid
from napari_hmrf.tissue.drawing import Arrow, Drawing, Stroke
from napari_hmrf.tissue.material_presets import PLAIN, Palette
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
    """Return a dock beside an empty viewer."""
    return quick(frame.open())


def brain(viewer, size=32):
    return open_sample(viewer, phantom_layers(phantom("expansion", size)))


def chosen_layers(widget):
    return [widget.image, widget.tissue, widget.boundary]


def test_a_new_sample_does_not_replace_the_sample_with_a_drawing(viewer, widget, settle):
    head = open_sample(viewer, volume_layers(head_phantom(24)))
    settle(widget)
    widget.drawing = MARKS_OF_VOLUME
    flat = brain(viewer)
    settle(widget)
    assert (chosen_layers(widget), widget.extent, widget.drawing) == (
        head,
        "volume",
        MARKS_OF_VOLUME,
    )
    widget.image = flat[0]
    settle(widget)
    assert (chosen_layers(widget), widget.extent) == (flat, "slice")
    assert widget.study.grid.shape == (32, 32)
    widget.image = head[0]
    settle(widget)
    assert (chosen_layers(widget), widget.extent, widget.drawing) == (
        head,
        "volume",
        MARKS_OF_VOLUME,
    )
    widget.undo()
    assert (chosen_layers(widget), widget.drawing) == (head, Drawing()), (
        "the choice of an image added an undo step"
    )


def test_each_of_two_samples_has_its_own_paint_and_edge(viewer, widget, settle):
    first = brain(viewer)
    widget.drawing = MARKS
    widget.boundary = None
    assert widget.hold_edge
    second = brain(viewer)
    settle(widget)
    assert (chosen_layers(widget), widget.hold_edge) == (second, False)
    assert not widget.drawing.marks
    widget.image = first[0]
    settle(widget)
    assert (chosen_layers(widget), widget.hold_edge) == ([*first[:2], None], True)
    assert widget.drawing == MARKS
    widget.undo()
    widget.undo()
    assert chosen_layers(widget) == first


def test_layers_of_another_place_are_deselected_when_their_image_is_removed(viewer, widget, settle):
    first = brain(viewer)
    viewer.layers.remove(first[0])
    settle(widget)
    assert chosen_layers(widget) == [None, *first[1:]]
    same = viewer.add_image(np.ones((32, 32)), name="same")
    assert chosen_layers(widget) == [same, *first[1:]], (
        "the paint was not selected for an equal new image"
    )
    widget.drawing = MARKS
    other = viewer.add_image(np.ones((40, 40)), name="other", visible=False)
    assert widget.image is same
    viewer.layers.remove(same)
    settle(widget)
    assert (chosen_layers(widget), widget.hold_edge) == ([other, None, None], True)
    assert widget.study.grid.shape == (40, 40)


def test_a_chosen_layer_at_another_place_is_refused_with_a_hint(viewer, widget, settle):
    viewer.add_image(np.ones((40, 40)), name="MR")
    widget.boundary = viewer.add_labels(np.ones((32, 32), int), name="wall")
    settle(widget)
    widget.start()
    assert "'wall' is not on the grid of 'MR'" in widget.status
    assert "----- for no layer" in widget.status
    widget.boundary = None
    assert widget.start()


def test_a_chosen_image_is_made_visible(viewer, widget):
    image = viewer.add_image(np.ones((20, 24)), name="MR", visible=False)
    over = viewer.add_image(np.ones((64, 48)), name="photo", translate=(9, 12))
    beside = viewer.add_image(np.ones((20, 24)), name="beside", translate=(0, 70))
    through = viewer.add_image(np.ones((20, 24)), name="through", opacity=0.5)
    widget.image = image
    assert [each.visible for each in (image, over, beside, through)] == [True, False, True, True]
    assert widget.status.startswith("Hidden to make 'MR' visible: 'photo'. Click the eye")
    widget.image = over
    assert (over.visible, image.visible) == (True, True)
    assert widget.status == widget.invitation


def test_without_an_image_no_result_is_solved_or_shown(viewer, widget, small_sample, run, settle):
    image, *paint = small_sample(viewer)
    run(widget)
    settle(widget)
    result = widget.result
    seen = [layer for layer in viewer.layers if layer.visible]
    widget.image = None
    settle(widget)
    assert widget.status.startswith("No image is chosen.")
    assert chosen_layers(widget) == [None] * 3
    assert (result.visible, viewer.layers["MR deformed, paper"].visible) == (False, False)
    assert run(widget) is None
    assert widget.status == CHOOSE
    widget.image = image
    settle(widget)
    assert (chosen_layers(widget), widget.result) == ([image, *paint], result)
    assert [layer for layer in viewer.layers if layer.visible] == seen
    assert widget.solution is not None


def test_the_result_of_an_image_is_visible_only_while_that_image_is_chosen(
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


def test_tissue_painted_with_a_brush_is_measured_and_shown_with_its_new_label(
    viewer, frame, settle
):
    widget = frame.open()
    brain(viewer, 64)
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


def test_undo_on_another_image_shows_that_image(viewer, widget, settle):
    first, second = brain(viewer), brain(viewer)
    widget.image = first[0]
    settle(widget)
    widget.drawing = MARKS
    settle(widget)
    undo = Screen(widget).button("Undo")
    assert undo.toolTip() == "Undo: replaced the drawing (Ctrl+Z)"
    widget.image = second[0]
    settle(widget)
    assert undo.toolTip() == f"Undo on '{first[0].name}': replaced the drawing (Ctrl+Z)"
    widget.undo()
    settle(widget)
    assert widget.image is first[0]
    assert first[0].visible
    assert not second[0].visible
    assert widget.status.startswith(f"Undid on '{first[0].name}': replaced the drawing.")


def test_painted_tissue_stays_the_same_in_a_new_tissue_layer(viewer, widget, settle):
    picture = np.random.default_rng(0).integers(0, 255, (20, 24, 3)).astype(np.uint8)
    widget.image = viewer.add_image(picture, rgb=True, name="photo")
    names = {row.name: row.label for row in Palette.of_preset(PLAIN).materials}
    stiff, bone = (
        Stroke("tissue", (((row, 6.0), (row, 18.0)),), 2.0, label=names[name])
        for row, name in ((5.0, "stiff"), (14.0, default_rigid(9).name))
    )
    widget.model = "elastic"
    widget.drawing = Drawing((stiff, bone, Arrow((10, 12), (0, 2), 2.0)))
    settle(widget)
    before = build_problem(widget.study).problem.stiffness
    Screen(widget).press("New tissue layer")
    settle(widget)
    after = build_problem(widget.study).problem.stiffness
    np.testing.assert_allclose(after, before)
    assert np.isinf(after).any()


def test_painted_tissue_stays_stiffer_or_softer_than_tissue_from_brightness(viewer, widget, settle):
    picture = np.random.default_rng(0).integers(0, 255, (24, 26, 3)).astype(np.uint8)
    widget.image = viewer.add_image(picture, rgb=True, name="photo")
    names = {row.name: row.label for row in Palette.of_preset(PLAIN).materials}
    strokes = {
        name: Stroke("tissue", (((row, 6.0), (row, 20.0)),), 2.0, label=names[name])
        for row, name in ((4.0, "stiff"), (11.0, "soft"), (18.0, default_rigid(9).name))
    }
    widget.model = "elastic"
    widget.drawing = Drawing((*strokes.values(), Arrow((11, 23), (0, 2), 2.0)))
    settle(widget)
    before = build_problem(widget.study).problem.stiffness
    Screen(widget).press("Tissue from brightness")
    settle(widget)
    after = build_problem(widget.study).problem.stiffness
    stiff, soft, bone = (before == value for value in (5, np.float32(0.2), np.inf))
    around = after[before == 1]
    assert after[stiff].min() > around.max()
    assert after[soft].max() < around.min()
    assert np.isinf(after[bone]).all()
    material = widget.fields.material.native
    said = [material.itemText(at) for at in range(material.count())]
    assert f"stiff ({after[stiff][0]:g})" in said
    widget.undo()
    settle(widget)
    np.testing.assert_array_equal(build_problem(widget.study).problem.stiffness, before)


def test_painted_tissue_remains_stiff_or_rigid_in_tissue_from_labels(viewer, widget, settle):
    picture = np.random.default_rng(0).integers(0, 255, (20, 24)).astype(np.uint8)
    widget.image = viewer.add_image(picture, name="photo")
    stiff, bone = (
        Stroke("tissue", (((row, 6.0), (row, 18.0)),), 2.0, label=label)
        for row, label in ((5.0, 3), (14.0, 4))
    )
    widget.model = "elastic"
    widget.drawing = Drawing((stiff, bone, Arrow((10, 12), (0, 2), 2.0)))
    rows = (Material(0, "gel", 10.0), Material(1, "jelly", 8.0))
    labels = np.zeros((20, 24), np.uint8)
    labels[:, :4] = 1
    table = layer_metadata(TISSUE, rows, "kPa")
    widget.tissue = viewer.add_labels(labels, name="organs", metadata=table)
    widget.deform()
    settle(widget)
    stiffness = build_problem(widget.study).problem.stiffness
    assert (stiffness[5, 12], stiffness[14, 12]) == (50, np.inf)
    assert "Painted tissue 3 is not listed: 'stiff' (50 kPa) is assumed" in widget.warning


def test_a_drawing_is_displayed_again_with_its_image(viewer, widget, settle):
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


def test_a_newly_opened_image_is_chosen_until_the_first_edit(viewer, widget, settle):
    for _ in range(2):
        newest, *_ = brain(viewer)
        settle(widget)
        assert widget.image is newest
    widget.plane = "strain"
    assert widget.image is newest
    later = viewer.add_image(np.ones((20, 24)), name="later", translate=(0, 300))
    assert widget.status.startswith("'later' was not chosen, because another image is in use")
    widget.image = later
    settle(widget)
    assert widget.image is later


def test_choosing_an_image_elsewhere_moves_the_camera_to_it(viewer, widget, settle):
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
    assert camera_of(viewer).zoom == 10, "the view of a visible image changed"
    settle(widget)


def test_paint_on_a_second_image_is_displayed_above_that_image(viewer, widget, settle):
    first = brain(viewer)
    widget.drawing = MARKS
    settle(widget)
    second = brain(viewer, 40)
    widget.image = second[0]
    widget.tool = "confidence"
    widget.start()
    strokes = (Stroke("pin", (((20, 20),),), 4.0), Stroke("confidence", (((20, 20),),), 6.0))
    widget.drawing = Drawing((*MARKS.marks, *strokes))
    settle(widget)
    names = [layer.name for layer in viewer.layers]
    painted = [at for at, name in enumerate(names) if name.startswith(("Motion, p", "Confidence"))]
    assert len(painted) == 2
    assert min(painted) > viewer.layers.index(second[0]) > viewer.layers.index(first[0])
