"""What lies on the same tissue as a result, moved with it: images, labels, points and shapes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Image, Labels, Points, Shapes

from napari_hmrf.field.other_grid import OtherGrid
from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.result_layers import Answer, LayerData
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.study.layer_names import full_resolution, naming

Array = npt.NDArray[Any]
#: What the metadata of a layer say that was moved.
MOVED = "moved"
#: Pieces of a side of a rectangle, and of an ellipse, which are bent.
_PIECES, _ROUND = 8, 64


def can_move(layer: Any) -> bool:
    """Whether a layer can be moved with a result, and is not itself made of one."""
    return isinstance(layer, Image | Labels | Points | Shapes) and "kind" not in known_of(layer)


def mover(layer: Any, answer: Answer) -> Callable[[], LayerData]:
    """Get ready to move a layer with a result: what is returned does, on any thread.

    The layer may have other pixels than the result, and more axes, as of `OtherGrid.of`. Labels get
    no new values.

    Raises
    ------
    LayerError
        As of `OtherGrid.of`.
    """
    with naming(observed=layer):
        grid = OtherGrid.of(answer.solution, answer.frame, frame_of(layer))
    data, attributes, kind = layer.as_layer_data_tuple()
    known = {key: value for key, value in known_of(layer).items() if key != "role"}
    attributes["metadata"] = {METADATA: {**known, "kind": MOVED}}
    attributes["name"], attributes["visible"] = f"{layer.name}, moved", True
    if kind in ("image", "labels"):
        attributes["multiscale"], order = False, 0 if kind == "labels" else 1
        pixels = full_resolution(layer)
        return lambda: LayerData(grid.moved_pixels(pixels, order=order), attributes, kind)
    if kind == "points":
        return lambda: LayerData(grid.moved_points(data), attributes, kind)
    bent = [_bent(corners, each) for corners, each in zip(data, layer.shape_type, strict=True)]
    attributes["shape_type"] = [each for _, each in bent]
    return lambda: LayerData([grid.moved_points(each) for each, _ in bent], attributes, kind)


def _bent(corners: Array, kind: str) -> tuple[Array, str]:
    """A shape as one that can be bent: of rectangles and ellipses, a polygon."""
    if kind == "rectangle":
        part = np.linspace(0, 1, _PIECES, endpoint=False)[:, None]
        ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        return np.concatenate([begin + part * (end - begin) for begin, end in ends]), "polygon"
    if kind == "ellipse":
        angles = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)[:, None]
        along, across = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
        middle = corners.mean(axis=0)
        return middle + np.cos(angles) * along + np.sin(angles) * across, "polygon"
    return corners, kind
