"""Published stiffness of tissues by their names in segmentations.

`sample_data/tissue_names.json` lists the tissues with their sources and names. A tissue matches if
the words of one of its names occur in the name of a label in the same order, with any separators:
"fat" matches "subcutaneous_fat_left". Longer names take precedence: "kidney_cyst_left" is a cyst
and not a kidney. A label is unknown if several tissues match, or if its name contains an ambiguous
word such as "lesion".
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

from napari_hmrf.arguments import is_whole, refuse_unless, require_kind
from napari_hmrf.checks import Poisson, Stiffness, Text, checked
from napari_hmrf.resources import resource_folder
from napari_hmrf.tissue.boundary_rules import RIGID, Material, stiffness_in_words, with_motion_of

_Words = tuple[str, ...]
#: Largest number of labels that a sentence lists.
_FEW = 6


@checked
class KnownTissue:
    """Tissue with a published stiffness.

    Attributes
    ----------
    name : str
    stiffness : float
        Young's modulus in kPa; 0 for void, infinity for rigid tissue.
    poisson : float
        Poisson's ratio.
    source : str
        Source of the values, and a remark if they were converted.
    """

    name: Text
    stiffness: Stiffness
    poisson: Poisson
    source: Text

    def __repr__(self) -> str:
        return (
            f"KnownTissue({self.name!r}, {self.stiffness:g} kPa, Poisson's ratio {self.poisson:g})"
        )


@dataclass(frozen=True)
class NamedMaterials:
    """Materials of named labels.

    Attributes
    ----------
    materials : tuple of Material
        Materials of the labels with a known name, sorted by label.
    unknown : mapping of int to str
        Names of the labels with unknown stiffness.
    tissues : mapping of int to KnownTissue
        Known tissue for each label in `materials`.
    unit : str
        Unit of stiffness.
    name : str
        Name of the table that lists the names of labels.
    """

    materials: tuple[Material, ...]
    unknown: Mapping[int, str]
    tissues: Mapping[int, KnownTissue]
    unit: str
    name: str = ""

    def __repr__(self) -> str:
        return f"NamedMaterials({len(self.materials)} known, {len(self.unknown)} unknown)"

    def published(self, labels: Iterable[int]) -> str:
        """Return a clause that lists the labels with published stiffness; "" without such labels.

        Parameters
        ----------
        labels : iterable of int
            Labels of the image or the table.

        Returns
        -------
        str
        """
        present = set(labels)
        known = [f"{row.label} ({row.name})" for row in self.materials if row.label in present]
        more = f" and {len(known) - _FEW} more" if len(known) > _FEW else ""
        if not known:
            return ""
        listed = f"{', '.join(known[:_FEW])}{more}"
        return f"the table only names its labels, so published stiffness is used for {listed}"

    def described(self) -> tuple[str, ...]:
        """Return a line for each known tissue, with its labels, and a line for unknown labels."""
        of_tissue: dict[KnownTissue, list[str]] = {}
        for row in self.materials:
            of_tissue.setdefault(self.tissues[row.label], []).append(f"{row.label} {row.name}")
        lines = []
        for tissue, labels in of_tissue.items():
            values = stiffness_in_words(tissue.stiffness, self.unit)
            if 0 < tissue.stiffness < RIGID:
                values += f", nu {tissue.poisson:g}"
            lines.append(f"{tissue.name} ({values}): {', '.join(labels)}")
        if self.unknown:
            labels = [f"{label} {name}" for label, name in self.unknown.items()]
            lines.append(f"unknown (fill in or remove): {', '.join(labels)}")
        return tuple(lines)

    @property
    def source(self) -> str:
        """Sources of the values of all tissues, in one line."""
        used = dict.fromkeys(self.tissues.values())
        return "; ".join(f"{tissue.name}: {tissue.source}" for tissue in used)

    def replace_materials(self, rows: Sequence[Material]) -> tuple[tuple[Material, ...], str]:
        """Replace the materials of a table, label by label.

        A row with an unknown label is unchanged if it is void or rigid. A deformable row with an
        unknown label is assigned the stiffness of the first known deformable material, because the
        old stiffness may be in another unit. Each row keeps its growth and its sliding.

        Parameters
        ----------
        rows : sequence of Material
            Rows of the table. No label is added.

        Returns
        -------
        materials : tuple of Material
            Rows of the new table.
        words : str
            Sentences about labels that use published stiffness, and about unknown labels with a
            changed stiffness.
        """
        known = {row.label: row for row in self.materials}
        first = next((row for row in self.materials if row.is_deformable), None)
        now, guessed = [], []
        for row in rows:
            other = replace(row, name=self.unknown.get(row.label, row.name))
            if row.label not in known and first is not None and row.is_deformable:
                other = replace(other, stiffness=first.stiffness, poisson=first.poisson)
                guessed.append(f"{row.label} ({other.name})")
            now.append(with_motion_of(known.get(row.label, other), row))
        sentences = []
        if published := self.published(row.label for row in rows):
            sentences.append(f"{published[0].upper()}{published[1:]}.")
        if first is not None and guessed:
            unknown = ", ".join(guessed)
            sentences.append(f"No stiffness is known for {unknown}: that of {first.name} is used.")
        return tuple(now), " ".join(sentences)


class _Rules(NamedTuple):
    """Content of `tissue_names.json`."""

    unit: str
    doubts: frozenset[_Words]
    tissues: dict[_Words, KnownTissue]


def lookup_tissue(name: str) -> KnownTissue | None:
    """Return the tissue that a name refers to, or None unless exactly one tissue matches.

    Parameters
    ----------
    name : str
        Name of a label in a segmentation, such as "Left-Cerebral-White-Matter" or
        "lung_upper_lobe_left".

    Returns
    -------
    KnownTissue or None

    Raises
    ------
    ArgumentError
        If the name is not a string.
    """
    require_kind(str, "name", name, '"liver"')
    words = _words(name)
    rules = _rules()
    spans = [(i, j) for i in range(len(words)) for j in range(i + 1, len(words) + 1)]
    matches = [(i, j) for i, j in spans if words[i:j] in rules.tissues]
    matches = [span for span in matches if not _is_within(span, matches)]
    doubts = [(i, j) for i, j in spans if words[i:j] in rules.doubts]
    tissues = {rules.tissues[words[i:j]] for i, j in matches}
    if len(tissues) != 1 or any(not _is_within(span, matches) for span in doubts):
        return None
    return tissues.pop()


def materials_by_name(names: Mapping[int, str], *, name: str = "") -> NamedMaterials:
    """Assign published stiffness to labels by their names.

    Parameters
    ----------
    names : mapping of int to str
        Name of each label of a segmentation, as returned by `read_label_names`.
    name : str
        Name of the table that lists the names of labels.

    Returns
    -------
    NamedMaterials
        Materials in kPa with their sources, and the unknown labels.

    Raises
    ------
    ArgumentError
        If `names` does not map whole numbers to strings.

    Examples
    --------
    >>> from napari_hmrf.tissue import materials_by_name
    >>> found = materials_by_name({5: "liver", 20: "colon", 91: "skull"})
    >>> [(row.name, row.stiffness) for row in found.materials], found.unknown
    ([('liver', 5.4), ('skull', inf)], {20: 'colon'})
    """
    right = isinstance(names, Mapping) and all(map(is_whole, names))
    requirement = 'a mapping of labels to names, such as {1: "liver", 2: "bone"}'
    refuse_unless(right, "names", names, requirement)
    tissues = {label: lookup_tissue(names[label]) for label in sorted(names)}
    known = {label: tissue for label, tissue in tissues.items() if tissue is not None}
    materials = tuple(
        Material(label, names[label], tissue.stiffness, tissue.poisson)
        for label, tissue in known.items()
    )
    unknown = {label: names[label] for label in tissues if label not in known}
    return NamedMaterials(materials, unknown, known, _rules().unit, name)


def _words(name: str) -> _Words:
    """Return the words of a name, in lower case."""
    return tuple(re.findall(r"[^\W_]+", name.casefold()))


def _is_within(span: tuple[int, int], others: list[tuple[int, int]]) -> bool:
    """Return whether a longer span among `others` contains the given span."""
    first, last = span
    return any(i <= first and last <= j and j - i > last - first for i, j in others)


@cache
def _rules() -> _Rules:
    file = resource_folder("sample_data") / "tissue_names.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    tissues: dict[_Words, KnownTissue] = {}
    for row in content["tissues"]:
        tissue = KnownTissue(row["name"], row["stiffness"], row["poisson"], row["source"])
        tissues |= {_words(name): tissue for name in row["names"]}
    return _Rules(content["unit"], frozenset(map(_words, content["doubts"])), tissues)
