"""Claims about tissue that moves far because it grows, is heavy, or is pressed."""

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
from tests.support.finite_oracle import solved

SIZE = 30
ROW, COL = np.indices((SIZE, SIZE))
DISC = np.hypot(ROW - 13, COL - 15) < 7


def frame() -> npt.NDArray[np.float64]:
    """Confidence of what is held all around."""
    c = np.zeros((SIZE, SIZE, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    return c


def held(loads: Loads, m: npt.ArrayLike = 1.0, **options: Any) -> Problem:
    """Tissue that nothing but loads moves."""
    c = frame()
    return Problem(0 * c, c, np.broadcast_to(m, (SIZE, SIZE)), loads=loads, **options)


def on_its_edge(loads: Loads, m: npt.ArrayLike = 1.0) -> Problem:
    """Tissue that is held along its first row."""
    c = np.zeros((SIZE, SIZE, 2))
    c[0] = 1
    return Problem(0 * c, c, np.broadcast_to(m, (SIZE, SIZE)), loads=loads)


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_free_tissue_grows_as_far_as_it_would_without_stress(plane) -> None:
    stretch = np.array([[0.8, 0.1], [0.1, -0.3]])
    c = np.zeros((SIZE, SIZE, 2))
    c[0, 0], c[0, -1, 0] = 1, 1
    y = np.zeros_like(c)
    y[0, -1, 0] = stretch[0, 1] * (SIZE - 1)
    loads = Loads(growth=np.broadcast_to(stretch, (SIZE, SIZE, 2, 2)))
    problem = Problem(y, c, np.ones((SIZE, SIZE)), loads=loads)
    prior, precise = NeoHookeanPrior(plane=plane), Multigrid(1e-5)
    found = solve(problem, prior, optimizer=precise, backend="cpu")
    expected = np.stack([ROW, COL], axis=-1) @ stretch
    assert np.abs(found.displacement - expected).max() < 1e-3
    assert found.mean_energy == pytest.approx(0, abs=1e-8)
    assert found.reach.least_jacobian == pytest.approx(np.linalg.det(np.eye(2) + stretch), abs=1e-3)


@pytest.mark.parametrize("plane", ["stress", "strain"])
@pytest.mark.parametrize("stiff", [1.0, 100.0])
def test_a_disc_that_grows_goes_where_an_independent_method_says(plane, stiff) -> None:
    problem = held(growth(0.5 * DISC), np.where(DISC, stiff, 1.0))
    prior = NeoHookeanPrior(plane=plane)
    found = solve(problem, prior, backend="cpu")
    assert np.abs(found.displacement - solved(problem, prior, 4)).max() < 0.003
    assert found.reach.grown == 1


def test_forces_move_tissue_as_an_independent_method_says() -> None:
    m = np.where(DISC, 5.0, 1.0)
    side = np.zeros((SIZE, SIZE), dtype=bool)
    side[:, -1] = True
    loads = (
        weight(m, (0.003, 0.0), spacing=1) + pressure(m, side, 0.05, spacing=1) + growth(0.2 * DISC)
    )
    problem, prior = on_its_edge(loads, m), NeoHookeanPrior(0.3)
    found = solve(problem, prior, backend="cpu")
    assert np.abs(found.displacement).max() > 3, "this is no large motion"
    assert np.abs(found.displacement - solved(problem, prior, 1)).max() < 0.003
    holds = reactions(problem, found, prior)
    assert loads.force is not None
    total = loads.force.sum(axis=(0, 1), dtype=np.float64)
    assert holds.sum(axis=(0, 1)) == pytest.approx(-total, abs=1e-2)


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_small_loads_move_it_as_linear_elasticity(plane) -> None:
    m = np.where(DISC, 4.0, 1.0)
    loads = weight(m, (2e-7, -1e-7), spacing=1) + growth(1e-4 * DISC)
    problem, precise = on_its_edge(loads, m), Multigrid(1e-9)
    finite = solve(problem, NeoHookeanPrior(plane=plane), optimizer=precise, backend="cpu")
    linear = solve(problem, ElasticPrior(plane=plane), optimizer=precise, backend="cpu")
    off = np.abs(finite.displacement - linear.displacement).max()
    assert off < 3e-4 * np.abs(linear.displacement).max()


def test_a_tumour_that_grows_far_folds_nothing() -> None:
    prior = NeoHookeanPrior()
    problem = held(growth(1.0 * DISC), np.where(DISC, 10.0, 1.0))
    linear = solve(problem, ElasticPrior(), backend="cpu")
    assert prior.corner_jacobians(problem, linear.displacement).min() < 0, (
        "this is no test of folds"
    )
    found = solve(problem, prior, backend="cpu")
    least = prior.corner_jacobians(problem, found.displacement).min()
    assert least == pytest.approx(found.reach.least_jacobian, abs=1e-6)
    assert least > 0.05


def test_growth_that_is_dragged_begins_with_the_last_fields() -> None:
    prior, live, frames = NeoHookeanPrior(), Multigrid(0.01), []
    for amount in (0.1, 0.12, 0.14, 0.16):
        problem = held(growth(amount * DISC))
        last = frames[:2] or None
        frames.insert(0, solve(problem, prior, optimizer=live, backend="cpu", initial=last))
    cold = solve(problem, prior, backend="cpu")
    assert frames[0].iterations <= 1 < cold.iterations
    assert np.abs(frames[0].displacement - cold.displacement).max() < 0.02


def test_growth_without_room_folds_nothing_and_finds_back_as_from_nothing(tmp_path) -> None:
    prior, updates = NeoHookeanPrior(), []
    easy, crowded = (held(growth(a * DISC), np.where(DISC, 30.0, 1.0)) for a in (0.1, 5.0))
    with LiveSolver(updates.append, prior, backend="cpu") as live:
        for problem in (crowded, easy):
            live.submit(problem)
            assert live.wait(100)
    crushed, back = (update.solution for update in updates)
    assert crushed.reach.least_jacobian < 0.01
    assert prior.corner_jacobians(crowded, crushed.displacement).min() > 0
    assert 0 < crushed.reach.grown <= 1
    assert Solution.read(crushed.write(tmp_path / "grown.npz")).reach == crushed.reach
    cold = solve(easy, prior, optimizer=Multigrid(0.01), backend="cpu")
    np.testing.assert_array_equal(back.displacement, cold.displacement)
