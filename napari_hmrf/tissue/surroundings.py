"""Detection of the dark surroundings of an image, such as air."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.brightness import thinned, without_padding
from napari_hmrf.notes import Note
from napari_hmrf.tissue.normals import outside_of

# Smallest difference between the means of two kinds of dark surroundings, relative to the contrast
# between bright pixels and air.
_APART = 0.35
# Smallest fraction of the surroundings that each kind must cover.
_PART = 0.02
# Number of images for which the result is cached.
_KEPT = 4
_known: list[tuple[weakref.ref[Any], npt.NDArray[np.bool_]]] = []
# Smallest fraction of the image's edge that dark surroundings must cover.
_AROUND = 0.75
# Largest number of samples along each axis, with which the outline of a volume is found in 50 ms.
_SAMPLES = 64
# Position of the void threshold between the intensity of air (0) and the median of tissue (1).
_ABOVE = 0.01


def background_of(picture: npt.NDArray[Any], axes: int = 2) -> npt.NDArray[np.bool_]:
    """Return a mask of the dark surroundings of an image.

    Otsu's threshold separates dark pixels from bright pixels. Dark pixels that are connected to the
    edge of the image are surroundings; other dark pixels are tissue. If the surroundings clearly
    consist of two kinds, such as air and fat in CT, the mask contains only the darker kind. Padding
    of a CT image counts as air; see `without_padding`.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
        Grey or colour image.
    axes : int
        Number of axes without channels: 2, or 3 for a volume.

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        Mask of the surroundings; all False if the image is constant.
    """
    return _separated(picture, axes)[0]


def surface_value(volume: npt.NDArray[Any]) -> float | None:
    """Return an intensity between the dark surroundings of a grey volume and its tissue.

    A surface of this intensity is the outline of the tissue. Large volumes are sampled.

    Parameters
    ----------
    volume : ndarray, shape (D, H, W)

    Returns
    -------
    float or None
        None if no dark surroundings cover most of the edge of the volume.
    """
    dark, threshold = _separated(thinned(volume, _SAMPLES), 3)
    return threshold if surrounds(dark) else None


def _separated(picture: npt.NDArray[Any], axes: int) -> tuple[npt.NDArray[np.bool_], float]:
    """Return the mask of `background_of`, and the largest intensity of its pixels."""
    from skimage.filters import threshold_otsu  # heavy: skimage

    grey = picture[..., :3].mean(axis=-1) if picture.ndim > axes else without_padding(picture)
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool), 0.0
    threshold = threshold_otsu(values)
    surroundings = outside_of(grey > threshold)  # NaN counts as dark
    around = grey[surroundings & np.isfinite(grey)].astype(np.float64)
    if around.size and around.min() < around.max():
        below = threshold_otsu(around)
        air, rest = around[around <= below], around[around > below]
        bright = values[values > threshold]
        differ = rest.mean() - air.mean() > _APART * (bright.mean() - air.mean())
        if differ and min(len(air), len(rest)) > _PART * len(around):
            surroundings, threshold = outside_of(grey > below), below
    return surroundings, float(threshold)


def dark_border(picture: npt.NDArray[Any], axes: int = 2) -> npt.NDArray[np.bool_]:
    """Return a mask of dark surroundings that cover most of the image's edge.

    The mask is all False if the dark surroundings cover less of the edge. The result is cached for
    read-only images.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
        Grey or colour image.
    axes : int
        Number of axes without channels: 2, or 3 for a volume.

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
    """
    known = next((mask for image, mask in _known if image() is picture), None)
    if known is None:
        known = background_of(picture, axes)
        known = known & surrounds(known)
        if not picture.flags.writeable:
            _known[:] = [(weakref.ref(picture), known), *_known][:_KEPT]
    return known


def surrounds(dark: npt.NDArray[np.bool_]) -> bool:
    """Return whether dark pixels cover most of the image's edge.

    Otherwise the dark pixels may be a part of the object, such as a shadow in a photograph.

    Parameters
    ----------
    dark : ndarray of bool, shape ([D,] H, W)
        Mask from `background_of`.
    """
    edge = np.concatenate(
        [dark.take(end, axis).ravel() for axis in range(dark.ndim) for end in (0, -1)]
    )
    return bool(edge.mean() >= _AROUND)


def void_threshold(picture: npt.NDArray[Any]) -> float | None:
    """Estimate the intensity below which there is no tissue.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W)

    Returns
    -------
    float or None
        Threshold, or None if the image does not have dark surroundings.
    """
    dark, known = background_of(picture, picture.ndim), np.isfinite(picture)
    air, inside = picture[dark & known], picture[~dark & known]
    if not (surrounds(dark) and air.size and inside.size):
        return None
    # The threshold is just above nearly all values of air, so dark tissue remains tissue.
    darkest, usual = float(np.percentile(air, 99)), float(np.median(inside))
    return float(f"{darkest + _ABOVE * (usual - darkest):.4g}")


def air_that_is_tissue(picture: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> str:
    """Return a warning if most of an image's dark surroundings are marked as tissue, else "".

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    tissue : ndarray of bool, shape ([D,] H, W)

    Returns
    -------
    str
    """
    dark = dark_border(picture, tissue.ndim)
    if not dark.any() or 2 * np.count_nonzero(dark & tissue) < np.count_nonzero(dark):
        return ""
    return Note(
        "the dark surroundings of the image move like tissue: if they are air, exclude them from "
        "the tissue (`without_border=True`)",
        short="dark surroundings move like tissue",
    )
