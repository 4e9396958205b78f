"""Axes of a .tif image, which napari opens as axes of space with pixels of size 1."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.io.images import TIFF, axes_of_tiff


class StoredAxes(NamedTuple):
    """Axes of the file of a layer.

    Attributes
    ----------
    contents : tuple of str
        Content of each axis of the layer, such as "channels" or "times"; "" for axes of space.
    sizes : tuple of float
        Size of a pixel along each axis; empty if the file states none, or the layer has a scale or
        a unit.
    unit : str
        Unit of `sizes`.
    """

    contents: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    unit: str = "pixel"


def stored_axes(layer: Any) -> StoredAxes:
    """Return the axes of the .tif file of a layer; those of other layers are empty."""
    path = layer.source.path
    if not path or not path.lower().endswith(TIFF) or not os.path.isfile(path):
        return StoredAxes()
    stored = _read(path, os.stat(path).st_mtime_ns)
    if len(stored.contents) != layer.ndim:
        return StoredAxes()
    is_plain = np.all(layer.scale == 1) and all(str(unit) == "pixel" for unit in layer.units)
    return stored if is_plain else stored._replace(sizes=())


@lru_cache(maxsize=16)
def _read(path: str, _time: int) -> StoredAxes:
    try:
        return StoredAxes(*axes_of_tiff(path))
    except Exception:  # noqa: BLE001 - the file may have been replaced by any other
        return StoredAxes()
