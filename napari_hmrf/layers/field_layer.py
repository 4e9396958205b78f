"""A displacement field as a layer: a few of its arrows are drawn, and the layer holds all of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from napari.utils.notifications import show_info

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.moved_points import looked_up
from napari_hmrf.layers.label_colours import OBSERVED
from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.result_layers import ARROWS, Answer, LayerData
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.solver.problem import grid_in_words

Array = npt.NDArray[Any]
#: How far beyond the middle of its outermost pixels a field reaches, in pixels.
_REACH = 0.5 + 1e-3


class FieldOnSlice(NamedTuple):
    """A field on the pixels of a slice.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2), float32
        In the slice's unit; 0 where it is not known.
    known : ndarray of bool, shape (H, W)
        Where the field reaches.
    out : float
        How far it leads out of the slice at most, which the displacement does not say.
    """

    displacement: npt.NDArray[np.float32]
    known: npt.NDArray[np.bool_]
    out: float


class LayerField(NamedTuple):
    """The field that a layer holds, where the layer lies.

    Attributes
    ----------
    displacement : ndarray, shape (..., D)
        Material; in the pixels of the layer, along all of its axes.
    frame : Frame
        Of the layer, at its first site.
    """

    displacement: Array
    frame: Frame

    def on(self, frame: Frame, shape: tuple[int, int]) -> FieldOnSlice:
        """Look the field up at the pixels of a slice, wherever these lie.

        Where the world of either has no unit of length, pixels are taken for pixels.

        Raises
        ------
        ProblemError
            If the field reaches no pixel of the slice, or pixels cannot be taken for pixels.
        """
        own, more = self.displacement.shape[:-1], self.frame.ndim - frame.ndim
        if min(frame.plane) + more < 0 or max((1, *own[: max(more, 0)])) > 1:
            raise ProblemError(
                "observed",
                f"is {grid_in_words(own)}, and the image is no slice of that. Give both the same "
                "axes.",
            )
        to, back = self.frame.from_pixels_of(frame), frame.from_pixels_of(self.frame)
        if to is None or back is None:
            return self._by_pixels(frame, shape)
        sites = np.zeros((*shape, frame.ndim)) + frame.index
        sites[..., list(frame.plane)] = np.moveaxis(np.indices(shape), 0, -1)
        at = sites.reshape(-1, frame.ndim) @ to[:, :-1].T + to[:, -1] - self.frame.index
        known = ((at > -_REACH) & (at < np.array(own) - 1 + _REACH)).all(axis=1)
        if not known.any():
            raise ProblemError("observed", "lies elsewhere than the image. Give both one place.")
        steps = np.zeros((len(at), frame.ndim))
        steps[known] = looked_up(self.displacement, at[known]) @ back[:, :-1].T
        sizes = np.linalg.norm(np.array(frame.matrix)[:-1, :-1], axis=0)
        out = np.abs(steps * sizes)[:, list(frame.others)].max(initial=0.0)
        d = (steps[:, list(frame.plane)] * frame.spacing).reshape(*shape, 2)
        return FieldOnSlice(d.astype(np.float32), known.reshape(shape), float(out))

    def _by_pixels(self, frame: Frame, shape: tuple[int, int]) -> FieldOnSlice:
        own = self.displacement.shape[:-1]
        if tuple(own) not in (shape, (1, *shape)):
            raise ProblemError(
                "observed",
                f"is {grid_in_words(own)} in {self.frame.unit}, but the image "
                f"{grid_in_words(shape)} in {frame.unit}. Give the image its place in units of "
                "length, or take a field on its pixels.",
            )
        d = self.displacement[..., -2:].reshape(*shape, 2) * frame.spacing
        return FieldOnSlice(d.astype(np.float32), np.ones(shape, bool), 0.0)


def holds_field(layer: Any) -> bool:
    """Whether a layer holds a field: one that was opened, or a result."""
    known = {} if layer is None else known_of(layer)
    answer = isinstance(known.get("answer"), Answer) and known.get("kind") == "arrows"
    return answer or "field" in known


def field_of(layer: Any) -> LayerField | None:
    """The field that a layer holds; None if it holds none."""
    if not holds_field(layer):
        return None
    known, frame = known_of(layer), frame_of(layer)
    if "field" in known:
        return LayerField(known["field"], frame)
    answer: Answer = known["answer"]
    d = answer.solution.displacement / answer.solution.spacing
    index = answer.frame.index
    return LayerField(on_all_axes(d, answer.frame), replace(frame, index=index))


def on_all_axes(pixels: Array, frame: Frame) -> Array:
    """A field of a slice, (H, W, 2) in its pixels, on all the axes of the layer it lies in."""
    placed = np.zeros((*pixels.shape[:2], frame.ndim))
    placed[..., list(frame.plane)] = pixels
    return frame.put_image(placed)


def field_layer(
    pixels: Array, place: Mapping[str, Any], name: str, role: str | None = None
) -> LayerData:
    """Have a layer hold a field, and draw some of its arrows.

    Parameters
    ----------
    pixels : ndarray, shape (..., D)
        Material displacement in pixels, along all axes.
    place : mapping
        Where the first pixel and the others lie, as a new layer takes it.
    name : str
    role : str, optional
        What the layer is for.
    """
    shape = pixels.shape[:-1]
    step = max(1, round((shape[-2] * shape[-1] / ARROWS) ** 0.5))
    steps = (*(1 for _ in shape[:-2]), step, step)
    lines = [
        np.arange(min(every // 2, size - 1), size, every)
        for every, size in zip(steps, shape, strict=True)
    ]
    starts = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(shape))
    arrows = np.stack([starts, pixels[tuple(starts.T)]], axis=1).astype(np.float32)
    known = {"field": pixels, **({} if role is None else {"role": role})}
    look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": step / 8}
    return LayerData(
        arrows, {**look, **place, "name": name, "metadata": {METADATA: known}}, "vectors"
    )


def saved_field(name: str, residual: float | None, tell: bool = False) -> str:
    """Which way a field that was written leads, and how good an inverse it is; perhaps tell it."""
    said = f"Saved {name}: it says where tissue goes, which moves points."
    if residual is not None:
        worst = f"{residual:.2g} px at the worst site"
        said = f"Saved {name}: it moves images, and is an inverse to {worst}."
    if tell:
        show_info(said)
    return said
