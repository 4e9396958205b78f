"""Tests of comma-separated tables: formulas, titles and unknown columns."""

import csv

import pytest

from napari_hmrf.arguments import nearest_word
from napari_hmrf.io.csv_files import read_cells, read_csv, write_csv

CELLS = ["=1+2", "+x", "-brain", "@SUM(A1)", "'=x", "'quoted", "plain", "-0.5", -0.5, 3, None]


def test_text_that_looks_like_a_formula_is_written_as_text_and_read_back(tmp_path):
    path = write_csv(tmp_path / "t.csv", ["=title", *"bcdefghijk"], [CELLS])
    with open(path, newline="") as file:
        titles, written = csv.reader(file)
    assert titles[0] == "'=title"
    assert written[:4] == ["'=1+2", "'+x", "'-brain", "'@SUM(A1)"]
    assert written[5:] == ["'quoted", "plain", "-0.5", "-0.5", "3", ""], (
        "a number was written as text"
    )
    (_, titles), (_, cells) = read_cells(path, 1000)
    assert titles[0] == "=title"
    assert cells == ["" if cell is None else str(cell) for cell in CELLS]


def test_the_first_line_with_text_names_the_columns(tmp_path):
    (tmp_path / "t.csv").write_text("\n,\na,b\n1,2\n")
    lines = []
    found = read_csv(
        tmp_path / "t.csv", largest=100, check=lambda titles, line: lines.append(line) or titles
    )
    assert lines == [3]
    assert found.lines == [(4, {"a": "1", "b": "2"})]


@pytest.mark.parametrize(
    ("word", "near"),
    [("stiffnes", "stiffness"), ("Young's_modulus", "stiffness"), ("xyz", None)],
)
def test_a_misspelt_word_is_matched_by_its_letters_or_its_meaning(word, near):
    assert nearest_word(word, ["label", "stiffness"], {"young's modulus": "stiffness"}) == near
