"""Detection of the dark surroundings of a picture, which are void or soft."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.tissue.normals import outside_of

# Dark surroundings are of two kinds if their means differ by this fraction of the contrast between
# the bright pixels and air.
_APART = 0.35
# Each kind must also cover this fraction of the surroundings.
_PART = 0.02
# Number of pictures whose border is cached.
_KEPT = 4
_known: list[tuple[weakref.ref[Any], npt.NDArray[np.bool_]]] = []
# Dark pixels surround something if they cover at least this fraction of the picture's edge.
_AROUND = 0.75
# Position of the void threshold between the intensity of air (0) and the usual one of tissue (1).
_ABOVE = 0.01


def background_of(picture: npt.NDArray[Any], axes: int = 2) -> npt.NDArray[np.bool_]:
    """Find the dark surroundings of a picture.

    Otsu's threshold defines dark pixels; those connected to the edge of the picture are
    surroundings, so that dark places inside stay tissue. If the surroundings are clearly of two
    kinds, such as air and fat in a CT, only the darker kind is air.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        Number of axes without channels: 3 for a volume.

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        All False if the picture is constant.
    """
    from skimage.filters import threshold_otsu  # heavy: skimage

    grey = picture[..., :3].mean(axis=-1) if picture.ndim > axes else picture
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool)
    threshold = threshold_otsu(values)
    found = outside_of(grey > threshold)  # NaN counts as dark
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
    """Return the dark surroundings of a picture, or an empty mask if they surround nothing.

    The result is cached for read-only pictures.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        Number of axes without channels: 3 for a volume.
    """
    known = next((mask for image, mask in _known if image() is picture), None)
    if known is None:
        known = background_of(picture, axes)
        known = known & surrounds(known)
        if not picture.flags.writeable:
            _known[:] = [(weakref.ref(picture), known), *_known][:_KEPT]
    return known


def surrounds(dark: npt.NDArray[np.bool_]) -> bool:
    """Return whether dark pixels surround something; in a photograph they may be a shadow.

    Parameters
    ----------
    dark : ndarray of bool, shape ([D,] H, W)
        From `background_of`.
    """
    edge = np.concatenate(
        [dark.take(end, axis).ravel() for axis in range(dark.ndim) for end in (0, -1)]
    )
    return bool(edge.mean() >= _AROUND)


def void_threshold(picture: npt.NDArray[Any]) -> float | None:
    """Guess the intensity below which there is no tissue.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W)

    Returns
    -------
    float or None
        None if no dark pixels surround anything.
    """
    dark, known = background_of(picture, picture.ndim), np.isfinite(picture)
    air, inside = picture[dark & known], picture[~dark & known]
    if not (surrounds(dark) and air.size and inside.size):
        return None
    # Just above nearly all values of air, so that dark places inside, such as fluid, stay tissue.
    darkest, usual = float(np.percentile(air, 99)), float(np.median(inside))
    return float(f"{darkest + _ABOVE * (usual - darkest):.4g}")


def air_that_is_tissue(picture: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> str:
    """Return a clause if most of the dark surroundings of a picture count as tissue, or "".

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
