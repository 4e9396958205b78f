"""Cache of compiled loops, invalidated by changes of their source."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from napari_hmrf.solver.backends.cpu import compiled

CALLEE = """
from compiled import inline, shared
from numba import float64

@inline
def one(x):
    return x + float64({number})

@shared
def other(x):
    return x * float64({number})
"""
CALLER = """
from compiled import strict
from callee import one, other

@strict
def answer(x):
    return one(x) + other(x)
"""
SCRIPT = """
from caller import answer
print(answer(1.0), sum(answer.stats.cache_hits.values()))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with loops in two modules and the decorators that compile them."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    shutil.copy(compiled.__file__, tmp_path)
    (tmp_path / "caller.py").write_text(CALLER)
    return tmp_path


def run_in_new_process(folder):
    """Return the result of the loops in a new process, and the number of cache hits."""
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    answer, hits = done.stdout.split()
    return float(answer), int(hits)


def test_a_loop_is_recompiled_when_a_module_it_calls_changes(folder):
    callee = folder / "callee.py"
    callee.write_text(CALLEE.format(number=1))
    assert run_in_new_process(folder) == (3, 0)
    assert run_in_new_process(folder) == (3, 1)
    callee.write_text(CALLEE.format(number=9))
    assert run_in_new_process(folder) == (19, 0)


def test_every_kernel_uses_the_decorators_of_this_module():
    here = Path(compiled.__file__)
    for path in here.parent.glob("*.py"):
        assert path == here or "njit" not in path.read_text(encoding="utf-8"), path.name
