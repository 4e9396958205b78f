"""Tests of versions that are stated in several files of the repository."""

import re
import tomllib
from pathlib import Path

import pytest

import napari_hmrf
from napari_hmrf import errors

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(
    not (ROOT / "CITATION.cff").exists(), reason="needs a checkout of the repository"
)


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere():
    assert tomllib.loads(read("pyproject.toml"))["project"]["version"] == napari_hmrf.__version__
    assert re.findall(r"^version: (.*)$", read("CITATION.cff"), re.M) == [napari_hmrf.__version__]


def test_the_page_of_errors_lists_every_error_of_the_package():
    page = read("docs/reference/errors.md")
    listed = set(re.findall(r"^\.\. autoexception:: .*\.(\w+)$", page, re.M))
    classes = (found for found in vars(errors).values() if isinstance(found, type))
    assert {found.__name__ for found in classes if issubclass(found, Exception)} == listed


def test_the_lower_bounds_of_dependencies_are_tested_versions():
    bounds = tomllib.loads(read("pyproject.toml"))["project"]["dependencies"]
    oldest = [line for line in read(".github/oldest.txt").splitlines() if "==" in line]
    assert [line.replace(">=", "==") for line in bounds] == oldest
