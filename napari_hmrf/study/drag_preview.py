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
#: Images with at most this number of sites are solved on the full grid, by model. Larger images are
#: solved during a drag on a grid with at most as many sites as the second number.
_IMAGES: dict[str, tuple[int, int]] = {
    "large motion": (4 * PREVIEW_SITES, PREVIEW_SITES),
    "elastic": (1_500_000, 4 * PREVIEW_SITES),
}
#: Largest number of pixels of a picture that is warped during a drag, in about 0.1 s.
_PICTURE = 1_500_000


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
    largest, sites = _IMAGES.get(study.model_name, (math.inf, 1))
    if math.prod(shape) <= largest:
        return None
    pixel = CoarseGrid.of_at_most(_PICTURE, shape).step
    step = CoarseGrid.of_at_most(sites, shape).step
    return Preview(CoarseGrid(-(-step // pixel) * pixel), pixel=pixel)


def as_dragged(study: Study) -> Study:
    """Return the study with the tolerance for a drag; the resulting error is not visible.

    Most of the work of large motion is the way to the targets, whatever the tolerance, so that its
    last solve of a drag is the result.
    """
    optimizer = study.optimizer
    if not isinstance(optimizer, Multigrid) or study.model_name == "large motion":
        return study
    tolerance = max(TOLERANCE, optimizer.tolerance)
    return replace(study, optimizer=replace(optimizer, tolerance=tolerance))
