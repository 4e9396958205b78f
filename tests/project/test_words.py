"""Tests of the wording check and of the wording of the package."""

import importlib.util
import sys
from functools import cache
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "words.py"

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="needs a checkout of the repository")


@pytest.fixture(scope="module")
def words():
    spec = importlib.util.spec_from_file_location("the_words", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # Dataclasses look the module up here.
    spec.loader.exec_module(module)
    return module


def test_no_text_violates_a_checked_rule(words):
    found = words.check_all()
    assert not any(found.values()), (
        f"{words.summary(found)}. To list them: python scripts/words.py napari_hmrf"
    )


def test_a_sample_is_reproducible_by_its_seed(words, monkeypatch):
    modules = words.modules([words.PACKAGE / "field"])
    monkeypatch.setattr(words, "modules", lambda: modules)
    monkeypatch.setattr(words, "texts_of", cache(words.texts_of))
    drawn = words.sample(1)
    assert drawn == words.sample(1)
    assert drawn != words.sample(2)
    assert [kind for kind, *_ in drawn].count("comment") == words.SAMPLE["comment"]


MODULE = '''"""Brush tool: paints strokes on the canvas."""

#: How wide a stroke is.
WIDTH = 3
# A comment of two lines, the second
# of which begins as no first line may.


class Brush:
    """Where strokes begin."""

    @property
    def size(self):
        """Width in pixels."""

    def lift(self):
        """Lift the brush when the user asks for that, from\\n        nothing."""

    def paint(self):
        """The strokes of `nobody`."""
        def inner():
            """A detail of its own."""
        raise ValueError(f"no stroke for {self}, who was told")

    def _mix(self):
        """Colours in a row."""
        return "What comes next", "What comes next?", "what a fragment", "who"
'''


def test_each_rule_is_checked_and_valid_texts_are_not_listed(words):
    found = words.check(MODULE, verbs={"lift"}, accepted=set())
    assert [(each.line, each.kind, each.text) for each in found] == [
        (3, "opening", "How wide a stroke is."),
        (10, "opening", "Where strokes begin."),
        (17, "people", "[from nothing] Lift the brush when the user asks for that, from"),
        (20, "verb", "The strokes of `nobody`."),
        (23, "people", "[who] no stroke for {}, who was told"),
        (23, "people", "[was told] no stroke for {}, who was told"),
        (27, "message", "What comes next"),
    ]
    assert len(words.check(MODULE, {"lift"}, {"Where strokes begin."})) == len(found) - 1
