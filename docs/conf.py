"""How `make docs` builds the site: from the pages of this folder, README, CONTRIBUTING, CHANGELOG.

Pages are written to be read in the repository, too, where a link names a file. Files at the top of
the repository have pages here that are empty but for a title; these are filled in, and links are
turned, while the site is built. The first page of a folder is its README, and the menu has below it
the pages that it links. Nothing is fetched: no other site is asked.
"""

from __future__ import annotations

import os.path
import re
import tomllib
from pathlib import Path, PurePosixPath

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

#: Pages of the site, and the files at the top of the repository that they show.
SHOWN = {
    "overview": "README.md",
    "changelog": "CHANGELOG.md",
    "development/contributing": "CONTRIBUTING.md",
}

_project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
project = _project["name"]
author = _project["authors"][0]["name"]
version = release = _project["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
myst_heading_anchors = 4
default_role = "py:obj"
highlight_language = "none"

# Docstrings say types, shapes, units and directions; signatures repeat only names and defaults.
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"{project} {version}"
html_show_copyright = False
html_copy_source = False

_LINK = re.compile(r"(\]\()(?!https?:|#)([^)#\s]+)(#[^)\s]*)?(\))")


def turned(text: str, source: str, page: str) -> str:
    """Have links that are relative to a file of the repository lead there from a page of the site.

    Parameters
    ----------
    text : str
        Markdown.
    source : str
        The file that it is from, relative to the top of the repository.
    page : str
        The page that shows it, relative to this folder, without its suffix.
    """
    pages = {shown: f"docs/{name}.md" for name, shown in SHOWN.items()}

    def turn(link: re.Match[str]) -> str:
        opening, target, anchor, closing = link.groups()
        there = os.path.normpath(PurePosixPath(source).parent / target)
        there = pages.get(Path(there).as_posix(), there)
        found = os.path.relpath(there, PurePosixPath("docs", page).parent)
        return f"{opening}{Path(found).as_posix()}{anchor or ''}{closing}"

    return _LINK.sub(turn, text)


def contents(text: str) -> str:
    """What is to be added to the first page of a folder: the pages that it links, for the menu."""
    linked = dict.fromkeys(re.findall(r"\]\(([\w-]+)\.md", text))
    return "\n".join(["", "", "```{toctree}", ":hidden:", "", *linked, "```", ""]) if linked else ""


def show(_app, page, content):
    """Fill in the pages of `SHOWN`, and turn the links of all."""
    source = SHOWN.get(page, f"docs/{page}.md")
    text = (ROOT / source).read_text(encoding="utf-8") if page in SHOWN else content[0]
    content[0] = turned(text, source, page)
    if page.endswith("/README"):
        content[0] += contents(text)


_said: dict[str, list[str]] = {}


def remember(_app, what, name, _object, _options, lines):
    """Keep what a property says: napoleon takes what stands before a colon for its type."""
    if what == "property":
        _said[name] = list(lines)


def restore(_app, what, name, _object, _options, lines):
    """Have a property say what it said."""
    if what == "property":
        lines[:] = _said[name]


def unlink(_app, doctree):
    """In the types of parameters the word "shape" is a word, not a name of ours."""
    from sphinx.addnodes import pending_xref

    for link in list(doctree.findall(pending_xref)):
        if link["reftarget"] == "shape" and link["reftype"] == "class":
            link.replace_self(link.children)


def setup(app):
    """Called by Sphinx."""
    app.connect("source-read", show)
    app.connect("autodoc-process-docstring", remember, priority=400)
    app.connect("autodoc-process-docstring", restore, priority=600)
    app.connect("doctree-read", unlink)
