"""Elastic volumes, compared with independently assembled matrices."""

import math

import numpy as np
import psutil
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import Cancelled, ConvergenceError, ProblemError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.direct.sparse_factors import elimination_order
from napari_hmrf.solver.model_names import in_words
from napari_hmrf.solver.optimizers import ICM
from napari_hmrf.solver.optimizers.cycle import Cycle, chebyshev, smoothing_of
from napari_hmrf.solver.priors.elements import Lame
from napari_hmrf.solver.priors.hexahedra import brick_shape
from napari_hmrf.solver.volume_memory import ORDINARY
from tests.support.cancel_flags import During
from validation.bodies import OBLONG, between_plates
from validation.oracles import calculix
from validation.oracles.elasticity import direct_solution, grid_matrix

PRECISE = Multigrid(1e-3)


def random(*shape, seed=0):
    return np.random.default_rng(seed).random(shape)


def compressed_volume(m, spacing=(1.0, 1.0, 1.0), by=(1.0, 0.5, -0.3)):
    """Return tissue between a fixed plate and a plate moved by `by` voxels along each axis."""
    return between_plates(m, by, spacing)


def random_stiffness(ratio, shape=(11, 10, 10), seed=0):
    """Return a random stiffness between 1 and `ratio`."""
    return ratio ** random(*shape, seed=seed)


def error_in_voxels(found, problem, poisson):
    """Return the largest distance from the direct solution, in voxels."""
    expected = direct_solution(problem, ElasticPrior(poisson))
    return float(np.abs(found.displacement - expected).max()) / problem.unit


# The prior


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), OBLONG])
def test_element_forces_match_an_assembled_matrix(spacing):
    first, shear = random(2, 3, 4, 2)
    d = random(4, 5, 3, 3, seed=1)
    shape = brick_shape(spacing)
    expected = (grid_matrix(spacing, first, shear, full=False) @ d.ravel()).reshape(d.shape)
    found = shape.forces(Lame(first, shear), d)
    np.testing.assert_allclose(found * math.prod(spacing) ** (1 / 3), expected, atol=1e-12)
    assert shape.energy(Lame(first, shear), d) == pytest.approx((d * found).sum() / 2)


def test_a_rigid_motion_has_no_energy():
    problem = compressed_volume(random_stiffness(10, (4, 5, 6)), OBLONG)
    places = np.moveaxis(np.indices(problem.shape), 0, -1) * OBLONG
    turn = np.cross((0.3, -0.2, 0.5), places) + np.array([1, 2, 3])
    assert ElasticPrior(0.45).energy(problem, turn) == pytest.approx(0, abs=1e-20)
    assert np.abs(ElasticPrior(0.45).forces(problem, turn)).max() < 1e-12


def test_forces_are_the_gradient_of_the_energy():
    problem, prior = (
        compressed_volume(random_stiffness(10, (3, 4, 3))),
        ElasticPrior(random(3, 4, 3) / 2.1),
    )
    d, step = random(3, 4, 3, 3), 1e-3
    forces = prior.forces(problem, d)
    for at in [(0, 0, 0, 0), (1, 2, 1, 1), (2, 3, 2, 2)]:
        more, less = d.copy(), d.copy()
        more[at] += step
        less[at] -= step
        slope = (prior.energy(problem, more) - prior.energy(problem, less)) / (2 * step)
        assert forces[at] == pytest.approx(slope, rel=1e-8)


# The loops


def model_of(problem, prior):
    """Return the model with the observed sites fixed."""
    made = CpuElasticModel(prior.material(problem), whole=False)
    _, held = host.prescribed(problem)
    made.hold(held.copy())
    return made


def hollow_ball(shape):
    """Return random stiffness in a ball with a hole; nearly half of the grid is void."""
    places = np.moveaxis(np.indices(shape), 0, -1)
    depth = np.linalg.norm(2 * places / (np.array(shape) - 1) - 1, axis=-1)
    m = np.where(depth < 1.05, random_stiffness(10, shape), 0)
    m[5:9, 6:9, 7] = 0
    return m


@pytest.mark.parametrize(
    ("shape", "poisson"),
    [((5, 4, 140), 0.45), ((6, 7, 5), "map"), ((17, 4, 6), 0.0), ((20, 17, 22), "map")],
)
def test_compiled_forces_match_the_prior(shape, poisson):
    m = random_stiffness(10, shape) if min(shape) < 10 else hollow_ball(shape)
    m[1:3, 2, 3] = 0
    poisson = 0.499 * random(*shape, seed=1) if poisson == "map" else poisson
    problem, prior = compressed_volume(m, OBLONG), ElasticPrior(poisson)
    model, d = model_of(problem, prior), host.planes(random(*shape, 3, seed=2))
    exact = prior.forces(problem, problem.unit * np.moveaxis(d[:, 2:-2, 2:-2, 2:-2], 0, -1))
    scale = np.abs(exact).max()
    np.testing.assert_allclose(-model.pull(d), host.planes(exact), atol=1e-6 * scale)
    left = host.planes(np.where(problem.known | ~problem.tissue[..., None], 0, -exact))
    balance, finest = model.balance(d, None), model.levels[0]
    assert finest.layout.is_whole == (min(shape) < 10)
    rest = finest.planes(balance.rest) * balance.unit
    np.testing.assert_allclose(rest, left, atol=1e-6 * scale)
    assert balance.norm == pytest.approx(np.linalg.norm(left), rel=1e-5)
    energy, norm = model.work(d)
    in_lengths = problem.unit * np.moveaxis(d[:, 2:-2, 2:-2, 2:-2], 0, -1)
    assert energy == pytest.approx(prior.energy(problem, in_lengths), rel=1e-6)
    assert norm == pytest.approx(np.linalg.norm(exact), rel=1e-6)
    inside = np.where(model.moves, d, 0)
    work, _ = model.work(inside)
    for level, rel in ((finest, 1e-5), (model.double_level, 1e-12)):
        direction = finest.layout.packed(inside.astype(level.vector().dtype))
        image = level.vector()
        assert level.apply(direction, image) == pytest.approx(2 * work, rel=rel)


def test_the_compiled_diagonal_matches_the_matrix():
    shape = (4, 5, 3)
    problem, prior = (
        compressed_volume(random_stiffness(10, shape), OBLONG),
        ElasticPrior(random(*shape) / 2.1),
    )
    diagonal = model_of(problem, prior).steepness
    for at in [(0, 0, 0, 0), (1, 2, 1, 1), (2, 3, 2, 2), (3, 4, 0, 1)]:
        impulse = np.zeros((*shape, 3))
        impulse[at] = problem.unit
        *site, component = at
        place = (component, *(index + 2 for index in site))
        assert diagonal[place] == pytest.approx(prior.forces(problem, impulse)[at], rel=1e-6)


@pytest.mark.parametrize("m", [random_stiffness(10, (9, 8, 10)), hollow_ball((20, 17, 22))])
def test_a_model_whose_tissue_changes_is_the_same_as_a_new_model(m):
    fewer = m.copy()
    fewer[3:7, 2:6, 4:8] = 0
    model, prior, found = None, ElasticPrior(0.4), []
    for each in (m, fewer, m):
        problem = compressed_volume(each)
        if model is None:
            model = model_of(problem, prior)
        else:
            model.assemble(prior.material(problem))
            model.hold(host.prescribed(problem)[1].copy())
        fresh = model_of(problem, prior)
        corrections = []
        for own in (model, fresh):
            finest = own.levels[0]
            load = finest.layout.packed(random(*own.moves.shape).astype(np.float32) * own.moves)
            cycle = Cycle(own, smoothing_of(own.material))
            corrections.append(finest.planes(cycle.run(load)).copy())
        np.testing.assert_array_equal(*corrections)
        found.append(corrections[0])
    assert not np.array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize("m", [np.ones((8, 8, 8)), np.ones((7, 10, 9)), hollow_ball((41, 38, 47))])
def test_restriction_is_the_transpose_of_interpolation(m):
    model = model_of(compressed_volume(m), ElasticPrior())
    fine, coarse = model.levels[:2]
    one, other, down = fine.vector(), coarse.vector(), coarse.vector()
    one[fine.inverse > 0] = random(np.count_nonzero(fine.inverse))
    other[coarse.inverse > 0] = random(np.count_nonzero(coarse.inverse), seed=1)
    fine._restrict(one, coarse, down)
    coarse.correction, fine.correction = other, fine.vector()
    fine.loops.interpolate(fine, coarse)
    assert fine.product(fine.correction, one) == pytest.approx((down * other).sum(), rel=1e-5)


def test_a_uniform_strain_has_the_same_energy_on_all_levels():
    problem = compressed_volume(np.ones((17, 17, 17)), OBLONG)
    model = CpuElasticModel(ElasticPrior(0.4).material(problem), whole=False)
    energies = []
    for number, level in enumerate(model.levels):
        places = np.indices(level.grid) * 2.0**number
        d, image = level.vector(), level.vector()
        d[:, 2:-2, 2:-2, 2:-2] = np.tensordot([[1, 2, 0], [0, 3, 1], [1, 0, 2]], places, 1)
        level.hold(np.zeros(d.shape, dtype=bool))
        level.reach[...] = (0, level.grid[2])
        if level.weight is not None:
            level.weight.fill(0)
        level.start_cycles()
        energies.append(level.apply(d, image))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-4)


def test_a_ratio_for_each_voxel_does_not_depend_on_the_ratio_of_the_last_solve():
    problem = compressed_volume(random_stiffness(3, (6, 5, 6)))
    ratios = np.where(random(6, 5, 6) < 0.5, 0.1, 0.45)
    first, _, last = (
        solve(problem, ElasticPrior(each), optimizer=PRECISE) for each in (ratios, 0.3, ratios)
    )
    np.testing.assert_array_equal(last.displacement, first.displacement)


def test_the_number_of_threads_does_not_change_the_residual():
    problem = compressed_volume(random_stiffness(10, (13, 6, 7)))
    model, d = model_of(problem, ElasticPrior()), host.planes(random(13, 6, 7, 3))
    alone = model.balance(d, None).rest.copy()
    model.levels[0].parts = 5
    np.testing.assert_array_equal(model.balance(d, None).rest, alone)


# The field


@pytest.mark.skipif(not calculix.is_there(), reason=calculix.MISSING)
@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_the_reference_solution_matches_calculix_except_for_locking(poisson):
    problem = compressed_volume(random_stiffness(100, (6, 5, 4)), OBLONG)
    prior = ElasticPrior(poisson)
    locking = direct_solution(problem, prior, locking=True)
    np.testing.assert_allclose(locking, calculix.solve(problem, "C3D8", poisson), atol=1e-5)
    assert np.abs(locking - direct_solution(problem, prior)).max() > 1e-3


@pytest.mark.parametrize(
    ("poisson", "ratio"),
    [
        (0.0, 1),
        (0.49, 1e4),
        pytest.param(0.3, 1e4, marks=pytest.mark.campaign),
        pytest.param(0.49, 1, marks=pytest.mark.campaign),
    ],
)
def test_the_field_matches_a_direct_solve(poisson, ratio):
    problem = compressed_volume(random_stiffness(ratio), OBLONG)
    found = solve(problem, ElasticPrior(poisson), optimizer=PRECISE)
    apart = error_in_voxels(found, problem, poisson)
    assert apart <= found.convergence.error <= PRECISE.tolerance
    assert apart <= 0.005


@pytest.mark.parametrize("poisson", [0.45, pytest.param(0.3, marks=pytest.mark.campaign)])
def test_tissue_beside_void_is_free(poisson):
    m = random_stiffness(10, (9, 8, 9))
    m[3:6, 2:5, :6] = 0
    m[:, :, -1] = 0
    problem = compressed_volume(m)
    found = solve(problem, ElasticPrior(poisson), optimizer=PRECISE)
    assert error_in_voxels(found, problem, poisson) <= found.convergence.error <= PRECISE.tolerance
    assert not found.displacement[m == 0].any()


def test_each_tissue_can_have_a_different_poisson_ratio():
    poisson = np.where(random(8, 7, 9) > 0.5, 0.1, 0.47).astype(np.float32)
    problem = compressed_volume(random_stiffness(5, poisson.shape))
    found = solve(problem, ElasticPrior(poisson), optimizer=PRECISE)
    assert error_in_voxels(found, problem, poisson) <= found.convergence.error <= PRECISE.tolerance


@pytest.mark.parametrize(
    "spacing", [OBLONG, pytest.param((1.0, 1.0, 1.0), marks=pytest.mark.campaign)]
)
def test_a_uniform_strain_of_the_faces_extends_to_the_inside(spacing):
    places = np.moveaxis(np.indices((9, 8, 12)), 0, -1) * spacing
    strain = np.array([[0.02, -0.01, 0.03], [0.03, 0.015, 0.01], [-0.02, 0.01, 0.01]])
    c = np.ones((9, 8, 12, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    problem = Problem(
        observed=places @ strain.T,
        confidence=c,
        stiffness=np.full((9, 8, 12), 7.0),
        spacing=spacing,
    )
    found = solve(problem, ElasticPrior(0.45), optimizer=Multigrid(1e-5))
    np.testing.assert_allclose(found.displacement, places @ strain.T, atol=2e-5)


def test_a_stack_of_slices_is_plane_strain():
    m = random_stiffness(10, (9, 11))
    y, c = np.zeros((9, 11, 2)), np.zeros((9, 11, 2))
    c[0] = c[-1] = 1
    y[-1] = (0.5, 0.3)
    spacing = (1.5, 1.0)
    of_slice = solve(
        Problem(observed=y, confidence=c, stiffness=m, spacing=spacing),
        ElasticPrior(0.4, plane="strain"),
        backend="cpu",
    )
    deep, sure = np.zeros((4, 9, 11, 3)), np.zeros((4, 9, 11, 3))
    deep[..., 1:], sure[..., 1:], sure[..., 0] = y, c, 1
    stack = Problem(
        observed=deep,
        confidence=sure,
        stiffness=np.broadcast_to(m, (4, 9, 11)),
        spacing=(2.0, *spacing),
    )
    found = solve(stack, ElasticPrior(0.4))
    for each in found.displacement:
        np.testing.assert_allclose(each[..., 1:], of_slice.displacement, atol=4e-3)
        assert not each[..., 0].any()


def test_the_field_does_not_depend_on_the_order_of_the_axes():
    problem = compressed_volume(random_stiffness(20, (7, 9, 8)), OBLONG)
    expected = solve(problem, ElasticPrior(0.4), optimizer=PRECISE).displacement
    for turn in [(1, 2, 0), (2, 1, 0)]:
        y, c = (
            each.transpose(*turn, 3)[..., turn] for each in (problem.observed, problem.confidence)
        )
        spacing = tuple(OBLONG[axis] for axis in turn)
        turned = Problem(
            observed=y, confidence=c, stiffness=problem.stiffness.transpose(turn), spacing=spacing
        )
        found = solve(turned, ElasticPrior(0.4), optimizer=PRECISE).displacement
        np.testing.assert_allclose(found, expected.transpose(*turn, 3)[..., turn], atol=2e-3)


def error_of_a_hollow_sphere(n):
    """Return the RMS error of u(r) = r + b / r^2 in a shell with prescribed skins."""
    places = np.moveaxis((np.indices((n, n, n)) - (n - 1) / 2) / (n / 2), 0, -1)
    r = np.linalg.norm(places, axis=-1)
    tissue = (r > 0.3) & (r < 0.97)
    skins = tissue & ((r < 0.45) | (r > 0.82))  # the same thickness on every grid
    exact = 0.05 * (1 + 0.1 / np.maximum(r, 0.1) ** 3)[..., None] * places
    c = np.repeat(skins[..., None], 3, axis=-1).astype(float)
    problem = Problem(
        observed=exact, confidence=c, stiffness=tissue.astype(float), spacing=(2 / n,) * 3
    )
    found = solve(problem, ElasticPrior(0.3), optimizer=Multigrid(1e-4))
    off = np.linalg.norm(found.displacement - exact, axis=-1)[tissue & ~skins]
    return float(np.sqrt((off**2).mean()))


def test_the_field_of_a_hollow_sphere_converges_with_second_order():
    coarse, fine = error_of_a_hollow_sphere(32), error_of_a_hollow_sphere(56)
    assert 1.7 < np.log(coarse / fine) / np.log(56 / 32) < 2.6


def test_the_error_of_a_weakly_constrained_volume_is_estimated_by_rehearsal():
    """A ball constrained at its poles: its rotation between the poles converges late."""
    places = np.moveaxis(np.indices((20, 16, 16)), 0, -1) / (20, 16, 16) - 0.475
    m = (np.linalg.norm(places, axis=-1) < 0.5).astype(float)
    problem = between_plates(m, np.random.default_rng(0).normal(size=(16, 16, 3)))
    heard = []
    found = solve(
        problem,
        optimizer=Multigrid(0.01),
        progress=lambda m: heard.append(m.message),
    )
    assert any(message.startswith("check of the accuracy") for message in heard)
    exact = solve(problem, optimizer=Multigrid(1e-5), initial=found)
    assert np.abs(found.displacement - exact.displacement).max() <= found.convergence.error


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 4))]
)
def test_the_reported_error_is_a_bound_or_the_solve_fails(seed):
    """Difficult tissue: random stiff blobs, void, and few constrained sites."""
    draw = np.random.default_rng(seed)
    shape = tuple(draw.integers(6, 13, 3))
    coarse = draw.random(tuple(-(-size // 3) for size in shape))
    blobs = np.kron(coarse, np.ones((3, 3, 3)))[tuple(slice(size) for size in shape)]
    m = np.where(blobs > 0.6, 10 ** draw.uniform(1, 6), 1.0)
    m[blobs < 0.08] = 0
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    held = draw.random(shape) < 0.02
    held[0] = True
    c[held], y[held] = 1, draw.normal(size=3)
    problem, poisson = (
        Problem(observed=y, confidence=c, stiffness=m),
        float(draw.uniform(0.2, 0.49)),
    )
    try:
        found = solve(problem, ElasticPrior(poisson), optimizer=PRECISE)
    except (ProblemError, ConvergenceError):
        return
    assert error_in_voxels(found, problem, poisson) <= found.convergence.error <= PRECISE.tolerance


# Rigid tissue


def volume_with_bones(shape, spacing=OBLONG, seed=0):
    """Return tissue between two plates, one of them moved, with three bones and a hole.

    Two bones are so close that soft elements between them have corners in both.
    """
    m = random_stiffness(5, shape, seed)
    m[2, 2:4, 2:5] = np.inf
    m[6, 5:8, 5] = m[6, 6, 4] = np.inf
    m[6, 2, 5] = np.inf
    m[5, 1:3, 7:] = 0
    return compressed_volume(m, spacing)


@pytest.mark.parametrize(
    ("shape", "spacing"), [((13, 10, 11), (1.0, 1.0, 1.0)), ((9, 10, 9), OBLONG)]
)
def test_rigid_tissue_in_a_volume_moves_rigidly(shape, spacing):
    problem = volume_with_bones(shape, spacing)
    found = solve(problem, ElasticPrior(0.4), optimizer=PRECISE)
    assert error_in_voxels(found, problem, 0.4) <= found.convergence.error <= PRECISE.tolerance
    assert found.convergence.way == ("factors" if math.prod(shape) < 1000 else "cycles")


def test_bone_with_prescribed_sites_follows_their_motion():
    problem = volume_with_bones((13, 10, 11))
    y, c = np.array(problem.observed), np.array(problem.confidence)
    # The first bone is rotated; the second can still rotate around its prescribed site.
    places = np.moveaxis(np.indices(problem.shape), 0, -1) * OBLONG
    turn = np.array((0.1, 0.2, 0.3)) + np.cross((0.02, -0.05, 0.03), places - (3, 5, 3))
    for at in [(2, 2, 2), (3, 3, 4), (2, 3, 3)]:
        y[at], c[at] = turn[at], 1
    y[6, 6, 5], c[6, 6, 5] = (0.4, -0.2, 0.1), 1
    problem = Problem(observed=y, confidence=c, stiffness=problem.stiffness, spacing=OBLONG)
    found = solve(problem, ElasticPrior(0.4), optimizer=PRECISE)
    assert error_in_voxels(found, problem, 0.4) <= found.convergence.error <= PRECISE.tolerance
    np.testing.assert_allclose(found.displacement[3, 2, 3], turn[3, 2, 3], atol=1e-5)
    y[3, 2, 3], c[3, 2, 3] = (1, 1, 1), 1
    with pytest.raises(ProblemError, match=r"the rigid body around \(2, 2, 3\) relative to each"):
        solve(Problem(observed=y, confidence=c, stiffness=problem.stiffness, spacing=OBLONG))


# Observations that slip


@pytest.mark.parametrize(
    ("shape", "penalty"),
    [
        ((6, 7, 5), 0.05),
        pytest.param((6, 7, 5), 0.4, marks=pytest.mark.campaign),
        ((11, 11, 10), 0.1),
    ],
)
def test_slipping_observations_pull_with_the_penalty_and_exact_ones_with_less(shape, penalty):
    draw = np.random.default_rng(1)
    m = random_stiffness(5, shape)
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    seen = draw.random(shape) < 0.1
    seen[0] = seen[-1] = True
    y[seen], c[seen] = draw.normal(size=(seen.sum(), 3)) * OBLONG, draw.uniform(0.2, 1)
    problem, prior = (
        Problem(observed=y, confidence=c, stiffness=m, spacing=OBLONG),
        ElasticPrior(0.4, penalty=penalty),
    )
    found = solve(problem, prior, optimizer=PRECISE)
    away = (problem.observed - found.displacement) / problem.unit
    held = problem.known & (np.abs(away) < 1e-6)
    slips = problem.known & ~held
    assert held.any()
    assert slips.any()
    # The energy is convex, so a field in equilibrium is its minimum.
    limit = penalty * problem.confidence
    force = prior.force_unit(problem) * np.where(slips, limit * np.sign(away), 0)
    exact = direct_solution(problem, prior, force=force, held=held)
    assert np.abs(found.displacement - exact).max() / problem.unit <= found.convergence.error
    forces = prior.forces(problem, exact)
    assert (np.abs(forces)[held] <= limit[held] * 1.001).all()


# Limits of cycles in single precision


def stiff_cubes(size, ratio):
    """Return the stiffness of stiff cubes in soft tissue."""
    return np.where((np.indices((size,) * 3) % 6 < 3).all(axis=0), float(ratio), 1.0)


@pytest.fixture
def without_factors(monkeypatch):
    """Disable the factorization, as for a volume that is too large."""
    monkeypatch.setattr(Factors, "fit", staticmethod(lambda *_: False))


@pytest.mark.usefixtures("without_factors")
def test_a_volume_beyond_single_precision_is_iterated_in_double_precision():
    problem, heard = compressed_volume(stiff_cubes(11, 1e6)), []
    found = solve(problem, optimizer=PRECISE, progress=lambda m: heard.append(m.message))
    assert error_in_voxels(found, problem, 0.45) <= found.convergence.error <= PRECISE.tolerance
    assert found.convergence.way == "cycles"
    assert sum(message.startswith("check of the accuracy") for message in heard) > 40


@pytest.mark.usefixtures("without_factors")
def test_a_volume_without_a_certain_error_bound_raises_an_error():
    with pytest.raises(ConvergenceError, match="Raise max_iterations, "):
        solve(compressed_volume(stiff_cubes(12, 1e6)), optimizer=Multigrid(1e-3, max_iterations=8))


def test_small_volumes_of_high_contrast_are_factorised():
    problem = compressed_volume(stiff_cubes(10, 1e7), OBLONG)
    found = solve(problem, optimizer=PRECISE)
    assert error_in_voxels(found, problem, 0.45) <= found.convergence.error <= PRECISE.tolerance
    assert found.convergence.way == "factors"


def test_separator_planes_are_eliminated_after_their_parts():
    order = elimination_order((7, 5, 4)).tolist()
    assert sorted(order) == list(range(140))
    place = {site: number for number, site in enumerate(order)}
    middle = [place[site] for site in range(60, 80)]
    assert min(middle) > max(place[site] for site in [*range(60), *range(80, 140)])


# Memory and time


def test_a_volume_beyond_the_memory_is_rejected_with_a_size_that_fits(monkeypatch):
    problem = compressed_volume(np.ones((10, 10, 10)))

    class Memory:
        available = 500 * ORDINARY / 0.9

    monkeypatch.setattr(psutil, "virtual_memory", Memory)
    with pytest.raises(ProblemError, match="A volume of 7 x 7 x 7 voxels would fit: crop"):
        solve(problem)


def test_a_cycle_checks_for_cancellation_between_smoothing_steps(monkeypatch):
    looks = []
    monkeypatch.setattr(compute_thread, "check_cancelled", lambda: looks.append(1))
    problem = compressed_volume(np.ones((56, 64, 64)))
    model = CpuElasticModel(ElasticPrior(0.3).material(problem), whole=False)
    _, held = host.prescribed(problem)
    model.hold(held)
    level, before = model.levels[0], len(looks)
    assert before >= 3  # checks during assembly and constraint setup
    level.load = level.vector(random(*level.inverse.shape).astype(np.float32))
    steps = chebyshev(0.02, 1.0, 20)
    level.relax(steps, from_zero=True)
    assert len(looks) == before + 2
    found = level.correction.copy()
    expected = smooth_stepwise(level, steps)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def smooth_stepwise(level, steps):
    """Return the correction after the same steps, one by one."""
    d, step = level.vector(), level.vector()
    for scale, momentum in steps:
        image = level.vector()
        level.apply(d, image)
        step = np.float32(scale) * level.inverse * (level.load - image) + momentum * step
        d = d + step
    return d


# Interface


def test_a_warm_start_reduces_the_iterations():
    prior, m = ElasticPrior(0.4), random_stiffness(4, (12, 12, 12))
    first, second = (compressed_volume(m, by=(push, 0.2, 0)) for push in (1.0, 1.01))
    earlier = solve(first, prior, optimizer=Multigrid(1e-4))
    assert solve(first, prior, optimizer=PRECISE, initial=earlier).iterations == 0
    warm = solve(second, prior, optimizer=PRECISE, initial=earlier)
    cold = solve(second, prior, optimizer=PRECISE)
    assert 0 < warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=2e-3)


def test_a_solve_can_be_cancelled():
    with pytest.raises(Cancelled):
        solve(
            compressed_volume(random_stiffness(4)),
            optimizer=Multigrid(1e-6),
            cancel=During("cycle"),
        )


def test_a_solution_is_saved_and_loaded(tmp_path):
    found = solve(compressed_volume(np.ones((5, 6, 7)), OBLONG))
    again = Solution.read(found.write(tmp_path / "volume.npz"))
    np.testing.assert_array_equal(again.displacement, found.displacement)
    assert again.tissue.shape == (5, 6, 7)
    assert again.spacing == OBLONG
    assert "5 x 6 x 7" in repr(again)
    assert in_words(again.provenance.parameters).startswith("elastic (Poisson's ratio 0.45), ")


def test_the_smallest_volumes_are_solved():
    for shape in [(2, 2, 2), (2, 3, 2), (2, 2, 9)]:
        problem = compressed_volume(np.ones(shape))
        found = solve(problem, ElasticPrior(0.3), optimizer=PRECISE)
        assert error_in_voxels(found, problem, 0.3) <= PRECISE.tolerance


def test_the_blanket_reading_is_rejected_for_volumes():
    with pytest.raises(ProblemError, match="for images only"):
        solve(
            compressed_volume(np.ones((4, 4, 4))),
            SeilerPrior(conditional="blanket"),
            optimizer=ICM(),
        )


@pytest.mark.parametrize("meet", ["corner", "edge"])
def test_tissue_that_can_rotate_around_a_hinge_is_rejected(meet):
    m = np.zeros((6, 6, 6))
    m[:3, :3, :3] = 1
    m[2:5, 2:5, 2 if meet == "corner" else 0 : 5] = 1
    y, c = np.zeros((6, 6, 6, 3)), np.zeros((6, 6, 6, 3))
    c[:2, :2] = 1
    with pytest.raises(ProblemError, match="could still move by turning"):
        solve(Problem(observed=y, confidence=c, stiffness=m))
    c[4, 4, 4] = c[4, 2, 4] = c[2, 4, 2] = 1  # not on a line with the hinge
    assert not solve(Problem(observed=y, confidence=c, stiffness=m)).displacement.any()


def test_a_piece_needs_three_constrained_sites():
    m = np.ones((3, 4, 9))
    m[:, :, 4] = 0
    y, c = np.zeros((3, 4, 9, 3)), np.zeros((3, 4, 9, 3))
    c[:, :, 0] = 1
    with pytest.raises(ProblemError, match=r"48 pixels around .* is not held anywhere"):
        solve(Problem(observed=y, confidence=c, stiffness=m))
    c[0, 0, 6] = c[0, 3, 6] = 1
    with pytest.raises(ProblemError, match="could still move by turning"):
        solve(Problem(observed=y, confidence=c, stiffness=m))
    c[2, 0, 6, 0] = 1
    with pytest.raises(ProblemError, match="could still move by turning"):
        solve(Problem(observed=y, confidence=c, stiffness=m))
    c[2, 0, 6] = 1
    y[:, :, 5:] = (1.0, -0.5, 0.3)
    assert solve(Problem(observed=y, confidence=c, stiffness=m)).displacement[
        1, 1, 7
    ] == pytest.approx([1, -0.5, 0.3], abs=1e-3)
