"""Tests that messages use the terms of the interface that shows them."""

import tomllib
from pathlib import Path
from typing import get_args

import pytest

import napari_hmrf
from napari_hmrf import ProblemError
from napari_hmrf.extras import Extra, how_to_install
from napari_hmrf.ui.messages import in_short
from napari_hmrf.ui.window_words import in_window_words
from napari_hmrf.wording import in_shell_words

ROOT = Path(napari_hmrf.__file__).parents[1]


def test_a_setting_is_named_in_the_terms_of_the_interface():
    said = "hold its edge (`hold_edge=True`), or paint the tissue that stays in place"
    assert in_window_words(said) == "hold its edge, or paint the tissue that stays in place"
    assert (
        in_shell_words(said, {"hold_edge"})
        == "hold its edge (--hold-edge), or paint the tissue that stays in place"
    )
    error = ProblemError(
        "tissue", "take the elastic model that holds by confidence (`penalty=None`)"
    )
    assert "('spring strength' under 'Advanced' at 'by confidence')" in in_short(error)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("hold_edge=False", " (without --hold-edge)"),
        ("penalty=None", " (without --penalty)"),
        ('backend="cpu"', " (--backend cpu)"),
        ("weight=..., cavity=...", " (--weight, --cavity)"),
        ("overwrite=True", " (--force)"),
        ("number", " (--slice)"),
        ("sd=0", ""),
        ("Motion(drawing=..., weight=...)", ""),
    ],
)
def test_an_option_of_the_shell_is_named_by_the_rule_of_its_python_name(setting, words):
    options = {"hold_edge", "penalty", "backend", "weight", "cavity", "force", "slice"}
    assert in_shell_words(f"do it (`{setting}`)", options) == f"do it{words}"


@pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="needs a checkout")
def test_extras_are_installed_from_a_copy_of_the_repository():
    assert how_to_install("film").endswith('pip install ".[film]"')
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(get_args(Extra)) <= set(extras["project"]["optional-dependencies"])
