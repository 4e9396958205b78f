"""Factorizations of small volumes and of sliding parts, and their memory."""

import gc
import threading
import weakref

import numpy as np
import pytest
import scipy

from napari_hmrf import ElasticPrior, solve
from napari_hmrf.solver.backends.direct import sparse_factors
from napari_hmrf.solver.backends.direct.sparse_factors import Links, SparseFactors
from validation.bodies import between_plates


def springs(*ranges):
    """Return elements that resist any difference between their corners."""
    shape = tuple(part.stop - part.start for part in ranges)
    return np.broadcast_to(8 * np.eye(8) - 1, (*shape, 8, 8))


def factors(size=3):
    moves = np.ones((size,) * 3 + (1,), dtype=bool)
    moves[0, 0, 0] = False
    return SparseFactors(springs, moves, lambda part: None)


def on_another_thread(action):
    thread = threading.Thread(target=action)
    thread.start()
    thread.join()


@pytest.fixture
def dropped():
    sparse_factors._dropped.clear()
    yield sparse_factors._dropped
    sparse_factors._dropped.clear()


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


def test_coupled_components_that_are_not_neighbours_move_together():
    moves = np.ones((4, 5, 1), dtype=bool)
    moves[0, 0] = False
    rng = np.random.default_rng(0)
    load, ends = rng.normal(size=moves.shape), np.zeros((2, moves.size))
    ends[[0, 0, 1, 1], [1, 18, 7, 12]] = 1, -1, 1, -1
    coupling = ends.T @ ends * 1e4

    def squares(*ranges):
        shape = tuple(part.stop - part.start for part in ranges)
        return np.broadcast_to(4 * np.eye(4) - 1, (*shape, 4, 4))

    links = Links(scipy.sparse.csr_array(coupling), (4, 5), np.arange(20))
    whole = SparseFactors(squares, moves, lambda part: None, links=links)
    found = whole.solve(load).ravel()
    assert abs(ends @ found).max() < 1e-3 * abs(found).max()
    matrix = np.array([forces_of(squares, each, moves.shape) for each in np.eye(moves.size)])
    rest = (load.ravel() - (matrix + coupling) @ found)[moves.ravel()]
    assert abs(rest).max() < 1e-9


def forces_of(elements, d, shape):
    """Return the forces of elements of four sites for a displacement, site by site."""
    d, forces = d.reshape(shape), np.zeros(shape)
    matrices = elements(*(slice(0, size - 1) for size in shape[:2]))
    for row, col in np.ndindex(matrices.shape[:2]):
        box = np.s_[row : row + 2, col : col + 2]
        forces[box] += (matrices[row, col] @ d[box].ravel()).reshape(2, 2, 1)
    return forces.ravel()


def wall(shape):
    """Return a random volume with one end fixed and the other pulled."""
    return between_plates(10 ** np.random.default_rng(0).uniform(0, 3, shape), (1, 0, 0))


def test_only_the_factors_of_the_last_volume_are_kept(monkeypatch):
    made = []
    original = SparseFactors.__init__

    def watched(self, *args, **kwargs):
        made.append(weakref.ref(self))
        original(self, *args, **kwargs)

    monkeypatch.setattr(SparseFactors, "__init__", watched)
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
