"""Tests that layers and arrays are read as the same problem and give the same field."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as some
from napari.layers import Image, Labels, Points, Vectors

from napari_hmrf import ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.study.ground import Ground, build_problem
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import RIGID, BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Rendering, Stroke
from tests.support.study_reader import read_ground

SHAPE = (18, 22)
SPACING = (0.5, 0.8)
PLACE = {"scale": SPACING, "translate": (3.0, -2.0)}

shares = some.floats(0.0, 1.0, width=32)
lengths = some.floats(-3.0, 3.0, width=32)
rows, cols = some.integers(2, SHAPE[0] - 3), some.integers(2, SHAPE[1] - 3)
places = some.tuples(rows.map(float), cols.map(float))
stiffnesses = some.sampled_from([0.0, 0.5, 1.0, 20.0, 400.0, RIGID])
materials = some.tuples(
    *(some.builds(Material, some.just(label), some.just("t"), stiffnesses) for label in (0, 2, 3)),
    some.builds(Material, some.just(1), some.just("t"), some.just(3.0)),
)
confidences = some.tuples(shares, shares)
rules = some.tuples(
    some.builds(
        BoundaryRule,
        some.just(1),
        some.just("move"),
        vector=some.tuples(lengths, lengths),
        confidence=confidences,
    ),
    some.just(BoundaryRule(2, "fixed")),
)
marks = some.lists(
    some.one_of(
        some.builds(Arrow, places, some.tuples(lengths, lengths), some.floats(0.5, 2)),
        some.builds(Landmark, places, places, some.floats(0.5, 2)),
        some.builds(
            Stroke,
            some.sampled_from(["pin", "free", "move", "confidence"]),
            places.map(lambda at: ((at,),)),
            some.floats(0.5, 3),
            by=some.tuples(lengths, lengths),
            confidence=shares,
        ),
    ),
    max_size=4,
).map(lambda found: Drawing(tuple(found)))
seeds = some.integers(0, 2**20)


def painted(seed):
    """Return random labels of tissue and of boundary, with a fixed column."""
    rng = np.random.default_rng(seed)
    tissue = np.kron(rng.integers(0, 4, (6, 8)), np.ones((3, 3), int))[: SHAPE[0], : SHAPE[1]]
    tissue[:, :6] = 1
    boundary = np.where(rng.random(SHAPE) < 0.05, 1, 0)
    boundary[:, 0] = 2
    return tissue.astype(np.uint8), boundary.astype(np.uint8)


def same_problem(one, other):
    for name in ("observed", "confidence", "stiffness"):
        mine, its = getattr(one.problem, name), getattr(other.problem, name)
        np.testing.assert_array_equal(mine, its, err_msg=name)
    assert one.problem.spacing == other.problem.spacing
    np.testing.assert_array_equal(one.prior.kernels, other.prior.kernels)
    assert one.prior == other.prior


@settings(deadline=None, max_examples=8, suppress_health_check=[HealthCheck.too_slow])
@given(seeds, materials, rules, marks, some.booleans())
def test_layers_and_arrays_give_the_same_problem(seed, table, rules, drawing, hold_edge):
    tissue, boundary = painted(seed)
    picture = np.full(SHAPE, 7, np.uint8)
    layers = {
        "image": Image(picture, name="MR", **PLACE),
        "tissue": Labels(tissue, metadata=layer_metadata(TISSUE, table), **PLACE),
        "boundary": Labels(boundary, metadata=layer_metadata(BOUNDARY, rules), **PLACE),
    }
    by_layers = study_from_layers(Request(**layers, hold_edge=hold_edge, drawing=drawing))
    by_arrays = Study(
        Grid(SHAPE, SPACING),
        Tissue(labels=tissue, materials=table),
        Motion(hold_edge, boundary, rules, drawing=drawing),
        pictures=Pictures(picture),
    )
    same_problem(build_problem(by_layers), build_problem(by_arrays))


@settings(deadline=None, max_examples=6, suppress_health_check=[HealthCheck.too_slow])
@given(seeds, materials, rules, some.lists(marks, min_size=2, max_size=4))
def test_successive_drawings_give_the_problem_of_the_last_drawing(seed, table, rules, drawings):
    tissue, boundary = painted(seed)
    ground = read_ground(
        Image(np.full(SHAPE, 7, np.uint8), **PLACE),
        Labels(tissue, metadata=layer_metadata(TISSUE, table), **PLACE),
        Labels(boundary, metadata=layer_metadata(BOUNDARY, rules), **PLACE),
    )
    rendering = Rendering(ground.base)
    for drawing in drawings:
        rendering.show(drawing)
    motion = replace(ground.study.motion, drawing=drawings[-1])
    at_once = build_problem(replace(ground.study, motion=motion))
    same_problem(ground.statement(rendering.canvas), at_once)


@settings(deadline=None, max_examples=5, suppress_health_check=[HealthCheck.too_slow])
@given(some.lists(some.tuples(places, places), min_size=1, max_size=4, unique_by=lambda p: p[0]))
def test_landmarks_from_layers_and_from_a_study_give_the_same_problem(pairs):
    where, should = (np.array(each) for each in zip(*pairs, strict=True))
    image, stiffness = Image(np.zeros(SHAPE), **PLACE), np.ones(SHAPE)
    points = Points(where, **PLACE), Points(should, **PLACE)
    marks = read_landmarks(*points, frame_of(image), SHAPE, radius=0.1)
    asked = Request(tissue=Image(stiffness, **PLACE), image=image, drawing=Drawing(marks))
    own = Drawing(tuple(Landmark(at, to, 0.1) for at, to in pairs))
    study = Study(
        Grid(SHAPE, SPACING),
        Tissue(stiffness=stiffness),
        Motion(drawing=own),
        pictures=Pictures(np.zeros(SHAPE)),
    )
    same_problem(build_problem(study_from_layers(asked)), build_problem(study))


def test_arrows_and_an_observed_field_give_the_same_problem():
    rng = np.random.default_rng(3)
    starts = np.argwhere(rng.random(SHAPE) < 0.3)
    steps = rng.normal(size=starts.shape)
    sure = rng.random(SHAPE)
    asked = Request(
        tissue=Image(np.ones(SHAPE), **PLACE),
        boundary=Vectors(np.stack([starts, steps], axis=1), **PLACE),
        confidence=Image(sure, **PLACE),
    )
    observed, counts = np.zeros((*SHAPE, 2), np.float32), np.zeros(SHAPE)
    observed[tuple(starts.T)] = steps * SPACING
    counts[tuple(starts.T)] = sure[tuple(starts.T)]
    motion = Motion(observed=observed, confidence=counts)
    study = Study(Grid(SHAPE, SPACING), Tissue(stiffness=np.ones(SHAPE)), motion)
    same_problem(build_problem(study_from_layers(asked)), build_problem(study))


@pytest.fixture
def tumour(frame):
    """Return the dock of a viewer with painted tissue and a boundary of low confidence."""
    viewer, dock = frame.viewer, frame.open()
    tissue, boundary = np.ones(SHAPE, np.uint8), np.zeros(SHAPE, np.uint8)
    tissue[6:10, 8:14] = 2
    boundary[:, 0], boundary[4:12, -1], boundary[8, 10] = 1, 2, 3
    table = (Material(1, "fat", 2.0, 0.4), Material(2, "gland", 9.0, 0.3))
    said = (
        BoundaryRule(1, "fixed"),
        BoundaryRule(2, "move", vector=(0.5, -1.0)),
        BoundaryRule(3, "fixed", confidence=(0.3, 0.3)),
    )
    viewer.add_image(np.full(SHAPE, 7, np.uint8), name="MR", **PLACE)
    viewer.add_labels(tissue, name="Tissue", metadata=layer_metadata(TISSUE, table, "kPa"), **PLACE)
    viewer.add_labels(boundary, name="Boundary", metadata=layer_metadata(BOUNDARY, said), **PLACE)
    dock.device = "cpu"
    return dock


def test_a_drawing_is_combined_with_the_painted_boundary(tumour):
    before = build_problem(tumour.study)
    assert before.prior.can_slip(before.problem)
    assert tumour.start()
    same_problem(before, build_problem(tumour.study))
    tumour.drawing = Drawing((Arrow((9.0, 6.0), (0.0, 1.0), 1.5),))
    drawn = build_problem(tumour.study)
    assert drawn.prior.can_slip(drawn.problem)
    at = drawn.problem.observed[9, 6], drawn.problem.confidence[9, 6]
    assert np.all(at == np.array([(0.0, 1.0), (1.0, 1.0)]))
    elsewhere = np.s_[13:]
    np.testing.assert_array_equal(
        before.problem.observed[elsewhere], drawn.problem.observed[elsewhere]
    )


@pytest.mark.parametrize("energy", ["elastic", pytest.param("paper", marks=pytest.mark.campaign)])
def test_the_window_and_python_give_the_same_field_bit_by_bit(tumour, qtbot, energy):
    deform = tumour
    deform.live = False
    deform.model = energy
    with qtbot.waitSignal(deform.finished, timeout=240_000):
        deform.deform()
    seen = deform.solution
    stated = build_problem(deform.study)
    kind = {"elastic": (ElasticPrior, Multigrid), "paper": (SeilerPrior, object)}[energy]
    assert isinstance(stated.prior, kind[0])
    assert isinstance(stated.optimizer, kind[1])
    found = solve(
        stated.problem, stated.prior, optimizer=stated.optimizer, backend=seen.provenance.backend
    )
    np.testing.assert_array_equal(found.displacement, seen.displacement)
    assert found.provenance.parameters["prior"] == seen.provenance.parameters["prior"]
    assert found.provenance.inputs == seen.provenance.inputs


def test_the_preview_while_pulling_equals_the_field_of_python(tumour, qtbot):
    grab = tumour
    assert grab.start()
    seen = []
    grab.deformation_changed.connect(seen.append)
    for by in (1.0, 1.5, 2.0):
        grab.drawing = Drawing((Arrow((9.0, 6.0), (0.0, by), 1.5),))
    qtbot.waitUntil(lambda: not grab.busy, timeout=240_000)
    stated = build_problem(grab.study)
    cold = solve(stated.problem, stated.prior, optimizer=stated.optimizer)
    warm = next(each.solution for each in reversed(seen) if each.solution is not None)
    pixels = np.abs(warm.displacement - cold.displacement)[Ground.of(grab.study).body] / SPACING
    assert pixels.max() <= warm.convergence.error + cold.convergence.error
