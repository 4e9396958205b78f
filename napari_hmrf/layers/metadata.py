"""What this package keeps in a layer's metadata: what the layer is for, and its table.

A table is a value, too, that can be taken back; what was done to it is said in words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any, Literal, NamedTuple

from napari_hmrf.io.study_file import materials_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

#: Where a layer's metadata hold what this package knows of it.
METADATA = "napari-hmrf"

Role = Literal["image", "tissue", "boundary"]
IMAGE: Role = "image"
TISSUE: Role = "tissue"
BOUNDARY: Role = "boundary"
_TABLES: dict[Role, tuple[str, Callable[..., Any]]] = {
    TISSUE: ("materials", Material.of_row),
    BOUNDARY: ("rules", BoundaryRule),
}
#: Of whose values some were changed by hand.
_CHANGED = "changed since taken from: "


def known_of(layer: Any) -> Mapping[str, Any]:
    """What is known of a layer; nothing, for a layer of others."""
    known = layer.metadata.get(METADATA)
    return known if isinstance(known, Mapping) else {}


def add_known(layer: Any, **facts: Any) -> None:
    """Have more be known of a layer."""
    layer.metadata = {**layer.metadata, METADATA: {**known_of(layer), **facts}}


def described(
    role: Role, rows: Iterable[Any] = (), unit: str = "", preset: str = "", whose: str = ""
) -> dict[str, Any]:
    """Metadata that say what a layer is for, with its table in JSON types.

    Parameters
    ----------
    role : {"image", "tissue", "boundary"}
    rows : iterable of Material or BoundaryRule
    unit : str
        Of stiffness.
    preset, whose : str
        Which materials these are, and whose values.
    """
    known: dict[str, Any] = {"role": role}
    if role in _TABLES:
        known[_TABLES[role][0]] = [
            row.as_row() if isinstance(row, Material) else asdict(row) for row in rows
        ]
    said = {"unit": unit, "preset": preset, "whose": whose}
    return {METADATA: {**known, **{name: words for name, words in said.items() if words}}}


def tissue_record(layer: Any, materials: Iterable[Material]) -> dict[str, Any]:
    """What made the tissue of a layer, in JSON types, to be kept with a solution.

    Parameters
    ----------
    layer : napari.layers.Labels or napari.layers.Image
    materials : iterable of Material
        Of labels.

    Returns
    -------
    dict
        The layer's name, the unit of stiffness, and a table of materials.
    """
    known = known_of(layer)
    record = {"layer": str(layer.name), **({"unit": known["unit"]} if "unit" in known else {})}
    rows = [material.as_row() for material in materials]
    return {**record, "materials": rows} if rows else record


def tissue_recorded(layer: Any) -> tuple[tuple[Material, ...] | None, str]:
    """The table of materials that the solution in a result's layer was made with, and its unit."""
    try:
        record = known_of(layer)["solution"].provenance.parameters["tissue"]
        return materials_of(record["materials"]), str(record.get("unit", ""))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        return None, ""


def role_of(layer: Any) -> Role | None:
    """What a layer is for, if its metadata say so."""
    role = known_of(layer).get("role")
    return role if role in (IMAGE, TISSUE, BOUNDARY) else None


def rows_of(layer: Any, role: Role) -> tuple[Any, ...]:
    """The table that a layer's metadata carry; empty if they carry none that can be read."""
    key, row_type = _TABLES[role]
    try:
        return tuple(
            row_type(**{name: tuple(v) if isinstance(v, list) else v for name, v in row.items()})
            for row in known_of(layer)[key]
        )
    except (KeyError, TypeError, AttributeError):
        return ()


class Table(NamedTuple):
    """What a table of tissues or of boundaries says.

    Attributes
    ----------
    rows : tuple of Material or BoundaryRule
    unit : str
        Of stiffness.
    preset, whose : str
        Which materials these are, and whose values.
    """

    rows: tuple[Any, ...]
    unit: str = ""
    preset: str = ""
    whose: str = ""

    @classmethod
    def of(cls, layer: Any, role: Role) -> Table:
        """The table a layer carries; an empty one if it carries none."""
        said = (str(known_of(layer).get(name, "")) for name in cls._fields[1:])
        return cls(rows_of(layer, role), *said)

    def give_to(self, layer: Any, role: Role) -> None:
        """Have a layer carry the table."""
        layer.metadata.update(described(role, *self))

    def edited(self, rows: Iterable[Any]) -> Table:
        """The table with rows that somebody has changed, which are no longer all its source's."""
        changed = self.whose and not self.whose.startswith(_CHANGED)
        return self._replace(rows=tuple(rows), whose=(_CHANGED if changed else "") + self.whose)


def change(before: Table, after: Table, name: str) -> str:
    """What was done to the table of a layer of that name, in the past tense."""
    was, now = ({row.label: row for row in table.rows} for table in (before, after))
    differing = [label for label in was | now if was.get(label) != now.get(label)]
    if len(differing) != 1:
        return f"changed the table of '{name}'"
    (label,) = differing
    done, where = ("changed", "of") if label in was else ("added", "to")
    return f"{done} label {label} {where} '{name}'"
