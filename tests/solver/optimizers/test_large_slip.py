"""Large motion with observations that may slip."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from napari_hmrf import (
    ConvergenceError,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    solve,
)
from napari_hmrf.loads import growth, weight
from napari_hmrf.solver.optimizers.large_slip import LargeSlip

SIZE = 30
ROW, COL = np.indices((SIZE, SIZE))
DISC = np.hypot(ROW - 14, COL - 10) < 5


def dragged(way: float, confidence: float = 1.0, **options: Any) -> Problem:
    """Return tissue with an observed fixed edge and a disc observed to move to the right."""
    c, y = np.zeros((2, SIZE, SIZE, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    c[DISC], y[DISC] = confidence, (0, way)
    return Problem(observed=y, confidence=c, stiffness=np.where(COL > 15, 4.0, 1.0), **options)


def total_energy(prior: NeoHookeanPrior, problem: Problem, d: npt.ArrayLike) -> float:
    """Return the total energy, including the observations."""
    off = np.abs(problem.observed - np.asarray(d, dtype=np.float64)) / problem.unit
    limit = prior.limit(problem)
    assert limit is not None
    return prior.energy(problem, d) + float((limit * off).sum())


@pytest.mark.parametrize(
    "penalty",
    [0.3, *(pytest.param(penalty, marks=pytest.mark.campaign) for penalty in (0.03, 1.0))],
)
def test_each_observation_is_exact_or_slips_at_its_force_limit(penalty) -> None:
    problem = dragged(8.0, 0.7, loads=weight(np.ones((SIZE, SIZE)), (1e-3, 0.0), spacing=1))
    prior = NeoHookeanPrior(penalty=penalty)
    found = solve(problem, prior, optimizer=Multigrid(1e-5), backend="cpu")
    limit = prior.limit(problem)
    assert limit is not None
    off = problem.observed - found.displacement
    forces = prior.forces(problem, found.displacement)
    held = problem.known & (np.abs(off) < 1e-5)
    slips = problem.known & ~held
    assert slips.any(), "nothing slips"
    assert (np.abs(forces[held]) <= 1.01 * limit[held]).all()
    assert np.abs(forces - np.sign(off) * limit)[slips].max() < 1e-3 * limit.max()
    assert np.abs(forces[~problem.known]).max() < 1e-3 * limit.max()
    assert found.reach.sites == slips.any(axis=-1).sum()


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_small_motion_slips_as_in_linear_elasticity(plane) -> None:
    problem, precise = dragged(1e-4), Multigrid(1e-10)
    finite = solve(
        problem, NeoHookeanPrior(plane=plane, penalty=3e-6), optimizer=precise, backend="cpu"
    )
    linear = solve(
        problem, ElasticPrior(plane=plane, penalty=3e-6), optimizer=precise, backend="cpu"
    )
    assert finite.reach.sites > 0, "nothing slips"
    off = np.abs(finite.displacement - linear.displacement).max()
    assert off < 1e-5 * np.abs(linear.displacement).max()


def test_slipping_observations_lower_the_total_energy() -> None:
    problem, slipping = dragged(8.0), NeoHookeanPrior(penalty=0.5)
    found = solve(problem, slipping, backend="cpu").displacement
    held = solve(problem, NeoHookeanPrior(), backend="cpu").displacement
    assert total_energy(slipping, problem, found) < 0.99 * total_energy(slipping, problem, held)
    firm = solve(problem, NeoHookeanPrior(penalty=100.0), backend="cpu").displacement
    assert np.abs(firm - held).max() < 0.002


def test_observations_out_of_reach_slip_without_folds() -> None:
    problem, prior = dragged(25.0), NeoHookeanPrior(penalty=2.0)
    found = solve(problem, prior, backend="cpu")
    assert prior.corner_jacobians(problem, found.displacement).min() > 0
    assert found.reach.part < 1
    assert found.reach.missing > 1


def test_growth_makes_uncertain_observations_slip() -> None:
    prior = NeoHookeanPrior(penalty=0.05)
    problem = dragged(0.0, loads=growth(0.4 * DISC))
    found = solve(problem, prior, backend="cpu")
    assert found.reach.sites > 0
    assert found.reach.grown == 1
    assert prior.corner_jacobians(problem, found.displacement).min() > 0


def test_a_drag_with_slip_starts_from_the_last_fields() -> None:
    prior, live, frames = NeoHookeanPrior(penalty=0.3), Multigrid(0.01), []
    for way in (4.0, 5.0, 6.0, 7.0):
        last = frames[:2] or None
        frames.insert(0, solve(dragged(way), prior, optimizer=live, backend="cpu", initial=last))
    cold = solve(dragged(7.0), prior, backend="cpu")
    assert frames[0].iterations < cold.iterations
    assert np.abs(frames[0].displacement - cold.displacement).max() < 0.02


def test_slip_is_rejected_if_there_is_rigid_tissue() -> None:
    c = np.ones((8, 8, 2))
    m = np.ones((8, 8))
    m[3:5, 3:5] = np.inf
    with pytest.raises(ProblemError, match="observations cannot slip"):
        solve(
            Problem(observed=0 * c, confidence=c, stiffness=m),
            NeoHookeanPrior(penalty=1.0),
            backend="cpu",
        )


def test_exact_observations_are_tried_if_smoothing_the_kinks_fails(monkeypatch) -> None:
    """Smoothing the kinks of the energy fails here; starting from exact observations works."""
    failed = []
    soften = LargeSlip._soften

    def watched(self, d, tolerance):
        try:
            soften(self, d, tolerance)
        except ConvergenceError:
            failed.append(tolerance)
            raise

    monkeypatch.setattr(LargeSlip, "_soften", watched)
    row, col = np.indices((16, 20))
    c, y = np.zeros((2, 16, 20, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    disc = np.hypot(row - 7.5, col - 9) < 3
    c[disc], y[disc] = 0.6, (4 / 3, 4.0)
    problem = Problem(observed=y, confidence=c, stiffness=np.where(col > 12, 500.0, 1.0))
    prior = NeoHookeanPrior(0.49, plane="strain", penalty=10.0)
    found = solve(problem, prior, backend="cpu")
    assert failed, "the smoothed energy converged, so this problem tests nothing"
    assert found.convergence.error <= 1e-3
    assert prior.corner_jacobians(problem, found.displacement).min() > 0
    off, limit = problem.observed - found.displacement, prior.limit(problem)
    forces = prior.forces(problem, found.displacement)
    slips = problem.known & (np.abs(off) > 1e-3)
    assert limit is not None
    assert np.abs(forces[~problem.known]).max() < 1e-3 * limit.max()
    assert (np.abs(forces)[problem.known & ~slips] <= 1.01 * limit[problem.known & ~slips]).all()
