"""Tests of patches that grow or shrink: a prescribed outline and a free inside."""

from itertools import product

import numpy as np
import pytest

from napari_hmrf import (
    BoundaryRule,
    Drawing,
    ElasticPrior,
    Grid,
    Motion,
    SeilerPrior,
    Stroke,
    Study,
    Tissue,
    build_problem,
    solve_study,
)
from napari_hmrf.fields import fold_mask, jacobian_determinant
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.tissue.usual_lengths import usual_radius, usual_step

SHAPE, RADIUS = (121, 121), 30.0


def away(middle):
    return np.hypot(*np.indices(SHAPE) - np.array(middle)[:, None, None])


def by_brush(middle, amount):
    """Return a motion with one dab of a brush."""
    stroke = Stroke("expand", ((middle,),), radius=RADIUS, amount=amount)
    return Motion(hold_edge=True, drawing=Drawing((stroke,)))


def by_label(middle, amount):
    """Return the same motion, painted in a layer."""
    rule = BoundaryRule(1, "expand", amount=amount)
    return Motion(hold_edge=True, labels=(away(middle) <= RADIUS).astype(int), rules=(rule,))


def study_of(motion, stiffness=None, **how):
    m = np.ones(SHAPE) if stiffness is None else stiffness
    return Study(Grid(SHAPE, (1, 1)), Tissue(stiffness=m), motion, **how)


ELASTIC, PAPER = (ElasticPrior(), Multigrid(), 0.06), (SeilerPrior(), ICM(), 0.15)
MIDDLE, NEAR_THE_EDGE = (60, 60), (60, 42)
SOME = [
    (by_brush, 6.0, NEAR_THE_EDGE, ELASTIC),
    (by_label, -6.0, NEAR_THE_EDGE, ELASTIC),
    (by_brush, 1.0, MIDDLE, ELASTIC),
    (by_label, 6.0, MIDDLE, PAPER),
]
OTHERS = [
    case
    for case in product(
        (by_brush, by_label), (1.0, 6.0, -6.0), (MIDDLE, NEAR_THE_EDGE), (ELASTIC, PAPER)
    )
    if case not in SOME
]


@pytest.mark.parametrize(
    ("paint", "amount", "middle", "solver"),
    [*SOME, *(pytest.param(*case, marks=pytest.mark.campaign) for case in OTHERS)],
)
def test_the_inside_of_a_patch_grows_evenly(paint, amount, middle, solver):
    """Check that the middle neither tears nor folds, as it did when every pixel was prescribed."""
    prior, optimizer, even = solver
    model = {"prior": prior, "optimizer": optimizer}
    field = solve_study(study_of(paint(middle, amount), **model)).displacement
    area, far = jacobian_determinant(field, spacing=1), away(middle)
    assert not fold_mask(field, spacing=1).any()
    assert area[far < RADIUS - 3] == pytest.approx((1 + amount / RADIUS) ** 2, rel=even)
    outline = field[(far <= RADIUS) & (far > RADIUS - 1)]
    assert np.linalg.norm(outline, axis=-1) == pytest.approx(abs(amount), rel=0.01)


@pytest.mark.parametrize(
    ("shape", "spacing"),
    [
        ((90, 120), (1.0, 1.0)),
        pytest.param((40, 40, 48), (1.0, 1.0, 1.0), marks=pytest.mark.campaign),
        ((12, 36, 36), (3.0, 1.0, 1.0)),
    ],
)
def test_a_patch_that_grows_by_the_default_step_does_not_fold(shape, spacing):
    """Test volumes too: tissue around a ball is squeezed twice as much as around a disc."""
    radius, step = usual_radius(shape, spacing), usual_step(shape, spacing)
    assert step > 0.1 * radius, "the step is too small to see"
    middle = tuple(size / 2 for size in shape)
    ball = Stroke("expand", ((middle,),), radius=radius, amount=step)
    motion = Motion(hold_edge=True, drawing=Drawing((ball,)))
    field = solve_study(Study(Grid(shape, spacing), Tissue(stiffness=np.ones(shape)), motion))
    assert not fold_mask(field.displacement, spacing=spacing).any()


def test_a_brush_and_a_layer_give_the_same_problem():
    brushed, painted = (
        build_problem(study_of(paint((60, 60), 6.0))).problem for paint in (by_brush, by_label)
    )
    np.testing.assert_array_equal(brushed.confidence, painted.confidence)
    np.testing.assert_allclose(brushed.observed, painted.observed, atol=1e-5)


def with_air_above(paint):
    """Return the problem of a patch at the surface of tissue with air above it."""
    air_above = np.ones(SHAPE)
    air_above[:60] = 0
    return build_problem(study_of(paint((60, 60), 2.0), air_above)).problem


def test_the_inside_of_a_painted_label_is_free_at_the_edge_of_the_tissue():
    known = with_air_above(by_label).known.any(axis=-1)
    assert known[60, :31].all(), "the tissue edge beside the patch or the rim of the patch is free"
    assert not known[60, 33:88].any()
    assert known[60, 89:].all()


def test_a_brushed_patch_at_the_edge_of_the_tissue_grows_outward():
    problem = with_air_above(by_brush)
    assert problem.known.any(axis=-1)[60].all()
    assert (problem.observed[60, 40:80, 0] < -1).all(), "the surface moves towards the air"
    assert not problem.known[65:70, 50:70].any(), "the inside of the patch is not free"
