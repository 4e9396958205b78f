"""Materials to begin with, from published models."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
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

    Those of one name are one material, whatever its number in the preset; the others go by their
    number. What the preset does not have stays void, or becomes its first tissue, since an old
    stiffness may be in another unit. What is rigid is so in any unit, and stays.

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
        What became of what the preset calls otherwise, or does not have; empty if all is as named.
    """
    ours, theirs = _by_name(rows), _by_name(preset.materials)
    given = {ours[name].label: theirs[name] for name in ours.keys() & theirs.keys()}
    named, mine = set(given), {row.label: row for row in rows}
    for material in preset.materials:
        if material in given.values():
            continue
        label = material.label
        if label in given:
            label = max([*mine, *given, *(each.label for each in preset.materials)]) + 1
        given[label] = material
    first = next((each for each in preset.materials if each.is_deformable), None)
    left = [row for row in rows if row.label not in given]
    others = left if first is None else [_as(first, row) for row in left]
    renamed = [
        f"'{mine[label].name}' is {material.name} now"
        for label, material in sorted(given.items())
        if label in mine and label not in named and mine[label].name != material.name
    ]
    sentences = []
    if renamed:
        number = "its number" if len(renamed) == 1 else "their numbers"
        sentences.append(f"By {number} {_and(renamed)}.")
    stiff = [f"'{row.name}'" for row in left if row.is_deformable]
    if stiff and first is not None:
        isare = "is" if len(stiff) == 1 else "are"
        sentences.append(f"{_and(stiff)} {isare} not among them: as stiff as {first.name} now.")
    materials = (*others, *(replace(each, label=label) for label, each in given.items()))
    return tuple(sorted(materials, key=lambda each: each.label)), " ".join(sentences)


def _as(first: Material, row: Material) -> Material:
    """What a preset does not have, as its first tissue; void and rigid stay so."""
    stiffness = first.stiffness if row.is_deformable else row.stiffness
    return replace(row, stiffness=stiffness, poisson=first.poisson)


def _by_name(rows: Iterable[Material]) -> dict[str, Material]:
    """Those whose name is theirs alone; what is unpainted is nothing that has one."""
    named = [(row.name.strip().casefold(), row) for row in rows if row.label > 0]
    often = Counter(name for name, _ in named)
    return {name: row for name, row in named if name and often[name] == 1}


def _and(parts: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(parts[:-1]), parts[-1]) if part)
