"""Tissue that is dragged while the loops come: they take over, and nobody can tell from the tissue.

Until then shaders solve, which is what they do here until the test says that loops are compiled.
"""

import subprocess
import sys
import threading

import numpy as np
import pytest

from napari_hmrf import Cancelled, ElasticPrior, LiveSolver, solve
from napari_hmrf.solver.backends.compile_cache import disk_cache, loader
from napari_hmrf.solver.backends.compile_cache.sets import COUNTS, FULL_COUNT, HARDER
from napari_hmrf.solver.backends.compile_cache.watch import watched
from napari_hmrf.solver.backends.opengl import is_software_renderer
from tests.support.opengl import require_opengl
from tests.support.problems import pulled_problem
from tests.support.timeouts import LONG


class Hand:
    """Somebody who drags a patch, and sees what comes of it."""

    def __init__(self):
        self.updates = []
        self._came = threading.Condition()
        self._live = LiveSolver(self._see)

    def pull(self, reach):
        return self._live.submit(pulled_problem((reach, -reach / 2), size=48, at=(24, 20)))

    def follow(self, reach):
        """Pull, and look at the answer."""
        number = self.pull(reach)
        with self._came:
            assert self._came.wait_for(lambda: self._answered(number), LONG)
            return self.updates[-1].solution

    def rest(self):
        assert self._live.wait(LONG)

    def let_go(self):
        self._live.close()

    def _answered(self, number):
        return bool(self.updates) and self.updates[-1].number == number

    def _see(self, update):
        with self._came:
            self.updates.append(update)
            self._came.notify_all()


@pytest.fixture
def hand(cold):
    require_opengl()
    made = Hand()
    first = made.follow(0.5)
    if not is_software_renderer(first.provenance.renderer):
        pytest.skip("this machine takes its GPU anyhow")
    assert first.provenance.backend.startswith("opengl")
    yield made
    made.let_go()


def test_the_field_stays_where_it_is_when_the_loops_take_over(hand):
    before = hand.follow(3.0)
    disk_cache.mark().touch()
    with loader._loader.step:
        meanwhile = hand.follow(2.0)
    assert loader.loaded(LONG)
    after = hand.follow(3.0)
    assert [each.provenance.backend.partition(":")[0] for each in (before, meanwhile, after)] == [
        "opengl",
        "opengl",
        "cpu",
    ]
    sure = before.convergence.error + after.convergence.error
    assert np.abs(after.displacement - before.displacement).max() < sure + 1e-5


def test_no_pull_is_without_its_answer_while_the_loops_are_loaded(hand):
    disk_cache.mark().touch()
    for turn in range(12):
        hand.follow(0.6 + turn / 10)
        if turn == 6:
            assert loader.loaded(LONG)
    assert all(update.error is None for update in hand.updates)
    assert {update.number for update in hand.updates} == set(range(1, 14))
    assert hand.updates[-1].solution.provenance.backend == "cpu"


def test_the_newest_of_many_pulls_wins_whoever_solves_it(hand):
    disk_cache.mark().touch()
    last = 0
    for turn in range(60):
        last = hand.pull(1 + turn / 30)
        if turn == 40:
            assert loader.loaded(LONG)
    hand.rest()
    assert hand.updates[-1].number == last
    assert hand.updates[-1].final
    assert hand.updates[-1].solution.provenance.backend == "cpu"


LOADING = """
from napari_hmrf.solver.backends.compile_cache import loader
assert not loader.begun()
loader.loaded(600)
loops = loader.cached_loops()
print(sum(sum(loop.stats.cache_hits.values()) for loop in loops))
print(sum(sum(loop.stats.cache_misses.values()) for loop in loops))
"""


def test_what_is_kept_is_loaded_and_nothing_is_compiled_for_it():
    solve(pulled_problem(), ElasticPrior(), backend="cpu")
    done = subprocess.run(
        [sys.executable, "-c", LOADING], capture_output=True, text=True, check=True, timeout=LONG
    )
    loaded, compiled = map(int, done.stdout.split())
    assert loaded > 10
    assert compiled == 0


COUNTING = """
from napari_hmrf import compiling
from napari_hmrf.solver.backends.compile_cache import watch
from napari_hmrf.solver.backends.thread import compute_thread
for job in compiling.jobs():
    compute_thread.submit(lambda: compiling.run(job, lambda stage: None)).result()
    print(job.name, watch._count_loops())
"""


def test_as_many_loops_are_announced_as_there_are():
    done = subprocess.run(
        [sys.executable, "-c", COUNTING], capture_output=True, text=True, check=True
    )
    found = {name: int(number) for name, number in map(str.split, done.stdout.splitlines())}
    assert set(found) == set(COUNTS) - {HARDER}
    assert COUNTS["elastic"] == pytest.approx(found["elastic"], rel=0.25)
    assert pytest.approx(max(found.values()), rel=0.25) == FULL_COUNT


ONE = """
import numba

@numba.njit
def {name}(x):
    return x + 1
"""


def test_what_is_watched_stops_between_two_loops_when_told():
    names: dict = {}
    for name in ("first", "second"):
        exec(ONE.format(name=name), names)
    told = []

    def tell(stage):
        told.append(stage)
        if len(told) == 2:
            raise Cancelled

    with watched("elastic", tell):
        names["first"](1)
        with pytest.raises(Cancelled):
            names["second"](1)
    assert [len(names[name].signatures) for name in ("first", "second")] == [1, 0]
    assert names["second"](1) == 2
    assert told[1].done == told[0].done + 1
    assert told[1].pace > 0
