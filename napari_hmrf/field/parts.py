"""Parts of tissue that slide along each other, between which a displacement has no derivative.

A site belongs to one part. Neighbouring sites of two parts have moved past each other, so that
their difference is a slip and no strain, and an element with sites of two parts does not exist.
Derivatives, folds and moved images are therefore computed within each part, as if the other parts
were void.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import pairs
from napari_hmrf.real_arrays import whole_numbers

BoolArray = npt.NDArray[np.bool_]
#: Number of the part of each site, 0 outside tissue; or the mask of connected tissue.
Sites = BoolArray | npt.NDArray[np.int64]


def part_numbers(mask: BoolArray, parts: npt.ArrayLike | None) -> Sites:
    """Return the number of the part of each site.

    Parameters
    ----------
    mask : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue.
    parts : array_like of int, shape ([D,] H, W), or None
        Label of the part of each site; None if all tissue is connected. Labels outside tissue are
        ignored.

    Returns
    -------
    ndarray of int or bool, shape ([D,] H, W)
        Above 0 in tissue and 0 elsewhere; the mask if `parts` is None.

    Raises
    ------
    ProblemError
        If the parts are no whole numbers on the grid of the mask.
    """
    if parts is None:
        return mask
    labels = whole_numbers("parts", parts)
    if labels.shape != mask.shape:
        raise ProblemError(
            "parts",
            f"have shape {labels.shape}, but the displacement needs {mask.shape}. Use the same "
            "pixel grid for both.",
        )
    numbers = labels.astype(np.int64)
    numbers += 1 - numbers.min(initial=0)
    return np.where(mask, numbers, 0)


def same_part(one: Sites, other: Sites) -> Sites:
    """Return the common part of pairs of sites; 0 or False if they have none."""
    if one.dtype == np.bool_:
        return one & other
    return np.where(one == other, one, 0)


def in_one_part(sites: Sites) -> BoolArray:
    """Return a mask of the elements with all corners in tissue of one part.

    Parameters
    ----------
    sites : ndarray of bool or int, shape (H, W) or (D, H, W)
        As from `part_numbers`.

    Returns
    -------
    ndarray of bool, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
    """
    common = sites
    for first, second in pairs(sites.ndim):
        common = same_part(common[first], common[second])
    return common.astype(np.bool_)
