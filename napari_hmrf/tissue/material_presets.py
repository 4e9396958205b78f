"""Materials to begin with, from published models."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from napari_hmrf.resources import resource_folder
from napari_hmrf.tissue.boundary_rules import Material


@dataclass(frozen=True)
class Preset:
    """Materials that belong together, and where their values come from.

    The stiffnesses of one preset share a unit and must not be mixed with those of another.
    Poisson's ratios are those of the source, if it has any.
    """

    name: str
    unit: str
    source: str
    materials: tuple[Material, ...]


def _published() -> Iterator[Preset]:
    """The presets of `sample_data/materials.json`."""
    file = resource_folder("sample_data") / "materials.json"
    for preset in json.loads(file.read_text(encoding="utf-8")):
        materials = tuple(Material(*row) for row in preset.pop("materials"))
        yield Preset(**preset, materials=materials)


#: Published stiffnesses differ by orders of magnitude between studies; ratios within one agree
#: better, and only ratios matter here.
PRESETS: tuple[Preset, ...] = tuple(_published())


def take_over(preset: Preset, rows: Sequence[Material]) -> tuple[tuple[Material, ...], str]:
    """Put the materials of a preset in place of those of a table.

    A row becomes the material of its name, else the one of its number that goes to no name; what
    no row becomes is added. A row that becomes none stays void or rigid, or is as the preset's
    first tissue, since an old stiffness may be in another unit.

    Parameters
    ----------
    preset : Preset
    rows : sequence of Material
        The table.

    Returns
    -------
    materials : tuple of Material
        By label.
    words : str
        What became of the rows that are called otherwise; empty if there are none.
    """
    named = {_key(each): each for each in preset.materials if each.label > 0 and each.name.strip()}
    now = {row.label: named[_key(row)] for row in rows if row.label > 0 and _key(row) in named}
    for material in preset.materials:
        if material not in now.values():
            known = (*now, *(each.label for each in (*rows, *preset.materials)))
            now[max(known) + 1 if material.label in now else material.label] = material
    first = next((each for each in preset.materials if each.is_deformable), None)
    words = []
    for row in rows:
        if row.label in now:
            if _key(row) != _key(now[row.label]):
                words.append(f"'{row.name}' is {now[row.label].name} now")
        elif first is None or not row.is_deformable:
            now[row.label] = row
        else:
            now[row.label] = replace(row, stiffness=first.stiffness, poisson=first.poisson)
            words.append(f"'{row.name}' is as stiff as {first.name} now")
    materials = (replace(each, label=label) for label, each in sorted(now.items()))
    return tuple(materials), f"{', '.join(words)}." if words else ""


def _key(row: Material) -> str:
    """Its name, however it is spelt."""
    return row.name.strip().casefold()
