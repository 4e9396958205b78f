"""Large motion with a quadratic data term: a precision at each site, and uncertain landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import campaign as campaigns
from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, ProblemError, solve
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu import finite_base
from napari_hmrf.solver.backends.cpu.finite_model import CpuFiniteModel
from napari_hmrf.solver.backends.cpu.finite_volume_model import CpuFiniteVolumeModel
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.optimizers.external_forces import ExternalForces, Measurements
from napari_hmrf.solver.problem import variant_of
from validation.bodies import turned
from validation.problems import random_large_data, random_tensors, tissue_with_data

GRIDS = {2: (12, 14), 3: (6, 7, 8)}
SPACING = {2: (1.0, 2.0), 3: (2.0, 1.0, 1.5)}


def tissue(axes, spacing=None):
    """Return tissue of random stiffness with random tensors and landmarks."""
    dice = np.random.default_rng(axes)
    tensors = random_tensors(dice, GRIDS[axes], axes, 3.0, 0.5)
    about = dice, GRIDS[axes], spacing or SPACING[axes], tensors, 10.0
    return tissue_with_data(*about, is_held=True, has_landmarks=True)


def linearised(problem, prior):
    """Return the model of a problem, linearised at a small random displacement, and its forces."""
    material, axes = prior.material(problem), len(problem.shape)
    kind = CpuFiniteModel if axes == 2 else CpuFiniteVolumeModel
    model = finite_base.the_model(material, kind)
    _, held = host.prescribed(problem)
    y = host.planes(problem.observed.astype(np.float64) / problem.unit)
    outside = ExternalForces(None, Measurements(material.data, y))
    moves = np.isfinite(y) & (host.planes(np.ones((*problem.shape, axes))) > 0)
    d = np.where(moves, 0.1 * np.random.default_rng(0).normal(size=y.shape), 0.0)

    def energy(at):
        return model.energy(at)[0] + outside.energy(at)

    def forces(at):
        return model.forces(at) + outside.forces(at)

    model.linearise(d, held, forces(d))
    return model, d, energy, forces


@pytest.mark.parametrize("axes", [2, 3])
def test_forces_and_linear_model_are_the_derivatives_of_the_energy(axes):
    model, d, energy, forces = linearised(tissue(axes), NeoHookeanPrior(0.3))
    way = np.where(model.moves, np.random.default_rng(1).normal(size=d.shape), 0.0)
    step = 1e-5
    slope = (energy(d + step * way) - energy(d - step * way)) / (2 * step)
    assert float((forces(d) * way).sum()) == pytest.approx(slope, rel=1e-6)
    bend = (forces(d + step * way) - forces(d - step * way)) / (2 * step)
    bend = np.where(model.moves, bend, 0.0)
    assert np.abs(model.image(way) - bend).max() < 1e-5 * np.abs(bend).max()
    factors = Factors(model.tangents, model.moves, lambda _: None, model.springs)
    assert np.abs(factors.solve(bend) - way).max() < 1e-4


@pytest.mark.parametrize("axes", [2, 3])
def test_small_motion_is_that_of_linear_elasticity(axes):
    # In oblong pixels, the two models have different energies of the twist.
    problem = tissue(axes, spacing=(2.0,) * axes)
    marks, differences = problem.landmarks, []
    for size in (1e-2, 1e-3):
        targets = marks.points + size * (marks.targets - marks.points)
        small = variant_of(
            problem,
            observed=problem.observed * np.float32(size),
            landmarks=Landmarks(marks.points, targets, sd=marks.sd),
        )
        one, two = (
            solve(small, prior, optimizer=Multigrid(1e-6), backend="cpu").displacement
            for prior in (ElasticPrior(0.3), NeoHookeanPrior(0.3))
        )
        differences.append(np.abs(one - two).max() / np.abs(one).max())
    assert differences[1] < 2e-3
    assert differences[1] < 0.2 * differences[0]


def test_random_data_lead_to_the_field_of_an_independent_method():
    run = campaigns.run("large-data", (0, 3, 4, 10))
    assert {verdict.kinds["rigid tissue"] for _, verdict in run.verdicts} == {"none", "some"}
    outcomes = [verdict.outcome for _, verdict in run.verdicts]
    assert outcomes.count("right") == 4
    assert run.is_right, campaigns.report(run)


@pytest.mark.parametrize("strength", [1e-2, 1e6])
def test_tissue_that_only_data_hold_follows_a_rotation_of_any_size(strength):
    y, c, data = np.zeros((20, 30, 2)), np.zeros((20, 30, 2)), np.zeros((20, 30))
    y[:, -1] = turned(20, 30, 60)
    data[:, [0, -1]] = strength
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((20, 30)), precision=data)
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    assert found.convergence.error < 1e-3
    assert found.reach.unbalanced_at is None
    assert found.count_folds() == 0
    if strength == 1e6:
        c[:, [0, -1]] = 1
        held = replace_data(problem, confidence=c, precision=None)
        exact = solve(held, NeoHookeanPrior(0.3), backend="cpu")
        assert np.abs(found.displacement - exact.displacement).max() < 5e-3


def replace_data(problem, **changes):
    """Return a problem with other fields."""
    fields = "observed", "confidence", "stiffness", "spacing", "precision", "landmarks"
    return Problem(**{name: getattr(problem, name) for name in fields} | changes)


def test_landmarks_that_fold_elastic_tissue_do_not_fold_it_in_large_motion():
    points = np.array([[10.0, 10.0], [10.0, 20.0], [20.0, 10.0], [20.0, 20.0]]) + 0.4
    steps = np.array([[4, 0], [-4, 2], [0, -4], [4, 4]])
    marks = Landmarks(points, points + steps, sd=0.05)
    c = np.zeros((30, 30, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones((30, 30)), landmarks=marks)
    assert solve(problem, ElasticPrior(0.3), backend="cpu").count_folds() > 0
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    assert found.count_folds() == 0
    assert found.reach.unbalanced_at is None
    assert np.abs(found.at(points) - steps).max() < 0.5


def test_strong_tensors_need_few_cycles():
    dice = np.random.default_rng(0)
    tensors = random_tensors(dice, (48, 48), 1, 1e4, 0.3)
    rows, cols = np.indices((48, 48)) / 47
    y = np.stack([np.sin(3 * rows) * cols, np.sin(3 * cols) * rows], axis=-1)
    problem = Problem(
        observed=y, confidence=np.zeros_like(y), stiffness=np.ones((48, 48)), precision=tensors
    )
    messages = []
    found = solve(
        problem,
        NeoHookeanPrior(0.3),
        backend="cpu",
        progress=lambda monitor: messages.append(monitor.message),
    )
    cycles = max(int(text.split()[1][:-1]) for text in messages if text.startswith("cycle"))
    assert found.convergence.way == "cycles"
    assert cycles <= 12 * len(found.energy)


def test_observations_that_may_slip_are_combined_with_data():
    problem, c = tissue(2), np.zeros((*GRIDS[2], 2))

    def displacement(penalty, confidence):
        c[0], c[-1] = 1, confidence
        some = replace_data(problem, confidence=c, observed=0.3 * problem.observed)
        return solve(some, NeoHookeanPrior(0.3, penalty=penalty), backend="cpu").displacement

    assert np.abs(displacement(1e4, 0.5) - displacement(np.inf, 1)).max() < 5e-3
    assert np.abs(displacement(None, 1e-6) - displacement(None, 0)).max() < 5e-3


def test_a_warm_start_continues_from_the_last_field():
    case = random_large_data(0)
    first = solve(case.problem, case.prior, backend="cpu")
    again = solve(case.problem, case.prior, backend="cpu", initial=first)
    assert len(again.energy) == 1
    assert np.abs(again.displacement - first.displacement).max() < 2e-3 * case.problem.unit


def test_a_drift_is_refused():
    points = np.array([[2.0, 2.0], [2.0, 7.0], [7.0, 2.0], [7.0, 7.0]])
    marks = Landmarks(points, points + 0.1, sd=0.5, drift=True)
    none = np.zeros((10, 10, 2))
    problem = Problem(observed=none, confidence=none, stiffness=np.ones((10, 10)), landmarks=marks)
    with pytest.raises(ProblemError, match="landmarks: cannot have a drift in large motion"):
        solve(problem, NeoHookeanPrior(), backend="cpu")
