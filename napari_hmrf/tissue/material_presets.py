"""Materials to begin with, from published models, and what tissue becomes that is painted."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.resources import resource_folder
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.tissue.boundary_rules import (
    Material,
    default_rigid,
    poisson_image,
    stiffness_image,
)

FloatArray = npt.NDArray[np.float32]
#: The label of what has a stiffness, but no row in the table.
OTHER = -1
_VOID = Material(0, "no tissue", 0.0)


@dataclass(frozen=True)
class Preset:
    """Published materials that belong together, with their source.

    The stiffnesses of one preset share a unit and must not be mixed with those of another.
    Poisson's ratios are those of the source, if it has any.

    Attributes
    ----------
    name : str
    unit : str
        Unit of stiffness; "" for ratios.
    source : str
    materials : tuple of Material
    """

    name: str
    unit: str
    source: str
    materials: tuple[Material, ...]

    def __repr__(self) -> str:
        return f"Preset({self.name!r}, {len(self.materials)} materials)"

    def take_over(self, rows: Sequence[Material]) -> tuple[tuple[Material, ...], str]:
        """Put these materials in place of those of a table.

        A row becomes the material of its name, else the one of its number that goes to no name;
        what no row becomes is added. A row that becomes none stays void or rigid, or is as the
        preset's first tissue, since an old stiffness may be in another unit.

        Parameters
        ----------
        rows : sequence of Material
            The table.

        Returns
        -------
        materials : tuple of Material
            By label.
        words : str
            What became of the rows that are called otherwise; empty if there are none.
        """
        called = (each for each in self.materials if each.label > 0 and each.name.strip())
        named = {_key(each): each for each in called}
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
                    words.append(f"'{row.name}' is {now[row.label].name} now")
            elif first is None or not row.is_deformable:
                now[row.label] = row
            else:
                now[row.label] = replace(row, stiffness=first.stiffness, poisson=first.poisson)
                words.append(f"'{row.name}' is as stiff as {first.name} now")
        materials = (replace(each, label=label) for label, each in sorted(now.items()))
        return tuple(materials), f"{', '.join(words)}." if words else ""


def _published() -> Iterator[Preset]:
    """The presets of `sample_data/materials.json`."""
    file = resource_folder("sample_data") / "materials.json"
    for preset in json.loads(file.read_text(encoding="utf-8")):
        materials = tuple(Material(*row) for row in preset.pop("materials"))
        yield Preset(**preset, materials=materials)


#: Published stiffnesses differ by orders of magnitude between studies; ratios within one agree
#: better, and only ratios matter here.
PRESETS: tuple[Preset, ...] = tuple(_published())


def _key(row: Material) -> str:
    """Its name, however it is spelt."""
    return row.name.strip().casefold()


@dataclass(frozen=True)
class Palette:
    """Tissues to paint with.

    Attributes
    ----------
    materials : tuple of Material
        One for each label.
    unit : str
        Of their stiffness; may be "".
    one : float
        The stiffness that counts as 1 on the ground that is painted on.
    own : bool
        Whether it is the tissue layer's own table, and not a preset.
    """

    materials: tuple[Material, ...]
    unit: str = ""
    one: float = 1.0
    own: bool = False

    @classmethod
    def of_preset(cls, preset: Preset | None = None, relative: bool = True) -> Palette:
        """Return the tissues of a preset, the void, and what is rigid.

        Parameters
        ----------
        preset : Preset, optional
            By default the first.
        relative : bool
            Whether the first of them counts as 1, as what is not painted does.
        """
        preset = preset or PRESETS[0]
        listed = {row.label for row in preset.materials}
        rows = (*([] if 0 in listed else [_VOID]), *preset.materials)
        first = next(row.stiffness for row in rows if row.is_deformable)
        rigid = default_rigid(max(row.label for row in rows) + 1)
        return cls((*rows, rigid), preset.unit, first if relative else 1.0)

    @property
    def usual(self) -> int:
        """The label of what is not painted, where there is no table."""
        return next(row.label for row in self.materials if row.is_deformable)

    def painted(
        self, labels: npt.NDArray[Any], before: npt.NDArray[Any], m: FloatArray, prior: Prior
    ) -> tuple[FloatArray, Prior]:
        """Return stiffness and energy where some tissue has become another.

        Parameters
        ----------
        labels, before : ndarray of int, shape (H, W)
            As painted, and as they were.
        m : ndarray, shape (H, W), float32
            Stiffness as it was.
        prior : Prior
            With Poisson's ratios as they were.
        """
        changed = labels != before
        if not changed.any():
            return m, prior
        now = labels[changed][None]
        m = m.copy()
        m[changed] = stiffness_image(now, self.materials)[0] / np.float32(self.one)
        if isinstance(prior, Elastic):
            ratios = np.broadcast_to(np.asarray(prior.poisson, dtype=np.float32), m.shape).copy()
            ratios[changed] = np.broadcast_to(poisson_image(now, self.materials), now.shape)[0]
            same = np.unique(ratios[(m > 0) & np.isfinite(m)])
            prior = replace(prior, poisson=float(same[0]) if len(same) == 1 else ratios)
        return m, prior
