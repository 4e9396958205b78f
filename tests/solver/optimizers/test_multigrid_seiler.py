"""The paper's prior, converged: multigrid finds the field that ICM would end at, and proves it."""

import numpy as np
import pytest
from readings import solve_exactly

from napari_hmrf import (
    ICM,
    Cancelled,
    ConvergenceError,
    ElasticPrior,
    Multigrid,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu.seiler_model import CpuSeilerModel
from tests.support.cancel_flags import During

READINGS = ["centred", "blanket"]


def random_problem(shape=(49, 62), spacing=(1.0, 1.0), ratio=5.0, seed=0):
    """Random tissue, smooth but for a hole and a stiff lump, whose border is held at random."""
    rng = np.random.default_rng(seed)
    m = np.kron(ratio ** rng.random((-(-shape[0] // 7), -(-shape[1] // 7))), np.ones((7, 7)))
    m = m[: shape[0], : shape[1]]
    m[shape[0] // 2 : shape[0] // 2 + 4, shape[1] // 3 : shape[1] // 3 + 3] = 0
    c = np.zeros((*shape, 2))
    c[:2] = c[-2:] = c[:, :2] = c[:, -2:] = 1
    return Problem(rng.normal(size=(*shape, 2)), c, m, spacing=spacing)


def doubtful(spacing=(1.0, 1.0), seed=1):
    """Soft and stiff tissue, some of whose sites are observed, more or less surely."""
    rng = np.random.default_rng(seed)
    shape = (11, 13)
    m = np.where(rng.random(shape) < 0.5, 1.0, 4.0)
    m[6, 4:6] = 0
    c = np.zeros((*shape, 2))
    c[0] = c[1] = rng.uniform(0.05, 1, (13, 2))
    c[-2:, ::2] = rng.uniform(0.05, 1, (2, 7, 2))
    c[3:6, 8:11, 1] = 0.5
    return Problem(rng.normal(size=(*shape, 2)), c, m, spacing=spacing)


def slow_and_sure(problem, prior):
    """The field where no site wants to move, in float64: one observed component after the other.

    The rest is eliminated first. What a site is pulled with is measured by impulses.
    """
    size = problem.observed.size
    steep = prior.site_parabola(problem, np.zeros(problem.observed.shape)).curvature.ravel()
    matrix = np.empty((size, size))
    for k in range(size):
        impulse = np.zeros(size)
        impulse[k] = problem.unit
        lowest = prior.site_parabola(problem, impulse.reshape(problem.observed.shape)).lowest
        matrix[:, k] = (impulse - lowest.ravel()) / problem.unit
    matrix *= np.where(steep > 0, 2 * steep, 1)[:, None]
    seen, moves = problem.confidence.ravel() > 0, steep > 0
    y = np.where(seen, problem.observed.ravel(), 0).astype(float) / problem.unit
    free, tied = moves & ~seen, np.flatnonzero(moves & seen)
    field = np.where(seen, y, 0)
    inner = np.linalg.inv(matrix[np.ix_(free, free)])
    schur = matrix[tied] - matrix[np.ix_(tied, free)] @ inner @ matrix[free]
    p = prior.limit(problem).ravel()
    for _ in range(20_000):
        most = 0.0
        for row, k in zip(schur, tied, strict=True):
            off = field[k] - (row * ~free) @ field / row[k] - y[k]
            target = y[k] + np.sign(off) * max(abs(off) - p[k] / row[k], 0)
            most = max(most, abs(target - field[k]))
            field[k] = target
        if most < 1e-8:
            break
    field[free] = -inner @ matrix[np.ix_(free, ~free)] @ field[~free]
    return field.reshape(problem.observed.shape) * problem.unit


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (1.0, 2.0)])
@pytest.mark.parametrize("shape", [(31, 37), (3, 40), (2, 2)])
def test_the_loops_pull_as_the_energies_say(shape, spacing, reading):
    problem = random_problem(shape, spacing, ratio=1e3)
    prior = SeilerPrior(conditional=reading)
    d = np.random.default_rng(3).normal(size=(*shape, 2))
    model = CpuSeilerModel(prior.material(problem))
    steep, lowest = prior.site_parabola(problem, d * problem.unit)
    expected = lowest / problem.unit - d
    if reading == "blanket":
        expected *= 2 * steep
    found = model.pull(host.planes(d))[:, 2:-2, 2:-2]
    np.testing.assert_allclose(np.moveaxis(found, 0, -1), expected, rtol=1e-9, atol=1e-9)
    model.hold(host.planes(0 * d) > 0)
    level = model.levels[0]
    image = level.vector()
    level.apply(level.vector(host.planes(d).astype(np.float32)), image)
    single = -np.moveaxis(image[:, 2:-2, 2:-2], 0, -1)
    np.testing.assert_allclose(single, expected, atol=2e-6 * max(1, np.abs(expected).max()))
    energy, _ = model.work(host.planes(d))
    nothing = Problem(
        problem.observed, 1e-30 * problem.confidence, problem.stiffness, spacing=spacing
    )
    total = SeilerPrior(penalty=1e-9).site_energy(nothing, d * problem.unit).sum()
    assert energy == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (1.0, 2.0)])
def test_the_field_is_that_of_a_direct_solve(reading, spacing):
    problem = random_problem(spacing=spacing)
    found = solve(problem, SeilerPrior(conditional=reading), optimizer=Multigrid(1e-3))
    expected = solve_exactly(problem, reading)
    assert np.abs(found.displacement - expected)[problem.tissue].max() < 1e-3
    assert found.convergence.error <= 1e-3


@pytest.mark.parametrize("name", ["expansion", "mass-effect", "bar"])
@pytest.mark.parametrize("reading", READINGS)
def test_a_phantom_moves_as_a_direct_solve_says(name, reading):
    problem = phantom(name, 64).problem
    found = solve(problem, SeilerPrior(conditional=reading), optimizer=Multigrid(1e-3)).displacement
    assert np.abs(found - solve_exactly(problem, reading))[problem.tissue].max() < 1e-3


@pytest.mark.parametrize("reading", READINGS)
def test_it_is_where_the_papers_sweeps_would_end(reading):
    problem = phantom("expansion", 20).problem
    prior = SeilerPrior(conditional=reading)
    patient = solve(
        problem, prior, optimizer=ICM(iterations=50_000, steps=None, energy_change=1e-9)
    )
    quick = solve(problem, prior, optimizer=Multigrid(1e-4))
    assert np.abs(quick.displacement - patient.displacement)[problem.tissue].max() < 2e-3
    assert quick.mean_energy == pytest.approx(patient.mean_energy, rel=1e-3)
    assert quick.iterations < patient.iterations / 10


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (2.0, 1.0)])
@pytest.mark.parametrize("penalty", [30.0, pytest.param(3.0, marks=pytest.mark.campaign), 0.3])
def test_what_is_observed_gives_way_where_it_is_pulled_harder_than_its_confidence(
    reading, spacing, penalty
):
    problem = doubtful(spacing)
    prior = SeilerPrior(penalty=penalty, conditional=reading)
    expected = slow_and_sure(problem, prior)
    found = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement
    assert np.abs(found - expected)[problem.tissue].max() < 2e-4
    slipped = (np.abs(expected - problem.observed) > 1e-3)[problem.confidence > 0]
    assert 0 < slipped.sum() < slipped.size or penalty != 3.0


def test_the_number_of_cycles_hardly_depends_on_the_size():
    for name in ("mass-effect", "expansion", "bar"):
        cycles = [
            solve(phantom(name, size).problem, SeilerPrior(), optimizer=Multigrid(0.01)).iterations
            for size in (100, 200, 400)
        ]
        assert max(cycles) <= 11
        assert max(cycles) - min(cycles) <= 4


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("name", ["expansion", "mass-effect"])
def test_a_tumour_that_swims_in_soft_tissue_is_found(ratio, name):
    problem = phantom(name, 64).problem
    m = np.where(problem.stiffness == 40, ratio, np.where(problem.stiffness > 0, 1.0, 0.0))
    problem = Problem(problem.observed, problem.confidence, m)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-3))
    expected = solve_exactly(problem, "centred")
    assert np.abs(found.displacement - expected)[problem.tissue].max() < 1e-3


def test_nothing_moves_further_than_something_pushes_it():
    problem = random_problem(ratio=1e3, seed=2)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4)).displacement
    for component in (0, 1):
        pushed = problem.observed[..., component][
            (problem.confidence[..., component] > 0) & problem.tissue
        ]
        assert found[..., component].max() <= max(pushed.max(), 0) + 1e-4
        assert found[..., component].min() >= min(pushed.min(), 0) - 1e-4


def test_a_bars_halves_strain_as_their_stiffness_says_at_any_length():
    for length in (64, 300):
        m = np.ones((3, length))
        m[:, : length // 2] = 5
        y, c = np.zeros((3, length, 2)), np.zeros((3, length, 2))
        c[:, [0, -1]] = 1
        y[:, -1, 1] = 10
        along = solve(Problem(y, c, m), SeilerPrior(), optimizer=Multigrid(1e-4)).displacement[
            1, :, 1
        ]
        middle = length // 2
        ratio = (along[-1] - along[middle]) / (along[middle - 1] - along[0])
        assert ratio == pytest.approx(5.71, abs=0.03)


@pytest.mark.parametrize("reading", READINGS)
def test_only_ratios_of_stiffness_and_lengths_matter(reading):
    problem = random_problem((24, 31), spacing=(1, 2))
    prior = SeilerPrior(conditional=reading)
    first = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement
    harder = Problem(
        problem.observed, problem.confidence, problem.stiffness * 1000, spacing=problem.spacing
    )
    found = solve(harder, prior, optimizer=Multigrid(1e-4)).displacement
    np.testing.assert_allclose(found, first, atol=5e-4)
    inches = Problem(
        problem.observed / 25.4, problem.confidence, problem.stiffness, spacing=(1 / 25.4, 2 / 25.4)
    )
    found = solve(inches, prior, optimizer=Multigrid(1e-4)).displacement * 25.4
    np.testing.assert_allclose(found, first, atol=5e-4)


@pytest.mark.parametrize("reading", READINGS)
def test_a_warm_start_ends_at_the_same_field(reading):
    problem = random_problem()
    prior = SeilerPrior(conditional=reading)
    cold = solve(problem, prior, optimizer=Multigrid(1e-4))
    y = np.array(problem.observed)
    y[:2, 20:30, 0] += 1
    edited = Problem(y, problem.confidence, problem.stiffness)
    expected = solve(edited, prior, optimizer=Multigrid(1e-4)).displacement
    warm = solve(edited, prior, optimizer=Multigrid(1e-4), initial=cold)
    np.testing.assert_allclose(warm.displacement, expected, atol=3e-4)


def test_a_start_from_elsewhere_moves_nothing_that_nothing_moves():
    # A free border has no clique around it: it stays, whatever the start says.
    y, c = np.zeros((12, 12, 2)), np.zeros((12, 12, 2))
    c[4:8, 4:8] = 1
    y[4:8, 4:8, 0] = 2
    problem = Problem(y, c, np.ones((12, 12)))
    start = solve(problem, SeilerPrior(), optimizer=ICM())
    assert np.abs(start.displacement[0, :, 0]).max() > 0.1
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4), initial=start).displacement
    np.testing.assert_allclose(found, solve_exactly(problem, "centred"), atol=1e-4)


def test_a_piece_that_nothing_holds_is_named():
    m = np.zeros((20, 30))
    m[3:17, 2:12] = 1
    m[5:15, 18:27] = 1
    c = np.zeros((20, 30, 2))
    c[3:17, 2:4] = 1
    prior = SeilerPrior(conditional="blanket")
    with pytest.raises(ProblemError, match=r"90 pixels around \(9, 22\) is not held anywhere"):
        solve(Problem(0 * c, c, m), prior, optimizer=Multigrid())
    c[9, 18:27] = 1
    with pytest.raises(ProblemError, match=r"90 pixels around \(9, 22\) could still grow along"):
        solve(Problem(0 * c, c, m), prior, optimizer=Multigrid())
    # Centred, a border that is the middle of no clique holds it.
    y = np.zeros_like(c)
    y[3:17, 2:4] = 1
    found = solve(
        Problem(y, np.where(y > 0, 1, 0), m), SeilerPrior(), optimizer=Multigrid()
    ).displacement
    assert np.abs(found[5:15, 18:27]).max() < 1e-3


def test_what_cannot_converge_is_an_error_and_not_a_field():
    problem = phantom("mass-effect", 48).problem
    with pytest.raises(ConvergenceError, match=r"still above 1e-06 px"):
        solve(problem, SeilerPrior(), optimizer=Multigrid(tolerance=1e-6, max_iterations=2))
    with pytest.raises(ConvergenceError, match=r"px after 2 cycles"):
        solve(problem, ElasticPrior(), optimizer=Multigrid(tolerance=1e-6, max_iterations=2))


@pytest.mark.parametrize("reading", READINGS)
def test_it_can_be_cancelled_on_the_way(reading):
    problem, prior = phantom("bar", 64).problem, SeilerPrior(conditional=reading)
    with pytest.raises(Cancelled):
        solve(problem, prior, optimizer=Multigrid(), cancel=During("cycle 2"))


def test_the_papers_schedule_stays_the_default():
    levels = solve(phantom("bar", 48).problem, SeilerPrior()).levels
    assert len(levels) == 7
    assert {level.iterations for level in levels} == {70}
