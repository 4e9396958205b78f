"""Tolerance and grid for solves during a drag, at several images a second."""

from __future__ import annotations

import math
from dataclasses import replace

from napari_hmrf.field.volume_preview import CutPlane
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.coarse_grid import CoarseGrid, Preview
from napari_hmrf.study.study import Study

#: Largest number of sites for a solve of a volume, or of an image in large motion, during a drag.
PREVIEW_SITES = 100_000
#: In the large-motion model, images with at most this factor times `PREVIEW_SITES` sites are solved
#: on the full grid.
_LARGER = 4
#: Tolerance during a drag in the large-motion model, in pixels.
_LARGE_MOTION_TOLERANCE = 0.1


def drag_preview(
    study: Study, plane: tuple[int, int] | None = None, cut: CutPlane | None = None
) -> Preview | None:
    """Return the coarse grid for a study during a drag; None for the full grid.

    Parameters
    ----------
    study : Study
    plane : tuple of int, optional
        For a volume in a slice view: axis perpendicular to the visible slice, and index of the
        slice; None in a 3-D view.
    cut : CutPlane, optional
        For a volume in a 3-D view: visible plane; None if the whole volume is visible.

    Returns
    -------
    Preview or None
    """
    shape = study.grid.shape
    if len(shape) == 3:
        grid = CoarseGrid.of_at_most(PREVIEW_SITES, shape)
        axis, number = (None, 0) if plane is None else plane
        return Preview(grid, axis, number, cut)
    if study.model_name != "large motion" or math.prod(shape) <= _LARGER * PREVIEW_SITES:
        return None
    return Preview(CoarseGrid.of_at_most(PREVIEW_SITES, shape))


def as_dragged(study: Study) -> Study:
    """Return the study with the tolerance for a drag; the resulting error is not visible."""
    optimizer = study.optimizer
    if not isinstance(optimizer, Multigrid):
        return study
    tolerance = _LARGE_MOTION_TOLERANCE if study.model_name == "large motion" else TOLERANCE
    tolerance = max(tolerance, optimizer.tolerance)
    return replace(study, optimizer=replace(optimizer, tolerance=tolerance))
