"""The tissue that is drawn on: an image, where it is tissue, and what holds it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels
from scipy import ndimage

from napari_hmrf.layers.arrow_layer import NAME as ARROWS
from napari_hmrf.layers.background import background_of, surrounds
from napari_hmrf.layers.label_defaults import default_material, default_rule
from napari_hmrf.layers.landmarks import usual_radius, usual_step
from napari_hmrf.layers.layer_names import LayerError, Named, naming
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, known_of, rows_of
from napari_hmrf.layers.palette import OTHER, Palette
from napari_hmrf.layers.pixel_copy import copy_slice, plane_shape, take_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import Pictures
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.snapshot import look_of
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.unconnected import scraps
from napari_hmrf.tissue.boundary_rules import (
    Material,
    boundary_images,
    poisson_image,
    stiffness_image,
)
from napari_hmrf.tissue.drawing import Canvas
from napari_hmrf.tissue.labels import labels_present
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.normals import outer_rim

FloatArray = npt.NDArray[np.float32]

#: Stiffness of what is in the picture and of its dark surroundings, where nothing is painted: soft
#: enough to hinder nothing, and still tissue, so that there always is something that holds.
_TISSUE, _SURROUNDINGS = 1.0, 0.01
#: K of eq. 19 where some confidence is below 1: what is held with confidence c slips where it would
#: take more than what strains the stiffest tissue by c.
_PENALTY = 1.0
#: K of what is certain beside it: no tissue takes as much, so that it is held exactly.
_FIRM = 1e4


@dataclass(frozen=True, eq=False)
class Ground:
    """What a drawing is drawn on; copies, which no later painting changes.

    Attributes
    ----------
    frame : Frame
        Where the slice lies.
    base : Canvas
        What is held without a drawing.
    stiffness : ndarray, shape (H, W), float32
        Young's modulus; 0 is no tissue, infinity is rigid.
    prior : Prior
        The energy, with the tissues' own Poisson's ratios.
    pictures : Pictures
        The slice of the image, to be deformed.
    body : ndarray of bool, shape (H, W)
        Where there is tissue that is no dark surroundings.
    pieces : ndarray of int, shape (H, W)
        Numbers of the connected pieces of tissue, from 1.
    palette : Palette
        The tissues that can be painted; the labels of `base` are theirs.
    named : Named
        What says where there is tissue: the tissue layer, or the image.
    """

    frame: Frame
    base: Canvas
    stiffness: FloatArray
    prior: Prior
    pictures: Pictures
    body: npt.NDArray[np.bool_]
    pieces: npt.NDArray[Any]
    palette: Palette
    named: Named

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.base.shape

    @cached_property
    def _pieces_there(self) -> int:
        return int(self.pieces.max())

    @property
    def usual_radius(self) -> float:
        """A radius to take hold of tissue with, in the unit of the frame's spacing."""
        return usual_radius(self.shape, self.frame.spacing)

    @property
    def usual_step(self) -> float:
        """How far a brush moves tissue to begin with, in the unit of the frame's spacing."""
        return usual_step(self.shape, self.frame.spacing)

    def same_as(self, other: Ground) -> bool:
        """Whether a drawing moves the same tissue in the same way on the other."""
        picture, its = self.pictures.image, other.pictures.image
        assert picture is not None
        assert its is not None
        return (
            self.frame == other.frame
            and self.prior == other.prior
            and self.palette == other.palette
            and np.array_equal(self.stiffness, other.stiffness)
            and np.array_equal(self.base.confidence, other.base.confidence)
            and np.array_equal(self.base.observed, other.base.observed)
            and np.array_equal(picture, its, equal_nan=picture.dtype.kind == "f")
        )

    def problem(self, canvas: Canvas, tissue_painted: bool = False) -> tuple[Problem, Prior]:
        """The problem of a drawing, and its energy.

        Tissue that nobody holds anywhere stays out of it, and where it is; so do scraps that could
        turn where they hang. What is not certain may slip, and nothing else.

        Parameters
        ----------
        canvas : Canvas
            The drawing on top of `base`.
        tissue_painted : bool
            Whether its labels may be others.

        Raises
        ------
        ProblemError
            If nothing is held.
        """
        m, prior, pieces, count = self.stiffness, self.prior, self.pieces, self._pieces_there
        if tissue_painted and canvas.labels is not None and self.base.labels is not None:
            m, prior = self.palette.painted(canvas.labels, self.base.labels, m, prior)
            if ((m > 0) != (self.stiffness > 0)).any():
                pieces, count = _pieces_of(m > 0)
        if count > 1:
            held = (canvas.confidence > 0).any(axis=-1)
            touched = np.zeros(count + 1, dtype=bool)
            touched[pieces[held]] = True
            touched[0] = False
            if touched.any() and not touched[1:].all():
                m = np.where(touched[pieces], m, np.float32(0))
        if isinstance(prior, ElasticPrior):
            scrap = scraps(m > 0, canvas.confidence > 0)
            if scrap.any():
                m = np.where(scrap, np.float32(0), m)
        exact = isinstance(prior, ElasticPrior) and prior.penalty == math.inf
        c = canvas.confidence
        if exact and ((c > 0) & (c < 1)).any():
            if np.isinf(m).any():
                raise LayerError(
                    self.named,
                    "has rigid tissue, beside which nothing may slip. Give all that is drawn or "
                    "painted a confidence of 1, or that tissue a number.",
                )
            prior = replace(prior, penalty=_FIRM)
            c = np.where(c < 1, np.float32(_PENALTY / _FIRM) * c, c)
        return Problem(canvas.observed, c, m, spacing=self.frame.spacing), prior

    def in_words(self, error: Exception | None) -> Exception | None:
        """What is wrong with a problem, said of the layers a person sees."""
        drawn = Named(ARROWS, "Vectors layer")
        try:
            with naming(
                stiffness=self.named,
                poisson=self.named,
                observed=drawn,
                confidence=drawn,
                spacing=self.named,
            ):
                if error is not None:
                    raise error
        except Exception as named:  # noqa: BLE001 - that is what is wanted
            return named
        return None


def read_ground(
    image: Any,
    tissue: Any = None,
    boundary: Any = None,
    view: View | None = None,
    hold_edge: bool = True,
    prior: Prior | None = None,
    preset: Preset | None = None,
) -> Ground:
    """Copy the slice that is shown out of an image and a tissue layer.

    Parameters
    ----------
    image : napari.layers.Image
    tissue : napari.layers.Labels or napari.layers.Image, optional
        Labels, with a table of materials in the layer's metadata, or the stiffness itself. Without
        it all that is in the picture is tissue of one stiffness, and its dark surroundings, if it
        has any, are a hundred times softer.
    boundary : napari.layers.Labels, optional
        What is painted to hold or to move, with a table of rules in the layer's metadata; drawings
        come on top of it.
    view : View, optional
        Which slice; by default the first, of the last two axes.
    hold_edge : bool
        Whether the outer edge of the tissue stays where it is: its pixels beside what is no tissue
        or the surroundings, and at the edge of the image. Holes in it are free.
    prior : Prior, optional
        By default elastic tissue.
    preset : Preset, optional
        The tissues that can be painted where the layer has no table of its own; by default the
        first of the presets.

    Returns
    -------
    Ground

    Raises
    ------
    ProblemError
        Naming the layer, what is wrong with it and what to do.
    """
    frame = Frame.of(image, view)
    shape = plane_shape(image, frame)
    picture = copy_slice(image, frame)
    prior = prior or ElasticPrior()
    if tissue is None:
        around = _surroundings(picture)
        m = np.where(around, np.float32(_SURROUNDINGS), np.float32(_TISSUE))
        palette = Palette.of_preset(preset)
        labels = np.where(around, OTHER, palette.usual)
    else:
        around = np.zeros(shape, dtype=bool)
        labels = take_slice(tissue, Frame.of(tissue, view), image, frame, shape)
        m, prior, palette = _stiffness(tissue, labels, prior, preset)
        if not palette.own:
            labels = np.full(shape, OTHER)
    there = m > 0
    body = there & ~around
    if not there.any():
        raise LayerError(
            tissue, "has no tissue in this slice: give what is tissue a stiffness above 0."
        )
    base = Canvas.blank(shape, frame.spacing, labels.astype(np.int32))
    base = replace(base, kinds=np.zeros(shape, dtype=np.uint8))
    if hold_edge:
        for part in (there, body):
            base.confidence[outer_rim(part)] = 1
    if boundary is not None:
        labels = take_slice(boundary, Frame.of(boundary, view), image, frame, shape)
        _paint_boundary(boundary, labels, base)
    pieces, _ = _pieces_of(there)
    return Ground(
        frame=frame,
        base=base,
        stiffness=m,
        prior=prior,
        pictures=Pictures(image=picture, name=str(image.name), look=look_of(image)),
        body=body,
        pieces=pieces,
        palette=palette,
        named=Named.of(image if tissue is None else tissue),
    )


def _pieces_of(there: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[Any], int]:
    """Numbers of the connected pieces of tissue, from 1, and how many there are."""
    pieces, count = ndimage.label(there, structure=np.ones((3, 3)))
    return pieces, int(count)


def _surroundings(picture: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """The dark background, where it really surrounds something."""
    dark = background_of(picture)
    return dark if surrounds(dark) else np.zeros_like(dark)


def _stiffness(
    tissue: Any, labels: npt.NDArray[Any], prior: Prior, preset: Preset | None
) -> tuple[FloatArray, Prior, Palette]:
    with naming(stiffness=tissue, poisson=tissue):
        if not isinstance(tissue, Labels):
            if labels.ndim != 2:
                raise LayerError(
                    tissue, "is a colour image. Choose a Labels layer or a grey image."
                )
            with np.errstate(over="ignore"):
                values = labels.astype(np.float32)
            # What single precision does not hold must not come out as rigid.
            known = (values >= 0) & (np.isfinite(values) | (labels == np.inf))
            if not known.all():
                raise LayerError(
                    tissue,
                    "holds values that are no stiffness. Give numbers of 0 or more, or infinity "
                    "where tissue is rigid.",
                )
            return values, prior, Palette.of_preset(preset, relative=False)
        materials = _completed(rows_of(tissue, TISSUE) or (), labels)
        if isinstance(prior, ElasticPrior):
            prior = replace(prior, poisson=poisson_image(labels, materials))
        unit = str(known_of(tissue).get("unit", ""))
        return stiffness_image(labels, materials), prior, Palette(materials, unit, own=True)


def _paint_boundary(boundary: Any, labels: npt.NDArray[Any], base: Canvas) -> None:
    """Have what is painted hold or move, over what is held already."""
    rules = list(rows_of(boundary, BOUNDARY) or ())
    listed = {0, *(rule.label for rule in rules)}
    rules += [default_rule(int(label)) for label in labels_present(labels) if label not in listed]
    with naming(observed=boundary, confidence=boundary):
        y, c = boundary_images(labels, rules, spacing=base.spacing)
    painted = (c > 0).any(axis=-1)
    base.observed[painted], base.confidence[painted] = y[painted], c[painted]


def _completed(known: Iterable[Material], labels: npt.NDArray[Any]) -> tuple[Material, ...]:
    """A table with rows for labels that it does not mention."""
    materials = list(known)
    listed = {material.label for material in materials}
    return (
        *materials,
        *(
            default_material(int(label), materials)
            for label in labels_present(labels)
            if int(label) not in listed
        ),
    )
