"""Multigrid shaders of the paper's prior, compared with the compiled loops."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from napari_hmrf import Cancelled, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.opengl import OpenGLBackend, is_software_renderer
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.opengl.images.seiler import GLSeilerModel
from napari_hmrf.solver.optimizers import refinement
from napari_hmrf.solver.optimizers.cycle import AVERAGING, BENDING, Cycle, chebyshev
from tests.support.linear_levels import (
    Example,
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

#: Odd, even, two sites wide, small enough to be the only level.
SHAPES = [(31, 37), (64, 48), (2, 9), (4, 5)]
SPACINGS = [(1.0, 1.0), (2.0, 0.5)]
CENTRED, BLANKET = SeilerPrior(), SeilerPrior(conditional="blanket")
#: All shapes, with pairwise combinations of contrasts, pixel sizes and conditionals.
CASES = [
    ((31, 37), 4.0, SPACINGS[0], CENTRED),
    ((31, 37), 4.0, SPACINGS[1], BLANKET),
    pytest.param((64, 48), 1e3, SPACINGS[0], BLANKET, marks=pytest.mark.campaign),
    pytest.param((64, 48), 1e3, SPACINGS[1], CENTRED, marks=pytest.mark.campaign),
    ((2, 9), 4.0, SPACINGS[1], CENTRED),
    ((2, 9), 1e3, SPACINGS[0], BLANKET),
    ((4, 5), 1e3, SPACINGS[1], BLANKET),
]
STEPS = chebyshev(0.5, 2.0, 3)

readings = pytest.mark.parametrize("prior", [CENTRED, BLANKET], ids=["centred", "blanket"])


def whole_solves(of_blanket: str):
    """Return a decorator that runs two combinations of stage and reading; the rest are campaigns.

    Parameters
    ----------
    of_blanket : str
        Stage that solves the blanket reading; the other stage solves the centred reading.
    """
    cases = [
        pytest.param(
            stage,
            prior,
            id=f"{stage}-{prior.conditional}",
            marks=() if (stage == of_blanket) == (prior is BLANKET) else pytest.mark.campaign,
        )
        for stage in ("fragment", "compute")
        for prior in (CENTRED, BLANKET)
    ]
    return pytest.mark.parametrize(("stage", "prior"), cases, indirect=["stage"])


@pytest.fixture
def by_cycles(monkeypatch):
    """Make a software renderer solve by cycles, where it would use a factorization."""
    monkeypatch.setattr(GLSeilerModel, "slow", False)


# Each step -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "ratio", "spacing", "prior"), CASES)
def test_shaders_restrict_residuals_like_the_loops(stage, shape, ratio, spacing, prior):
    given = random_example(shape, prior, spacing, ratio)
    assert_loads_go_down_alike(stage, given, (STEPS[:1], STEPS))


@pytest.mark.parametrize(("shape", "ratio", "spacing", "prior"), CASES[:-1])
def test_shaders_interpolate_corrections_like_the_loops(stage, shape, ratio, spacing, prior):
    assert_corrections_come_up_alike(stage, random_example(shape, prior, spacing, ratio), STEPS)


@readings
def test_fused_steps_on_the_coarsest_level_equal_single_steps(stage, prior):
    given = random_example((31, 37), prior)
    assert_the_coarsest_is_alike(stage, given, lambda level, steps: level.descend(steps, None))


@pytest.mark.parametrize(("shape", "ratio", "spacing", "prior"), CASES)
def test_elastic_forces_match_the_loops(stage, shape, ratio, spacing, prior):
    given = random_example(shape, prior, spacing, ratio)
    (host, *_) = host_levels(given)
    values = given.planes(host)

    def job(level, _):
        image = level.vector()
        work = level.apply(level.vector(values.copy()), image)
        return [level.planes(image).copy(), np.array(level.read(work))]

    loops, shaders = with_levels(stage, given, job)
    assert_same(shaders, loops)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_bicgstab_step_matches_the_loops(stage, shape):
    given = random_example(shape, CENTRED, (1.0, 2.0))
    (host, *_) = host_levels(given)
    first = [given.planes(host) for _ in range(4)]
    first[1] *= 1e-9  # as small as multiplied scalars get

    def job(level, _):
        found, rest, direction, image = (level.vector(each.copy()) for each in first)
        along, against = level.product(rest, rest), level.product(rest, direction)
        length = level.quotient(along, against)
        stride = level.quotient(against, level.product(image, image))
        share = level.quotient(level.times(along, length), level.times(against, stride))
        none = level.quotient(along, level.largest(level.vector()))
        level.lean(rest, direction, image, length, stride)
        square = level.advance(found, rest, direction, image, length)
        scalars = level.read(along, length, stride, share, none, square)
        return [np.array([each]) for each in scalars] + [
            level.planes(vector).copy() for vector in (found, rest, direction)
        ]

    loops, shaders = with_levels(stage, given, job)
    assert_same(shaders, loops, 1e-4)  # terms of both signs nearly cancel in one scalar
    assert shaders[4] == 0


def test_a_negative_step_length_reverses_the_step(stage):
    given = random_example((9, 8), CENTRED)
    (host, *_) = host_levels(given)
    values = given.planes(host)

    def job(level, _):
        d, direction, rest, image = (level.vector(values.copy()) for _ in range(4))
        length = level.quotient(
            level.product(direction, rest), level.product(rest, level.vector(-2 * values))
        )
        level.advance(d, rest, direction, image, length)
        return [level.planes(d).copy(), level.planes(rest).copy(), np.array(level.read(length))]

    for d, rest, length in with_levels(stage, given, job):
        assert length == -0.5
        np.testing.assert_array_equal(d, 0.5 * values)
        np.testing.assert_array_equal(rest, 1.5 * values)


@readings
def test_a_cycle_matches_the_loops(stage, prior):
    given = random_example((70, 55), prior, (1.0, 1.5))
    loops, shaders = cycles(stage, given, AVERAGING if prior is CENTRED else BENDING)
    assert_same(shaders, loops, 3e-5)
    np.testing.assert_array_equal(*shaders)


# Whole solves ----------------------------------------------------------------------------------


@whole_solves("fragment")
@pytest.mark.parametrize(
    "spacing", [pytest.param(SPACINGS[0], marks=pytest.mark.campaign), SPACINGS[1]]
)
def test_the_field_of_torn_tissue_matches_the_loops(by_cycles, stage, spacing, prior):
    problem = torn(20.0, (36, 47), spacing)
    loops = solve(problem, prior, optimizer=Multigrid(5e-4), backend="cpu")
    shaders = solve(problem, prior, optimizer=Multigrid(5e-4), backend=f"opengl:{stage}")
    off = np.abs(shaders.displacement - loops.displacement) / np.array(spacing)
    assert off.max() < 2e-3
    assert (shaders.displacement[~problem.tissue] == 0).all()
    assert shaders.mean_energy == pytest.approx(loops.mean_energy, rel=1e-4)
    assert shaders.convergence.error <= 5e-4
    # Rounding may decide whether a solve switches to the factorization.
    if {loops.convergence.way, shaders.convergence.way} == {"cycles"}:
        assert abs(shaders.iterations - loops.iterations) <= max(2, loops.iterations // 4)


@whole_solves("compute")
@pytest.mark.parametrize(
    ("name", "size"),
    [("expansion", 40), pytest.param("mass-effect", 96, marks=pytest.mark.campaign)],
)
def test_the_field_of_a_phantom_matches_the_loops(by_cycles, stage, name, size, prior):
    problem = phantom(name, size).problem
    loops = solve(problem, prior, optimizer=Multigrid(), backend="cpu")
    shaders = solve(problem, prior, optimizer=Multigrid(), backend=f"opengl:{stage}")
    assert np.abs(shaders.displacement - loops.displacement).max() < 2e-3
    assert abs(shaders.iterations - loops.iterations) <= 1


def test_the_field_of_a_tumour_in_soft_tissue_matches_the_loops(stage):
    # With ten times the stiffness, single precision might not converge.
    problem = torn(ratio=1e3)
    loops = solve(problem, CENTRED, optimizer=Multigrid(1e-3), backend="cpu")
    shaders = solve(problem, CENTRED, optimizer=Multigrid(1e-3), backend=f"opengl:{stage}")
    assert np.abs(shaders.displacement - loops.displacement).max() < 2e-3


@whole_solves("fragment")
def test_slipping_observations_match_the_loops(by_cycles, stage, prior):
    problem = torn(ratio=5.0)
    graded = np.linspace(0.1, 1, problem.shape[0])[:, None, None] * problem.confidence
    problem = Problem(problem.observed, graded, problem.stiffness)
    prior = SeilerPrior(penalty=3.0, conditional=prior.conditional)
    loops = solve(problem, prior, optimizer=Multigrid(1e-3), backend="cpu")
    shaders = solve(problem, prior, optimizer=Multigrid(1e-3), backend=f"opengl:{stage}")
    slipped = np.abs(loops.displacement - problem.observed)[problem.confidence > 0] > 0.01
    assert 0 < slipped.sum() < slipped.size
    assert np.abs(shaders.displacement - loops.displacement).max() < 4e-3


def test_a_software_renderer_factorises_the_blanket_conditional():
    require_opengl()
    problem = phantom("expansion", 64).problem
    loops, shaders = (
        solve(problem, BLANKET, optimizer=Multigrid(), backend=name) for name in ("cpu", "opengl")
    )
    software = is_software_renderer(shaders.provenance.renderer)
    assert shaders.convergence.way == ("factors" if software else "cycles")
    assert np.abs(shaders.displacement - loops.displacement).max() < 2e-3


def test_slipping_blanket_observations_are_factorised_once():
    # Each set of slipping observations is a separate system.
    require_opengl()
    problem = torn(5.0, (36, 47))
    graded = np.linspace(0.1, 1, problem.shape[0])[:, None, None] * problem.confidence
    problem = Problem(problem.observed, graded, problem.stiffness)
    prior = SeilerPrior(penalty=0.3, conditional="blanket")
    told = []
    found = solve(problem, prior, optimizer=Multigrid(), backend="opengl", progress=told.append)
    words = [monitor.message for monitor in told]
    assert any(message.startswith("cycle") for message in words)
    if is_software_renderer(found.provenance.renderer):
        assert words.count("factorizing, 0%") == 1
    loops = solve(problem, prior, optimizer=Multigrid(), backend="cpu")
    assert np.abs(found.displacement - loops.displacement).max() < 4e-3


def test_auto_uses_the_shaders_on_a_gpu(monkeypatch):
    from napari_hmrf.solver.backends import opengl

    require_opengl()
    monkeypatch.setattr(opengl, "is_software_renderer", lambda _: False)
    provenance = solve(torn(20.0), CENTRED, optimizer=Multigrid(), backend="auto").provenance
    assert provenance.backend.startswith("opengl:")
    assert provenance.reason == "a GPU is available"


# Memory and cancellation -----------------------------------------------------------------------


def test_an_iteration_allocates_nothing(stage, made):
    given = random_example((70, 55), CENTRED)
    (host, *_) = host_levels(given)
    load = given.planes(host)

    def job():
        backend = OpenGLBackend(lambda: None, stage)
        try:
            model = given.model(backend)
            level, cycle = model.levels[0], Cycle(model, AVERAGING)
            counts = []
            rest, found, direction, image = level.vector(load), *(level.vector() for _ in "123")
            along = level.product(rest, rest)
            for _ in range(6):
                steepest = cycle.run(rest)
                level.apply(steepest, image)
                length = level.quotient(along, level.product(rest, image))
                level.advance(found, rest, steepest, image, length)
                share = level.quotient(level.times(along, length), level.times(along, along))
                level.lean(rest, direction, image, share, length)
                level.read(level.largest(rest), share)
                counts.append(len(made))
            return counts
        finally:
            backend.close()

    counts = on_compute_thread(job)
    assert counts[3:] == [counts[3]] * 3
    assert left(made) == 0


def _count_batches(stage: str, prior: SeilerPrior, stop_at: int | None = None) -> int:
    """Solve, cancel at a given check, and return the number of checks."""
    return count_looks(stage, Multigrid(), torn(20.0), prior.resolved(torn(20.0)), stop_at)


@cache
def _uninterrupted(stage: str, prior: SeilerPrior):
    """Return the solution without cancellation, and the number of checks once compiled."""
    found = solve(torn(20.0), prior, optimizer=Multigrid(), backend=f"opengl:{stage}")
    return found, _count_batches(stage, prior)


@pytest.mark.parametrize(
    ("where", "prior"),
    [
        (0.0, CENTRED),
        (0.5, CENTRED),
        (0.999, CENTRED),
        pytest.param(0.0, BLANKET, marks=pytest.mark.campaign),
        pytest.param(0.999, BLANKET, marks=pytest.mark.campaign),
    ],
)
def test_a_cancelled_solve_frees_memory_and_the_next_gives_the_same_bits(
    by_cycles, stage, made, where, prior, every_pass_a_batch, monkeypatch
):
    monkeypatch.setattr(refinement, "_FEW", 0)  # so that few sites are solved in batches
    before, looks = _uninterrupted(stage, prior)
    assert looks > 10 * before.iterations
    with pytest.raises(Cancelled):
        _count_batches(stage, prior, stop_at=int(where * looks))
    assert left(made) == 0
    after = solve(torn(20.0), prior, optimizer=Multigrid(), backend=f"opengl:{stage}")
    np.testing.assert_array_equal(after.displacement, before.displacement)
    assert left(made) == 0


def test_splitting_a_pass_into_strips_does_not_change_the_result(stage, monkeypatch):
    from napari_hmrf.solver.backends.opengl import backend
    from napari_hmrf.solver.backends.opengl.programs import regions

    whole = solve(
        torn(20.0), CENTRED, optimizer=Multigrid(), backend=f"opengl:{stage}"
    ).displacement
    monkeypatch.setattr(backend, "MAX_PASS_SECONDS", 1e-4)
    monkeypatch.setattr(backend, "BATCH_SECONDS", 1e-4)
    monkeypatch.setattr(regions, "_ACROSS", 2)
    cut = solve(torn(20.0), CENTRED, optimizer=Multigrid(), backend=f"opengl:{stage}").displacement
    np.testing.assert_array_equal(cut, whole)


# A wrong shader --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "right", "wrong"),
    [
        pytest.param(
            "pulls",
            "force[1] = answer(site + HORIZONTAL, 2)",
            "force[1] = answer(site, 2)",
            marks=pytest.mark.campaign,
        ),
        pytest.param("cliques", "ratio.x * u + s", "ratio.y * u + s", marks=pytest.mark.campaign),
        pytest.param(
            "ends",
            "ratio = end > 0 ? ratio : ratio.yx",
            "ratio = ratio.yx",
            marks=pytest.mark.campaign,
        ),
        pytest.param(
            "ends", "middle + end * line", "middle - end * line", marks=pytest.mark.campaign
        ),
        ("begin", "taken = first_scale * inverses", "taken = first_scale"),
        ("begin", "greaterThan(inverses, vec4(0.0))", "bvec4(true)"),
        pytest.param(
            "residual",
            "texelFetch(load, at, 0) - pulls",
            "texelFetch(load, at, 0) + pulls",
            marks=pytest.mark.campaign,
        ),
        ("gather", "(before + first.zw)", "(first.zw + first.zw)"),
        ("gather", "fine - VERTICAL", "fine"),
        pytest.param(
            "smooth",
            "pulls += texelFetch(springs",
            "pulls -= texelFetch(springs",
            marks=pytest.mark.campaign,
        ),
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
    given = random_example((33, 47), BLANKET, (1.0, 1.5))
    hosts = host_levels(given)
    loads = [given.planes(host) for host in hosts]
    device = on_compute_thread(the_device)
    monkeypatch.setattr(device, "_programs", {})
    monkeypatch.setattr(device, "rows", 4)
    loops, shaders = [], []
    for number in (0, 1):  # the first level has fixed sites, the others have springs
        below = hosts[number + 1].inverse

        def job(level, coarse, number=number, below=below):
            level.load = level.vector(loads[number].copy())
            level.descend(STEPS, coarse)
            given_down = np.where(below > 0, coarse.planes(coarse.load), 0)
            coarse.correction = coarse.vector(loads[number + 1].copy())
            level.ascend(STEPS, coarse)
            image = level.vector()
            work = level.read(level.apply(level.correction, image))
            return [level.planes(level.correction).copy(), given_down, np.array(work)]

        of_loops, of_shaders = with_levels("compute", given, job, number)
        loops += of_loops
        shaders += of_shaders
    with pytest.raises(AssertionError):
        assert_same(shaders, loops)


def test_averaged_loads_at_the_border_of_tissue_match_the_loops(monkeypatch):
    require_opengl()
    given: Example = random_example((33, 47), CENTRED)
    hosts = host_levels(given)
    load = given.planes(hosts[0])

    def job(level, coarse):
        level.load = level.vector(load.copy())
        level.descend(STEPS, coarse)
        return [np.where(hosts[1].inverse > 0, coarse.planes(coarse.load), 0)]

    loops, shaders = with_levels(None, given, job)
    assert_same(shaders, loops)
    monkeypatch.setattr("napari_hmrf.solver.backends.cpu.seiler.even_out", lambda *_: None)
    loops, shaders = with_levels(None, given, job)
    with pytest.raises(AssertionError):
        assert_same(shaders, loops)
