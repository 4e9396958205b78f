"""Tests of tables: formulas, separators, encodings and unknown columns."""

import csv

import pytest

from napari_hmrf.arguments import nearest_word
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.table_files import read_cells, read_table, write_csv

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


CELLS_OF_A_ROW = {"label": "1", "name": "größer, als", "growth": "0.5/1.5"}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    "lines",
    [
        ["", ",", "Label, name,growth,", '1,"größer, als",0.5/1.5,', ""],
        ["label;name;growth", "1;größer, als;0,5/1,5"],
        ["label\tname\tgrowth\t", "1\tgrößer, als\t0.5/1.5"],
        ["label\tname\tgrowth\t", "1\tgrößer, als\t0,5/1,5"],
    ],
    ids=["commas", "semicolons and decimal commas", "tabs", "tabs and decimal commas"],
)
def test_tables_of_spreadsheets_are_read_alike(tmp_path, encoding, ending, lines):
    path = tmp_path / "t.csv"
    path.write_bytes(ending.join(lines).encode(encoding))
    ((place, cells),) = read_table(path).rows
    assert cells == CELLS_OF_A_ROW
    assert place == ("line 4" if lines[0] == "" else "line 2")


def test_a_line_with_too_many_cells_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("label,growth\n1,0,5\n")
    with pytest.raises(FileFormatError, match=r"t\.csv: line 2 has more cells"):
        read_table(tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("first", "second"), [("1.234,5", "2"), ("1,234.5", "2"), ("1.234.567", "0,5"), ("1.5", "0,5")]
)
def test_a_point_that_may_separate_thousands_is_refused(tmp_path, first, second):
    path = tmp_path / "t.csv"
    for separator in ";\t":
        path.write_text(f"label{separator}growth\n1{separator}{second}\n2{separator}{first}\n")
        with pytest.raises(FileFormatError, match=f"line 3 contains {first}, .* thousands"):
            read_table(path)


@pytest.mark.parametrize(
    ("word", "near"),
    [("stiffnes", "stiffness"), ("Young's_modulus", "stiffness"), ("xyz", None)],
)
def test_a_misspelt_word_is_matched_by_its_letters_or_its_meaning(word, near):
    assert nearest_word(word, ["label", "stiffness"], {"young's modulus": "stiffness"}) == near


def test_an_empty_value_of_a_json_table_is_a_missing_cell(tmp_path):
    (tmp_path / "t.json").write_text('[{"Label": 1, "name": null, "stiffness": 2}]')
    ((_, cells),) = read_table(tmp_path / "t.json").rows
    assert cells == {"label": 1, "stiffness": 2}
