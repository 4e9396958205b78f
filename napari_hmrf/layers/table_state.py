"""The table of a Labels layer as a value, and what was done to it in words."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

from napari_hmrf.layers.metadata import Role, described, known_of, rows_of

_WORDS = {
    "name": "the name",
    "stiffness": "the stiffness",
    "poisson": "Poisson's ratio",
    "action": "what is done",
    "vector": "the motion",
    "amount": "the motion",
    "confidence": "the confidence",
}


class Table(NamedTuple):
    """What a table of tissues or of boundaries says.

    Attributes
    ----------
    rows : tuple of Material or BoundaryRule
    unit : str
        Of stiffness.
    """

    rows: tuple[Any, ...]
    unit: str = ""

    @classmethod
    def of(cls, layer: Any, role: Role) -> Table:
        """The table a layer carries; an empty one if it carries none."""
        return cls(rows_of(layer, role) or (), str(known_of(layer).get("unit", "")))

    def give_to(self, layer: Any, role: Role) -> None:
        """Have a layer carry the table."""
        layer.metadata.update(described(role, self.rows, self.unit))


def change(before: Table, after: Table, name: str) -> str:
    """What was done to the table of a layer of that name, in the past tense."""
    was = {row.label: row for row in before.rows}
    now = {row.label: row for row in after.rows}
    if len(now) == len(was) + 1 and all(now.get(label) == row for label, row in was.items()):
        (label,) = now.keys() - was.keys()
        return f"added label {label} to '{name}'"
    differing = [label for label in now if now[label] != was.get(label)]
    if len(differing) != 1 or now.keys() != was.keys() or before.unit != after.unit:
        return f"changed the table of '{name}'"
    old, new = was[differing[0]], now[differing[0]]
    changed = [
        field.name
        for field in fields(new)
        if getattr(new, field.name, None) != getattr(old, field.name, None)
    ]
    what = _WORDS.get(changed[0], "the row") if len(changed) == 1 else "the row"
    return f"changed {what} of label {new.label} in '{name}'"
