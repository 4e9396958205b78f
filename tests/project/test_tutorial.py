"""Tests of the tutorials: named buttons, menus and fields, links and pictures."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorials"
PAGES = sorted(TUTORIAL.glob("*.md"))
IMAGES = TUTORIAL / "images"

#: Bold texts of napari, names of sample images and emphasised words.
NOT_OURS = {
    "Brain",
    "File",
    "Open Sample",
    "Open File(s)...",
    "Save Selected Layers...",
    "Save Screenshot...",
    "View",
    "Scale Bar",
    "New Layer",
    "Points",
    "Plugins",
    "scale",
    "units",
    "Copy scale and transforms",
    "Apply scale/transforms from Clipboard",
    "in the same order",
    "The command palette",
    "Show Orthogonal Views",
    "The image does not fit into the canvas.",
    "You want to move the view, not the tissue.",
    "Nothing moves when you drag.",
    "A message says that there is no tissue at that position.",
    "A warning reports pixels where tissue is pushed through itself.",
    "You want to start again.",
    'A text ends in "more".',
}

pytestmark = pytest.mark.skipif(not PAGES, reason="needs a checkout of the repository")


def words(page):
    return " ".join(page.read_text(encoding="utf-8").split())


def quoted(page):
    """Return the texts in bold, with menus split into entries."""
    return {
        part.strip()
        for bold in re.findall(r"\*\*(.+?)\*\*", words(page))
        for part in bold.split(" > ")
    }


@pytest.fixture(scope="module")
def strings():
    """Return all strings in the code and in the manifest."""
    manifest = (ROOT / "napari_hmrf" / "napari.yaml").read_text(encoding="utf-8")
    found = {line.partition(": ")[2].strip().strip('"') for line in manifest.splitlines()}
    for module in (ROOT / "napari_hmrf").rglob("*.py"):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(" ".join(node.value.split()))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_controls_named_in_a_page_exist(page, strings):
    names = quoted(page) - NOT_OURS
    assert names
    # napari adds the name of the plugin to the name of a dock.
    assert {name.removesuffix(" (napari-hmrf)") for name in names} <= strings


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_menus_are_named_as_napari_shows_them(page):
    for bold in re.findall(r"\*\*(Plugins > .+?)\*\*", words(page)):
        assert bold == "Plugins > Soft tissue (napari-hmrf)"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_linked_page_and_picture_exists(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", text):
        assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_every_picture_is_shown_and_small():
    pictures = [path for path in IMAGES.iterdir() if path.suffix in (".png", ".gif")]
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in pictures:
        assert f"images/{picture.name}" in text, f"{picture.name} is not shown"
    assert sum(picture.stat().st_size for picture in pictures) < 3_000_000
    assert (IMAGES / "grab-and-pull.gif").stat().st_size < 1_500_000


def test_every_page_is_linked_from_the_first_page_and_the_tutorial_from_the_readme():
    first = (TUTORIAL / "README.md").read_text(encoding="utf-8")
    for page in PAGES:
        assert page.name == "README.md" or f"({page.name})" in first
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "(docs/tutorials/README.md)" in readme
    assert "docs/tutorials/images/grab-and-pull.gif" in readme
