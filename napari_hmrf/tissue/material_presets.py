"""Materials to begin with, from published models."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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


#: Published stiffnesses differ by orders of magnitude between studies; ratios within one agree
#: better, and only ratios matter here.
PRESETS: tuple[Preset, ...] = (
    Preset(
        "Paper: normal 20, soft 10, tumour 40",
        "MPa",
        "Seiler et al., Hierarchical Markov Random Fields Applied to Model Soft Tissue "
        "Deformations on Graphics Hardware, section 2; it has no Poisson's ratio, so that is 0.45, "
        "common for soft tissue",
        (
            Material(1, "normal tissue", 20.0),
            Material(2, "soft tissue", 10.0),
            Material(3, "tumour", 40.0),
        ),
    ),
    Preset(
        "Brain with tumour: healthy 2.1, fluid 0.1, tumour 8",
        "kPa",
        "parameters of the tumour growth solver GLIA (Subramanian, Biros and others), Poisson's "
        "ratios 0.4, 0.1 and 0.45; fluid is modelled there as very soft tissue",
        (
            Material(1, "white and grey matter", 2.1, 0.4),
            Material(2, "cerebrospinal fluid", 0.1, 0.1),
            Material(3, "tumour", 8.0, 0.45),
        ),
    ),
    Preset(
        "Brain: white and grey matter 3, fluid 1",
        "kPa",
        "parameters of the glioma growth library glimslib (Abler, Büchler and others), Poisson's "
        "ratio 0.45 for both",
        (
            Material(1, "white and grey matter", 3.0, 0.45),
            Material(2, "cerebrospinal fluid", 1.0, 0.45),
        ),
    ),
    Preset(
        "Brain: grey matter 1.4, white matter 1.9",
        "kPa",
        "Budday, Nay, de Rooij, Steinmann, Wyrobek, Ovaert and Kuhl, Mechanical properties of gray "
        "and white matter brain tissue by indentation, Journal of the Mechanical Behavior of "
        "Biomedical Materials 46 (2015): means of indentations of bovine brains; no Poisson's "
        "ratio, so that is 0.45, common for soft tissue",
        (
            Material(1, "grey matter", 1.389),
            Material(2, "white matter", 1.895),
        ),
    ),
    Preset(
        "Muscle 3, fat 2.3",
        "kPa",
        "Strain-dependent shear properties of human adipose tissue in vivo, Journal of the "
        "Mechanical Behavior of Biomedical Materials (2023): buttocks of volunteers by magnetic "
        "resonance elastography at 50 Hz, not compressed; Young's modulus taken as three times the "
        "shear modulus, of 1.0 and 0.752 kPa; Poisson's ratio 0.49, for tissue that hardly changes "
        "its volume",
        (
            Material(1, "muscle", 3.0, 0.49),
            Material(2, "fat", 2.256, 0.49),
        ),
    ),
    Preset(
        "Liver 5.4, carcinoma 70",
        "kPa",
        "table 1, from the literature, of an article in Physics in Medicine and Biology 64 (2019) "
        "225001, doi 10.1088/1361-6560/ab5010; Young's modulus taken as three times the shear "
        "modulus, of 1.8 and 23.4 kPa; Poisson's ratio 0.49, for tissue that hardly changes its "
        "volume",
        (
            Material(1, "liver", 5.4, 0.49),
            Material(2, "hepatocellular carcinoma", 70.2, 0.49),
        ),
    ),
    Preset(
        "Breast: fat and gland 3.2, carcinoma 10 to 43",
        "kPa",
        "Samani, Zubovits and Plewes, Elastic moduli of normal and pathological human breast "
        "tissues, Physics in Medicine and Biology 52 (2007) 1565, doi 10.1088/0031-9155/52/6/002: "
        "means of samples outside the body; no Poisson's ratio, so that is 0.45, common for soft "
        "tissue",
        (
            Material(1, "fibroglandular tissue", 3.24),
            Material(2, "fat", 3.25),
            Material(3, "invasive ductal carcinoma, low grade", 10.4),
            Material(4, "invasive ductal carcinoma, high grade", 42.52),
        ),
    ),
)


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
