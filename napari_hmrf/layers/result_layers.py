"""Conversion of a solution to layers: the deformed image, displacement arrows and overlays.

The arrow layer contains the result. An overlay, such as a colour map of the strain, is shown over
the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.colormaps import beyond, reach_of
from napari_hmrf.field.deformation import (
    arrows_apart,
    arrows_in_slices,
    pixels_between,
    smallest_determinant,
    spread,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.resample import emptiness, resample, without_removed
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.layers import label_colours
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.notes import kind_of
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.posterior.study_uncertainty import ground_uncertainty
from napari_hmrf.results.animation import (
    FOLD_MARKS,
    Motion,
    fullest_planes,
    marked_sites,
    moved_grid,
    moved_marks,
)
from napari_hmrf.results.comparison import Comparison
from napari_hmrf.results.held_forces import HeldForce, held_forces
from napari_hmrf.results.quantities import QUANTITIES, Coloured, Quantity, coloured, title_and_unit
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.solver.model_names import in_words, model_name
from napari_hmrf.solver.priors import Elastic, ElasticPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.shortcomings import FOLDS, shortcomings
from napari_hmrf.study.study import Pictures

Array = npt.NDArray[Any]
#: Metadata or display settings, by name.
Facts = Mapping[str, Any]
#: Kind of a layer that is created for each result.
Kind = Literal["image", "arrows"]

#: Approximate number of arrows: enough to show the motion, but few enough not to hide the image.
ARROWS = 250
#: Name of an overlay.
Name = (
    Quantity
    | Literal["folds", "grid", "labels", "difference", "uncertainty"]
    | Literal["stiffness", "observed", "confidence"]
)
#: Number of arrows of the observed motion along a side of the image.
_ACROSS = 40
#: Largest number of labels whose mean displacements are estimated. More labels would take longer
#: than the samples of the patches.
_MOST_LABELS = 10


class LayerData(NamedTuple):
    """napari's layer data tuple, as returned by readers and sample functions.

    Attributes
    ----------
    data : object
        Data of the layer.
    attributes : dict
        Keyword arguments of the new layer.
    kind : str
        Type of the layer, such as "image".
    """

    data: Any
    attributes: dict[str, Any]
    kind: str


#: Function that computes the forces on the constrained parts of the tissue.
Forces = Callable[[], tuple[HeldForce, ...]]
#: Function that estimates the uncertainty; its arguments are `progress` and `cancel`.
Estimate = Callable[..., Uncertainty]


@dataclass(frozen=True, eq=False)
class PlacedSolution:
    """Solution with its place and pictures: the result stored in an arrow layer.

    Attributes
    ----------
    solution : Solution
        Solution, including its frame.
    frame : Frame
        Place of the solution in world coordinates.
    pictures : Pictures
        Pictures that are deformed with the solution, without the pixels of the image; empty for a
        result from a file.
    problem : Problem, optional
        Solved problem; None for a result from a file.
    forces : callable, optional
        Function that returns the forces on the constrained parts of the tissue; None for a result
        from a file.
    estimate : callable, optional
        Function that estimates the uncertainty; None for a result from a file or of a model other
        than the elastic model.
    """

    solution: Solution
    frame: Frame
    pictures: Pictures = field(default_factory=Pictures)
    problem: Problem | None = None
    forces: Forces | None = None
    estimate: Estimate | None = None

    @property
    def unit(self) -> str:
        """Symbol of the unit of length, such as "px" or "mm"."""
        return unit_symbol(self.frame.unit)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid: ([planes,] rows, columns)."""
        shape: tuple[int, ...] = self.solution.tissue.shape
        return shape

    def layer(
        self, kind: str, data: Array, what: str, look: Facts, sort: str = "image", source: str = ""
    ) -> LayerData:
        """Create the layer of a part of the result, with the transform of the solution.

        Parameters
        ----------
        kind : str
            Kind of the layer, for its metadata.
        data, look, sort
            As for `layer_on`.
        what : str
            Description of the content, for the name of the layer.
        source : str
            Name of the source, for the name of the layer; by default, the name of the deformed
            image.
        """
        provenance = self.solution.provenance
        known = {
            **_origin_facts(self.frame, self.pictures),
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
    """Layers of a result, with the numbers of folds and overlaps.

    Attributes
    ----------
    solution : Solution
        Solution, including its frame.
    layers : dict of kind to LayerData
        Layers in stacking order.
    folds : int
        Number of sites at which the tissue folds over itself (Jacobian determinant <= 0).
    overlaps : int
        Number of pixels at which different parts of the tissue overlap; 0 if no pictures are given.
    fullest : tuple of int
        Index of the plane perpendicular to each axis with most folds and overlaps.
    """

    solution: Solution
    layers: dict[Kind, LayerData]
    folds: int
    overlaps: int = 0
    fullest: tuple[int, ...] = ()


def result_layers(
    solution: Solution,
    frame: Frame | None = None,
    pictures: Pictures | None = None,
    checkpoint: Callable[[], None] = lambda: None,
    problem: Problem | None = None,
    forces: Forces | None = None,
    estimate: Estimate | None = None,
) -> Outputs:
    """Convert a solution to layer data, without creating layers.

    Parameters
    ----------
    solution : Solution
    frame : Frame, optional
        Place of the solution; by default, the place in `solution.frame`, or else the origin.
    pictures : Pictures, optional
        Pictures to deform with the tissue.
    checkpoint : callable
        Called between steps; raises an exception to cancel the work.
    problem, forces, estimate
        As for `PlacedSolution`.

    Returns
    -------
    Outputs

    Raises
    ------
    ValueError
        If the solution's frame is not a valid frame of layers.
    """
    frame = solution.place if frame is None else frame
    solution = replace(solution, frame={**(solution.frame or {}), **frame.as_dict()})
    checkpoint()
    folded = smallest_determinant(solution.displacement, **solution.on_grid) <= 0
    marks = moved_marks(solution, folded).astype(bool)
    shown = pictures or Pictures()
    digests = solution.provenance.inputs
    for name in digests:
        checkpoint()
        digests[name]  # computed on first access
    answer = PlacedSolution(
        solution, frame, replace(shown, image=None, look={}), problem, forces, estimate
    )
    layers: dict[Kind, LayerData] = {}
    overlaps = 0
    if pictures is not None:  # skipped for results from files, to avoid waiting for compiled loops
        checkpoint()
        origin, covered, overlapping = inverse_map_and_overlaps(
            solution.displacement, **solution.on_grid
        )
        overlaps, marks = int(overlapping.sum()), marks | overlapping
        if (image := pictures.image) is not None:
            checkpoint()
            fill = emptiness(image, solution.tissue.ndim)
            remaining = without_removed(image, solution.removed, fill)
            moved = resample(remaining, origin, covered, order=1, fill=fill)
            layers["image"] = answer.layer("image", moved, "deformed", pictures.look)
    checkpoint()
    layers["arrows"] = _arrow_layer(answer)
    return Outputs(solution, layers, int(folded.sum()), overlaps, fullest_planes(marks))


def _arrow_layer(answer: PlacedSolution) -> LayerData:
    """Create the arrow layer, with the result in its metadata (in memory only)."""
    solution = answer.solution
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    pick_arrows = arrows_apart if tissue.ndim == 2 else arrows_in_slices
    arrows = pick_arrows(d, spacing=spacing, tissue=tissue, about=ARROWS)
    fullest = tissue.sum(axis=(-2, -1)).max()
    width = max(1.0, math.sqrt(fullest / ARROWS)) / 8
    look = {"vector_style": "arrow", "edge_color": label_colours.ARROWS, "edge_width": width}
    made = answer.layer("arrows", arrows, "arrows", look, "vectors")
    made.attributes["metadata"][METADATA]["answer"] = answer
    return made


def picture_layer(frame: Frame, pictures: Pictures, picture: Array, parameters: Facts) -> LayerData:
    """Create the layer of a deformed image during live updates, before the result is complete.

    Parameters
    ----------
    frame : Frame
    pictures : Pictures
        Name and display settings of the image.
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
        Deformed image.
    parameters : mapping
        Parameters in the provenance of the solution.
    """
    known = {**_origin_facts(frame, pictures), "kind": "image"}
    name = _result_name(pictures.name, "deformed", parameters, frame.slice_seen)
    return layer_on(frame, picture, name, known, pictures.look)


def layer_on(
    frame: Frame, data: Array, name: str, known: Facts, look: Facts, sort: str = "image"
) -> LayerData:
    """Create the data of a layer with the transform of a frame.

    Parameters
    ----------
    frame : Frame
    data : ndarray
        Pixels, shape ([D,] H, W) or ([D,] H, W, 3 or 4); or vectors in pixels, shape (N, 2, n).
    name : str
        Name of the layer.
    known : mapping
        Entry of this package in the metadata of the layer.
    look : mapping
        Display settings, as keyword arguments of a new layer.
    sort : {"image", "labels", "vectors"}
        Type of the layer.
    """
    lines = sort == "vectors"
    attributes = {**look, **frame.placement(image=not lines), "name": name}
    attributes["metadata"] = {METADATA: dict(known)}
    if sort == "image":
        attributes["rgb"] = data.ndim > len(frame.plane)
    placed = frame.put_vectors(data) if lines else frame.put_image(data)
    return LayerData(placed, attributes, sort)


def _origin_facts(frame: Frame, pictures: Pictures) -> dict[str, Any]:
    """Return the source, slice and unit of a result, for the metadata of its layers."""
    return {"source": pictures.name, "slice": frame.slice_name, "unit": frame.unit}


def _result_name(source: str, what: str, parameters: Facts, where: str) -> str:
    """Return a layer name that consists of the source image, content, model and slice."""
    name = ", ".join(filter(None, (f"{source} {what}".strip(), model_name(parameters))))
    return name + (f" ({where})" if where else "")


class Overlay(NamedTuple):
    """Overlay on the image of a result.

    Attributes
    ----------
    name : Name
    layer : LayerData
        Layer at the full deformation.
    picture : ndarray, shape ([D,] H, W), optional
        Undeformed pixels of the overlay, bool for marked sites; None if the overlay consists of
        lines.
    """

    name: Name
    layer: LayerData
    picture: Array | None = None

    @property
    def limits(self) -> tuple[float, float] | None:
        """Ends of the colour scale, or None if the overlay has no colour scale."""
        limits: tuple[float, float] | None = self.layer.attributes.get("contrast_limits")
        return limits

    @property
    def quantity(self) -> Quantity | None:
        """Quantity of the tissue in the overlay, or None for another overlay."""
        return self.name if self.name in QUANTITIES else None

    @property
    def beyond(self) -> str:
        """Note on values outside the colour limits, or "" if there are no such values."""
        if self.limits is None or self.picture is None:
            return ""
        return beyond(self.picture, self.limits)

    def motion(self, solution: Solution, image: Array | None = None) -> Motion:
        """Return the motion of the overlay and, if given, of an image."""
        is_grid = self.name == "grid"
        return Motion(solution, image, self.picture, is_grid, self.quantity, self.limits)


def overlay_of(
    answer: PlacedSolution,
    name: Name,
    compared: Comparison | None = None,
    estimated: Uncertainty | None = None,
) -> Overlay | None:
    """Create an overlay on the image of a result; must be called on the compute thread.

    Overlays are deformed with the tissue, except for the arrows of the observed motion, which
    begin at the original positions of the tissue.

    Signed quantities have colours from purple (lower) to orange (higher), and other quantities from
    dark to light. The overlay is transparent at the neutral value. Folds are blue.

    Parameters
    ----------
    answer : PlacedSolution
        Result.
    name : Name
        Name of the overlay.
    compared : Comparison, optional
        Comparison with another result, for the overlay "difference".
    estimated : Uncertainty, optional
        Uncertainty of the result, for the overlay "uncertainty".

    Returns
    -------
    Overlay or None
        None if the result lacks the content of the overlay, such as folds or labels.
    """
    if name == "grid":
        look = {"vector_style": "line", "edge_color": "cyan", "edge_width": max(answer.shape) / 500}
        grid = moved_grid(answer.solution)
        return Overlay(name, answer.layer(name, grid, name, look, "vectors"))
    if name == "observed":
        made = _motion_layer(answer)
        return None if made is None else Overlay(name, made)
    if (pixels := _pixels_of(answer, name, compared, estimated)) is None:
        return None
    picture, *shown = pixels
    still = Overlay(name, answer.layer(name, picture, *shown), picture)
    moved = np.asarray(still.motion(answer.solution).at(1).overlay)
    return still._replace(layer=still.layer._replace(data=answer.frame.put_image(moved)))


def _pixels_of(
    answer: PlacedSolution,
    name: Name,
    compared: Comparison | None,
    estimated: Uncertainty | None,
) -> tuple[Any, ...] | None:
    """Return the undeformed pixels of an overlay, and the arguments of `PlacedSolution.layer`.

    The result is None if there is no such overlay.
    """
    pictures, problem = answer.pictures, answer.problem
    if name in ("von_mises", "pressure") and answer.solution.elasticity is None:
        return None
    if name in QUANTITIES:
        title, unit = title_and_unit(name, answer.solution)
        shown = coloured(answer.solution, name)
        legend = f"{title} ({unit or answer.unit}{shown.unit_note})"
        return shown.values, legend, _colours(shown)
    if name == FOLD_MARKS:
        sites = marked_sites(answer.solution)
        return (sites, name, label_colours.mark_look(), "labels") if sites.any() else None
    if name == "labels" and pictures.labels is not None:
        look, source = pictures.labels_look, pictures.labels_name
        return pictures.labels, "deformed", look, "labels", source
    if name == "difference" and compared is not None:
        difference = compared.difference
        shown = Coloured(difference, (0.0, reach_of(difference)), signed=False)
        return difference, f"difference from {compared.reference} ({answer.unit})", _colours(shown)
    if name == "uncertainty" and estimated is not None:
        bars = np.where(answer.solution.tissue, estimated.along, np.float32(np.nan))
        shown = Coloured(bars, (0.0, reach_of(bars)), signed=False)
        patch = f"patches of {estimated.patch:.2g} {answer.unit}"
        return bars, f"uncertainty ({answer.unit}, {patch})", _colours(shown)
    if name == "confidence" and problem is not None:
        c = problem.confidence.max(axis=-1)
        return c, "confidence (0 to 1)", label_colours.confidence_look()
    if name == "stiffness" and problem is not None:
        m = problem.stiffness
        most = float(m[np.isfinite(m)].max(initial=0.0)) or 1.0
        unit = answer.solution.stress_unit or "relative"
        look = {"colormap": label_colours.stiffness_colours(), **label_colours.OVER}
        return m, f"stiffness ({unit})", {**look, "contrast_limits": (1e-9, most)}
    return None


def _colours(shown: Coloured) -> dict[str, Any]:
    """Return the display settings of an Image layer that shows a quantity."""
    scale = label_colours.quantity_colours(shown.signed, shown.folded, shown.descending)
    look = {"colormap": scale, "contrast_limits": shown.limits, **label_colours.OVER}
    return {**look, "rendering": "minip" if shown.descending else "mip"}


def _motion_layer(answer: PlacedSolution) -> LayerData | None:
    """Create the arrow layer of the observed motion y; return None if there is no problem."""
    if (problem := answer.problem) is None:
        return None
    y, known = problem.observed, problem.known  # the arrows of fixed sites are dots
    apart = pixels_between(_ACROSS, answer.shape, problem.spacing)
    cell = (1, apart, apart)[-len(answer.shape) :]
    starts = spread(np.asarray(known.any(axis=-1)), cell)
    steps = np.where(known, y, 0)[tuple(starts.T)] / problem.spacing
    arrows = np.stack([starts, steps], axis=1).astype(np.float32)
    width = max(answer.shape) / 300
    look = {"vector_style": "arrow", "edge_color": label_colours.OBSERVED, "edge_width": width}
    return answer.layer("observed", arrows, "given motion", look, "vectors")


class CompleteResult(NamedTuple):
    """Completed deformation, its layers, and notes for the user; each note is a clause."""

    moved: Deformation
    outputs: Outputs
    notes: tuple[str, ...]


def complete_result(
    moved: Deformation, checkpoint: Callable[[], None] = lambda: None
) -> CompleteResult:
    """Create the layers of a deformation, and collect notes for the user.

    Parameters
    ----------
    moved : Deformation
        Deformation with a solution.
    checkpoint : callable
        Called between steps; raises an exception to cancel the work.
    """
    study, ground, stated, solved = moved.study, moved.ground, moved.stated, moved.solution
    assert ground is not None
    assert stated is not None
    assert solved is not None
    place, pictures = study.grid.place, study.pictures
    if stated.labels is not None:
        pictures = replace(pictures, labels=stated.labels)
    # A ground may be older than the drawing.
    ground = replace(ground, study=study)
    of_study = tuple(filter(None, ground.notes_on(stated)))
    stored = (*drift_clauses(solved), *of_study) if of_study else solved.notes
    kept = replace(_solution_to_keep(moved, ground), notes=stored)
    forces = estimate = None
    if isinstance(stated.prior, Elastic):
        forces = partial(held_forces, stated.problem, solved)
    if isinstance(stated.prior, ElasticPrior):
        labels = pictures.labels
        is_quick = labels is None or len(np.unique(labels)) <= _MOST_LABELS
        where = kept.tissue if is_quick else np.zeros_like(kept.tissue)
        estimate = partial(ground_uncertainty, ground, stated, labels=labels, where=where)
    outputs = result_layers(kept, place, pictures, checkpoint, stated.problem, forces, estimate)
    short = shortcomings(solved, study.grid.unit, outputs.folds, stated.problem, stated.edge)
    # The warning chip reports the number of folds.
    notes = (*(note for note in short if kind_of(note) != FOLDS), *of_study)
    return CompleteResult(moved, outputs, notes)


def _solution_to_keep(moved: Deformation, ground: Ground) -> Solution:
    """Return the solution without air and with records of the drawing and the tissue."""
    study, solution = moved.study, moved.solution
    assert solution is not None
    solution = ground.without_air(solution)
    if study.motion.drawing.marks:
        solution = replace(solution, frame={"drawing": study.motion.drawing.as_dict()})
    if study.tissue.record or study.tissue.stiffness_unit:
        record = {"unit": study.tissue.stiffness_unit, **study.tissue.record}
        parameters = {**solution.provenance.parameters, "tissue": record}
        solution = replace(solution, provenance=replace(solution.provenance, parameters=parameters))
    return solution
