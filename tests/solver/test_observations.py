"""Uncertain observations of elastic tissue: the L1 data term, compared with exact minimisation."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.data import phantom
from validation.bodies import uncertain_problem
from validation.oracles.elasticity import direct_solution, stiffness_matrix
from validation.oracles.exact import exact_field


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (2.0, 0.5)])
@pytest.mark.parametrize("penalty", [0.05, 0.5, 3.0])
def test_the_field_minimises_the_energy(penalty, spacing):
    problem, prior = uncertain_problem(spacing=spacing), ElasticPrior(0.4, penalty=penalty)
    found = solve(problem, prior, optimizer=Multigrid(1e-4))
    expected = exact_field(problem, prior).displacement * problem.unit
    assert np.abs(found.displacement - expected).max() < 1e-3
    slipped = np.abs(expected - problem.observed)[problem.confidence > 0] > 1e-4
    assert 0.02 < slipped.mean() < 1  # otherwise the comparison shows nothing
    cost = (prior.limit(problem) * np.abs(problem.observed - expected)).sum() / problem.unit
    energy = (prior.energy(problem, expected) + cost) / problem.tissue.sum()
    assert found.mean_energy == pytest.approx(energy, rel=1e-3)


def test_the_force_of_an_observation_is_proportional_to_its_confidence():
    # Pull a bar at one end with half and with full confidence.
    y, c = np.zeros((2, 9, 41, 2))
    c[:, 0] = 1
    y[:, -1, 1] = 4
    strain = []
    for confidence in (0.5, 1.0):
        c[:, -1, 1] = confidence
        prior = ElasticPrior(0.0, penalty=0.05)  # too weak for 4 pixels
        found = solve(
            Problem(observed=y, confidence=c, stiffness=np.ones((9, 41))),
            prior,
            optimizer=Multigrid(1e-4),
        ).displacement
        strain.append(found[4, 30, 1] - found[4, 10, 1])
    assert strain[1] == pytest.approx(2 * strain[0], rel=1e-3)
    assert strain[1] == pytest.approx(20 * 0.05 * 9 / 8, rel=1e-3)


def test_a_large_penalty_makes_observations_exact():
    problem = phantom("mass-effect", 64).problem
    held = solve(problem, ElasticPrior()).displacement
    strongly = solve(problem, ElasticPrior(penalty=1e4)).displacement
    np.testing.assert_allclose(strongly, held, atol=2e-3)


def test_the_field_depends_only_on_ratios_of_stiffness():
    problem = uncertain_problem()
    prior = ElasticPrior(penalty=0.5)
    harder = Problem(
        observed=problem.observed, confidence=problem.confidence, stiffness=problem.stiffness * 1000
    )
    np.testing.assert_allclose(
        solve(harder, prior).displacement, solve(problem, prior).displacement, atol=2e-3
    )


def test_a_slipping_piece_moves_to_the_majority_of_its_observations():
    # Observe the left part of a bar at 0 and its right end far away, both too weak to strain it.
    y, c = np.zeros((2, 8, 20, 2))
    c[:, :5, 1] = c[:, -1, 1] = 1
    c[3, 10, 0] = 1
    y[:, -1, 1] = 30
    found = solve(
        Problem(observed=y, confidence=c, stiffness=np.ones((8, 20))),
        ElasticPrior(penalty=1e-3),
        optimizer=Multigrid(1e-4),
    )
    assert np.abs(found.displacement[:, :5]).max() < 0.02
    y[:, :5, 1], y[:, -1, 1] = 30, 0
    found = solve(
        Problem(observed=y, confidence=c, stiffness=np.ones((8, 20))),
        ElasticPrior(penalty=1e-3),
        optimizer=Multigrid(1e-4),
    )
    assert np.abs(found.displacement[:, :5, 1] - 30).max() < 0.02


@pytest.mark.parametrize("penalty", [0.05, pytest.param(0.03, marks=pytest.mark.campaign)])
def test_a_weakly_pulled_patch_slips_into_equilibrium(penalty):
    shape, firm = (96, 96), 1e4
    place = np.indices(shape) - 47.5
    patch, edge = np.hypot(*place) < 12, np.abs(place).max(axis=0) > 47
    y, c = np.zeros((2, *shape, 2))
    c[edge] = 1
    y[patch], c[patch] = (0, 35), penalty / firm
    m = np.where(np.hypot(*(place - 12)) < 24, 4.0, 1.0)
    problem, prior = (
        Problem(observed=y, confidence=c, stiffness=m),
        ElasticPrior(0.45, penalty=firm),
    )
    found = solve(problem, prior, optimizer=Multigrid(1e-4))
    # About fifty cycles find the slipping components; the others confirm them.
    assert found.iterations < 450
    d = found.displacement.astype(float)
    matrix = stiffness_matrix(problem, prior) / float(problem.stiffness.max())
    forces = -(matrix @ d.ravel()).reshape(d.shape)
    off, limit = (y - d)[patch], prior.limit(problem)[patch]
    slips, near = np.abs(off) > 1e-3, 0.02 * limit.max()
    assert 0.1 < slips.mean() < 0.9
    assert np.abs(forces[patch] + np.sign(off) * limit)[slips].max() < near
    assert (np.abs(forces[patch]) - limit).max() < near
    assert np.abs(forces[~patch & ~edge]).max() < near


def test_a_warm_start_after_a_small_edit_saves_cycles_without_changing_the_field():
    problem = phantom("mass-effect", 128).problem
    before = solve(problem, ElasticPrior(), optimizer=Multigrid(0.01))
    y = problem.observed.copy()
    y[..., 0] += np.where(y[..., 0] > 0, 0.2, 0).astype(np.float32)
    edited = Problem(observed=y, confidence=problem.confidence, stiffness=problem.stiffness)
    cold = solve(edited, ElasticPrior(), optimizer=Multigrid(0.01))
    warm = solve(edited, ElasticPrior(), optimizer=Multigrid(0.01), initial=before)
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=0.02)
    again = solve(edited, ElasticPrior(), optimizer=Multigrid(0.01), initial=warm)
    assert again.iterations <= 1


@pytest.mark.parametrize("penalty", [0.05, 0.5])
def test_a_warm_start_with_slipping_observations_saves_cycles(penalty):
    problem, prior = uncertain_problem(), ElasticPrior(0.4, penalty=penalty)
    cold = solve(problem, prior, optimizer=Multigrid(1e-4))
    warm = solve(problem, prior, optimizer=Multigrid(1e-4), initial=cold)
    assert warm.iterations < cold.iterations / 2
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=5e-4)


def test_moving_a_patch_again_is_extrapolated_from_earlier_fields():
    problem = phantom("mass-effect", 128).problem
    patch = (np.arange(128)[:, None, None] < 40) & (problem.confidence > 0)
    moved = [
        Problem(
            observed=problem.observed + k * patch,
            confidence=problem.confidence,
            stiffness=problem.stiffness,
        )
        for k in (0, 1, 3)
    ]
    known = [solve(each, ElasticPrior(), optimizer=Multigrid(1e-3)) for each in moved[:2]]
    cold = solve(moved[2], ElasticPrior(), optimizer=Multigrid(0.01))
    warm = solve(moved[2], ElasticPrior(), optimizer=Multigrid(0.01), initial=known)
    assert warm.iterations <= 1
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=0.02)


def test_an_initial_field_on_another_grid_is_rejected():
    small, large = (phantom("bar", size).problem for size in (32, 48))
    with pytest.raises(ValueError, match="initial has a grid"):
        solve(large, ElasticPrior(), initial=solve(small, ElasticPrior()))
    with pytest.raises(ValueError, match="Leave initial out, or use Multigrid"):
        solve(small, SeilerPrior(), initial=solve(small, SeilerPrior()))


def test_the_poisson_ratio_can_vary_from_site_to_site():
    problem = phantom("mass-effect", 48).problem
    uniform = solve(problem, ElasticPrior(0.3)).displacement
    as_map = solve(problem, ElasticPrior(np.full(problem.shape, 0.3))).displacement
    np.testing.assert_allclose(as_map, uniform, atol=1e-4)
    nu = np.where(np.arange(48) < 24, 0.1, 0.49) * np.ones((48, 1))
    for plane in ("stress", "strain"):
        prior = ElasticPrior(nu, plane=plane)
        found = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement
        assert np.abs(found - direct_solution(problem, prior))[problem.tissue].max() < 1e-3
        assert np.abs(found - uniform)[problem.tissue].max() > 0.05


def test_a_poisson_map_must_match_the_tissue():
    problem = phantom("bar", 32).problem
    with pytest.raises(ProblemError, match=r"poisson: has shape \(3, 3\)"):
        solve(problem, ElasticPrior(np.full((3, 3), 0.3)))
    wrong = np.full(problem.shape, 0.3)
    wrong[5, 16] = 0.6
    with pytest.raises(ProblemError, match=r"poisson: has 1 values .* first at \(5, 16\)"):
        solve(problem, ElasticPrior(wrong))
    with pytest.raises(ValueError, match="a number or an array of shape"):
        ElasticPrior(np.full(3, 0.3))


def test_a_solution_records_its_error_and_residual(tmp_path):
    problem = phantom("expansion", 64).problem
    solution = solve(problem, ElasticPrior(), optimizer=Multigrid(0.01))
    assert 0 < solution.convergence.error <= 0.01
    assert 0 < solution.convergence.residual < 0.01
    closer = solve(problem, ElasticPrior(), optimizer=Multigrid(1e-4))
    assert closer.convergence.residual < solution.convergence.residual
    assert closer.convergence.error < solution.convergence.error / 10
    assert np.abs(solution.displacement - closer.displacement).max() < 0.01
    assert np.all(np.diff(solution.energy) <= 0)
    loaded = type(solution).read(solution.write(tmp_path / "a.npz"))
    assert loaded.convergence == solution.convergence
    assert solve(problem, SeilerPrior()).convergence is None
