"""Meaning of confidence in a Problem and a Study: 1 is exact, lower values may slip."""

import json
import math

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Drawing,
    ElasticPrior,
    Grid,
    LiveSolver,
    Motion,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Study,
    Tissue,
    read_study,
    replay,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.loads import reactions
from napari_hmrf.solver.loads import Loads
from napari_hmrf.study.ground import build_problem
from napari_hmrf.study.models import HOLD_ALL, details_of, prior_of

SIZE = 24


def uncertain_problem(confidence=0.05, rigid=False, far=3.0):
    """Return a square with a fixed edge and an uncertain displacement of its middle."""
    y, c = np.zeros((2, SIZE, SIZE, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    y[10:14, 10:14], c[10:14, 10:14] = (0, far), confidence
    m = np.ones((SIZE, SIZE))
    m[5:8, 5:15] = math.inf if rigid else 4.0
    return Problem(observed=y, confidence=c, stiffness=m)


def study_of(problem, prior):
    """Return the problem as a study."""
    motion = Motion(observed=problem.observed, confidence=problem.confidence)
    grid = Grid(problem.shape, problem.spacing)
    return Study(grid, Tissue(stiffness=problem.stiffness), motion, prior=prior)


@pytest.mark.parametrize("prior", [ElasticPrior(), NeoHookeanPrior(), ElasticPrior(penalty=0.02)])
def test_a_problem_and_a_study_give_the_same_field_bit_for_bit(prior):
    problem = uncertain_problem()
    found = solve(problem, prior, backend="cpu")
    of_study = solve_study(study_of(problem, prior), backend="cpu")
    np.testing.assert_array_equal(found.displacement, of_study.displacement)
    assert 0.02 < found.displacement[11, 11, 1] < 2.5, "the uncertain observation should slip"
    assert found.provenance.parameters == of_study.provenance.parameters
    assert dict(found.provenance.inputs) == dict(of_study.provenance.inputs)


def random_uncertain_problem(seed):
    dice = np.random.default_rng(seed)
    shape = (9, 8)
    c = np.where(dice.random((*shape, 2)) < 0.5, dice.choice([0.01, 0.2, 1.0], (*shape, 2)), 0)
    c[0] = 1
    y = dice.normal(size=(*shape, 2))
    return Problem(
        observed=y, confidence=c, stiffness=10 ** dice.uniform(0, 2, shape), spacing=(1.0, 1.5)
    )


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(2, 9))]
)
def test_the_field_is_exact_for_mixed_certain_and_uncertain_observations(seed):
    """Check the conditions of the minimum, which are sufficient because the energy is convex."""
    problem, prior = random_uncertain_problem(seed), ElasticPrior(0.4)
    found = solve(problem, prior, optimizer=Multigrid(1e-6), backend="cpu")
    c, off = problem.confidence, problem.observed - found.displacement
    forces = prior.forces(problem, found.displacement)
    np.testing.assert_allclose(off[c == 1], 0, atol=1e-6)  # rounding errors of the units
    np.testing.assert_allclose(forces[c == 0], 0, atol=1e-4)
    doubtful = (c > 0) & (c < 1)
    slips = doubtful & (np.abs(off) > 1e-4)
    assert np.abs(off)[doubtful].max() > 0.1
    np.testing.assert_allclose(forces[slips], (np.sign(off) * c)[slips], atol=1e-4)
    assert (np.abs(forces) <= c + 1e-4)[doubtful].all()


@pytest.mark.parametrize("kind", [ElasticPrior, NeoHookeanPrior])
def test_the_force_of_an_uncertain_observation_is_limited_by_its_confidence(kind):
    problem, prior = uncertain_problem(), kind()
    found = solve(problem, prior, backend="cpu")
    forces = np.abs(reactions(problem, found)) / prior.force_unit(problem)
    doubtful = (problem.confidence > 0) & (problem.confidence < 1)
    most = problem.confidence[doubtful]
    assert (forces[doubtful] <= 1.01 * most).all()
    assert (forces[doubtful] >= 0.99 * most).any()
    assert forces[problem.confidence == 1].max() > 0


def test_certain_observations_withstand_any_force():
    # A force that no finite penalty would resist, on a prescribed pixel.
    calm = uncertain_problem()
    pull = np.zeros((SIZE, SIZE, 2))
    pull[0, 12] = (-1e9, 0)
    problem = Problem(
        observed=calm.observed,
        confidence=calm.confidence,
        stiffness=calm.stiffness,
        loads=Loads(force=pull),
    )
    found = solve(problem, backend="cpu")
    np.testing.assert_array_equal(found.displacement, solve(calm, backend="cpu").displacement)


def test_uncertain_observations_in_a_volume_slip():
    y, c = np.zeros((2, 8, 8, 8, 3))
    c[0] = c[-1] = 1
    y[4, 3:5, 3:5], c[4, 3:5, 3:5] = (0, 0, 2.0), 0.05
    found = solve(Problem(observed=y, confidence=c, stiffness=np.ones((8, 8, 8))), backend="cpu")
    assert not found.displacement[0].any()
    assert 0.01 < found.displacement[4, 3, 3, 2] < 1.5


def test_in_large_motion_with_rigid_tissue_observations_are_exact_and_a_note_reports_it():
    problem, kind = uncertain_problem(0.5, rigid=True, far=1.0), NeoHookeanPrior
    found = solve(problem, kind(), backend="cpu")
    np.testing.assert_allclose(found.displacement[11, 11], (0, 1), atol=2e-3)
    (note,) = found.notes
    assert "16 boundary pixels were held exactly" in note
    of_study = solve_study(study_of(problem, kind()), backend="cpu")
    assert note in of_study.notes
    np.testing.assert_array_equal(of_study.displacement, found.displacement)
    assert not solve(problem, kind(penalty=math.inf), backend="cpu").notes, (
        "no note is expected for exact observations"
    )
    assert not solve(uncertain_problem(), kind(), backend="cpu").notes


def test_the_penalty_is_infinite_without_uncertain_observations():
    problem = uncertain_problem(1.0)
    prior = ElasticPrior().resolved(problem)
    assert prior == ElasticPrior(penalty=math.inf)
    assert prior.kernels == ElasticPrior(penalty=math.inf).kernels
    assert ElasticPrior().resolved(uncertain_problem()).kernels == ElasticPrior(penalty=1.0).kernels
    by_default, by_name = (solve(problem, each) for each in (None, ElasticPrior(penalty=math.inf)))
    np.testing.assert_array_equal(by_default.displacement, by_name.displacement)
    assert by_default.provenance.parameters == by_name.provenance.parameters
    # Confidence outside tissue has no effect.
    m = problem.stiffness.copy()
    m[20, 20] = 0
    c = problem.confidence.copy()
    c[20, 20] = 0.5
    assert not ElasticPrior().can_slip(
        Problem(observed=problem.observed, confidence=c, stiffness=m)
    )


def test_a_given_penalty_replaces_the_default_rule():
    everything = solve(uncertain_problem(), ElasticPrior(penalty=math.inf), backend="cpu")
    np.testing.assert_allclose(everything.displacement[10:14, 10:14, 1], 3.0, atol=1e-6)
    number = solve(uncertain_problem(), ElasticPrior(penalty=1e-3), backend="cpu")
    assert number.displacement[11, 11, 1] < 0.05, "a finite K should limit the force to K c"


def test_live_solves_of_uncertain_observations_agree_with_a_cold_solve():
    problem, frames = uncertain_problem(), []
    with LiveSolver(frames.append, optimizer=Multigrid(1e-4), backend="cpu") as live:
        for far in (1.0, 2.0, 3.0):
            live.submit(uncertain_problem(far=far))
            assert live.wait(60)
    cold = solve(problem, optimizer=Multigrid(1e-4), backend="cpu")
    apart = np.abs(frames[-1].solution.displacement - cold.displacement).max()
    assert apart <= frames[-1].solution.convergence.error + cold.convergence.error


@pytest.mark.parametrize("penalty", [None, 0.25, math.inf])
@pytest.mark.parametrize("kind", [ElasticPrior, NeoHookeanPrior])
def test_files_and_the_form_preserve_the_penalty(tmp_path, kind, penalty):
    prior = kind(0.3, penalty=penalty)
    study = study_of(uncertain_problem(), prior)
    solution = solve_study(study, backend="cpu")
    saved = write_study(tmp_path / "a.study", study, solution)
    again = read_study(saved)
    assert again.study.prior == prior
    np.testing.assert_array_equal(replay(saved).displacement, solution.displacement)
    of_solution = again.solution.provenance.parameters["prior"]
    assert of_solution == prior.in_force(uncertain_problem()).parameters
    json.dumps(prior.parameters)
    assert prior_of(session(kind), details_of(prior, study.optimizer), poisson=0.3) == prior


def session(kind):
    return "elastic" if kind is ElasticPrior else "large motion"


def test_the_largest_holding_force_in_the_form_makes_observations_exact():
    assert prior_of("elastic").penalty is None
    every = details_of(ElasticPrior(penalty=math.inf), Multigrid())
    assert every.grip == HOLD_ALL
    assert prior_of("elastic", every).penalty == math.inf


def test_the_problem_of_a_study_has_the_drawn_confidence():
    pull = Arrow(at=(12, 12), by=(0, 2), radius=2, confidence=0.05)
    motion = Motion(hold_edge=True, drawing=Drawing((pull,)))
    grid = Grid((SIZE, SIZE), (1.0, 1.0))
    stated = build_problem(Study(grid, Tissue(stiffness=np.ones(grid.shape)), motion))
    assert set(np.unique(stated.problem.confidence)) == {0, np.float32(0.05), 1}
    assert stated.prior.penalty is None
