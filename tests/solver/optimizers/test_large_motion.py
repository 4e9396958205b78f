"""Large motion: displacement, absence of folds, and reports."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt
import pytest

from napari_hmrf import (
    BackendError,
    Cancelled,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    Solution,
    solve,
)
from napari_hmrf.loads import Loads
from validation.bodies import bar, dragged_disc, turned
from validation.oracles.large_motion import large_field

Field = npt.NDArray[np.float64]


def jacobians_of(problem: Problem, solution: Solution) -> Field:
    return NeoHookeanPrior().corner_jacobians(problem, solution.displacement)


def random_loads(random: np.random.Generator, shape: tuple[int, int]) -> Loads:
    """Return random growth along all directions and random forces."""
    strain = random.normal(size=(*shape, 3, 3)) * 0.1
    return Loads(growth=strain + strain.swapaxes(-1, -2), force=random.normal(size=(*shape, 2)))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
@pytest.mark.parametrize("degrees", [90, 120])
def test_a_disc_that_its_core_turns_is_as_near_to_a_rotation_as_reported(degrees, tolerance):
    place = np.moveaxis(np.indices((33, 33)), 0, -1) - 16.0
    away, turn = np.linalg.norm(place, axis=-1), np.radians(degrees)
    turned_back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    exact, core = place @ turned_back - place, (away < 4)[..., None]
    disc = Problem(
        observed=np.where(core, exact, 0),
        confidence=core * np.ones(2),
        stiffness=(away < 14).astype(float),
    )
    solution = solve(disc, NeoHookeanPrior(), optimizer=Multigrid(tolerance), backend="cpu")
    error = np.abs(solution.displacement - exact)[away < 14].max()
    assert error <= 1.05 * max(tolerance, solution.convergence.error)


def test_a_compressed_bar_that_hardly_resists_bending_is_as_near_to_equilibrium_as_reported():
    c, y = np.zeros((10, 13, 2)), np.zeros((10, 13, 2))
    c[:, [0, -1], 1], c[0, :, 0], y[:, -1, 1] = 1, 1, -6
    compressed = Problem(observed=y, confidence=c, stiffness=np.ones((10, 13)))
    rough, exact = (
        solve(compressed, NeoHookeanPrior(0.45), optimizer=Multigrid(within), backend="cpu")
        for within in (1e-3, 1e-6)
    )
    assert np.abs(rough.displacement - exact.displacement).max() <= rough.convergence.error


@pytest.mark.parametrize("grows", [False, True])
@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_forces_and_tangents_are_derivatives_of_the_energy(plane, grows) -> None:
    random = np.random.default_rng(4)
    m = random.uniform(1, 3, (6, 7))
    m[0, 0] = 0
    c = np.ones((6, 7, 2))
    loads = random_loads(random, (6, 7)) if grows else None
    if loads is not None:
        pulls = np.array(loads.force)
        pulls[0, 0] = 0
        loads = Loads(growth=loads.growth, force=pulls)
    problem = Problem(observed=c, confidence=c, stiffness=m, spacing=(1, 2), loads=loads)
    prior = NeoHookeanPrior(0.4, plane=plane)
    d, way = random.normal(size=(2, 6, 7, 2)) * 0.15 * problem.unit
    assert 0 < prior.corner_jacobians(problem, d).min() < 0.5, (
        "the field does not cover small Jacobians"
    )
    step, short = way / problem.unit, 1e-5
    energies = [prior.energy(problem, d + side * short * way) for side in (-1, 1)]
    slope = float((prior.forces(problem, d) * step).sum())
    assert (energies[1] - energies[0]) / (2 * short) == pytest.approx(slope, rel=1e-6)
    forces = [prior.forces(problem, d + side * short * way) for side in (-1, 1)]
    bend = float(((forces[1] - forces[0]) * step).sum()) / (2 * short)
    upper, lower = step[1:] - step[:-1], step[:, 1:] - step[:, :-1]
    rows, cols = upper[:, :-1] + upper[:, 1:], lower[:-1] + lower[1:]
    differences = np.concatenate([rows, cols, upper[:, 1:] - upper[:, :-1]], axis=-1)
    tangents = prior.tangents(problem, d)
    found = np.einsum("ija,ijab,ijb", differences, tangents, differences)
    assert found == pytest.approx(bend, rel=1e-6)


def test_the_compiled_energy_forces_and_tangents_match_the_prior() -> None:
    from napari_hmrf.solver.backends import host
    from napari_hmrf.solver.backends.cpu.finite_model import CpuFiniteModel

    random = np.random.default_rng(5)
    m = random.uniform(1, 3, (40, 37))
    m[10:14, 7:9] = 0
    c = np.ones((40, 37, 2))
    d = random.normal(size=c.shape) * 0.15
    grown = Loads(growth=random_loads(random, (40, 37)).growth)
    for plane, loads in (("stress", None), ("strain", None), ("stress", grown), ("strain", grown)):
        problem, prior = (
            Problem(observed=c, confidence=c, stiffness=m, loads=loads),
            NeoHookeanPrior(0.4, plane=plane),
        )
        model = CpuFiniteModel((40, 37))
        model.assemble(prior.material(problem))
        planes = host.planes(d)
        energy, least = model.energy(planes)
        assert 0 < least == pytest.approx(prior.corner_jacobians(problem, d).min())
        assert energy == pytest.approx(prior.energy(problem, d))
        np.testing.assert_allclose(
            host.field(model.forces(planes)), prior.forces(problem, d), atol=1e-12
        )
        way, none = host.planes(random.normal(size=c.shape)), np.zeros((2, 44, 41), dtype=bool)
        model.linearise(planes, none, model.forces(planes))
        short = 1e-6
        forces = [prior.forces(problem, d + side * short * host.field(way)) for side in (-1, 1)]
        expected = (forces[1] - forces[0]) / (2 * short)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            host.field(model.image(way)) / scale, expected / scale, atol=1e-6
        )


@pytest.mark.parametrize(
    ("name", "plane"),
    [
        ("bent", "stress"),
        ("sheared", "strain"),
        *(
            pytest.param(*case, marks=pytest.mark.campaign)
            for case in (
                ("pulled", "stress"),
                ("pulled", "strain"),
                ("bent", "strain"),
                ("sheared", "stress"),
            )
        ),
    ],
)
def test_large_motion_agrees_with_an_independent_solver(name, plane) -> None:
    ends = {
        "pulled": np.broadcast_to([0.0, 7.0], (16, 2)),
        "bent": turned(16, 24, 60),
        "sheared": np.broadcast_to([8.0, 0.0], (16, 2)),
    }
    m = np.ones((16, 24))
    m[:8] = 5
    problem, prior = bar(16, 24, ends[name], m), NeoHookeanPrior(0.45, plane=plane)
    found = solve(problem, prior, backend="cpu")
    assert np.abs(found.displacement - large_field(problem, prior, 20)).max() < 0.002
    assert found.convergence.error <= 1e-3


def test_small_motion_agrees_with_linear_elasticity() -> None:
    random = np.random.default_rng(6)
    m = random.uniform(1, 4, (24, 30))
    m[5:9, 11:14] = 0
    problem = bar(24, 30, np.broadcast_to([2e-4, 3e-4], (24, 2)), m)
    precise = Multigrid(1e-9)
    nu = np.where(m > 2, 0.3, 0.45)
    finite = solve(problem, NeoHookeanPrior(nu), optimizer=precise, backend="cpu")
    linear = solve(problem, ElasticPrior(nu), optimizer=precise, backend="cpu")
    off = np.abs(finite.displacement - linear.displacement).max()
    assert off < 1e-4 * np.abs(linear.displacement).max()


@pytest.mark.parametrize("spacing", [(0.5, 1.5), pytest.param((1, 1), marks=pytest.mark.campaign)])
def test_tissue_rotates_without_strain(spacing) -> None:
    row, col = np.indices((20, 26))
    angle, size = np.deg2rad(30), np.array(spacing)
    x = np.stack([row, col], axis=-1) * size
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    y = x @ turn - x
    c = np.zeros_like(y)
    c[4:7, 4:6] = 1
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((20, 26)), spacing=spacing)
    found = solve(problem, NeoHookeanPrior(), optimizer=Multigrid(1e-5), backend="cpu")
    assert np.abs(found.displacement - y).max() < 1e-3
    moved = x + found.displacement
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(moved, axis=axis), axis=-1) / size[axis]
        assert np.abs(length - 1).max() < 1e-4


def test_a_patch_that_is_pulled_far_causes_no_folds() -> None:
    problem = dragged_disc(60, 4, 22)
    linear = solve(problem, ElasticPrior(), backend="cpu")
    assert jacobians_of(problem, linear).min() < 0, "the linear solution does not fold"
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    least = jacobians_of(problem, found).min()
    assert found.reach.least_jacobian == pytest.approx(least, abs=1e-6)
    assert least > 0.05
    assert (found.reach.part, found.reach.where) == (1.0, None)


def test_an_unreachable_prescribed_motion_is_followed_as_far_as_possible() -> None:
    c, y = np.zeros((2, 32, 32, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    inside = np.zeros((32, 32), dtype=bool)
    inside[12:20, 6:14] = True
    c[inside], y[inside] = 1, (0, 30)
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((32, 32)))
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    reach = found.reach
    assert jacobians_of(problem, found).min() > 0
    assert inside[reach.where]
    assert 0 < reach.sites <= inside.sum()
    assert reach.missing == pytest.approx(30 - found.displacement[reach.where][1], abs=0.02)
    assert 0.2 < reach.part < 0.9
    assert reach.part == pytest.approx(1 - reach.missing / 30)


def test_a_drag_starts_from_the_last_fields() -> None:
    frames = [solve(dragged_disc(48, 4, 6), NeoHookeanPrior(), backend="cpu")]
    base = np.array(dragged_disc(48, 4, 6).observed)
    moved = base[..., 1] > 0
    for far in (8, 10, 12):
        y = base.copy()
        y[moved, 1] = far
        problem = Problem(
            observed=y, confidence=dragged_disc(48, 4, 6).confidence, stiffness=np.ones((48, 48))
        )
        live, last = Multigrid(0.01), frames[:3]
        found = solve(problem, NeoHookeanPrior(), optimizer=live, backend="cpu", initial=last)
        frames.insert(0, found)
    cold = solve(problem, NeoHookeanPrior(), backend="cpu")
    assert found.iterations <= 2 < cold.iterations
    assert np.abs(found.displacement - cold.displacement).max() < 0.02


def test_a_solve_reports_progress_and_can_be_cancelled() -> None:
    said, stop = [], threading.Event()

    def tell(monitor) -> None:
        said.append(monitor)
        if "cycle 3" in monitor.message:
            stop.set()

    with pytest.raises(Cancelled):
        solve(dragged_disc(60, 4, 22), NeoHookeanPrior(), backend="cpu", progress=tell, cancel=stop)
    assert any("px left to pull" in each.message for each in said)
    assert all(0 <= each.fraction <= 1 for each in said)


def test_unsupported_problems_are_rejected_with_an_explanation() -> None:
    soft = bar(8, 8, np.zeros((8, 2)))
    shear = np.zeros((8, 8, 2, 2))
    shear[..., 0, 1] = shear[..., 1, 0] = 1.5
    loaded = Problem(
        observed=soft.observed,
        confidence=soft.confidence,
        stiffness=soft.stiffness,
        loads=Loads(growth=shear),
    )
    with pytest.raises(ProblemError, match="shrinks tissue to nothing in some direction"):
        solve(loaded, NeoHookeanPrior())
    with pytest.raises(BackendError, match="loops solve large motion, not opengl"):
        solve(soft, NeoHookeanPrior(), backend="opengl")
    loose = np.ones((8, 8))
    loose[:, 4] = 0
    c = np.zeros((8, 8, 2))
    c[:, 0] = 1
    with pytest.raises(ProblemError, match="free"):
        solve(Problem(observed=c, confidence=c, stiffness=loose), NeoHookeanPrior())


def test_the_reach_is_saved_with_the_solution(tmp_path) -> None:
    found = solve(bar(8, 12, np.broadcast_to([0.0, 4.0], (8, 2))), NeoHookeanPrior(), backend="cpu")
    again = Solution.read(found.write(tmp_path / "far.npz"))
    assert again.reach == found.reach
    assert again.provenance.model == "large motion"
