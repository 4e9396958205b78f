"""Tests of the description of a changed table."""

import pytest

from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.row_table import RowTable, change

SOFT, STIFF, BONE = Material(1, "soft", 10.0), Material(2, "stiff", 40.0), Material(3, "bone", 90.0)


@pytest.mark.parametrize(
    ("rows", "description"),
    [
        ((SOFT, Material(2, "stiff", 50.0)), "changed label 2 of 'Tissue'"),
        ((SOFT, STIFF, BONE), "added label 3 to 'Tissue'"),
        ((STIFF,), "changed label 1 of 'Tissue'"),
        ((Material(1, "soft", 5.0), Material(2, "stiff", 50.0)), "changed the table of 'Tissue'"),
        ((BONE,), "changed the table of 'Tissue'"),
    ],
)
def test_a_change_is_described_by_the_changed_row(rows, description):
    assert change(RowTable((SOFT, STIFF)), RowTable(rows), "Tissue") == description
