"""Levels of a linear model, as compiled loops and as shaders, and what both make of the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from opengl_here import on_compute_thread

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.optimizers.cycle import Cycle
from napari_hmrf.solver.priors import Prior


@dataclass
class Example:
    """Random tissue with holes, some components of it held, and random vectors on it."""

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
        """Random values wherever something moves."""
        values = self._random.normal(size=host_level.inverse.shape)
        return np.where(host_level.inverse > 0, values, 0).astype(np.float32)


def random_example(shape, prior, spacing=(1.0, 1.0), ratio=4.0) -> Example:
    """Random tissue of a ratio of stiffnesses, with holes, a tenth of it held."""
    random = np.random.default_rng([*shape, int(ratio)])
    m = ratio ** -random.random(shape)
    m[random.random(shape) < 0.05] = 0
    m[(0,) * len(shape)] = 1
    sites = (*shape, len(shape))
    held = (random.random(sites) < 0.1) & (m > 0)[..., None]
    return Example(Problem(random.normal(size=sites), held, m, spacing=spacing), prior)


def with_levels(stage, given: Example, job, number=0):
    """What a job makes of a level and the next coarser one, on the processor and as shaders."""

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
    """The levels of the compiled loops, to know their grids and what moves."""

    def job():
        backend = CpuBackend(lambda: None)
        try:
            return given.model(backend).levels
        finally:
            backend.close()

    return on_compute_thread(job)


def assert_same(actual, expected, relative=1e-5):
    """Equal to a fraction of the largest value, as float32 arithmetic allows."""
    for ours, theirs in zip(actual, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=relative * np.abs(theirs).max())


def torn(ratio, shape=(67, 90), spacing=(1.0, 1.0)) -> Problem:
    """A stiff lump in soft tissue with a hole, held at its left edge and pulled at its right."""
    rows, cols = np.indices(shape)
    m = np.where(np.hypot(rows - 45, cols - 60) < 14, ratio, 1.0)
    m[np.hypot(rows - 30, cols - 30) < 9] = 0
    m[:6, 20:] = 0
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[:, :2] = c[:, -2:] = 1
    y[:, -2:] = (1.5, 4)
    return Problem(y * spacing, c, m, spacing=spacing)


def cycles(stage, given: Example, smoothing):
    """What the first and the second run of a V-cycle make of a load, as loops and as shaders."""
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
