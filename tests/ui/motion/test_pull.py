"""Tests of the *Pull* tool without a window: drags, arrows and the resulting problem."""

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from napari.layers import Image, Labels
from scipy import ndimage

from napari_hmrf import Grid, Motion, Multigrid, ProblemError, Study, Tissue, solve, solve_study
from napari_hmrf.field.inverse_point import inverse_point
from napari_hmrf.layers.arrow_layer import arrow_layer, arrow_lines
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Rendering, Stroke
from napari_hmrf.tissue.usual_lengths import usual_radius
from napari_hmrf.ui.motion.motion_messages import NOTHING
from napari_hmrf.ui.motion.pull_tools import PullTool
from tests.support.study_reader import read_ground

SPACING = (1.0, 2.0)
GRIP = {"radius": 3.0, "confidence": 1.0, "components": "both"}


@pytest.fixture
def model():
    return Session()


@pytest.fixture
def pull(model):
    return PullTool(model, SPACING)


@pytest.fixture
def drag(pull, model):
    """Return a function that drags the tool and returns the undo step, or "" if there is none."""

    def done(*points, reach=1.0, settings=GRIP, **options):
        before = model.next_undo
        assert not pull.press(points[0], reach, settings, **options)
        assert pull.is_dragging
        for point in points[1:]:
            pull.move(point)
        assert pull.release() is None
        return "" if model.next_undo is before else model.next_undo.word

    return done


def test_a_drag_draws_one_arrow_in_the_unit_of_the_spacing(drag, model):
    assert drag((10, 10), (11, 10), (14, 13)) == "pulled tissue"
    assert model.drawing.marks == (Arrow((10, 10), (4, 6), 3.0, slack=2.0),)
    assert model.undo().word == "pulled tissue"
    assert not model.drawing.marks


def test_a_click_pins_tissue_at_its_displayed_position(drag, model):
    settings = {**GRIP, "confidence": 0.5}
    assert drag((10, 10), settings=settings, origin=lambda _: (8.0, 11.0)) == "held tissue"
    assert model.drawing.marks == (Arrow((8, 11), (2, -2), 3.0, 0.5, slack=2.0),)


def test_void_is_not_pulled(pull, model):
    assert pull.press((10, 10), 1, GRIP, lambda _: None) == NOTHING
    assert not pull.is_dragging
    pull.move((12, 12))
    assert (pull.release(), model.drawing.marks, model.next_undo) == (None, (), None)


def test_an_arrow_is_dragged_by_its_head_or_its_base_within_reach(drag, model):
    drag((10, 10), (14, 12))
    drag((14.5, 12), (16.5, 13))  # Half a pixel beside the head.
    assert model.drawing.marks == (Arrow((10, 10), (6, 6), 3.0, slack=2.0),)
    drag((10, 10), (11, 10))
    moved = Arrow((11, 10), (5, 6), 3.0, slack=2.0)
    assert model.drawing.marks == (moved,), "the head moved with the base"
    assert model.undo().word == "moved an arrow"
    assert model.undo().word == "moved an arrow"
    assert model.undo().word == "pulled tissue"


def test_a_click_on_an_arrow_adds_no_undo_step(drag, pull, model):
    drag((10, 10), (14, 12))
    assert drag((14, 12)) == ""
    assert pull.selected == 0
    assert model.next_undo.word == "pulled tissue"


def test_an_arrow_of_one_component_stays_on_its_axis(drag, pull, model):
    drag((10, 10), (14, 13), settings={**GRIP, "components": "row"})
    assert model.drawing.marks[0].by == (4, 0)
    pull.change({**GRIP, "components": "col"})
    assert model.drawing.marks[0].by == (0, 0)


def test_the_selected_arrow_is_changed_and_removed(drag, pull, model):
    drag((10, 10), (14, 12))
    drag((20, 20), (21, 21))
    assert pull.selected == 1
    pull.change({**GRIP, "radius": 5.0, "confidence": 0.25})
    assert model.drawing.marks[1] == Arrow((20, 20), (1, 2), 5.0, 0.25, slack=2.0)
    before = model.next_undo
    pull.change(pull.mark_settings)
    assert model.next_undo is before, "an unchanged setting added an undo step"
    assert pull.remove()
    assert len(model.drawing.marks) == 1
    assert pull.selected is None
    assert not pull.remove()
    model.undo()
    assert pull.selected is None, "a restored arrow is selected"


def test_a_cancelled_drag_leaves_no_mark(drag, pull, model):
    drag((10, 10), (14, 12))
    before = model.drawing
    pull.press((20, 20), 1, GRIP)
    pull.move((25, 25))
    assert pull.cancel()
    pull.move((26, 26))
    pull.release()
    assert (model.drawing, model.next_undo.word) == (before, "pulled tissue")
    assert not pull.cancel()


def test_a_landmark_is_moved_by_either_end(drag, model):
    model.draw(Drawing((Landmark((5, 5), (8, 8), 2),)), "opened")
    drag((8, 8), (9, 9))
    drag((5, 5), (4, 4))
    assert model.drawing.marks == (Landmark((4, 4), (9, 9), 2),)


def test_the_origin_of_displayed_tissue_is_found():
    rows, cols = np.indices((40, 30)).astype(np.float32)
    field = np.stack([3 * np.sin(cols / 8), 0.2 * rows], axis=-1)
    tissue = np.ones((40, 30), bool)
    for before in [(10.0, 12.0), (20.3, 8.6), (30.7, 3.2)]:
        d = (3 * np.sin(before[1] / 8), 0.2 * before[0])
        seen = (before[0] + d[0] / SPACING[0], before[1] + d[1] / SPACING[1])
        assert inverse_point(seen, field, SPACING, tissue) == pytest.approx(before, abs=0.05)
    tissue[:, 15:] = False
    assert inverse_point((5.0, 28.0), field, SPACING, tissue) is None
    assert inverse_point((500.0, 28.0), field, SPACING, tissue) is None


# Appearance


def test_an_arrow_is_drawn_from_the_origin_to_the_target_of_tissue():
    drawing = Drawing((Arrow((10, 10), (4, 6), 3.0), Arrow((30, 30), (0, 0), 2.0, 0.5)))
    lines, colours = arrow_lines(drawing, SPACING, selected=1)
    ends = lines[:, 0] + lines[:, 1]
    shaft = np.flatnonzero((lines[:, 0] == (10, 10)).all(axis=1))
    assert ends[shaft].tolist() == [[14, 13]]
    outline = (lines[:20, 0] - (14, 13)) * SPACING
    assert np.allclose(np.linalg.norm(outline, axis=1), 3)
    assert np.unique(colours, axis=0).shape == (2, 4)
    assert len(arrow_lines(Drawing(), SPACING)[0]) == 0


@pytest.mark.parametrize(("components", "axis"), [("row", 0), ("col", 1)])
@pytest.mark.parametrize("by", [(0, 0), (3, 4)])
def test_an_arrow_of_one_component_has_a_double_arrow_at_its_head(components, axis, by):
    arrow = Arrow((10, 20), by, 2.0, components=components)
    plain = arrow_lines(Drawing((replace(arrow, components="both"),)), SPACING)[0]
    lines = arrow_lines(Drawing((arrow,)), SPACING)[0]
    added = [line for line in lines.tolist() if line not in plain.tolist()]
    shaft, *barbs = np.array(added) * SPACING
    head = np.array(arrow.head(SPACING)) * SPACING
    assert shaft[1, 1 - axis] == 0, "the double arrow is not parallel to its axis"
    assert shaft[1, axis] > 2 * arrow.radius, "the double arrow does not extend beyond the patch"
    assert shaft[0] + shaft[1] / 2 == pytest.approx(head)
    assert len(barbs) == 4, "the double arrow does not have two heads"
    held = not any(by)
    assert len(lines) == len(plain) + 5 - (2 if held else 0), (
        "a fixed arrow has both a cross and a double arrow"
    )


def test_arrows_lie_on_their_slice():
    frame = frame_of(Image(np.zeros((4, 20, 30)), scale=(5, 2, 2)))
    made = arrow_layer(frame, (20, 30))
    assert made.attributes["ndim"] == 3
    assert tuple(made.attributes["scale"]) == (5, 2, 2)


# The problem


def disc(shape=(40, 40), radius=12):
    rows, cols = np.indices(shape)
    inside = np.hypot(rows - shape[0] / 2, cols - shape[1] / 2) <= radius
    return inside, (inside * 180 + 10 + (rows + cols) % 7).astype(np.uint8)


def test_without_a_tissue_layer_the_foreground_is_tissue_with_a_fixed_edge():
    inside, picture = disc()
    ground = read_ground(Image(picture, scale=(2, 2), name="MR"))
    assert (ground.stiffness[inside] == 1).all()
    assert np.allclose(ground.stiffness[~inside], 0.01)
    held = (ground.base.confidence > 0).all(axis=-1)
    assert held[0].all()
    assert held[:, -1].all()
    assert not held[20, 20]
    edge = inside & ~ndimage.binary_erosion(inside, np.ones((3, 3), bool))
    assert (held[inside] == edge[inside]).all()
    assert ground.base.spacing == (2, 2)
    assert usual_radius(ground.base.shape, ground.base.spacing) == 5.0
    free = read_ground(Image(picture), hold_edge=False)
    assert not free.base.confidence.any()


def test_a_painted_boundary_is_combined_with_the_drawing():
    _, picture = disc()
    labels = np.zeros((40, 40), np.uint8)
    labels[18:22, 18:22] = 2
    rules = (BoundaryRule(2, "move", vector=(0.0, 3.0), confidence=(1.0, 0.5)),)
    painted = Labels(labels, metadata=layer_metadata(BOUNDARY, rules))
    ground = read_ground(Image(picture), boundary=painted)
    assert (ground.base.observed[labels == 2] == (0, 3)).all()
    assert (ground.base.confidence[labels == 2] == (1, 0.5)).all()
    assert not ground.study.same_as(read_ground(Image(picture)).study)


@pytest.mark.parametrize("shape", [(24, 30), (14, 16, 18)])
def test_painted_fixed_tissue_under_a_pulled_patch_moves_and_causes_a_note(shape):
    labels = np.zeros(shape, np.uint8)
    labels[..., :3] = 1
    middle = tuple(size // 2 for size in shape[:-1])
    by = (*(0,) * (len(shape) - 1), 2)

    def moved(col):
        pull = Drawing((Arrow((*middle, col), by, 3.0),))
        motion = Motion(labels=labels, rules=(BoundaryRule(1, "fixed"),), drawing=pull)
        tissue = Tissue(stiffness=np.ones(shape))
        study = Study(Grid(shape, (1.0,) * len(shape)), tissue, motion)
        ground = Ground.of(study)
        said = [each for each in ground.notes_on(ground.statement()) if "painted as held" in each]
        return np.abs(solve_study(study).displacement).max(axis=-1), said

    far, said = moved(8)
    assert not far[labels == 1].any(), "fixed tissue outside the patch moves"
    assert not said
    near, said = moved(4)
    over = near[labels == 1] > 0
    assert 0 < over.sum() < (16 if len(shape) == 2 else 64), (
        "fixed tissue under the patch does not move"
    )
    assert len(said) == 1


def test_a_photograph_has_no_background():
    rows, cols = np.indices((40, 50))
    photograph = np.stack([rows * 4, cols * 4, rows + cols], axis=-1).astype(np.uint8)
    assert (read_ground(Image(photograph, rgb=True)).stiffness == 1).all()


def test_a_tissue_layer_sets_the_stiffness():
    inside, picture = disc()
    materials = (Material(0, "air", 0.0), Material(1, "gel", 20.0, 0.3))
    labels = Labels(inside.astype(np.uint8), metadata=layer_metadata(TISSUE, materials, "kPa"))
    ground = read_ground(Image(picture), labels)
    assert np.array_equal(ground.stiffness, np.where(inside, 20, 0))
    assert ground.prior.poisson == 0.3
    assert not (ground.base.confidence[~inside] > 0).any()
    void = Labels(np.zeros((40, 40), np.uint8), metadata=labels.metadata)
    ground = read_ground(Image(picture), void)
    with pytest.raises(ProblemError, match="there is no tissue"):
        ground.statement()
    stiffness = Image(np.where(inside, 3.0, 1.0), name="E")
    assert read_ground(Image(picture), stiffness).stiffness.max() == 3
    with pytest.raises(ProblemError, match="negative values"):
        read_ground(Image(picture), Image(np.where(inside, 3.0, -1.0)))


def test_infinite_stiffness_in_an_image_is_rigid_and_too_large_values_are_refused():
    inside, picture = disc()
    bone = np.where(inside, np.inf, 3.0)
    ground = read_ground(Image(picture), Image(bone, contrast_limits=(0, 3)), hold_edge=False)
    assert np.array_equal(np.isinf(ground.stiffness), inside)
    for wrong in (1e39, -np.inf, np.nan):
        image = Image(np.where(inside, wrong, 3.0), contrast_limits=(0, 3))
        with pytest.raises(ProblemError, match=r"single precision|NaN or infinite"):
            read_ground(Image(picture), image)


def test_rigid_tissue_can_be_painted_without_a_table():
    _, picture = disc()
    ground = read_ground(Image(picture))
    rigid = ground.palette.materials[-1]
    assert rigid.is_rigid
    assert rigid.label not in {row.label for row in ground.palette.materials[:-1]}
    rendering = Rendering(ground.base)
    rendering.show(Drawing((Stroke("tissue", (((20.0, 20.0),),), 4.0, label=rigid.label),)))
    stated = ground.statement(rendering.canvas)
    problem, prior = stated.problem, stated.prior
    assert np.array_equal(np.isinf(problem.stiffness), rendering.canvas.labels == rigid.label)
    assert np.isinf(problem.stiffness).sum() > 20
    assert isinstance(prior.poisson, float), "rigid tissue has a Poisson's ratio of its own"


def test_uncertain_sites_near_rigid_tissue_may_slip():
    inside, picture = disc()
    bone = Image(np.where(inside, np.inf, 3.0), contrast_limits=(0, 3), name="E")
    ground = read_ground(Image(picture), bone)
    rendering = Rendering(ground.base)
    rendering.show(Drawing((Arrow((3, 3), (1, 0), 2.0, confidence=0.5),)))
    stated = ground.statement(rendering.canvas)
    assert stated.prior.can_slip(stated.problem)
    assert not any("slip" in note for note in ground.notes_on(stated))


def test_unconstrained_tissue_is_excluded_and_does_not_move():
    two = np.zeros((20, 40), np.uint8)
    two[5:15, 5:15] = two[5:15, 25:35] = 1
    materials = (Material(0, "air", 0.0), Material(1, "gel", 20.0))
    labels = Labels(two, metadata=layer_metadata(TISSUE, materials, "kPa"))
    ground = read_ground(Image(two * 100), labels, hold_edge=False)
    rendering = Rendering(ground.base)
    rendering.show(Drawing((Arrow((10, 10), (1, 2), 2.0),)))
    stated = ground.statement(rendering.canvas)
    problem, prior = stated.problem, stated.prior
    assert problem.tissue[5:15, 5:15].all()
    assert not problem.tissue[5:15, 25:35].any()
    assert not prior.can_slip(problem)
    rendering.show(Drawing((Arrow((10, 10), (1, 2), 2.0, confidence=0.5),)))
    unsure = ground.statement(rendering.canvas)
    assert unsure.prior.can_slip(unsure.problem)


def test_a_low_confidence_at_one_site_does_not_affect_certain_sites():
    _, picture = disc()
    ground = read_ground(Image(picture))
    rendering = Rendering(ground.base)
    far_pull, held = Arrow((14, 20), (9, 0), 5.0), ((28, 20), (0, 0), 2.0)
    rendering.show(Drawing((far_pull, Arrow(*held, confidence=0.9))))
    canvas = rendering.canvas
    stated = ground.statement(canvas)
    found = solve(stated.problem, stated.prior, optimizer=Multigrid(1e-3)).displacement
    certain = (canvas.confidence == 1) & (ground.stiffness > 0)[..., None]
    np.testing.assert_allclose(found[certain], canvas.observed[certain], atol=1e-5)
    rendering.show(Drawing((far_pull, Arrow((26, 20), (-6, 0), 2.0, confidence=0.05))))
    stated = ground.statement(rendering.canvas)
    problem, prior = stated.problem, stated.prior
    found = solve(problem, prior, optimizer=Multigrid(1e-3)).displacement
    assert found[26, 20, 0] > -4, "the tissue follows a landmark of low confidence exactly"
    assert found[14, 20] == pytest.approx((9, 0), abs=1e-4)


def test_a_study_is_equal_until_a_layer_is_painted():
    _, picture = disc()
    image, copies = Image(picture), LayerCopies()

    def read(**how):
        return study_from_layers(Request(image=image, drawing=Drawing(), **how), copies=copies)

    one = read()
    assert one.same_as(read())
    image.refresh()
    assert one.same_as(read()), "a refresh without a change made the study unequal"
    assert not one.same_as(read(hold_edge=True))
    image.data = picture[::-1].copy() // 2
    assert not one.same_as(read())


# Calls from other threads


def test_calls_from_other_threads_run_in_order_on_the_gui_thread(qtbot, at_rest):
    from napari_hmrf.ui.jobs import GuiThread

    called, gui = [], GuiThread()

    def call(number):
        called.append((number, threading.current_thread()))

    work = threading.Thread(target=lambda: [gui.submit(partial(call, n)) for n in range(50)])
    work.start()
    work.join()
    assert not called
    qtbot.waitUntil(lambda: len(called) == 50)
    assert called == [(number, threading.main_thread()) for number in range(50)]
    gui.submit(partial(call, 50))
    gui.release()
    gui.submit(partial(call, 51))
    at_rest()
    assert len(called) == 50, "a call after the release was executed"


def test_holes_in_tissue_have_free_edges_and_enclosed_tissue_has_a_fixed_edge():
    rows, cols = np.indices((60, 70))
    radius = np.hypot(rows - 30, cols - 30)
    # A skull, a gap, the brain with a hole, and a separate speck.
    m = np.where((radius > 25) | ((radius > 6) & (radius < 18)), 1.0, 0.0)
    m[:, 62:] = 0
    m[5, 66] = 1
    ground = read_ground(Image(np.ones(m.shape), name="MR"), Image(m, name="stiffness"))
    held = (ground.base.confidence > 0).all(axis=-1)
    assert held[radius < 9].sum() == 0, "the edge of the hole in the brain is fixed"
    assert held[(radius > 17.4) & (radius < 18)].all(), "the outline of the brain is free"
    assert not held[(radius > 25) & (radius < 28)].any(), "the inside of the skull is fixed"
    assert held[[0, -1], :62].all()
    assert held[5, 66]
