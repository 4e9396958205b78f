"""Growth of a labelled region with the mouse wheel, by the growth in the table of tissues."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from napari.layers import Labels

from napari_hmrf.solver.priors import Elastic
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.session import Part, Session
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing.growth import patch_at
from napari_hmrf.tissue.drawing.marks import Point

#: Growth by one notch of the wheel, and largest shrinkage, as relative changes in length.
_NOTCH, _MOST_SHRINKAGE = 0.05, 0.8


class RegionGrowth:
    """Growth of all tissue of a label, such as a tumour, as one undo step for each label.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        # Label of the region whose growth is in progress.
        self._growing = 0
        # Label of the main tissue of a ground, which is computed once for each ground.
        self._main: tuple[Ground | None, int | None] = (None, None)

    def material_at(self, moved: Deformation, point: Point) -> Material | None:
        """Return the material of the region at a displayed position, or None.

        The region must have a row of the table, and not be the main tissue. Where the drawing moves
        or grows a patch, the wheel changes this patch instead.
        """
        ground, at = moved.ground, moved.origin_of(point)
        layer = self._session.choice.tissue_layer
        if ground is None or at is None or not isinstance(layer, Labels):
            return None
        if not (ground.palette.is_table and isinstance(moved.study.prior, Elastic)):
            return None
        labels = ground.base.labels
        site = tuple(
            min(max(round(x), 0), size - 1) for x, size in zip(at, labels.shape, strict=True)
        )
        label = int(labels[site])
        rows = [row for row in ground.palette.materials if row.label == label and row.is_deformable]
        if not rows or label in (0, self._main_label(ground)):
            return None
        is_drawn = patch_at(self._session.drawing, at, ground.base.spacing) is not None
        return None if is_drawn else rows[0]

    def turn(self, material: Material, notches: float) -> Material:
        """Grow or shrink all tissue of a material; return its new row of the table."""
        session, layer = self._session, self._session.choice.tissue_layer
        part, word = Part("tissue", layer), f"grew '{material.name or material.label}'"
        table = session.table("tissue", layer)
        assert table is not None
        before = next(row for row in table.rows if row.label == material.label)
        changed = np.maximum(np.add(before.growth, _NOTCH * notches), -_MOST_SHRINKAGE).round(6)
        row: Material = replace(
            before, growth=tuple(changed.tolist()) if changed.ndim else float(changed)
        )
        if session.in_progress != part or self._growing != material.label:
            session.begin(part, word)
            self._growing = material.label
        session.update(table.edited(row if each is before else each for each in table.rows))
        return row

    def end(self) -> None:
        """End the undo step."""
        if self._session.in_progress == Part("tissue", self._session.choice.tissue_layer):
            self._session.end()

    def _main_label(self, ground: Ground) -> int | None:
        """Return the label of the largest deformable tissue."""
        if self._main[0] is not ground:
            counts = {
                row.label: np.count_nonzero(ground.base.labels == row.label)
                for row in ground.palette.materials
                if row.is_deformable
            }
            main = max(counts, key=lambda label: counts[label], default=None)
            self._main = ground, main
        return self._main[1]
