"""Layers and tables become a problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels, Vectors
from scipy import ndimage

from napari_hmrf.annotation import BoundaryRule, Material, boundary_images, stiffness_image
from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.observations import arrow_observations
from napari_hmrf.layers.outputs import Pictures
from napari_hmrf.layers.reading import check_place, naming, plane_shape, take_slice
from napari_hmrf.layers.view import View, describe
from napari_hmrf.problem import Problem

FloatArray = npt.NDArray[np.float32]

#: Pixels sheared by less than this many degrees pass for rectangles.
_RIGHT_ANGLE = 0.1


@dataclass(frozen=True)
class Request:
    """What the user chose: layers, tables, and the slice that was shown.

    Attributes
    ----------
    tissue : napari.layers.Labels or napari.layers.Image
        Labels, each with a stiffness in `materials`; or the stiffness itself.
    boundary : napari.layers.Labels or napari.layers.Vectors
        Labels, each with a rule in `rules`; or the observed displacements as arrows.
    image : napari.layers.Image, optional
        The picture to deform; its place is the reference, else that of `tissue`.
    materials : tuple of Material
    rules : tuple of BoundaryRule
        Lengths in the unit of the image.
    confidence : napari.layers.Image, optional
        With arrows: how sure each is, 0 to 1; by default 1.
    view : View, optional
        Which slice; by default the first, of the last two axes.
    """

    tissue: Any
    boundary: Any
    image: Any = None
    materials: tuple[Material, ...] = ()
    rules: tuple[BoundaryRule, ...] = ()
    confidence: Any = None
    view: View | None = None

    @property
    def layers(self) -> tuple[Any, ...]:
        """The layers that are there, the reference first."""
        chosen = (self.image, self.tissue, self.boundary, self.confidence)
        return tuple(layer for layer in chosen if layer is not None)


@dataclass(frozen=True, eq=False)
class Inputs:
    """Copies of everything a solve needs, which no later painting changes.

    Attributes
    ----------
    problem : Problem
    frame : Frame
        Where the slice lies.
    pictures : Pictures
        The slices of the image and of the tissue labels, to be deformed.
    ignored : int
        Boundary pixels painted where there is no tissue.
    notes : tuple of str
        What the user should know about how the layers were read.
    """

    problem: Problem
    frame: Frame
    pictures: Pictures
    ignored: int = 0
    notes: tuple[str, ...] = ()

    def same_as(self, other: Inputs) -> bool:
        """Whether a solve of the other would have given the same result."""
        pairs = [
            (self.problem.y, other.problem.y),
            (self.problem.c, other.problem.c),
            (self.problem.m, other.problem.m),
            (self.pictures.image, other.pictures.image),
            (self.pictures.labels, other.pictures.labels),
        ]
        return self.frame == other.frame and all(_equal(mine, its) for mine, its in pairs)


def read_layers(request: Request) -> Inputs:
    """Turn layers and tables into a problem; the one way to do so.

    Parameters
    ----------
    request : Request

    Returns
    -------
    Inputs
        Copies; no layer is kept or changed.

    Raises
    ------
    ProblemError
        Naming the layer, what is wrong with it and what to do.
    """
    reference = request.layers[0]
    frame = Frame.of(reference, request.view)
    height, width = plane_shape(reference, frame)
    frames = {
        id(layer): frame if layer is reference else Frame.of(layer, request.view)
        for layer in request.layers
    }
    notes = _notes(request, frame, (height, width))
    notes += tuple(
        f"of '{layer.name}' the slice {frames[id(layer)].slice_name} was taken"
        for layer in request.layers[1:]
        if frames[id(layer)].ndim > frame.ndim
    )
    taken = {
        id(layer): take_slice(layer, frames[id(layer)], reference, frame, (height, width))
        for layer in request.layers
        if not isinstance(layer, Vectors)
    }
    image = None if request.image is None else taken[id(request.image)]
    if image is not None:
        notes += _check_picture(request.image, image)
    with naming(m=request.tissue):
        labelled = isinstance(request.tissue, Labels)
        tissue = taken[id(request.tissue)]
        if not labelled and request.tissue.rgb:
            raise ProblemError(
                "m",
                "is a colour image, which cannot be a stiffness. Choose a Labels layer or a grey "
                "image.",
            )
        m = stiffness_image(tissue, request.materials) if labelled else tissue
        if not labelled:
            notes += _check_digits(request.tissue, tissue)
    named = {"m": request.tissue, "y": request.boundary, "spacing": reference}
    with naming(**named, c=request.confidence or request.boundary):
        if isinstance(request.boundary, Labels):
            y, c = boundary_images(taken[id(request.boundary)], request.rules, frame.spacing)
        else:
            own = frames[id(request.boundary)]
            y, c, out = _observed(request, own, frame, (height, width), taken)
            if out:
                what = "1 arrow points" if out == 1 else f"{out} arrows point"
                notes += (f"{what} straight out of the slice and did not count",)
        problem = Problem(y, c, m, frame.spacing)
    ignored = int(((problem.c > 0).any(axis=-1) & ~problem.tissue).sum())
    return Inputs(
        problem=problem,
        frame=frame,
        pictures=Pictures(
            image=image,
            labels=tissue if labelled else None,
            name=str(reference.name),
            labels_name=str(request.tissue.name),
            look=_look(request.image),
            labels_look=_look(request.tissue) if labelled else {},
            level=0 if any(_multiscale(layer) for layer in request.layers) else None,
        ),
        ignored=ignored,
        notes=(*notes, *_loose_pieces(problem)),
    )


def _look(layer: Any) -> dict[str, Any]:
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


def _notes(request: Request, frame: Frame, shape: tuple[int, int]) -> tuple[str, ...]:
    notes = []
    if frame.skew > _RIGHT_ANGLE:
        notes.append(
            f"the pixels are sheared by {frame.skew:.1f} degrees, but were taken as rectangles"
        )
    if any(_multiscale(layer) for layer in request.layers):
        notes.append(f"computed on the finest level, {shape[0]} x {shape[1]}")
    return tuple(notes)


def _multiscale(layer: Any) -> bool:
    return bool(getattr(layer, "multiscale", False))


def _check_picture(layer: Any, picture: npt.NDArray[Any]) -> tuple[str, ...]:
    """Refuse a picture of nothing; count the holes of another."""
    if picture.dtype.kind != "f":
        return ()
    bad = int((~np.isfinite(picture)).sum())
    if bad == picture.size:
        raise ProblemError(
            describe(layer), "is NaN everywhere in this slice. Choose another image or slice."
        )
    return (f"{bad} pixels of '{layer.name}' are NaN or infinite",) if bad else ()


def _check_digits(layer: Any, stiffness: npt.NDArray[Any]) -> tuple[str, ...]:
    """Say so where single precision, which the solver works in, rounds whole numbers."""
    if stiffness.dtype.kind not in "iu":
        return ()
    # Bit by bit: no float holds all 64-bit integers to compare with.
    whole = np.maximum(stiffness, 1).astype(np.uint64)
    lowest_bit = whole & (~whole + np.uint64(1))
    rounded = int((whole // lowest_bit > 2**24).sum())
    if not rounded:
        return ()
    return (f"{rounded} whole numbers of '{layer.name}' above 2^24 were rounded",)


def _observed(
    request: Request,
    own: Frame,
    frame: Frame,
    shape: tuple[int, int],
    taken: dict[int, npt.NDArray[Any]],
) -> tuple[FloatArray, FloatArray, int]:
    check_place(request.boundary, own, request.layers[0], frame, shape)
    y, c, out = arrow_observations(request.boundary, own, frame.spacing, shape)
    if request.confidence is not None:
        if request.confidence.rgb:
            raise ProblemError("c", "is a colour image. Choose a grey image of values 0 to 1.")
        sure = taken[id(request.confidence)].astype(np.float32)
        c = np.where(c > 0, sure[..., None], np.float32(0))
    return y, c, out


def _loose_pieces(problem: Problem) -> tuple[str, ...]:
    """Say so where tissue hangs on nothing that was observed."""
    pieces, count = ndimage.label(problem.tissue, structure=np.ones((3, 3)))
    held = np.unique(pieces[(problem.c > 0).any(axis=-1)])
    loose = count - int((held > 0).sum())
    if not loose:
        return ()
    pixels = int((problem.tissue & ~np.isin(pieces, held)).sum())
    what = "a piece of tissue touches" if loose == 1 else f"{loose} pieces of tissue touch"
    return (f"{what} no boundary ({pixels} pixels): how it moves is not determined",)


def _equal(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f" and other.dtype.kind == "f")
