"""Queue that runs only the latest job."""

import threading
from functools import partial

import pytest

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.latest_queue import LatestQueue
from tests.support.timeouts import LONG


@pytest.fixture
def queue():
    made = LatestQueue("a test")
    yield made
    made.close()


@pytest.fixture
def occupied():
    """Keep the compute thread occupied until the event is set."""
    begun, over = threading.Event(), threading.Event()
    compute_thread.submit(lambda: (begun.set(), over.wait(LONG)))
    assert begun.wait(LONG)
    yield over
    over.set()


def test_only_the_latest_pending_job_runs(queue, occupied):
    ran = []
    turns = [queue.submit(lambda turn: ran.append(turn.generation)) for _ in range(5)]
    occupied.set()
    assert queue.wait(LONG)
    assert ran == [5]
    assert [turn.generation for turn in turns] == [1, 2, 3, 4, 5]


def test_a_running_job_continues_until_its_patience_ends(queue):
    flags = []

    def job(turn):
        if turn.generation == 1:
            queue.submit(job)
            flags.append(turn.is_set())
            turn.patience = 0
            flags.append(turn.is_set())

    queue.submit(job)
    assert queue.wait(LONG)
    assert flags == [False, True]


def test_patience_has_no_effect_without_a_newer_job(queue):
    flags = []
    queue.submit(lambda turn: flags.append(turn.is_set()), patience=0)
    assert queue.wait(LONG)
    assert flags == [False]


def test_a_held_queue_starts_its_latest_job_when_it_is_resumed(queue):
    ran = []

    def job(turn):
        ran.append(turn.generation)
        if turn.generation == 1:
            queue.hold()

    queue.submit(job)
    assert queue.wait(LONG)
    queue.submit(job)
    queue.submit(job)
    compute_thread.submit(lambda: None).result(LONG)
    assert ran == [1]
    assert queue.busy
    queue.resume()
    assert queue.wait(LONG)
    assert ran == [1, 3]
    assert not queue.busy


def test_a_dropped_job_cannot_hold_the_queue(queue):
    def dropped(_):
        queue.drop()
        queue.hold()

    queue.submit(dropped)
    assert queue.wait(LONG)
    assert not queue.is_held


def test_dropped_jobs_do_not_run_and_later_jobs_do(queue, occupied):
    ran = []
    first = queue.submit(ran.append)
    queue.drop()
    assert not queue.busy
    occupied.set()
    second = queue.submit(ran.append)
    assert queue.wait(LONG)
    assert ran == [second]
    assert first.dropped
    assert not second.dropped
    queue.drop()
    assert second.dropped, "a finished job should count as dropped, too"


def test_the_next_job_runs_after_a_failed_job(queue, caplog):
    ran = []
    queue.submit(lambda _: 1 / 0)
    assert queue.wait(LONG)
    queue.submit(ran.append)
    assert queue.wait(LONG)
    assert len(ran) == 1
    assert "a background job failed" in caplog.text


def test_queues_alternate(queue, occupied):
    other, order = LatestQueue("another test"), []

    def again(name, own, turn):
        order.append(name)
        if turn.generation < 3:
            own.submit(partial(again, name, own))

    queue.submit(partial(again, "a", queue))
    other.submit(partial(again, "b", other))
    occupied.set()
    assert queue.wait(LONG)
    assert other.wait(LONG)
    other.close()
    assert order == ["a", "b"] * 3
