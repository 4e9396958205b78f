"""Switch from shaders to compiled loops during a drag.

Shaders solve until the test marks the loops as compiled.
"""

import subprocess
import sys
import threading

import numpy as np
import pytest

from napari_hmrf import Cancelled, ElasticPrior, LiveSolver, solve
from napari_hmrf.compute.compile_cache import disk_cache, loader
from napari_hmrf.compute.compile_cache.sets import COSTS
from napari_hmrf.compute.compile_cache.watch import watched
from napari_hmrf.solver.backends.opengl import is_software_renderer
from tests.support.opengl import require_opengl
from tests.support.timeouts import LONG
from validation.bodies import pulled_problem


class Drag:
    """Drag of a patch with a live solver, with recorded updates."""

    def __init__(self):
        self.updates = []
        self._came = threading.Condition()
        self._live = LiveSolver(self._see)

    def pull(self, reach):
        return self._live.submit(pulled_problem((reach, -reach / 2), size=48, at=(24, 20)))

    def pull_and_wait(self, reach):
        """Pull the patch and return the solution."""
        number = self.pull(reach)
        with self._came:
            assert self._came.wait_for(lambda: self._answered(number), LONG)
            return self.updates[-1].solution

    def rest(self):
        assert self._live.wait(LONG)

    def release(self):
        self._live.close()

    def _answered(self, number):
        return bool(self.updates) and self.updates[-1].number == number

    def _see(self, update):
        with self._came:
            self.updates.append(update)
            self._came.notify_all()


@pytest.fixture
def drag(cold):
    require_opengl()
    made = Drag()
    first = made.pull_and_wait(0.5)
    if not is_software_renderer(first.provenance.renderer):
        pytest.skip("this machine has a GPU")
    assert first.provenance.backend.startswith("opengl")
    yield made
    made.release()


def test_the_field_does_not_change_when_the_loops_take_over(drag):
    before = drag.pull_and_wait(3.0)
    disk_cache.mark().touch()
    with loader._loader.step:
        meanwhile = drag.pull_and_wait(2.0)
    assert loader.loaded(wait=LONG)
    after = drag.pull_and_wait(3.0)
    assert [each.provenance.backend.partition(":")[0] for each in (before, meanwhile, after)] == [
        "opengl",
        "opengl",
        "cpu",
    ]
    sure = before.convergence.error + after.convergence.error
    assert np.abs(after.displacement - before.displacement).max() < sure + 1e-5


def test_each_pull_is_solved_while_the_loops_load(drag):
    disk_cache.mark().touch()
    for turn in range(12):
        drag.pull_and_wait(0.6 + turn / 10)
        if turn == 6:
            assert loader.loaded(wait=LONG)
    assert all(update.error is None for update in drag.updates)
    assert {update.number for update in drag.updates} == set(range(1, 14))
    assert drag.updates[-1].solution.provenance.backend == "cpu"


def test_the_latest_of_many_pulls_wins_on_either_backend(drag):
    disk_cache.mark().touch()
    last = 0
    for turn in range(60):
        last = drag.pull(1 + turn / 30)
        if turn == 40:
            assert loader.loaded(wait=LONG)
    drag.rest()
    assert drag.updates[-1].number == last
    assert drag.updates[-1].final
    assert drag.updates[-1].solution.provenance.backend == "cpu"


LOADING = """
from napari_hmrf.compute.compile_cache import loader
assert not loader.begun()
loader.loaded(wait=600)
loops = loader.cached_loops()
print(sum(sum(loop.stats.cache_hits.values()) for loop in loops))
print(sum(sum(loop.stats.cache_misses.values()) for loop in loops))
"""


def test_cached_loops_are_loaded_without_compilation():
    solve(pulled_problem(), ElasticPrior(), backend="cpu")
    done = subprocess.run(
        [sys.executable, "-c", LOADING], capture_output=True, text=True, check=True, timeout=LONG
    )
    loaded, compiled = map(int, done.stdout.split())
    assert loaded > 10
    assert compiled == 0


COUNTING = """
from napari_hmrf import compiling
from napari_hmrf.compute.compile_cache import watch
from napari_hmrf.compute.thread import compute_thread
for job in compiling.jobs():
    compute_thread.submit(lambda: compiling.run(job, lambda stage: None)).result()
    print(job.name, watch._count_loops())
"""


@pytest.mark.campaign
def test_the_expected_number_of_loops_is_about_right():
    done = subprocess.run(
        [sys.executable, "-c", COUNTING], capture_output=True, text=True, check=True
    )
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, _ in lines] == [*COSTS]
    counts = np.diff([0, *(int(number) for _, number in lines)])
    expected = [cost.loops for cost in COSTS.values()]
    np.testing.assert_allclose(counts, expected, atol=2)


ONE = """
import numba

@numba.njit
def {name}(x):
    return x + 1
"""


def test_a_watched_compilation_can_be_cancelled_between_two_loops():
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
    assert told[1].loops == told[0].loops + 1
    assert told[1].pace > 0
