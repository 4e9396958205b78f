"""Conversion of napari layers to a `Study`, and of a `Study` to napari layers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels, Layer, Vectors

from napari_hmrf.errors import HmrfError, LayerError, naming
from napari_hmrf.field.brightness import edge_confidence
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.units import has_same_spacing
from napari_hmrf.layers.arrow_layer import NAME as ARROWS
from napari_hmrf.layers.field_layer import field_layer, field_of, holds_field
from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import (
    BOUNDARY,
    FILE_AXES,
    IMAGE,
    METADATA,
    TISSUE,
    layer_metadata,
    metadata_of,
    rows_of,
    tissue_record,
)
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.result_layers import layer_on
from napari_hmrf.layers.second_picture import second_layer
from napari_hmrf.layers.slice_view import View, check_size, frame_of, plane_shape, view_of
from napari_hmrf.layers.stored_axes import stored_axes
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.results.observation import arrow_observation
from napari_hmrf.solver.volume_memory import STUDY, require_memory
from napari_hmrf.study.session import BRIGHTNESS, ImageChoice, Part, Session
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve, first_curve

#: Value of `ImageChoice.confidence`: the confidence is 1 at edges in the image, and 0 elsewhere.
EDGES = "edges"
#: Largest shear angle of pixels that are treated as rectangles without a note, in degrees.
_RIGHT_ANGLE = 0.1
#: Largest displacement out of the slice that is ignored without a note, in pixels.
_NEGLIGIBLE = 0.1
#: Largest number of arrows in a layer; a larger number of observations is stored as a field.
_MOST_ARROWS = 2000
#: Attributes of a `Request` that define each part of a study.
_FIELDS: dict[str, tuple[str, ...]] = {
    "motion": ("boundary", "rules", "confidence"),
    "tissue": ("tissue", "materials", "curve"),
}


@dataclass(frozen=True, kw_only=True)
class Request(ImageChoice):
    """Choices for an image, with its tables, its curve, its drawing and the visible slice.

    Attributes
    ----------
    image : napari.layers.Image, optional
        Image to deform. Its grid is the reference; without an image, the grid of `tissue` is used.
    materials : tuple of Material, optional
        Materials of the tissue labels; by default, those in the metadata of the tissue layer.
    rules : tuple of BoundaryRule, optional
        Rules of the boundary labels, with lengths in the unit of the image; by default, those in
        the metadata of the boundary layer.
    view : View, optional
        Visible slice; by default, the first slice along the last two axes.
    drawing : Drawing, optional
        Drawn and painted marks, which take precedence; None if there is no drawing.
    curve : StiffnessCurve, optional
        Curve from the intensity of `image` to stiffness, used instead of `tissue`.
    """

    without_border: bool = False
    hold_edge: bool = False
    image: Any = None
    materials: tuple[Material, ...] | None = None
    rules: tuple[BoundaryRule, ...] | None = None
    view: View | None = None
    drawing: Drawing | None = None
    curve: StiffnessCurve | None = None

    @classmethod
    def of(cls, session: Session, view: View) -> Request:
        """Return the request for the image that is selected in a session.

        Parameters
        ----------
        session : Session
        view : View
            Visible slice.
        """
        choice = session.choice
        tissue, boundary = choice.tissue_layer, choice.boundary
        materials = None if tissue is None else session.table(TISSUE, tissue)
        rules = None if boundary is None else session.table(BOUNDARY, boundary)
        chosen = {**vars(choice), "tissue": tissue}
        if not isinstance(boundary, Vectors):
            chosen["confidence"] = None
        return cls(
            image=session.image,
            materials=None if materials is None else materials.rows,
            rules=None if rules is None else rules.rows,
            view=view,
            drawing=session.drawing,
            curve=session.curve if choice.tissue == BRIGHTNESS else None,
            **chosen,
        )

    @property
    def grid_layers(self) -> tuple[Any, ...]:
        """Layers that must have the same grid; the first layer is the reference."""
        arrows = None if holds_field(self.boundary) else self.boundary
        chosen = (self.image, self.tissue, arrows, self.confidence)
        return tuple(layer for layer in chosen if isinstance(layer, Layer))


def study_from_layers(request: Request, copies: LayerCopies | None = None) -> Study:
    """Create a study from the visible slices of the selected layers.

    This function is called on the GUI thread, so it must be fast.

    Parameters
    ----------
    request : Request
    copies : LayerCopies, optional
        Cache with copies of unchanged layers.

    Raises
    ------
    ProblemError
        If the place or size of a layer differs from that of the reference, or the layer cannot be
        read; the message names the layer.
    """
    return _Reader(request, copies or LayerCopies()).study()


class _Reader:
    """Reader for the layers of a request."""

    def __init__(self, request: Request, copies: LayerCopies) -> None:
        self._request = request
        self._copies = copies
        self._reference = reference = request.grid_layers[0]
        self._frame = frame_of(reference, request.view)
        self._shape = plane_shape(reference, self._frame)
        with naming(image=reference):
            require_memory(self._shape, STUDY)
        self._notes: list[str] = []
        if (skew := self._frame.skew) > _RIGHT_ANGLE:
            sheared = f"the pixels are sheared by {skew:.1f} degrees, but treated as rectangles"
            self._notes.append(sheared)
        self._note_stored_axes()
        if request.view is not None and request.view.tilts(self._frame):
            self._notes.append(
                f"napari cannot display '{reference.name}' tilted relative to the slice plane, so "
                "the displayed positions are approximate; directions, lengths and saved files are "
                "exact"
            )
        if any(layer.multiscale for layer in request.grid_layers):
            self._notes.append(f"computed on the finest level, {grid_in_words(self._shape)}")

    def _note_stored_axes(self) -> None:
        """Note what the file of the reference states about its axes, which napari ignores."""
        reference, plane = self._reference, self._frame.plane
        contents, sizes, unit = stored_axes(reference)
        content = contents[plane[0]] if contents and len(plane) == 3 else ""
        if content:
            raise LayerError(
                reference,
                f"is a stack of {self._shape[0]} {content}, not a volume. Choose one of its slices "
                "instead of the volume.",
            )
        if not sizes:
            return
        seen = [sizes[axis] for axis in plane]
        if not has_same_spacing(self._shape, seen, unit, seen[:1] * len(seen), unit):
            raise LayerError(
                reference,
                f"has pixels of {grid_in_words(seen)} {unit} in its file, but napari shows them "
                f"with equal sides. Set its scale in the console: layer.scale = {sizes}; "
                f"layer.units = ({unit!r},) * {len(sizes)}",
            )
        self._notes.append(
            f"lengths are in pixels: the file of '{reference.name}' states pixels of "
            f"{grid_in_words(seen)} {unit}"
        )

    def study(self) -> Study:
        request, frame, reference = self._request, self._frame, self._reference
        image = None if request.image is None else self._slice(request.image)
        tissue, motion = self._tissue(), replace(self._motion(), **request.conditions)
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
        """Return the pixels of a layer, which must be on the grid of the reference layer."""
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
        unit = str(metadata_of(layer).get("unit", ""))
        if isinstance(layer, Labels):
            rows = request.materials
            rows = rows_of(layer, TISSUE) if rows is None else tuple(rows)
            return Tissue(
                labels=self._slice(layer),
                materials=rows,
                preset=request.preset,
                unit=unit,
                record=tissue_record(layer, rows),
                without_border=request.without_border,
            )
        if layer.rgb:
            raise LayerError(
                layer,
                "is a colour image, but stiffness requires one value per pixel. Choose a Labels "
                "layer or a grey image.",
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
            observed, confidence = self._observed(layer)
            return Motion(observed=observed, confidence=confidence, drawing=drawing)
        if layer is None:
            return Motion(drawing=drawing)
        labels = self._slice(layer)
        if request.drawing is None and not labels.any():
            slice_name = frame_of(layer, request.view).slice_seen
            raise LayerError(
                layer,
                f"has no paint{f' in {slice_name}' if slice_name else ' yet'}. Choose a row, then "
                "paint a region that is fixed or moved.",
            )
        rules = request.rules
        rules = rows_of(layer, BOUNDARY) if rules is None else tuple(rules)
        return Motion(labels=labels, rules=rules, drawing=drawing)

    def _observed(self, layer: Any) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the displacements of an arrow layer or a field layer, and their confidence."""
        request, frame, shape = self._request, self._frame, self._shape
        data, confidence, field = self._copies.of(layer), self._read_confidence(), field_of(layer)
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
            c = np.where(known, 1 if confidence is None else confidence, 0).astype(np.float32)
            if known.any() and not c.any():
                raise LayerError(
                    request.confidence,
                    f"is 0 wherever '{layer.name}' has a displacement, so no displacement is used. "
                    "Paint where displacements are certain, or choose ----- in 'confidence'.",
                )
            return y, np.repeat(c[..., None], len(shape), axis=-1), out, note

        of = (data, confidence, own, frame.spacing, shape, *(field or ()))
        y, c, out, note = self._copies.derive(layer, of, observe)
        if note:
            self._notes.append(f"'{layer.name}' {note}")
        if out > (0 if field is None else _NEGLIGIBLE * max(frame.spacing)):
            self._notes.append(
                f"'{layer.name}' also has displacements out of the slice, which are ignored"
            )
        return y, c

    def _read_confidence(self) -> npt.NDArray[Any] | None:
        """Return the confidence of the observed displacements."""
        chosen, image = self._request.confidence, self._request.image
        if chosen is None:
            return None
        if isinstance(chosen, Layer):
            pixels = self._slice(chosen)
            if isinstance(chosen, Labels):
                return self._copies.derive(chosen, (pixels,), lambda: pixels > 0)
            if pixels.ndim != len(self._shape):
                raise LayerError(
                    chosen, "is a colour image. Choose a grey image with values from 0 to 1."
                )
            return pixels
        if image is None:
            raise LayerError(
                self._reference, "is not an image, so it has no edges. Choose an image."
            )
        pixels = self._slice(image)
        return self._copies.derive(
            image, (pixels,), lambda: edge_confidence(pixels, axes=len(self._shape))
        )


def look_of(layer: Any) -> dict[str, Any]:
    """Return the display settings of an Image or Labels layer, as arguments for a new layer."""
    if layer is None or getattr(layer, "rgb", False):
        return {}
    if isinstance(layer, Labels):
        return {"colormap": layer.colormap, "opacity": layer.opacity}
    return {
        "colormap": layer.colormap,
        "contrast_limits": tuple(layer.contrast_limits),
        "gamma": layer.gamma,
    }


def study_layers(study: Study, second: SecondPicture | None = None) -> dict[str, Any]:
    """Create the layers of a study; the inverse of `study_from_layers`.

    If the study has no place in world coordinates, the layers are at the origin. The drawing, the
    model and the conditions are not converted to layers.

    Parameters
    ----------
    study : Study
    second : SecondPicture, optional
        Second image on the grid of the study.

    Returns
    -------
    dict of str to napari.layers.Layer
        Layers in stacking order, with the keys "image", "second", "tissue", "boundary" and
        "confidence"; the keys of parts that the study lacks are omitted.
    """
    grid, tissue, motion, pictures = study.grid, study.tissue, study.motion, study.pictures
    n = len(grid.shape)
    frame = grid.place or Frame.at(grid.spacing, (grid.unit,) * n, volume=n == 3)
    layers: dict[str, Any] = {}
    # Tissue and boundary layers would tint the deformed image.
    visible = "image" if pictures.image is not None else "tissue"

    def add(
        part: str, name: str, data: Any, look: Mapping[str, Any], sort: str = "image", **what: Any
    ) -> None:
        """Create the layer of a part, with its name in the study or the default `name`."""
        name = study.names.get(part, name)
        known = layer_metadata(**what)[METADATA] if what else {}
        if frame.file_axes:
            known = {**known, FILE_AXES: frame.file_axes}
        look = {**look, "visible": not study.moves or part == visible}
        layers[part] = Layer.create(*layer_on(frame, data, name, known, look, sort))

    if pictures.image is not None:
        add("image", pictures.name or "image", pictures.image, pictures.look, role=IMAGE)
    if second is not None:
        layers["second"] = Layer.create(*second_layer(second, frame, layers.get("image")))
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
        confidence = motion.confidence
        confidence = confidence if confidence.ndim == n else confidence.max(axis=-1)
        starts, steps = np.argwhere(confidence > 0), motion.observed / grid.spacing
        if len(starts) > _MOST_ARROWS:
            field = Field.in_pixels(frame.put_field(steps))
            name = study.names.get("boundary", "Observed")
            place = frame.placement(image=True)
            made = field_layer(field, place, name, BOUNDARY)
            made.attributes["visible"] = not study.moves
            layers["boundary"] = Layer.create(*made)
        else:
            arrows = np.stack([starts, steps[tuple(starts.T)]], axis=1)
            add("boundary", "Observed", arrows, {}, "vectors", role=BOUNDARY)
        look = {"contrast_limits": (0, 1), "opacity": 0.3}
        add("confidence", "Confidence", confidence, look)
    return layers


class NoImageError(HmrfError):
    """There is neither an image nor tissue labels to deform."""


class StudyReader:
    """Reader of the study defined by the layers and choices of a dock.

    Layers are read again only if they have changed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    session : Session
        Session with the choices.
    settle : callable
        Called before the choices are read, so that they are all in the session.
    """

    def __init__(self, viewer: Any, session: Session, settle: Callable[[], object]) -> None:
        self._viewer, self._session, self._settle = viewer, session, settle
        self._copies: LayerCopies = shared(viewer, LayerCopies)

    def request(self) -> Request:
        """Return the current choices, with the visible slice and its drawing.

        Raises
        ------
        NoImageError
            If neither an image nor tissue labels are chosen, or if the image of the labels is gone.
        """
        self._settle()
        session = self._session
        is_painted = isinstance(session.choice.tissue_layer, Labels)
        if session.image is None and (session.image_is_gone or not is_painted):
            raise NoImageError("Choose an image, or open one (File > Open).")
        request = Request.of(session, view_of(self._viewer, session))
        return replace(request, drawing=self._session.get(_slice_of(request), Drawing()))

    def read(self, request: Request) -> Study:
        """Read the study of a request, with the chosen model and solver settings.

        Raises
        ------
        HmrfError
            If a layer cannot be read.
        """
        model = self._session.model
        study = study_from_layers(request, self._copies)
        measured = Part.of_slice("measured", request.grid_layers[0], study.grid.place)
        motion = replace(
            study.motion,
            typical_strain=model.strain,
            drift=model.drift,
            measured=self._session.get(measured),
        )
        return replace(study, motion=motion, prior=model.prior, optimizer=model.optimizer)

    def read_partly(self, last: Study | None) -> Study | None:
        """Read the selected slice, and take the parts that cannot be read from an earlier study.

        Parameters
        ----------
        last : Study or None
            Last study that was read, with the current drawing of the selected slice.

        Returns
        -------
        Study or None
            None if the image cannot be read, and there is no earlier study.
        """
        try:
            request = self.request()
            if _slice_of(request) != self._session.slice:
                return last  # a slice is displayed that could not be selected
        except Exception:  # noqa: BLE001 - a layer may raise anything
            return last
        for without in ((), ("motion",), ("tissue",), ("motion", "tissue")):
            left: dict[str, Any] = {name: None for part in without for name in _FIELDS[part]}
            some = replace(request, **left)
            if not some.grid_layers:
                continue
            try:
                study = self.read(some)
            except Exception:  # noqa: BLE001 - a layer may raise anything
                continue
            if without and last is not None and last.grid == study.grid:
                if "tissue" in without:
                    study = replace(study, tissue=last.tissue, pictures=last.pictures)
                if "motion" in without:
                    study = replace(study, motion=last.motion)
                study = replace(study, names={**last.names, **study.names})
            return study
        return last

    def first_curve(self) -> StiffnessCurve:
        """Return a first guess of the curve that maps the brightness of the slice to stiffness.

        Raises
        ------
        HmrfError
            If the slice cannot be read, or if all its pixels have the same value.
        """
        image, view = self._session.image, view_of(self._viewer, self._session)
        study = self.read(Request(image=image, view=view, drawing=Drawing()))
        assert study.intensities is not None
        return first_curve(study.intensities)

    def invalidate(self) -> None:
        """Discard all layer copies, because a script may have changed an array in place."""
        self._copies.invalidate()


def _slice_of(request: Request) -> Part:
    """Return the key of the drawing of a request."""
    layer = request.grid_layers[0]
    return Part.of_slice("drawing", layer, frame_of(layer, request.view))
