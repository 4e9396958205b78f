"""Presets of published materials, and palettes of tissues for painting."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.checks import Text, checked
from napari_hmrf.resources import resource_folder
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.tissue.boundary_rules import (
    Material,
    default_material,
    default_rigid,
    poisson_image,
    stiffness_image,
    unlisted,
    with_motion_of,
)

FloatArray = npt.NDArray[np.float32]
#: Label of pixels that have a stiffness but no row in the table.
OTHER = -1
_VOID = Material(0, "no tissue", 0.0)


@checked
class Preset:
    """Published materials from one source.

    All stiffnesses of a preset share a unit, and must not be mixed with stiffnesses of another
    preset. The Poisson's ratios are from the source, if the source reports any.

    Attributes
    ----------
    name : str
    unit : str
        Unit of stiffness; "" if only ratios of stiffness are known.
    source : str
        Reference to the publication.
    materials : tuple of Material
    """

    name: Text
    unit: Text
    source: Text
    materials: tuple[Material, ...]

    def __repr__(self) -> str:
        return f"Preset({self.name!r}, {len(self.materials)} materials)"

    def replace_materials(self, rows: Sequence[Material]) -> tuple[tuple[Material, ...], str]:
        """Replace the materials of a table with the materials of the preset.

        A row is replaced with the preset's material of the same name. If there is no such material,
        the row is replaced with the material of the same label, unless the name of that material
        matches another row. The remaining materials of the preset are added. A row that is not
        replaced is unchanged if it is void or rigid. A deformable row that is not replaced is
        assigned the stiffness of the preset's first tissue, because the old stiffness may be in
        another unit. A row keeps its growth and its sliding unless the preset has its own.

        Parameters
        ----------
        rows : sequence of Material
            Rows of the table.

        Returns
        -------
        materials : tuple of Material
            Rows of the new table, sorted by label.
        words : str
            Sentence about rows with a changed name or stiffness; "" if there are no such rows.
        """
        with_names = (each for each in self.materials if each.label > 0 and each.name.strip())
        named = {_key(each): each for each in with_names}
        now = {row.label: named[_key(row)] for row in rows if row.label > 0 and _key(row) in named}
        for material in self.materials:
            if material not in now.values():
                known = (*now, *(each.label for each in (*rows, *self.materials)))
                now[max(known) + 1 if material.label in now else material.label] = material
        first = next((each for each in self.materials if each.is_deformable), None)
        words = []
        for row in rows:
            if row.label in now:
                if _key(row) != _key(now[row.label]):
                    words.append(f"'{row.name}' is now {now[row.label].name}")
                now[row.label] = with_motion_of(now[row.label], row)
            elif first is None or not row.is_deformable:
                now[row.label] = row
            else:
                now[row.label] = replace(row, stiffness=first.stiffness, poisson=first.poisson)
                words.append(f"'{row.name}' is now as stiff as {first.name}")
        materials = (replace(each, label=label) for label, each in sorted(now.items()))
        return tuple(materials), f"{', '.join(words)}." if words else ""


def _published() -> Iterator[Preset]:
    """Yield the presets of `sample_data/materials.json`."""
    file = resource_folder("sample_data") / "materials.json"
    for preset in json.loads(file.read_text(encoding="utf-8")):
        materials = tuple(Material(*row) for row in preset.pop("materials"))
        yield Preset(**preset, materials=materials)


#: Published presets. Published stiffnesses differ by orders of magnitude between studies; their
#: ratios within a study agree better, and only ratios matter for the displacement.
PRESETS: tuple[Preset, ...] = tuple(_published())

#: Preset for images that need not show tissue, such as photographs; not from a publication.
PLAIN = Preset(
    "Normal, soft, stiff",
    "",
    "no publication: relative stiffnesses for photographs and drawings, and Poisson's ratio 0.45",
    (
        Material(1, "normal", 1.0, 0.45),
        Material(2, "soft", 0.2, 0.45),
        Material(3, "stiff", 5.0, 0.45),
    ),
)


def _key(row: Material) -> str:
    """Return the name of a row for comparisons that ignore case and surrounding spaces."""
    return row.name.strip().casefold()


@dataclass(frozen=True)
class Palette:
    """Set of tissues for painting.

    Attributes
    ----------
    materials : tuple of Material
        Materials with distinct labels.
    unit : str
        Unit of stiffness; "" if it is unknown.
    unit_stiffness : float
        Stiffness in the palette that corresponds to a stiffness of 1 in the painted image. It is
        not 1 only if unpainted tissue has no stiffness of its own.
    is_table : bool
        True if the palette is the table of the tissue layer, False if it is a preset.
    spare : tuple of Material
        Materials for painted labels that are not in `materials`, such as those of a preset beside a
        table.
    """

    materials: tuple[Material, ...]
    unit: str = ""
    unit_stiffness: float = 1.0
    is_table: bool = False
    spare: tuple[Material, ...] = ()

    @classmethod
    def of_preset(
        cls, preset: Preset | None = None, typical: float | None = None, unit: str = ""
    ) -> Palette:
        """Create a palette from the tissues of a preset, a void material and a rigid material.

        Only the ratios between the stiffnesses of the preset matter: its first deformable tissue is
        as stiff as typical unpainted tissue.

        Parameters
        ----------
        preset : Preset, optional
            Preset; the default is the first preset.
        typical : float, optional
            Stiffness of typical unpainted tissue; see `typical_stiffness`. The palette then has the
            stiffnesses that are painted, rounded to three digits. By default, unpainted tissue has
            a stiffness of 1, and the palette has the stiffnesses of the preset.
        unit : str
            Unit of `typical`.

        Returns
        -------
        Palette
        """
        preset = preset or PRESETS[0]
        listed = {row.label for row in preset.materials}
        rows = (*([] if 0 in listed else [_VOID]), *preset.materials)
        first = next(row.stiffness for row in rows if row.is_deformable)
        rigid = default_rigid(max(row.label for row in rows) + 1)
        if typical is None:
            return cls((*rows, rigid), preset.unit, first)
        scaled = (
            replace(row, stiffness=float(f"{row.stiffness / first * typical:.3g}")) for row in rows
        )
        return cls((*scaled, rigid), unit)

    @property
    def unpainted_label(self) -> int:
        """Label of the first deformable material, for unpainted tissue without a table."""
        return next(row.label for row in self.materials if row.is_deformable)

    def assumed(self, labels: npt.ArrayLike) -> tuple[Material, ...]:
        """Return materials for the labels that are not in the palette.

        Strokes have such labels if they were painted before another source of stiffness was chosen.
        The material is that of `spare`, or else a copy of the first deformable material.
        """
        spare = {row.label: row for row in self.spare}
        missing = unlisted(labels, self.materials)
        return tuple(
            spare.get(label) or default_material(label, self.materials) for label in missing
        )

    def painted(
        self, labels: npt.NDArray[Any], before: npt.NDArray[Any], m: FloatArray, prior: Prior
    ) -> tuple[FloatArray, Prior]:
        """Return the stiffness and the prior after pixels were painted with other tissues.

        Parameters
        ----------
        labels, before : ndarray of int, shape ([D,] H, W)
            Labels after and before painting.
        m : ndarray, shape ([D,] H, W), float32
            Stiffness before painting.
        prior : Prior
            Prior before painting, with its Poisson's ratios.

        Returns
        -------
        m : ndarray, shape ([D,] H, W), float32
            Stiffness after painting.
        prior : Prior
            Prior after painting.
        """
        changed = labels != before
        if not changed.any():
            return m, prior
        now = labels[changed][None]
        m, rows = m.copy(), (*self.materials, *self.assumed(now))
        m[changed] = stiffness_image(now, rows)[0] / np.float32(self.unit_stiffness)
        if isinstance(prior, Elastic):
            ratios = np.broadcast_to(np.asarray(prior.poisson, dtype=np.float32), m.shape).copy()
            ratios[changed] = np.broadcast_to(poisson_image(now, rows), now.shape)[0]
            same = np.unique(ratios[(m > 0) & np.isfinite(m)])
            prior = replace(prior, poisson=float(same[0]) if len(same) == 1 else ratios)
        return m, prior
