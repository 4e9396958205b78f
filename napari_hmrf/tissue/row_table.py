"""Table of the labels of a layer, as an immutable value, and names for changes of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, NamedTuple, TypeVar

from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

Row = TypeVar("Row", bound=Material | BoundaryRule)

# Prefix of the source of values that the user has changed.
_CHANGED = "changed since taken from: "


class RowTable(NamedTuple, Generic[Row]):
    """Rows of a table of tissues or of boundaries, and their source.

    Attributes
    ----------
    rows : tuple of Material or BoundaryRule
    unit : str
        Unit of stiffness.
    preset, whose : str
        Name of the preset, and source of its values.
    """

    rows: tuple[Row, ...]
    unit: str = ""
    preset: str = ""
    whose: str = ""

    def edited(self, rows: Iterable[Row]) -> RowTable[Row]:
        """Return the table with rows that the user has edited; the source says so."""
        changed = self.whose and not self.whose.startswith(_CHANGED)
        return self._replace(rows=tuple(rows), whose=(_CHANGED if changed else "") + self.whose)


def change(before: RowTable[Row], after: RowTable[Row], name: str) -> str:
    """Return a name for the change of a table, in the past tense.

    Parameters
    ----------
    before, after : RowTable
    name : str
        Name of the layer.
    """
    was, now = ({row.label: row for row in table.rows} for table in (before, after))
    differing = [label for label in was | now if was.get(label) != now.get(label)]
    if len(differing) != 1:
        return f"changed the table of '{name}'"
    (label,) = differing
    done, where = ("changed", "of") if label in was else ("added", "to")
    return f"{done} label {label} {where} '{name}'"
