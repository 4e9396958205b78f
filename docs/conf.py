"""Configuration of the site that `make docs` builds from the pages of this folder.

The pages are also readable in the repository, where a link names a file. Three kinds of page are
completed during the build: files at the top of the repository are inserted into pages that hold
only a title, notebooks become Markdown, and the reference of the shell is made from its parser. The
first page of a folder is its README; the menu lists the pages that it links. The build reads no
other site. It also warns of public names that the reference does not describe, and of links to
missing files in Markdown that is no page.
"""

from __future__ import annotations

import argparse
import json
import os.path
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from sphinx.util import logging

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

#: Pages of the site, and the files at the top of the repository that they show.
SHOWN = {
    "overview": "README.md",
    "changelog": "CHANGELOG.md",
    "development/contributing": "CONTRIBUTING.md",
}
#: Page that gets the commands of the shell.
SHELL_PAGE = "reference/shell"

_project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
project = _project["name"]
author = _project["authors"][0]["name"]
version = release = _project["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".ipynb": "markdown"}
exclude_patterns = ["_build"]
myst_heading_anchors = 4
default_role = "py:obj"
highlight_language = "none"

# Docstrings state types, shapes, units and directions; signatures show only names and defaults.
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

_logger = logging.getLogger(__name__)
_LINK = re.compile(r"(\]\()(?!https?:|#)([^)#\s]+)(#[^)\s]*)?(\))")


def turned(text: str, source: str, page: str) -> str:
    """Rewrite links relative to a file of the repository as links of a page of the site.

    Parameters
    ----------
    text : str
        Markdown.
    source : str
        File that contains the text, relative to the top of the repository.
    page : str
        Page that shows it, relative to this folder, without its suffix.
    """
    pages = {shown: f"docs/{name}.md" for name, shown in SHOWN.items()}

    def turn(link: re.Match[str]) -> str:
        opening, target, anchor, closing = link.groups()
        there = os.path.normpath(PurePosixPath(source).parent / target)
        there = pages.get(Path(there).as_posix(), there)
        found = os.path.relpath(there, PurePosixPath("docs", page).parent)
        return f"{opening}{Path(found).as_posix()}{anchor or ''}{closing}"

    return _LINK.sub(turn, text)


def offer_files(text: str, page: str) -> str:
    """Rewrite links to Markdown outside this folder as downloads: they are no pages of the site."""

    def offer(link: re.Match[str]) -> str:
        opening, target, anchor, closing = link.groups()
        there = os.path.normpath(PurePosixPath("docs", page).parent / target)
        is_page = Path(there).parts[0] == "docs" or not target.endswith(".md")
        return link.group() if is_page else f"{opening}path:{target}{anchor or ''}{closing}"

    return _LINK.sub(offer, text)


def contents(text: str) -> str:
    """Return the menu of a folder: the pages that its first page links."""
    linked = dict.fromkeys(re.findall(r"\]\(([\w-]+)\.(?:md|ipynb)", text))
    return "\n".join(["", "", "```{toctree}", ":hidden:", "", *linked, "```", ""]) if linked else ""


def notebook_cells(text: str) -> Iterator[tuple[str, str]]:
    """Yield the type, "markdown" or "code", and the source of each cell of a notebook."""
    for cell in json.loads(text)["cells"]:
        yield cell["cell_type"], "".join(cell["source"])


def notebook_page(text: str) -> str:
    """Return a notebook as Markdown."""
    parts = [
        source if kind == "markdown" else f"```python\n{source}\n```"
        for kind, source in notebook_cells(text)
    ]
    return "\n\n".join(parts)


def shell_commands() -> str:
    """Return the commands of the shell and their options as Markdown."""
    from napari_hmrf.cli import parser_of_commands

    parser = parser_of_commands()
    (commands,) = (
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    )
    width, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "88"
    try:
        parts = [_command_section(name, each) for name, each in commands.choices.items()]
    finally:
        os.environ.pop("COLUMNS")
        if width is not None:
            os.environ["COLUMNS"] = width
    return "\n".join(parts)


def _command_section(name: str, command: argparse.ArgumentParser) -> str:
    """Return one command: its sentence, usage, arguments and example."""
    example = (command.epilog or "").removeprefix("example: ")
    usage = command.format_usage().removeprefix("usage: ").rstrip()
    lines = ["", f"## {name}", "", command.description or "", "", "```", usage, "```", ""]
    for action in command._actions:
        if not isinstance(action, argparse._HelpAction):
            formatter = command._get_formatter()
            title = formatter._format_action_invocation(action)
            if not action.option_strings and action.nargs in ("+", "*"):
                title += " ..."
            told = formatter._expand_help(action) if action.help else ""
            lines += [f"- `{title}`: {told}"]
    return "\n".join([*lines, "", "Example:", "", "```sh", example, "```", ""])


def show(_app, page, content):
    """Complete a page before Sphinx parses it."""
    source = SHOWN.get(page, f"docs/{page}.md")
    text = (ROOT / source).read_text(encoding="utf-8") if page in SHOWN else content[0]
    if page.startswith("notebooks/") and text.startswith("{"):
        text = notebook_page(text)
    content[0] = offer_files(turned(text, source, page), page)
    if page.endswith("/README"):
        content[0] += contents(text)
    if page == SHELL_PAGE:
        content[0] += shell_commands()


_property_docs: dict[str, list[str]] = {}


def remember(_app, what, name, _object, _options, lines):
    """Store the docstring of a property: napoleon takes words before a colon for its type."""
    if what == "property":
        _property_docs[name] = list(lines)


def restore(_app, what, name, _object, _options, lines):
    """Restore the docstring of a property."""
    if what == "property":
        lines[:] = _property_docs[name]


def unlink(_app, doctree):
    """Remove links from the word "shape" in the types of parameters."""
    from sphinx.addnodes import pending_xref

    for link in list(doctree.findall(pending_xref)):
        if link["reftarget"] == "shape" and link["reftype"] == "class":
            link.replace_self(link.children)


def check_links(_app):
    """Warn of links to missing files in the Markdown of other folders, which the site omits."""
    for page in sorted(ROOT.glob("[a-z]*/*.md")):
        for _, target, _, _ in _LINK.findall(page.read_text(encoding="utf-8")):
            if page.parent != DOCS and not (page.parent / target).exists():
                _logger.warning("%s links a missing file: %s", page.relative_to(ROOT), target)


def check_reference(_app, env):
    """Warn of public names that the reference does not describe."""
    import napari_hmrf

    described = env.get_domain("py").objects
    packages = [getattr(napari_hmrf, each) for each in napari_hmrf._PACKAGES]
    for package in (napari_hmrf, *packages):
        for name in package.__all__:
            if f"{package.__name__}.{name}" not in described:
                _logger.warning("the reference lacks %s.%s", package.__name__, name)


def setup(app):
    """Connect the functions above; called by Sphinx."""
    app.connect("builder-inited", check_links)
    app.connect("env-check-consistency", check_reference)
    app.connect("source-read", show)
    app.connect("autodoc-process-docstring", remember, priority=400)
    app.connect("autodoc-process-docstring", restore, priority=600)
    app.connect("doctree-read", unlink)
