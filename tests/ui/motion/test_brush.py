"""Painting and placing landmarks with a pointer, without a window."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Labels

from napari_hmrf import ProblemError
from napari_hmrf.layers.paint_layer import COLOURS, number_of, painted_colours
from napari_hmrf.study.study_model import StudyModel
from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Landmark, Rendering, Stroke
from napari_hmrf.ui.motion.brush import Brush
from napari_hmrf.ui.motion.hands import Pull

SPACING = (1.0, 2.0)
SHAPE = (60, 50)


def paint(action, radius, **how):
    """A stroke as new ones are to be."""
    return Stroke(action, (((0, 0),),), radius, **how)


def grip(radius, confidence=1.0):
    """A landmark as new ones are to be."""
    return Landmark((0, 0), (0, 0), radius, confidence)


@pytest.fixture
def model():
    return StudyModel()


@pytest.fixture
def brush(model):
    return Brush(model, SPACING, SHAPE)


@pytest.fixture
def landmark(model):
    return Pull(model, SPACING)


def drag(hand, how, *points, reach=1.0, **options):
    assert hand.press(points[0], reach, how, **options)
    for point in points[1:]:
        hand.move(point)
    return hand.release()


def rendered(model):
    labels = np.ones(SHAPE, np.int32)
    return model.drawing.render(Canvas.blank(SHAPE, SPACING, labels))


def ring(middle=(30, 25), radius=14.0, count=40):
    turn = np.linspace(0, 2 * np.pi, count)
    rows = middle[0] + radius * np.sin(turn) / SPACING[0]
    cols = middle[1] + radius * np.cos(turn) / SPACING[1]
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def test_a_drag_of_the_brush_is_one_stroke_and_one_step(brush, model):
    assert drag(brush, paint("pin", 4.0), (10, 10), (20, 10), (30, 10)) == "held tissue"
    assert model.drawing.marks == (Stroke("pin", (((10, 10), (20, 10), (30, 10)),), 4.0),)
    assert model.undo().word == "held tissue"
    assert not model.drawing.marks


@pytest.mark.parametrize(
    ("how", "y", "c"),
    [
        (paint("pin", 4.0, confidence=0.5), (0, 0), (0.5, 0.5)),
        (paint("free", 4.0), (0, 0), (0, 0)),
        (paint("move", 4.0, by=(3, -1)), (3, -1), (1, 1)),
        (paint("move", 4.0, by=(3, -1), components="row"), (3, 8), (1, 0.8)),
        (paint("confidence", 4.0, confidence=0.25), (7, 8), (0.25, 0.25)),
    ],
)
def test_each_brush_says_its_own_of_what_it_covers(brush, model, how, y, c):
    model.draw(Drawing((Arrow((20, 20), (7, 8), 15.0, 0.8),)), "pulled")
    drag(brush, how, (18, 20), (22, 20))
    canvas = rendered(model)
    assert canvas.observed[20, 20] == pytest.approx(y)
    assert canvas.confidence[20, 20] == pytest.approx(c)
    assert canvas.observed[32, 20] == pytest.approx((7, 8)), "beside the brush nothing has changed"


def test_tissue_becomes_what_is_painted(brush, model):
    drag(brush, paint("tissue", 4.0, label=3), (20, 20), (30, 20))
    labels = rendered(model).labels
    assert (labels[25, 20], labels[25, 30]) == (3, 1)
    assert not rendered(model).confidence.any(), "and nothing is held by that"


def test_a_soft_brush_fades_confidence_out(brush, model):
    model.draw(Drawing((Arrow((30, 25), (0, 0), 40.0),)), "held")
    drag(brush, paint("confidence", 10.0, confidence=0.0, softness=1.0), (30, 25))
    down = rendered(model).confidence[30:42, 25, 0]
    assert down[0] == pytest.approx(0, abs=0.01)
    assert (np.diff(down[:11]) > 0).all()
    assert down[11] == 1


def test_a_ring_expands_outward_and_shrinks_inward(brush, model):
    drag(brush, paint("expand", 3.0, amount=2.0), *ring())
    y = rendered(model).observed
    assert y[16, 25] == pytest.approx((-2, 0), abs=0.15)
    assert y[30, 32] == pytest.approx((0, 2), abs=0.15)
    brush.change(replace(brush.mark, amount=-2.0))
    assert rendered(model).observed[16, 25] == pytest.approx((2, 0), abs=0.15)


def test_an_open_line_cannot_expand_and_leaves_nothing(brush, model):
    brush.press((5, 5), 1.0, paint("expand", 1.0, amount=2.0))
    for row in range(6, 50):
        brush.move((row, 5))
    with pytest.raises(ProblemError, match="no outside"):
        brush.release()
    assert (model.drawing, model.next_undo) == (Drawing(), None)
    assert not brush.holding


def test_a_region_is_painted_on_where_the_brush_goes_over_it_again(brush, model):
    how = paint("expand", 4.0, amount=1.0)
    drag(brush, how, (20, 20), (30, 20))
    drag(brush, how, (28, 21), (28, 28))
    assert len(model.drawing.marks) == 1
    assert len(model.drawing.marks[0].lines) == 2
    drag(brush, how, (50, 40))
    assert len(model.drawing.marks) == 2, "elsewhere another one begins"
    model.undo()
    model.undo()
    assert len(model.drawing.marks[0].lines) == 1


def test_the_stroke_painted_last_is_changed_but_not_its_size(brush, model):
    drag(brush, paint("move", 4.0, by=(1, 0)), (20, 20))
    brush.change(replace(brush.mark, by=(3, 0), confidence=0.5))
    brush.change(replace(brush.mark, radius=9.0))
    assert model.drawing.marks == (Stroke("move", (((20, 20),),), 4.0, by=(3, 0), confidence=0.5),)
    assert model.next_undo.word == "changed a stroke"
    assert brush.remove()
    assert model.undo().word == "removed a stroke"
    assert brush.selected is None


def test_what_was_painted_in_a_volume_is_dragged_to_where_it_goes(model):
    brush = Brush(model, (2.0, *SPACING), (9, *SHAPE))
    how = Stroke("move", (((0, 0, 0),),), 4.0, by=(0, 0, 0))
    drag(brush, how, (4, 20, 20))
    assert drag(brush, how, (4, 20, 20), (5, 21, 23)) == "pushed what was painted"
    assert model.drawing.marks[0].by == (2, SPACING[0], 3 * SPACING[1])


def test_a_cancelled_stroke_leaves_nothing_and_what_was_selected(brush, model):
    how = paint("pin", 4.0)
    drag(brush, how, (20, 20))
    before = model.drawing
    brush.press((21, 20), 1.0, how)
    brush.move((40, 20))
    assert brush.cancel()
    brush.move((45, 20))
    brush.release()
    assert model.drawing == before
    assert brush.selected == 0


def test_moved_tissue_is_painted_where_it_came_from(brush, model):
    def came_from(point):
        return None if point[1] > 30 else (point[0] - 5, point[1])

    drag(brush, paint("pin", 4.0), (20, 20), (20, 40), came_from=came_from)
    assert model.drawing.marks[0].lines == (((15, 20), (20, 40)),), "beyond it, the place itself"


def test_the_uppermost_stroke_is_found_under_a_place():
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
    assert drawing.painted_at((10, 10), SPACING) == 0, "an arrow is nothing painted"


def test_what_was_painted_last_is_known_of_each_pixel():
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


def test_one_drag_makes_a_landmark(landmark, model):
    how = grip(3.0, 0.5)
    assert drag(landmark, how, (10, 10), (10.2, 10), (14, 12)) == "drew a landmark"
    assert model.drawing.marks == (Landmark((10, 10), (14, 12), 3.0, 0.5),)
    assert model.undo().word == "drew a landmark"


def test_escape_gives_a_landmark_up(landmark, model):
    assert landmark.press((10, 10), 1.0, grip(3.0))
    landmark.move((14, 12))
    assert landmark.cancel()
    assert not landmark.cancel()
    assert (model.drawing, model.next_undo) == (Drawing(), None)


def test_landmarks_are_taken_up_again_by_either_end(landmark, model):
    model.draw(Drawing((Landmark((10, 10), (20, 20), 3.0),)), "opened")
    assert drag(landmark, grip(3.0), (20, 20), (22, 20)) == "moved a landmark"
    drag(landmark, grip(3.0), (10, 10), (9, 10))
    assert model.drawing.marks == (Landmark((9, 10), (22, 20), 3.0),)
    assert landmark.remove()
    assert model.undo().word == "removed a landmark"


def test_an_arrow_in_the_hand_of_landmarks_speaks_of_the_directions_it_spoke_of(landmark, model):
    model.draw(Drawing((Arrow((10, 10), (4, 0), 3.0, components="row"),)), "opened")
    drag(landmark, grip(3.0), (14, 10), (15, 11))
    landmark.change(grip(2.0, 0.5))
    assert model.drawing.marks == (Arrow((10, 10), (5, 0), 2.0, 0.5, "row"),)


def test_a_landmark_begins_where_tissue_came_from_and_ends_where_it_is_seen(landmark, model):
    drag(landmark, grip(3.0), (10, 10), (14, 14), came_from=lambda _: (8.0, 9.0))
    assert model.drawing.marks == (Landmark((8, 9), (14, 14), 3.0),)
    assert not landmark.press((40, 40), 1.0, grip(3.0), lambda _: None)


def test_what_was_painted_has_a_colour_of_its_own():
    picture = np.zeros((4, 4), np.uint8)
    colours = {7: (0.2, 0.4, 0.6)}
    layer = Labels(picture, colormap=painted_colours(colours))
    assert not layer.colormap.colors[0].any(), "nothing hides the image where nothing is painted"
    seen = [layer.get_color(number_of(action)) for action in COLOURS]
    for colour, expected in zip(seen, COLOURS.values(), strict=True):
        assert colour[:3] == pytest.approx(expected, abs=0.01)
    assert layer.get_color(number_of("tissue", label=7))[:3] == pytest.approx(colours[7], abs=0.01)


def test_what_was_painted_to_move_is_dragged_to_where_it_goes(brush, model):
    drag(brush, paint("move", 4.0), (20, 20), (24, 20))
    assert model.drawing.marks[0].moves_nowhere
    assert (
        drag(brush, paint("move", 4.0), (22, 20), (25, 21), (27, 24)) == "pushed what was painted"
    )
    (stroke,) = model.drawing.marks
    assert stroke.by == pytest.approx((5 * SPACING[0], 4 * SPACING[1]))
    assert stroke.lines == (((20, 20), (24, 20)),), "dragged, and not painted on"
    drag(brush, paint("move", 4.0, by=stroke.by), (22, 20), (20, 20))
    assert model.drawing.marks[0].by == pytest.approx((3 * SPACING[0], 4 * SPACING[1]))
    model.undo()
    assert model.drawing.marks == (stroke,)
    drag(brush, paint("move", 4.0), (50, 40))
    assert len(model.drawing.marks) == 2, "elsewhere another region is painted"
