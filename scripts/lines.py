"""Number of lines of code in each folder.

    python scripts/lines.py [folder ...]

Blank lines, comments and docstrings are not counted. The default folder is the package. Each row
has the modules directly in a folder, followed by the modules in the folder and all its subfolders.
The last row has the total of all given folders.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "napari_hmrf"

_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def lines_of_code(text: str) -> int:
    """Count the lines of a module that contain code.

    Parameters
    ----------
    text : str
        Source of the module.
    """
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            code.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(code)


def lines_in(folder: Path) -> dict[Path, list[int]]:
    """Count the lines of all modules in a folder and its subfolders, grouped by folder."""
    found: dict[Path, list[int]] = {}
    for module in sorted(folder.rglob("*.py")):
        lines = lines_of_code(module.read_text(encoding="utf-8"))
        found.setdefault(module.parent, []).append(lines)
    return found


def main(arguments: Sequence[str]) -> int:
    """Print the table; return 1 if a folder contains no modules."""
    folders = [Path(each).resolve() for each in arguments] or [PACKAGE]
    totals: Counter[str] = Counter()
    print(f"{'folder':34}{'modules':>8}{'lines':>8}{'with subfolders':>22}")
    for folder in folders:
        found = lines_in(folder)
        if not found:
            print(f"{folder}: no modules", file=sys.stderr)
            return 1
        for each in sorted(found):
            below = [found[other] for other in found if other.is_relative_to(each)]
            modules, lines = sum(map(len, below)), sum(map(sum, below))
            name = each.relative_to(folder.parent).as_posix()
            deeper = "" if len(below) == 1 else f"{modules:>14}{lines:>8,}"
            print(f"{name:34}{len(found[each]):>8}{sum(found[each]):>8,}{deeper}")
        totals["modules"] += sum(map(len, found.values()))
        totals["lines"] += sum(map(sum, found.values()))
    print(f"{'total':34}{totals['modules']:>8}{totals['lines']:>8,}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
