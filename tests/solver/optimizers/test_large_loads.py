"""Large motion caused by growth, weight and pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from napari_hmrf import (
    ElasticPrior,
    LiveSolver,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Solution,
    solve,
)
from napari_hmrf.loads import Loads, growth, pressure, reactions, weight
from validation.oracles.large_motion import large_field

SIZE = 30
ROW, COL = np.indices((SIZE, SIZE))
DISC = np.hypot(ROW - 13, COL - 15) < 7


def edge_confidence() -> npt.NDArray[np.float64]:
    """Return the confidence of a fixed edge on all sides."""
    c = np.zeros((SIZE, SIZE, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    return c


def framed_problem(loads: Loads, m: npt.ArrayLike = 1.0, **options: Any) -> Problem:
    """Return tissue with a fixed edge on all sides that moves only by loads."""
    c = edge_confidence()
    return Problem(
        observed=0 * c,
        confidence=c,
        stiffness=np.broadcast_to(m, (SIZE, SIZE)),
        loads=loads,
        **options,
    )


def hanging_problem(loads: Loads, m: npt.ArrayLike = 1.0) -> Problem:
    """Return tissue that is fixed along its first row."""
    c = np.zeros((SIZE, SIZE, 2))
    c[0] = 1
    return Problem(
        observed=0 * c, confidence=c, stiffness=np.broadcast_to(m, (SIZE, SIZE)), loads=loads
    )


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_free_tissue_grows_by_its_stress_free_stretch(plane) -> None:
    stretch = np.array([[0.8, 0.1], [0.1, -0.3]])
    c = np.zeros((SIZE, SIZE, 2))
    c[0, 0], c[0, -1, 0] = 1, 1
    y = np.zeros_like(c)
    y[0, -1, 0] = stretch[0, 1] * (SIZE - 1)
    loads = Loads(growth=np.broadcast_to(stretch, (SIZE, SIZE, 2, 2)))
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((SIZE, SIZE)), loads=loads)
    prior, precise = NeoHookeanPrior(plane=plane), Multigrid(1e-5)
    found = solve(problem, prior, optimizer=precise, backend="cpu")
    expected = np.stack([ROW, COL], axis=-1) @ stretch
    assert np.abs(found.displacement - expected).max() < 1e-3
    assert found.mean_energy == pytest.approx(0, abs=1e-8)
    assert found.reach.least_jacobian == pytest.approx(np.linalg.det(np.eye(2) + stretch), abs=1e-3)


@pytest.mark.parametrize(
    ("plane", "stiff"),
    [
        ("stress", 100.0),
        ("strain", 1.0),
        pytest.param("stress", 1.0, marks=pytest.mark.campaign),
        pytest.param("strain", 100.0, marks=pytest.mark.campaign),
    ],
)
def test_a_growing_disc_agrees_with_an_independent_solver(plane, stiff) -> None:
    problem = framed_problem(growth(0.5 * DISC), np.where(DISC, stiff, 1.0))
    prior = NeoHookeanPrior(plane=plane)
    found = solve(problem, prior, backend="cpu")
    assert np.abs(found.displacement - large_field(problem, prior, 4)).max() < 0.003
    assert found.reach.grown == 1


def test_motion_by_forces_agrees_with_an_independent_solver() -> None:
    m = np.where(DISC, 5.0, 1.0)
    side = np.zeros((SIZE, SIZE), dtype=bool)
    side[:, -1] = True
    loads = (
        weight(m, (0.003, 0.0), spacing=1) + pressure(m, side, 0.05, spacing=1) + growth(0.2 * DISC)
    )
    problem, prior = hanging_problem(loads, m), NeoHookeanPrior(0.3)
    found = solve(problem, prior, backend="cpu")
    assert np.abs(found.displacement).max() > 3, "the motion is not large"
    assert np.abs(found.displacement - large_field(problem, prior, 1)).max() < 0.003
    holds = reactions(problem, found)
    assert loads.force is not None
    total = loads.force.sum(axis=(0, 1), dtype=np.float64)
    assert holds.sum(axis=(0, 1)) == pytest.approx(-total, abs=1e-2)


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_small_loads_give_the_field_of_linear_elasticity(plane) -> None:
    m = np.where(DISC, 4.0, 1.0)
    loads = weight(m, (2e-7, -1e-7), spacing=1) + growth(1e-4 * DISC)
    problem, precise = hanging_problem(loads, m), Multigrid(1e-9)
    finite = solve(problem, NeoHookeanPrior(plane=plane), optimizer=precise, backend="cpu")
    linear = solve(problem, ElasticPrior(plane=plane), optimizer=precise, backend="cpu")
    off = np.abs(finite.displacement - linear.displacement).max()
    assert off < 3e-4 * np.abs(linear.displacement).max()


def test_a_tumour_that_grows_far_causes_no_folds() -> None:
    prior = NeoHookeanPrior()
    problem = framed_problem(growth(1.0 * DISC), np.where(DISC, 10.0, 1.0))
    linear = solve(problem, ElasticPrior(), backend="cpu")
    assert prior.corner_jacobians(problem, linear.displacement).min() < 0, (
        "the linear solution does not fold"
    )
    found = solve(problem, prior, backend="cpu")
    least = prior.corner_jacobians(problem, found.displacement).min()
    assert least == pytest.approx(found.reach.least_jacobian, abs=1e-6)
    assert least > 0.05


def test_repeated_edits_of_growth_start_from_the_last_fields() -> None:
    prior, live, frames = NeoHookeanPrior(), Multigrid(0.01), []
    for amount in (0.1, 0.12, 0.14, 0.16):
        problem = framed_problem(growth(amount * DISC))
        last = frames[:2] or None
        frames.insert(0, solve(problem, prior, optimizer=live, backend="cpu", initial=last))
    cold = solve(problem, prior, backend="cpu")
    assert frames[0].iterations <= 1 < cold.iterations
    assert np.abs(frames[0].displacement - cold.displacement).max() < 0.02


def test_crowded_growth_causes_no_folds_and_reverts_to_the_cold_solution(tmp_path) -> None:
    prior, updates = NeoHookeanPrior(), []
    easy, crowded = (
        framed_problem(growth(a * DISC), np.where(DISC, 30.0, 1.0)) for a in (0.1, 5.0)
    )
    with LiveSolver(updates.append, prior, backend="cpu") as live:
        for problem in (crowded, easy):
            live.submit(problem)
            assert live.wait(100)
    crushed, back = (update.solution for update in updates if update.final)
    assert crushed.reach.least_jacobian < 0.01
    assert prior.corner_jacobians(crowded, crushed.displacement).min() > 0
    assert 0 < crushed.reach.grown <= 1
    assert Solution.read(crushed.write(tmp_path / "grown.npz")).reach == crushed.reach
    cold = solve(easy, prior, optimizer=Multigrid(0.01), backend="cpu")
    np.testing.assert_array_equal(back.displacement, cold.displacement)
