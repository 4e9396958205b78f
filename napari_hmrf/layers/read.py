"""Conversion between napari layers and a `Study`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels, Layer, Vectors

from napari_hmrf.errors import LayerError, naming
from napari_hmrf.field.brightness import edge_confidence
from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.observation import arrow_observation
from napari_hmrf.layers.arrow_layer import NAME as ARROWS
from napari_hmrf.layers.field_layer import field_layer, field_of, holds_field
from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import (
    BOUNDARY,
    IMAGE,
    METADATA,
    TISSUE,
    described,
    known_of,
    rows_of,
    tissue_record,
)
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.result_layers import layer_on
from napari_hmrf.layers.slice_view import View, check_size, frame_of, plane_shape
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.study.study_model import BRIGHTNESS, StudyModel
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve

#: Choice of confidence: complete where the image has edges.
EDGES = "edges"
#: Pixels sheared by less than this many degrees pass for rectangles.
_RIGHT_ANGLE = 0.1
#: A field that leads out of its slice by less than this part of a pixel leads along it.
_OUT = 0.1
#: More arrows than this are a field, of which some are drawn.
_MANY = 2000


@dataclass(frozen=True)
class Request:
    """Selection of the user: layers, tables, the drawing and the visible slice.

    Attributes
    ----------
    tissue : napari.layers.Labels or napari.layers.Image, optional
        Labels, each with a stiffness in `materials`; or the stiffness itself. Without it tissue is
        what is in the image.
    boundary : napari.layers.Labels or napari.layers.Vectors, optional
        Labels, each with a rule in `rules`; or the observed displacements: arrows on the pixels, or
        a layer that holds a field, wherever that lies.
    image : napari.layers.Image, optional
        The picture to deform; its place is the reference, else that of `tissue`.
    materials : tuple of Material, optional
        By default those that the tissue layer carries.
    rules : tuple of BoundaryRule, optional
        Lengths in the unit of the image; by default those that the boundary layer carries.
    confidence : napari.layers.Image, napari.layers.Labels or "edges", optional
        Confidence of the observed displacements, 0 to 1; labels are a mask. "edges": complete
        where the image has its steepest edges. By default it is complete everywhere.
    view : View, optional
        The visible slice; by default the first, of the last two axes.
    hold_edge : bool
        Whether the outer edge of the tissue stays where it is.
    drawing : Drawing, optional
        Marks drawn with a pointer, which take precedence; None if there is no drawing.
    preset : Preset, optional
        The tissues that can be painted where the layer has no table of its own.
    without_border : bool
        Whether what is dark around the image is no tissue where its label is 0.
    curve : StiffnessCurve, optional
        Curve from the image's intensity to stiffness; used with `image`, in place of `tissue`.
    weight : tuple of float
        As of `Motion`.
    """

    tissue: Any = None
    boundary: Any = None
    image: Any = None
    materials: tuple[Material, ...] | None = None
    rules: tuple[BoundaryRule, ...] | None = None
    confidence: Any = None
    view: View | None = None
    hold_edge: bool = False
    drawing: Drawing | None = None
    preset: Preset | None = None
    without_border: bool = False
    curve: StiffnessCurve | None = None
    weight: tuple[float, ...] = ()

    @classmethod
    def of(cls, model: StudyModel, view: View, preset: Preset | None = None) -> Request:
        """Return the choices for the selected image of a model, with its drawing.

        Parameters
        ----------
        model : StudyModel
        view : View
            The visible slice.
        preset : Preset, optional
            Tissues that can be painted where the layer has no table of its own.
        """
        choice = model.choice
        tissue, boundary = choice.tissue_layer, choice.boundary
        materials = None if tissue is None else model.table(TISSUE, tissue)
        rules = None if boundary is None else model.table(BOUNDARY, boundary)
        return cls(
            image=model.image,
            tissue=tissue,
            materials=None if materials is None else materials.rows,
            boundary=boundary,
            rules=None if rules is None else rules.rows,
            confidence=choice.confidence if isinstance(boundary, Vectors) else None,
            view=view,
            hold_edge=choice.hold_edge,
            drawing=model.drawing,
            preset=preset,
            without_border=choice.without_border,
            curve=model.curve if choice.tissue == BRIGHTNESS else None,
            weight=choice.weight,
        )

    @property
    def layers(self) -> tuple[Any, ...]:
        """The layers that have the same pixels, the reference first."""
        arrows = None if holds_field(self.boundary) else self.boundary
        chosen = (self.image, self.tissue, arrows, self.confidence)
        return tuple(layer for layer in chosen if isinstance(layer, Layer))


def study_from_layers(request: Request, copies: LayerCopies | None = None) -> Study:
    """Read the visible slice of every layer into a study; quick, as the window waits for it.

    Parameters
    ----------
    request : Request
    copies : LayerCopies, optional
        Of a viewer: a layer that did not change since is not read again.

    Raises
    ------
    ProblemError
        Naming the layer that lies elsewhere, is of another size or cannot be read.
    """
    return _Reader(request, copies or LayerCopies()).study()


class _Reader:
    """State while layers are read."""

    def __init__(self, request: Request, copies: LayerCopies) -> None:
        self._request = request
        self._copies = copies
        self._reference = reference = request.layers[0]
        self._frame = frame_of(reference, request.view)
        self._shape = plane_shape(reference, self._frame)
        self._notes: list[str] = []
        if (skew := self._frame.skew) > _RIGHT_ANGLE:
            sheared = f"the pixels are sheared by {skew:.1f} degrees, but taken as rectangles"
            self._notes.append(sheared)
        if request.view is not None and request.view.tilts(self._frame):
            self._notes.append(
                f"napari draws '{reference.name}' as if it did not lean out of its slices, and "
                "so it says places; directions, lengths and what is saved are the true ones"
            )
        if any(layer.multiscale for layer in request.layers):
            self._notes.append(f"computed on the finest level, {grid_in_words(self._shape)}")

    def study(self) -> Study:
        request, frame, reference = self._request, self._frame, self._reference
        image = None if request.image is None else self._slice(request.image)
        tissue, motion = self._tissue(), replace(self._motion(), weight=request.weight)
        parts = {
            "image": reference,
            "tissue": request.tissue,
            "boundary": request.boundary,
            "confidence": request.confidence,
        }
        names = {part: str(layer.name) for part, layer in parts.items() if isinstance(layer, Layer)}
        drawing = request.drawing
        if drawing is not None and (drawing.marks or "boundary" not in names):
            names["drawing"] = ARROWS
        return Study(
            grid=Grid(self._shape, frame.spacing, frame.unit, frame),
            tissue=tissue,
            motion=motion,
            pictures=Pictures(
                image=image,
                labels=tissue.labels,
                name=str(reference.name),
                labels_name="" if request.tissue is None else str(request.tissue.name),
                look=look_of(request.image),
                labels_look=look_of(request.tissue) if tissue.labels is not None else {},
            ),
            names=names,
            notes=tuple(self._notes),
        )

    def _slice(self, layer: Any) -> npt.NDArray[Any]:
        """The pixels of a layer that are the reference's."""
        own = frame_of(layer, self._request.view)
        check_size(layer, own, self._reference, self._frame, self._shape)
        return self._copies.of(layer, own)

    def _tissue(self) -> Tissue:
        request = self._request
        layer, curve = request.tissue, request.curve
        if curve is not None:
            record = {"curve": curve.as_dict(), "source": str(self._reference.name)}
            return Tissue(curve=curve, preset=request.preset, unit=curve.unit, record=record)
        if layer is None:
            return Tissue(preset=request.preset)
        unit = str(known_of(layer).get("unit", ""))
        if isinstance(layer, Labels):
            rows = request.materials
            rows = rows_of(layer, TISSUE) if rows is None else tuple(rows)
            return Tissue(
                labels=self._slice(layer),
                materials=rows,
                unit=unit,
                record=tissue_record(layer, rows),
                without_border=request.without_border,
            )
        if layer.rgb:
            raise LayerError(
                layer,
                "is a colour image, which cannot be a stiffness. Choose a Labels layer or a grey "
                "image.",
            )
        return Tissue(
            stiffness=self._slice(layer),
            preset=request.preset,
            unit=unit,
            record=tissue_record(layer, ()),
        )

    def _motion(self) -> Motion:
        request, layer = self._request, self._request.boundary
        drawing = request.drawing or Drawing()
        if isinstance(layer, Vectors):
            observed, counts = self._observed(layer)
            return Motion(request.hold_edge, observed=observed, confidence=counts, drawing=drawing)
        if layer is None:
            return Motion(request.hold_edge, drawing=drawing)
        labels = self._slice(layer)
        if request.drawing is None and not labels.any():
            here = frame_of(layer, request.view).slice_seen
            raise LayerError(
                layer,
                f"has no paint{f' in {here}' if here else ' yet'}: choose a row, then paint a wall "
                "or something that moves.",
            )
        rules = request.rules
        rules = rows_of(layer, BOUNDARY) if rules is None else tuple(rules)
        return Motion(request.hold_edge, labels, rules, drawing=drawing)

    def _observed(self, layer: Any) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the displacements that arrows or a field observe, and their confidence."""
        request, frame, shape = self._request, self._frame, self._shape
        data, sure, field = self._copies.of(layer), self._sure(), field_of(layer)
        own = frame if field else frame_of(layer, request.view)
        if field is None:
            check_size(layer, own, self._reference, frame, shape)

        def observe() -> tuple[npt.NDArray[Any], npt.NDArray[Any], float, str]:
            with naming(observed=layer):
                if field is not None:
                    y, known, out, note = field.on(frame, shape)
                else:
                    arrows = np.array(data, float)
                    y, known, out, note = arrow_observation(arrows, own, frame.spacing, shape)
            c = np.where(known, 1 if sure is None else sure, 0).astype(np.float32)
            if known.any() and not c.any():
                raise LayerError(
                    request.confidence,
                    f"is 0 wherever '{layer.name}' says how tissue moves, so that nothing of that "
                    "counts. Paint where it is sure, or choose ----- in 'confidence'.",
                )
            return y, np.repeat(c[..., None], len(shape), axis=-1), out, note

        of = (data, sure, own, frame.spacing, shape, *(field or ()))
        y, c, out, note = self._copies.made(layer, of, observe)
        if note:
            self._notes.append(f"'{layer.name}' {note}")
        if out > (0 if field is None else _OUT * max(frame.spacing)):
            self._notes.append(f"'{layer.name}' leads out of the slice, too, which did not count")
        return y, c

    def _sure(self) -> npt.NDArray[Any] | None:
        """Return the confidence of the observed displacements."""
        chosen, image = self._request.confidence, self._request.image
        if chosen is None:
            return None
        if isinstance(chosen, Layer):
            pixels = self._slice(chosen)
            if isinstance(chosen, Labels):
                return self._copies.made(chosen, (pixels,), lambda: pixels > 0)
            if pixels.ndim != len(self._shape):
                raise LayerError(chosen, "is a colour image. Choose a grey image of values 0 to 1.")
            return pixels
        if image is None:
            raise LayerError(self._reference, "has no edges: choose an image.")
        pixels = self._slice(image)
        return self._copies.made(
            image, (pixels,), lambda: edge_confidence(pixels, axes=len(self._shape))
        )


def look_of(layer: Any) -> dict[str, Any]:
    """Return the display settings of an Image or Labels layer, as arguments of a new layer."""
    if layer is None or getattr(layer, "rgb", False):
        return {}
    if isinstance(layer, Labels):
        return {"colormap": layer.colormap, "opacity": layer.opacity}
    return {
        "colormap": layer.colormap,
        "contrast_limits": tuple(layer.contrast_limits),
        "gamma": layer.gamma,
    }


def study_layers(study: Study) -> dict[str, Any]:
    """Make the layers that are read as a study, where it lies, or from the origin on.

    Parameters
    ----------
    study : Study
        Of which all but its drawing, its model and what holds the edge becomes layers.

    Returns
    -------
    dict of str to napari.layers.Layer
        By "image", "tissue", "boundary" and "confidence", those there are; in the order in which
        they lie above each other.
    """
    grid, tissue, motion, pictures = study.grid, study.tissue, study.motion, study.pictures
    n = len(grid.shape)
    frame = grid.place or Frame.at(grid.spacing, (grid.unit,) * n, volume=n == 3)
    made: dict[str, Any] = {}

    def add(
        part: str, name: str, data: Any, look: Mapping[str, Any], sort: str = "image", **what: Any
    ) -> None:
        """Make a layer, by the name that it had."""
        name = study.names.get(part, name)
        known = described(**what)[METADATA] if what else {}
        made[part] = Layer.create(*layer_on(frame, data, name, known, look, sort))

    if pictures.image is not None:
        add("image", pictures.name or "image", pictures.image, pictures.look, role=IMAGE)
    known = {"role": TISSUE, "unit": tissue.unit}
    if tissue.labels is not None:
        look = {"opacity": 0.4, **pictures.labels_look}
        add("tissue", "Tissue", tissue.labels, look, "labels", rows=tissue.materials, **known)
    elif tissue.stiffness is not None:
        add("tissue", "Stiffness", tissue.stiffness, {"opacity": 0.4}, **known)
    if motion.labels is not None:
        look, rules = {"colormap": boundary_colours()}, motion.rules
        add("boundary", "Boundary", motion.labels, look, "labels", role=BOUNDARY, rows=rules)
    elif motion.observed is not None and motion.confidence is not None:
        counts = motion.confidence
        counts = counts if counts.ndim == n else counts.max(axis=-1)
        starts, steps = np.argwhere(counts > 0), motion.observed / grid.spacing
        if len(starts) > _MANY:
            field = DisplacementField.in_pixels(frame.put_field(steps))
            name = study.names.get("boundary", "Observed")
            place = frame.placement(image=True)
            made["boundary"] = Layer.create(*field_layer(field, place, name, BOUNDARY))
        else:
            arrows = np.stack([starts, steps[tuple(starts.T)]], axis=1)
            add("boundary", "Observed", arrows, {}, "vectors", role=BOUNDARY)
        look = {"contrast_limits": (0, 1), "opacity": 0.3}
        add("confidence", "Confidence", counts, look)
    for part, layer in made.items():  # paint would tint the picture that has moved
        layer.visible = not study.moves or part == ("image" if "image" in made else "tissue")
    return made
