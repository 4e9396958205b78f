"""Compute shaders of elastic volumes, compared with the compiled loops."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from napari_hmrf import (
    BackendError,
    Cancelled,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    SeilerPrior,
    solve,
)
from napari_hmrf.compute.compile_cache import compiler, loops
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.choice import COMPILING, open_backend
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.backends.opengl import backend as opengl_backend
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.opengl.programs.volume_programs import Groups, groups_of
from napari_hmrf.solver.backends.opengl.volumes import volume_level
from napari_hmrf.solver.optimizers.cycle import NEARLY_INCOMPRESSIBLE_VOLUME, chebyshev
from tests.support.linear_levels import (
    Example,
    assert_a_ratio_is_nothing_unless_both_are_positive,
    assert_corrections_come_up_alike,
    assert_loads_go_down_alike,
    assert_same,
    assert_the_coarsest_is_alike,
    cycles,
    host_levels,
    random_example,
    with_levels,
)
from tests.support.opengl import count_looks, left, on_compute_thread, require_opengl

OBLONG = (1.0, 1.7, 0.6)
ELASTIC = ElasticPrior(penalty=np.inf)
STEPS = chebyshev(0.5, 2.0, 3)
#: Wider than a work group, deeper than one, and with one level only.
SHAPES = [(5, 6, 40), (19, 7, 9), (4, 5, 3)]


def volume(shape=(9, 9, 9), prior=ELASTIC, **has):
    return SolveJob(shape, (1.0, 1.0, 1.0), prior, Multigrid(), **has)


@pytest.fixture(autouse=True)
def compute():
    """Skip the tests if there are no compute shaders."""
    require_opengl("compute")


def map_of_ratios(shape):
    return ElasticPrior((0.499 * np.random.default_rng(3).random(shape)).astype(np.float32))


@pytest.fixture(params=[*SHAPES, "map"], ids=str)
def given(request) -> Example:
    """Return random tissue with holes and a tenth of its sites fixed, also with a Poisson map."""
    if request.param == "map":
        shape = (8, 9, 7)
        return random_example(shape, map_of_ratios(shape), OBLONG, 10.0)
    return random_example(request.param, ElasticPrior(0.45), OBLONG, 10.0)


def both_models(given: Example, job):
    """Return the results of a job with the model of the loops and with that of the shaders."""

    def both():
        answers = []
        for backend in (CpuBackend(lambda: None), OpenGLBackend(lambda: None, "compute")):
            try:
                answers.append(job(given.model(backend)))
            finally:
                backend.close()
        return answers

    return on_compute_thread(both)


def random_field(given: Example):
    return host.planes(np.random.default_rng(5).normal(size=(*given.problem.shape, 3)))


# Each kernel -----------------------------------------------------------------------------------


def test_all_levels_match_the_loops(given):
    hosts = host_levels(given)
    for number, host_level in enumerate(hosts):
        ones = np.where(host_level.inverse > 0, 1, 0).astype(np.float32)

        def job(level, _, ones=ones):
            """Return the correction and the forces of a unit load."""
            level.load, image = level.vector(ones.copy()), level.vector()
            level.descend(STEPS[:1], None)
            level.apply(level.load, image)
            return [level.planes(level.correction).copy(), level.planes(image).copy()]

        loops, shaders = with_levels("compute", given, job, number)
        assert_same(shaders[:1], loops[:1], 1e-6)
        assert_same(shaders[1:], loops[1:])


def test_properties_of_the_tissue_match_the_loops(given):
    def job(model):
        return [model.steepness, model.moves.astype(float)]

    loops, shaders = both_models(given, job)
    assert_same(shaders[:1], loops[:1], 1e-6)
    np.testing.assert_array_equal(shaders[1], loops[1])


def test_the_residual_in_double_precision_matches_the_prior(given):
    d = random_field(given)

    def job(model):
        balance = model.balance(d, None)
        rest = model.levels[0].planes(model.levels[0].vector(balance.rest))
        return balance.unit * rest, balance.norm, balance.most, *model.work(d), model.pull(d)

    loops, shaders = both_models(given, job)
    assert_same(shaders[:1], loops[:1], 1e-7)
    assert shaders[1:-1] == pytest.approx(loops[1:-1], rel=1e-7)
    in_lengths = given.problem.unit * np.moveaxis(d[:, 2:-2, 2:-2, 2:-2], 0, -1)
    exact = -given.prior.forces(given.problem, in_lengths)
    moves = ~given.problem.known & given.problem.tissue[..., None]
    assert_same([shaders[0]], [host.planes(np.where(moves, exact, 0))], 1e-6)
    assert_same([shaders[-1]], [host.planes(exact)], 1e-6)
    assert shaders[3] == pytest.approx(given.prior.energy(given.problem, in_lengths), rel=1e-6)


def test_tiny_displacements_have_the_same_relative_accuracy(given):
    d = 1e-20 * random_field(given)
    loops, shaders = both_models(given, lambda model: model.balance(d, None)[2:])
    assert shaders == pytest.approx(loops, rel=1e-6)


def test_shaders_restrict_residuals_like_the_loops(given):
    choices = STEPS[:1], STEPS[:2], STEPS
    assert_loads_go_down_alike("compute", given, choices, again=True)


def test_shaders_interpolate_corrections_like_the_loops(given):
    assert_corrections_come_up_alike("compute", given, STEPS)


@pytest.mark.parametrize("sites", [128, 0])
def test_the_coarsest_level_runs_its_steps_fused_or_one_by_one(given, sites, monkeypatch):
    monkeypatch.setattr(volume_level, "SITES", sites)
    assert_the_coarsest_is_alike("compute", given, lambda level, steps: level.finish((), steps))


def test_a_conjugate_gradient_step_matches_the_loops(given):
    (host_level, *_) = host_levels(given)
    first = [given.planes(host_level) for _ in range(4)]

    def job(level, _):
        found, rest, direction, steepest = (level.vector(each.copy()) for each in first)
        image = level.vector()
        slope = level.product(steepest, rest)
        square = level.product(rest, rest)
        share = level.ratio(square, level.largest(steepest))
        level.turn(steepest, direction, share)
        curvature = level.apply(direction, image)
        after = level.advance(found, rest, direction, image, level.ratio(square, curvature))
        most, product = level.weigh(rest, found)
        scalars = level.read(square, share, curvature, after, most, product, slope)
        vectors = [level.planes(each).copy() for each in (found, rest, direction, image)]
        return [*(np.array([each]) for each in scalars), *vectors]

    loops, shaders = with_levels("compute", given, job)
    assert_same(shaders[:5] + shaders[7:], loops[:5] + loops[7:])
    scale = np.sqrt(loops[0] * (first[3] ** 2).sum())  # the product may be near 0
    assert abs(shaders[6] - loops[6]) < 1e-5 * scale


def test_a_ratio_is_zero_unless_both_operands_are_positive():
    given = random_example((4, 5, 6), ElasticPrior(0.3), OBLONG)
    assert_a_ratio_is_nothing_unless_both_are_positive("compute", given)


@pytest.mark.parametrize("of_void", [0, 20])
def test_sums_and_maxima_include_every_site(of_void):
    m = np.ones((37, 5, 70))
    m[:of_void, :, :33] = 0  # whole work groups
    held = np.zeros((*m.shape, 3))
    held[-1, 0, 0, 0] = 1
    given = Example(Problem(observed=0 * held, confidence=held, stiffness=m), ElasticPrior(0.3))
    (host_level, *_) = host_levels(given)
    ones = (host_level.planes(host_level.inverse) > 0).astype(np.float32)
    peak = ones.copy()
    peak[1, -3, -3, -3] = -7

    def job(level, _):
        flat, peaked = level.vector(ones.copy()), level.vector(peak.copy())
        sums = level.product(flat, flat), level.product(flat, peaked)
        return level.read(*sums, level.largest(peaked))

    count = 3 * np.count_nonzero(m) - 1
    for numbers in with_levels("compute", given, job):
        assert numbers == (count, count - 8, 7)


@pytest.mark.parametrize("count", [1, 255, 70_001])
def test_a_cleared_buffer_contains_only_zeros(count):
    def job():
        device = the_device()
        buffer = device.buffer(4 * count)
        device.write_buffer(buffer, np.ones(count, np.float32))
        device.clear_buffer(buffer)
        device.finish()
        found = np.frombuffer(buffer.read(), np.float32)
        device.free([buffer])
        return found

    assert not on_compute_thread(job).any()


def test_a_cycle_matches_the_loops():
    given = random_example((17, 14, 21), ElasticPrior(0.45), OBLONG)
    loops, shaders = cycles("compute", given, NEARLY_INCOMPRESSIBLE_VOLUME)
    assert_same(shaders, loops, 3e-5)
    np.testing.assert_array_equal(*shaders)


def test_the_depth_of_a_work_group_does_not_change_the_result(monkeypatch):
    given = random_example((19, 7, 9), ElasticPrior(0.45), OBLONG)
    (host_level, *_) = host_levels(given)
    load = given.planes(host_level)

    def job(level, coarse):
        level.load = level.vector(load.copy())
        level.descend(STEPS, coarse)
        return level.planes(level.correction).copy()

    found = []
    for planes in (16, 5, 1):
        monkeypatch.setattr(volume_level, "groups_of", lambda grid, _, n=planes: Groups(grid, n))
        found.append(with_levels("compute", given, job)[1])
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_work_groups_are_small_on_a_gpu_and_large_on_a_software_renderer():
    for size, planes in ((256, 8), (128, 8), (64, 4), (33, 1), (5, 1)):
        assert groups_of((size,) * 3, software=False).planes == planes
        assert groups_of((size,) * 3, software=True).planes == 8
    assert groups_of((33, 33, 33), software=False).count == 33 * 9 * 2


# Whole solves ----------------------------------------------------------------------------------


def pressed(n, free, seed=0):
    """Return random tissue with a hole between two plates; the other sides are free or fixed."""
    draw = np.random.default_rng(seed)
    m = 10 ** draw.random((n, n, n))
    m[n // 4 : n // 2, n // 3 : n // 2, n // 4 :] = 0
    y, c = np.zeros((n, n, n, 3)), np.zeros((n, n, n, 3))
    if not free:
        c[:, [0, -1]] = c[:, :, [0, -1]] = 1
    c[[0, -1]] = 1
    y[-1] = np.array((1.0, 0.5, -0.3)) * OBLONG
    return Problem(observed=y, confidence=c, stiffness=m, spacing=OBLONG)


@pytest.mark.parametrize(
    ("poisson", "free"), [pytest.param(0.3, False, marks=pytest.mark.campaign), (0.45, True)]
)
def test_the_field_of_a_volume_matches_the_loops(poisson, free):
    problem, prior = pressed(16, free), ElasticPrior(poisson)
    ours, theirs = (
        solve(problem, prior, optimizer=Multigrid(1e-3), backend=name) for name in ("opengl", "cpu")
    )
    assert ours.provenance.backend == "opengl:compute"
    assert ours.iterations == theirs.iterations
    assert ours.convergence.error == pytest.approx(theirs.convergence.error, rel=0.05)
    assert ours.convergence.residual == pytest.approx(theirs.convergence.residual, rel=0.05)
    np.testing.assert_allclose(ours.energy, theirs.energy, rtol=1e-5)
    assert_same([ours.displacement], [theirs.displacement])


def test_a_poisson_map_matches_the_loops():
    problem = pressed(9, True)
    poisson = map_of_ratios(problem.shape).poisson.copy()
    poisson[~problem.tissue] = np.nan  # values in void have no effect
    prior = ElasticPrior(poisson)
    ours, theirs = (solve(problem, prior, backend=name) for name in ("opengl", "cpu"))
    assert_same([ours.displacement], [theirs.displacement])


def test_a_warm_start_needs_no_iterations_unless_the_tissue_changed():
    problem, prior = pressed(12, True), ElasticPrior(0.3)
    first = solve(problem, prior, backend="opengl")
    assert solve(problem, prior, backend="opengl", initial=first).iterations == 0
    other = solve(pressed(12, True, seed=1), prior, backend="opengl", initial=first)
    cold = solve(pressed(12, True, seed=1), prior, backend="cpu")
    assert other.iterations > 0
    np.testing.assert_allclose(other.displacement, cold.displacement, atol=2e-3)


def test_an_iteration_allocates_nothing_and_a_solve_frees_all_memory(made):
    problem, counts = pressed(12, True), []

    def count(monitor):
        if "cycle" in monitor.message:
            counts.append(left(made))

    def job():
        return solve(problem, backend="opengl", progress=count)

    first = on_compute_thread(job)
    assert len(counts) > 2
    assert len(set(counts)) == 1
    assert left(made) == 0
    np.testing.assert_array_equal(on_compute_thread(job).displacement, first.displacement)


def test_a_cancelled_solve_frees_all_memory(made, every_pass_a_batch):
    def count_batches(stop_at=None):
        prior = ElasticPrior(0.3)
        return count_looks("compute", Multigrid(0.1), pressed(9, True), prior, stop_at)

    looks = count_batches()
    assert looks > 10
    for where in (0.0, 0.5, 0.999):
        with pytest.raises(Cancelled):
            count_batches(stop_at=int(where * looks))
        assert made
        assert left(made) == 0


def test_splitting_a_pass_into_strips_does_not_change_the_result(monkeypatch):
    problem = pressed(12, True)
    whole = solve(problem, ElasticPrior(0.3), backend="opengl").displacement
    monkeypatch.setattr(opengl_backend, "BATCH_SECONDS", 1e-6)
    cut = solve(problem, ElasticPrior(0.3), backend="opengl").displacement
    np.testing.assert_array_equal(cut, whole)


# Errors and the choice of the backend ----------------------------------------------------------


def test_a_volume_beyond_the_limit_is_rejected_before_any_allocation(made, monkeypatch):
    monkeypatch.setattr(on_compute_thread(the_device), "largest_buffer", 16 * 2**10)
    with pytest.raises(
        BackendError, match=r"12 x 12 x 12 voxels.*has buffers of.*Downsample or crop"
    ):
        solve(pressed(12, True), backend="opengl")
    assert left(made) == 0


def test_a_driver_with_too_few_buffers_is_rejected(monkeypatch):
    monkeypatch.setattr(on_compute_thread(the_device), "most_buffers", 8)
    with pytest.raises(
        BackendError, match=r"8 storage buffers .* need 16. Use .*`backend=\"cpu\"`"
    ):
        solve(pressed(12, True), backend="opengl")


def test_fragment_shaders_reject_volumes():
    with pytest.raises(
        BackendError, match=r"`backend=\"opengl:compute\"`\) or .*`backend=\"cpu\"`"
    ):
        solve(pressed(12, True), backend="opengl:fragment")


UNSUPPORTED = {
    "large motion": SolveJob((9, 9), (1.0, 1.0), NeoHookeanPrior(), Multigrid()),
    "volumes with the paper's prior": volume(prior=SeilerPrior()),
    "volumes with loads": volume(has_loads=True),
    "volumes with rigid tissue": volume(has_rigid_tissue=True),
    "volumes in which tissue may slip": volume(prior=ElasticPrior(penalty=1.0)),
}


@pytest.mark.parametrize("kind", UNSUPPORTED)
def test_shaders_name_the_problems_that_only_the_loops_solve(kind):
    job = UNSUPPORTED[kind]

    def answers():
        shaders, loops = OpenGLBackend(lambda: None), CpuBackend(lambda: None)
        said = shaders.supports(job), loops.supports(job)
        shaders.close()
        return said, open_backend(job, "auto", lambda: None).reason

    (refusal, none), reason = on_compute_thread(answers)
    assert refusal == f'only the compiled loops solve {kind}. Use them (`backend="cpu"`).'
    assert none is None
    assert reason == f"only the compiled loops solve {kind}"
    with pytest.raises(BackendError, match=f"solve {kind}, not opengl. Use"):
        on_compute_thread(lambda: open_backend(job, "opengl", lambda: None))


def test_auto_solves_a_volume_on_a_gpu_unless_it_is_too_large(monkeypatch):
    monkeypatch.setattr(
        "napari_hmrf.solver.backends.opengl.is_software_renderer", lambda renderer: False
    )

    def choice(**has):
        backend, reason = open_backend(volume(**has), "auto", lambda: None)
        backend.close()
        return backend.name, reason

    assert on_compute_thread(choice) == ("opengl:compute", "a GPU is available")
    monkeypatch.setattr(on_compute_thread(the_device), "largest_buffer", 1000)
    name, reason = on_compute_thread(choice)
    assert name == "cpu"
    assert "do not support this volume" in reason
    assert on_compute_thread(lambda: choice(has_loads=True))[0] == "cpu"


def test_an_image_beyond_the_limit_of_a_gpu_is_solved_by_the_loops(monkeypatch):
    monkeypatch.setattr(on_compute_thread(the_device), "largest", 8)
    image = SolveJob((9, 4), (1.0, 1.0), ELASTIC, Multigrid())
    backend, reason = on_compute_thread(lambda: open_backend(image, "auto", lambda: None))
    assert backend.name == "cpu"
    assert reason.startswith("the shaders do not support this image (the image has 9 x 4 pixels")


def test_a_software_renderer_solves_volumes_until_the_loops_are_compiled(monkeypatch):
    if not on_compute_thread(the_device).software:
        pytest.skip("this is a GPU")
    wanted, waited = [], []
    monkeypatch.setattr(compiler, "request", wanted.append)

    def choice(voxels=(9, 9, 9)):
        provide_loops = partial(waited.append, 1)
        backend, reason = open_backend(volume(voxels), "auto", lambda: None, provide_loops)
        backend.close()
        return backend.name, reason

    monkeypatch.setattr(loops, "ready_for_volumes", lambda: False)
    assert on_compute_thread(choice) == ("opengl:compute", COMPILING)
    assert (wanted, waited) == (["volume"], [])
    large = on_compute_thread(lambda: choice((101, 100, 100)))
    assert large[0] == "cpu", "large volumes should wait for the compiler"
    assert waited.pop() == 1
    monkeypatch.setattr(loops, "ready_for_volumes", lambda: True)
    name, reason = on_compute_thread(choice)
    assert name == "cpu"
    assert "software only" in reason
    assert (wanted, waited) == (["volume"], [1])


def test_an_opengl_error_during_allocation_ends_the_solve(monkeypatch):
    device = on_compute_thread(the_device)
    monkeypatch.setattr(type(device.ctx), "error", "GL_OUT_OF_MEMORY", raising=True)
    with pytest.raises(BackendError, match="GL_OUT_OF_MEMORY"):
        solve(pressed(12, True), backend="opengl")
    monkeypatch.undo()
    solve(pressed(12, True), backend="opengl")  # with a new context


@pytest.mark.parametrize("kind", ["rigid", "slips"])
def test_rigid_or_slipping_tissue_is_solved_by_the_loops(kind):
    problem = pressed(8, True)
    m = problem.stiffness.copy()
    m[5, 5, 2:4] = np.inf
    if kind == "rigid":
        problem = Problem(
            observed=problem.observed, confidence=problem.confidence, stiffness=m, spacing=OBLONG
        )
    prior = ElasticPrior(0.3, penalty=np.inf if kind == "rigid" else 0.5)
    kind = "rigid tissue" if kind == "rigid" else "may slip"
    with pytest.raises(BackendError, match=f"compiled loops solve volumes .*{kind}, not opengl"):
        solve(problem, prior, backend="opengl")
    assert solve(problem, prior, backend="auto").provenance.backend == "cpu"
