"""Elastic prior: energy of finite elements, and solution by multigrid."""

import threading
from functools import partial
from itertools import product

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
    solve,
)
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.backends.cpu import elastic_model, forces
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.coarse_levels import smoother_bounds
from napari_hmrf.solver.priors.elements import element_forces
from validation.bodies import frame_problem
from validation.oracles.elasticity import direct_solution, stiffness_matrix

PLANES = ["stress", "strain"]
random_problem = partial(frame_problem, ratio=5.0, amplitude=1.0)


@pytest.mark.parametrize(
    ("poisson", "plane", "spacing"),
    [(0.0, "stress", (2.0, 0.5)), (0.3, "stress", (1.0, 1.0)), (0.45, "strain", (2.0, 0.5))],
)
def test_the_energy_and_the_forces_match_finite_elements(poisson, plane, spacing):
    problem = random_problem((9, 7), spacing=spacing, has_hole=True)
    prior = ElasticPrior(poisson, plane=plane)
    matrix = stiffness_matrix(problem, prior)
    d = np.random.default_rng(1).normal(size=problem.observed.shape)
    pulls = (matrix @ d.ravel()).reshape(d.shape)
    stiffest, unit = float(problem.stiffness.max()), problem.unit
    energy = prior.energy(problem, d) * stiffest * unit**2
    assert energy == pytest.approx(0.5 * (d * pulls).sum(), rel=1e-10)
    forces = prior.forces(problem, d) * stiffest * unit
    np.testing.assert_allclose(forces, pulls, atol=1e-10 * np.abs(pulls).max())


@pytest.mark.parametrize(("plane", "spacing"), [("stress", (2.0, 0.5)), ("strain", (1.0, 1.0))])
def test_forces_are_the_gradient_of_the_energy(plane, spacing):
    problem = random_problem((5, 6), spacing=spacing, has_hole=True)
    prior = ElasticPrior(0.4, plane=plane)
    d = np.random.default_rng(2).normal(size=(5, 6, 2)) * problem.unit
    forces = prior.forces(problem, d)
    step = 1e-5 * problem.unit
    for site in [(0, 0, 0), (2, 3, 1), (4, 5, 0), (1, 2, 1), (3, 3, 0)]:
        ahead, behind = d.copy(), d.copy()
        ahead[site] += step
        behind[site] -= step
        slope = (prior.energy(problem, ahead) - prior.energy(problem, behind)) / 2e-5
        assert forces[site] == pytest.approx(slope, abs=1e-6)


@pytest.mark.parametrize(
    "count", [3, *(pytest.param(count, marks=pytest.mark.campaign) for count in (2, 7))]
)
def test_the_number_of_threads_does_not_change_the_field(count, monkeypatch):
    problem = random_problem((123, 96), has_hole=True, ratio=1e3)
    elastic_model._model.clear()
    monkeypatch.setattr(forces, "parts", lambda height: 1)
    alone = solve(problem, ElasticPrior(), backend="cpu")
    elastic_model._model.clear()
    monkeypatch.setattr(forces, "parts", lambda height: min(count, height))
    shared = solve(problem, ElasticPrior(), backend="cpu")
    assert shared.iterations > 1
    np.testing.assert_array_equal(shared.displacement, alone.displacement)
    assert shared.convergence == alone.convergence


@pytest.mark.parametrize(
    ("shape", "spacing"),
    [
        ((31, 37), (2.0, 0.5)),
        ((2, 2), (1.0, 1.0)),
        ((13, 2), (2.0, 0.5)),
        ((101, 8), (1.0, 1.0)),
    ],
)
def test_compiled_forces_match_the_energy(shape, spacing):
    problem = random_problem(shape, spacing=spacing, has_hole=shape[0] > 13, ratio=1e4)
    prior = ElasticPrior(0.45, plane="strain")
    d = np.random.default_rng(3).normal(size=(*shape, 2))
    model = CpuElasticModel(prior.material(problem))
    planes = np.zeros((2, shape[0] + 4, shape[1] + 4))
    planes[:, 2:-2, 2:-2] = np.moveaxis(d, -1, 0)
    expected = -element_forces(prior.lame(problem), prior.shape(spacing), d)
    most = np.abs(expected).max()
    np.testing.assert_allclose(
        np.moveaxis(model.pull(planes)[:, 2:-2, 2:-2], 0, -1), expected, atol=1e-6 * most
    )
    assert model.work(planes)[0] == pytest.approx(prior.energy(problem, d * problem.unit), rel=1e-5)
    held = np.zeros_like(planes, dtype=bool)
    held[0, 3, 2] = True
    model.hold(held)
    single = planes.astype(np.float32)
    found = np.zeros_like(single)
    model.levels[0].apply(single, found)
    found = np.moveaxis(found[:, 2:-2, 2:-2], 0, -1)
    assert found[1, 0, 0] == 0
    found[1, 0, 0] = -expected[1, 0, 0]
    np.testing.assert_allclose(found, -expected, atol=1e-5 * most)


@pytest.mark.parametrize(("plane", "spacing"), [("stress", (0.5, 1.5)), ("strain", (1.0, 1.0))])
def test_uniform_tissue_with_an_affine_border_moves_affinely(plane, spacing):
    i, j = np.mgrid[:120, :90]
    affine = np.stack([0.02 * i - 0.05 * j, 0.03 * j + 0.01 * i], axis=-1)
    c = np.zeros((120, 90, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    found = solve(
        Problem(observed=affine, confidence=c, stiffness=np.ones((120, 90)), spacing=spacing),
        ElasticPrior(0.4, plane=plane),
    )
    assert np.abs(found.displacement - affine).max() < 2e-3


@pytest.mark.parametrize(("plane", "spacing"), [("stress", (1.0, 1.0)), ("strain", (1.0, 2.5))])
def test_the_field_matches_a_direct_solve(plane, spacing):
    problem = random_problem((49, 62), spacing=spacing, has_hole=True)
    prior = ElasticPrior(0.45, plane=plane)
    found = solve(problem, prior, optimizer=Multigrid(tolerance=1e-4))
    expected = direct_solution(problem, prior)
    assert np.abs(found.displacement - expected)[problem.tissue].max() < 1e-3


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("mass-effect", 96),
        pytest.param("mass-effect", 128, marks=pytest.mark.campaign),
        pytest.param("expansion", 128, marks=pytest.mark.campaign),
    ],
)
def test_the_displacement_of_a_brain_matches_finite_elements(name, size):
    problem = phantom(name, size).problem
    found = solve(problem, ElasticPrior(poisson=0.3))
    expected = direct_solution(problem, ElasticPrior(0.3))
    assert rmsd(found.displacement, expected, problem.tissue) < 0.005


MATERIALS = [(0.0, 1.0), (0.3, 1e6), (0.499, 1e3)]


@pytest.mark.parametrize(
    ("poisson", "ratio"),
    [
        *MATERIALS,
        *(
            pytest.param(*material, marks=pytest.mark.campaign)
            for material in product((0.0, 0.3, 0.49, 0.499), (1.0, 1e3, 1e6))
            if material not in MATERIALS
        ),
    ],
)
def test_any_material_converges_to_the_tolerance(poisson, ratio):
    problem = phantom("mass-effect", 64).problem
    m = np.where(problem.stiffness == 40, ratio, np.where(problem.stiffness > 0, 1.0, 0.0))
    problem = Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m)
    for plane in PLANES:
        if ratio == 1e6 and poisson == 0.499 and plane == "strain":
            continue  # beyond single precision
        prior = ElasticPrior(poisson, plane=plane)
        found = solve(problem, prior, optimizer=Multigrid(tolerance=1e-3))
        off = np.abs(found.displacement - direct_solution(problem, prior))[problem.tissue]
        assert off.max() < 3e-3


def test_a_solve_without_convergence_raises_an_error():
    problem = phantom("mass-effect", 48).problem
    with pytest.raises(ConvergenceError, match=r"still .* px after 2 cycles"):
        solve(problem, ElasticPrior(), optimizer=Multigrid(tolerance=1e-6, max_iterations=2))


def test_the_number_of_cycles_does_not_depend_on_the_size():
    cycles = [
        solve(
            phantom("mass-effect", size).problem, ElasticPrior(0.3), optimizer=Multigrid(0.01)
        ).iterations
        for size in (64, 160)
    ]
    assert max(cycles) - min(cycles) <= 2
    assert max(cycles) < 12


def test_compressed_tissue_bulges_according_to_its_poisson_ratio():
    shape = (41, 61)
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[:, 0, 1] = c[:, -1, 1] = 1  # compressed along columns, free to slide along rows
    c[20, 0, 0] = 1
    y[:, -1, 1] = -3
    for poisson in (0.0, 0.25, 0.45):
        for plane, expected in (("stress", poisson), ("strain", poisson / (1 - poisson))):
            found = solve(
                Problem(observed=y, confidence=c, stiffness=np.ones(shape)),
                ElasticPrior(poisson, plane=plane),
            ).displacement
            bulge = (found[-1, 30, 0] - found[0, 30, 0]) / 40
            assert bulge == pytest.approx(expected * 3 / 60, abs=2e-4)


def test_nearly_incompressible_tissue_does_not_lock():
    # Elements that lock would keep the middle of a bent beam straight.
    shape = (13, 97)
    i, j = np.mgrid[: shape[0], : shape[1]]
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    x, height = (j - 48) / 48, i - 6
    y[..., 0] = 4 * x**2
    y[..., 1] = -8 * x / 48 * height
    c[:, [0, -1]] = 1  # the ends are rotated
    sag = []
    for poisson in (0.3, 0.499):
        prior = ElasticPrior(poisson, plane="strain")
        found = solve(
            Problem(observed=y, confidence=c, stiffness=np.ones(shape)),
            prior,
            optimizer=Multigrid(0.01),
        ).displacement
        sag.append(found[6, 48, 0])
    assert sag[0] == pytest.approx(0, abs=0.2)
    assert sag[1] == pytest.approx(sag[0], abs=0.2)


def test_the_field_depends_only_on_ratios_of_stiffness_and_lengths():
    problem = random_problem((24, 31), spacing=(1, 2))
    first = solve(problem, ElasticPrior()).displacement
    harder = Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness * 1000,
        spacing=problem.spacing,
    )
    np.testing.assert_allclose(solve(harder, ElasticPrior()).displacement, first, atol=2e-3)
    inches = Problem(
        observed=problem.observed / 25.4,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=(1 / 25.4, 2 / 25.4),
    )
    found = solve(inches, ElasticPrior()).displacement * 25.4
    np.testing.assert_allclose(found, first, atol=5e-3)


def pieces():
    """Return two islands of tissue, the left of which is fixed at its left edge."""
    m = np.zeros((20, 30))
    m[3:17, 2:12] = 1
    m[5:15, 18:27] = 1
    c = np.zeros((20, 30, 2))
    c[3:17, 2] = 1
    return m, c


def test_an_unconstrained_piece_is_named():
    m, c = pieces()
    with pytest.raises(ProblemError, match=r"90 pixels around \(9, 22\) is not held anywhere"):
        solve(Problem(observed=0 * c, confidence=c, stiffness=m), ElasticPrior())


@pytest.mark.parametrize(
    ("sites", "way"),
    [
        ([(9, 20, 0), (9, 20, 1)], "by turning"),
        ([(9, 20, 0), (12, 24, 0)], "along the column axis"),
        ([(9, 20, 1), (12, 24, 1)], "along the row axis"),
    ],
)
def test_the_free_motion_of_an_underconstrained_piece_is_named(sites, way):
    m, c = pieces()
    for site in sites:
        c[site] = 1
    with pytest.raises(ProblemError, match=f"could still move {way}"):
        solve(Problem(observed=0 * c, confidence=c, stiffness=m), ElasticPrior())


def test_a_removed_constraint_is_noticed_after_a_solve_with_more_constraints():
    m, c = pieces()
    c[9, 20] = c[9, 24, 0] = 1
    more, less = c.copy(), c.copy()
    more[12, 22] = 1
    less[9, 24, 0] = 0
    for enough in (c, more, c):
        solve(Problem(observed=0 * c, confidence=enough, stiffness=m), ElasticPrior())
    with pytest.raises(ProblemError, match="could still move by turning"):
        solve(Problem(observed=0 * c, confidence=less, stiffness=m), ElasticPrior())


def test_two_points_constrain_a_piece():
    m, c = pieces()
    c[9, 20] = c[9, 24, 0] = 1
    y = np.zeros_like(c)
    y[9, 20] = (1, 2)
    y[9, 24, 0] = 1
    found = solve(Problem(observed=y, confidence=c, stiffness=m), ElasticPrior()).displacement
    np.testing.assert_allclose(found[5:15, 18:27], np.broadcast_to((1, 2), (10, 9, 2)), atol=2e-3)
    assert np.abs(found[3:17, 2:12]).max() < 1e-3


def test_tissue_only_one_pixel_wide_is_rejected():
    m = np.zeros((9, 9))
    m[4] = 1
    c = np.ones((9, 9, 2))
    c[4, 4] = 0
    with pytest.raises(ProblemError, match="two pixels wide"):
        solve(Problem(observed=np.zeros((9, 9, 2)), confidence=c, stiffness=m), ElasticPrior())


def test_a_cancelled_solve_has_no_result():
    stop = threading.Event()
    stop.set()
    with pytest.raises(Cancelled):
        solve(phantom("bar", 64).problem, ElasticPrior(), cancel=stop)


def test_a_solution_records_its_prior_and_optimizer():
    problem = phantom("bar", 48).problem
    solution = solve(problem, ElasticPrior(0.4, plane="strain"))
    prior = solution.provenance.parameters["prior"]
    assert (prior["name"], prior["poisson"], prior["plane"]) == ("ElasticPrior", 0.4, "strain")
    assert solution.provenance.parameters["optimizer"]["name"] == "Multigrid"
    expected = ElasticPrior(0.4, plane="strain").energy(problem, solution.displacement)
    assert solution.mean_energy == pytest.approx(expected / problem.tissue.sum(), rel=1e-3)


def test_a_prior_with_an_unsuitable_optimizer_is_rejected():
    problem = phantom("bar", 32).problem
    with pytest.raises(ValueError, match="Use Multigrid for ElasticPrior"):
        solve(problem, ElasticPrior(), optimizer=ICM())


def test_smoother_bounds_are_ordered_and_limited():
    problem = random_problem((6, 6))
    for prior in (ElasticPrior(0.3), ElasticPrior(0.499, plane="strain")):
        usual, worst = smoother_bounds(prior.material(problem))
        assert 2 <= usual <= worst <= 8


@pytest.mark.parametrize(
    "wrong",
    [
        {"poisson": -0.1},
        {"poisson": 0.5},
        {"poisson": np.nan},
        {"poisson": 0.3 + 0.1j},
        {"poisson": np.complex64(0.3 + 0.1j)},
        {"poisson": np.full((2, 2), 0.3 + 0.1j)},
        {"poisson": "soft"},
        {"poisson": [[0.3], [0.3, 0.4]]},
        {"plane": "shell"},
        {"penalty": 0.0},
        {"penalty": "hard"},
        {"penalty": 1j},
    ],
)
def test_invalid_parameters_of_a_prior_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ElasticPrior(**wrong)


@pytest.mark.parametrize("wrong", [{"tolerance": 0}, {"tolerance": np.nan}, {"max_iterations": 0}])
def test_invalid_parameters_of_multigrid_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Multigrid(**wrong)


def test_a_piece_attached_at_one_corner_can_still_rotate():
    m = np.zeros((16, 16))
    m[:8, :8] = 1
    m[7:, 7:] = 1  # touches the first piece only at the site (7, 7)
    c = np.zeros((16, 16, 2))
    c[0] = 1
    with pytest.raises(ProblemError, match=r"of 81 pixels around \(11, 11\) could still move by"):
        solve(Problem(observed=0 * c, confidence=c, stiffness=m), ElasticPrior())
    c[15, 15, 0] = 1
    y = np.zeros_like(c)
    y[15, 15, 0] = 0.8
    found = solve(Problem(observed=y, confidence=c, stiffness=m), ElasticPrior()).displacement
    np.testing.assert_allclose(found[7, 15], (0.8, 0), atol=2e-3)
    np.testing.assert_allclose(found[15, 7], (0, -0.8), atol=2e-3)
