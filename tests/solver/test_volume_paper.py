"""The paper's prior for volumes: cliques, schedule and converged field."""

import itertools
from functools import partial

import numba
import numpy as np
import pytest

from napari_hmrf import Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import BackendError, Cancelled, ConvergenceError, ProblemError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.arrays.seiler import ArraySeilerModel
from napari_hmrf.solver.backends.base import SiteRule
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.cpu.seiler_model import CpuSeilerModel
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.model_names import in_words
from napari_hmrf.solver.optimizers import ICM
from napari_hmrf.solver.priors import line_steps, line_weights
from tests.support.cancel_flags import During
from validation.bodies import dice_of
from validation.oracles.paper import (
    best_candidates,
    candidates,
    local_energies,
    prolonged,
    schedule,
    solve_exactly,
    total_energy,
)
from validation.oracles.paper import line_weights as reference_weights
from validation.problems import random_problem

CUBES, OBLONG = (1.0, 1.0, 1.0), (1.0, 1.7, 0.6)
PRECISE = Multigrid(1e-3)
CONVERGED = ICM(iterations=3000, steps=None, energy_change=1e-9)
STEPS = (1.0, 0.1, 0.01, 0.001)


def compressed_volume(shape=(8, 9, 7), ratio=10.0, spacing=CUBES, seed=0, void=False):
    """Return random tissue between a fixed and a moved plate, with some observed sites."""
    draw = np.random.default_rng([seed, *shape])
    m = ratio ** draw.random(shape)
    if void:
        m[3:5, 2:5, :4] = 0
        m[draw.random(shape) < 0.05] = 0
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[0] = c[-1] = 1
    y[-1] = np.array([1.0, 0.5, -0.3]) * spacing
    some = draw.random((*shape, 3)) < 0.05
    c[some], y[some] = 0.5, draw.normal(size=some.sum())
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


def error_in_voxels(found, problem):
    """Return the largest distance from the direct solution, in voxels."""
    apart = np.abs(found.displacement - solve_exactly(problem, "centred"))
    return float(apart[problem.tissue].max()) / problem.unit


def next_position(problem, prior, d):
    """Return the minimiser of each component, y + soft(q - y, p / 2A), in the unit of length."""
    curvature, lowest = prior.site_parabola(problem, d)
    p = prior.limit(problem) * problem.unit
    y = problem.observed.astype(float)
    reach = np.divide(p, 2 * curvature, out=np.full_like(p, np.inf), where=curvature > 0)
    away = lowest - y
    best = y + np.sign(away) * np.maximum(np.abs(away) - reach, 0)
    return np.where(problem.tissue[..., None] & ((curvature > 0) | (p > 0)), best, d)


# The prior


def test_the_energy_is_the_sum_over_all_lines_of_three_sites():
    problem = compressed_volume((4, 3, 6), ratio=100, spacing=OBLONG, void=True)
    d = np.random.default_rng(1).normal(size=problem.observed.shape)
    total = total_energy(problem, d, 2.0)
    assert SeilerPrior(penalty=2.0).site_energy(problem, d).sum() == pytest.approx(total, rel=1e-6)


def test_the_parabola_of_a_site_matches_its_local_energy():
    problem, prior = compressed_volume((4, 5, 3), ratio=100, void=True), SeilerPrior(penalty=1e-9)
    d = np.random.default_rng(1).normal(size=problem.observed.shape)
    curvature, lowest = prior.site_parabola(problem, d)
    for at in [(1, 2, 1, 0), (2, 2, 1, 1), (2, 1, 1, 2)]:
        values = []
        for there in (lowest[at], lowest[at] + 1, lowest[at] - 1):
            moved = d.copy()
            moved[at] = there
            values.append(prior.site_energy(problem, moved)[at[:3]])
        least, more, less = values
        assert [more - least, less - least] == pytest.approx([curvature[at]] * 2)


@pytest.mark.parametrize("spacing", [CUBES, OBLONG, (1, 1, 4), (4, 1, 1), (0.5, 1, 3), (2.3,) * 3])
def test_the_continuum_limit_does_not_depend_on_the_voxel_shape(spacing):
    weights, steps = line_weights(spacing), np.array(line_steps(3)) * spacing
    assert (weights >= 0).all()
    for k in range(3):
        moment = np.einsum("l,li,lj->ij", weights[:, k], steps, steps)
        expected = np.diag(np.where(np.arange(3) == k, 3.0, 2.0))
        np.testing.assert_allclose(3 * moment / moment[k, k], expected, atol=1e-12)
    for step, weight in zip(line_steps(3), weights, strict=True):
        np.testing.assert_allclose(weight, reference_weights(step, spacing), atol=1e-12)
    if len(set(spacing)) == 1:
        carried = np.where(np.array(line_steps(3)) == 0, 0, 1)
        np.testing.assert_array_equal(weights, carried)


def test_sites_are_weighted_means_of_their_neighbours_for_any_stiffness():
    problem = compressed_volume((5, 6, 5), ratio=1e6, spacing=OBLONG)
    d = np.random.default_rng(1).random(problem.observed.shape)
    curvature, lowest = SeilerPrior().site_parabola(problem, d)
    assert lowest[curvature > 0].min() >= d.min()
    assert lowest[curvature > 0].max() <= d.max()
    np.testing.assert_allclose(SeilerPrior().site_parabola(problem, 0 * d + 1).lowest, 1)


# The loops


def uploaded(backend, problem, prior, d):
    m = problem.stiffness / problem.stiffness.max()
    tissue = np.stack([m, np.divide(1, m, out=np.zeros_like(m), where=m > 0)], axis=-1)
    y, p = problem.observed / problem.unit, prior.limit(problem)
    observation = np.concatenate([y, p], axis=-1)
    observation[~problem.tissue] = 0
    return [backend.upload(each.astype(np.float32)) for each in (d, tissue, observation)]


def relaxed(problem, prior, d, steps, sweeps=1):
    """Return the displacement after some sweeps, U_total before each sweep, and U_total now."""

    def job():
        backend = CpuBackend(lambda: None)
        rule = SiteRule(False, prior.relaxation, steps, line_weights(problem.spacing))
        fields = uploaded(backend, problem, prior, d)
        moved, before = backend.relax(*fields, rule, sweeps)
        now = backend.energy(moved, *fields[1:], rule)
        backend.close()
        return backend.download(moved), before, now

    return compute_thread.submit(job).result()


CASES = [((6, 7, 5), 10.0, CUBES), ((5, 4, 140), 10.0, OBLONG), ((9, 6, 12), 1e4, OBLONG)]


@pytest.mark.parametrize(
    ("shape", "ratio", "spacing", "damping"),
    [(*case, damping) for case, damping in zip(CASES, (1.0, 0.6, 1.0), strict=True)],
)
def test_a_sweep_matches_the_equations(shape, ratio, spacing, damping):
    problem = compressed_volume(shape, ratio, spacing, void=True)
    prior = SeilerPrior(penalty=1e3, damping=damping)
    d = np.random.default_rng(2).normal(size=problem.observed.shape).astype(np.float32)
    d[~problem.tissue] = 0
    moved, before, now = relaxed(problem, prior, d, ())
    lengths = d.astype(float) * problem.unit
    assert before[0] == pytest.approx(prior.site_energy(problem, lengths).sum(), rel=1e-5)
    after = prior.site_energy(problem, moved.astype(float) * problem.unit).sum()
    assert now == pytest.approx(after, rel=1e-5)
    curvature, lowest = prior.site_parabola(problem, lengths)
    p, y = prior.limit(problem), problem.observed / problem.unit
    way = damping * (lowest / problem.unit - d)
    reach = np.divide(damping * p, 2 * curvature, out=np.full_like(p, np.inf), where=curvature > 0)
    away = d + way - y
    best = y + np.sign(away) * np.maximum(np.abs(away) - reach, 0)
    best = np.where((curvature > 0) | (p > 0), best, d) * problem.tissue[..., None]
    np.testing.assert_allclose(moved, best, atol=2e-5)


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_a_sweep_moves_each_site_to_its_best_candidate(shape, ratio, spacing):
    problem, prior = compressed_volume(shape, ratio, spacing, void=True), SeilerPrior(penalty=1e3)
    d = np.random.default_rng(2).normal(size=problem.observed.shape).astype(np.float32)
    d[~problem.tissue] = 0
    moved, _, _ = relaxed(problem, prior, d, STEPS)
    y, p = problem.observed / problem.unit, prior.limit(problem)
    energies = local_energies(problem.stiffness, y, p, d, spacing)
    best = best_candidates(energies, d.astype(float), candidates(STEPS, 3))
    best *= problem.tissue[..., None]
    # Either of two candidates that are equal up to rounding may be taken.
    worse = energies(moved.astype(float)) - energies(best)
    assert (worse / (energies(d.astype(float)) + 1e-30))[problem.tissue].max() < 1e-5
    assert (np.abs(moved - best).max(axis=-1) > 1e-5).mean() < 1e-2


def test_prolongation_is_linear_and_ignores_void():
    draw = np.random.default_rng(0)
    for shape in [(5, 7, 6), (2, 9, 1)]:
        coarse_shape = tuple(-(-size // 2) for size in shape)
        coarse_m, m = ((draw.random(s) > 0.3).astype(np.float32) for s in (coarse_shape, shape))
        coarse = draw.normal(size=(*coarse_shape, 3)).astype(np.float32)

        def job(parts=(coarse, coarse_m, m)):
            backend = CpuBackend(lambda: None)
            given, above, here = (
                backend.upload(each if each.ndim == 4 else np.stack([each] * 2, -1))
                for each in parts
            )
            return backend.download(backend.prolong(given, above, here))

        found = compute_thread.submit(job).result()
        np.testing.assert_allclose(found, prolonged(coarse, coarse_m, m), atol=1e-6)


def test_the_schedule_matches_the_literal_implementation():
    problem = compressed_volume((9, 6, 7), void=True)
    one, many = (solve(problem, SeilerPrior(), optimizer=ICM(iterations=n)) for n in (1, 12))
    np.testing.assert_allclose(one.displacement, schedule(problem, 1), atol=1e-6)
    # Rounding decides between candidates of equal energy, so single sites may differ.
    apart = np.abs(many.displacement - schedule(problem, 12))
    assert np.sqrt((apart**2).mean()) < 0.01
    assert (apart > 1e-4).mean() < 0.05


def test_the_schedule_gives_the_same_bits_on_any_number_of_threads():
    problem = compressed_volume((24, 20, 26), void=True)
    before, found = numba.get_num_threads(), []
    for threads in (1, numba.config.NUMBA_NUM_THREADS, numba.config.NUMBA_NUM_THREADS):
        compute_thread.submit(partial(numba.set_num_threads, threads)).result()
        found.append(solve(problem, SeilerPrior(), optimizer=ICM(iterations=8)))
    compute_thread.submit(partial(numba.set_num_threads, before)).result()
    for other in found[1:]:
        np.testing.assert_array_equal(other.displacement, found[0].displacement)
        np.testing.assert_array_equal(other.energy, found[0].energy)


def without_ring(planes):
    """Return planes without their padding, with the component axis last."""
    return np.moveaxis(planes[:, 2:-2, 2:-2, 2:-2], 0, -1)


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_compiled_forces_match_the_energies(shape, ratio, spacing):
    problem, prior = compressed_volume(shape, ratio, spacing, void=True), SeilerPrior()
    d = np.random.default_rng(2).normal(size=problem.observed.shape)
    model = CpuSeilerModel(prior.material(problem))
    curvature, lowest = prior.site_parabola(problem, d * problem.unit)
    expected = lowest / problem.unit - d
    np.testing.assert_allclose(without_ring(model.pull(host.planes(d))), expected, atol=1e-9)
    np.testing.assert_allclose(without_ring(model.steepness), 2 * curvature, rtol=1e-9)
    energy, norm = model.work(host.planes(d))
    total = SeilerPrior(penalty=1e-30).site_energy(problem, d * problem.unit).sum()
    assert energy == pytest.approx(total, rel=1e-9)
    assert norm == pytest.approx(np.linalg.norm(expected))
    _, held = host.prescribed(problem)
    model.hold(held.copy())
    moves = (curvature > 0) & ~problem.known
    np.testing.assert_array_equal(without_ring(model.moves), moves)
    left = np.where(moves, expected, 0)
    balance = model.balance(host.planes(d), None)
    np.testing.assert_allclose(without_ring(balance.rest) * balance.unit, left, atol=1e-5)
    level = model.levels[0]
    image = level.vector()
    product = level.apply(level.vector(host.planes(d).astype(np.float32)), image)
    np.testing.assert_allclose(without_ring(image), -left, atol=1e-5)
    assert product == pytest.approx(-(d * left).sum(), rel=1e-3)


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_all_levels_match_the_array_model(shape, ratio, spacing):
    problem = compressed_volume(shape, ratio, spacing, void=True)
    material = SeilerPrior().material(problem)
    loops, arrays = CpuSeilerModel(material), ArraySeilerModel(material)
    _, held = host.prescribed(problem)
    for model in (loops, arrays):
        model.hold(held.copy())
    draw = np.random.default_rng(3)
    assert len(loops.levels) == len(arrays.levels) > 1
    for ours, theirs in zip(loops.levels, arrays.levels, strict=True):
        for name in ("stiffness", "even", "inverse", "weight"):
            if name == "even" and ours is loops.levels[0]:
                continue
            expected, found = getattr(theirs, name), getattr(ours, name)
            assert (found is None) == (expected is None)
            if found is not None:
                np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        d = draw.normal(size=theirs.inverse.shape).astype(np.float32) * (theirs.inverse > 0)
        image, expected = ours.vector(), theirs.vector()
        ours.apply(d, image)
        theirs.apply(d, expected)
        np.testing.assert_allclose(image, expected, atol=1e-5)


def test_smoothing_is_a_chebyshev_iteration_and_the_residual_is_restricted():
    problem = compressed_volume((9, 8, 10), void=True)
    model = CpuSeilerModel(SeilerPrior().material(problem))
    _, held = host.prescribed(problem)
    model.hold(held.copy())
    (fine, coarse), draw = model.levels[:2], np.random.default_rng(3)
    load = draw.normal(size=fine.inverse.shape).astype(np.float32) * (fine.inverse > 0)
    fine.load = load
    steps = ((0.7, 0.0), (0.9, 0.2), (1.1, 0.3))
    fine.descend(steps, coarse)
    d, step, image = np.zeros_like(load), np.zeros_like(load), fine.vector()
    for scale, momentum in steps:
        fine.apply(d, image)
        step = scale * fine.inverse * (load - image) + momentum * step
        d = d + step
    np.testing.assert_allclose(fine.correction, d, atol=1e-5)
    fine.apply(d, image)
    rest, total = load - image, np.zeros_like(coarse.load)
    near = {-1: 0.5, 0: 1.0, 1: 0.5}
    for a, b, c in itertools.product((-1, 0, 1), repeat=3):
        shares = near[a] * near[b] * near[c]
        padded = np.pad(rest, ((0, 0), *[(0, 3)] * 3))
        rows = [2 + 2 * np.arange(size) + o for size, o in zip(coarse.grid, (a, b, c), strict=True)]
        total[:, 2:-2, 2:-2, 2:-2] += shares * padded[np.ix_(range(3), *rows)]
    np.testing.assert_allclose(coarse.load, total * coarse.even, atol=1e-4)


# The field


TISSUES = [(1, False, CUBES), (10, True, OBLONG), (1e4, True, OBLONG)]


@pytest.mark.parametrize(
    ("ratio", "void", "spacing"),
    [
        *TISSUES,
        *(
            pytest.param(*each, spacing, marks=pytest.mark.campaign)
            for each in ((1, False), (10, True), (1e4, False), (1e4, True))
            for spacing in (CUBES, OBLONG)
            if (*each, spacing) not in TISSUES
        ),
    ],
)
def test_the_field_matches_a_direct_solve(ratio, void, spacing):
    problem = compressed_volume((11, 9, 10), ratio, spacing, void=void)
    found = solve(problem, SeilerPrior(), optimizer=PRECISE)
    assert error_in_voxels(found, problem) <= found.convergence.error <= PRECISE.tolerance
    assert not found.displacement[~problem.tissue].any()


@pytest.mark.parametrize("ratio", [1e6, pytest.param(1e2, marks=pytest.mark.campaign)])
def test_a_stiff_tumour_in_soft_tissue_is_solved_accurately(ratio):
    n = 14
    places = np.moveaxis(np.indices((n, n, n)), 0, -1) * (2 / n) - 1
    m = np.where(np.linalg.norm(places - (0.1, 0.1, 0), axis=-1) < 0.45, ratio, 1.0)
    y, c = np.zeros((n, n, n, 3)), np.ones((n, n, n, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    y[-1, ..., 0] = 1 - np.abs(places[-1, ..., 1])
    problem = Problem(observed=y, confidence=c, stiffness=m)
    found = solve(problem, SeilerPrior(), optimizer=PRECISE)
    assert error_in_voxels(found, problem) <= found.convergence.error <= PRECISE.tolerance


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 4))]
)
def test_the_reported_error_is_a_bound_or_the_solve_fails(seed):
    """Difficult tissue: random stiff blobs, void, and few constrained sites."""
    draw = np.random.default_rng(seed)
    shape = tuple(draw.integers(6, 11, 3))
    blobs = np.kron(draw.random((4, 4, 4)), np.ones((3, 3, 3)))[tuple(map(slice, shape))]
    m = np.where(blobs > 0.6, 10 ** draw.uniform(1, 6), 1.0)
    m[blobs < 0.08] = 0
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[draw.random(shape) < 0.02] = c[0] = 1
    y[c > 0] = draw.normal(size=int(c.sum()))
    problem = Problem(observed=y, confidence=c, stiffness=m)
    try:
        found = solve(problem, SeilerPrior(), optimizer=PRECISE)
    except ConvergenceError:
        return
    assert error_in_voxels(found, problem) <= found.convergence.error <= PRECISE.tolerance


def test_observations_slip_where_the_force_exceeds_their_confidence():
    problem = compressed_volume((8, 9, 7), ratio=3, spacing=OBLONG, void=True)
    for penalty, slips in ((300.0, True), (10.0, True), (1e6, False)):
        prior = SeilerPrior(penalty=penalty)
        d = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement.astype(float)
        solved = connected(problem, prior).problem  # the other sites follow
        expected = np.where(solved.tissue[..., None], next_position(solved, prior, d), d)
        curvature = prior.site_parabola(solved, d).curvature
        np.testing.assert_allclose(expected[curvature > 0], d[curvature > 0], atol=2e-4)
        away = np.abs(d - problem.observed)[problem.known & (curvature > 0)]
        assert (away.max() > 0.01) == slips


@pytest.mark.parametrize("spacing", [OBLONG, pytest.param(CUBES, marks=pytest.mark.campaign)])
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
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-5))
    np.testing.assert_allclose(found.displacement, places @ strain.T, atol=2e-5)
    relaxed = solve(problem, SeilerPrior(), optimizer=CONVERGED)
    np.testing.assert_allclose(relaxed.displacement, places @ strain.T, atol=2e-3)


@pytest.mark.parametrize(
    "optimizer", [PRECISE, pytest.param(CONVERGED, marks=pytest.mark.campaign)]
)
def test_the_field_does_not_depend_on_the_order_of_the_axes(optimizer):
    # The octree is symmetric only for a cube with a power of two as its size.
    problem = compressed_volume((8, 8, 8), spacing=OBLONG, void=True)
    expected = solve(problem, SeilerPrior(), optimizer=optimizer).displacement
    for turn in [(1, 2, 0), (2, 1, 0)]:
        y, c = (
            each.transpose(*turn, 3)[..., turn] for each in (problem.observed, problem.confidence)
        )
        spacing = tuple(OBLONG[axis] for axis in turn)
        turned = Problem(
            observed=y, confidence=c, stiffness=problem.stiffness.transpose(turn), spacing=spacing
        )
        found = solve(turned, SeilerPrior(), optimizer=optimizer).displacement
        np.testing.assert_allclose(found, expected.transpose(*turn, 3)[..., turn], atol=2e-3)


@pytest.mark.parametrize(
    "spacing", [(1.7, 0.6), pytest.param((1.0, 1.0), marks=pytest.mark.campaign)]
)
def test_a_stack_of_equal_slices_moves_like_a_single_image(spacing):
    draw = np.random.default_rng(0)
    m, y, c = 10 ** draw.random((9, 11)), np.zeros((9, 11, 2)), np.zeros((9, 11, 2))
    c[0] = c[-1] = 1
    y[-1] = (0.5, 0.3)
    c[4, 5], y[4, 5] = 0.02, 2
    image = solve(
        Problem(observed=y, confidence=c, stiffness=m, spacing=spacing),
        SeilerPrior(penalty=100.0),
        optimizer=Multigrid(1e-4),
    )
    assert np.abs(image.displacement[4, 5] - 2).max() > 0.1  # the observation slips
    deep, sure = np.zeros((5, 9, 11, 3)), np.zeros((5, 9, 11, 3))
    deep[..., 1:], sure[..., 1:] = y, c
    # Sites of the outer slices have fewer cliques, so prescribe their displacement.
    sure[[0, -1], 4, 5] = 0
    deep[[0, -1], :, :, 1:], sure[[0, -1], :, :, 1:] = image.displacement, 1
    stack = Problem(
        observed=deep,
        confidence=sure,
        stiffness=np.broadcast_to(m, (5, 9, 11)),
        spacing=(1.0, *spacing),
    )
    unit = stack.unit**2 / np.prod(spacing)  # ratio of the units of the penalty
    found = solve(stack, SeilerPrior(penalty=300.0 / unit), optimizer=Multigrid(1e-4))
    for each in found.displacement:
        np.testing.assert_allclose(each[..., 1:], image.displacement, atol=1e-3)
        assert not each[..., 0].any()


def test_the_field_depends_only_on_ratios_of_stiffness_and_lengths():
    problem = compressed_volume(spacing=OBLONG, void=True)
    for optimizer in (PRECISE, ICM(steps=None)):
        first = solve(problem, SeilerPrior(), optimizer=optimizer).displacement
        inches = Problem(
            observed=problem.observed / 25.4,
            confidence=problem.confidence,
            stiffness=1000 * problem.stiffness,
            spacing=tuple(size / 25.4 for size in OBLONG),
        )
        second = solve(inches, SeilerPrior(), optimizer=optimizer).displacement
        np.testing.assert_allclose(25.4 * second, first, atol=1e-3)


def test_sweeps_and_cycles_converge_to_the_same_field():
    # Sweeps never move sites that are not the middle of a clique, so fix all faces.
    some = compressed_volume((10, 9, 8))
    m, c = some.stiffness.copy(), np.ones(some.observed.shape)
    m[4:6, 3:6, 3:5], c[1:-1, 1:-1, 1:-1] = 0, some.confidence[1:-1, 1:-1, 1:-1]
    problem = Problem(observed=some.observed, confidence=c, stiffness=m)
    relaxed = solve(problem, SeilerPrior(), optimizer=CONVERGED)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4))
    apart = np.abs(relaxed.displacement - found.displacement)[problem.tissue]
    assert apart.max() < 2e-3
    assert relaxed.mean_energy == pytest.approx(found.mean_energy, rel=1e-3)


# Interface


def test_the_schedule_of_the_paper_on_an_octree_is_the_default():
    problem = compressed_volume((9, 6, 12), void=True)
    heard = []
    found = solve(problem, SeilerPrior(), progress=heard.append)
    assert [run.shape for run in found.levels] == [
        (1, 1, 1), (2, 1, 2), (3, 2, 3), (5, 3, 6), (9, 6, 12)
    ]  # fmt: skip
    assert {run.iterations for run in found.levels} == {70}
    expected = SeilerPrior().mean_energy(problem, found.displacement)
    assert found.mean_energy == pytest.approx(expected, rel=1e-4)
    assert any(each.message.startswith("level 0 (9 x 6 x 12), sweep 70") for each in heard)
    assert heard[-1].fraction == pytest.approx(1)
    assert found.provenance.backend == "cpu"
    assert found.provenance.reason == "only the compiled loops solve volumes with the paper's prior"


@pytest.mark.parametrize(("optimizer", "stage"), [(ICM(), "level 0"), (PRECISE, "cycle 2")])
def test_a_solve_can_be_cancelled(optimizer, stage):
    with pytest.raises(Cancelled):
        solve(
            compressed_volume((14, 14, 14)),
            SeilerPrior(),
            optimizer=optimizer,
            cancel=During(stage),
        )


def test_a_warm_start_converges_to_the_same_field():
    problem = compressed_volume((16, 12, 14))
    y = problem.observed.copy()
    y[-1, 3:6, 3:6, 0] += 0.2
    edited = Problem(observed=y, confidence=problem.confidence, stiffness=problem.stiffness)
    cold = solve(edited, SeilerPrior(), optimizer=PRECISE)
    earlier = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4))
    warm = solve(edited, SeilerPrior(), optimizer=PRECISE, initial=earlier)
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=2e-3)


def test_a_solution_is_saved_and_loaded(tmp_path):
    found = solve(compressed_volume((5, 6, 7), spacing=OBLONG), SeilerPrior(), optimizer=PRECISE)
    again = Solution.read(found.write(tmp_path / "volume.npz"))
    np.testing.assert_array_equal(again.displacement, found.displacement)
    assert in_words(again.provenance.parameters) == "the paper's prior (centred), converged"


def test_the_smallest_volumes_are_solved():
    for shape in [(2, 2, 2), (3, 1, 1), (2, 3, 9), (1, 4, 5)]:
        c = np.zeros((*shape, 3))
        c[0] = 1
        problem = Problem(observed=c, confidence=c, stiffness=np.ones(shape))
        for optimizer in (ICM(), PRECISE):
            found = solve(problem, SeilerPrior(), optimizer=optimizer)
            np.testing.assert_allclose(found.displacement[0], 1, atol=1e-3)


@pytest.mark.parametrize("optimizer", [ICM(), PRECISE])
def test_shaders_reject_volumes_with_the_paper_prior(optimizer):
    with pytest.raises(BackendError, match=r"only the compiled loops .* \(`backend=\"cpu\"`\)"):
        solve(compressed_volume(), SeilerPrior(), optimizer=optimizer, backend="opengl")


def test_unsupported_options_for_volumes_are_rejected():
    problem = compressed_volume()
    with pytest.raises(ProblemError, match="the blanket reading is for images only"):
        solve(problem, SeilerPrior(conditional="blanket"))
    m = problem.stiffness.copy()
    m[3, 3, 3] = np.inf
    with pytest.raises(ProblemError, match="ratios of stiffness"):
        solve(
            Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m),
            SeilerPrior(),
        )


def test_a_volume_without_a_certain_error_bound_raises_an_error():
    drawn = random_problem(dice_of(0, 176), axes=3)
    with pytest.raises(ConvergenceError, match="no factorization is available"):
        solve(drawn.problem, SeilerPrior(), optimizer=Multigrid(0.01))
