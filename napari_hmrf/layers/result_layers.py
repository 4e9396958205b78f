"""A solution becomes layers: the image, moved, and arrows, which hold the result.

Over the image lies one thing at a time, such as the strain as colours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.animation import (
    MARKS,
    Mark,
    Motion,
    fullest_planes,
    marked_sites,
    moved_grid,
    moved_marks,
)
from napari_hmrf.field.colormaps import beyond, reach_of
from napari_hmrf.field.comparison import Comparison
from napari_hmrf.field.deformation import (
    arrows_apart,
    arrows_in_slices,
    pixels_between,
    smallest_determinant,
    spread,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.held_forces import HeldForce
from napari_hmrf.field.quantities import QUANTITIES, Coloured, Quantity, coloured, title_and_unit
from napari_hmrf.field.resample import emptiness, resample
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.layers import label_colours
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
#: What there is to lie over the image.
Name = (
    Quantity | Mark | Literal["grid", "labels", "difference", "stiffness", "observed", "confidence"]
)
#: Arrows of what is given that fit beside each other across the image.
_ACROSS = 40


class LayerData(NamedTuple):
    """A layer before it is one, as napari's readers and samples give it."""

    data: Any
    attributes: dict[str, Any]
    kind: str


#: What it takes to hold and to move each part of a result, computed when it is asked for.
Forces = Callable[[], tuple[HeldForce, ...]]


@dataclass(frozen=True, eq=False)
class Answer:
    """A solution, where it lies, and what moves with it: what a layer of arrows holds.

    Attributes
    ----------
    solution : Solution
        With its frame.
    frame : Frame
        Where it lies.
    pictures : Pictures
        What moves with it, but for the image, of which there is the name; nothing, of a result
        from a file.
    problem : Problem, optional
        What was solved; not known of a result from a file.
    forces : callable, optional
        Returns what it takes to hold and to move its parts; not known of a result from a file.
    """

    solution: Solution
    frame: Frame
    pictures: Pictures = field(default_factory=Pictures)
    problem: Problem | None = None
    forces: Forces | None = None

    @property
    def unit(self) -> str:
        """The unit of its lengths, as tables show it: "px", "mm"."""
        return unit_symbol(self.frame.unit)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns, of a volume planes before these."""
        shape: tuple[int, ...] = self.solution.tissue.shape
        return shape

    def layer(
        self, kind: str, data: Array, what: str, look: Facts, sort: str = "image", source: str = ""
    ) -> LayerData:
        """Something of the result as a layer that lies where its tissue does.

        Parameters
        ----------
        kind : str
            Of the layer, in its metadata.
        data, look, sort
            As of `layer_on`.
        what : str
            What the layer shows; it is named after that and its source.
        source : str
            By default what was deformed.
        """
        provenance = self.solution.provenance
        known = {
            **_whence(self.frame, self.pictures),
            "kind": kind,
            "model": in_words(provenance.parameters),
            "provenance": asdict(provenance),
        }
        if sort == "vectors":
            known["solution"] = self.solution
            look = {**look, "length": 1.0, "opacity": 1.0}
        where = self.frame.slice_seen
        name = _result_name(source or self.pictures.name, what, provenance.parameters, where)
        return layer_on(self.frame, data, name, known, look, sort)


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
    fullest : dict of mark to tuple of int
        Of folds and of overlaps, the plane with most of them, across each axis.
    """

    solution: Solution
    layers: dict[Kind, LayerData]
    folds: int
    overlaps: int = 0
    fullest: Mapping[Mark, tuple[int, ...]] = field(default_factory=dict)


def result_layers(
    solution: Solution,
    frame: Frame | None = None,
    pictures: Pictures | None = None,
    checkpoint: Callable[[], None] = lambda: None,
    problem: Problem | None = None,
    forces: Forces | None = None,
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
    problem, forces
        As `Answer` has them.

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
    folded = smallest_determinant(*field) <= 0
    fullest: dict[Mark, tuple[int, ...]] = {"folds": fullest_planes(moved_marks(solution, folded))}
    shown = pictures or Pictures()
    digests = solution.provenance.inputs
    for name in digests:
        checkpoint()
        digests[name]  # made when it is looked at first
    answer = Answer(solution, frame, replace(shown, image=None, look={}), problem, forces)
    layers: dict[Kind, LayerData] = {}
    overlaps = 0
    if pictures is not None:  # a file that is opened need not wait for the compiler of the loops
        checkpoint()
        origin, covered, twice = inverse_map_and_overlaps(*field)
        overlaps, fullest["overlaps"] = int(twice.sum()), fullest_planes(twice)
        if (image := pictures.image) is not None:
            checkpoint()
            fill = emptiness(image, solution.tissue.ndim)
            moved = resample(image, origin, covered, order=1, fill=fill)
            layers["image"] = answer.layer("image", moved, "deformed", pictures.look)
    checkpoint()
    layers["arrows"] = _arrow_layer(answer)
    return Outputs(solution, layers, int(folded.sum()), overlaps, fullest)


def _arrow_layer(answer: Answer) -> LayerData:
    """Where the tissue goes; the layer holds the answer, in memory only."""
    solution = answer.solution
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    picked = arrows_apart if tissue.ndim == 2 else arrows_in_slices
    found = picked(d, spacing=spacing, tissue=tissue, about=ARROWS)
    fullest = tissue.sum(axis=(-2, -1)).max()
    width = max(1.0, math.sqrt(fullest / ARROWS)) / 8
    look = {"vector_style": "arrow", "edge_color": label_colours.ARROWS, "edge_width": width}
    made = answer.layer("arrows", found, "arrows", look, "vectors")
    made.attributes["metadata"][METADATA]["answer"] = answer
    return made


def picture_layer(frame: Frame, pictures: Pictures, picture: Array, parameters: Facts) -> LayerData:
    """An image as it is while its tissue is on its way.

    Parameters
    ----------
    frame : Frame
    pictures : Pictures
        Which image it is, and how that is drawn.
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
        As it has moved.
    parameters : mapping
        Of the solution's provenance.
    """
    known = {**_whence(frame, pictures), "kind": "image"}
    name = _result_name(pictures.name, "deformed", parameters, frame.slice_seen)
    return layer_on(frame, picture, name, known, pictures.look)


def layer_on(
    frame: Frame, data: Array, name: str, known: Facts, look: Facts, sort: str = "image"
) -> LayerData:
    """What lies on the pixels of a slice as a layer, with what it is to know of itself.

    Parameters
    ----------
    frame : Frame
    data : ndarray
        Pixels, shape ([D,] H, W) or ([D,] H, W, 3 or 4); or segments in pixels, (N, 2, n).
    name : str
    known : mapping
        For its metadata.
    look : mapping
        How it is drawn, as a new layer takes it.
    sort : {"image", "labels", "vectors"}
    """
    lines = sort == "vectors"
    attributes = {**look, **frame.placement(image=not lines), "name": name}
    attributes["metadata"] = {METADATA: dict(known)}
    if sort == "image":
        attributes["rgb"] = data.ndim > len(frame.plane)
    placed = frame.put_vectors(data) if lines else frame.put_image(data)
    return LayerData(placed, attributes, sort)


def _whence(frame: Frame, pictures: Pictures) -> dict[str, Any]:
    """Of what a result was made."""
    return {"source": pictures.name, "slice": frame.slice_name, "unit": frame.unit}


def _result_name(source: str, what: str, parameters: Facts, where: str) -> str:
    """Name a layer after the image it was made of, what it shows, the model and the slice."""
    name = ", ".join(filter(None, (f"{source} {what}".strip(), model_name(parameters))))
    return name + (f" ({where})" if where else "")


class Overlay(NamedTuple):
    """What lies over the image of a result.

    Attributes
    ----------
    name : Name
    layer : LayerData
        When all of the deformation is seen.
    picture : ndarray, shape ([D,] H, W), optional
        Its pixels before they move with the tissue, of bool where these are sites that are marked;
        None if they do not, or if it is of lines.
    """

    name: Name
    layer: LayerData
    picture: Array | None = None

    @property
    def beyond(self) -> str:
        """How far its values go beyond the colours, in words; "" if they do not."""
        limits = self.layer.attributes.get("contrast_limits")
        return "" if limits is None or self.picture is None else beyond(self.picture, limits)


def overlay_of(answer: Answer, name: Name, compared: Comparison | None = None) -> Overlay | None:
    """Make what is to lie over the image of a result; on the compute thread only.

    All moves with the tissue, the difference to what it was `compared` with, too. Arrows of the
    motion that was given begin where tissue was, as their name says.

    What has two directions is drawn from purple (less) to orange (more), the rest from dark to
    light, and where hardly anything happens the image is seen. Folds are yellow, which is the
    colour of whatever is at the lower limit.

    Returns
    -------
    Overlay or None
        None if the result has nothing of that name: no folds, no overlaps, no labels, no reference,
        or no problem.
    """
    if name == "grid":
        look = {"vector_style": "line", "edge_color": "cyan", "edge_width": max(answer.shape) / 500}
        grid = moved_grid(answer.solution)
        return Overlay(name, answer.layer(name, grid, name, look, "vectors"))
    if name == "observed":
        made = _motion_layer(answer)
        return None if made is None else Overlay(name, made)
    if (pixels := _pixels_of(answer, name, compared)) is None:
        return None
    picture, *shown = pixels
    moved = np.asarray(Motion(answer.solution, overlay=picture).at(1).overlay)
    return Overlay(name, answer.layer(name, moved, *shown), picture)


def _pixels_of(answer: Answer, name: Name, compared: Comparison | None) -> tuple[Any, ...] | None:
    """Pixels before they move, and what else `Answer.layer` takes; None if there are none."""
    pictures, problem = answer.pictures, answer.problem
    if name in QUANTITIES:
        title, unit = title_and_unit(name, answer.solution)
        shown = coloured(answer.solution, name)
        return shown.values, f"{title} ({unit or answer.unit})", _colours(shown)
    if name in MARKS:
        sites = marked_sites(answer.solution, name)
        return (sites, name, label_colours.mark_look(), "labels") if sites.any() else None
    if name == "labels" and pictures.labels is not None:
        look, source = pictures.labels_look, pictures.labels_name
        return pictures.labels, "deformed", look, "labels", source
    if name == "difference" and compared is not None:
        far = compared.difference
        shown = Coloured(far, (0.0, reach_of(far)), signed=False)
        return far, f"difference from {compared.reference} ({answer.unit})", _colours(shown)
    if name == "confidence" and problem is not None:
        c = problem.confidence.max(axis=-1)
        return c, "confidence (0 to 1)", label_colours.confidence_look()
    if name == "stiffness" and problem is not None:
        m = problem.stiffness
        most = float(m[np.isfinite(m)].max(initial=0.0)) or 1.0
        unit = stiffness_unit(answer) or "relative"
        look = {"colormap": label_colours.stiffness_colours(), **label_colours.OVER}
        return m, f"stiffness ({unit})", {**look, "contrast_limits": (1e-9, most)}
    return None


def stiffness_unit(answer: Answer) -> str:
    """The unit of the stiffness that a result was made with; "" where it is relative."""
    tissue = answer.solution.provenance.parameters.get("tissue", {})
    return str(tissue.get("unit") or tissue.get("curve", {}).get("unit") or "")


def _colours(shown: Coloured) -> dict[str, Any]:
    """How every pixel of tissue is coloured."""
    scale = label_colours.quantity_colours(shown.signed, shown.folded)
    return {"colormap": scale, "contrast_limits": shown.limits, **label_colours.OVER}


def _motion_layer(answer: Answer) -> LayerData | None:
    """How tissue was to move (y), as arrows; None if that is not known."""
    if (problem := answer.problem) is None:
        return None
    y, known = problem.observed, problem.known  # what was held has a dot
    apart = pixels_between(_ACROSS, answer.shape, problem.spacing)
    cell = (1, apart, apart)[-len(answer.shape) :]
    starts = spread(np.asarray(known.any(axis=-1)), cell)
    steps = np.where(known, y, 0)[tuple(starts.T)] / problem.spacing
    arrows = np.stack([starts, steps], axis=1).astype(np.float32)
    width = max(answer.shape) / 300
    look = {"vector_style": "arrow", "edge_color": label_colours.OBSERVED, "edge_width": width}
    return answer.layer("observed", arrows, "motion given where tissue was", look, "vectors")
