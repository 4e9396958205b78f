"""Multigrid of the paper's prior: the converged field and its error bound."""

import numpy as np
import pytest

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
from validation.bodies import uncertain_problem
from validation.oracles.exact import exact_field
from validation.oracles.paper import solve_exactly

CONDITIONALS = ["centred", "blanket"]


def random_problem(shape=(49, 62), spacing=(1.0, 1.0), ratio=5.0, seed=0):
    """Return random tissue with a hole and random prescribed displacements at its border."""
    rng = np.random.default_rng(seed)
    m = np.kron(ratio ** rng.random((-(-shape[0] // 7), -(-shape[1] // 7))), np.ones((7, 7)))
    m = m[: shape[0], : shape[1]]
    m[shape[0] // 2 : shape[0] // 2 + 4, shape[1] // 3 : shape[1] // 3 + 3] = 0
    c = np.zeros((*shape, 2))
    c[:2] = c[-2:] = c[:, :2] = c[:, -2:] = 1
    return Problem(
        observed=rng.normal(size=(*shape, 2)), confidence=c, stiffness=m, spacing=spacing
    )


@pytest.mark.parametrize(
    ("shape", "spacing", "reading"),
    [
        ((31, 37), (1.0, 2.0), "centred"),
        ((31, 37), (1.0, 2.0), "blanket"),
        ((3, 40), (1.0, 1.0), "blanket"),
        ((3, 40), (1.0, 2.0), "centred"),
        ((2, 2), (1.0, 1.0), "centred"),
    ],
)
def test_compiled_forces_match_the_energies(shape, spacing, reading):
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
        observed=problem.observed,
        confidence=1e-30 * problem.confidence,
        stiffness=problem.stiffness,
        spacing=spacing,
    )
    total = SeilerPrior(penalty=1e-9).site_energy(nothing, d * problem.unit).sum()
    assert energy == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize(("spacing", "reading"), [((1.0, 1.0), "centred"), ((1.0, 2.0), "blanket")])
def test_the_field_matches_a_direct_solve(reading, spacing):
    problem = random_problem(spacing=spacing)
    found = solve(problem, SeilerPrior(conditional=reading), optimizer=Multigrid(1e-3))
    expected = solve_exactly(problem, reading)
    assert np.abs(found.displacement - expected)[problem.tissue].max() < 1e-3
    assert found.convergence.error <= 1e-3


@pytest.mark.parametrize(
    ("name", "reading"),
    [
        ("mass-effect", "centred"),
        *(
            pytest.param(name, reading, marks=pytest.mark.campaign)
            for name in ("expansion", "mass-effect", "bar")
            for reading in CONDITIONALS
            if (name, reading) != ("mass-effect", "centred")
        ),
    ],
)
def test_the_field_of_a_phantom_matches_a_direct_solve(name, reading):
    problem = phantom(name, 64).problem
    found = solve(problem, SeilerPrior(conditional=reading), optimizer=Multigrid(1e-3)).displacement
    assert np.abs(found - solve_exactly(problem, reading))[problem.tissue].max() < 1e-3


@pytest.mark.campaign
@pytest.mark.parametrize("reading", CONDITIONALS)
def test_multigrid_matches_the_limit_of_many_icm_sweeps(reading):
    problem = phantom("expansion", 20).problem
    prior = SeilerPrior(conditional=reading)
    patient = solve(
        problem, prior, optimizer=ICM(iterations=50_000, steps=None, energy_change=1e-9)
    )
    quick = solve(problem, prior, optimizer=Multigrid(1e-4))
    assert np.abs(quick.displacement - patient.displacement)[problem.tissue].max() < 2e-3
    assert quick.mean_energy == pytest.approx(patient.mean_energy, rel=1e-3)
    assert quick.iterations < patient.iterations / 10


@pytest.mark.parametrize("penalty", [0.3, 3.0, 30.0])
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (2.0, 1.0)])
@pytest.mark.parametrize("reading", CONDITIONALS)
def test_observations_slip_where_the_force_exceeds_their_confidence(reading, spacing, penalty):
    problem = uncertain_problem(spacing=spacing)
    prior = SeilerPrior(penalty=penalty, conditional=reading)
    expected = exact_field(problem, prior).displacement * problem.unit
    found = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement
    assert np.abs(found - expected)[problem.tissue].max() < 2e-4
    slipped = (np.abs(expected - problem.observed) > 1e-3)[problem.confidence > 0]
    assert 0 < slipped.sum() < slipped.size


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("mass-effect", (64, 160)),
        *(
            pytest.param(name, (100, 200, 400), marks=pytest.mark.campaign)
            for name in ("mass-effect", "expansion", "bar")
        ),
    ],
)
def test_the_number_of_cycles_is_nearly_independent_of_the_size(name, sizes):
    cycles = [
        solve(phantom(name, size).problem, SeilerPrior(), optimizer=Multigrid(0.01)).iterations
        for size in sizes
    ]
    assert max(cycles) <= 11
    assert max(cycles) - min(cycles) <= 4


@pytest.mark.parametrize(
    ("name", "ratio"),
    [
        ("expansion", 1e2),
        ("mass-effect", 1e6),
        *(
            pytest.param(*case, marks=pytest.mark.campaign)
            for case in (
                ("expansion", 1e4),
                ("expansion", 1e6),
                ("mass-effect", 1e2),
                ("mass-effect", 1e4),
            )
        ),
    ],
)
def test_a_stiff_tumour_in_soft_tissue_is_solved_accurately(ratio, name):
    problem = phantom(name, 64).problem
    m = np.where(problem.stiffness == 40, ratio, np.where(problem.stiffness > 0, 1.0, 0.0))
    problem = Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-3))
    expected = solve_exactly(problem, "centred")
    assert np.abs(found.displacement - expected)[problem.tissue].max() < 1e-3


def test_tissue_never_moves_further_than_its_largest_observation():
    problem = random_problem(ratio=1e3, seed=2)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4)).displacement
    for component in (0, 1):
        pushed = problem.observed[..., component][
            (problem.confidence[..., component] > 0) & problem.tissue
        ]
        assert found[..., component].max() <= max(pushed.max(), 0) + 1e-4
        assert found[..., component].min() >= min(pushed.min(), 0) - 1e-4


def test_the_strain_ratio_of_a_bar_does_not_depend_on_its_length():
    for length in (64, 300):
        m = np.ones((3, length))
        m[:, : length // 2] = 5
        y, c = np.zeros((3, length, 2)), np.zeros((3, length, 2))
        c[:, [0, -1]] = 1
        y[:, -1, 1] = 10
        along = solve(
            Problem(observed=y, confidence=c, stiffness=m), SeilerPrior(), optimizer=Multigrid(1e-4)
        ).displacement[1, :, 1]
        middle = length // 2
        ratio = (along[-1] - along[middle]) / (along[middle - 1] - along[0])
        assert ratio == pytest.approx(5.71, abs=0.03)


@pytest.mark.parametrize("reading", CONDITIONALS)
def test_the_field_depends_only_on_ratios_of_stiffness_and_lengths(reading):
    problem = random_problem((24, 31), spacing=(1, 2))
    prior = SeilerPrior(conditional=reading)
    first = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement
    harder = Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness * 1000,
        spacing=problem.spacing,
    )
    found = solve(harder, prior, optimizer=Multigrid(1e-4)).displacement
    np.testing.assert_allclose(found, first, atol=5e-4)
    inches = Problem(
        observed=problem.observed / 25.4,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=(1 / 25.4, 2 / 25.4),
    )
    found = solve(inches, prior, optimizer=Multigrid(1e-4)).displacement * 25.4
    np.testing.assert_allclose(found, first, atol=5e-4)


@pytest.mark.parametrize("reading", CONDITIONALS)
def test_a_warm_start_converges_to_the_same_field(reading):
    problem = random_problem()
    prior = SeilerPrior(conditional=reading)
    cold = solve(problem, prior, optimizer=Multigrid(1e-4))
    y = np.array(problem.observed)
    y[:2, 20:30, 0] += 1
    edited = Problem(observed=y, confidence=problem.confidence, stiffness=problem.stiffness)
    expected = solve(edited, prior, optimizer=Multigrid(1e-4)).displacement
    warm = solve(edited, prior, optimizer=Multigrid(1e-4), initial=cold)
    np.testing.assert_allclose(warm.displacement, expected, atol=3e-4)


def test_a_warm_start_does_not_move_a_free_border():
    # A free border belongs to no clique as its middle, so it stays at rest for any start.
    y, c = np.zeros((12, 12, 2)), np.zeros((12, 12, 2))
    c[4:8, 4:8] = 1
    y[4:8, 4:8, 0] = 2
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((12, 12)))
    start = solve(problem, SeilerPrior(), optimizer=ICM())
    assert np.abs(start.displacement[0, :, 0]).max() > 0.1
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4), initial=start).displacement
    np.testing.assert_allclose(found, solve_exactly(problem, "centred"), atol=1e-4)


def test_an_unconstrained_piece_is_named():
    m = np.zeros((20, 30))
    m[3:17, 2:12] = 1
    m[5:15, 18:27] = 1
    c = np.zeros((20, 30, 2))
    c[3:17, 2:4] = 1
    prior = SeilerPrior(conditional="blanket")
    with pytest.raises(ProblemError, match=r"90 pixels around \(9, 22\) is not held anywhere"):
        solve(Problem(observed=0 * c, confidence=c, stiffness=m), prior, optimizer=Multigrid())
    c[9, 18:27] = 1
    with pytest.raises(ProblemError, match=r"90 pixels around \(9, 22\) could still grow along"):
        solve(Problem(observed=0 * c, confidence=c, stiffness=m), prior, optimizer=Multigrid())
    # In the centred conditional, a border that is not the middle of any clique stays at rest.
    y = np.zeros_like(c)
    y[3:17, 2:4] = 1
    found = solve(
        Problem(observed=y, confidence=np.where(y > 0, 1, 0), stiffness=m),
        SeilerPrior(),
        optimizer=Multigrid(),
    ).displacement
    assert np.abs(found[5:15, 18:27]).max() < 1e-3


def test_a_solve_without_convergence_raises_an_error():
    problem = phantom("mass-effect", 48).problem
    with pytest.raises(ConvergenceError, match=r"still above 1e-06 px"):
        solve(problem, SeilerPrior(), optimizer=Multigrid(tolerance=1e-6, max_iterations=2))
    with pytest.raises(ConvergenceError, match=r"px after 2 cycles"):
        solve(problem, ElasticPrior(), optimizer=Multigrid(tolerance=1e-6, max_iterations=2))


@pytest.mark.parametrize("reading", CONDITIONALS)
def test_a_solve_can_be_cancelled_between_cycles(reading):
    problem, prior = phantom("bar", 64).problem, SeilerPrior(conditional=reading)
    with pytest.raises(Cancelled):
        solve(problem, prior, optimizer=Multigrid(), cancel=During("cycle 2"))


def test_the_schedule_of_the_paper_is_the_default():
    levels = solve(phantom("bar", 48).problem, SeilerPrior()).levels
    assert len(levels) == 7
    assert {level.iterations for level in levels} == {70}
