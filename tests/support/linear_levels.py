"""Comparison of the levels of a linear model between compiled loops and shaders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.optimizers.cycle import Cycle, chebyshev
from napari_hmrf.solver.priors import Prior
from tests.support.opengl import on_compute_thread


@dataclass
class Example:
    """Random tissue with holes, some prescribed components and random vectors."""

    problem: Problem
    prior: Prior

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(1)

    def model(self, backend):
        elastic = isinstance(self.prior, ElasticPrior)
        make = backend.elastic_model if elastic else backend.seiler_model
        made = make(self.prior.material(self.problem))
        shape = self.problem.shape
        held = np.zeros((len(shape), *(size + 4 for size in shape)), bool)
        inside = (slice(None), *(slice(2, -2) for _ in shape))
        held[inside] = np.moveaxis(self.problem.confidence > 0, -1, 0)
        made.hold(held)
        return made

    def planes(self, host_level) -> np.ndarray:
        """Return random values at all components that are not prescribed."""
        values = self._random.normal(size=host_level.inverse.shape)
        return np.where(host_level.inverse > 0, values, 0).astype(np.float32)


def random_example(shape, prior, spacing=(1.0, 1.0), ratio=4.0) -> Example:
    """Return random tissue of a stiffness ratio, with holes and a tenth of the components
    prescribed."""
    random = np.random.default_rng([*shape, int(ratio)])
    m = ratio ** -random.random(shape)
    m[random.random(shape) < 0.05] = 0
    m[(0,) * len(shape)] = 1
    sites = (*shape, len(shape))
    held = (random.random(sites) < 0.1) & (m > 0)[..., None]
    return Example(
        Problem(observed=random.normal(size=sites), confidence=held, stiffness=m, spacing=spacing),
        prior,
    )


def with_levels(stage, given: Example, job, number=0):
    """Return the result of a job on a level and the next coarser level, by loops and by shaders."""

    def both():
        answers = []
        for backend in (CpuBackend(lambda: None), OpenGLBackend(lambda: None, stage)):
            try:
                model = given.model(backend)
                coarse = model.levels[number + 1] if number + 1 < len(model.levels) else None
                answers.append(job(model.levels[number], coarse))
            finally:
                backend.close()
        return answers

    return on_compute_thread(both)


def host_levels(given: Example):
    """Return the levels of the compiled loops, for their grids and moving components."""

    def job():
        backend = CpuBackend(lambda: None)
        try:
            return given.model(backend).levels
        finally:
            backend.close()

    return on_compute_thread(job)


def assert_same(actual, expected, relative=1e-5):
    """Assert that values are equal to a fraction of the largest value, as float32 allows."""
    for ours, theirs in zip(actual, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=relative * np.abs(theirs).max())


def assert_loads_go_down_alike(stage, given: Example, choices: Sequence, again=False):
    """Compare the residual load on each level and on the next coarser one, for each choice of
    steps."""
    for number, (host, below) in enumerate(pairwise([*host_levels(given), None])):
        load = given.planes(host)
        for steps in choices:

            def job(level, coarse, load=load, steps=steps, below=below):
                level.load = level.vector(load.copy())
                level.descend(steps, coarse)
                made = [level.planes(level.correction).copy()]
                if coarse is not None:
                    made.append(np.where(below.inverse > 0, coarse.planes(coarse.load), 0))
                if again:
                    level.descend(steps, coarse, again=True)
                    made.append(level.planes(level.correction).copy())
                return made

            loops, shaders = with_levels(stage, given, job, number)
            assert_same(shaders, loops)


def assert_corrections_come_up_alike(stage, given: Example, steps):
    """Compare each level after the correction of the next coarser level is added."""
    for number, (host, below) in enumerate(pairwise(host_levels(given))):
        random = [given.planes(each) for each in (host, host, below)]

        def job(level, coarse, random=random):
            load, correction, of_coarse = random
            level.load = level.vector(load.copy())
            level.correction = level.vector(correction.copy())
            coarse.correction = coarse.vector(of_coarse.copy())
            level.ascend(steps, coarse)
            return [level.planes(level.correction).copy()]

        loops, shaders = with_levels(stage, given, job, number)
        assert_same(shaders, loops)


def assert_the_coarsest_is_alike(stage, given: Example, take_steps):
    """Compare the coarsest level after many steps by `take_steps(level, steps)`."""
    hosts = host_levels(given)
    load = given.planes(hosts[-1])

    def job(level, _):
        level.load = level.vector(load.copy())
        made = []
        for steps in (chebyshev(0.05, 2.5, 20), chebyshev(0.1, 5.0, 11)):
            take_steps(level, steps)
            made.append(level.planes(level.correction).copy())
        return made

    loops, shaders = with_levels(stage, given, job, len(hosts) - 1)
    assert_same(shaders, loops, 3e-5)


def assert_a_ratio_is_nothing_unless_both_are_positive(stage, given: Example):
    """Check that a ratio of scalar products is 0 unless both products are positive."""
    (host, *_) = host_levels(given)
    values = given.planes(host)

    def job(level, _):
        vector, opposite, zero = level.vector(values.copy()), level.vector(-values), level.vector()
        square, negative = level.product(vector, vector), level.product(vector, opposite)
        none = level.largest(zero)
        over = [(square, square), (square, negative), (negative, square), (square, none)]
        ratios = [level.ratio(*each) for each in over]
        used = []
        for share in ratios:
            direction = level.vector(values.copy())
            level.turn(vector, direction, share)
            used.append(level.planes(direction).copy())
        return level.read(*ratios), used

    for numbers, used in with_levels(stage, given, job):
        assert numbers == (1, 0, 0, 0)
        for number, turned in zip(numbers, used, strict=True):
            # A GPU may round a product and a sum only once.
            np.testing.assert_allclose(turned, (1 + number) * values, rtol=2e-7)


def torn(ratio, shape=(45, 61), spacing=(1.0, 1.0)) -> Problem:
    """Return a stiff inclusion in soft tissue with a hole, fixed at the left and pulled at the
    right."""
    rows, cols = np.indices(shape) * 90 / shape[1]
    m = np.where(np.hypot(rows - 45, cols - 60) < 14, ratio, 1.0)
    m[np.hypot(rows - 30, cols - 30) < 9] = 0
    m[(rows < 6) & (cols >= 20)] = 0
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[:, :2] = c[:, -2:] = 1
    y[:, -2:] = (1.5, 4)
    return Problem(observed=y * spacing, confidence=c, stiffness=m, spacing=spacing)


def cycles(stage, given: Example, smoothing):
    """Return the first and the second result of a V-cycle on a load, by loops and by shaders."""
    (host, *_) = host_levels(given)
    load = given.planes(host)

    def both():
        answers = []
        for backend in (CpuBackend(lambda: None), OpenGLBackend(lambda: None, stage)):
            try:
                model = given.model(backend)
                cycle, finest = Cycle(model, smoothing), model.levels[0]
                vector = finest.vector(load.copy())
                answers.append([finest.planes(cycle.run(vector)).copy() for _ in range(2)])
            finally:
                backend.close()
        return answers

    return on_compute_thread(both)
