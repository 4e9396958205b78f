"""Whoever cancels waits for no volume: what is computed of it looks in time whether to stop."""

import signal
import sys
import threading

import numba
import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Drawing,
    ElasticPrior,
    Grid,
    Motion,
    Multigrid,
    Problem,
    Study,
    Tissue,
    warp,
)
from napari_hmrf.errors import Cancelled
from napari_hmrf.field import slabs, tetrahedron_raster, volume_loops
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.solve import run_here
from napari_hmrf.study.engine import Engine
from napari_hmrf.study.study import Pictures
from napari_hmrf.ui.background_jobs import BackgroundJobs
from tests.support.cancel_flags import AfterLooks
from tests.support.timeouts import LONG

#: Of slabs of four planes for each core, three or more, whichever cores a test before left to work.
SHAPE = (12 * numba.config.NUMBA_NUM_THREADS, 9, 8)
#: The loops that a volume goes through slab by slab.
LOOPS = {
    "rasterise": tetrahedron_raster,
    "look_up": volume_loops,
    "determinants": volume_loops,
}


@pytest.fixture
def thin(monkeypatch):
    """Slabs of as few planes as there may be."""
    monkeypatch.setattr(slabs, "VOXELS", 1)


@pytest.fixture
def counted(monkeypatch):
    """Has something called at each slab that a loop goes through; the list of these slabs."""

    def count(loop, call):
        done, original = [], getattr(LOOPS[loop], loop)

        def counting(*arguments):
            done.append(len(done))
            call()
            return original(*arguments)

        monkeypatch.setattr(LOOPS[loop], loop, counting)
        return done

    return count


def waves(shape=SHAPE):
    places = np.indices(shape) / max(shape) * 6
    return 1.5 * np.moveaxis(np.sin(places + places[::-1]), 0, -1).astype(np.float32)


def a_ball(shape=SHAPE):
    places = np.indices(shape) * 2 / np.reshape(shape, (3, 1, 1, 1)) - 1
    return (places**2).sum(axis=0) < 0.9


def answers():
    """An image that has moved, and how near each of its sites is to a fold."""
    image = np.random.default_rng(0).random(SHAPE)
    return warp(image, waves(), spacing=1, tissue=a_ball()), smallest_determinant(
        waves(), 1, a_ball()
    )


def on_compute_thread(work, stop):
    """Have work done there unless a flag is set."""

    def job():
        with compute_thread.unless(stop.is_set):
            return work()

    return compute_thread.submit(job).result()


def test_slabs_of_a_volume_are_the_volume(monkeypatch):
    whole = answers()
    monkeypatch.setattr(slabs, "VOXELS", 1)
    for one, other in zip(whole, answers(), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("loop", LOOPS)
def test_a_volume_that_moves_stops_at_the_slab_at_which_nobody_wants_it(thin, counted, loop):
    stop = threading.Event()
    done = counted(loop, stop.set)
    with pytest.raises(Cancelled):
        on_compute_thread(answers, stop)
    assert len(done) == 1
    stop.clear()
    done.clear()
    counted(loop, lambda: None)
    on_compute_thread(answers, threading.Event())
    assert len(done) >= 3


@pytest.mark.skipif(sys.platform == "win32", reason="there no thread is sent a signal")
def test_a_warp_that_ctrl_c_leaves_stops(thin, counted, request):
    # A process that was started in the background may ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    left = threading.Event()

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        assert left.wait(LONG)

    done = counted("rasterise", interrupt)
    with pytest.raises(KeyboardInterrupt):
        answers()
    left.set()
    compute_thread.submit(lambda: None).result(LONG)
    assert len(done) == 1


def a_study():
    image = np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8)
    pull = Arrow((10, 5, 4), (0.0, 1.0, 0.5), 2)
    return Study(
        Grid(SHAPE, (1.0,) * 3),
        Tissue(stiffness=np.ones(SHAPE)),
        Motion(hold_edge=True, drawing=Drawing((pull,))),
        pictures=Pictures(image=image),
    )


def test_a_study_that_is_dropped_while_its_image_moves_is_not_answered(thin, counted):
    found = []
    engine = Engine(found.append, "a test")
    try:
        done = counted("rasterise", engine.cancel)
        engine.submit(a_study(), cold_start=True)
        compute_thread.submit(lambda: None).result(LONG)
        assert (len(done), found) == (1, [])
    finally:
        engine.close()


def test_a_background_job_that_is_dropped_stops(thin, counted, qtbot):
    refused, found = [], []
    jobs = BackgroundJobs(refused.append)
    begun, forgotten = threading.Event(), threading.Event()

    def wait():
        begun.set()
        assert forgotten.wait(LONG)

    done = counted("rasterise", wait)
    jobs.submit("a warp", answers, found.append)
    assert begun.wait(LONG)
    jobs.cancel("a warp")
    forgotten.set()
    compute_thread.submit(lambda: None).result(LONG)
    assert len(done) == 1
    assert not jobs.busy()
    assert (found, refused) == ([], [])
    jobs.release()


def test_a_background_job_that_is_dropped_on_its_way_to_the_window_is_not_shown(qtbot, at_rest):
    shown = []
    jobs = BackgroundJobs(shown.append)
    jobs.submit("a warp", lambda: 1, shown.append)
    compute_thread.submit(lambda: None).result(LONG)
    assert jobs.busy("a warp")
    jobs.cancel()
    assert not jobs.busy()
    jobs.submit("a warp", lambda: 2, shown.append)
    at_rest.until(lambda: not jobs.busy())
    assert shown == [2]
    jobs.release()


def problems(shape=(12, 10, 9)):
    """The same tissue, held here and there: what moves reaches less far, and farther."""
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1] = 1
    more = c.copy()
    more[:, :, :3] = 1
    return Problem(y, more, np.ones(shape)), Problem(y, c, np.ones(shape))


def test_a_solve_that_is_stopped_at_any_look_leaves_nothing_to_the_next():
    before, problem = problems()

    def solved(problem, looks=10**6):
        # By its own thread no more looks are taken than the work takes.
        flag = AfterLooks(looks)
        how = ElasticPrior(), Multigrid(1e-4), "cpu", None, flag
        found = compute_thread.submit(lambda: run_here(problem, *how)).result()
        return found.displacement, looks - flag.left

    expected, _ = solved(problem)
    solved(before)
    _, number = solved(problem)
    assert number > 100
    for at in range(0, number - 1, number // 12):
        solved(before)
        with pytest.raises(Cancelled):
            solved(problem, at)
        np.testing.assert_allclose(solved(problem)[0], expected, atol=2e-4)
