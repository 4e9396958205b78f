"""What is kept of compiled loops is what their source says now."""

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
ASKED = """
from caller import answer
print(answer(1.0), sum(answer.stats.cache_hits.values()))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with loops of two files and our way to compile them."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    shutil.copy(compiled.__file__, tmp_path)
    (tmp_path / "caller.py").write_text(CALLER)
    return tmp_path


def asked(folder):
    """What the loops answer in a new process, and how many were there already."""
    command = [sys.executable, "-c", ASKED]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    answer, hits = done.stdout.split()
    return float(answer), int(hits)


def test_a_loop_is_compiled_again_when_another_file_that_it_calls_changes(folder):
    callee = folder / "callee.py"
    callee.write_text(CALLEE.format(number=1))
    assert asked(folder) == (3, 0)
    assert asked(folder) == (3, 1)
    callee.write_text(CALLEE.format(number=9))
    assert asked(folder) == (19, 0)


def test_all_kernels_are_compiled_in_one_of_these_ways():
    here = Path(compiled.__file__)
    for path in here.parent.glob("*.py"):
        assert path == here or "njit" not in path.read_text(encoding="utf-8"), path.name
