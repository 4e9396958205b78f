"""Check of the wording of docstrings, comments and messages, with a ratchet.

    python scripts/words.py                     # count the violations that are left, by kind
    python scripts/words.py PATH ...            # list them by file and line; PATH may be a folder
    python scripts/words.py --update            # lower the recorded counts; never raises one

Four kinds of violation are counted:

opening    the first line of a docstring or comment begins with one of `OPENINGS`
people     a sentence has one of the words of `PEOPLE`, as if the software had people in it
verb       the docstring of a public function or method does not begin with an imperative verb
message    a message begins with one of `OPENINGS`, capitalised, and is no question

A message is any string of two words or more that is no docstring. Text between backticks is code
and is not read. Three files in `tests/project` belong to the check: `words_verbs.txt` lists the
accepted verbs, `words_accepted.txt` the reviewed exceptions and `words_left.txt` the files that
still have violations.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "napari_hmrf"
RECORDS = ROOT / "tests" / "project"
VERBS = RECORDS / "words_verbs.txt"
ACCEPTED = RECORDS / "words_accepted.txt"
LEFT = RECORDS / "words_left.txt"

KINDS = ("opening", "people", "verb", "message")
OPENINGS = ("what", "whether", "which", "who", "how", "of", "have", "be", "that", "where")
_PERSON = r"(?<!user )(?<!users )(?<!caller )(?<!callers )(?<!you )(?<!reader )"
PEOPLE = re.compile(
    r"\b(?:nobody|somebody|everybody|anybody|whoever|who|someone|no one|anew|from nothing"
    r"|(?:comes?|came|coming) to rest|(?:gives?|gave|giving) up"
    r"|(?:is|are|was|were|be|been|being) (?:asked|told)|asked of"
    rf"|{_PERSON}(?:asks|tells|hears?|feels?|wants?|knows))\b",
    re.IGNORECASE,
)
_CODE = re.compile(r"``.*?``|`[^`\n]*`", re.DOTALL)
_PRAGMA = re.compile(r"#\s*(?:noqa|type:|pragma|fmt:|ruff:|mypy:|!)")
_WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")
_HEAD = "# path  sha256  violations; written by `python scripts/words.py --update`\n"


@dataclass(frozen=True)
class Violation:
    """One place that breaks a rule."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True)
class Row:
    """Recorded state of a file that still has violations."""

    digest: str
    count: int


def read_list(path: Path) -> set[str]:
    """Return the lines of a list, without comments and empty lines."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return {line.strip() for line in lines if line.strip() and not line.startswith("#")}


def check(source: str, verbs: set[str], accepted: set[str]) -> list[Violation]:
    """List the violations in the source of a module."""
    tree = ast.parse(source)
    found = [*_check_docstrings(tree, verbs), *_check_messages(tree), *_check_comments(source)]
    return sorted(
        (each for each in found if each.text not in accepted),
        key=lambda each: (each.line, each.kind),
    )


def _check_docstrings(tree: ast.Module, verbs: set[str]) -> Iterator[Violation]:
    for node, is_public in _documented(tree, True):
        text = ast.get_docstring(node, clean=False)
        if text is None:
            continue
        line = node.body[0].lineno
        first = text.strip().split("\n")[0]
        word = _first_word(first)
        yield from _check_opening(first, line)
        yield from _check_people(text, line)
        if is_public and word not in verbs and word not in OPENINGS:
            yield Violation(line, "verb", first)


def _documented(node: ast.AST, is_public: bool) -> Iterator[tuple[ast.AST, bool]]:
    """Yield each node that may have a docstring, and whether a verb must begin it."""
    is_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    if is_function:
        yield node, is_public and not node.name.startswith("_") and not _is_property(node)
    elif isinstance(node, (ast.Module, ast.ClassDef)):
        yield node, False
    for child in ast.iter_child_nodes(node):
        yield from _documented(child, is_public and not is_function)


def _is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    names = [ast.unparse(decorator) for decorator in node.decorator_list]
    return any("property" in name or name.endswith((".setter", ".deleter")) for name in names)


def _check_messages(tree: ast.Module) -> Iterator[Violation]:
    docstrings = {
        id(node.body[0].value)
        for node, _ in _documented(tree, True)
        if ast.get_docstring(node, clean=False) is not None
    }
    for node, text in _strings(tree):
        if id(node) in docstrings or len(_WORD.findall(text)) < 2:
            continue
        yield from _check_people(text, node.lineno)
        first = text.strip().split("\n")[0]
        word = _first_word(first)
        if word in OPENINGS and first[:1].isupper() and not text.rstrip().endswith("?"):
            yield Violation(node.lineno, "message", first)


def _strings(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Yield the strings of a module; an f-string is one, with `{}` where a value goes."""
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
        yield node, "".join(parts)
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                yield from _strings(part.value)
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node, node.value
    for child in ast.iter_child_nodes(node):
        yield from _strings(child)


def _check_comments(source: str) -> Iterator[Violation]:
    for line, text in _comments(source):
        yield from _check_opening(text, line)
        yield from _check_people(text, line)


def _comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield each comment with its line; lines of nothing but comment that follow make one."""
    begun, block, column = 0, [], -1
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or _PRAGMA.match(token.string):
            continue
        line, start = token.start
        alone = not token.line[:start].strip()
        if not (block and alone and line == begun + len(block) and start == column):
            if block:
                yield begun, "\n".join(block)
            begun, block = line, []
        column = start if alone else -1
        block.append(token.string.lstrip("#:").strip())
    if block:
        yield begun, "\n".join(block)


def _check_opening(text: str, line: int) -> Iterator[Violation]:
    first = text.strip().split("\n")[0]
    if _first_word(first) in OPENINGS:
        yield Violation(line, "opening", first)


def _check_people(text: str, line: int) -> Iterator[Violation]:
    # A phrase may go on in the next line; what is code keeps its length, so that lines are right.
    plain = _CODE.sub(lambda code: re.sub(r"[^\n]", "`", code.group()), text)
    spaced = re.sub(r"\s", " ", plain)
    spaced = re.sub(r"  +", lambda gap: " " + "\0" * (len(gap.group()) - 1), spaced)
    squeezed = spaced.replace("\0", "")
    places = [at for at, letter in enumerate(spaced) if letter != "\0"]
    for match in PEOPLE.finditer(squeezed):
        at = places[match.start()]
        start, end = text.rfind("\n", 0, at) + 1, text.find("\n", at)
        sentence = text[start : end if end >= 0 else None].strip()
        yield Violation(line + text.count("\n", 0, at), "people", f"[{match.group()}] {sentence}")


def _first_word(text: str) -> str:
    words = text.split()
    return words[0].strip("\"'`*.,:;()").lower() if words else ""


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's text, the same on every system."""
    return hashlib.sha256(path.read_text(encoding="utf-8").encode()).hexdigest()


def modules(paths: Iterable[Path] = (PACKAGE,)) -> list[Path]:
    """List the Python files among paths and in folders."""
    return [
        file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]


def name_of(path: Path) -> str:
    """Return the path of a file inside of the repository, with slashes."""
    return path.resolve().relative_to(ROOT).as_posix()


def read_left(path: Path = LEFT) -> dict[str, Row]:
    """Read which files have violations left, and how many."""
    rows = (line.split() for line in sorted(read_list(path)))
    return {name: Row(sha, int(count)) for name, sha, count in rows}


def check_all(paths: Iterable[Path] = (PACKAGE,)) -> dict[Path, list[Violation]]:
    """Check files; those without a violation are in the result, too."""
    verbs, accepted = read_list(VERBS), read_list(ACCEPTED)
    return {
        path: check(path.read_text(encoding="utf-8"), verbs, accepted) for path in modules(paths)
    }


def complaints(found: dict[str, tuple[str, int]], left: dict[str, Row]) -> list[str]:
    """Compare the present state, {path: (digest, violations)}, with the record; list the faults."""
    said = []
    for name, (sha, count) in found.items():
        row = left.get(name)
        if count and row is None:
            said.append(f"{name}: a clean or new file has {count} violations")
        elif count and sha != row.digest:
            said.append(f"{name}: was changed and still has {count} violations; there must be none")
        elif row and count > row.count:
            said.append(f"{name}: {count} violations, more than the {row.count} recorded")
    return said


def update(found: dict[str, tuple[str, int]], left: dict[str, Row]) -> dict[str, Row]:
    """Return the record without clean and deleted files; no count rises, no changed file passes."""
    return {
        name: Row(row.digest, min(row.count, found[name][1]))
        for name, row in left.items()
        if name in found and found[name][1]
    }


def write_left(left: dict[str, Row], path: Path = LEFT) -> None:
    """Write the record."""
    rows = [f"{name} {row.digest} {row.count}\n" for name, row in sorted(left.items())]
    path.write_text(_HEAD + "".join(rows), encoding="utf-8", newline="\n")


def summary(found: dict[Path, list[Violation]]) -> str:
    """Return how many violations of each kind are left, in one line."""
    kinds = Counter(each.kind for violations in found.values() for each in violations)
    files = sum(bool(violations) for violations in found.values())
    counts = ", ".join(f"{kinds[kind]} {kind}" for kind in KINDS)
    return f"{kinds.total()} violations left in {files} of {len(found)} files: {counts}"


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 1 if files that were named have violations."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("paths", nargs="*", type=Path, help="files or folders to list")
    parser.add_argument("--update", action="store_true", help="lower the recorded counts")
    options = parser.parse_args(arguments)
    found = check_all(options.paths or [PACKAGE])
    if options.paths:
        for path, violations in found.items():
            for each in violations:
                print(f"{path}:{each.line}: {each.kind}: {each.text}")
    print(summary(found))
    if options.update:
        found = check_all()
        state = {name_of(path): (digest(path), len(each)) for path, each in found.items()}
        if LEFT.exists():
            left = update(state, read_left())
        else:
            left = {name: Row(sha, count) for name, (sha, count) in state.items() if count}
        write_left(left)
        for said in complaints(state, left):
            print(said)
    return int(bool(options.paths) and any(found.values()))


if __name__ == "__main__":
    sys.exit(main())
