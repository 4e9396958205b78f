"""Affine drift: a uniform strain that is estimated together with landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem, ProblemError, Solution, solve
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import Loads, reactions
from napari_hmrf.solver import drift
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.live_solver import LiveSolver
from validation.oracles.posterior import posterior_mean_with_drift
from validation.oracles.slipping import slipped

GRIDS = [((24, 18), (1, 2)), ((8, 9, 10), (2, 1, 1.5))]
SHEAR = np.array([(0.06, 0.02), (0.02, -0.04)])


def scattered(grid, count=12):
    return np.random.default_rng(3).random((count, len(grid))) * (np.array(grid) - 1)


def free_tissue(points, targets, m=None, held=False, **options):
    m = np.ones((30, 24)) if m is None else m
    y = np.zeros((*m.shape, m.ndim))
    c = np.zeros_like(y)
    c[0] = held
    return Problem(
        observed=y,
        confidence=c,
        stiffness=m,
        landmarks=Landmarks(points, targets, drift=True, **options),
    )


def drift_of(solution):
    return np.array(solution.provenance.parameters["drift"])


@pytest.mark.parametrize("sd", [0.02, 1.0])
def test_landmarks_of_an_affine_motion_are_met_without_elastic_strain(sd):
    points = scattered((30, 24))
    targets = points + points @ (SHEAR + np.array([(0, 0.03), (-0.03, 0)])).T + 2
    solution = solve(free_tissue(points, targets, sd=sd), backend="cpu")
    assert solution.move(points) == pytest.approx(targets, abs=2e-3)
    assert drift_of(solution) == pytest.approx(SHEAR, abs=1e-4)
    assert np.abs(solution.strain()).max() < 1e-3
    assert np.abs(solution.strain("small") - SHEAR).max() < 1e-3
    assert solution.energy[-1] == pytest.approx(0, abs=1e-6)
    assert "a drift was estimated with the landmarks: strains of " in solution.notes[-1]


CASES = [
    ("free", 0.02, "stress"),
    ("free", 0.5, "strain"),
    ("held", 0.02, "strain"),
    ("precision and loads", 0.5, "stress"),
]


@pytest.mark.parametrize(
    ("grid", "spacing", "case", "sd", "plane"),
    [
        *((*GRIDS[0], *case) for case in CASES),
        (*GRIDS[1], *CASES[2]),
        *(pytest.param(*GRIDS[1], *CASES[k], marks=pytest.mark.campaign) for k in (0, 1, 3)),
    ],
)
def test_a_drift_has_the_least_energy_of_all_fields_and_strains(grid, spacing, sd, case, plane):
    rng, axes = np.random.default_rng(1), len(grid)
    points = scattered(grid)
    y, c, loads, precision = np.zeros((*grid, axes)), np.zeros((*grid, axes)), None, None
    if case == "held":
        c[0], y[0] = 1, 0.3 * rng.normal(size=y[0].shape)
    if case == "precision and loads":
        y[-1], precision = rng.normal(size=y[-1].shape), np.zeros((*grid, axes))
        precision[-1] = 2
        loads = Loads(growth=0.1 * rng.random(grid), force=0.01 * rng.normal(size=y.shape))
    targets = points + 0.5 * rng.normal(size=points.shape) + 0.05 * points
    marks = Landmarks(points, targets, sd=sd, drift=True)
    m = 20 ** rng.random(grid)
    problem = Problem(
        observed=y,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        loads=loads,
        precision=precision,
        landmarks=marks,
    )
    prior = ElasticPrior(0.3, plane=plane)
    solution = solve(problem, prior, backend="cpu")
    field, strain = posterior_mean_with_drift(problem, prior)
    assert np.abs(solution.displacement - field).max() <= 1e-3 * problem.unit
    assert drift_of(solution) == pytest.approx(strain, abs=1e-4)
    assert solution.convergence.error <= 1e-3


def test_a_drift_does_not_depend_on_the_unit_of_stiffness():
    points = scattered((30, 24))
    targets = points + np.random.default_rng(2).normal(size=points.shape)
    fields = [
        solve(free_tissue(points, targets, unit * np.ones((30, 24)), sd=1.0), backend="cpu")
        for unit in (1.0, 1000.0)
    ]
    assert np.abs(fields[0].displacement - fields[1].displacement).max() < 2e-3


def test_a_bone_keeps_its_shape_in_a_drift():
    points, m = scattered((30, 24)), np.ones((30, 24))
    m[8:14, 8:14] = np.inf
    targets = points + points @ SHEAR
    solution = solve(free_tissue(points, targets, m, sd=1.0), backend="cpu")
    bone = solution.displacement[8:14, 8:14]
    stretch = np.diff(bone[..., 0], axis=0), np.diff(bone[..., 1], axis=1)
    assert max(np.abs(each).max() for each in stretch) < 1e-5
    assert np.abs(solution.strain()[8:14, 8:14]).max() == 0
    assert drift_of(solution)[0, 0] > 0.04
    assert not solution.loads.growth[8:14, 8:14].any()
    assert solution.loads.growth[0, 0] == pytest.approx(drift_of(solution))


@pytest.mark.parametrize("held", [False, True])
def test_any_other_drift_around_bones_has_more_energy(held):
    m = np.ones((30, 24))
    m[8:14, 8:14] = m[20:25, 3:9] = np.inf
    points = scattered((30, 24))
    problem = free_tissue(points, points + points @ SHEAR, m, sd=0.5, held=held)
    best = solve(problem, backend="cpu")
    soft = (problem.tissue & ~problem.rigid)[..., None, None]

    def energy_with(strain):
        loads = Loads(growth=soft * strain)
        marks = Landmarks(points, points + points @ SHEAR, sd=0.5)
        varied = Problem(
            observed=problem.observed,
            confidence=problem.confidence,
            stiffness=problem.stiffness,
            landmarks=marks,
            loads=loads,
        )
        return solve(varied, backend="cpu").mean_energy

    assert best.mean_energy == pytest.approx(energy_with(drift_of(best)), rel=1e-4)
    for unit in ([[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]):
        step = 0.01 * np.array(unit)
        more, less = energy_with(drift_of(best) + step), energy_with(drift_of(best) - step)
        assert more == pytest.approx(less, abs=0.01 * (more - best.mean_energy))
        assert more > best.mean_energy


@pytest.mark.parametrize(
    ("points", "held", "sd"),
    [
        ([(4.5, 3.0), (20.2, 17.0)], False, 1.0),
        ([(4, 4), (9, 9), (14, 14), (20, 20)], False, 0.01),
        ([(0, 12.0)], True, 1.0),
    ],
)
def test_landmarks_that_do_not_determine_a_drift_are_refused(points, held, sd):
    problem = free_tissue(points, np.add(points, 1), sd=sd, held=held)
    with pytest.raises(ProblemError, match="landmarks: cannot determine a drift"):
        solve(problem, backend="cpu")


def test_a_drift_that_would_turn_tissue_inside_out_is_refused():
    points = scattered((30, 24))
    with pytest.raises(ProblemError, match="need a drift of -120 %"):
        solve(free_tissue(points, -0.2 * points, sd=0.1), backend="cpu")


@pytest.mark.parametrize(("held", "is_ragged"), [(0.5, False), (1e-3, False), (1e-3, True)])
def test_observations_slip_beside_a_drift(held, is_ragged):
    points = scattered((9, 8))
    m = np.ones((9, 8))
    m[3:5, 2:4] = np.inf
    if is_ragged:
        m[1, 0] = 0  # the observed sites of the corner are in no element, and follow
    problem = free_tissue(points, points @ (np.eye(2) + SHEAR) + 1, m, sd=1.0, held=held)
    found = solve(problem, backend="cpu")
    exact = slipped(connected(problem, ElasticPrior()).problem, ElasticPrior())
    assert exact.is_proven
    error = np.abs(found.displacement - exact.field)[sites_of_elements(m)].max()
    assert error <= found.convergence.error + 1e-6
    assert (np.abs(found.displacement[0]).max() > 0.1) == (held < 0.5), "only weak holds slip"


def test_large_motion_refuses_a_drift():
    points = scattered((30, 24))
    with pytest.raises(ProblemError, match="landmarks: cannot have a drift in large motion"):
        solve(free_tissue(points, points + 1, sd=1.0), NeoHookeanPrior(), backend="cpu")


def test_a_drag_of_targets_gives_the_same_field_as_a_new_solve_and_needs_one_solve():
    points, updates, solves = scattered((30, 24)), [], []
    problems = [
        free_tissue(points, points + points @ SHEAR * share, sd=0.5) for share in (1, -2, 3)
    ]
    with LiveSolver(updates.append, progress=lambda each: solves.append(each.message)) as live:
        for problem in problems:
            live.submit(problem)
            assert live.wait(60)
            solves.append("next")
    for update, problem in zip(updates, problems, strict=True):
        drift._responses.clear()
        alone = solve(problem, backend="cpu")
        assert np.abs(update.solution.displacement - alone.displacement).max() < 0.01
    begun = [part.split(", ").count("preparing") for part in ", ".join(solves).split("next")]
    assert begun[:3] == [4, 1, 1]


def test_a_field_with_drift_is_a_warm_start_of_the_problem_without_it():
    points = scattered((30, 24))
    problem = free_tissue(points, points + points @ SHEAR, sd=0.5)
    plain = drift.without_drift(problem)
    drifted = solve(problem, backend="cpu")
    warm = solve(plain, backend="cpu", initial=drifted)
    assert np.abs(warm.displacement - solve(plain, backend="cpu").displacement).max() < 2e-3


def test_reactions_of_held_tissue_balance_the_pull_of_the_landmarks():
    points = 4 + 0.8 * scattered((30, 24))
    problem = free_tissue(points, points + points @ SHEAR + 1, sd=0.5, held=True)
    solution = solve(problem, backend="cpu")
    marks = problem.landmarks
    missing = marks.displacement(problem.spacing) - solution.at(points)
    pull = (marks.precision(problem.stiffness, problem.spacing) * missing).sum(axis=0)
    forces, held = reactions(problem, solution), problem.known.any(axis=-1)
    assert forces[held].sum(axis=0) == pytest.approx(-pull, abs=0.02 * np.abs(pull).max())
    assert forces[~held].sum(axis=0) == pytest.approx(pull, abs=0.02 * np.abs(pull).max())
    assert np.abs(pull).max() > 0.5


def test_a_drift_is_part_of_the_problem_and_of_its_file(tmp_path):
    points = scattered((30, 24))
    problem = free_tissue(points, points + points @ SHEAR, sd=0.5)
    plain = drift.without_drift(problem)
    assert dict(problem.digests) != dict(plain.digests)
    assert "with a drift" in repr(problem)
    assert "drift" not in repr(plain)
    solution = solve(problem, backend="cpu")
    saved = Solution.read(solution.write(tmp_path / "drift.npz"))
    assert drift_of(saved) == pytest.approx(SHEAR, abs=1e-4)
    assert np.abs(saved.strain()).max() < 1e-3


def test_a_uniform_strain_costs_nothing_whatever_the_typical_strain():
    points = scattered((30, 24))
    strains = [
        drift_of(solve(free_tissue(points, 1.1 * points, sd=1.0, scale=scale), backend="cpu"))
        for scale in (StrainScale(0.01), StrainScale(0.3))
    ]
    assert strains[0] == pytest.approx(strains[1], abs=1e-3)
