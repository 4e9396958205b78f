"""A displacement field as a layer: a few of its arrows are drawn, and the layer holds all of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.observation import PixelField
from napari_hmrf.layers.label_colours import OBSERVED
from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.result_layers import ARROWS, LayerData
from napari_hmrf.layers.result_lookup import result_of
from napari_hmrf.layers.slice_view import frame_of


def holds_field(layer: Any) -> bool:
    """Whether a layer holds a field: one that was opened, or a result."""
    return layer is not None and ("field" in known_of(layer) or result_of(layer) is not None)


def field_of(layer: Any) -> PixelField | None:
    """The field that a layer holds; None if it holds none."""
    if not holds_field(layer):
        return None
    answer, frame = result_of(layer), frame_of(layer)
    if answer is None:
        return PixelField(known_of(layer)["field"], frame)
    pixels = answer.frame.put_field(answer.solution.displacement / answer.solution.spacing)
    return PixelField(DisplacementField.in_pixels(pixels), replace(frame, index=answer.frame.index))


def field_layer(
    field: DisplacementField, place: Mapping[str, Any], name: str, role: str | None = None
) -> LayerData:
    """Have a layer hold a field, and draw some of its arrows.

    Parameters
    ----------
    field : DisplacementField
        In pixels, along all axes.
    place : mapping
        Where the first pixel and the others lie, as a new layer takes it.
    name : str
    role : str, optional
        What the layer is for.
    """
    shape = field.shape
    step = max(1, round((shape[-2] * shape[-1] / ARROWS) ** 0.5))
    lines = [slice(size) for size in shape[:-2]]
    lines += [slice(min(step // 2, size - 1), size, step) for size in shape[-2:]]
    starts = np.mgrid[tuple(lines)].reshape(len(shape), -1).T
    arrows = np.stack([starts, field.at(starts.astype(float))], axis=1).astype(np.float32)
    known = {"field": field, **({} if role is None else {"role": role})}
    look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": step / 8}
    return LayerData(
        arrows, {**look, **place, "name": name, "metadata": {METADATA: known}}, "vectors"
    )
