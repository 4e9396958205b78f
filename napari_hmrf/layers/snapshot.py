"""Copies of what the user chose, taken at once; what they mean is found out later, elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels, Points, Shapes, Vectors

from napari_hmrf.layers.landmarks import LandmarkLayers, Landmarks, read_landmarks
from napari_hmrf.layers.metadata import tissue_record
from napari_hmrf.layers.pixel_copy import check_place, nearest_paint, plane_shape, take_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import Pictures
from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.layer_names import LayerError, Named
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

#: Pixels sheared by less than this many degrees pass for rectangles.
_RIGHT_ANGLE = 0.1


@dataclass(frozen=True)
class Request:
    """What the user chose: layers, tables, and the slice that was shown.

    Attributes
    ----------
    tissue : napari.layers.Labels or napari.layers.Image
        Labels, each with a stiffness in `materials`; or the stiffness itself.
    boundary : napari.layers.Labels or napari.layers.Vectors, optional
        Labels, each with a rule in `rules`; or the observed displacements as arrows. May be left
        out where there are `landmarks`.
    image : napari.layers.Image, optional
        The picture to deform; its place is the reference, else that of `tissue`.
    materials : tuple of Material
    rules : tuple of BoundaryRule
        Lengths in the unit of the image.
    confidence : napari.layers.Image, optional
        With arrows: how sure each is, 0 to 1; by default 1.
    view : View, optional
        Which slice; by default the first, of the last two axes.
    landmarks : LandmarkLayers, optional
        Two Points layers, or lines, which count on top of the boundary.
    """

    tissue: Any
    boundary: Any = None
    image: Any = None
    materials: tuple[Material, ...] = ()
    rules: tuple[BoundaryRule, ...] = ()
    confidence: Any = None
    view: View | None = None
    landmarks: LandmarkLayers | None = None

    @property
    def layers(self) -> tuple[Any, ...]:
        """The layers that are there, the reference first."""
        pairs = self.landmarks
        points = () if pairs is None else (pairs.where, pairs.should)
        chosen = (self.image, self.tissue, self.boundary, self.confidence, *points)
        return tuple(layer for layer in chosen if layer is not None)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The slice of every layer as it was, and both tables; no layer is kept.

    Attributes
    ----------
    frame : Frame
        Where the slice lies.
    tissue, boundary : ndarray, shape (H, W)
        Labels or stiffness; labels, or arrows (N, 2, D) in the layer's own pixels.
    tissue_labelled, boundary_labelled : bool
        Whether those are labels.
    tissue_name, boundary_name, reference_name : Named
    boundary_frame : Frame
        The boundary's own, to find its arrows of this slice.
    pictures : Pictures
        The slices of the image and of the tissue labels, to be deformed.
    confidence : ndarray, shape (H, W), optional
    confidence_name : Named, optional
    image_name : Named, optional
    materials, rules : tuple
    record : dict
        What made the tissue, as `tissue_record` says it; of no consequence for the result.
    notes : tuple of str
        What the user should know about how the layers were read.
    landmarks : Landmarks, optional
    """

    frame: Frame
    tissue: npt.NDArray[Any]
    boundary: npt.NDArray[Any]
    tissue_labelled: bool
    boundary_labelled: bool
    tissue_name: Named
    boundary_name: Named
    reference_name: Named
    boundary_frame: Frame
    pictures: Pictures
    confidence: npt.NDArray[Any] | None = None
    confidence_name: Named | None = None
    image_name: Named | None = None
    materials: tuple[Material, ...] = ()
    rules: tuple[BoundaryRule, ...] = ()
    record: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    landmarks: Landmarks | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.tissue.shape[0]), int(self.tissue.shape[1])

    def same_as(self, other: Snapshot) -> bool:
        """Whether a solve of the other would give the same result."""
        pairs = [
            (self.tissue, other.tissue),
            (self.boundary, other.boundary),
            (self.confidence, other.confidence),
            (self.pictures.image, other.pictures.image),
        ]
        return (
            (self.frame, self.materials, self.rules) == (other.frame, other.materials, other.rules)
            and self.tissue_labelled == other.tissue_labelled
            and self.boundary_labelled == other.boundary_labelled
            and _marks(self.landmarks) == _marks(other.landmarks)
            and all(_equal(mine, its) for mine, its in pairs)
        )


def copy_layers(request: Request) -> Snapshot:
    """Copy the slice that is shown out of every layer; quick, for the window waits for it.

    Raises
    ------
    ProblemError
        Naming the layer that lies elsewhere, is of another size or cannot be read.
    """
    reference = request.layers[0]
    frame = Frame.of(reference, request.view)
    shape = plane_shape(reference, frame)
    tissue, boundary, image = request.tissue, request.boundary, request.image
    placed = [layer for layer in request.layers if not isinstance(layer, Points | Shapes)]
    frames = {
        id(layer): frame if layer is reference else Frame.of(layer, request.view)
        for layer in placed
    }
    taken = {
        id(layer): take_slice(layer, frames[id(layer)], reference, frame, shape)
        for layer in placed
        if not isinstance(layer, Vectors)
    }
    labelled = isinstance(tissue, Labels)
    if not labelled and tissue.rgb:
        raise LayerError(
            tissue,
            "is a colour image, which cannot be a stiffness. Choose a Labels layer or a grey "
            "image.",
        )
    pairs, landmarks = request.landmarks, None
    if pairs is not None:
        landmarks = read_landmarks(pairs, frame, shape, request.view)
    if boundary is None:
        if landmarks is None:
            raise LayerError(reference, "has no boundary. Choose a boundary layer, or landmarks.")
        own, observed, named = frame, np.zeros(shape, np.uint8), landmarks.layer
    elif isinstance(boundary, Vectors):
        own, observed = frames[id(boundary)], np.array(boundary.data, dtype=float)
        named = Named.of(boundary)
        check_place(boundary, own, reference, frame, shape)
    else:
        own, observed, named = frames[id(boundary)], taken[id(boundary)], Named.of(boundary)
        if landmarks is None and not observed.any():
            _refuse_unpainted(boundary, own)
    return Snapshot(
        frame=frame,
        tissue=taken[id(tissue)],
        boundary=observed,
        tissue_labelled=labelled,
        boundary_labelled=boundary is None or isinstance(boundary, Labels),
        tissue_name=Named.of(tissue),
        boundary_name=named,
        reference_name=Named.of(reference),
        boundary_frame=own,
        pictures=Pictures(
            image=None if image is None else taken[id(image)],
            labels=taken[id(tissue)] if labelled else None,
            name=str(reference.name),
            labels_name=str(tissue.name),
            look=look_of(image),
            labels_look=look_of(tissue) if labelled else {},
            level=0 if any(_multiscale(layer) for layer in request.layers) else None,
        ),
        confidence=None if request.confidence is None else taken[id(request.confidence)],
        confidence_name=None if request.confidence is None else Named.of(request.confidence),
        image_name=None if image is None else Named.of(image),
        materials=tuple(request.materials),
        rules=() if boundary is None else tuple(request.rules),
        record=tissue_record(tissue, request.materials if labelled else ()),
        notes=_notes(request, frames, shape) + (landmarks.notes if landmarks else ()),
        landmarks=landmarks,
    )


def _refuse_unpainted(boundary: Any, own: Frame) -> None:
    """Say where there is paint, if not here."""
    elsewhere = nearest_paint(boundary, own)
    if elsewhere:
        raise LayerError(
            boundary,
            f"has no paint in {own.slice_said}; paint here or go to {elsewhere}.",
        )
    raise LayerError(
        boundary,
        "is not painted yet.",
        f"Nothing is painted in '{boundary.name}' yet: choose a row, then paint a wall or "
        "something that moves.",
    )


def look_of(layer: Any) -> dict[str, Any]:
    """How an Image or Labels layer is drawn, as a new layer takes it."""
    if layer is None:
        return {}
    if isinstance(layer, Labels):
        return {"colormap": layer.colormap, "opacity": layer.opacity}
    if layer.rgb:
        return {}
    return {
        "colormap": layer.colormap,
        "contrast_limits": tuple(layer.contrast_limits),
        "gamma": layer.gamma,
    }


def _notes(request: Request, frames: dict[int, Frame], shape: tuple[int, int]) -> tuple[str, ...]:
    notes = []
    if request.tissue is request.boundary:
        notes.append(
            f"'{request.tissue.name}' is both the tissue and the boundary: choose another layer "
            "for one of them, unless that is meant"
        )
    frame = frames[id(request.layers[0])]
    if frame.skew > _RIGHT_ANGLE:
        notes.append(
            f"the pixels are sheared by {frame.skew:.1f} degrees, but were taken as rectangles"
        )
    if any(_multiscale(layer) for layer in request.layers):
        notes.append(f"computed on the finest level, {shape[0]} x {shape[1]}")
    notes += [
        f"of '{layer.name}' {frames[id(layer)].slice_said} was taken"
        for layer in request.layers[1:]
        if id(layer) in frames and frames[id(layer)].ndim > frame.ndim
    ]
    return tuple(notes)


def _multiscale(layer: Any) -> bool:
    return bool(getattr(layer, "multiscale", False))


def _marks(landmarks: Landmarks | None) -> Any:
    return None if landmarks is None else landmarks.marks


def _equal(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f" and other.dtype.kind == "f")
