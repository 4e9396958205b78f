"""The paper's prior in three dimensions: its cliques, its schedule, and its converged field."""

import itertools
from functools import partial

import numba
import numpy as np
import pytest
from line_oracle import cliques, field_of_means, weights_of
from random_volumes import random_volume

from napari_hmrf import Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.errors import BackendError, Cancelled, ConvergenceError, ProblemError
from napari_hmrf.solver.backends import SiteRule, host
from napari_hmrf.solver.backends.arrays.seiler import ArraySeilerModel
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.cpu.volume_seiler_model import CpuVolumeSeilerModel
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.model_names import in_words
from napari_hmrf.solver.optimizers import ICM
from napari_hmrf.solver.priors import line_steps, line_weights
from napari_hmrf.solver.quadtree import levels
from tests.support.cancel_flags import During

CUBES, OBLONG = (1.0, 1.0, 1.0), (1.0, 1.7, 0.6)
WITHIN = Multigrid(1e-3)
EXACTLY = ICM(iterations=3000, steps=None, energy_change=1e-9)
STEPS = (1.0, 0.1, 0.01, 0.001)
#: A confidence that stands for none, for problems of which nothing is observed.
NOWHERE = 1e-30


def squeezed(shape=(8, 9, 7), ratio=10.0, spacing=CUBES, seed=0, void=False):
    """Random tissue between two plates, one of which is moved, with some sites held elsewhere."""
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
    return Problem(y, c, m, spacing=spacing)


def off(found, problem):
    """How far a solution is from the direct one at most, in voxels."""
    apart = np.abs(found.displacement - field_of_means(problem))
    return float(apart[problem.tissue].max()) / problem.unit


def at_rest_or_best(problem, prior, d):
    """Where each component would go next: y + soft(q - y, p / 2A), in the unit of the problem."""
    curvature, lowest = prior.site_parabola(problem, d)
    p = prior.limit(problem) * problem.unit
    y = problem.observed.astype(float)
    reach = np.divide(p, 2 * curvature, out=np.full_like(p, np.inf), where=curvature > 0)
    away = lowest - y
    best = y + np.sign(away) * np.maximum(np.abs(away) - reach, 0)
    return np.where(problem.tissue[..., None] & ((curvature > 0) | (p > 0)), best, d)


# The prior


@pytest.mark.parametrize("spacing", [CUBES, OBLONG])
def test_the_energy_is_that_of_all_lines_of_three_sites(spacing):
    problem = squeezed((4, 3, 6), ratio=100, spacing=spacing, void=True)
    d = np.random.default_rng(1).normal(size=problem.observed.shape)
    m, moved = problem.stiffness.astype(float).ravel(), d.reshape(-1, 3) / problem.unit
    total = 0.0
    for s, t, u, weights in cliques(problem):
        first = (m[t] / m[u])[:, None] * (moved[t] - moved[s]) - (moved[u] - moved[t])
        second = (m[t] / m[s])[:, None] * (moved[t] - moved[u]) - (moved[s] - moved[t])
        total += (weights * (first**2 + second**2)).sum()
    prior = SeilerPrior(penalty=2.0)
    y = problem.observed / problem.unit
    held = problem.tissue[..., None] * 2.0 * problem.confidence
    total += (held * np.abs(y - d / problem.unit)).sum()
    assert prior.site_energy(problem, d).sum() == pytest.approx(total, rel=1e-6)


def test_a_site_looks_for_the_least_of_its_own_cliques():
    problem, prior = squeezed((4, 5, 3), ratio=100, void=True), SeilerPrior(penalty=1e-9)
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
def test_the_continuum_does_not_depend_on_the_shape_of_voxels(spacing):
    weights, steps = line_weights(spacing), np.array(line_steps(3)) * spacing
    assert (weights >= 0).all()
    for k in range(3):
        moment = np.einsum("l,li,lj->ij", weights[:, k], steps, steps)
        expected = np.diag(np.where(np.arange(3) == k, 3.0, 2.0))
        np.testing.assert_allclose(3 * moment / moment[k, k], expected, atol=1e-12)
    for step, weight in zip(line_steps(3), weights, strict=True):
        np.testing.assert_allclose(weight, weights_of(step, spacing), atol=1e-12)
    if len(set(spacing)) == 1:
        carried = np.where(np.array(line_steps(3)) == 0, 0, 1)
        np.testing.assert_array_equal(weights, carried)


def test_sites_are_weighted_means_of_their_neighbours_whatever_the_stiffness():
    problem = squeezed((5, 6, 5), ratio=1e6, spacing=OBLONG)
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


def swept(problem, prior, d, steps, sweeps=1):
    """A displacement in voxels after some sweeps, U_total before each, and U_total now."""

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


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
@pytest.mark.parametrize("damping", [1.0, 0.6])
def test_a_sweep_is_that_of_the_equations(shape, ratio, spacing, damping):
    problem = squeezed(shape, ratio, spacing, void=True)
    prior = SeilerPrior(penalty=1e3, damping=damping)
    d = np.random.default_rng(2).normal(size=problem.observed.shape).astype(np.float32)
    d[~problem.tissue] = 0
    moved, before, now = swept(problem, prior, d, ())
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


def best_candidate(problem, prior, d):
    """The literal program: the first of the best of all moves, in voxels; and the site's energy."""
    curvature, lowest = prior.site_parabola(problem, d * problem.unit)
    p = np.where(problem.known & (problem.confidence > NOWHERE), prior.limit(problem), 0)
    y = problem.observed / problem.unit

    def energy(there):
        of_cliques = curvature * (there - lowest / problem.unit) ** 2
        return (of_cliques + p * np.abs(there - y)).sum(axis=-1)

    moves = [e * np.array(way) for e in STEPS for way in itertools.product((0, 1, -1), repeat=3)]
    least, best = energy(d), d
    for move in moves:
        value = energy(d + move)
        best = np.where((value < least)[..., None], d + move, best)
        least = np.minimum(value, least)
    return best * problem.tissue[..., None], least, energy


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_a_site_takes_the_best_of_all_candidates(shape, ratio, spacing):
    problem, prior = squeezed(shape, ratio, spacing, void=True), SeilerPrior(penalty=1e3)
    d = np.random.default_rng(2).normal(size=problem.observed.shape).astype(np.float32)
    d[~problem.tissue] = 0
    moved, _, _ = swept(problem, prior, d, STEPS)
    best, least, energy = best_candidate(problem, prior, d.astype(float))
    # Of two candidates that are equal up to rounding, either may be taken.
    worse = energy(moved.astype(float)) - least
    assert (worse / (energy(d.astype(float)) + 1e-30)).max() < 1e-5
    assert (np.abs(moved - best).max(axis=-1) > 1e-5).mean() < 1e-2


def literally(problem, iterations):
    """The schedule as it is printed, level by level, in NumPy and double precision."""
    d, above, penalty = None, None, SeilerPrior().penalty_for(problem)
    for level in reversed(levels(problem.shape)):
        at = np.ix_(
            *(
                [min((2 * i + 1) * 2**level.number // 2, size - 1) for i in range(sites)]
                for sites, size in zip(level.shape, problem.shape, strict=True)
            )
        )
        y, c, m = (each[at] for each in (problem.observed, problem.confidence, problem.stiffness))
        if above is None:  # the root: a volume of one site there is not, but one beside void
            y, c, m = (np.concatenate([each, 0 * each]) for each in (y, c, m))
        here = np.zeros(y.shape) if above is None else projected(d, above, m)
        for _ in range(iterations):
            on_level = Problem(y, np.maximum(c, NOWHERE), m)
            here, _, _ = best_candidate(on_level, SeilerPrior(penalty=penalty), here)
        if above is None:
            here, m = here[:1], m[:1]
        d, above = here, m
    return d


def projected(coarse, coarse_m, m):
    """Displacement one level down: linear, void without weight, the border repeated."""
    made = np.zeros((*m.shape, 3))
    for site in np.argwhere(m > 0):
        total, moved = 0.0, np.zeros(3)
        for far in itertools.product((0, 1), repeat=3):
            near = [i // 2 + (o if i % 2 else -o) for i, o in zip(site, far, strict=True)]
            at = tuple(
                min(max(i, 0), size - 1) for i, size in zip(near, coarse_m.shape, strict=True)
            )
            weight = 0.75 ** (3 - sum(far)) * 0.25 ** sum(far) * (coarse_m[at] > 0)
            total, moved = total + weight, moved + weight * coarse[at]
        made[tuple(site)] = moved / total if total else 0
    return made


def test_displacement_goes_down_a_level_linearly_and_around_void():
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
        np.testing.assert_allclose(found, projected(coarse, coarse_m, m), atol=1e-6)


def test_the_schedule_is_the_printed_one():
    problem = squeezed((9, 6, 7), void=True)
    one, many = (solve(problem, SeilerPrior(), optimizer=ICM(iterations=n)) for n in (1, 12))
    np.testing.assert_allclose(one.displacement, literally(problem, 1), atol=1e-6)
    # Rounding decides between candidates of equal energy, so single sites part by a small step.
    apart = np.abs(many.displacement - literally(problem, 12))
    assert np.sqrt((apart**2).mean()) < 0.01
    assert (apart > 1e-4).mean() < 0.05


def test_a_schedule_is_the_same_to_the_last_bit_on_one_thread_and_on_many():
    problem = squeezed((24, 20, 26), void=True)
    before, found = numba.get_num_threads(), []
    for threads in (1, numba.config.NUMBA_NUM_THREADS, numba.config.NUMBA_NUM_THREADS):
        compute_thread.submit(partial(numba.set_num_threads, threads)).result()
        found.append(solve(problem, SeilerPrior(), optimizer=ICM(iterations=8)))
    compute_thread.submit(partial(numba.set_num_threads, before)).result()
    for other in found[1:]:
        np.testing.assert_array_equal(other.displacement, found[0].displacement)
        np.testing.assert_array_equal(other.energy, found[0].energy)


def inside(planes):
    """Planes without their ring, the component last."""
    return np.moveaxis(planes[:, 2:-2, 2:-2, 2:-2], 0, -1)


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_the_loops_pull_as_the_energies_say(shape, ratio, spacing):
    problem, prior = squeezed(shape, ratio, spacing, void=True), SeilerPrior()
    d = np.random.default_rng(2).normal(size=problem.observed.shape)
    model = CpuVolumeSeilerModel(prior.material(problem))
    curvature, lowest = prior.site_parabola(problem, d * problem.unit)
    expected = lowest / problem.unit - d
    np.testing.assert_allclose(inside(model.pull(host.planes(d))), expected, atol=1e-9)
    np.testing.assert_allclose(inside(model.steepness), 2 * curvature, rtol=1e-9)
    energy, norm = model.work(host.planes(d))
    total = SeilerPrior(penalty=1e-30).site_energy(problem, d * problem.unit).sum()
    assert energy == pytest.approx(total, rel=1e-9)
    assert norm == pytest.approx(np.linalg.norm(expected))
    _, held = host.prescribed(problem)
    model.hold(held.copy())
    moves = (curvature > 0) & ~problem.known
    np.testing.assert_array_equal(inside(model.moves), moves)
    left = np.where(moves, expected, 0)
    balance = model.balance(host.planes(d), None)
    np.testing.assert_allclose(inside(balance.rest) * balance.unit, left, atol=1e-5)
    level = model.levels[0]
    image = level.vector()
    product = level.apply(level.vector(host.planes(d).astype(np.float32)), image)
    np.testing.assert_allclose(inside(image), -left, atol=1e-5)
    assert product == pytest.approx(-(d * left).sum(), rel=1e-3)


@pytest.mark.parametrize(("shape", "ratio", "spacing"), CASES)
def test_all_levels_are_those_of_their_twins(shape, ratio, spacing):
    problem = squeezed(shape, ratio, spacing, void=True)
    material = SeilerPrior().material(problem)
    loops, arrays = CpuVolumeSeilerModel(material), ArraySeilerModel(material)
    _, held = host.prescribed(problem)
    for model in (loops, arrays):
        model.hold(held.copy())
    draw = np.random.default_rng(3)
    assert len(loops.levels) == len(arrays.levels) > 1
    for ours, theirs in zip(loops.levels, arrays.levels, strict=True):
        for name in ("stiffness", "even", "pins", "inverse", "weight"):
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


def test_smoothing_is_that_of_chebyshev_and_what_is_left_goes_down():
    problem = squeezed((9, 8, 10), void=True)
    model = CpuVolumeSeilerModel(SeilerPrior().material(problem))
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


@pytest.mark.parametrize("spacing", [CUBES, OBLONG])
@pytest.mark.parametrize(("ratio", "void"), [(1, False), (10, True), (1e4, False), (1e4, True)])
def test_the_field_is_that_of_a_direct_solve(ratio, void, spacing):
    problem = squeezed((11, 9, 10), ratio, spacing, void=void)
    found = solve(problem, SeilerPrior(), optimizer=WITHIN)
    assert off(found, problem) <= found.convergence.error <= WITHIN.tolerance
    assert not found.displacement[~problem.tissue].any()


@pytest.mark.parametrize("ratio", [1e2, 1e6])
def test_a_tumour_that_swims_in_soft_tissue_is_found(ratio):
    n = 14
    places = np.moveaxis(np.indices((n, n, n)), 0, -1) * (2 / n) - 1
    m = np.where(np.linalg.norm(places - (0.1, 0.1, 0), axis=-1) < 0.45, ratio, 1.0)
    y, c = np.zeros((n, n, n, 3)), np.ones((n, n, n, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    y[-1, ..., 0] = 1 - np.abs(places[-1, ..., 1])
    problem = Problem(y, c, m)
    found = solve(problem, SeilerPrior(), optimizer=WITHIN)
    assert off(found, problem) <= found.convergence.error <= WITHIN.tolerance


@pytest.mark.parametrize("seed", range(4))
def test_what_is_reported_holds_or_is_refused(seed):
    """Hard tissue: blobs far stiffer than what is around them, void, little that is held."""
    draw = np.random.default_rng(seed)
    shape = tuple(draw.integers(6, 11, 3))
    blobs = np.kron(draw.random((4, 4, 4)), np.ones((3, 3, 3)))[tuple(map(slice, shape))]
    m = np.where(blobs > 0.6, 10 ** draw.uniform(1, 6), 1.0)
    m[blobs < 0.08] = 0
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[draw.random(shape) < 0.02] = c[0] = 1
    y[c > 0] = draw.normal(size=int(c.sum()))
    problem = Problem(y, c, m)
    try:
        found = solve(problem, SeilerPrior(), optimizer=WITHIN)
    except ConvergenceError:
        return
    assert off(found, problem) <= found.convergence.error <= WITHIN.tolerance


def test_what_is_observed_gives_way_where_it_is_pulled_harder_than_its_confidence():
    problem = squeezed((8, 9, 7), ratio=3, spacing=OBLONG, void=True)
    for penalty, slips in ((300.0, True), (10.0, True), (1e6, False)):
        prior = SeilerPrior(penalty=penalty)
        d = solve(problem, prior, optimizer=Multigrid(1e-4)).displacement.astype(float)
        np.testing.assert_allclose(at_rest_or_best(problem, prior, d), d, atol=2e-4)
        curvature = prior.site_parabola(problem, d).curvature
        away = np.abs(d - problem.observed)[problem.known & (curvature > 0)]
        assert (away.max() > 0.01) == slips


def test_an_even_strain_on_the_faces_fills_the_inside():
    for spacing in (CUBES, OBLONG):
        places = np.moveaxis(np.indices((9, 8, 12)), 0, -1) * spacing
        strain = np.array([[0.02, -0.01, 0.03], [0.03, 0.015, 0.01], [-0.02, 0.01, 0.01]])
        c = np.ones((9, 8, 12, 3))
        c[1:-1, 1:-1, 1:-1] = 0
        problem = Problem(places @ strain.T, c, np.full((9, 8, 12), 7.0), spacing=spacing)
        found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-5))
        np.testing.assert_allclose(found.displacement, places @ strain.T, atol=2e-5)
        swept = solve(problem, SeilerPrior(), optimizer=EXACTLY)
        np.testing.assert_allclose(swept.displacement, places @ strain.T, atol=2e-3)


@pytest.mark.parametrize("optimizer", [WITHIN, EXACTLY])
def test_no_axis_is_another(optimizer):
    # A cube of a power of two: the octree itself is not symmetric on other grids.
    problem = squeezed((8, 8, 8), spacing=OBLONG, void=True)
    expected = solve(problem, SeilerPrior(), optimizer=optimizer).displacement
    for turn in [(1, 2, 0), (2, 1, 0)]:
        y, c = (
            each.transpose(*turn, 3)[..., turn] for each in (problem.observed, problem.confidence)
        )
        spacing = tuple(OBLONG[axis] for axis in turn)
        turned = Problem(y, c, problem.stiffness.transpose(turn), spacing=spacing)
        found = solve(turned, SeilerPrior(), optimizer=optimizer).displacement
        np.testing.assert_allclose(found, expected.transpose(*turn, 3)[..., turn], atol=2e-3)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (1.7, 0.6)])
def test_slices_that_are_all_alike_move_as_one_image_does(spacing):
    draw = np.random.default_rng(0)
    m, y, c = 10 ** draw.random((9, 11)), np.zeros((9, 11, 2)), np.zeros((9, 11, 2))
    c[0] = c[-1] = 1
    y[-1] = (0.5, 0.3)
    c[4, 5], y[4, 5] = 0.02, 2
    image = solve(
        Problem(y, c, m, spacing=spacing), SeilerPrior(penalty=100.0), optimizer=Multigrid(1e-4)
    )
    assert np.abs(image.displacement[4, 5] - 2).max() > 0.1  # it slips
    deep, sure = np.zeros((5, 9, 11, 3)), np.zeros((5, 9, 11, 3))
    deep[..., 1:], sure[..., 1:] = y, c
    # Those of the outer slices have fewer cliques, and so less to hold them against.
    sure[[0, -1], 4, 5] = 0
    deep[[0, -1], :, :, 1:], sure[[0, -1], :, :, 1:] = image.displacement, 1
    stack = Problem(deep, sure, np.broadcast_to(m, (5, 9, 11)), spacing=(1.0, *spacing))
    unit = stack.unit**2 / np.prod(spacing)  # what a penalty is measured in
    found = solve(stack, SeilerPrior(penalty=300.0 / unit), optimizer=Multigrid(1e-4))
    for each in found.displacement:
        np.testing.assert_allclose(each[..., 1:], image.displacement, atol=1e-3)
        assert not each[..., 0].any()


def test_only_ratios_of_stiffness_and_lengths_matter():
    problem = squeezed(spacing=OBLONG, void=True)
    for optimizer in (WITHIN, ICM(steps=None)):
        first = solve(problem, SeilerPrior(), optimizer=optimizer).displacement
        inches = Problem(
            problem.observed / 25.4,
            problem.confidence,
            1000 * problem.stiffness,
            spacing=tuple(size / 25.4 for size in OBLONG),
        )
        second = solve(inches, SeilerPrior(), optimizer=optimizer).displacement
        np.testing.assert_allclose(25.4 * second, first, atol=1e-3)


def test_sweeps_end_where_cycles_do():
    # Sweeps leave what no clique is about where coarser levels have put it: hold all faces.
    some = squeezed((10, 9, 8))
    m, c = some.stiffness.copy(), np.ones(some.observed.shape)
    m[4:6, 3:6, 3:5], c[1:-1, 1:-1, 1:-1] = 0, some.confidence[1:-1, 1:-1, 1:-1]
    problem = Problem(some.observed, c, m)
    swept = solve(problem, SeilerPrior(), optimizer=EXACTLY)
    found = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4))
    apart = np.abs(swept.displacement - found.displacement)[problem.tissue]
    assert apart.max() < 2e-3
    assert swept.mean_energy == pytest.approx(found.mean_energy, rel=1e-3)


# Around it


def test_the_papers_schedule_is_the_default_on_an_octree():
    problem = squeezed((9, 6, 12), void=True)
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


@pytest.mark.parametrize(("optimizer", "stage"), [(ICM(), "level 0"), (WITHIN, "cycle 2")])
def test_a_solve_is_cancelled(optimizer, stage):
    with pytest.raises(Cancelled):
        solve(squeezed((24, 24, 24)), SeilerPrior(), optimizer=optimizer, cancel=During(stage))


def test_an_earlier_solution_leaves_less_to_do():
    problem = squeezed((16, 12, 14))
    y = problem.observed.copy()
    y[-1, 3:6, 3:6, 0] += 0.2
    edited = Problem(y, problem.confidence, problem.stiffness)
    cold = solve(edited, SeilerPrior(), optimizer=WITHIN)
    earlier = solve(problem, SeilerPrior(), optimizer=Multigrid(1e-4))
    warm = solve(edited, SeilerPrior(), optimizer=WITHIN, initial=earlier)
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=2e-3)


def test_a_solution_is_saved_and_loaded(tmp_path):
    found = solve(squeezed((5, 6, 7), spacing=OBLONG), SeilerPrior(), optimizer=WITHIN)
    again = Solution.read(found.write(tmp_path / "volume.npz"))
    np.testing.assert_array_equal(again.displacement, found.displacement)
    assert in_words(again.provenance.parameters) == "the paper's prior (centred), converged"


def test_the_smallest_volumes_are_solved():
    for shape in [(2, 2, 2), (3, 1, 1), (2, 3, 9), (1, 4, 5)]:
        c = np.zeros((*shape, 3))
        c[0] = 1
        problem = Problem(c, c, np.ones(shape))
        for optimizer in (ICM(), WITHIN):
            found = solve(problem, SeilerPrior(), optimizer=optimizer)
            np.testing.assert_allclose(found.displacement[0], 1, atol=1e-3)


@pytest.mark.parametrize("optimizer", [ICM(), WITHIN])
def test_shaders_refuse_volumes(optimizer):
    with pytest.raises(BackendError, match='Use backend="cpu"'):
        solve(squeezed(), SeilerPrior(), optimizer=optimizer, backend="opengl")


def test_what_has_no_meaning_is_refused():
    problem = squeezed()
    with pytest.raises(ProblemError, match="the blanket reading is for images only"):
        solve(problem, SeilerPrior(conditional="blanket"))
    m = problem.stiffness.copy()
    m[3, 3, 3] = np.inf
    with pytest.raises(ProblemError, match="ratios of stiffness"):
        solve(Problem(problem.observed, problem.confidence, m), SeilerPrior())


def test_a_volume_that_cycles_are_not_sure_of_is_refused_as_it_has_no_factors():
    y, c, m, spacing, _ = random_volume(6)
    with pytest.raises(ConvergenceError, match="no factorization is available"):
        solve(Problem(y, c, m, spacing=spacing), SeilerPrior(), optimizer=Multigrid(0.01))
