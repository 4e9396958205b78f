"""Tests that messages use the terms of the interface that shows them."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

import napari_hmrf
from napari_hmrf import ProblemError
from napari_hmrf.extras import Extra, how_to_install
from napari_hmrf.ui.messages import in_short
from napari_hmrf.wording import TERMS, in_words_of

PACKAGE = Path(napari_hmrf.__file__).parent
ROOT = PACKAGE.parent
#: Subpackages whose messages are shown by all interfaces.
CORE = ("solver", "field", "tissue", "study", "io", "augmentation", "samples")


@cache
def messages_of_core():
    """Return the strings of the core that are not docstrings, each with the name of its file."""
    found = []
    for path in (path for room in CORE for path in (PACKAGE / room).rglob("*.py")):
        nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
        bare = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        strings = (
            each for each in nodes if isinstance(each, ast.Constant) and id(each) not in bare
        )
        found += [(path.name, each.value) for each in strings if isinstance(each.value, str)]
    return found


def test_a_setting_is_named_in_the_terms_of_the_interface():
    said = "hold its edge (`hold_edge=True`), or paint the tissue that stays in place"
    assert (
        in_words_of("shell", said)
        == "hold its edge (--hold-edge), or paint the tissue that stays in place"
    )
    assert in_words_of("window", said) == "hold its edge, or paint the tissue that stays in place"
    assert in_words_of("shell", "see (`unknown`)") == "see (`unknown`)"
    error = ProblemError(
        "tissue", "take the elastic model that holds by confidence (`penalty=None`)"
    )
    assert "('spring strength' under 'Advanced' at 'by confidence')" in in_short(error)


def test_every_setting_in_a_message_has_a_term_for_shell_and_window():
    found = {
        setting for _, text in messages_of_core() for setting in re.findall(r"\(`([^`]+)`\)", text)
    }
    assert found == set(TERMS)


def test_no_message_of_the_core_names_a_control_of_the_window():
    window = re.compile(r"'Advanced'|\btick\b|under 'Ad|\bpress Deform|\bthe menu\b", re.IGNORECASE)
    found = [f"{name}: {text}" for name, text in messages_of_core() if window.search(text)]
    assert found == []


def test_extras_are_installed_from_a_copy_of_the_repository():
    assert how_to_install("film").endswith('pip install ".[film]"')
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(get_args(Extra)) <= set(extras["project"]["optional-dependencies"])


@pytest.mark.skipif(not (ROOT / "docs").exists(), reason="needs a checkout of the repository")
def test_no_hint_installs_an_extra_from_a_registry():
    files = [
        path
        for folder in ("napari_hmrf", "docs", "benchmarks", "examples")
        for kind in ("*.py", "*.md")
        for path in (ROOT / folder).rglob(kind)
    ]
    assert len(files) > 100
    named = [
        path.name
        for path in files
        if re.search(
            r"pip install\s+[\"']?(napari-hmrf\[|imageio-ffmpeg|distributed|monai|simpleitk)",
            path.read_text(encoding="utf-8"),
            re.IGNORECASE,
        )
    ]
    assert named == []
