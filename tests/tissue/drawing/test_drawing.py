"""Tests of drawings: rendering, picking, storage and undo of marks."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from napari_hmrf import ArgumentError, ElasticPrior, Problem, ProblemError, solve
from napari_hmrf.field.strain import count_folds
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.drawing import (
    Arrow,
    Canvas,
    Drawing,
    Hit,
    Landmark,
    Rendering,
    Stroke,
)
from napari_hmrf.tissue.drawing.marks import grows

SHAPE = (24, 30)
SPACING = (1.0, 2.0)

places = st.tuples(
    st.floats(-5, SHAPE[0] + 5).map(lambda x: round(x, 1)),
    st.floats(-5, SHAPE[1] + 5).map(lambda x: round(x, 1)),
)
lengths = st.tuples(st.integers(-6, 6), st.integers(-6, 6))
radii = st.sampled_from([0.1, 1.0, 2.5, 6.0])
sure = st.sampled_from([0.25, 0.5, 1.0])
components = st.sampled_from(["both", "row", "col"])
growth = st.sampled_from([0.0, 0.0, 1.0, -0.5])
slack = st.sampled_from([0.0, 2.0])
arrows = st.builds(Arrow, places, lengths, radii, sure, components, growth, slack=slack)
landmarks = st.builds(Landmark, places, places, radii, sure, growth)
strokes = st.builds(
    Stroke,
    st.sampled_from(["pin", "free", "move", "confidence", "tissue"]),
    st.lists(st.lists(places, min_size=1, max_size=4), min_size=1, max_size=2),
    radii,
    by=lengths,
    confidence=st.sampled_from([0.0, 0.3, 1.0]),
    softness=st.sampled_from([0.0, 0.5]),
    label=st.integers(0, 3),
    components=components,
)
dabs = st.builds(
    Stroke,
    st.sampled_from(["expand", "move"]),
    places.map(lambda place: ((place,),)),
    radii,
    by=lengths,
    amount=st.integers(-2, 2),
)
marks = arrows | landmarks | strokes | dabs
#: Edits: the action, the number of the mark, a new mark and a place.
edits = st.tuples(
    st.sampled_from(["add", "replace", "remove", "onward", "drag", "drop", "undo", "redo"]),
    st.integers(0, 100),
    marks,
    places,
)


def canvas(shape=SHAPE, spacing=SPACING):
    """Return a canvas on which every third row is observed already."""
    found = Canvas.blank(shape, spacing, np.ones(shape, np.uint8))
    found.observed[::3], found.confidence[::3] = (0.5, -0.5), 0.75
    found.edge[::9] = True
    return found


def same(one, other):
    return (
        np.array_equal(one.observed, other.observed)
        and np.array_equal(one.confidence, other.confidence)
        and np.array_equal(one.labels, other.labels)
    )


def edited(drawing, edit):
    """Return the drawing after an edit; the same drawing if the edit does not apply."""
    what, number, mark, place = edit
    if what == "add" or not drawing.marks:
        return drawing.with_mark(mark)
    number %= len(drawing.marks)
    if what == "remove":
        return drawing.without(number)
    there = drawing.marks[number]
    if what == "onward" and isinstance(there, Stroke) and not grows(there):
        return drawing.replaced(number, there.onward(place))
    return drawing.replaced(number, mark)


# Marks on images


def test_an_arrow_moves_only_its_patch():
    drawn = Drawing((Arrow((10, 12), (3, -2), radius=4, confidence=0.5),)).render(
        Canvas.blank((30, 40), (1.0, 2.0))
    )
    rows, cols = np.indices((30, 40))
    patch = np.hypot(rows - 10, 2.0 * (cols - 12)) <= 4
    assert (drawn.observed[patch] == (3, -2)).all()
    assert (drawn.confidence[patch] == 0.5).all()
    assert not drawn.observed[~patch].any()
    assert not drawn.confidence[~patch].any()


@given(st.tuples(st.floats(0, SHAPE[0] - 1), st.floats(0, SHAPE[1] - 1)))
@settings(max_examples=30)
def test_the_smallest_patch_contains_a_pixel(place):
    drawn = Drawing((Arrow(place, (1, 1), radius=1e-6),)).render(Canvas.blank(SHAPE, SPACING))
    nearest = tuple(round(along) for along in place)
    assert drawn.confidence[nearest].all()
    assert 1 <= (drawn.confidence[..., 0] > 0).sum() <= 4


def test_an_arrow_of_one_component_does_not_change_the_other_component():
    base = Canvas.blank((9, 9))
    base.observed[:], base.confidence[:] = (0, 5), (0, 1)
    drawn = Drawing((Arrow((4, 4), (2, 7), radius=1, components="row"),)).render(base)
    assert tuple(drawn.observed[4, 4]) == (2, 5)
    assert tuple(drawn.confidence[4, 4]) == (1, 1)
    assert not drawn.observed[0, 0, 0]


def test_the_held_edge_is_free_around_a_pull_that_takes_it_along():
    base = Canvas.blank((20, 60))
    base.confidence[0], base.edge[0] = 1, True
    hold, pull = Arrow((0, 14), (0, 0), 1), Arrow((2, 20), (4, 0), 3, slack=2)

    def held_edge(*marks):
        drawn = Drawing(marks).render(base)
        moves = drawn.observed[0].any(axis=-1)
        return np.flatnonzero(~moves & (drawn.confidence[0] > 0).all(axis=-1)).tolist()

    far = [*range(12), *range(29, 60)]  # within 9 of the centre, the edge is free
    assert held_edge(pull) == far
    assert held_edge(hold, pull) == held_edge(pull, hold) == [*range(12), 13, 14, 15, *far[12:]]
    still = replace(pull, by=(0, 0)), replace(pull, at=(5, 20)), Arrow((2, 20), (4, 0), 3)
    assert [len(held_edge(each)) for each in still] == [60, 60, 55]


def test_a_later_mark_covers_an_earlier_mark():
    first, second = Arrow((5, 5), (1, 0), 3), Arrow((5, 7), (0, 1), 3)
    one = Drawing((first, second)).render(Canvas.blank((12, 14)))
    other = Drawing((second, first)).render(Canvas.blank((12, 14)))
    assert tuple(one.observed[5, 6]) == (0, 1)
    assert tuple(other.observed[5, 6]) == (1, 0)


def test_a_landmark_moves_its_source_to_its_target():
    drawn = Drawing((Landmark((4, 5), (6, 2), radius=0.5),)).render(Canvas.blank((9, 9), (0.5, 2)))
    assert tuple(drawn.observed[4, 5]) == (1.0, -6.0)


@pytest.mark.parametrize("source", [(3.3, 9.7, 10.2), (3.0, 9.0, 10.0), (6.9, 0.2, 18.9)])
def test_a_landmark_between_slices_moves_as_far_as_asked(source):
    """The displacement is interpolated between slices that are further apart than the patch."""
    target = tuple(at + by for at, by in zip(source, (0.5, 2.0, -1.0), strict=True))
    blank = Canvas.blank((8, 20, 20), (3.0, 0.5, 0.5))
    drawn = Drawing((Landmark(source, target, radius=0.5),)).render(blank)
    moved = [
        map_coordinates(drawn.observed[..., axis], np.reshape(source, (3, 1)), order=1).item()
        for axis in range(3)
    ]
    assert moved == pytest.approx((1.5, 1.0, -0.5), rel=1e-6)


def test_a_landmark_between_slices_moves_no_pixel_of_an_earlier_landmark():
    blank = Canvas.blank((4, 9, 9), (3.0, 1.0, 1.0))
    marks = Landmark((1, 4, 4), (2, 4, 4), 1.0), Landmark((1.6, 4, 4), (1.6, 4, 5), 1.0)
    alone, both = (Drawing(marks[:count]).render(blank) for count in (1, 2))
    held = (alone.confidence > 0).any(axis=-1)
    np.testing.assert_array_equal(both.observed[held], alone.observed[held])
    assert tuple(both.observed[2, 4, 4]) == (0, 0, 1)


def test_brushes_pin_free_and_move_the_painted_pixels():
    line = (((5, 2), (5, 12)),)
    base = canvas((11, 15), (1.0, 1.0))
    for action, moved, certain in [("pin", (0, 0), 1), ("free", (0, 0), 0), ("move", (2, 1), 1)]:
        drawn = Drawing((Stroke(action, line, radius=1, by=(2, 1)),)).render(base)
        assert (drawn.observed[4:7, 2:13] == moved).all()
        assert (drawn.confidence[4:7, 2:13] == certain).all()
        assert np.array_equal(drawn.observed[:4], base.observed[:4])
        assert np.array_equal(drawn.confidence[:, 14], base.confidence[:, 14])


def test_a_painted_ring_expands_outward_and_shrinks_inward():
    turn = np.linspace(0, 2 * np.pi, 60)
    ring = tuple(zip(20 + 10 * np.sin(turn), 20 + 10 * np.cos(turn), strict=True))
    rows, cols = np.indices((41, 41)) - 20
    outward = np.stack([rows, cols], axis=-1) / np.maximum(np.hypot(rows, cols), 1)[..., None]
    for amount in (2, -2):
        stroke = Stroke("expand", (ring,), radius=1.5, amount=amount)
        drawn = Drawing((stroke,)).render(Canvas.blank((41, 41)))
        painted = drawn.confidence[..., 0] > 0
        assert painted.sum() > 150
        along = (drawn.observed * outward).sum(axis=-1)[painted] / amount
        assert along.min() > 0.98
        assert np.allclose(np.linalg.norm(drawn.observed[painted], axis=-1), 2, atol=1e-5)


def test_an_open_line_that_expands_is_refused_and_changes_no_pixel():
    good = Drawing((Arrow((5, 5), (1, 0), 2),))
    bad = good.with_mark(Stroke("expand", (((10, 2), (10, 38)),), radius=1, amount=1))
    rendering = Rendering(Canvas.blank((20, 40)))
    rendering.show(good)
    with pytest.raises(ProblemError, match="open line"):
        rendering.show(bad)
    assert rendering.drawing == good
    assert same(rendering.canvas, good.render(Canvas.blank((20, 40))))


def test_a_soft_brush_fades_the_confidence_of_observed_pixels():
    base = Canvas.blank((21, 21))
    base.observed[:, :15], base.confidence[:, :15] = (1, 0), 1
    stroke = Stroke("confidence", (((10, 10),),), radius=8, confidence=0.2, softness=0.5)
    drawn = Drawing((stroke,)).render(base)
    across = drawn.confidence[10, 10:15, 0]
    assert across[0] == pytest.approx(0.2)
    assert (np.diff(drawn.confidence[10, 3:10, 0]) <= 0).all()
    assert 0.2 < drawn.confidence[10, 4, 0] < 1
    assert not drawn.confidence[:, 15:].any(), "the brush made an unobserved pixel observed"
    assert np.array_equal(drawn.observed, base.observed)


def test_a_tissue_brush_paints_labels():
    stroke = Stroke("tissue", (((5, 5), (5, 9)),), radius=1, label=3)
    drawn = Drawing((stroke,)).render(canvas((12, 12), (1.0, 1.0)))
    assert (drawn.labels[4:7, 5:10] == 3).all()
    assert (drawn.labels == 3).sum() < 25


def test_tissue_follows_the_drawing():
    held = Stroke("pin", (((0, 0), (0, 19), (19, 19), (19, 0), (0, 0)),), radius=0.5)
    drawn = Drawing((held, Arrow((10, 10), (2, 1), radius=2))).render(Canvas.blank((20, 20)))
    moved = solve(
        Problem(observed=drawn.observed, confidence=drawn.confidence, stiffness=np.ones((20, 20))),
        ElasticPrior(),
    ).displacement
    assert moved[10, 10] == pytest.approx((2, 1), abs=1e-3)
    assert 0.2 < moved[10, 4, 0] < 1.8
    assert not moved[0].any()


@pytest.mark.parametrize(
    ("make", "hint"),
    [
        (lambda: Arrow((0, float("nan")), (1, 1), 2), r"at must be finite numbers: \(row, col\)"),
        (lambda: Arrow((0, 0), (1, float("inf")), 2), r"by must be finite numbers: \(row, col\)"),
        (lambda: Stroke("tissue", (((0, 0),),), 2, label=0.5), "label must be a whole number"),
        (lambda: Arrow((0, 0), (1, 1), 0), "radius must be a number above 0"),
        (lambda: Arrow((0, 0), (1, 1), 2, confidence=0), "confidence must be .* above 0, up to 1"),
        (lambda: Arrow((0, 0), (1, 1), 2, components="z"), "components must be both, row or col"),
        (lambda: Landmark((0, 0), (1, 1), 2, sd=-1), "sd must be a length above 0, or 0"),
        (lambda: Stroke("melt", (((0, 0),),), 1), "action must be pin, free"),
        (lambda: Stroke("pin", (), 1), "lines must be the paths of a brush"),
        (lambda: Stroke("pin", ((),), 1), "lines must be the paths of a brush"),
        (lambda: Stroke("pin", (((0, 0),),), 1).onward((0,)), "point must be finite numbers"),
        (
            lambda: Arrow((0, 0), (1, 1), 2, motion=(1, 1)),
            "motion: input should be",
        ),
        (lambda: Arrow((0, 0, 0), (1, 1), 2), r"must all be \(row, col\)"),
        (lambda: Stroke("pin", (((0, 0), (1, 2, 3)),), 1), r"must all be \(row, col\)"),
    ],
)
def test_invalid_marks_are_refused(make, hint):
    with pytest.raises(ArgumentError, match=hint):
        make()


def test_a_path_may_be_an_array():
    path = np.array([[0, 1], [2, 3]])
    plain = Stroke("pin", (((0.0, 1.0), (2.0, 3.0)),), 1)
    assert Stroke("pin", path[None], 1) == Stroke("pin", [path], 1) == plain


# Edits


def test_an_edit_returns_a_new_drawing():
    empty = Drawing()
    arrow, other = Arrow((1, 1), (1, 0), 1), Arrow((5, 5), (0, 1), 1)
    one = empty.with_mark(arrow)
    two = one.with_mark(other)
    assert (empty.marks, one.marks) == ((), (arrow,))
    assert two.replaced(0, other).marks == (other, other)
    assert two.without(0).marks == (other,)
    assert two.marks == (arrow, other)
    for number in (-1, 2):
        with pytest.raises(IndexError):
            two.without(number)


def test_an_arrow_is_hit_at_its_head_or_its_base():
    drawing = Drawing(
        (
            Arrow((10, 10), (4, 8), radius=2),
            Landmark((10, 14.5), (20, 20), radius=2),
            Stroke("pin", (((0, 0),),), 3),
        )
    )
    spacing = (1.0, 2.0)  # The head of the arrow is at (14, 14).
    assert drawing.at((10, 10.2), 1.5, spacing) == Hit(0, "base")
    assert drawing.at((14, 14), 1.5, spacing) == Hit(0, "head")
    assert drawing.at((20.5, 20), 1.5, spacing) == Hit(1, "head")
    assert drawing.at((10, 14), 1.5, spacing) == Hit(1, "base")
    assert drawing.at((10, 11), 1.5, spacing) is None, "a hit at one pixel, but two lengths"
    assert drawing.at((0, 0), 1.5, spacing) is None
    on_top = drawing.with_mark(Arrow((10, 10), (1, 1), 1))
    assert on_top.at((10, 10), 0.5, spacing) == Hit(3, "base"), "the earlier of two marks was hit"


@given(st.lists(marks, max_size=4), st.lists(edits, max_size=12))
@settings(max_examples=25)
def test_an_updated_rendering_equals_a_new_rendering(begin, sequence):
    drawing, base = Drawing(tuple(begin)), canvas()
    rendering, before = Rendering(base), base.copy()
    rendering.show(drawing)
    for edit in sequence:
        old = rendering.canvas.copy()
        drawing = edited(drawing, edit)
        window = rendering.show(drawing)
        assert same(rendering.canvas, drawing.render(base))
        if window is not None:
            for mine, its in zip(old.images, rendering.canvas.images, strict=True):
                mine[window] = its[window]
        assert same(old, rendering.canvas), "a pixel changed outside the reported window"
    assert same(base, before)


@given(st.lists(edits, max_size=25))
@settings(max_examples=20)
def test_undo_and_redo_restore_the_drawing_exactly(sequence):
    """Compare with two lists of drawings, in which a drag is one step."""
    base, model = canvas(), Session()
    said = []
    model.changed.connect(lambda _, value: said.append(value))
    past, now, future = [], Drawing(), []

    def step(new, first):
        nonlocal now
        if new != first:
            past.append(first)
            future.clear()
        now = new

    for edit in sequence:
        what, number, mark, place = edit
        if what == "undo":
            assert bool(model.undo()) == bool(past)
            if past:
                future.append(now)
                now = past.pop()
        elif what == "redo":
            assert bool(model.redo()) == bool(future)
            if future:
                past.append(now)
                now = future.pop()
        elif what in ("drag", "drop"):
            first = now
            model.begin_drawing("dragged")
            moved = first
            for kind in ("add", "replace", "onward"):
                moved = edited(moved, (kind, number, mark, place))
                model.update_drawing(moved)
            if what == "drag":
                model.end_drawing()
                step(moved, first)
            else:
                model.cancel_drawing()
        else:
            model.draw(edited(now, edit), what)
            step(edited(now, edit), now)
        assert model.drawing == now
        assert same(model.drawing.render(base), now.render(base))
    assert not said or said[-1] == now
    for earlier in reversed(past):
        model.undo()
        assert model.drawing == earlier
        assert same(model.drawing.render(base), earlier.render(base))
    assert model.undo() is None


def test_steps_have_descriptions_and_unchanged_drawings_add_no_step():
    arrow, model = Arrow((1, 1), (1, 0), 1), Session()
    model.draw(Drawing((arrow,)), "drew an arrow")
    model.draw(Drawing((arrow,)), "did nothing")
    model.begin_drawing("moved an arrow")
    for by in (2, 3, 4):
        model.update_drawing(Drawing((Arrow((1, 1), (by, 0), 1),)))
    assert (model.next_undo.word, model.drawing_in_progress) == ("moved an arrow", True)
    assert model.undo().word == "moved an arrow"
    assert (model.drawing.marks, model.next_undo.word) == ((arrow,), "drew an arrow")
    assert model.next_redo.word == "moved an arrow"
    model.redo()
    assert model.drawing.marks[0].by == (4, 0)
    assert model.redo() is None
    with pytest.raises(RuntimeError, match="begin"):
        model.update_drawing(Drawing())


def test_history_drops_the_oldest_steps():
    model = Session(3)
    for number in range(1, 6):
        model.draw(Drawing((Arrow((number, 0), (1, 0), 1),)), f"step {number}")
    assert [model.undo().word for _ in range(3)] == ["step 5", "step 4", "step 3"]
    assert model.drawing.marks[0].at == (2, 0)


@pytest.mark.parametrize(
    ("kind", "by"),
    [("arrow", (0.0, 3.0)), ("arrow", (0.0, 0.0)), ("landmark", (0.0, 3.0)), ("push", (0.0, 3.0))],
)
def test_a_pulled_patch_that_grows_moves_its_rim_and_keeps_its_centre(kind, by):
    place = 20.0, 20.0
    mark = {
        "arrow": Arrow(place, by, 8.0, 0.5, amount=2.0),
        "landmark": Landmark(place, tuple(map(sum, zip(place, by, strict=True))), 8.0, 0.5, 2.0),
        "push": Stroke("move", ((place,),), 8.0, by=by, confidence=0.5, amount=2.0),
    }[kind]
    image = Drawing((mark,)).render(Canvas.blank((41, 41)))
    across = image.observed[20, [12, 28], 1]
    assert across == pytest.approx((by[1] - 2, by[1] + 2), abs=0.01)
    assert not image.confidence[20, [11, 17, 23, 29]].any(), "the interior is not free"
    is_observed = kind != "push"
    assert image.confidence[20, 20, 1] == 0.5 * is_observed
    assert image.observed[20, 20, 1] == by[1] * is_observed


# Storage


@given(st.lists(marks, max_size=5))
@settings(max_examples=30)
def test_a_drawing_survives_storage_as_json(made):
    drawing = Drawing(tuple(made))
    assert Drawing.from_dict(json.loads(json.dumps(drawing.as_dict()))) == drawing


@pytest.mark.parametrize(
    "values",
    [
        None,
        {"colour": 1},
        {"marks": [{"class": "Spell"}]},
        {"marks": [{"class": "Arrow", "at": [0, 0]}]},
        {"marks": [{"class": "Arrow", "at": [0], "by": [1, 1], "radius": 1}]},
        {"marks": [{"at": [0, 0]}]},
        {"marks": 3},
    ],
)
def test_invalid_stored_drawings_are_refused(values):
    with pytest.raises(ValueError, match="not a drawing: "):
        Drawing.from_dict(values)


def test_an_edit_of_a_large_image_redraws_only_the_changed_pixels():
    rendering = Rendering(Canvas.blank((1200, 1200)))
    zigzag = tuple((10.0 + 5 * number % 1100, 3.0 * number) for number in range(390))
    drawing = Drawing((Stroke("pin", (zigzag,), 12), Arrow((600, 600), (5, 5), 60)))
    rendering.show(drawing)

    def most(edit):
        nonlocal drawing
        pixels = []
        for number in range(1, 4):
            drawing = edit(drawing, number)
            window = rendering.show(drawing)
            pixels.append(rendering.canvas.observed[window][..., 0].size)
        return max(pixels)

    def drag(drawing, number):
        return drawing.replaced(1, Arrow((600, 600), (5, number), 60))

    def brush(drawing, number):
        return drawing.replaced(0, drawing.marks[0].onward((900.0, 40.0 + 5 * number)))

    assert most(drag) <= 125**2
    drawing = brush(drawing, 0)
    rendering.show(drawing)
    assert most(brush) <= 40**2


def test_the_advice_against_folds_is_effective():
    """Check the advice for tissue with a prescribed edge.

    A smaller motion does not fold. A larger patch has fewer folds in the middle of the image.
    """
    base = Canvas.blank((96, 96))
    base.confidence[...] = 1
    base.confidence[2:-2, 2:-2] = 0

    def folds(col, by, radius):
        rendering = Rendering(base)
        rendering.show(Drawing((Arrow((48, col), (0, by), radius),)))
        canvas = rendering.canvas
        problem = Problem(
            observed=canvas.observed, confidence=canvas.confidence, stiffness=np.ones(base.shape)
        )
        solution = solve(problem, ElasticPrior(), optimizer=Multigrid(0.05), backend="cpu")
        return count_folds(solution.displacement, spacing=solution.spacing, tissue=solution.tissue)

    assert folds(48, 8, 4) == folds(70, 8, 4) == 0 < folds(48, 20, 4)
    assert folds(48, 20, 8) < folds(48, 20, 4)
    assert folds(70, 14, 16) > folds(70, 14, 4) > 0, "a larger patch at the edge folds less"


def test_a_drawing_refuses_a_single_mark_and_other_types():
    arrow = Arrow((8, 8), (0, 2), 3)
    for wrong in (arrow, None, (1,), "arrow"):
        with pytest.raises(ArgumentError, match=r"marks must be a tuple of Arrow, .* Drawing\(\(A"):
            Drawing(wrong)
    assert Drawing([arrow]) == Drawing((arrow,))
    assert repr(Drawing([arrow, arrow])) == "Drawing(2 Arrow)"


def test_a_landmark_with_a_standard_deviation_changes_no_pixel():
    mark = Landmark((10.0, 10.0), (12.0, 10.0), 3.0, sd=1.0)
    rendering = Rendering(Canvas.blank((20, 40)))
    assert rendering.show(Drawing((mark,))) is None
    assert rendering.drawing == Drawing((mark,))
    assert rendering.show(Drawing((replace(mark, sd=0),))) is not None
    assert rendering.canvas.confidence.any()
    rendering.show(Drawing((mark,)))
    assert not rendering.canvas.confidence.any()
