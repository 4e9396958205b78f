"""Studies: their harness, and the commands that pages name."""

import itertools
import re
from pathlib import Path

import pytest

from validation import study as harness
from validation.__main__ import MODULES, main
from validation.study import Table, Target, study

ROOT = Path(__file__).parents[2]


@pytest.fixture
def example(monkeypatch, tmp_path):
    """Register a study of two numbers, with a page of its own."""
    monkeypatch.setattr(harness, "PAGES", tmp_path)
    monkeypatch.setattr(harness, "STUDIES", {})
    (tmp_path / "README.md").write_text(
        "0 of 1 targets were met.\n\nCommit of the figures: `old`\n\nMISSED  largest: 9 (<= 3)\n\n"
        "| number | square |\n| --- | --- |\n| 3 | 9 |\n\nText.\n"
    )

    @study(
        "numbers.squares",
        {"one": 1, "two": 2},
        ("number", "square"),
        rows=lambda results: results.values(),
        targets=lambda results: [Target("largest", max(row[1] for row in results.values()), 3)],
    )
    def squares(number):
        """Compare numbers with their squares."""
        return [number, number**2]

    return harness.STUDIES["numbers.squares"], tmp_path / "README.md"


def execute(one, *words):
    return harness.run([one], harness.parser().parse_args(words), "a command")


def test_a_missed_target_is_the_exit_code(example, capsys):
    one, _ = example
    assert execute(one) == 1
    assert execute(one, "--cases", "one") == 0
    assert "| 2 | 4 |" in capsys.readouterr().out


def test_a_page_keeps_its_text(example):
    one, page = example
    assert execute(one, "--write") == 0
    text = page.read_text()
    assert text.endswith("| number | square |\n| --- | --- |\n| 1 | 1 |\n| 2 | 4 |\n\nText.\n")
    assert "MISSED  largest: 4 (<= 3)" in text
    assert "`old`" not in text


def test_results_are_found_again(example, tmp_path):
    one, _ = example
    file = tmp_path / "results"
    execute(one, "--results", str(file), "--cases", "one")
    file.write_text(file.read_text().replace("[1, 1]", "[1, 2]"))
    whole = harness.Run(harness.Options(), results=file)
    whole.execute(one)
    assert "| 1 | 2 |" in whole.tables[0][1]
    assert isinstance(one.tables({"one": [1, 1]})[0], Table)


def test_commands_of_pages_name_studies(capsys):
    assert main([]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    known = {"report", "NAME", "$(NAMES)", *MODULES, *listed}
    named = re.findall(r"-m validation(.*)", (ROOT / "Makefile").read_text())
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        named += re.findall(r"-m validation([^`]*)`", page.read_text(encoding="utf-8"))
    assert len(named) > 20
    for words in named:
        names = list(itertools.takewhile(lambda word: not word.startswith("-"), words.split()))
        assert set(names) <= known, names
