"""A solution becomes layers."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.animation import moved_grid
from napari_hmrf.field.colormaps import OPACITY
from napari_hmrf.field.deformation import arrows, pixels_between, smallest_determinant
from napari_hmrf.field.resample import emptiness, resample
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.layers.label_colours import ARROWS as ARROW_COLOUR
from napari_hmrf.layers.label_colours import (
    OBSERVED,
    fold_colours,
    quantity_colours,
    stiffness_colours,
)
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.place import Frame
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.models import in_words, short_name
from napari_hmrf.study.study import Pictures

Array = npt.NDArray[Any]
#: What is known of something, or how it looks, by name.
Facts = Mapping[str, Any]
Kind = Literal["image", "labels", "stiffness", "confidence", "folds", "observed", "grid", "arrows"]
#: The layers there can be, in the order they are stacked, lowest first. What was given, m, y and c
#: of the problem, lies where tissue was before it moved.
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Of these, what was given.
_GIVEN = ("stiffness", "confidence", "observed")

#: Arrows enough to see the motion, few enough to see the image and each of them.
ARROWS = 250
#: What moves by less than this part of the farthest is not drawn: its arrow would be a dot.
_LEAST = 0.1
#: Arrows of what is given that fit beside each other across the image.
_ACROSS = 40
#: How quantities lie over the image.
OVER = {"blending": "translucent", "opacity": OPACITY}


class LayerData(NamedTuple):
    """A layer before it is one, as napari's readers and samples give it."""

    data: Any
    attributes: dict[str, Any]
    kind: str


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
    kinds: Collection[Kind] = ("arrows", "image"),
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
    kinds : collection of Kind
        The layers to make; those that lack their picture, or the problem, are left out.
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
    checkpoint()
    smallest = smallest_determinant(solution.displacement, solution.spacing, solution.tissue)
    folded = smallest <= 0
    worst = None
    if folded.any():
        row, col = np.unravel_index(int(np.nanargmin(smallest)), smallest.shape)
        worst = (int(row), int(col))
    # A file that is opened shows arrows, and need not wait for the compiler of the loops.
    arrows_alone, pictures = pictures is None, pictures or Pictures()
    maker = _Maker(solution, frame, pictures, folded, problem)
    overlaps = 0 if arrows_alone else maker.count_overlaps()
    layers: dict[Kind, LayerData] = {}
    for kind in KINDS:
        checkpoint()
        known = problem is not None or kind not in _GIVEN
        if known and kind in kinds and (made := getattr(maker, kind)()) is not None:
            layers[kind] = made
    return Outputs(solution, layers, int(folded.sum()), overlaps, worst)


def _arrows_apart(solution: Solution) -> tuple[npt.NDArray[np.float32], float]:
    """Pick arrows as (start, step) in pixels, none on another, and how thick they are drawn."""
    found = arrows(
        solution.displacement, spacing=solution.spacing, tissue=solution.tissue, about=ARROWS
    )
    lengths = np.linalg.norm(found[:, 1], axis=1)
    found = found[lengths >= max(_LEAST * lengths.max(initial=0.0), 1e-6)]
    pixels = max(1.0, math.sqrt(solution.tissue.sum() / ARROWS))
    chosen = apart(found, pixels * math.prod(solution.spacing) ** 0.5 / 4, solution.spacing)
    return found[chosen], pixels / 8


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
    name = result_name(pictures.name, "deformed", parameters, frame.slice_seen)
    return pixel_layer(frame, picture, name, known, pictures.look)


def pixel_layer(
    frame: Frame, pixels: Array, name: str, known: Facts, look: Facts, sort: str = "image"
) -> LayerData:
    """Pixels of a slice as a layer that lies there, with what it is to know of itself."""
    attributes = {**look, **frame.placement(image=True), "name": name}
    attributes["metadata"] = {METADATA: dict(known)}
    if sort == "image":
        attributes["rgb"] = pixels.ndim == 3
    return LayerData(frame.put_image(pixels), attributes, sort)


def _whence(frame: Frame, pictures: Pictures) -> dict[str, Any]:
    """Of what a result was made."""
    return {
        "source": pictures.name,
        "slice": frame.slice_name,
        "slice_seen": frame.slice_seen,
        "unit": frame.unit,
    }


def result_name(source: str, what: str, parameters: Facts, where: str) -> str:
    """Name a layer after the image it was made of, what it shows, the model and the slice."""
    model = short_name(parameters)
    name = f"{source} {what}".strip() + (f", {model}" if model else "")
    return name + (f" ({where})" if where else "")


class _Maker:
    """One method per kind of layer."""

    def __init__(
        self,
        solution: Solution,
        frame: Frame,
        pictures: Pictures,
        folded: npt.NDArray[np.bool_],
        problem: Any,
    ) -> None:
        self._solution, self._problem, self._folded = solution, problem, folded
        self._frame, self._pictures = frame, pictures
        self._field = (solution.displacement, solution.spacing)
        self._facts: dict[str, Any] = {
            **_whence(frame, pictures),
            "model": in_words(solution.provenance.parameters),
            "folds": int(folded.sum()),
            "provenance": asdict(solution.provenance),
        }
        if pictures.level is not None:
            self._facts["level"] = pictures.level

    def count_overlaps(self) -> int:
        """Count the pixels that hold tissue twice, and keep the number with the layers' facts."""
        self._facts["overlaps"] = int(self._inverted[2].sum())
        return int(self._facts["overlaps"])

    def image(self) -> LayerData | None:
        """The image, moved with the tissue."""
        picture = self._pictures.image
        if picture is None:
            return None
        moved = resample(picture, *self._inverted[:2], order=1, fill=emptiness(picture))
        parameters = self._solution.provenance.parameters
        return picture_layer(self._frame, self._pictures, moved, parameters, self._facts)

    def labels(self) -> LayerData | None:
        """The tissue labels, moved with the tissue."""
        labels = self._pictures.labels
        if labels is None:
            return None
        moved = resample(labels, *self._inverted[:2], order=0)
        look, source = self._pictures.labels_look, self._pictures.labels_name
        return self._pixels("labels", moved, self._name("deformed", source), look, "labels")

    def stiffness(self) -> LayerData:
        """How stiff tissue was taken to be: m."""
        m = self._problem.stiffness
        finite = m[np.isfinite(m)]
        most = float(finite.max(initial=0.0)) or 1.0
        look = {"colormap": stiffness_colours(), "contrast_limits": (1e-9, most), **OVER}
        return self._pixels("stiffness", m, self._name("stiffness"), look)

    def confidence(self) -> LayerData:
        """How sure it was how tissue moves: c, the larger of its components."""
        look = {"colormap": quantity_colours(signed=False), "contrast_limits": (0.0, 1.0), **OVER}
        c = self._problem.confidence.max(axis=-1)
        return self._pixels("confidence", c, self._name("confidence"), look)

    def observed(self) -> LayerData:
        """How tissue was to move where that was known: y; what was held has a dot."""
        y, known = self._problem.observed, self._problem.known
        apart_by = pixels_between(_ACROSS, known.shape[:2], self._solution.spacing)
        starts = np.argwhere(known.any(axis=-1))
        if len(starts):
            _, first = np.unique(starts // apart_by, axis=0, return_index=True)
            starts = starts[first]
        steps = np.where(known, y, 0)[tuple(starts.T)] / self._solution.spacing
        arrows = np.stack([starts, steps], axis=1).astype(np.float32)
        width = max(known.shape[:2]) / 300
        look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": width}
        return self._vectors("observed", arrows, "motion given", look)

    def grid(self) -> LayerData:
        """A grid that has moved with the tissue."""
        width = max(self._solution.tissue.shape) / 500
        look = {"vector_style": "line", "edge_color": "cyan", "edge_width": width}
        return self._vectors("grid", moved_grid(self._solution), "grid", look)

    def folds(self) -> LayerData | None:
        """Where the tissue folds over itself, before it moved."""
        if not self._folded.any():
            return None
        look = {"colormap": fold_colours(), "opacity": 1.0}
        folded = self._folded.astype(np.uint8)
        return self._pixels("folds", folded, self._name("folds"), look, "labels")

    def arrows(self) -> LayerData:
        """Where the tissue goes."""
        found, width = _arrows_apart(self._solution)
        look = {"vector_style": "arrow", "edge_color": ARROW_COLOUR, "edge_width": width}
        made = self._vectors("arrows", found, "arrows", look)
        # What can be shown of the result later on; in memory only.
        given = {"pictures": replace(self._pictures, image=None, look={}), "problem": self._problem}
        made.attributes["metadata"][METADATA].update(given)
        return made

    @cached_property
    def _inverted(
        self,
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        return inverse_map_and_overlaps(*self._field, self._solution.tissue)

    def _pixels(
        self, kind: Kind, pixels: Array, name: str, look: Facts, sort: str = "image"
    ) -> LayerData:
        known = {"kind": kind, **self._facts}
        return pixel_layer(self._frame, pixels, name, known, look, sort)

    def _vectors(self, kind: Kind, segments: Array, what: str, look: Facts) -> LayerData:
        known = {"kind": kind, **self._facts, "solution": self._solution}
        attributes = {**look, **self._frame.placement(), "length": 1.0, "opacity": 1.0}
        attributes.update(name=self._name(what), metadata={METADATA: known})
        return LayerData(self._frame.put_vectors(segments), attributes, "vectors")

    def _name(self, what: str, source: str | None = None) -> str:
        of = self._pictures.name if source is None else source
        return result_name(of, what, self._solution.provenance.parameters, self._frame.slice_seen)


def apart(
    arrows: npt.NDArray[np.float32], gap: float, spacing: Sequence[float] = (1.0, 1.0)
) -> npt.NDArray[np.intp]:
    """Choose arrows of which none lies on another; where two do, the longer one stays.

    Parameters
    ----------
    arrows : ndarray, shape (N, 2, 2)
        (start, step) in pixels.
    gap : float
        How far lines must at least be apart, in the unit of `spacing`.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.

    Returns
    -------
    ndarray of int
        Which to keep, in order.
    """
    if not len(arrows):
        return np.zeros(0, dtype=np.intp)
    # In cells as wide as the gap: a kept line claims its cells and those around them.
    starts, steps = arrows[:, 0] * spacing / gap, arrows[:, 1] * spacing / gap
    lowest = np.minimum(starts, starts + steps).min(axis=0) - 1
    starts = starts - lowest
    size = np.maximum(starts, starts + steps).max(axis=0).astype(int) + 3
    claimed = np.zeros(size, dtype=bool)
    lengths = np.linalg.norm(steps, axis=1)
    kept = []
    for number in np.argsort(-lengths, kind="stable"):
        along = np.linspace(0, 1, int(2 * lengths[number]) + 2)[:, None]
        rows, cols = (starts[number] + along * steps[number]).astype(int).T
        if claimed[rows, cols].any():
            continue
        kept.append(number)
        for row in (-1, 0, 1):
            for col in (-1, 0, 1):
                claimed[rows + row, cols + col] = True
    return np.sort(np.array(kept, dtype=np.intp))
