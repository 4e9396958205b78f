"""Factorizations of small volumes and their memory."""

import gc
import threading
import weakref

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.solver.backends.direct import brick_factors
from napari_hmrf.solver.backends.direct.brick_factors import BrickFactors


def springs(*ranges):
    """Return elements that resist any difference between their corners."""
    shape = tuple(part.stop - part.start for part in ranges)
    return np.broadcast_to(8 * np.eye(8) - 1, (*shape, 8, 8))


def factors(size=3):
    moves = np.ones((size,) * 3 + (1,), dtype=bool)
    moves[0, 0, 0] = False
    return BrickFactors(springs, moves, lambda part: None)


def on_another_thread(action):
    thread = threading.Thread(target=action)
    thread.start()
    thread.join()


@pytest.fixture
def dropped():
    brick_factors._dropped.clear()
    yield brick_factors._dropped
    brick_factors._dropped.clear()


def test_factors_dropped_on_another_thread_are_freed_with_the_next_factors(dropped):
    box = [factors()]
    on_another_thread(box.clear)
    assert len(dropped) == 1
    factors()
    assert not dropped


def test_factors_dropped_on_their_own_thread_are_freed_at_once(dropped):
    box = [factors()]
    box.clear()
    assert not dropped


def wall(shape):
    """Return a random volume with one end fixed and the other pulled."""
    m = 10 ** np.random.default_rng(0).uniform(0, 3, shape)
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1, ..., 0] = 1
    return Problem(y, c, m)


def test_only_the_factors_of_the_last_volume_are_kept(monkeypatch):
    made = []
    original = BrickFactors.__init__

    def watched(self, *args, **kwargs):
        made.append(weakref.ref(self))
        original(self, *args, **kwargs)

    monkeypatch.setattr(BrickFactors, "__init__", watched)
    gc.collect()
    gc.disable()  # so that a reference cycle would be noticed
    try:
        for depth in (4, 5, 6):
            solution = solve(wall((depth, 4, 4)), ElasticPrior(0.3), backend="cpu")
            assert solution.convergence.way == "factors"
        alive = [each for each in made if each() is not None]
    finally:
        gc.enable()
    assert len(made) >= 3
    assert len(alive) <= 1
