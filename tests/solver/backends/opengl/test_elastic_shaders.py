"""Multigrid shaders of elastic tissue, compared with the compiled loops."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import BackendError, Cancelled, ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.optimizers.cycle import STRETCHING, Cycle, chebyshev
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
    torn,
    with_levels,
)
from tests.support.opengl import count_looks, left, on_compute_thread, require_opengl

#: Odd, even, prime, two sites wide, small enough to be the only level.
SHAPES = [(31, 37), (64, 48), (2, 9), (101, 7), (4, 5)]
SPACINGS = [(1.0, 1.0), (2.0, 0.5)]
PRIORS = [ElasticPrior(0.3), ElasticPrior(0.499, plane="strain")]
#: All shapes, with pairwise combinations of contrasts, pixel sizes and priors.
CASES = [
    ((31, 37), 4.0, SPACINGS[0], PRIORS[0]),
    ((31, 37), 1e4, SPACINGS[1], PRIORS[0]),
    ((64, 48), 1e4, SPACINGS[0], PRIORS[1]),
    ((101, 7), 4.0, SPACINGS[1], PRIORS[1]),
    ((2, 9), 1e4, SPACINGS[1], PRIORS[0]),
    ((4, 5), 4.0, SPACINGS[1], PRIORS[1]),
]
STEPS = chebyshev(0.5, 2.0, 3)
COARSELY = Multigrid(0.1)


@pytest.fixture
def equal_visits(monkeypatch):
    """Make shaders visit small levels as often as the loops do."""
    from napari_hmrf.solver.backends.opengl.images import relaxing

    monkeypatch.setattr(relaxing, "WORTH_AGAIN", 0)


def example(shape, prior=PRIORS[0], spacing=(1.0, 1.0), ratio=4.0) -> Example:
    return random_example(shape, prior, spacing, ratio)


# Each step -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "ratio", "spacing", "prior"), CASES)
def test_shaders_restrict_residuals_like_the_loops(stage, shape, ratio, spacing, prior):
    given = example(shape, prior, spacing, ratio)
    assert_loads_go_down_alike(stage, given, (STEPS[:1], STEPS[:2], STEPS))


@pytest.mark.parametrize(("shape", "ratio", "spacing", "prior"), CASES[:-1])
def test_shaders_interpolate_corrections_like_the_loops(stage, shape, ratio, spacing, prior):
    assert_corrections_come_up_alike(stage, example(shape, prior, spacing, ratio), STEPS)


def test_fused_steps_on_the_coarsest_level_equal_single_steps(stage):
    given = example((31, 37), PRIORS[1])
    assert_the_coarsest_is_alike(stage, given, lambda level, steps: level.descend(steps, None))


@pytest.mark.parametrize(
    ("shape", "prior"), list(zip(SHAPES, [*PRIORS, *PRIORS, PRIORS[0]], strict=True))
)
def test_a_conjugate_gradient_step_matches_the_loops(stage, shape, prior):
    given = example(shape, prior, (1.0, 2.0))
    (host, *_) = host_levels(given)
    first = [given.planes(host) for _ in range(4)]

    def job(level, _):
        found, rest, direction, steepest = (level.vector(each.copy()) for each in first)
        image = level.vector()
        slope = level.product(steepest, rest)
        square = level.product(rest, rest)
        share = level.ratio(square, level.largest(steepest))
        level.turn(steepest, direction, share)
        curvature = level.apply(direction, image)
        left = level.advance(found, rest, direction, image, level.ratio(square, curvature))
        scalars = level.read(slope, square, share, curvature, left, level.largest(rest))
        return [np.array([each]) for each in scalars] + [
            level.planes(vector).copy() for vector in (found, rest, direction, image)
        ]

    loops, shaders = with_levels(stage, given, job)
    assert_same(shaders[1:], loops[1:])
    scale = np.sqrt(loops[1] * (first[3] ** 2).sum())  # the product may be near 0
    assert abs(shaders[0] - loops[0]) < 1e-5 * scale


def test_a_ratio_is_zero_unless_both_operands_are_positive(stage):
    assert_a_ratio_is_nothing_unless_both_are_positive(stage, example((9, 8)))


@pytest.mark.parametrize("shape", [(1200, 3), (65, 131), (600, 2), (4, 5)])
def test_sums_and_maxima_include_every_site(stage, shape):
    held = np.zeros((*shape, 2))
    held[0, 0] = 1
    given = Example(Problem(0 * held, held, np.ones(shape)), PRIORS[0])
    sites = np.zeros((2, shape[0] + 4, shape[1] + 4), np.float32)
    sites[:, 2:-2, 2:-2] = 1
    peak = sites.copy()
    peak[1, -3, -3] = -7

    def job(level, _):
        ones, peaked = level.vector(sites.copy()), level.vector(peak.copy())
        numbers = level.product(ones, ones), level.product(ones, peaked), level.largest(peaked)
        return level.read(*numbers)

    count = 2 * shape[0] * shape[1]
    for numbers in with_levels(stage, given, job):
        assert numbers == (count, count - 8, 7)


def test_a_cycle_matches_the_loops(stage, equal_visits):
    given = example((70, 55), PRIORS[1], (1.0, 1.5))
    loops, shaders = cycles(stage, given, STRETCHING)
    assert_same(shaders, loops, 3e-5)
    np.testing.assert_array_equal(*shaders)


# Whole solves ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("prior", "ratio", "spacing"),
    [
        (ElasticPrior(0.0), 1e4, (1.0, 1.0)),
        (ElasticPrior(0.45), 1e4, (1.0, 1.0)),
        (ElasticPrior(0.45), 1e4, (2.0, 0.5)),
        (ElasticPrior(0.45, plane="strain"), 10.0, (1.0, 1.5)),
        (ElasticPrior(0.499, plane="strain"), 1.0, (1.0, 1.0)),
    ],
)
def test_the_field_of_torn_tissue_matches_the_loops(stage, prior, ratio, spacing, equal_visits):
    problem = torn(ratio=ratio, spacing=spacing)
    loops = solve(problem, prior, optimizer=Multigrid(5e-4), backend="cpu")
    shaders = solve(problem, prior, optimizer=Multigrid(5e-4), backend=f"opengl:{stage}")
    off = np.abs(shaders.displacement - loops.displacement) / np.array(spacing)
    assert off.max() < 2e-3
    assert (shaders.displacement[~problem.tissue] == 0).all()
    assert shaders.mean_energy == pytest.approx(loops.mean_energy, rel=1e-4)
    if loops.convergence.way == "cycles":
        assert abs(shaders.iterations - loops.iterations) <= max(2, loops.iterations // 4)


@pytest.mark.parametrize("name", ["expansion", "mass-effect", "bar"])
def test_the_field_of_a_phantom_matches_the_loops(stage, name, equal_visits):
    problem = phantom(name, 100).problem
    loops = solve(problem, ElasticPrior(), backend="cpu")
    shaders = solve(problem, ElasticPrior(), backend=f"opengl:{stage}")
    assert np.abs(shaders.displacement - loops.displacement).max() < 2e-3
    assert shaders.iterations == loops.iterations


def test_slipping_observations_and_a_poisson_map_match_the_loops(stage):
    problem = torn(ratio=5.0)
    graded = np.linspace(0.1, 1, problem.shape[0])[:, None, None] * problem.confidence
    problem = Problem(problem.observed, graded, problem.stiffness)
    poisson = np.where(problem.stiffness > 1, 0.2, 0.45)
    prior = ElasticPrior(poisson, penalty=0.03)
    loops = solve(problem, prior, optimizer=Multigrid(5e-4), backend="cpu")
    shaders = solve(problem, prior, optimizer=Multigrid(5e-4), backend=f"opengl:{stage}")
    slipped = np.abs(loops.displacement - problem.observed)[problem.confidence > 0] > 0.01
    assert 0.05 < slipped.mean() < 0.95
    assert np.abs(shaders.displacement - loops.displacement).max() < 2e-3


def test_a_warm_start_reduces_the_iterations(stage):
    backend = f"opengl:{stage}"
    first = solve(torn(4.0), ElasticPrior(), backend=backend)
    again = solve(torn(4.0), ElasticPrior(), backend=backend, initial=first)
    assert again.iterations < first.iterations / 3
    assert np.abs(again.displacement - first.displacement).max() < 4e-3


def test_the_same_solve_gives_the_same_bits(stage):
    first, second = (solve(torn(4.0), ElasticPrior(), backend=f"opengl:{stage}") for _ in range(2))
    np.testing.assert_array_equal(first.displacement, second.displacement)


def test_changed_constraints_leave_no_trace_of_earlier_ones(stage):
    given = example((33, 41))
    other = example((33, 41))
    other.problem = Problem(
        given.problem.observed,
        np.roll(given.problem.confidence, 5, axis=0),
        given.problem.stiffness,
    )

    def fields(*held):
        backend = OpenGLBackend(lambda: None, stage)
        try:
            model = given.model(backend)
            finest, cycle = model.levels[0], Cycle(model)
            for mask in held:
                planes = np.zeros((2, 37, 45), bool)
                planes[:, 2:-2, 2:-2] = np.moveaxis(mask > 0, -1, 0)
                model.hold(planes)
                load = np.where(planes, 0, 1).astype(np.float32)
                load[:, 2:-2, 2:-2] *= given.problem.tissue
                corrected = finest.planes(cycle.run(finest.vector(load))).copy()
            return corrected
        finally:
            backend.close()

    masks = given.problem.confidence, other.problem.confidence
    twice, once = (on_compute_thread(lambda h=h: fields(*h)) for h in (masks, masks[1:]))
    np.testing.assert_array_equal(twice, once)
    assert not twice[:, 2:-2, 2:-2][np.moveaxis(masks[1] > 0, -1, 0)].any()


# Memory and cancellation -----------------------------------------------------------------------


def test_an_iteration_allocates_nothing(stage, made):
    given = example((70, 55))
    (host, *_) = host_levels(given)
    load = given.planes(host)

    def job():
        backend = OpenGLBackend(lambda: None, stage)
        try:
            model = given.model(backend)
            level, cycle = model.levels[0], Cycle(model)
            counts = []
            rest, found, direction, image = level.vector(load), *(level.vector() for _ in "123")
            for _ in range(6):
                steepest = cycle.run(rest)
                slope = level.product(steepest, rest)
                level.turn(steepest, direction, slope)
                curvature = level.apply(direction, image)
                length = level.ratio(slope, curvature)
                level.read(level.advance(found, rest, direction, image, length), length)
                counts.append(len(made))
            return counts
        finally:
            backend.close()

    counts = on_compute_thread(job)
    assert counts[3:] == [counts[3]] * 3
    assert left(made) == 0


def _count_batches(stage: str, stop_at: int | None = None) -> int:
    """Solve, cancel at a given check, and return the number of checks."""
    return count_looks(stage, COARSELY, torn(4.0), ElasticPrior(), stop_at)


@pytest.mark.parametrize("where", [0.0, 0.5, 0.999])
def test_a_cancelled_solve_frees_memory_and_does_not_affect_the_next(
    stage, made, where, every_pass_a_batch
):
    backend = f"opengl:{stage}"
    before = solve(torn(4.0), ElasticPrior(), optimizer=COARSELY, backend=backend)
    looks = _count_batches(stage)
    assert looks > 10 * before.iterations
    with pytest.raises(Cancelled):
        _count_batches(stage, stop_at=int(where * looks))
    assert left(made) == 0
    after = solve(torn(4.0), ElasticPrior(), optimizer=COARSELY, backend=backend)
    np.testing.assert_array_equal(after.displacement, before.displacement)
    assert left(made) == 0


def test_splitting_a_pass_into_strips_does_not_change_the_result(stage, monkeypatch):
    from napari_hmrf.solver.backends.opengl import backend
    from napari_hmrf.solver.backends.opengl.programs import regions

    whole = solve(torn(4.0), ElasticPrior(), backend=f"opengl:{stage}").displacement
    monkeypatch.setattr(backend, "MAX_PASS_SECONDS", 1e-4)
    monkeypatch.setattr(backend, "BATCH_SECONDS", 1e-4)
    monkeypatch.setattr(regions, "_ACROSS", 2)
    cut = solve(torn(4.0), ElasticPrior(), backend=f"opengl:{stage}").displacement
    np.testing.assert_array_equal(cut, whole)


def test_an_image_beyond_the_limit_is_rejected_before_any_allocation(made, monkeypatch):
    monkeypatch.setattr(on_compute_thread(the_device), "largest", 60)
    with pytest.raises(BackendError, match=r"45 x 61 pixels, but .* at most 60 x 60"):
        solve(torn(4.0), ElasticPrior(), backend="opengl")
    assert left(made) == 0


# A wrong shader --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "right", "wrong"),
    [
        pytest.param(
            "elements",
            "f01 += cols - rows - twist",
            "f01 += cols - rows + twist",
            marks=pytest.mark.campaign,
        ),
        pytest.param(
            "elements",
            "shape[2] * lame.x * cols.y",
            "shape[2] * lame.y * cols.y",
            marks=pytest.mark.campaign,
        ),
        pytest.param(
            "elements", "min(pair.x, pair.y) < 0", "pair.x < -1", marks=pytest.mark.campaign
        ),
        pytest.param(
            "forces", "force[1] += carried[1]", "force[1] -= carried[1]", marks=pytest.mark.campaign
        ),
        (
            "smooth",
            "momentum * texelFetch(last, at, 0)",
            "momentum * texelFetch(displacement, at, 0)",
        ),
        ("interpolation", "row[0] = 0.25 * (before + on)", "row[0] = 0.25 * (before + after)"),
        ("interpolation", "odd ? first.xy : first.zw", "odd ? first.zw : first.xy"),
        ("restrict", "(first.zw + second.zw)", "(first.zw + second.xy)"),
        pytest.param(
            "restrict",
            "in_image(pair, size) ? rest : vec4(0.0)",
            "rest",
            marks=pytest.mark.campaign,
        ),
        ("restrict", "half_above = next", "half_above = middle"),
        ("apply", "share = dot(image,", "share = 1.01 * dot(image,"),
    ],
)
def test_a_wrong_sign_or_border_in_a_shader_is_detected(monkeypatch, file, right, wrong):
    from napari_hmrf.solver.backends.opengl.programs import source

    require_opengl("compute")
    text = source._text

    def broken(name):
        if name != file:
            return text(name)
        assert right in text(name)
        return text(name).replace(right, wrong)

    monkeypatch.setattr(source, "_text", broken)
    given = example((33, 47), ElasticPrior(0.4), (1.0, 1.5))
    hosts = host_levels(given)
    load, coarse_load = given.planes(hosts[0]), given.planes(hosts[1])
    assert hosts[1].grid[0] > 8  # an invocation of the coarse level then has rows below it

    def job(level, coarse):
        level.load = level.vector(load.copy())
        level.descend(STEPS, coarse)
        given_down = np.where(hosts[1].inverse > 0, coarse.planes(coarse.load), 0)
        coarse.correction = coarse.vector(coarse_load.copy())
        level.ascend(STEPS, coarse)
        image = level.vector()
        work = level.apply(level.correction, image)
        return [level.planes(level.correction).copy(), given_down, np.array(level.read(work))]

    device = on_compute_thread(the_device)
    monkeypatch.setattr(device, "_programs", {})
    monkeypatch.setattr(device, "rows", 4)
    loops, shaders = with_levels("compute", given, job)
    with pytest.raises(AssertionError):
        assert_same(shaders, loops)
