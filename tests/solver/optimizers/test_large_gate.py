"""Large motion never returns folded fields or errors that are NaN."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import ConvergenceError, NeoHookeanPrior, Problem, Solution, solve
from napari_hmrf.fields import count_folds
from napari_hmrf.loads import growth
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu.finite_model import CpuFiniteModel
from napari_hmrf.solver.caveats import shortfall
from napari_hmrf.solver.optimizers import large_motion, newton
from napari_hmrf.solver.optimizers.base import Reach
from validation.oracles.large_motion import smallest_jacobian

PRIOR = NeoHookeanPrior(0.49, plane="strain")


def dragged(way: float, spacing: tuple[float, float] = (1.0, 1.0)) -> Problem:
    """Return a disc that is pulled towards a fixed edge through soft and stiff tissue."""
    row, col = np.indices((14, 20))
    disc = np.hypot(row - 6.5, col - 8) < 3
    c, y = np.zeros((2, 14, 20, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    c[disc], y[disc] = 1, (0, way)
    m = np.where(abs(row - col / 2) < 2, 2000.0, 1.0)
    return Problem(observed=y * np.array(spacing), confidence=c, stiffness=m, spacing=spacing)


def crushed(phase: float) -> Problem:
    """Return a disc that grows to four times its length beside a disc that is pulled by 40 px."""
    row, col = np.indices((12, 28))
    disc = np.hypot(row - 5.5, col - 16.8) < 3.5
    c, y = np.zeros((2, 12, 28, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    c[disc], y[disc] = 1, (-4.0, -40.0)
    m = np.where(abs(row - 6 - 3.36 * np.sin(0.35 * col + phase)) < 2.5, 2000.0, 1.0)
    grows = np.hypot(row - 5.5, col - 14) < 5.5
    return Problem(
        observed=y, confidence=c, stiffness=m, spacing=(0.5, 2.0), loads=growth(3.0 * grows)
    )


def model_of(problem: Problem) -> CpuFiniteModel:
    model = CpuFiniteModel(problem.shape)
    model.assemble(PRIOR.material(problem))
    return model


def squeezed(left: float, pushed: float) -> np.ndarray:
    """Return a translation of 2 x 2 sites that also compresses their width."""
    d = np.full((2, 2, 2), pushed)
    d[:, 1, 1] += left - 1
    return d


def test_a_corner_whose_jacobian_first_rises_still_limits_the_step() -> None:
    problem = Problem(
        observed=np.zeros((2, 2, 2)), confidence=np.ones((2, 2, 2)), stiffness=np.ones((2, 2))
    )
    model, d, way = model_of(problem), squeezed(1e-6, 0.0), np.zeros((2, 2, 2))
    way[:, 1, 1] = 1e-3  # makes the element wider
    way[1, :, 0] = -1.0  # and flatter: J = (1 - t) (1e-6 + 1e-3 t)
    length, _ = model.length(host.planes(d), host.planes(way), 0.25, 1e-5)
    assert length == pytest.approx(1 - 1e-3)
    assert smallest_jacobian(problem, d + length * way, 2) >= 0.99e-6


def test_a_step_that_folds_tissue_is_rejected_after_it_is_taken(monkeypatch) -> None:
    """Check that fields are tested for folds after a step, not only before."""
    unlimited = np.inf, np.full((13, 19), np.inf)
    monkeypatch.setattr(CpuFiniteModel, "length", lambda *_, **__: unlimited)
    problem = dragged(15.0)
    try:
        found = solve(problem, PRIOR, backend="cpu")
    except ConvergenceError:
        return  # an error is also acceptable
    assert smallest_jacobian(problem, found.displacement, 2) > 0
    assert math.isfinite(found.convergence.error)


def test_the_last_valid_field_is_returned_after_a_step_to_nan(monkeypatch) -> None:
    steps = []

    def pull(self, d, start, way, y, held):
        steps.append(d.copy())
        np.copyto(d, d + 0.1 * way if len(steps) < 3 else np.nan)
        return 0.1

    monkeypatch.setattr(newton.Newton, "_pull", pull)
    found = solve(dragged(2.0), PRIOR, backend="cpu")
    assert np.isfinite(found.displacement).all()
    assert found.reach.part < 1
    assert math.isfinite(found.convergence.error)


def test_the_field_has_double_precision_if_single_precision_would_fold() -> None:
    problem = Problem(
        observed=np.zeros((2, 2, 2)), confidence=np.ones((2, 2, 2)), stiffness=np.ones((2, 2))
    )
    model, far = model_of(problem), squeezed(1e-6, 100.3)
    assert not smallest_jacobian(problem, far.astype(np.float32), 2) > 0, (
        "single precision resolves the field"
    )
    found, _, least = large_motion._returned(model, problem, host.planes(far), 1e-3)
    assert found.dtype == np.float64
    assert least == pytest.approx(1e-6, rel=1e-3)
    near = squeezed(0.5, 1.0)
    found, _, least = large_motion._returned(model, problem, host.planes(near), 1e-3)
    assert found.dtype == np.float32
    assert least == pytest.approx(0.5)


@pytest.mark.parametrize("left", [-0.1, 0.0, math.nan])
def test_a_folded_result_raises_an_error(left) -> None:
    problem = Problem(
        observed=np.zeros((2, 2, 2)), confidence=np.ones((2, 2, 2)), stiffness=np.ones((2, 2))
    )
    d = host.planes(squeezed(left, 0.0))
    with pytest.raises(ConvergenceError, match="crushed to nothing"):
        large_motion._returned(model_of(problem), problem, d, 1e-3)


@pytest.mark.parametrize(
    "phase", [1.2, *(pytest.param(phase, marks=pytest.mark.campaign) for phase in (1.4, 5.0))]
)
def test_tissue_crushed_between_stiff_parts_does_not_fold(phase) -> None:
    problem = crushed(phase)
    found = solve(problem, PRIOR, backend="cpu")
    assert smallest_jacobian(problem, found.displacement, 2) > 0
    assert found.reach.least_jacobian > 0
    assert math.isfinite(found.convergence.error)
    assert math.isfinite(found.convergence.residual)
    assert count_folds(found.displacement, spacing=problem.spacing) == 0


def test_crushed_tissue_out_of_equilibrium_is_reported(tmp_path) -> None:
    problem = crushed(1.0)
    found = solve(problem, PRIOR, backend="cpu")
    reach, error = found.reach, found.convergence.error
    assert error > 1e-3, "the solve reached equilibrium"
    assert reach.unbalanced == pytest.approx(error * problem.unit)
    assert problem.tissue[reach.unbalanced_at]
    assert not problem.known[reach.unbalanced_at].all(), "the site is prescribed"
    said = shortfall(reach, "mm")
    assert f"{reach.unbalanced:.3g} mm from equilibrium" in said
    assert str(reach.unbalanced_at) in said
    assert Solution.read(found.write(tmp_path / "crushed.npz")).reach == reach


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_solution_file_keeps_the_floating_point_precision(precision, tmp_path) -> None:
    solution = solve(dragged(0.5), PRIOR, backend="cpu")
    solution = replace(solution, displacement=(solution.displacement + 1 / 3).astype(precision))
    loaded = Solution.read(solution.write(tmp_path / "precise.npz"))
    assert loaded.displacement.dtype == precision
    np.testing.assert_array_equal(loaded.displacement, solution.displacement)


def test_tissue_in_equilibrium_is_not_reported_as_unbalanced() -> None:
    found = solve(dragged(0.5), PRIOR, backend="cpu")
    assert found.convergence.error <= 1e-3
    assert found.reach.unbalanced == 0
    assert found.reach.unbalanced_at is None
    assert shortfall(Reach(0.5), "mm") == ""
