"""The dark surroundings of a picture, which are no tissue, or soft."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.normals import outside_of

# Of how far what is bright is from air, so much must what is dark be apart to be two things.
_APART = 0.35
# And each of them so much of the surroundings.
_PART = 0.02
# Of how many pictures the border is known.
_KEPT = 4
_known: list[tuple[weakref.ref[Any], npt.NDArray[np.bool_]]] = []
# What is dark surrounds something from this part of the picture's edge on.
_AROUND = 0.75
# So far above what surrounds it tissue begins, on the way to its usual intensity.
_ABOVE = 0.01


def background_of(picture: npt.NDArray[Any], axes: int = 2) -> npt.NDArray[np.bool_]:
    """Tell the dark surroundings of a picture from what is in it.

    Dark is what Otsu's threshold says; surroundings are what hangs together with the edge of the
    picture, so that dark places inside stay tissue. Where those are clearly of two kinds, as air
    and fat are in a CT, only the darker one is air.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        How many of it are not colours: 3 of a volume.

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        Nothing, if the picture is of one value.
    """
    from skimage.filters import threshold_otsu

    grey = picture[..., :3].mean(axis=-1) if picture.ndim > axes else picture
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool)
    threshold = threshold_otsu(values)
    found = outside_of(grey > threshold)  # what is no number is dark
    around = grey[found & np.isfinite(grey)].astype(np.float64)
    if around.size and around.min() < around.max():
        below = threshold_otsu(around)
        air, rest = around[around <= below], around[around > below]
        bright = values[values > threshold]
        apart = rest.mean() - air.mean() > _APART * (bright.mean() - air.mean())
        if apart and min(len(air), len(rest)) > _PART * len(around):
            found = outside_of(grey > below)
    return found


def dark_border(picture: npt.NDArray[Any], axes: int = 2) -> npt.NDArray[np.bool_]:
    """What is dark around a picture, if it surrounds something; else nothing.

    Of a picture that cannot be written to it is found once.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        How many of it are not colours: 3 of a volume.
    """
    known = next((mask for image, mask in _known if image() is picture), None)
    if known is None:
        known = background_of(picture, axes)
        known = known & surrounds(known)
        if not picture.flags.writeable:
            _known[:] = [(weakref.ref(picture), known), *_known][:_KEPT]
    return known


def surrounds(dark: npt.NDArray[np.bool_]) -> bool:
    """Whether what is dark in a picture surrounds something: in a photograph it is a shadow.

    Parameters
    ----------
    dark : ndarray of bool, shape ([D,] H, W)
        Of `background_of`.
    """
    edge = np.concatenate(
        [dark.take(end, axis).ravel() for axis in range(dark.ndim) for end in (0, -1)]
    )
    return bool(edge.mean() >= _AROUND)


def void_threshold(picture: npt.NDArray[Any]) -> float | None:
    """Guess the intensity below which there is no tissue.

    Parameters
    ----------
    picture : ndarray, shape (H, W)

    Returns
    -------
    float or None
        None if nothing dark surrounds anything.
    """
    dark, known = background_of(picture), np.isfinite(picture)
    air, inside = picture[dark & known], picture[~dark & known]
    if not (surrounds(dark) and air.size and inside.size):
        return None
    # Just above nearly all of it: dark places inside, such as fluid, stay tissue.
    darkest, usual = float(np.percentile(air, 99)), float(np.median(inside))
    return float(f"{darkest + _ABOVE * (usual - darkest):.4g}")


def air_that_is_tissue(picture: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> str:
    """Say so where most of what is dark around a picture counts as tissue, as a clause.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    tissue : ndarray of bool, shape ([D,] H, W)
    """
    dark = dark_border(picture, tissue.ndim)
    if not dark.any() or 2 * np.count_nonzero(dark & tissue) < np.count_nonzero(dark):
        return ""
    return (
        "the dark surroundings of the image move as tissue does, too: if they are air, say that "
        "they are no tissue (`without_border=True`)"
    )
