"""Tests that messages use the terms of the interface that shows them."""

import tomllib
from pathlib import Path
from typing import get_args

import pytest

import napari_hmrf
from napari_hmrf import ProblemError
from napari_hmrf.extras import Extra, how_to_install
from napari_hmrf.ui.messages import in_short
from napari_hmrf.wording import in_words_of

ROOT = Path(napari_hmrf.__file__).parents[1]


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


@pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="needs a checkout")
def test_extras_are_installed_from_a_copy_of_the_repository():
    assert how_to_install("film").endswith('pip install ".[film]"')
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert set(get_args(Extra)) <= set(extras["project"]["optional-dependencies"])
