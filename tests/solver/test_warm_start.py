"""Warm starts from earlier solutions, and their error bounds."""

import gc
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.loads import growth
from napari_hmrf.solver.warm_start import combine_solutions
from validation.bodies import between_plates
from validation.oracles.elasticity import direct_solution

TOLERANT = Multigrid(0.01)
PRIOR = ElasticPrior()
PROBLEM = phantom("mass-effect", 96).problem
PATCH = (np.arange(96)[:, None, None] < 30) & (PROBLEM.confidence > 0)


def moved_problem(by, sideways=0.0, c=PROBLEM.confidence, m=PROBLEM.stiffness, spacing=(1.0, 1.0)):
    """Return the problem with a patch moved further, in pixels along both axes."""
    step = np.array([by, sideways]) * spacing
    return Problem(
        observed=PROBLEM.observed * np.array(spacing) + step * PATCH,
        confidence=c,
        stiffness=m,
        spacing=spacing,
    )


def accurate_solutions(backend="cpu", **about):
    """Return two solutions with a smaller tolerance than the later solves."""
    problems = [moved_problem(by, **about) for by in (0, 1)]
    return [solve(each, PRIOR, optimizer=Multigrid(1e-3), backend=backend) for each in problems]


@pytest.mark.parametrize(("backend", "spacing"), [("cpu", (0.5, 0.5)), ("opengl", (1.0, 1.0))])
def test_a_patch_that_continues_its_motion_needs_no_cycle(backend, spacing):
    known = accurate_solutions(backend, spacing=spacing)
    further = moved_problem(2, spacing=spacing)
    found = solve(further, PRIOR, optimizer=TOLERANT, backend=backend, initial=known)
    exact = solve(further, PRIOR, optimizer=Multigrid(1e-5), backend=backend)
    assert found.iterations == 0
    assert len(found.energy) == 1
    assert found.mean_energy == pytest.approx(exact.mean_energy, rel=1e-3)
    # The extrapolation takes the first solution -1 times and the second 2 times.
    known_by = known[0].convergence.error + 2 * known[1].convergence.error
    assert found.convergence.error == pytest.approx(known_by, rel=1e-3)
    apart = np.abs(found.displacement - exact.displacement).max() / spacing[0]
    assert apart <= found.convergence.error <= TOLERANT.tolerance
    assert 0 < found.convergence.residual < 0.01


def test_moving_a_patch_back_needs_no_cycle():
    known = accurate_solutions()
    assert (
        solve(
            moved_problem(0.4), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known
        ).iterations
        == 0
    )
    assert (
        solve(
            moved_problem(1), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known[1]
        ).iterations
        == 0
    )


def test_a_solution_that_is_solved_again_reports_its_error():
    problem = between_plates(np.ones((36, 72)), (0, 3))
    first = solve(problem, PRIOR, optimizer=TOLERANT, backend="cpu")
    again = solve(problem, PRIOR, optimizer=TOLERANT, backend="cpu", initial=first)
    assert len(again.energy) == 1, "a cycle changed the solution"
    error = np.linalg.norm(again.displacement - direct_solution(problem, PRIOR), axis=-1).max()
    assert error <= again.convergence.error <= TOLERANT.tolerance


def test_errors_of_warm_starts_accumulate_until_a_cycle_reduces_them():
    known, cycles = accurate_solutions()[::-1], []
    for by in range(2, 30):
        found = solve(moved_problem(by), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known)
        assert found.convergence.error <= TOLERANT.tolerance
        cycles.append(found.iterations)
        known = [found, *known][:4]
    assert cycles[0] == 0
    assert 0 < sum(cycles) < len(cycles)
    exact = solve(moved_problem(29), PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=TOLERANT.tolerance)


def softened_stiffness():
    """Return a stiffness softened where strain is small, so that the residual hardly changes."""
    m = PROBLEM.stiffness.copy()
    m[60:80, 20:40] *= 1e-3
    return m


def confidence_with_another_site():
    c = PROBLEM.confidence.copy()
    c[48, 48] = 1
    return c


@pytest.mark.parametrize(
    "edited",
    [
        moved_problem(2, sideways=0.5),
        moved_problem(2, m=softened_stiffness()),
        moved_problem(2, c=confidence_with_another_site()),
    ],
    ids=["sideways", "softer", "another fixed site"],
)
def test_a_warm_start_for_another_problem_needs_cycles(edited):
    found = solve(edited, PRIOR, optimizer=TOLERANT, backend="cpu", initial=accurate_solutions())
    exact = solve(edited, PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    assert found.iterations > 0
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=TOLERANT.tolerance)


def test_a_new_motion_of_very_soft_tissue_needs_cycles():
    m = np.where(np.arange(96)[:, None] < 34, 1e-5, 1) * PROBLEM.stiffness
    found = solve(
        moved_problem(2, sideways=0.5, m=m),
        PRIOR,
        optimizer=TOLERANT,
        backend="cpu",
        initial=accurate_solutions(m=m),
    )
    exact = solve(
        moved_problem(2, sideways=0.5, m=m), PRIOR, optimizer=Multigrid(1e-5), backend="cpu"
    )
    assert found.iterations > 0
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=TOLERANT.tolerance)


def test_a_warm_start_with_another_poisson_ratio_needs_cycles():
    found = solve(
        moved_problem(2),
        ElasticPrior(0.2),
        optimizer=TOLERANT,
        backend="cpu",
        initial=accurate_solutions(),
    )
    assert found.iterations > 0


def test_a_warm_start_after_solving_other_tissue_needs_cycles():
    known = accurate_solutions()
    solve(moved_problem(0, m=softened_stiffness()), PRIOR, optimizer=TOLERANT, backend="cpu")
    assert (
        solve(moved_problem(2), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known).iterations
        > 0
    )


def test_copied_or_modified_solutions_are_not_trusted_as_a_warm_start():
    known = accurate_solutions()
    copies = [replace(each, displacement=each.displacement.copy()) for each in known]
    assert (
        solve(moved_problem(2), PRIOR, optimizer=TOLERANT, backend="cpu", initial=copies).iterations
        > 0
    )
    place = np.s_[30:36, 44:50]
    assert PROBLEM.tissue[place].all()
    assert not PROBLEM.known[place].any(), "the modified pixels should not be observed"
    field = known[1].displacement.copy()
    field[place] += 0.3
    known[1] = replace(known[1], displacement=field)
    found = solve(moved_problem(2), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known)
    assert found.iterations > 0
    exact = solve(moved_problem(2), PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=TOLERANT.tolerance)


def test_deleted_solutions_are_removed_from_the_cache():
    known = accurate_solutions()
    model = last_model()
    for by in range(5):
        solve(moved_problem(by), PRIOR, optimizer=TOLERANT, backend="cpu", initial=known)
    del known
    gc.collect()
    found = solve(moved_problem(7), PRIOR, optimizer=TOLERANT, backend="cpu")
    assert [known() is found.displacement for known, _ in model.earlier._qualities] == [True]


def last_model():
    from napari_hmrf.solver.backends.cpu import elastic_model

    return elastic_model._model.value


def test_a_solution_without_cycles_can_be_saved_and_read(tmp_path):
    found = solve(
        moved_problem(2), PRIOR, optimizer=TOLERANT, backend="cpu", initial=accurate_solutions()
    )
    read = type(found).read(found.write(tmp_path / "found.npz"))
    assert (read.iterations, len(read.energy)) == (0, 1)


def test_shares_sum_to_one_and_reproduce_the_position_of_the_patch():
    solutions = [
        *accurate_solutions(),
        solve(moved_problem(0, 1), PRIOR, optimizer=TOLERANT, backend="cpu"),
    ]
    begin = combine_solutions(solutions, moved_problem(3, -2))
    assert sum(begin.shares) == pytest.approx(1)
    assert begin.shares[1:] == pytest.approx((3, -2), abs=1e-3)
    assert begin.missing < 1e-4
    assert combine_solutions(solutions[0], moved_problem(3)).missing == pytest.approx(3, rel=1e-5)


@pytest.mark.parametrize("prior", [PRIOR, NeoHookeanPrior()])
def test_thin_tissue_that_is_no_longer_observed_returns_to_rest(prior):
    y, c = np.zeros((2, 40, 40, 2))
    m = np.zeros((40, 40))
    m[:30], m[32:36, 5] = 1, 1
    c[0], c[29] = 1, 1
    y[29, :, 0] = 0.5
    c[32:36, 5], y[32:36, 5] = 1, 2
    before = solve(
        Problem(observed=y, confidence=c, stiffness=m), prior, optimizer=TOLERANT, backend="cpu"
    )
    assert (before.displacement[32:36, 5] == 2).all()
    c[32:36] = 0
    after = solve(
        Problem(observed=y, confidence=c, stiffness=m),
        prior,
        optimizer=TOLERANT,
        backend="cpu",
        initial=before,
    )
    assert (after.displacement[32:36] == 0).all()
    assert after.displacement[29, 0, 0] == pytest.approx(0.5, abs=1e-6)


def test_a_warm_start_leaves_out_tissue_that_became_void():
    removed, pulled = np.zeros((2, 24, 24), bool)
    removed[8:14, 4:8] = pulled[8:14, 16:20] = True
    loads = growth(0.01 * pulled)

    def problem(of_removed, of_pulled, m=1.0):
        y, c = np.zeros((2, 24, 24, 2))
        c[0] = c[-1] = 1
        c[removed | pulled] = 1
        y[removed, 1], y[pulled, 1] = of_removed, of_pulled
        return Problem(observed=y, confidence=c, stiffness=np.full((24, 24), 1.0) * m, loads=loads)

    earlier = [solve(problem(*by), PRIOR, backend="cpu") for by in ((0, 0), (2, 0.01))]
    cavity = problem(0, 3, m=~removed)
    warm, cold = (solve(cavity, PRIOR, backend="cpu", initial=each) for each in (earlier, None))
    apart = np.abs(warm.displacement - cold.displacement).max()
    assert apart <= warm.convergence.error + cold.convergence.error


class _ColdOnly(Multigrid):
    """Schedule that fails from any warm start."""

    def run(self, problem, prior, backend, report, start=None):
        if start is not None:
            raise ConvergenceError("no")
        return super().run(problem, prior, backend, report)


def test_a_problem_that_fails_from_a_warm_start_is_solved_from_a_cold_start():
    cold = solve(PROBLEM, PRIOR, backend="cpu")
    found = solve(PROBLEM, PRIOR, optimizer=_ColdOnly(), backend="cpu", initial=cold)
    np.testing.assert_array_equal(found.displacement, cold.displacement)
