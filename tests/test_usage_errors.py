"""Tests of misspelt commands and options: one sentence, with a suggestion."""

import pytest

from napari_hmrf.cli import read_command


@pytest.mark.parametrize(
    ("line", "suggestion"),
    [
        ("slove scan.nii", "'solve'"),
        ("solve scan.nii -o out --bounday rim.csv", "'--boundary'"),
        ("solve scan.nii -o out --model elastik", "'elastic'"),
    ],
)
def test_a_misspelt_word_is_refused_with_a_suggestion(line, suggestion, capsys):
    with pytest.raises(SystemExit) as ended:
        read_command(line.split())
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert f"Did you mean {suggestion}?" in said
    assert len(said.splitlines()) == 2
