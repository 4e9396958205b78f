"""Cache of compiled loops, invalidated by changes of their source."""

import importlib
import shutil
import sys
from pathlib import Path

import pytest

from napari_hmrf.compute.compile_cache import disk_cache
from napari_hmrf.compute.compile_cache.disk_cache import sources
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


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with loops in two modules and the decorators that compile them."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    # Python compares times of modules in seconds, and the tests edit a module sooner.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(disk_cache, "sources", lambda: sources(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    shutil.copy(compiled.__file__, tmp_path)
    (tmp_path / "caller.py").write_text(CALLER)
    yield tmp_path
    forget_modules()


def forget_modules():
    for name in ("compiled", "callee", "caller"):
        sys.modules.pop(name, None)
    sources.cache_clear()


def run_in_new_modules():
    """Import the modules anew; return the result of the loops and the number of cache hits."""
    forget_modules()
    importlib.invalidate_caches()
    answer = importlib.import_module("caller").answer
    return answer(1.0), sum(answer.stats.cache_hits.values())


def test_a_loop_is_recompiled_when_a_module_it_calls_changes(folder):
    callee = folder / "callee.py"
    callee.write_text(CALLEE.format(number=1))
    assert run_in_new_modules() == (3, 0)
    assert run_in_new_modules() == (3, 1)
    callee.write_text(CALLEE.format(number=9))
    assert run_in_new_modules() == (19, 0)


def test_every_kernel_uses_the_decorators_of_this_module():
    here = Path(compiled.__file__)
    for path in here.parent.glob("*.py"):
        assert path == here or "njit" not in path.read_text(encoding="utf-8"), path.name
