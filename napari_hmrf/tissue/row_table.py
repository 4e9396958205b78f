"""Immutable table of the labels of a layer, and descriptions of changes between two tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, NamedTuple, TypeVar

from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

Row = TypeVar("Row", bound=Material | BoundaryRule)

# Prefix of the source of a table that the user has changed.
_CHANGED = "changed since taken from: "


class RowTable(NamedTuple, Generic[Row]):
    """Rows of a table of tissues or of boundaries, and their source.

    Attributes
    ----------
    rows : tuple of Material or BoundaryRule
    unit : str
        Unit of stiffness.
    preset : str
        Name of the preset; "" if there is none.
    source : str
        Source of the values; "" if it is unknown.
    """

    rows: tuple[Row, ...]
    unit: str = ""
    preset: str = ""
    source: str = ""

    def edited(self, rows: Iterable[Row]) -> RowTable[Row]:
        """Return the table with rows edited by the user, and mark its source as changed."""
        changed = self.source and not self.source.startswith(_CHANGED)
        return self._replace(rows=tuple(rows), source=(_CHANGED if changed else "") + self.source)


def change(before: RowTable[Row], after: RowTable[Row], name: str) -> str:
    """Describe the change between two tables in the past tense, for the undo menu.

    Parameters
    ----------
    before, after : RowTable
    name : str
        Name of the layer.

    Returns
    -------
    str
    """
    old, new = ({row.label: row for row in table.rows} for table in (before, after))
    differing = [label for label in old | new if old.get(label) != new.get(label)]
    if len(differing) != 1:
        return f"changed the table of '{name}'"
    (label,) = differing
    verb, preposition = ("changed", "of") if label in old else ("added", "to")
    return f"{verb} label {label} {preposition} '{name}'"
