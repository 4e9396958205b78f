"""Multithreaded loops: each thread computes its part, and turns follow each other."""

import numba
import numpy as np
import pytest

from napari_hmrf.compute.compile_cache.threaded import LOOPS, portion, threaded
from napari_hmrf.compute.thread import compute_thread


@numba.njit(**LOOPS)
def scratch(length):
    return np.ones(length)


@numba.njit(**LOOPS)
def total(length):
    return scratch(length).sum()


@threaded()
def note(thread, seen):
    for i in portion(thread, len(seen)):
        seen[i] += 1


@threaded()
def mean_of_neighbours(thread, values):
    now, before = values[thread[2] + 1], values[thread[2]]
    for i in portion(thread, len(now) - 2):
        now[i + 1] = (before[i] + before[i + 2]) / 2


@threaded()
def large(thread, lengths, sums):
    for i in portion(thread, len(lengths)):
        sums[i] = total(lengths[i])


@threaded()
def leak(thread, lengths, sums):
    for i in portion(thread, len(lengths)):
        sums[i] = scratch(lengths[i])[0]


def on_threads(count, loop, *arguments):
    def run():
        before = numba.get_num_threads()
        numba.set_num_threads(count)
        try:
            loop(*arguments)
        finally:
            numba.set_num_threads(before)

    compute_thread.submit(run).result()


THREADS = range(1, numba.config.NUMBA_NUM_THREADS + 1)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("rows", [0, 1, 2, 5, 1000])
def test_each_row_is_computed_once_by_any_number_of_threads(threads, rows):
    seen = np.zeros(rows)
    on_threads(threads, note, seen)
    np.testing.assert_array_equal(seen, 1)


@pytest.mark.parametrize("threads", THREADS)
def test_all_threads_finish_a_turn_before_the_next_one(threads):
    values = np.zeros((200, 51))
    values[0, 25] = 2.0**60
    expected = values.copy()
    for k in range(199):
        expected[k + 1, 1:-1] = (expected[k, :-2] + expected[k, 2:]) / 2
    on_threads(threads, mean_of_neighbours.in_turns, 199, values)
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("threads", THREADS)
def test_a_loop_without_enough_memory_says_so(threads):
    lengths, sums = np.array([3, 2**55, 4]), np.zeros(3)
    with pytest.raises(MemoryError, match="not enough memory for a loop"):
        on_threads(threads, large, lengths, sums)
    on_threads(threads, large, np.array([3, 2, 4]), sums)
    np.testing.assert_array_equal(sums, [3, 2, 4])


def test_a_loop_that_would_never_free_an_array_is_not_compiled():
    with pytest.raises(TypeError, match="leak calls scratch, which returns an array"):
        compute_thread.submit(lambda: leak(np.array([3]), np.zeros(1))).result()
