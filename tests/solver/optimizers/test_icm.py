"""ICM: agreement with the paper's algorithm, and behaviour of the tissue."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napari_hmrf import ICM, ConvergenceError, Problem, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.quadtree import levels
from validation.bodies import frame_problem
from validation.oracles.paper import (
    best_candidates,
    candidates,
    local_energies,
    prolonged,
    schedule,
    solve_exactly,
    solve_literally,
)

CONVERGED = ICM(iterations=20000, steps=None, energy_change=1e-9)


def bar(length, ratio, width=5):
    """Return a bar stretched by a tenth, with a left half that is `ratio` times stiffer."""
    shape = (width, length)
    m = np.ones(shape)
    m[:, : length // 2] = ratio
    y = np.zeros((*shape, 2))
    c = np.zeros((*shape, 2))
    c[:, [0, -1]] = 1
    c[[0, -1], :, 0] = 1  # prevent the sides from bulging
    y[:, -1, 1] = length / 10
    return Problem(observed=y, confidence=c, stiffness=m)


@pytest.mark.parametrize("conditional", ["centred", "blanket"])
def test_a_sweep_moves_each_site_to_its_best_candidate(conditional):
    # With one sweep per level, the finest level starts from the prolonged coarse field.
    shape = (3, 2)  # the levels are 3x2, 2x1 and 1x1, and only the finest has cliques
    rng = np.random.default_rng(5)
    steps = ICM().steps
    for _ in range(8):
        m = rng.choice([10.0, 20, 40], size=shape)
        problem = Problem(
            observed=rng.normal(size=(*shape, 2)), confidence=rng.random((*shape, 2)), stiffness=m
        )
        prior = SeilerPrior(penalty=2.0, conditional=conditional, damping=1.0)
        moved = solve(problem, prior, optimizer=ICM(iterations=1, steps=steps), backend="cpu")
        start, y, p = coarse_start(problem, prior, steps), problem.observed, prior.limit(problem)
        energies = local_energies(m, y, p, start, problem.spacing, conditional == "blanket")
        least = energies(best_candidates(energies, start, candidates(steps)))
        np.testing.assert_allclose(energies(moved.displacement), least, atol=1e-4)


def coarse_start(problem, prior, steps):
    """Return the start of the finest level: the prolonged solution of the coarse levels."""
    finest, *coarser = levels(problem.shape)
    at = np.ix_(
        *[[min(2 * i + 1, size - 1) for i in range(-(-size // 2))] for size in finest.shape]
    )
    coarse = Problem(
        observed=problem.observed[at],
        confidence=problem.confidence[at],
        stiffness=problem.stiffness[at],
    )
    assert coarse.shape == coarser[0].shape
    d = solve(coarse, prior, optimizer=ICM(iterations=1, steps=steps), backend="cpu").displacement
    return prolonged(d.astype(float), coarse.stiffness, problem.stiffness)


def test_the_loops_and_the_baseline_of_the_speed_tables_agree_with_the_literal_schedule():
    # Rounding decides between candidates of equal energy, so single sites may differ.
    problem = frame_problem((32, 25))
    expected = schedule(problem, 30)
    literal = solve_literally(problem, optimizer=ICM(iterations=30))
    ours = solve(problem, SeilerPrior(), optimizer=ICM(iterations=30), backend="cpu").displacement
    for found in (literal, ours):
        assert np.sqrt(np.mean((found - expected) ** 2)) < 0.01


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_the_converged_field_is_the_fixed_point(seed):
    problem = frame_problem((40, 40), seed=seed)
    solution = solve(
        problem, SeilerPrior(), optimizer=ICM(iterations=20000, steps=None), backend="cpu"
    )
    off = np.abs(solution.displacement - solve_exactly(problem, "centred"))
    assert off.max() < 0.01


def test_the_converged_field_is_exact_beside_void():
    rng = np.random.default_rng(2)
    shape = (42, 38)
    i, j = np.mgrid[:42, :38]
    r = np.hypot(i - 21, j - 19)
    m = np.where(r < 17, 10.0 * 2 ** rng.integers(0, 3, shape), 0)
    ring = (r >= 14) & (r < 17)
    y = np.stack([(i - 21) / 10, (j - 19) / 15], axis=-1) * ring[..., None]
    problem = Problem(observed=y, confidence=np.repeat(ring[..., None], 2, -1), stiffness=m)
    solution = solve(
        problem, SeilerPrior(), optimizer=ICM(iterations=20000, steps=None), backend="cpu"
    )
    assert (solution.displacement[~problem.tissue] == 0).all()
    inside = problem.tissue
    off = np.abs(solution.displacement - solve_exactly(problem, "centred"))[inside]
    assert off.max() < 0.01


@pytest.mark.parametrize(
    ("ratio", "expected", "length"),
    [
        (2.0, 2.04, 32),
        (5.0, 5.7, 64),
        pytest.param(2.0, 2.04, 128, marks=pytest.mark.campaign),
        pytest.param(5.0, 5.7, 128, marks=pytest.mark.campaign),
    ],
)
def test_a_bar_strains_where_it_is_soft_at_any_resolution(ratio, expected, length):
    solution = solve(bar(length, ratio), SeilerPrior(), optimizer=CONVERGED, backend="cpu")
    along = solution.displacement[2, :, 1]
    strain = np.diff(along)
    stiff = strain[length // 8 : length // 4].mean()
    soft = strain[-length // 4 : -length // 8].mean()
    assert soft / stiff == pytest.approx(expected, rel=0.05)


def test_uniform_tissue_with_an_affine_border_moves_affinely():
    i, j = np.mgrid[:40, :33]
    affine = np.stack([0.02 * i - 0.05 * j, 0.03 * j + 0.01 * i], axis=-1)
    c = np.zeros((40, 33, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    for spacing in [(1, 1), (0.5, 1.5)]:
        problem = Problem(
            observed=affine, confidence=c, stiffness=np.ones((40, 33)), spacing=spacing
        )
        found = solve(problem, SeilerPrior(), optimizer=CONVERGED, backend="cpu").displacement
        assert np.abs(found - affine).max() < 2e-3


def test_nothing_moves_when_the_boundary_is_fixed():
    problem = frame_problem((30, 30), amplitude=0)
    for optimizer in (ICM(), ICM(steps=None)):
        assert (
            solve(problem, SeilerPrior(), optimizer=optimizer, backend="cpu").displacement == 0
        ).all()


def test_the_field_depends_only_on_ratios_of_stiffness():
    problem = frame_problem((33, 20))
    scaled = Problem(
        observed=problem.observed, confidence=problem.confidence, stiffness=problem.stiffness * 1024
    )
    first = solve(problem, SeilerPrior(), optimizer=ICM(steps=None), backend="cpu").displacement
    second = solve(scaled, SeilerPrior(), optimizer=ICM(steps=None), backend="cpu").displacement
    np.testing.assert_allclose(first, second, atol=1e-5)


def test_the_unit_of_length_does_not_matter():
    problem = frame_problem((24, 30), spacing=(1, 2))
    inches = Problem(
        observed=problem.observed / 25.4,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=(1 / 25.4, 2 / 25.4),
    )
    first = solve(problem, SeilerPrior(), optimizer=ICM(steps=None), backend="cpu")
    second = solve(inches, SeilerPrior(), optimizer=ICM(steps=None), backend="cpu")
    np.testing.assert_allclose(first.displacement, second.displacement * 25.4, atol=1e-4)
    np.testing.assert_allclose(first.energy, second.energy, rtol=1e-3)


@pytest.mark.parametrize("shape", [(32, 16), pytest.param((64, 16), marks=pytest.mark.campaign)])
def test_mirrored_tissue_has_the_mirrored_displacement(shape):
    # Powers of two: the quadtree itself is not symmetric on other grids.
    problem = frame_problem(shape)
    sides = Problem(
        observed=problem.observed[:, ::-1] * (1, -1),
        confidence=problem.confidence[:, ::-1],
        stiffness=problem.stiffness[:, ::-1],
    )
    first = solve(problem, SeilerPrior(), optimizer=CONVERGED, backend="cpu").displacement
    second = solve(sides, SeilerPrior(), optimizer=CONVERGED, backend="cpu").displacement[
        :, ::-1
    ] * (1, -1)
    np.testing.assert_allclose(first, second, atol=0.01)


def test_higher_confidence_brings_tissue_closer_to_its_observation():
    shape = (17, 17)
    off = []
    for confidence in (0.01, 0.1, 1.0):
        c = np.zeros((*shape, 2))
        c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
        c[8, 8] = confidence
        y = np.zeros((*shape, 2))
        y[8, 8] = (0, 2)
        prior = SeilerPrior(penalty=100)
        problem = Problem(observed=y, confidence=c, stiffness=np.ones(shape))
        found = solve(problem, prior, optimizer=CONVERGED, backend="cpu").displacement
        off.append(2 - found[8, 8, 1])
        assert found[8, 8, 0] == pytest.approx(0, abs=1e-4)
    assert off[0] > off[1] > off[2]
    assert off[2] < 1e-3


def test_the_recorded_energy_is_the_energy_of_the_field():
    problem = frame_problem((50, 41))
    for prior in (SeilerPrior(penalty=50), SeilerPrior(conditional="blanket")):
        solution = solve(problem, prior, backend="cpu")
        expected = prior.mean_energy(problem, solution.displacement)
        assert solution.mean_energy == pytest.approx(expected, rel=1e-4)


def test_the_history_contains_every_iteration_from_coarse_to_fine():
    problem = frame_problem((50, 41))
    solution = solve(problem, SeilerPrior(), optimizer=ICM(iterations=13), backend="cpu")
    assert [run.shape for run in solution.levels] == [
        level.shape for level in reversed(levels((50, 41)))
    ]
    assert [run.iterations for run in solution.levels] == [13] * 7
    assert len(solution.energy) == solution.iterations == 13 * 7
    assert np.isfinite(solution.energy).all()


def test_a_tolerance_ends_each_level_once_its_energy_is_constant():
    problem = frame_problem((64, 64))
    fixed = solve(problem, SeilerPrior(), optimizer=ICM(iterations=500, steps=None), backend="cpu")
    loose = solve(
        problem,
        SeilerPrior(),
        optimizer=ICM(iterations=500, steps=None, energy_change=1e-3),
        backend="cpu",
    )
    assert loose.iterations < fixed.iterations / 2
    assert all(run.iterations <= 500 for run in loose.levels)
    assert loose.mean_energy == pytest.approx(fixed.mean_energy, rel=0.05)


def test_the_damped_blanket_conditional_lowers_the_energy_in_every_sweep():
    problem = frame_problem((40, 40), ratio=50)
    prior = SeilerPrior(conditional="blanket")
    solution = solve(problem, prior, optimizer=ICM(iterations=200, steps=None), backend="cpu")
    finest = solution.energy[-200:]
    assert (np.diff(finest) <= 1e-6 * finest[0]).all()


@pytest.mark.parametrize(("damping", "sweeps"), [(1.0, 20), (0.8, 70), (0.8, 300), (1.0, 1000)])
def test_blanket_cliques_that_diverge_are_refused_and_their_damping_named(damping, sweeps):
    too_large = SeilerPrior(conditional="blanket", damping=damping)
    for problem in (phantom("expansion", size=32).problem, frame_problem((40, 40))):
        with pytest.raises(ConvergenceError, match=rf"damping {damping:g}: .* below 2/3"):
            solve(problem, too_large, optimizer=ICM(sweeps, steps=None))


def test_blanket_cliques_that_do_not_diverge_are_solved_with_any_damping():
    # The energy of an affine motion is zero, so rounding raises it from sweep to sweep.
    i, j = np.mgrid[:40, :33]
    affine = np.stack([0.02 * i - 0.05 * j, 0.03 * j + 0.01 * i], axis=-1)
    c = np.zeros((40, 33, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    uniform = Problem(observed=affine, confidence=c, stiffness=np.ones((40, 33)))
    for damping, steps, tolerance in [
        (0.7, None, 0.1),  # bending decays slowly
        (1.0, ICM().steps, 0.5),  # candidates may oscillate by half the largest step
    ]:
        prior = SeilerPrior(conditional="blanket", damping=damping)
        found = solve(uniform, prior, optimizer=ICM(1000, steps=steps)).displacement
        assert np.abs(found - affine).max() < tolerance


@pytest.mark.parametrize(
    ("ratio", "optimizer"),
    [
        (40.0, ICM()),
        (1000.0, ICM(steps=None)),
        pytest.param(1.0, ICM(), marks=pytest.mark.campaign),
        pytest.param(1000.0, ICM(), marks=pytest.mark.campaign),
    ],
)
def test_a_thin_plate_of_any_stiffness_reaches_its_prescribed_position(ratio, optimizer):
    shape = (64, 64)
    m = np.ones(shape)
    m[:, 32] = ratio
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    c[20:44, 32] = 1
    y[20:44, 32, 1] = 8
    found = solve(
        Problem(observed=y, confidence=c, stiffness=m),
        SeilerPrior(),
        optimizer=optimizer,
        backend="cpu",
    ).displacement
    np.testing.assert_allclose(found[20:44, 32, 1], 8, atol=0.002)


@settings(max_examples=8)
@given(
    height=st.integers(1, 33),
    width=st.integers(1, 33),
    seed=st.integers(0, 2**16),
    decades=st.floats(0, 5),
    void=st.booleans(),
)
def test_tissue_never_moves_further_than_its_largest_observation(
    height, width, seed, decades, void
):
    # The centred update is a weighted mean with positive weights: a maximum principle.
    if height * width == 1:
        return
    rng = np.random.default_rng(seed)
    m = 10 ** (decades * rng.random((height, width)))
    if void:
        m *= rng.random((height, width)) < 0.8
    c = (rng.random((height, width, 2)) < 0.3).astype(float)
    m[0, 0], c[0, 0] = 1, 1
    y = rng.normal(size=(height, width, 2))
    problem = Problem(observed=y, confidence=c, stiffness=m)
    found = solve(
        problem, SeilerPrior(), optimizer=ICM(iterations=20, steps=None), backend="cpu"
    ).displacement.copy()
    held = np.where((c > 0) & (m > 0)[..., None], problem.observed, 0)
    for k, followers in enumerate(connected(problem, SeilerPrior()).extension):
        if followers is not None:  # sites without cliques follow by an affine motion
            found.reshape(-1, 2)[followers.sites, k] = 0
        assert found[..., k].max() <= max(0, held[..., k].max()) + 1e-4
        assert found[..., k].min() >= min(0, held[..., k].min()) - 1e-4


@pytest.mark.parametrize(
    "wrong",
    [
        {"iterations": 0},
        {"iterations": 2.5},
        {"iterations": float("inf")},
        {"iterations": float("nan")},
        {"iterations": None},
        {"steps": ()},
        {"steps": (1, -1)},
        {"energy_change": 0},
        {"energy_change": float("nan")},
    ],
)
def test_an_invalid_schedule_is_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ICM(**wrong)
