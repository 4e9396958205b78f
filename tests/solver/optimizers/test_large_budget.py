"""The budget of large motion: a solve that takes long ends with the best field so far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from napari_hmrf import (
    ArgumentError,
    LiveSolver,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Solution,
    Update,
    solve,
)
from napari_hmrf.fields import count_folds
from napari_hmrf.loads import growth
from napari_hmrf.solver import live_solver
from napari_hmrf.solver.live_solver import Known
from napari_hmrf.solver.optimizers import work
from napari_hmrf.solver.optimizers.coarse_start import coarse_problem, prolonged
from validation.bodies import bar, framed, turned

PRIOR = NeoHookeanPrior()


@pytest.fixture
def exact_budget(monkeypatch):
    """Apply the budget to small images as well."""
    monkeypatch.setattr(work, "_LEAST_CYCLE_SITES", {2: 0.0, 3: 0.0})


def dragged(size: int = 96) -> Problem:
    """Return a block with a disc that is dragged by a third of the side."""
    row, col = np.indices((size, size))
    disc = np.hypot(row - size // 2, col - 0.3 * size) < 0.06 * size
    return framed(disc, (0, size / 3))


def within(budget: float | None, initial: Solution | None = None) -> Solution:
    return solve(
        dragged(), PRIOR, optimizer=Multigrid(0.01, budget=budget), backend="cpu", initial=initial
    )


def farthest(one: Solution, other: Solution) -> float:
    return float(np.abs(one.displacement - other.displacement).max())


def test_a_solve_that_uses_up_its_budget_returns_a_valid_field_and_says_what_is_missing(
    exact_budget,
):
    short = within(5)
    assert short.reach.stopped
    assert short.count_folds() == 0
    problem = dragged()
    gap = np.linalg.norm((problem.observed - short.displacement) * problem.known, axis=-1)
    assert short.reach.missing == pytest.approx(gap.max(), abs=0.01) or gap.max() < 0.01
    assert short.reach.unbalanced > 0
    assert np.array_equal(short.displacement, within(5).displacement)


def test_a_warm_start_from_a_stopped_solve_ends_at_the_same_field(exact_budget):
    whole = within(None)
    assert not whole.reach.stopped
    assert whole.reach.missing == 0
    assert farthest(within(5), whole) > 1
    assert farthest(within(None, within(5)), whole) < 0.03


def test_the_progress_of_a_solve_with_growth_or_a_far_pull_never_decreases(exact_budget):
    grown = np.zeros((24, 24), np.float32)
    grown[8:16, 8:16] = 4
    frame = np.ones((24, 24, 2))
    frame[1:-1, 1:-1] = 0
    crowded = Problem(
        observed=0 * frame, confidence=frame, stiffness=np.ones((24, 24)), loads=growth(grown)
    )
    for problem in dragged(), crowded:
        done: list[float] = []
        solve(
            problem,
            PRIOR,
            optimizer=Multigrid(0.01),
            backend="cpu",
            progress=lambda monitor, done=done: done.append(monitor.fraction),
        )
        assert len(set(done)) > 2
        assert done == sorted(done)


def test_a_live_solve_shows_how_far_it_got_until_it_is_done(exact_budget, monkeypatch):
    for name in ("FIRST_PICTURE", "PICTURE_INTERVAL"):
        monkeypatch.setattr(live_solver, name, 0.0)
    updates: list[Update] = []
    done: list[float] = []
    with LiveSolver(
        updates.append, PRIOR, backend="cpu", progress=lambda said: done.append(said.fraction)
    ) as live:
        live.optimizer = Multigrid(0.01, budget=None)
        live.submit(dragged())
        assert live.wait(100)
    *previews, last = updates
    parts = [update.solution.reach.part for update in previews]
    assert len(previews) > 2
    assert parts == sorted(parts), "a picture went back"
    assert done == sorted(done), "the progress decreased after a preview"
    assert sum(fraction < 1 for fraction in done) > len(done) / 2
    assert not any(update.final for update in previews)
    assert all(update.solution.count_folds() == 0 for update in previews)
    assert last.final
    assert np.array_equal(last.solution.displacement, within(None).displacement)


def test_a_pull_that_was_not_completed_is_no_start_for_another_pull(exact_budget):
    updates: list[Update] = []
    other = np.array(dragged().observed)[:, ::-1] * (1, -1)
    mirrored = Problem(
        observed=other, confidence=dragged().confidence[:, ::-1], stiffness=np.ones((96, 96))
    )
    with LiveSolver(updates.append, PRIOR, backend="cpu") as live:
        live.optimizer = Multigrid(0.01, budget=5)
        for problem in dragged(), mirrored:
            live.submit(problem, preview=False)
            assert live.wait(100)
    assert updates[0].solution.reach.stopped
    cold = solve(mirrored, PRIOR, optimizer=Multigrid(0.01, budget=5), backend="cpu")
    assert np.array_equal(updates[1].solution.displacement, cold.displacement)


def test_a_live_solve_continues_a_solution_from_a_file(exact_budget, tmp_path):
    whole = within(None)
    whole.write(tmp_path / "whole.hmrf")
    updates: list[Update] = []
    with LiveSolver(updates.append, PRIOR, backend="cpu") as live:
        live.optimizer = Multigrid(0.01, budget=5)
        live.start_from(Solution.read(tmp_path / "whole.hmrf"))
        live.submit(dragged(), preview=False)
        assert live.wait(100)
    assert farthest(updates[-1].solution, whole) < 0.03


@pytest.mark.parametrize(("budget", "is_nearer"), [(10, True), (2, False)])
def test_of_two_stopped_solves_the_nearer_one_is_delivered(exact_budget, budget, is_nearer):
    earlier = within(budget)
    assert earlier.reach.stopped
    updates: list[Update] = []
    with LiveSolver(updates.append, PRIOR, backend="cpu") as live:
        live.optimizer = Multigrid(0.01, budget=5)
        live.submit(lambda: Known(dragged(), PRIOR, earlier, is_answer=False), preview=False)
        assert live.wait(100)
    assert (updates[-1].solution.displacement is earlier.displacement) == is_nearer
    assert updates[-1].solution.reach.stopped


class _Detour(Multigrid):
    """Schedule that loses the warm start, and ends without having run out of work."""

    def run(self, problem, prior, backend, report, start=None):
        outcome = super().run(problem, prior, backend, report)
        return replace(outcome, reach=replace(outcome.reach, stopped=False))


def test_a_solve_that_continues_another_never_ends_farther_from_its_targets(exact_budget):
    earlier = within(10)
    found = solve(
        dragged(), PRIOR, optimizer=_Detour(0.01, budget=5), backend="cpu", initial=earlier
    )
    assert found.displacement is earlier.displacement
    assert found.reach.missing == earlier.reach.missing
    assert not found.reach.stopped, "a larger budget leads no further"


def test_a_stopped_solve_is_marked_in_its_file(exact_budget, tmp_path):
    within(5).write(tmp_path / "short.hmrf")
    assert Solution.read(tmp_path / "short.hmrf").reach.stopped


@pytest.mark.parametrize("budget", [0, -1, np.inf, "many"])
def test_a_budget_that_is_not_a_positive_number_is_refused(budget):
    with pytest.raises(ArgumentError, match="budget"):
        Multigrid(budget=budget)


@pytest.mark.parametrize("shape", [(9, 12), (6, 7, 8)])
def test_interpolation_to_a_finer_grid_keeps_a_field_without_folds(shape):
    coarse = tuple(size // 2 + 1 for size in shape)
    jitter = np.random.default_rng(3).uniform(-0.2, 0.2, (*coarse, len(shape)))
    even = (1.0,) * len(shape)
    assert count_folds(jitter, spacing=even) == 0
    fine = prolonged(jitter, shape)
    assert count_folds(fine, spacing=even) == 0
    np.testing.assert_allclose(
        fine[(slice(None, None, 2),) * len(shape)], 2 * jitter[sampled(shape)]
    )


def sampled(shape: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(-(-size // 2)) for size in shape)


@pytest.mark.parametrize("shape", [(40, 41), (12, 13, 14)])
def test_held_tissue_stays_in_place_when_a_coarser_field_is_interpolated(shape):
    sites = np.indices(shape) - (np.reshape(shape, (-1, *(1,) * len(shape))) - 1) / 2
    disc = np.linalg.norm(sites, axis=0) < min(shape) / 2 - 1
    rim = disc & ~binary_erosion(disc)
    c, y = np.zeros((2, *shape, len(shape)))
    c[rim] = 1
    coarse, _ = coarse_problem(Problem(observed=y, confidence=c, stiffness=disc * 1.0), PRIOR)
    moved = np.where(coarse.known, 0, np.random.default_rng(1).uniform(1, 2, coarse.known.shape))
    assert not prolonged(moved, shape)[rim].any()


def test_thin_tissue_and_thin_observations_are_on_the_coarser_grid():
    shape = 41, 42
    m, c, y = np.zeros(shape), np.zeros((*shape, 2)), np.zeros((*shape, 2))
    m[9:32, 7:40] = 1
    m[21, :] = 4
    c[21, 41], y[21, 41] = 1, (0, 6)
    c[:, 7] = 1
    coarse, prior = coarse_problem(
        Problem(observed=y, confidence=c, stiffness=m, spacing=(2, 3)), NeoHookeanPrior(m * 0.1)
    )
    assert coarse.spacing == (4, 6)
    assert (coarse.stiffness > 0)[:, -1].sum() >= 1
    assert coarse.observed[..., 1].max() == 6
    assert coarse.known[5:16, 4].all()
    assert np.shape(prior.poisson) == coarse.shape


def test_a_bar_bent_by_90_degrees_in_one_solve_reaches_its_end(exact_budget):
    problem = bar(60, 300, turned(60, 300, 90))
    bent = solve(problem, PRIOR, optimizer=Multigrid(0.01), backend="cpu")
    assert bent.reach.missing == 0
    assert not bent.reach.stopped
