"""Check of the wording of docstrings, comments and messages.

    python scripts/words.py                     # count the violations, by kind
    python scripts/words.py PATH ...            # list the violations in files or folders
    python scripts/words.py --sample SEED       # draw texts of each kind for a reader to judge

Four kinds of violation are counted:

opening    the first line of a docstring or comment begins with one of `OPENINGS`
people     a sentence contains one of the words of `PEOPLE`, which treat software as a person
verb       the docstring of a public function or method does not begin with an imperative verb
message    a message begins with one of `OPENINGS`, capitalised, and is not a question

A message is any string of two or more words that is not a docstring. Text between backticks is code
and is not checked. In `tests/project`, `words_verbs.txt` lists the accepted verbs, and
`words_accepted.txt` lists the reviewed exceptions. A program cannot check all rules, so a reader
judges a sample for the remaining rules.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
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

#: Number of texts of each kind in a sample. Sampled messages have more words than `_SHORT`.
SAMPLE = {"docstring": 200, "comment": 100, "message": 100}
_SHORT = 3
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


@dataclass(frozen=True)
class Violation:
    """Text that violates a rule, with its line."""

    line: int
    kind: str
    text: str


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
    """Yield each node that may have a docstring, and whether it must begin with a verb."""
    is_function = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    if is_function:
        yield node, is_public and not node.name.startswith("_") and not _is_property(node)
    elif isinstance(node, (ast.Module, ast.ClassDef)):
        yield node, False
    # Expressions, most of a tree, contain no docstrings.
    for block in ("body", "orelse", "handlers", "finalbody", "cases"):
        for child in getattr(node, block, ()):
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
    """Yield the strings of a module; an f-string is one string with `{}` for each value."""
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
    """Yield each comment with its line; consecutive comment lines are one comment."""
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
    # A phrase may continue on the next line. Code is masked without changing the length of the
    # text, so that line numbers remain valid.
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


def modules(paths: Iterable[Path] = (PACKAGE,)) -> list[Path]:
    """List the Python files among paths and in folders."""
    return [
        file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]


def name_of(path: Path) -> str:
    """Return the path of a file relative to the repository, with slashes."""
    return path.resolve().relative_to(ROOT).as_posix()


def check_all(paths: Iterable[Path] = (PACKAGE,)) -> dict[Path, list[Violation]]:
    """Check files; the result also includes files without violations."""
    verbs, accepted = read_list(VERBS), read_list(ACCEPTED)
    return {
        path: check(path.read_text(encoding="utf-8"), verbs, accepted) for path in modules(paths)
    }


def texts_of(path: Path) -> dict[str, list[tuple[int, str]]]:
    """Return the docstrings, comments and messages of a module, with their lines."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    documented = [node for node, _ in _documented(tree, True) if ast.get_docstring(node)]
    docstrings = [(node.body[0].lineno, ast.get_docstring(node)) for node in documented]
    ours = {id(node.body[0].value) for node in documented}
    messages = [
        (node.lineno, text)
        for node, text in _strings(tree)
        if id(node) not in ours and len(_WORD.findall(text)) > _SHORT
    ]
    return {"docstring": docstrings, "comment": [*_comments(source)], "message": messages}


def sample(seed: int) -> list[tuple[str, Path, int, str]]:
    """Draw `SAMPLE` texts of each kind from the package: kind, file, line and text."""
    texts: dict[str, list[tuple[Path, int, str]]] = {kind: [] for kind in SAMPLE}
    for path in modules():
        for kind, lines in texts_of(path).items():
            texts[kind] += [(path, line, text) for line, text in lines]
    draw = random.Random(seed)
    return [
        (kind, *each)
        for kind, number in SAMPLE.items()
        for each in draw.sample(texts[kind], min(number, len(texts[kind])))
    ]


def summary(found: dict[Path, list[Violation]]) -> str:
    """Return the number of violations of each kind, in one line."""
    kinds = Counter(each.kind for violations in found.values() for each in violations)
    files = sum(bool(violations) for violations in found.values())
    counts = ", ".join(f"{kinds[kind]} {kind}" for kind in KINDS)
    return f"{kinds.total()} violations left in {files} of {len(found)} files: {counts}"


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return 1 if there are violations."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("paths", nargs="*", type=Path, help="files or folders to list")
    parser.add_argument("--sample", type=int, metavar="SEED", help="draw texts to judge")
    options = parser.parse_args(arguments)
    if options.sample is not None:
        for number, (kind, path, line, text) in enumerate(sample(options.sample), 1):
            print(f"[{number}] {kind} {name_of(path)}:{line}\n{text}\n")
        return 0
    found = check_all(options.paths or [PACKAGE])
    if options.paths:
        for path, violations in found.items():
            for each in violations:
                print(f"{path}:{each.line}: {each.kind}: {each.text}")
    print(summary(found))
    return int(any(found.values()))


if __name__ == "__main__":
    sys.exit(main())
