"""Diagram and table of the subpackages of the package, and of the imports between them.

    python scripts/structure.py [--write | --check]

Each row of the diagram may import from the rows below it; the subpackages in the lowest row do not
import other subpackages. The table has the first sentence of each docstring, and the imports
without those that follow from other imports. With ``--write``, the diagram and the table are
written to `docs/development/architecture.md`, between the markers. With ``--check``, the script
fails if that page has another structure.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "napari_hmrf"
PAGE = ROOT / "docs" / "development" / "architecture.md"
BEGIN = "<!-- begin: written by `make structure` -->\n"
END = "<!-- end: written by `make structure` -->\n"
_WIDTH = 48
_Import = ast.Import | ast.ImportFrom


def list_rooms() -> list[str]:
    """List the names of the subpackages."""
    return sorted(each.parent.name for each in PACKAGE.glob("*/__init__.py"))


def duty_of(room: str) -> str:
    """Return the first sentence of a subpackage's docstring."""
    tree = ast.parse((PACKAGE / room / "__init__.py").read_text(encoding="utf-8"))
    first = (ast.get_docstring(tree) or "").partition("\n")[0]
    return first.partition(". ")[0].rstrip(".")


def find_imports(room: str, *, late: bool = False) -> set[str]:
    """Find the other subpackages that a subpackage imports.

    Parameters
    ----------
    room : str
        Name of the subpackage.
    late : bool
        If True, return imports inside functions; otherwise imports of modules.
    """
    found = set()
    for at_import, in_functions in _read_imports(room):
        for node in in_functions if late else at_import:
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {n.split(".")[1] for n in names if n.startswith("napari_hmrf.")}
    return (found & set(list_rooms())) - {room}


@cache
def _read_imports(room: str) -> list[tuple[list[_Import], list[_Import]]]:
    """Return the imports of each module of a subpackage: of the module, and in functions."""
    trees = (ast.parse(each.read_text(encoding="utf-8")) for each in (PACKAGE / room).rglob("*.py"))
    return [([*_at_import(tree.body)], [*_in_functions(tree.body)]) for tree in trees]


def _at_import(statements: list[ast.stmt]) -> Iterator[_Import]:
    """Yield the imports that run when a module is imported."""
    for statement in statements:
        if isinstance(statement, _Import):
            yield statement
        elif isinstance(statement, ast.If | ast.Try):
            is_for_types = "TYPE_CHECKING" in ast.unparse(statement).partition("\n")[0]
            yield from _at_import(statement.orelse if is_for_types else statement.body)
            if not is_for_types:
                yield from _at_import(statement.orelse)


def _in_functions(statements: list[ast.stmt], inside: bool = False) -> Iterator[_Import]:
    """Yield the imports in functions; expressions, most of a tree, are not visited."""
    for statement in statements:
        if inside and isinstance(statement, _Import):
            yield statement
        is_inside = inside or isinstance(statement, ast.FunctionDef)
        for block in ("body", "orelse", "handlers", "finalbody", "cases"):
            yield from _in_functions(getattr(statement, block, []), is_inside)


def find_below(room: str, arrows: Mapping[str, set[str]]) -> set[str]:
    """Find all subpackages that a subpackage imports, directly or indirectly."""
    found: set[str] = set()
    todo = [room]
    while todo:
        new = arrows[todo.pop()] - found
        found |= new
        todo += new
    return found


def arrange(arrows: Mapping[str, set[str]]) -> list[list[str]]:
    """Arrange the subpackages in rows, with each subpackage above all its imports."""
    heights: dict[str, int] = {}
    left = set(arrows)
    while left:
        ready = {room for room in left if arrows[room] <= heights.keys()}
        if not ready:
            raise ValueError(f"these subpackages import each other: {', '.join(sorted(left))}")
        for room in ready:
            heights[room] = max((heights[each] + 1 for each in arrows[room]), default=0)
        left -= ready
    return [
        sorted(room for room in arrows if heights[room] == height)
        for height in range(max(heights.values()), -1, -1)
    ]


def draw_structure() -> str:
    """Return the diagram and the table, in Markdown."""
    arrows = {room: find_imports(room) for room in list_rooms()}
    in_rows = arrange(arrows)
    names = ["     ".join(row).center(_WIDTH).rstrip() for row in in_rows]
    arrow = "\n" + "|".center(_WIDTH).rstrip() + "\n" + "v".center(_WIDTH).rstrip() + "\n"
    lines = ["```text", arrow.join(names), "```", ""]
    lines += ["| subpackage | imports | contents |", "| --- | --- | --- |"]
    for room in (each for row in in_rows for each in row):
        needed = arrows[room]
        through = set[str]().union(*(find_below(each, arrows) for each in needed))
        direct = ", ".join(f"`{each}`" for each in sorted(needed - through)) or "none"
        lines.append(f"| `{room}/` | {direct} | {duty_of(room)} |")
    upward = {
        room: find_imports(room, late=True) - find_below(room, arrows) - {room} for room in arrows
    }
    late = [
        f"`{room}` -> {', '.join(f'`{each}`' for each in sorted(above))}"
        for room, above in upward.items()
        if above
    ]
    if late:
        lines += ["", f"Some functions import upwards when they are called: {'; '.join(late)}."]
    return "\n".join(lines) + "\n"


def update_page() -> str:
    """Return the page with the present structure."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{draw_structure()}\n{END}{after}"


def main() -> None:
    """Print the structure, or write it to the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    task = parser.add_mutually_exclusive_group()
    task.add_argument("--write", action="store_true", help="write the structure to the page")
    task.add_argument("--check", action="store_true", help="fail if the page is outdated")
    options = parser.parse_args()
    if options.check:
        if PAGE.read_text(encoding="utf-8") != update_page():
            sys.exit(f"{PAGE.relative_to(ROOT)} is outdated; run `make structure`")
    elif options.write:
        PAGE.write_text(update_page(), encoding="utf-8")
        print(f"written: {PAGE.relative_to(ROOT)}")
    else:
        print(draw_structure(), end="")


if __name__ == "__main__":
    main()
