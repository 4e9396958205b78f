"""Tests of the count of lines of code."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "lines.py"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs a checkout of the repository")

MODULE = '''"""What this is.

At length.
"""

import math  # used below

#: A number.
SIDES = (
    3,

    4,
)


def area(radius):
    """Of a disc."""
    text = """not
    a docstring"""
    return math.pi * radius**2, text
'''


@pytest.fixture
def script():
    return runpy.run_path(str(SCRIPT))


def test_blank_lines_comments_and_docstrings_are_not_counted(script):
    assert script["lines_of_code"](MODULE) == 9
    assert script["lines_of_code"]('"""Nothing but words."""\n') == 0


def test_each_folder_is_counted_with_and_without_its_subfolders(script, tmp_path, capsys):
    below = tmp_path / "room" / "corner"
    below.mkdir(parents=True)
    (below / "one.py").write_text("one = 1\n")
    (below.parent / "two.py").write_text("two = 2\n\nthree = 3\n")
    assert script["main"]([str(below.parent)]) == 0
    words = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["room", "1", "2", "2", "3"] in words
    assert ["room/corner", "1", "1"] in words
    assert words[-1] == ["total", "2", "3"]
    assert script["main"]([str(tmp_path / "nowhere")]) == 1
