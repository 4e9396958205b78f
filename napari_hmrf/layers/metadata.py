"""Metadata that this package stores in layers: the role of a layer, and its table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, overload

from pydantic import TypeAdapter

from napari_hmrf.tissue.boundary_rules import MATERIALS, RULES, BoundaryRule, Material
from napari_hmrf.tissue.row_table import Row, RowTable

#: Key of the package's entry in a layer's metadata.
METADATA = "napari-hmrf"

#: Key of the order of the axes in the file of a layer, see `Frame.file_axes`.
FILE_AXES = "file_axes"
#: Role of a layer in a study.
Role = Literal["image", "tissue", "boundary"]
IMAGE: Literal["image"] = "image"
TISSUE: Literal["tissue"] = "tissue"
BOUNDARY: Literal["boundary"] = "boundary"
_TABLES: dict[Role, tuple[str, TypeAdapter[Any]]] = {
    TISSUE: ("materials", MATERIALS),
    BOUNDARY: ("rules", RULES),
}


def metadata_of(layer: Any) -> Mapping[str, Any]:
    """Return the package's entry in the metadata of a layer, or {} if there is none."""
    known = layer.metadata.get(METADATA)
    return known if isinstance(known, Mapping) else {}


def add_metadata(layer: Any, **facts: Any) -> None:
    """Add values to the package's entry in the metadata of a layer."""
    layer.metadata = {**layer.metadata, METADATA: {**metadata_of(layer), **facts}}


def file_axes_of(layer: Any) -> tuple[int, ...]:
    """Return the axis of the image file for each axis of a layer; () if they were not reordered."""
    axes = metadata_of(layer).get(FILE_AXES, ())
    known = isinstance(axes, list | tuple) and sorted(axes) == [*range(int(layer.ndim))]
    return tuple(axes) if known else ()


def layer_metadata(
    role: Role,
    rows: Iterable[Material | BoundaryRule] = (),
    unit: str = "",
    preset: str = "",
    source: str = "",
) -> dict[str, Any]:
    """Create metadata with the role of a layer and its table, in JSON types.

    Parameters
    ----------
    role : {"image", "tissue", "boundary"}
    rows : iterable of Material or BoundaryRule
        Rows of the table.
    unit : str
        Unit of stiffness.
    preset : str
        Name of the preset from which the table was created.
    source : str
        Source of the values in the preset.
    """
    known: dict[str, Any] = {"role": role}
    if role in _TABLES:
        key, kind = _TABLES[role]
        known[key] = kind.dump_python(tuple(rows), mode="json")
    texts = {"unit": unit, "preset": preset, "source": source}
    return {METADATA: {**known, **{name: words for name, words in texts.items() if words}}}


def tissue_record(layer: Any, materials: Iterable[Material]) -> dict[str, Any]:
    """Return a description of the tissue, in JSON types, to be stored with a solution.

    Parameters
    ----------
    layer : napari.layers.Labels or napari.layers.Image
        Layer that defines the tissue.
    materials : iterable of Material
        Materials of the labels.

    Returns
    -------
    dict
        Name of the layer and, if available, the unit of stiffness and the materials.
    """
    known = metadata_of(layer)
    record = {"layer": str(layer.name), **({"unit": known["unit"]} if "unit" in known else {})}
    rows = MATERIALS.dump_python(tuple(materials), mode="json")
    return {**record, "materials": rows} if rows else record


def tissue_recorded(layer: Any) -> tuple[tuple[Material, ...] | None, str]:
    """Return the materials used to compute a result, and the unit of stiffness.

    If the layer has no valid record of the tissue, the materials are None and the unit is "".
    """
    try:
        record = metadata_of(layer)["solution"].provenance.parameters["tissue"]
        return MATERIALS.validate_python(record["materials"]), str(record.get("unit", ""))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError):
        return None, ""


def role_of(layer: Any) -> Role | None:
    """Return the role stored in the metadata of a layer, or None."""
    role = metadata_of(layer).get("role")
    return role if role in (IMAGE, TISSUE, BOUNDARY) else None


@overload
def rows_of(layer: Any, role: Literal["tissue"]) -> tuple[Material, ...]: ...
@overload
def rows_of(layer: Any, role: Literal["boundary"]) -> tuple[BoundaryRule, ...]: ...
@overload
def rows_of(layer: Any, role: Role) -> tuple[Material | BoundaryRule, ...]: ...
def rows_of(layer: Any, role: Role) -> tuple[Any, ...]:
    """Return the table rows in the metadata of a layer, or () if missing or invalid."""
    key, kind = _TABLES[role]
    try:
        return kind.validate_python(metadata_of(layer)[key])  # type: ignore[no-any-return]
    except (KeyError, ValueError):
        return ()


@overload
def table_of(layer: Any, role: Literal["tissue"]) -> RowTable[Material]: ...
@overload
def table_of(layer: Any, role: Literal["boundary"]) -> RowTable[BoundaryRule]: ...
@overload
def table_of(layer: Any, role: Role) -> RowTable[Any]: ...
def table_of(layer: Any, role: Role) -> RowTable[Any]:
    """Return the table in the metadata of a layer, or an empty table if missing or invalid."""
    texts = (str(metadata_of(layer).get(name, "")) for name in RowTable._fields[1:])
    return RowTable(rows_of(layer, role), *texts)


def store_table(table: RowTable[Row], layer: Any, role: Role) -> None:
    """Store a table in the metadata of a layer."""
    layer.metadata.update(layer_metadata(role, *table))
