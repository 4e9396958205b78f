"""Cancellation of work on volumes: every loop checks for it slab by slab."""

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
    solve,
    warp,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import Cancelled
from napari_hmrf.field import slabs, tetrahedron_raster, volume_loops
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.study.engine import Engine
from napari_hmrf.study.study import Pictures
from napari_hmrf.ui.jobs import Jobs
from tests.support.cancel_flags import AfterLooks
from tests.support.timeouts import LONG

#: At least three slabs of four planes per core.
SHAPE = (12 * numba.config.NUMBA_NUM_THREADS, 9, 8)
#: Loops that process a volume slab by slab, with their modules.
LOOPS = {
    "rasterise": tetrahedron_raster,
    "look_up": volume_loops,
    "determinants": volume_loops,
}


@pytest.fixture
def thin_slabs(monkeypatch):
    """Make the slabs as thin as possible."""
    monkeypatch.setattr(slabs, "VOXELS", 1)


@pytest.fixture
def count_slabs(monkeypatch):
    """Return a function that counts the slabs of a loop and calls a callback at each."""

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


def warp_and_determinants():
    """Return a warped image and the smallest determinant at each site."""
    image = np.random.default_rng(0).random(SHAPE)
    return warp(image, waves(), spacing=1, tissue=a_ball()), smallest_determinant(
        waves(), 1, a_ball()
    )


def on_compute_thread(work, stop):
    """Run work on the compute thread and cancel it when `stop` is set."""

    def job():
        with compute_thread.unless(stop.is_set):
            return work()

    return compute_thread.submit(job).result()


def test_processing_in_slabs_does_not_change_the_result(monkeypatch):
    whole = warp_and_determinants()
    monkeypatch.setattr(slabs, "VOXELS", 1)
    for one, other in zip(whole, warp_and_determinants(), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("loop", LOOPS)
def test_the_warp_of_a_volume_stops_at_the_slab_where_it_is_cancelled(
    thin_slabs, count_slabs, loop
):
    stop = threading.Event()
    done = count_slabs(loop, stop.set)
    with pytest.raises(Cancelled):
        on_compute_thread(warp_and_determinants, stop)
    assert len(done) == 1
    stop.clear()
    done.clear()
    count_slabs(loop, lambda: None)
    on_compute_thread(warp_and_determinants, threading.Event())
    assert len(done) >= 3


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot send a signal to a thread")
def test_ctrl_c_stops_a_warp(thin_slabs, count_slabs, request):
    # A background process may ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    left = threading.Event()

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        assert left.wait(LONG)

    done = count_slabs("rasterise", interrupt)
    with pytest.raises(KeyboardInterrupt):
        warp_and_determinants()
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


def test_a_study_cancelled_during_its_warp_delivers_no_result(thin_slabs, count_slabs):
    found = []
    engine = Engine(found.append, "a test")
    try:
        done = count_slabs("rasterise", engine.cancel)
        engine.submit(a_study(), cold_start=True)
        compute_thread.submit(lambda: None).result(LONG)
        assert (len(done), found) == (1, [])
    finally:
        engine.close()


def test_a_cancelled_background_job_stops(thin_slabs, count_slabs, qtbot):
    refused, found = [], []
    jobs = Jobs()
    jobs.refused.connect(refused.append)
    begun, forgotten = threading.Event(), threading.Event()

    def wait():
        begun.set()
        assert forgotten.wait(LONG)

    done = count_slabs("rasterise", wait)
    jobs.submit("a warp", warp_and_determinants, found.append)
    assert begun.wait(LONG)
    jobs.cancel("a warp")
    forgotten.set()
    compute_thread.submit(lambda: None).result(LONG)
    assert len(done) == 1
    assert not jobs.busy()
    assert (found, refused) == ([], [])
    jobs.release()


def test_the_result_of_a_job_cancelled_before_delivery_is_not_shown(qtbot, at_rest):
    shown = []
    jobs = Jobs()
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
    """Return two problems on the same tissue: more sites fixed, and fewer."""
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1] = 1
    more = c.copy()
    more[:, :, :3] = 1
    return Problem(observed=y, confidence=more, stiffness=np.ones(shape)), Problem(
        observed=y, confidence=c, stiffness=np.ones(shape)
    )


def test_a_cancelled_solve_does_not_affect_the_next_solve():
    before, problem = problems()

    def solved(problem, looks=10**6):
        # On the compute thread only the solve itself checks the flag.
        flag = AfterLooks(looks)
        how = {"optimizer": Multigrid(1e-4), "backend": "cpu", "cancel": flag}
        found = compute_thread.submit(lambda: solve(problem, ElasticPrior(), **how)).result()
        return found.displacement, looks - flag.left

    expected, _ = solved(problem)
    solved(before)
    _, number = solved(problem)
    assert number > 100
    for at in range(0, number - 1, number // 6):
        solved(before)
        with pytest.raises(Cancelled):
            solved(problem, at)
        np.testing.assert_allclose(solved(problem)[0], expected, atol=2e-4)
