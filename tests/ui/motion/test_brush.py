"""Tests of brushes and landmarks as tools, without a window."""

from typing import get_args

import numpy as np
import pytest
from napari.layers import Labels

from napari_hmrf.layers.paint_layer import COLOURS, number_of, painted_colours
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Landmark, Rendering, Stroke
from napari_hmrf.tissue.drawing.marks import Action
from napari_hmrf.ui.motion.motion_messages import NO_STEP, NO_WAY, NOTHING, OPEN, OUTSIDE
from napari_hmrf.ui.motion.pull_tools import LandmarkTool
from napari_hmrf.ui.motion.tool import ToolError
from napari_hmrf.ui.motion.tools import BY_NAME, TOOLS, tool_of

SPACING = (1.0, 2.0)
SHAPE = (60, 50)


def paint(radius=4.0, **settings):
    """Return the settings of a brush."""
    return {"radius": radius, **settings}


def grip(radius, confidence=1.0):
    """Return the settings of a landmark."""
    return {"radius": radius, "confidence": confidence}


@pytest.fixture
def model():
    return Session()


@pytest.fixture
def brush(model):
    """Return a function that makes the brush of an action."""
    return lambda action: BY_NAME[action](model, SPACING, SHAPE)


@pytest.fixture
def landmark(model):
    return LandmarkTool(model, SPACING)


@pytest.fixture
def drag(model):
    """Return a function that drags a tool and returns the undo step, or "" if there is none."""

    def done(tool, settings, *points, reach=1.0, **options):
        before = model.next_undo
        tool.press(points[0], reach, settings, **options)
        assert tool.is_dragging
        for point in points[1:]:
            tool.move(point)
        tool.release()
        return "" if model.next_undo is before else model.next_undo.word

    return done


def rendered(model):
    labels = np.ones(SHAPE, np.int32)
    return model.drawing.render(Canvas.blank(SHAPE, SPACING, labels))


def ring(middle=(30, 25), radius=14.0, count=40):
    turn = np.linspace(0, 2 * np.pi, count)
    rows = middle[0] + radius * np.sin(turn) / SPACING[0]
    cols = middle[1] + radius * np.cos(turn) / SPACING[1]
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def test_a_drag_of_the_brush_is_one_stroke_and_one_undo_step(brush, drag, model):
    assert drag(brush("pin"), paint(), (10, 10), (20, 10), (30, 10)) == "held tissue"
    assert model.drawing.marks == (Stroke("pin", (((10, 10), (20, 10), (30, 10)),), 4.0),)
    assert model.undo().word == "held tissue"
    assert not model.drawing.marks


@pytest.mark.parametrize(
    ("action", "settings", "y", "c"),
    [
        ("pin", paint(confidence=0.5), (0, 0), (0.5, 0.5)),
        ("free", paint(), (0, 0), (0, 0)),
        ("move", paint(by=(3, -1)), (3, -1), (1, 1)),
        ("move", paint(by=(3, -1), components="row"), (3, 8), (1, 0.8)),
        ("confidence", paint(confidence=0.25), (7, 8), (0.25, 0.25)),
    ],
)
def test_each_brush_sets_displacement_and_confidence_of_its_stroke(
    brush, drag, model, action, settings, y, c
):
    model.draw(Drawing((Arrow((20, 20), (7, 8), 15.0, 0.8),)), "pulled")
    drag(brush(action), settings, (18, 20), (22, 20))
    canvas = rendered(model)
    assert canvas.observed[20, 20] == pytest.approx(y)
    assert canvas.confidence[20, 20] == pytest.approx(c)
    assert canvas.observed[32, 20] == pytest.approx((7, 8)), "a pixel beside the stroke changed"


def test_the_tissue_brush_sets_labels(brush, drag, model):
    drag(brush("tissue"), paint(label=3), (20, 20), (30, 20))
    labels = rendered(model).labels
    assert (labels[25, 20], labels[25, 30]) == (3, 1)
    assert not rendered(model).confidence.any(), "the tissue brush prescribed a displacement"


def test_a_soft_brush_fades_confidence_out(brush, drag, model):
    model.draw(Drawing((Arrow((30, 25), (0, 0), 40.0),)), "held")
    drag(brush("confidence"), paint(10.0, confidence=0.0, softness=1.0), (30, 25))
    down = rendered(model).confidence[30:42, 25, 0]
    assert down[0] == pytest.approx(0, abs=0.01)
    assert (np.diff(down[:11]) > 0).all()
    assert down[11] == 1


def test_a_ring_expands_outward_and_shrinks_inward(brush, drag, model):
    grow = brush("expand")
    drag(grow, paint(3.0, amount=2.0), *ring())
    y = rendered(model).observed
    assert y[16, 25] == pytest.approx((-2, 0), abs=0.15)
    assert y[30, 32] == pytest.approx((0, 2), abs=0.15)
    grow.change({**grow.mark_settings, "amount": -2.0})
    assert rendered(model).observed[16, 25] == pytest.approx((2, 0), abs=0.15)


def test_an_open_line_that_expands_is_refused_and_leaves_no_mark(brush, model):
    grow = brush("expand")
    grow.press((5, 5), 1.0, paint(1.0, amount=2.0))
    for row in range(6, 50):
        grow.move((row, 5))
    assert grow.error_message == OPEN
    with pytest.raises(ToolError, match="no inside"):
        grow.release()
    assert (model.drawing, model.next_undo) == (Drawing(), None)
    assert not grow.is_dragging
    assert not grow.error_message


def test_an_expanding_region_is_extended_by_a_stroke_over_it(brush, drag, model):
    grow, settings = brush("expand"), paint(amount=1.0)
    drag(grow, settings, (20, 20), (30, 20))
    drag(grow, settings, (28, 21), (28, 28))
    assert len(model.drawing.marks) == 1
    assert len(model.drawing.marks[0].lines) == 2
    drag(grow, settings, (50, 40))
    assert len(model.drawing.marks) == 2, "a separate stroke extended the region"
    model.undo()
    model.undo()
    assert len(model.drawing.marks[0].lines) == 1


def test_settings_change_the_last_stroke_except_its_radius(brush, drag, model):
    push = brush("move")
    drag(push, paint(by=(1, 0)), (20, 20))
    push.change(paint(by=(3, 0), confidence=0.5))
    push.change(paint(9.0, by=(3, 0), confidence=0.5))
    assert model.drawing.marks == (Stroke("move", (((20, 20),),), 4.0, by=(3, 0), confidence=0.5),)
    assert model.next_undo.word == "changed a stroke"
    assert push.remove()
    assert model.undo().word == "removed a stroke"
    assert push.selected is None


def test_a_painted_region_of_a_volume_is_dragged_to_its_target(drag, model):
    push = BY_NAME["move"](model, (2.0, *SPACING), (9, *SHAPE))
    settings = paint(by=(0, 0, 0))
    drag(push, settings, (4, 20, 20))
    assert drag(push, settings, (4, 20, 20), (5, 21, 23)) == "pushed painted tissue"
    assert model.drawing.marks[0].by == (2, SPACING[0], 3 * SPACING[1])


def test_a_cancelled_stroke_leaves_no_mark_and_restores_the_selection(brush, drag, model):
    hold, settings = brush("pin"), paint()
    drag(hold, settings, (20, 20))
    before = model.drawing
    hold.press((21, 20), 1.0, settings)
    hold.move((40, 20))
    assert hold.cancel()
    hold.move((45, 20))
    hold.release()
    assert model.drawing == before
    assert hold.selected == 0


def test_a_stroke_on_moved_tissue_is_stored_at_the_origin_of_the_tissue(brush, drag, model):
    def origin(point):
        return None if point[1] > 30 else (point[0] - 5, point[1])

    drag(brush("pin"), paint(), (20, 20), (20, 40), origin=origin)
    assert model.drawing.marks[0].lines == (((15, 20), (20, 40)),), (
        "a place without an origin was not stored unchanged"
    )


def test_the_uppermost_stroke_at_a_place_is_found():
    drawing = Drawing(
        (
            Stroke("pin", (((10, 10), (30, 10)),), 4.0),
            Stroke("free", (((20, 10),),), 2.0),
            Arrow((10, 10), (1, 1), 3.0),
        )
    )
    assert drawing.painted_at((20, 10.5), SPACING) == 1
    assert drawing.painted_at((20, 11.9), SPACING) == 0
    assert drawing.painted_at((20, 12.1), SPACING) is None
    assert drawing.painted_at((10, 10), SPACING) == 0, "an arrow was found as a stroke"


def test_each_pixel_stores_the_kind_of_its_uppermost_stroke():
    marks = (
        Stroke("pin", (((20, 20),),), 8.0),
        Stroke("free", (((20, 20),),), 3.0),
        Stroke("confidence", (((20, 20), (20, 30)),), 3.0, confidence=0.5),
        Arrow((20, 24), (0, 0), 2.0),
    )
    rendering = Rendering(Canvas.blank(SHAPE, SPACING))
    rendering.show(Drawing(marks))
    kinds = rendering.canvas.kinds
    assert [kinds[20, col] for col in (20, 22, 24, 30)] == [2, 1, 0, 0]
    rendering.show(Drawing(marks[:1]))
    assert [kinds[20, col] for col in (20, 22, 24, 30)] == [1, 1, 1, 0]


def test_one_drag_makes_a_landmark(landmark, drag, model):
    assert drag(landmark, grip(3.0, 0.5), (10, 10), (10.2, 10), (14, 12)) == "drew a landmark"
    assert model.drawing.marks == (Landmark((10, 10), (14, 12), 3.0, 0.5),)
    assert model.undo().word == "drew a landmark"


def test_escape_cancels_a_landmark(landmark, model):
    landmark.press((10, 10), 1.0, grip(3.0))
    landmark.move((14, 12))
    assert landmark.cancel()
    assert not landmark.cancel()
    assert (model.drawing, model.next_undo) == (Drawing(), None)


def test_a_landmark_is_dragged_by_either_end(landmark, drag, model):
    model.draw(Drawing((Landmark((10, 10), (20, 20), 3.0),)), "opened")
    assert drag(landmark, grip(3.0), (20, 20), (22, 20)) == "moved a landmark"
    drag(landmark, grip(3.0), (10, 10), (9, 10))
    assert model.drawing.marks == (Landmark((9, 10), (22, 20), 3.0),)
    assert landmark.remove()
    assert model.undo().word == "removed a landmark"


def test_an_arrow_edited_with_the_landmark_tool_retains_its_components(landmark, drag, model):
    model.draw(Drawing((Arrow((10, 10), (4, 0), 3.0, components="row"),)), "opened")
    drag(landmark, grip(3.0), (14, 10), (15, 11))
    landmark.change(grip(2.0, 0.5))
    assert model.drawing.marks == (Arrow((10, 10), (5, 0), 2.0, 0.5, "row"),)


def test_a_landmark_starts_at_the_origin_of_tissue_and_ends_at_the_pointer(landmark, drag, model):
    drag(landmark, grip(3.0), (10, 10), (14, 14), origin=lambda _: (8.0, 9.0))
    assert model.drawing.marks == (Landmark((8, 9), (14, 14), 3.0),)
    assert landmark.press((40, 40), 1.0, grip(3.0), lambda _: None) == NOTHING


def test_each_kind_of_stroke_has_its_own_colour():
    picture = np.zeros((4, 4), np.uint8)
    colours = {7: (0.2, 0.4, 0.6)}
    layer = Labels(picture, colormap=painted_colours(colours))
    assert not layer.colormap.colors[0].any(), "unpainted pixels hide the image"
    seen = [layer.get_color(number_of(action)) for action in COLOURS]
    for colour, expected in zip(seen, COLOURS.values(), strict=True):
        assert colour[:3] == pytest.approx(expected, abs=0.01)
    assert layer.get_color(number_of("tissue", label=7))[:3] == pytest.approx(colours[7], abs=0.01)
    assert layer.get_color(number_of("tissue", label=9))[3], "paint of unlisted tissue is invisible"


def test_a_painted_region_that_moves_is_dragged_to_its_target(brush, drag, model):
    push = brush("move")
    drag(push, paint(), (20, 20), (24, 20))
    assert model.drawing.marks[0].moves_nowhere
    assert drag(push, paint(), (22, 20), (25, 21), (27, 24)) == "pushed painted tissue"
    (stroke,) = model.drawing.marks
    assert stroke.by == pytest.approx((5 * SPACING[0], 4 * SPACING[1]))
    assert stroke.lines == (((20, 20), (24, 20)),), "the drag extended the stroke"
    drag(push, paint(by=stroke.by), (22, 20), (20, 20))
    assert model.drawing.marks[0].by == pytest.approx((3 * SPACING[0], 4 * SPACING[1]))
    model.undo()
    assert model.drawing.marks == (stroke,)
    drag(push, paint(), (50, 40))
    assert len(model.drawing.marks) == 2, "a drag elsewhere painted no new region"


def test_a_landmark_without_a_drag_shows_a_message(landmark, model):
    landmark.press((10, 10), 1.0, grip(3.0), lambda _: (8.0, 9.0))
    assert landmark.release() == NO_WAY
    landmark.press((10, 10), 1.0, grip(3.0))
    assert landmark.release() is None, "a click on an old landmark shows a message"
    landmark.press((30, 30), 1.0, grip(3.0))
    landmark.move((30, 34))
    assert landmark.release() is None


def test_a_moving_region_shows_a_message_until_it_is_dragged(brush, model):
    push = brush("move")
    assert push.press((20, 20), 1.0, paint()) == NO_STEP
    assert push.release() is None, "the message was cleared"
    assert push.press((20, 20), 1.0, paint()) == NO_STEP
    push.move((20, 24))
    assert push.release() == ""
    assert not brush("pin").press((40, 40), 1.0, paint())


def test_a_brush_paints_only_inside_the_image(brush, model):
    hold = brush("pin")
    for point in [(-1, 20), (20, 50)]:
        assert hold.press(point, 1.0, paint()) == OUTSIDE
        assert not hold.is_dragging
    assert not hold.press((-0.4, 49.4), 1.0, paint())
    assert hold.stroke == model.drawing.marks[0]
    hold.release()
    assert hold.stroke is None


def test_a_new_label_applies_to_the_next_or_to_the_selected_stroke(brush, drag, model):
    tissue = brush("tissue")
    drag(tissue, paint(label=3), (20, 20))
    tissue.change(paint(label=4))
    assert model.drawing.marks[0].label == 3
    tissue.pick(0)
    tissue.change(paint(label=4))
    assert model.drawing.marks[0].label == 4
    drag(tissue, paint(label=5), (40, 40))
    tissue.change(paint(label=6))
    assert model.drawing.marks[1].label == 5


def test_the_circle_of_the_cursor_is_hidden_during_a_drag(brush, landmark):
    for tool in (brush("pin"), landmark):
        assert tool.cursor(grip(3.0)) == 3.0
        tool.press((10, 10), 1.0, grip(3.0))
        assert tool.cursor(grip(3.0)) is None
        tool.release()
        assert tool.cursor(grip(3.0)) == 3.0


def test_each_mark_is_made_by_one_tool():
    marks = [
        Arrow((0, 0), (0, 0), 1.0),
        Landmark((0, 0), (0, 0), 1.0),
        *(Stroke(action, (((0, 0),),), 1.0) for action in get_args(Action)),
    ]
    assert {tool_of(mark) for mark in marks} == set(TOOLS)
    assert [sum(tool.makes(mark) for tool in TOOLS) for mark in marks] == [1] * len(TOOLS)
