"""Tests of the list of capabilities, whose rows name existing tests."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
PAGE = TESTS.parent / "docs" / "development" / "capabilities.md"

pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="needs a checkout of the repository")


@cache
def named_tests(file: str) -> dict[str, ast.FunctionDef]:
    """Return the tests of a file by name."""
    tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
    return {
        node.name: node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def uses_private_names(test: ast.FunctionDef) -> bool:
    """Return whether a test accesses a private attribute."""
    names = [node.attr for node in ast.walk(test) if isinstance(node, ast.Attribute)]
    return any(name.startswith("_") and not name.startswith("__") for name in names)


def rows() -> list[tuple[str, list[str]]]:
    """Return each listed capability with the names in its row."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    cells = [line.strip("|").split(" | ") for line in lines if line.startswith("| ")]
    return [
        (what.strip(), re.findall(r"`([^`]+)`", held))
        for what, held in cells
        if what.strip() not in ("capability", "---")
    ]


def test_every_row_names_existing_tests():
    assert len(rows()) > 100
    missing = []
    for what, named in rows():
        for each in named:
            file, _, test = each.partition("::")
            if not (TESTS / file).is_file() or test not in named_tests(file):
                missing.append(f"{what}: {each}")
        if not named:
            missing.append(f"{what}: no test")
    assert missing == []


def test_every_capability_is_tested_through_the_public_interface():
    behind = []
    for what, named in rows():
        parts = [each.split("::") for each in named]
        if all(uses_private_names(named_tests(file)[test]) for file, test in parts):
            behind.append(what)
    assert behind == []


def test_no_capability_is_listed_twice():
    listed = [what for what, _ in rows()]
    assert len(set(listed)) == len(listed)
