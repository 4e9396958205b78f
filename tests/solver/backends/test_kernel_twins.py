"""Agreement of shaders, compiled loops and the energies of the paper.

The fields are random so that no smoothness or symmetry can hide an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest

from napari_hmrf import ICM, Problem, SeilerPrior, solve
from napari_hmrf.solver.backends.base import SiteRule
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.opengl.images.fields import as_given, as_stored, pairs, singles
from napari_hmrf.solver.backends.opengl.programs import regions
from napari_hmrf.solver.backends.opengl.programs.source import GROUP
from napari_hmrf.solver.priors import line_weights
from napari_hmrf.solver.quadtree import levels, nearest_pixels
from tests.support.opengl import on_compute_thread, require_opengl
from validation.oracles.paper import candidates

STEPS = (1.0, 0.1, 0.01, 0.001)
PENALTY = 1e3
#: Odd, prime, not square, one site wide, smaller than a clique.
SHAPES = [(31, 37), (64, 48), (1, 17), (13, 1), (2, 3), (1, 2), (101, 7)]
SOFT, HARD, SQUARE, OBLONG = 4.0, 1e4, (1.0, 1.0), (2.0, 0.5)


def cases(*also):
    """Return each shape once, with either contrast, pixel size and value of `also` by turns.

    All combinations on one grid, and two contrasts and pixel sizes on the others, are campaigns.
    """
    regular = [
        (
            shape,
            *((HARD, OBLONG) if k % 2 else (SOFT, SQUARE)),
            *(each[k // 2 % 2] for each in also),
        )
        for k, shape in enumerate(SHAPES)
    ]
    product_of = [
        ((31, 37), ratio, spacing) for ratio in (SOFT, HARD) for spacing in (SQUARE, OBLONG)
    ]
    product_of += [case[:3] for case in regular[1:]]
    every = [(*case, *values) for case in product_of for values in product(*also)]
    return regular + [
        pytest.param(*case, marks=pytest.mark.campaign) for case in every if case not in regular
    ]


def some_shapes(*regular):
    """Return all shapes, of which some are regular and the others are campaigns."""
    return [
        shape if shape in regular else pytest.param(shape, marks=pytest.mark.campaign)
        for shape in SHAPES
    ]


READINGS = ("centred", "blanket")


@dataclass
class Example:
    """Problem with random tissue, holes and observations, and a random displacement."""

    problem: Problem
    displacement: np.ndarray  # (H, W, 2), pixels, 0 in void

    @property
    def stiffness(self) -> np.ndarray:
        m = self.problem.stiffness / self.problem.stiffness.max()
        return np.stack([m, np.divide(1, m, out=np.zeros_like(m), where=m > 0)], axis=-1)

    @property
    def observation(self) -> np.ndarray:
        y = self.problem.observed / np.float32(self.problem.unit)
        both = np.concatenate([y, np.float32(PENALTY) * self.problem.confidence], axis=-1)
        both[~self.problem.tissue] = 0
        return both

    def rule(self, prior: SeilerPrior, steps: tuple[float, ...] = ()) -> SiteRule:
        blanket = prior.conditional == "blanket"
        return SiteRule(blanket, prior.relaxation, steps, line_weights(self.problem.spacing))


def example(shape, ratio=4.0, spacing=(1.0, 1.0), seed=0) -> Example:
    random = np.random.default_rng([seed, *shape, int(ratio)])
    m = 40 * np.exp(random.uniform(-np.log(ratio), 0, shape))
    m[random.random(shape) < 0.12] = 0
    m.flat[0] = 40
    seen = random.random((*shape, 2)) < 0.3
    seen[0, 0] = True
    c = random.random((*shape, 2)) * seen
    y = random.normal(size=(*shape, 2)) * np.sqrt(np.prod(spacing))
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)
    d = random.normal(size=(*shape, 2)).astype(np.float32)
    d[~problem.tissue] = 0
    return Example(problem, d)


def relaxed(backend, given: Example, rule: SiteRule, sweeps: int = 1):
    """Return the displacement after some sweeps, U_total before each sweep, and U_total now."""
    stiffness = backend.upload(given.stiffness)
    observation = backend.upload(given.observation)
    moved, before = backend.relax(
        backend.upload(given.displacement), stiffness, observation, rule, sweeps
    )
    now = backend.energy(moved, stiffness, observation, rule)
    return backend.download(moved), before, now


def with_backends(stage: str, job):
    """Return the results of a job with the compiled loops and with the shaders."""

    def both():
        answers = []
        for backend in (CpuBackend(lambda: None), OpenGLBackend(lambda: None, stage)):
            try:
                answers.append(job(backend))
            finally:
                backend.close()
        return answers

    return on_compute_thread(both)


def assert_same(actual, expected, relative=1e-5):
    """Assert equality to a fraction of the largest value, the accuracy of float32."""
    np.testing.assert_allclose(actual, expected, rtol=0, atol=relative * np.abs(expected).max())


@pytest.mark.parametrize(("shape", "ratio", "spacing", "conditional"), cases(READINGS))
def test_a_closed_form_sweep_agrees_in_shaders_loops_and_equations(
    stage, shape, ratio, spacing, conditional
):
    given = example(shape, ratio, spacing)
    prior = SeilerPrior(penalty=PENALTY, conditional=conditional)
    loops, shaders = with_backends(stage, lambda b: relaxed(b, given, given.rule(prior)))
    for theirs, ours in zip(loops, shaders, strict=True):
        assert_same(ours, theirs)

    unit = given.problem.unit
    oracle = prior.site_parabola(given.problem, given.displacement * unit)
    curvature = oracle.curvature / prior.relaxation
    way = prior.relaxation * (oracle.lowest / unit - given.displacement)
    y, p = np.split(given.observation.astype(float), 2, axis=-1)
    off = given.displacement + way - y
    reach = np.divide(p, 2 * curvature, out=np.full_like(p, np.inf), where=curvature > 0)
    best = y + np.sign(off) * np.maximum(np.abs(off) - reach, 0)
    free = (curvature == 0) & (p == 0)
    assert_same(shaders[0], np.where(free, given.displacement, best))


@pytest.mark.parametrize(("shape", "ratio", "spacing", "conditional"), cases(READINGS))
def test_a_site_takes_the_best_candidate_in_shaders_and_loops(
    stage, shape, ratio, spacing, conditional
):
    given = example(shape, ratio, spacing)
    prior = SeilerPrior(penalty=PENALTY, conditional=conditional)
    loops, shaders = with_backends(stage, lambda b: relaxed(b, given, given.rule(prior, STEPS)))

    unit = given.problem.unit
    oracle = prior.site_parabola(given.problem, given.displacement * unit)
    y, p = np.split(given.observation.astype(float), 2, axis=-1)
    curvature = oracle.curvature / prior.relaxation
    lowest = given.displacement + prior.relaxation * (oracle.lowest / unit - given.displacement)

    def local_energy(d):
        return (curvature * (d - lowest) ** 2 + p * np.abs(d - y)).sum(axis=-1)

    moves = candidates(STEPS).astype(float)
    energies = np.array([local_energy(given.displacement + move) for move in moves])
    scale = local_energy(given.displacement) + 1e-30
    for moved in (loops[0], shaders[0]):
        # Either of two candidates that are equal up to rounding may be taken.
        worse = local_energy(moved.astype(float)) - energies.min(axis=0)
        assert (worse / scale).max() < 1e-5
        off_grid = [np.abs(moved - given.displacement - move).max(axis=-1) for move in moves]
        assert np.min(off_grid, axis=0).max() < 1e-6
    assert (np.abs(loops[0] - shaders[0]).max(axis=-1) > 1e-5).mean() <= 1e-3
    assert_same(shaders[1], loops[1])


@pytest.mark.parametrize(("shape", "ratio", "spacing"), cases())
def test_the_energy_of_each_pair_of_sites_matches_the_equations(stage, shape, ratio, spacing):
    given = example(shape, ratio, spacing)
    prior = SeilerPrior(penalty=PENALTY)
    weights = {"weights": line_weights(spacing).astype(np.float32)}
    square = {"SQUARE": int(spacing == (1.0, 1.0))}
    moving = {"relaxation": np.ones(1, np.float32)}

    def shares():
        backend = OpenGLBackend(lambda: None, stage)
        try:
            around = [backend.upload(given.displacement).texture]
            stiffness = backend.upload(given.stiffness)
            around += backend._ratios(stiffness)
            tissue = backend._tissue(stiffness)
            around += [backend.upload(given.observation).texture]
            icm = backend._program("icm", {"BLANKET": 0, "STEPS": 0, **square})
            icm.set({**weights, **moving})
            energy = backend._program("energy", square)
            energy.set(weights)
            grid = pairs(shape)
            moved, first, second = (backend._pool.acquire(grid, k) for k in (4, 1, 1))
            backend._run(icm, around, [moved, first], grid, tissue=tissue)
            backend._run(energy, around, [second], grid, tissue=tissue)
            backend._pace.wait()
            return [
                np.frombuffer(texture.read(), np.float32).reshape(grid)
                for texture in (first, second)
            ]
        finally:
            backend.close()

    of_sweep, of_energy = on_compute_thread(shares)
    of_sites = prior.site_energy(given.problem, given.displacement * given.problem.unit)
    expected = np.add.reduceat(of_sites, range(0, shape[1], 2), axis=1)
    np.testing.assert_allclose(of_energy, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(of_sweep, of_energy, rtol=1e-6)


@pytest.mark.parametrize(("shape", "components"), [((31, 37), 2), ((2, 3), 4), ((64, 48), 2)])
def test_fields_of_any_width_survive_a_storage_round_trip(shape, components):
    values = np.random.default_rng(0).normal(size=(*shape, components)).astype(np.float32)
    stored = as_stored(values)
    assert stored.shape[1] % 2 == 0
    assert not stored[:, shape[1] :].any()  # the added column is void
    np.testing.assert_array_equal(as_given(stored, shape, components), values)


def test_the_mask_marks_exactly_the_pairs_with_tissue():
    require_opengl("fragment")
    tissue = np.zeros((7, 9), np.float32)
    tissue[0, 3], tissue[2, 6], tissue[6, 8] = 1, 0.5, 1e-30

    def shown():
        backend = OpenGLBackend(lambda: None, "fragment")
        try:
            stiffness = backend.upload(np.repeat(tissue[..., None], 2, axis=-1))
            found = backend._tissue(stiffness)
            return np.frombuffer(found.mask.read(), np.float32).reshape(7, 5), found.region
        finally:
            backend.close()

    expected = np.zeros((7, 5))
    expected[0, 1] = expected[2, 3] = expected[6, 4] = 1
    mask, window = on_compute_thread(shown)
    np.testing.assert_array_equal(mask, expected)
    assert window == (0, 1, 7, 5)


@pytest.mark.parametrize("across", [1, 3, 256])
def test_every_work_group_with_tissue_is_listed(across, monkeypatch):
    monkeypatch.setattr(regions, "_ACROSS", across)
    shown = np.zeros((40, 21), bool)
    some = [(0, 0), (7, 7), (8, 8), (9, 9), (39, 20), (31, 3), (16, 15)]
    shown[tuple(np.transpose(some))] = True
    places = regions.groups_with(shown)
    assert places.shape[1] <= across
    listed = [tuple(place) for place in places.reshape(-1, 2)]
    rows, cols = GROUP
    assert set(listed) == {(col // cols, row // rows) for row, col in some}
    assert len(listed) < len(set(listed)) + len(places)


@pytest.mark.parametrize(
    ("shape", "conditional"),
    [
        ((31, 37), "blanket"),
        ((2, 3), "centred"),
        *(
            pytest.param(shape, conditional, marks=pytest.mark.campaign)
            for shape, conditional in product(SHAPES, READINGS)
        ),
    ],
)
def test_the_number_of_texels_per_invocation_does_not_change_the_result(
    shape, conditional, monkeypatch
):
    require_opengl("compute")
    given = example(shape)
    rule = given.rule(SeilerPrior(penalty=PENALTY, conditional=conditional), STEPS)

    def job(rows: int):
        monkeypatch.setattr(the_device(), "rows", rows)
        backend = OpenGLBackend(lambda: None, "compute")
        try:
            return relaxed(backend, given, rule, sweeps=5)
        finally:
            backend.close()

    one, *more = (on_compute_thread(lambda rows=rows: job(rows)) for rows in (1, 2, 4, 8))
    for answer in more:
        for ours, theirs in zip(answer, one, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_void_contains_no_values_of_earlier_solves(stage):
    # Only tissue is drawn, so earlier values of a texture must be ignored.
    rows, cols = np.mgrid[:70, :50]
    disc = np.hypot(rows - 35, cols - 25) < 20
    full = Problem(
        observed=np.ones((70, 50, 2)),
        confidence=np.ones((70, 50, 2)) * disc[..., None],
        stiffness=np.ones((70, 50)),
    )
    body = Problem(
        observed=full.observed, confidence=full.confidence, stiffness=np.where(disc, 2.0, 0)
    )
    expected = solve(body, SeilerPrior(), backend="cpu")
    for problem in (full, body):
        found = solve(problem, SeilerPrior(), backend=f"opengl:{stage}")
    assert (found.displacement[~disc] == 0).all()
    np.testing.assert_allclose(found.energy, expected.energy, rtol=0.02, atol=1e-3)


def test_two_problems_on_one_grid_do_not_interfere(stage):
    soft, torn = np.ones((24, 24)), np.ones((24, 24))
    torn[:, 14:] = 0
    torn[12, 12:14] = 5
    held = np.zeros((24, 24, 2))
    held[[0, -1]] = 1
    pull = np.random.default_rng(0).normal(size=held.shape)
    schedule = ICM(iterations=12, steps=None)

    def job(*stiffnesses):
        backend = OpenGLBackend(lambda: None, stage)
        try:
            for m in stiffnesses:
                problem = Problem(observed=pull, confidence=held, stiffness=m)
                outcome = schedule.run(problem, SeilerPrior(), backend, lambda _: None)
            return outcome
        finally:
            backend.close()

    alone = on_compute_thread(lambda: job(torn))
    second = on_compute_thread(lambda: job(soft, torn))
    np.testing.assert_array_equal(second.displacement, alone.displacement)
    np.testing.assert_array_equal(second.energy, alone.energy)


@pytest.mark.parametrize(
    ("shape", "kept"),
    [
        ((31, 37), True),
        ((31, 37), False),
        ((2, 3), False),
        *(
            pytest.param(shape, kept, marks=pytest.mark.campaign)
            for shape, kept in product(SHAPES[1:], (True, False))
        ),
    ],
)
def test_the_energies_of_many_sweeps_are_returned_in_order(stage, shape, kept):
    given = example(shape)
    rule = given.rule(SeilerPrior(penalty=PENALTY))

    def job(backend):
        if isinstance(backend, OpenGLBackend):
            backend._keeps_shares = kept
        return relaxed(backend, given, rule, sweeps=37)

    loops, shaders = with_backends(stage, job)
    np.testing.assert_allclose(shaders[1], loops[1], rtol=1e-5)
    np.testing.assert_allclose(shaders[2], loops[2], rtol=1e-5)
    assert_same(shaders[0], loops[0])


@pytest.mark.parametrize("shape", [(31, 37), (1, 17)])
def test_a_full_atlas_of_energies_is_read_and_reused(stage, shape, monkeypatch):
    given = example(shape)
    rule = given.rule(SeilerPrior(penalty=PENALTY))

    def job(backend):
        if isinstance(backend, OpenGLBackend):
            backend._keeps_shares = False
            monkeypatch.setattr(the_device(), "largest", max(singles(shape)))
        return relaxed(backend, given, rule, sweeps=30)

    loops, shaders = with_backends(stage, job)
    np.testing.assert_allclose(shaders[1], loops[1], rtol=1e-5)


@pytest.mark.parametrize("longest", [0.0, 1e-4])
def test_splitting_a_pass_into_strips_does_not_change_the_result(stage, longest, monkeypatch):
    monkeypatch.setattr(regions, "_ACROSS", 2)  # so that the list of work groups has several rows
    given = example((67, 41))
    rule = given.rule(SeilerPrior(penalty=PENALTY), STEPS)
    waits = []

    def job(cut: bool):
        backend = OpenGLBackend(lambda: waits.append(cut), stage)
        try:
            backend._keeps_shares = False
            if cut:
                backend._pace._longest = longest
                backend._pace._seconds_per_site = 0.05 / 41 / 3  # three rows make a batch
                backend._pace._measured = True
            return relaxed(backend, given, rule, sweeps=5)
        finally:
            backend.close()

    whole = on_compute_thread(lambda: job(False))
    strips = on_compute_thread(lambda: job(True))
    for ours, theirs in zip(strips, whole, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert waits.count(True) > waits.count(False)


@pytest.mark.parametrize("shape", some_shapes((31, 37), (1, 17), (13, 1), (2, 3)))
def test_every_level_samples_the_nearest_pixels(stage, shape):
    given = example(shape)

    def projected(backend):
        finest = backend.upload(given.stiffness), backend.upload(given.observation)
        return [
            backend.download(backend.project(field, level))
            for level in levels(shape)
            for field in finest
        ]

    _, shaders = with_backends(stage, projected)
    expected = [
        values[np.ix_(*nearest_pixels(level, shape))]
        for level in levels(shape)
        for values in (given.stiffness, given.observation)
    ]
    for ours, exact in zip(shaders, expected, strict=True):
        np.testing.assert_array_equal(ours, exact)


@pytest.mark.parametrize("shape", some_shapes((31, 37), (1, 17), (13, 1), (2, 3)))
def test_prolonged_displacements_match_the_loops(stage, shape):
    given = example(shape)
    coarse = levels(shape)[1]
    d = np.random.default_rng(3).normal(size=(*coarse.shape, 2)).astype(np.float32)

    def prolonged(backend):
        stiffness = backend.upload(given.stiffness)
        above = backend.project(stiffness, coarse)
        return backend.download(backend.prolong(backend.upload(d), above, stiffness))

    loops, shaders = with_backends(stage, prolonged)
    assert_same(shaders, loops)
    assert not shaders[~given.problem.tissue].any()


def test_prolongation_is_exact_for_linear_fields(stage):
    coarse, fine = (20, 15), (40, 30)
    tissue = {shape: np.ones((*shape, 2), np.float32) for shape in (coarse, fine)}
    sites = np.moveaxis(np.indices(coarse), 0, -1).astype(np.float32)

    def prolonged(backend):
        field = backend.upload(sites)
        return backend.download(
            backend.prolong(field, backend.upload(tissue[coarse]), backend.upload(tissue[fine]))
        )

    _, shaders = with_backends(stage, prolonged)
    # The centre of fine site i is at (i + 1/2) / 2 - 1/2 in coarse sites.
    expected = (np.moveaxis(np.indices(fine), 0, -1) + 0.5) / 2 - 0.5
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(shaders[inside], expected[inside], atol=1e-6)


def test_void_does_not_move(stage):
    given = example((31, 37))
    rule = given.rule(SeilerPrior(penalty=PENALTY), STEPS)
    _, shaders = with_backends(stage, lambda b: relaxed(b, given, rule, sweeps=10))
    assert not shaders[0][~given.problem.tissue].any()
