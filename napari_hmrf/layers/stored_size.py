"""Size of the pixels of a .tif image, which napari reads as pixels of size 1."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import numpy as np

from napari_hmrf.io.images import TIFF, pixel_size_of


def stored_size(layer: Any) -> tuple[tuple[float, ...], str]:
    """Return the size of a pixel in the file of a layer, if the layer lacks it, and its unit.

    Returns
    -------
    sizes : tuple of float
        Size along each axis of the layer; empty if the file states none, or the layer has a scale
        or a unit.
    unit : str
    """
    path = layer.source.path
    is_plain = np.all(layer.scale == 1) and all(str(unit) == "pixel" for unit in layer.units)
    if not path or not is_plain or not path.lower().endswith(TIFF) or not os.path.isfile(path):
        return (), "pixel"
    sizes, unit = _read(path, os.stat(path).st_mtime_ns)
    return (sizes, unit) if len(sizes) == layer.ndim else ((), "pixel")


@lru_cache(maxsize=16)
def _read(path: str, _time: int) -> tuple[tuple[float, ...], str]:
    try:
        return pixel_size_of(path)
    except Exception:  # noqa: BLE001 - the file may have been replaced by any other
        return (), "pixel"
