"""A solution becomes layers: the image, moved, and arrows, which hold the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.deformation import arrows_apart, smallest_determinant
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.resample import emptiness, resample
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.layers.label_colours import ARROWS as ARROW_COLOUR
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.solver.model_names import in_words, model_name
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.study import Pictures

Array = npt.NDArray[Any]
#: What is known of something, or how it looks, by name.
Facts = Mapping[str, Any]
#: The layers that are made of each result.
Kind = Literal["image", "arrows"]

#: Arrows enough to see the motion, few enough to see the image and each of them.
ARROWS = 250


class LayerData(NamedTuple):
    """A layer before it is one, as napari's readers and samples give it."""

    data: Any
    attributes: dict[str, Any]
    kind: str


@dataclass(frozen=True, eq=False)
class Answer:
    """A solution, where it lies, and what moves with it: what a layer of arrows holds.

    Attributes
    ----------
    solution : Solution
        With its frame.
    frame : Frame
        Where it lies.
    facts : mapping
        What all its layers know.
    pictures : Pictures
        What moves with it, but for the image; nothing, of a result from a file.
    problem : Problem, optional
        What was solved; not known of a result from a file.
    """

    solution: Solution
    frame: Frame
    facts: Facts
    pictures: Pictures = field(default_factory=Pictures)
    problem: Problem | None = None

    @property
    def unit(self) -> str:
        """The unit of its lengths, as tables show it: "px", "mm"."""
        return unit_symbol(self.frame.unit)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.solution.tissue.shape
        return int(rows), int(cols)

    @property
    def source(self) -> str:
        """The name that the deformed image's layer had; empty for a result from a file."""
        return self.pictures.name

    def pixels(
        self,
        kind: str,
        pixels: Array,
        what: str,
        look: Facts,
        sort: str = "image",
        source: str = "",
    ) -> LayerData:
        """Pixels as a layer that lies where the tissue does.

        Parameters
        ----------
        kind : str
            Of the layer, in its metadata.
        pixels : ndarray, shape (H, W)
        what : str
            What the layer shows; it is named after that and its source.
        look : mapping
            How it is drawn, as a new layer takes it.
        sort : {"image", "labels"}
        source : str
            By default what was deformed.
        """
        name = self._name(what, source or self.source)
        return pixel_layer(self.frame, pixels, name, {"kind": kind, **self.facts}, look, sort)

    def vectors(self, kind: str, segments: Array, what: str, look: Facts) -> LayerData:
        """Segments, (N, 2, 2) in pixels, as a layer; the other parameters are as of `pixels`."""
        known = {"kind": kind, **self.facts, "solution": self.solution}
        name = self._name(what, self.source)
        return vector_layer(self.frame, segments, name, known, {**look, "length": 1.0})

    def _name(self, what: str, source: str) -> str:
        parameters = self.solution.provenance.parameters
        return _result_name(source, what, parameters, self.frame.slice_seen)


@dataclass(frozen=True, eq=False)
class Outputs:
    """The layers of a result, and what there is to say of it.

    Attributes
    ----------
    solution : Solution
        With its frame.
    layers : dict of kind to LayerData
        In stacking order.
    folds : int
        Sites at which the tissue folds over itself (Jacobian determinant <= 0).
    overlaps : int
        Pixels at which one part of the tissue has moved onto another; only counted where there
        are pictures.
    worst : (int, int), optional
        Row and column of the worst of them.
    """

    solution: Solution
    layers: dict[Kind, LayerData]
    folds: int
    overlaps: int = 0
    worst: tuple[int, int] | None = None


def result_layers(
    solution: Solution,
    frame: Frame | None = None,
    pictures: Pictures | None = None,
    checkpoint: Callable[[], None] = lambda: None,
    problem: Problem | None = None,
) -> Outputs:
    """Turn a solution into layer data; the one way to do so. Needs neither window nor layer.

    Parameters
    ----------
    solution : Solution
    frame : Frame, optional
        Where it lies; by default as its `frame` says, or at the origin.
    pictures : Pictures, optional
        What to deform with it.
    checkpoint : callable
        Called between the parts; raises to stop the work.
    problem : Problem, optional
        What was solved.

    Returns
    -------
    Outputs

    Raises
    ------
    ValueError
        If the solution's frame is not one that layers have.
    """
    frame = Frame.of_solution(solution) if frame is None else frame
    solution = replace(solution, frame={**(solution.frame or {}), **frame.as_dict()})
    field = (solution.displacement, solution.spacing, solution.tissue)
    checkpoint()
    smallest = smallest_determinant(*field)
    folds, worst = int((smallest <= 0).sum()), None
    if folds:
        row, col = np.unravel_index(int(np.nanargmin(smallest)), smallest.shape)
        worst = (int(row), int(col))
    shown = pictures or Pictures()
    facts = {
        **_whence(frame, shown),
        "model": in_words(solution.provenance.parameters),
        "folds": folds,
        "provenance": asdict(solution.provenance),
    }
    if shown.level is not None:
        facts["level"] = shown.level
    layers: dict[Kind, LayerData] = {}
    overlaps = 0
    if pictures is not None:  # a file that is opened need not wait for the compiler of the loops
        checkpoint()
        origin, covered, twice = inverse_map_and_overlaps(*field)
        overlaps = facts["overlaps"] = int(twice.sum())
        if (image := pictures.image) is not None:
            checkpoint()
            moved = resample(image, origin, covered, order=1, fill=emptiness(image))
            parameters = solution.provenance.parameters
            layers["image"] = picture_layer(frame, pictures, moved, parameters, facts)
    checkpoint()
    kept = replace(shown, image=None, look={})
    layers["arrows"] = _arrow_layer(Answer(solution, frame, facts, kept, problem))
    return Outputs(solution, layers, folds, overlaps, worst)


def _arrow_layer(answer: Answer) -> LayerData:
    """Where the tissue goes; the layer holds the answer, in memory only."""
    solution = answer.solution
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    found = arrows_apart(d, spacing=spacing, tissue=tissue, about=ARROWS)
    width = max(1.0, math.sqrt(tissue.sum() / ARROWS)) / 8
    look = {"vector_style": "arrow", "edge_color": ARROW_COLOUR, "edge_width": width}
    made = answer.vectors("arrows", found, "arrows", look)
    made.attributes["metadata"][METADATA]["answer"] = answer
    return made


def picture_layer(
    frame: Frame,
    pictures: Pictures,
    picture: Array,
    parameters: Facts,
    facts: Facts | None = None,
) -> LayerData:
    """An image as it is while its tissue is on its way.

    Parameters
    ----------
    frame : Frame
    pictures : Pictures
        Which image it is, and how that is drawn.
    picture : ndarray, shape (H, W) or (H, W, 3 or 4)
        As it has moved.
    parameters : mapping
        Of the solution's provenance.
    facts : mapping, optional
        What the layer is to know of its result; by default where it comes from.
    """
    known = {**(facts or _whence(frame, pictures)), "kind": "image"}
    name = _result_name(pictures.name, "deformed", parameters, frame.slice_seen)
    return pixel_layer(frame, picture, name, known, pictures.look)


def pixel_layer(
    frame: Frame, pixels: Array, name: str, known: Facts, look: Facts, sort: str = "image"
) -> LayerData:
    """Pixels of a slice as a layer that lies there, with what it is to know of itself.

    Parameters
    ----------
    frame : Frame
    pixels : ndarray, shape (H, W) or (H, W, 3 or 4)
    name : str
    known : mapping
        For its metadata.
    look : mapping
        How it is drawn, as a new layer takes it.
    sort : {"image", "labels"}
    """
    attributes = {**look, **frame.placement(image=True), "name": name}
    attributes["metadata"] = {METADATA: dict(known)}
    if sort == "image":
        attributes["rgb"] = pixels.ndim == 3
    return LayerData(frame.put_image(pixels), attributes, sort)


def vector_layer(frame: Frame, segments: Array, name: str, known: Facts, look: Facts) -> LayerData:
    """Segments, (N, 2, 2) in pixels of a slice, as a layer; as of `pixel_layer`."""
    attributes = {**look, **frame.placement(), "name": name, "opacity": 1.0}
    attributes["metadata"] = {METADATA: dict(known)}
    return LayerData(frame.put_vectors(segments), attributes, "vectors")


def _whence(frame: Frame, pictures: Pictures) -> dict[str, Any]:
    """Of what a result was made."""
    return {
        "source": pictures.name,
        "slice": frame.slice_name,
        "slice_seen": frame.slice_seen,
        "unit": frame.unit,
    }


def _result_name(source: str, what: str, parameters: Facts, where: str) -> str:
    """Name a layer after the image it was made of, what it shows, the model and the slice."""
    # The paper's prior and schedule need no word.
    model = model_name(parameters).removeprefix("paper").removeprefix(", ")
    name = f"{source} {what}".strip() + (f", {model}" if model else "")
    return name + (f" ({where})" if where else "")
