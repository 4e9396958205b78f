"""Layer that shows the tissue without counterpart in the second image, for the user to correct."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.result_layers import LayerData, layer_on

#: Kind of the layer in its metadata; layers with a kind are not offered as tissue.
MISSING: Literal["missing"] = "missing"


def missing_layer(missing: npt.NDArray[np.bool_], frame: Frame, image: str) -> LayerData:
    """Return the data of a Labels layer: 1 at tissue without counterpart.

    Parameters
    ----------
    missing : ndarray of bool, shape ([D,] H, W)
    frame : Frame
        Place of the study.
    image : str
        Name of the image.
    """
    known = {"kind": MISSING, "source": image, "slice": frame.slice_name}
    pixels, name = missing.astype(np.uint8), f"{image} without counterpart"
    return layer_on(frame, pixels, name, known, {"opacity": 0.5}, "labels")


def missing_layer_of(layers: Iterable[Any], frame: Frame, image: str) -> Any:
    """Return the layer with the tissue without counterpart of an image and a slice, or None."""
    wanted = {"kind": MISSING, "source": image, "slice": frame.slice_name}
    for layer in layers:
        if wanted.items() <= dict(metadata_of(layer)).items():
            return layer
    return None


def missing_in(layer: Any, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Return the mask that a layer shows, shape ([D,] H, W)."""
    return np.asarray(np.asarray(layer.data).reshape(shape) != 0)
