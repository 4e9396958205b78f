"""Quadratic data term: a precision at each site, and landmarks between pixels."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    ElasticPrior,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import Loads
from napari_hmrf.solver.data_term import combined_data
from validation.oracles.posterior import posterior_mean
from validation.problems import random_tensors, tissue_with_data

observed_tissue = partial(tissue_with_data, has_landmarks=False)

GRIDS = [
    ((20, 26), (1, 1)),
    ((24, 18), (1, 2)),
    ((9, 10, 11), (1, 1, 1)),
    ((8, 9, 10), (2, 1, 1.5)),
]


def paired(values):
    """Return each grid with one of some values; all other combinations are campaigns."""
    regular = [(*grid, *values[k % len(values)]) for k, grid in enumerate(GRIDS)]
    every = [(*grid, *value) for grid in GRIDS for value in values]
    return regular + [
        pytest.param(*case, marks=pytest.mark.campaign) for case in every if case not in regular
    ]


def largest_error(solution, problem, prior):
    far = np.abs(solution.displacement - posterior_mean(problem, prior))
    return float(far.max()) / problem.unit


@pytest.mark.parametrize(
    ("grid", "spacing", "strength", "rank"), paired([(1e-3, 2), (1.0, 1), (1e4, 2), (1e4, 1)])
)
def test_data_of_any_strength_give_the_field_of_least_energy(grid, spacing, strength, rank):
    rng = np.random.default_rng(rank)
    for share in (1.0, 0.1):
        data = random_tensors(rng, grid, rank, strength, share)
        problem = observed_tissue(rng, grid, spacing, data, 30.0, is_held=True)
        prior = ElasticPrior(0.3)
        solution = solve(problem, prior, backend="cpu")
        assert largest_error(solution, problem, prior) <= 1e-3
        assert solution.convergence.error <= 1e-3


def test_data_alone_hold_tissue_of_any_contrast():
    rng = np.random.default_rng(5)
    data = random_tensors(rng, (24, 24), 2, share=0.2)
    problem = observed_tissue(rng, (24, 24), (1, 1), data, 1e4, is_held=False)
    prior = ElasticPrior(0.45)
    assert largest_error(solve(problem, prior, backend="cpu"), problem, prior) <= 1e-3


def test_beside_data_an_observation_that_slips_is_a_constant_force():
    y, c, force = np.zeros((16, 16, 2)), np.zeros((16, 16, 2)), np.zeros((16, 16, 2))
    c[0] = 1
    m, prior = np.full((16, 16), 5.0), ElasticPrior(0.3)
    force[8, 8, 0] = 1e-3 * prior.force_unit(Problem(observed=y, confidence=c, stiffness=m))
    # Without data at this site, which would pull it to the observed position.
    data = np.full((16, 16), 0.5)
    data[8, 8] = 0
    c[8, 8, 0], y[8, 8, 0] = 1e-3, 6
    slipping = solve(
        Problem(observed=y, confidence=c, stiffness=m, precision=data), prior, backend="cpu"
    )
    assert 0 < slipping.displacement[8, 8, 0] < 6
    c[8, 8, 0] = y[8, 8, 0] = 0
    loads = Loads(force=force)
    pushed = solve(
        Problem(observed=y, confidence=c, stiffness=m, precision=data, loads=loads),
        prior,
        backend="cpu",
    )
    assert np.abs(slipping.displacement - pushed.displacement).max() < 2e-3


def test_a_motion_that_meets_all_data_without_strain_has_no_energy():
    y = np.zeros((12, 12, 2))
    y[..., 0] = 1.5
    problem = Problem(
        observed=y, confidence=np.zeros_like(y), stiffness=np.ones((12, 12)), precision=2.0
    )
    solution = solve(problem, backend="cpu")
    assert solution.displacement == pytest.approx(y, abs=1e-5)
    assert solution.energy[-1] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("axes", [2, 3])
def test_the_energy_of_a_solution_is_that_of_its_strain_and_its_data(axes):
    rng, grid = np.random.default_rng(axes), (7, 6, 5)[:axes]
    y, data = rng.normal(size=(*grid, axes)), random_tensors(rng, grid, axes, 3.0)
    problem, prior = (
        Problem(
            observed=y,
            confidence=0 * y,
            stiffness=np.ones(grid),
            spacing=(1, 2, 1.5)[:axes],
            precision=data,
        ),
        ElasticPrior(0.3),
    )
    solution = solve(problem, prior, backend="cpu")
    missing = solution.displacement - problem.observed
    of_data = np.einsum("...i,...ij,...j", missing, problem.precision, missing).sum() / 2
    energy = of_data / (prior.force_unit(problem) * problem.unit)
    energy += prior.energy(problem, solution.displacement)
    assert solution.mean_energy * np.prod(grid) == pytest.approx(energy, rel=1e-4)


def test_strong_data_are_the_limit_of_a_prescribed_motion():
    y, c = np.zeros((30, 30, 2)), np.zeros((30, 30, 2))
    c[0] = 1
    y[20:24, 10:14] = (3, -1)
    soft = np.zeros((30, 30))
    soft[20:24, 10:14] = 1e5
    by_data = solve(
        Problem(observed=y, confidence=c, stiffness=np.ones((30, 30)), precision=soft),
        backend="cpu",
    )
    c[20:24, 10:14] = 1
    held = solve(Problem(observed=y, confidence=c, stiffness=np.ones((30, 30))), backend="cpu")
    assert np.abs(by_data.displacement - held.displacement).max() < 2e-3


@pytest.mark.parametrize("axes", [2, pytest.param(3, marks=pytest.mark.campaign)])
def test_a_unit_of_stiffness_has_no_effect_if_precision_has_it_too(axes):
    rng = np.random.default_rng(1)
    grid = (14,) * axes
    data = random_tensors(rng, grid, axes)
    y = rng.normal(size=(*grid, axes))
    fields = [
        solve(
            Problem(
                observed=y, confidence=0 * y, stiffness=unit * np.ones(grid), precision=unit * data
            ),
            backend="cpu",
        )
        for unit in (1.0, 1000.0)
    ]
    assert np.abs(fields[0].displacement - fields[1].displacement).max() < 2e-3


@pytest.mark.parametrize("axes", [2, pytest.param(3, marks=pytest.mark.campaign)])
def test_a_ball_turns_freely_within_a_surface_that_observes_the_normal(axes):
    size, radius = (42, 13) if axes == 2 else (26, 8)
    grid = (size,) * axes
    place = np.moveaxis(np.indices(grid), 0, -1) - (size - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    normal = place / np.maximum(away, 1)[..., None]
    surface = (np.abs(away - radius) <= 0.5)[..., None, None]
    data = 1000 * surface * normal[..., :, None] * normal[..., None, :]
    turn = np.zeros_like(place, float)
    turn[..., -2], turn[..., -1] = -0.1 * place[..., -1], 0.1 * place[..., -2]
    core = (away <= 3)[..., None]
    problem = Problem(
        observed=turn * core,
        confidence=core * np.ones(axes),
        stiffness=away <= radius + 0.5,
        precision=data,
    )
    # The observed displacement of the surface is 0: only its normal component counts.
    field = solve(problem, ElasticPrior(0.3), backend="cpu").displacement
    tissue = away <= radius + 0.5
    assert np.abs(field - turn)[tissue].max() < 0.02 * np.abs(turn)[tissue].max()


@pytest.mark.parametrize(
    "degrees", [17, *(pytest.param(degrees, marks=pytest.mark.campaign) for degrees in (0, 45))]
)
def test_a_block_slides_along_a_tilted_plane_and_keeps_its_distance(degrees):
    size, angle = 48, np.radians(degrees)
    along, normal = (
        np.array([np.sin(angle), np.cos(angle)]),
        np.array([np.cos(angle), -np.sin(angle)]),
    )
    place = np.moveaxis(np.indices((size, size)), 0, -1) - size / 2
    depth = place @ normal
    plane = np.abs(depth) <= 0.5
    y, c = np.zeros((size, size, 2)), np.zeros((size, size, 2))
    far = depth < -16
    y[far], c[far] = 4 * along, 1
    data = 1e3 * plane[..., None, None] * np.outer(normal, normal)
    problem = Problem(
        observed=y, confidence=c, stiffness=(depth < 0.6).astype(float), precision=data
    )
    field = solve(problem, ElasticPrior(0.3), backend="cpu").displacement
    middle = plane & (np.abs(place @ along) < 12)
    assert (field[middle] @ along).min() > 0.95 * 4
    assert np.abs(field[middle] @ normal).max() < 0.1


@pytest.mark.parametrize(("grid", "spacing", "sd"), paired([(0.02,), (0.5,), (5.0,)]))
def test_landmarks_give_the_posterior_mean_of_the_same_prior(grid, spacing, sd):
    rng = np.random.default_rng(3)
    points = rng.random((12, len(grid))) * (np.array(grid) - 1)
    marks = Landmarks(points, points + rng.normal(size=points.shape), sd=sd)
    none = np.zeros((*grid, len(grid)))
    problem, prior = (
        Problem(
            observed=none,
            confidence=none,
            stiffness=np.ones(grid),
            landmarks=marks,
            spacing=spacing,
        ),
        ElasticPrior(0.3),
    )
    solution = solve(problem, prior, backend="cpu")
    assert largest_error(solution, problem, prior) <= 1e-3


def test_many_certain_landmarks_in_a_volume_need_few_cycles():
    rng = np.random.default_rng(2)
    y, c = np.zeros((16, 16, 16, 3)), np.zeros((16, 16, 16, 3))
    c[0] = 1
    points = rng.random((60, 3)) * 15
    marks = Landmarks(points, points + rng.normal(size=points.shape), sd=0.02)
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((16, 16, 16)), landmarks=marks)
    solution = solve(problem, ElasticPrior(0.3), backend="cpu")
    assert solution.convergence.way == "cycles"
    assert len(solution.energy) <= 12


def test_landmarks_do_not_depend_on_the_unit_of_stiffness():
    points = np.array([(5.3, 6.1), (14.8, 12.2), (9.5, 3.25)])
    marks = Landmarks(
        points, points + np.array([1, 0.5]), sd=[0.2, 0.5, 1.0], scale=StrainScale(0.1, extent=5.0)
    )
    y, c = np.zeros((20, 20, 2)), np.zeros((20, 20, 2))
    c[0] = 1
    fields = [
        solve(
            Problem(observed=y, confidence=c, stiffness=unit * np.ones((20, 20)), landmarks=marks),
            backend="cpu",
        ).displacement
        for unit in (1.0, 1000.0)
    ]
    assert np.abs(fields[0] - fields[1]).max() < 2e-3


def test_a_certain_landmark_is_met_between_pixels():
    points = np.array([(5.3, 6.1), (14.8, 12.2)])
    targets = points + np.array([(1.0, 0.5), (-1.0, 2.0)])
    none = np.zeros((20, 20, 2))
    marks = Landmarks(points, targets, sd=0.001)
    solution = solve(
        Problem(observed=none, confidence=none, stiffness=np.ones((20, 20)), landmarks=marks),
        backend="cpu",
    )
    assert solution.at(points) == pytest.approx(targets - points, abs=2e-3)


@pytest.mark.parametrize(
    ("precision", "message"),
    [
        (-1.0, "not positive semidefinite"),
        (np.zeros((6, 6, 3)), "has shape"),
        (np.full((6, 6), np.nan), "NaN or infinite"),
        (np.broadcast_to([[1.0, 0.5], [0.0, 1.0]], (6, 6, 2, 2)), "not symmetric"),
        (np.broadcast_to([[1.0, 2.0], [2.0, 1.0]], (6, 6, 2, 2)), "not positive semidefinite"),
        (1e9, "confidence of 1"),
        ("strong", "Pass real numbers"),
    ],
)
def test_an_impossible_precision_is_refused_with_the_reason(precision, message):
    none = np.zeros((6, 6, 2))
    with pytest.raises(ProblemError, match=message) as refusal:
        Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), precision=precision)
    assert "precision" in str(refusal.value)


def test_landmarks_that_move_tissue_far_beyond_the_image_are_refused():
    none, at = np.zeros((6, 6, 2)), [(1.5, 1.5), (3.2, 2.0)]
    landmarks = Landmarks(at, [(2.5, 1.5), (3.2, 40.0)], sd=1.0)
    with pytest.raises(ProblemError, match=r"by up to 38 \(landmark number 1\), but the diagonal"):
        Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), landmarks=landmarks)


@pytest.mark.parametrize(
    ("points", "sd", "message"),
    [
        ([(1.5, 9.0)], 1.0, "outside the image"),
        ([(1.5, 1.5, 1.5)], 1.0, "3 coordinates"),
        ([(3.5, 3.5)], 1.0, "not between pixels of tissue"),
        ([(1.5, 1.5)], 1e-9, "prescribe what is more certain"),
        ([(1.5, 1.5)], -1.0, "not positive"),
        ([(1.5, 1.5)], [1.0, 2.0], "has shape"),
        ([(np.nan, 1.5)], 1.0, "NaN"),
    ],
)
def test_impossible_landmarks_are_refused_with_the_reason(points, sd, message):
    none, m = np.zeros((6, 6, 2)), np.ones((6, 6))
    m[3:5, 3:5] = 0
    with pytest.raises(ProblemError, match=message):
        Problem(
            observed=none, confidence=none, stiffness=m, landmarks=Landmarks(points, points, sd=sd)
        )


def test_landmarks_too_close_to_hold_the_rest_of_the_tissue_are_named_as_the_cause():
    none = np.zeros((6, 6, 2))
    marks = Landmarks([(1.2, 1.5), (1.3, 1.5)], [(1.2, 0.0), (1.3, 3.0)], sd=0.01)
    with pytest.raises(ProblemError) as refusal:
        solve(
            Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), landmarks=marks),
            backend="cpu",
        )
    assert refusal.value.field == "landmarks"


@pytest.mark.parametrize(
    "given", [{"strain": 1e30}, {"strain": 1e200}, {"extent": 1e200}, {"stiffness": 0}]
)
def test_a_scale_without_a_finite_energy_is_refused(given):
    with pytest.raises(ArgumentError, match=next(iter(given))):
        StrainScale(**given)


def test_data_that_leave_a_motion_free_are_refused():
    none = np.zeros((6, 6, 2))
    marks = Landmarks([(2.5, 2.5)], [(3.5, 2.5)], sd=1.0)
    with pytest.raises(ProblemError, match="by turning"):
        solve(
            Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), landmarks=marks),
            backend="cpu",
        )
    normals = np.broadcast_to(np.diag([1.0, 0.0]), (6, 6, 2, 2))
    with pytest.raises(ProblemError, match="along the column axis"):
        solve(
            Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), precision=normals),
            backend="cpu",
        )


def test_problems_with_equal_tensors_share_them_unless_tissue_differs():
    none, m, hole = np.zeros((8, 8, 2)), np.ones((8, 8)), np.ones((8, 8))
    hole[3, 3] = 0
    data = random_tensors(np.random.default_rng(0), (8, 8), 2)
    first = Problem(observed=none, confidence=none, stiffness=m, precision=data)
    assert (
        Problem(observed=none + 1, confidence=none, stiffness=m, precision=data).precision
        is first.precision
    )
    data[4, 4] *= 2
    assert np.array_equal(
        Problem(observed=none, confidence=none, stiffness=m, precision=data).precision, data
    )
    assert (
        not Problem(observed=none, confidence=none, stiffness=hole, precision=data)
        .precision[3, 3]
        .any()
    )


def test_tensors_stay_in_single_precision_and_are_copied_unless_nothing_can_change_them():
    none, m = np.zeros((8, 8, 2)), np.ones((8, 8))
    data = random_tensors(np.random.default_rng(1), (8, 8), 2).astype(np.float32)
    data = (data + np.swapaxes(data, -2, -1)) / 2
    assert (
        Problem(observed=none, confidence=none, stiffness=m, precision=data).precision is not data
    )
    data.setflags(write=False)
    known = Problem(observed=none, confidence=none, stiffness=m, precision=2 * data).precision
    assert known.dtype == np.float32
    assert Problem(observed=none, confidence=none, stiffness=m, precision=data).precision is data
    m[2, 5] = 0
    other = Problem(observed=none, confidence=none, stiffness=m, precision=data).precision
    assert data[2, 5].any()
    assert not other[2, 5].any()


def test_further_data_add_to_other_data_but_not_to_what_is_held():
    y, z = np.zeros((1, 4, 2)), np.ones((1, 4, 2))
    first, second = (np.zeros((1, 4, 2, 2)) for _ in range(2))
    known = np.zeros((1, 4, 2), bool)
    first[0, 0], first[0, 1], second[:] = np.eye(2), np.eye(2), 3 * np.eye(2)
    known[0, 1, 0] = known[0, 2] = True
    for own in (first, None):
        observed, precision = combined_data((y, own), (z, second), known)
        np.testing.assert_array_equal(observed[0, :, 0], (1 if own is None else 0.75, 0, 0, 1))
        expected = (3, 0, 0, 3) if own is None else (4, 1, 0, 3)
        np.testing.assert_array_equal(precision[0, :, 0, 0], expected)


def test_the_papers_model_refuses_a_data_term():
    none = np.zeros((6, 6, 2))
    with pytest.raises(ProblemError, match="precision: cannot be used"):
        solve(
            Problem(observed=none, confidence=none, stiffness=np.ones((6, 6)), precision=1.0),
            SeilerPrior(),
            backend="cpu",
        )


def test_a_bone_follows_the_data_as_one_body():
    y = np.zeros((24, 24, 2))
    y[..., 0] = 0.05 * np.indices((24, 24))[1]
    m = np.ones((24, 24))
    m[8:14, 8:14] = np.inf
    field = solve(
        Problem(observed=y, confidence=0 * y, stiffness=m, precision=1.0), backend="cpu"
    ).displacement[8:14, 8:14]
    stretch = np.diff(field[..., 0], axis=0), np.diff(field[..., 1], axis=1)
    assert max(np.abs(each).max() for each in stretch) < 1e-5
    assert field[..., 0].mean() == pytest.approx(y[8:14, 8:14, 0].mean(), abs=0.05)


def test_loose_specks_stay_at_rest_on_request_in_images_and_volumes():
    for axes in (2, 3):
        grid = (16,) * axes
        m = np.zeros(grid)
        m[(slice(0, 10),) * axes] = 1
        m[(slice(13, 15),) * axes] = 1
        y, c = np.zeros((*grid, axes)), np.zeros((*grid, axes))
        c[0], y[9], c[9] = 1, 0.5, 1
        problem = Problem(observed=y, confidence=c, stiffness=m)
        with pytest.raises(ProblemError, match="not held anywhere"):
            solve(problem, backend="cpu")
        solution = solve(problem, backend="cpu", rest_loose=True)
        assert not solution.displacement[(slice(13, 15),) * axes].any()
        assert "stays at rest" in solution.notes[-1]


def test_a_piece_that_landmarks_hold_does_not_stay_at_rest():
    m, none = np.zeros((16, 16)), np.zeros((16, 16, 2))
    m[:10, :10] = m[12:, 12:] = 1
    points = np.array([(1.5, 2.5), (8.2, 7.7), (12.5, 12.5), (14.5, 13.5), (4.5, 8.5)])
    marks = Landmarks(points, points + 1.0, sd=0.1)
    problem = Problem(observed=none, confidence=none, stiffness=m, landmarks=marks)
    field = solve(problem, backend="cpu", rest_loose=True).displacement
    assert field[m > 0] == pytest.approx(1, abs=1e-3)


def test_points_beside_tissue_follow_the_nearest_tissue_on_request():
    y = np.zeros((12, 12, 2))
    y[..., 0] = 2
    m = np.zeros((12, 12))
    m[2:8, 2:8] = 1
    solution = solve(
        Problem(observed=y, confidence=0 * y, stiffness=m, precision=1.0), backend="cpu"
    )
    points = [(7.5, 4.0), (10.0, 10.0), (4.25, 5.5)]
    assert solution.at(points, extend=True) == pytest.approx(np.array([(2, 0)] * 3), abs=1e-4)
    assert solution.at(points)[0, 0] == pytest.approx(1, abs=1e-4)
