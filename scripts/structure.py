"""Print the structure of the package: sizes, compiled loops, models, and values that it keeps.

    python scripts/structure.py

Reads the source of `napari_hmrf` only. Code lines are those with neither blanks, comments nor
docstrings alone. `make structure` first checks the contracts of imports.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "napari_hmrf"
# Class of the values that the workspace keeps.
_KEPT = "Kept"
# Module of the decorators that compile a function.
_DECORATORS = PACKAGE / "solver" / "backends" / "cpu" / "compiled.py"
# Methods that change a container.
_CHANGES = {"add", "append", "clear", "discard", "extend", "insert", "pop", "remove", "update"}
_IGNORED = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


class Module:
    """Source of a module.

    Attributes
    ----------
    name : str
        Path relative to the package.
    tree : ast.Module
    text : str
    """

    def __init__(self, path: Path) -> None:
        self.name = path.relative_to(PACKAGE).as_posix()
        self.text = path.read_text(encoding="utf-8")
        self.tree = ast.parse(self.text)

    @property
    def folder(self) -> str:
        """Folder of the package; of the solver and its backends, the subfolder."""
        parts = self.name.split("/")[:-1]
        deep = parts[:1] == ["solver"]
        return "/".join(parts[: 3 if deep else 1]) or "."

    def code_lines(self) -> int:
        """Return the number of lines of code."""
        lines: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type not in _IGNORED:
                lines.update(range(token.start[0], token.end[0] + 1))
        for node in ast.walk(self.tree):
            body = getattr(node, "body", None)
            if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
                value = body[0].value
                if isinstance(value, ast.Constant) and isinstance(value.value, str):
                    lines -= set(range(value.lineno, (value.end_lineno or value.lineno) + 1))
        return len(lines)

    def classes(self) -> Iterator[ast.ClassDef]:
        """Yield the classes of the module."""
        return (node for node in self.tree.body if isinstance(node, ast.ClassDef))

    def compiled(self, decorators: set[str]) -> int:
        """Return the number of functions with one of the decorators that compile them."""
        functions = (node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef))
        names = ({ast.unparse(each).split("(")[0] for each in f.decorator_list} for f in functions)
        return sum(not decorators.isdisjoint(each) for each in names)

    def kept(self) -> Iterator[str]:
        """Yield the names of values that the workspace keeps."""
        for name, value in self.globals():
            if isinstance(value, ast.Call) and _KEPT in ast.unparse(value.func):
                yield name

    def changed(self) -> Iterator[str]:
        """Yield the names of other global values that functions of the module change."""
        containers = (ast.List, ast.Set, ast.Dict, ast.Call)
        names = {name for name, value in self.globals() if isinstance(value, containers)}
        found = set()
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Global):
                found.update(node.names)
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                if node.func.attr in _CHANGES and isinstance(node.func.value, ast.Name):
                    found.update({node.func.value.id} & names)
            elif isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
                found.update({ast.unparse(node.value)} & names)
        yield from sorted(found - set(self.kept()))

    def globals(self) -> Iterator[tuple[str, ast.expr]]:
        """Yield the names of global values, and the expressions that they are assigned."""
        for node in self.tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            if isinstance(node, ast.AnnAssign):
                targets = [node.target]
            value = getattr(node, "value", None)
            for target in targets:
                if isinstance(target, ast.Name) and value is not None:
                    yield target.id, value


def models(modules: list[Module]) -> Iterator[tuple[str, str, int]]:
    """Yield the models of the solver, without protocols: module, name and number of lines."""
    for module in modules:
        for each in module.classes():
            bases = {ast.unparse(base) for base in each.bases}
            is_model = module.name.startswith("solver/") and each.name.endswith("Model")
            if is_model and "Protocol" not in bases:
                yield module.name, each.name, (each.end_lineno or each.lineno) - each.lineno + 1


def main() -> None:
    """Print the structure."""
    modules = [Module(path) for path in sorted(PACKAGE.rglob("*.py"))]
    decorators = {name for name, _ in Module(_DECORATORS).globals()}
    lines: Counter[str] = Counter()
    loops: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for each in modules:
        lines[each.folder] += each.code_lines()
        loops[each.folder] += each.compiled(decorators)
        counts[each.folder] += 1
    print(f"{'folder':<36}{'modules':>8}{'code lines':>12}{'compiled':>10}")
    for folder in sorted(lines):
        row = counts[folder], lines[folder], loops[folder]
        print(f"{folder:<36}{row[0]:>8}{row[1]:>12,}{row[2]:>10}")
    total = counts.total(), lines.total(), loops.total()
    print(f"{'all':<36}{total[0]:>8}{total[1]:>12,}{total[2]:>10}")
    print("\nModels")
    for name, model, count in models(modules):
        print(f"  {model:<24}{count:>5} lines  {name}")
    print("\nValues of the workspace")
    for each in modules:
        for name in each.kept():
            print(f"  {name:<24}{each.name}")
    print("\nOther global values that functions change")
    for each in modules:
        for name in each.changed():
            print(f"  {name:<24}{each.name}")


if __name__ == "__main__":
    main()
