"""Study: all inputs of a displacement field, shared by the window, the Python API and files.

This module does not import napari or Qt. A study is immutable; an edit creates a new study that
shares the unchanged parts. Arrays are therefore compared by identity, not by value.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import KW_ONLY, InitVar, dataclass, field, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from napari_hmrf.archive import ByClass
from napari_hmrf.arguments import (
    reals,
    refuse_unless,
    require_flag,
    require_kind,
    shown,
    tuple_of,
)
from napari_hmrf.checks import PerAxis, TypicalStrain, Words, convert
from napari_hmrf.errors import ArgumentError, ProblemError, naming
from napari_hmrf.field.brightness import luminance
from napari_hmrf.field.frame import Frame, StoredFrame
from napari_hmrf.field.units import (
    UNKNOWN_UNITS,
    has_same_spacing,
    is_length,
    may_be_stiffness,
)
from napari_hmrf.real_arrays import checked_spacing, grid_in_words, whole_numbers
from napari_hmrf.solver.model_names import model_name
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.uncertain_landmarks import StrainScale
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.models import USUAL_OPTIMIZER, USUAL_PRIOR, is_by_name, parts_of
from napari_hmrf.tissue.boundary_rules import FORCES, BoundaryRule, Material, default_material
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.tissue.drawing import Drawing, Landmark, Stroke
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.tissue.tissue_maps import materials_of_maps, most_likely
from napari_hmrf.tissue.tissue_names import materials_by_name

Array = npt.NDArray[Any]
#: Display settings, which are not stored in files.
Look = Annotated[dict[str, Any], Field(exclude=True)]
_Weight = Annotated[
    tuple[()] | PerAxis, Words("a number along each axis, such as (0.01, 0), or ()")
]
#: Largest distance, in slices, between a point in a slice and the centre plane of the slice.
_IN_SLICE = 0.5 + 1e-3


@dataclass(frozen=True)
class Grid:
    """Pixel grid of all images of a study.

    Attributes
    ----------
    shape : tuple of int
        (H, W), or (D, H, W) for a volume.
    spacing : tuple of float
        Size of a pixel along each axis, in `unit`; a single number applies to all axes.
    unit : str
        Unit of all lengths, such as displacements and radii. Different names of the same unit, such
        as "mm" and "millimeter", are equivalent; `grid_of_image` returns "millimeter".
    place : Frame, optional
        Position of the pixels in the world and, for a slice, within its volume, as returned by
        `grid_of_image`. Required to export files; it does not affect the displacement. A place
        does not include the number of pixels: a grid with fewer pixels starts at the same pixel.

    Raises
    ------
    ProblemError
        If the shape or the spacing is invalid, or if the place has a different number of axes, a
        different spacing or a different unit of length.
    ArgumentError
        If the unit is not one of length.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    unit: str = "pixel"
    place: StoredFrame | None = None

    def __post_init__(self) -> None:
        axes = len(self.shape) if isinstance(self.shape, Sized) else 0
        sizes = reals(self.shape, axes)
        if axes not in (2, 3) or not all(size >= 1 and size.is_integer() for size in sizes):
            raise ProblemError(
                "grid",
                f"has shape {shown(self.shape)}. Pass the number of pixels along each axis, (H, W) "
                "or (D, H, W).",
            )
        object.__setattr__(self, "shape", tuple(map(int, sizes)))
        object.__setattr__(self, "spacing", checked_spacing(self.spacing, axes))
        require_kind(str, "unit", self.unit, '"mm"')
        refuse_unless(is_length(self.unit), "unit", self.unit, 'a unit of length, such as "mm"')
        place = self.place
        if place is None:
            return
        if not isinstance(place, Frame):
            raise ProblemError(
                "grid",
                f"has a place of type {type(place).__name__}. Pass a Frame; see grid_of_image.",
            )
        if len(place.plane) != len(self.shape):
            raise ProblemError(
                "grid",
                f"has {len(self.shape)} axes, but its place has {len(place.plane)}. Pass the place "
                "of the same slice or volume.",
            )
        # "pixel" is a known unit for a place, but an unknown unit for the grid.
        is_same_kind = (self.unit in UNKNOWN_UNITS) == (place.unit in UNKNOWN_UNITS)
        pixels, sizes = (self.shape, self.spacing, self.unit), place.spacing
        if not (is_same_kind and has_same_spacing(*pixels, sizes, place.unit)):
            raise ProblemError(
                "grid",
                f"has pixels of {grid_in_words(self.spacing)} {self.unit}, but its place has "
                f"pixels of {grid_in_words(sizes)} {place.unit}. Pass the spacing and the unit of "
                "the place, or omit the place.",
            )

    @property
    def known_place(self) -> Frame:
        """Place of a grid that is known to have a place, such as a grid read from layers."""
        assert self.place is not None
        return self.place

    def require_grid_of(self, solution: Solution, remedy: str) -> None:
        """Raise a ProblemError with a remedy if a solution has another shape, spacing or place."""
        shape, difference = solution.tissue.shape, ""
        if shape != self.shape:
            sizes = grid_in_words(self.shape), grid_in_words(shape)
            difference = f"is {sizes[0]}, but the field is {sizes[1]}"
        elif not has_same_spacing(shape, solution.spacing, solution.unit, self.spacing, self.unit):
            sizes = grid_in_words(self.spacing), grid_in_words(solution.spacing)
            difference = (
                f"has pixels of {sizes[0]} {self.unit}, but the field has pixels of {sizes[1]} "
                f"{solution.unit}"
            ).rstrip()
        elif solution.frame and self.place is not None:
            place = solution.place
            if place.ndim != self.place.ndim or not place.same_place(self.place, shape):
                difference = "is not in the same place as the field"
        if difference:
            raise ProblemError("grid", f"{difference}. {remedy}")

    def to_pixels(self, points: npt.ArrayLike, unit: str = "mm") -> npt.NDArray[np.float64]:
        """Convert the points of a landmark file to pixels of this grid.

        Parameters
        ----------
        points : array_like, shape (N, 3) or (N, 2)
            Points as returned by `read_points`: ([z,] y, x) for a volume, a slice of a volume, or a
            two-dimensional image.
        unit : str
            Unit that `read_points` returned: "mm" for positions in the patient, towards superior,
            posterior and left, as of 3D Slicer; "" for coordinates in the unit of the image, from
            its first pixel and along the axes of its file, as of BigWarp; or "pixel".

        Returns
        -------
        ndarray, shape (N, n)
            Positions in pixels, in the order of the grid's axes.

        Raises
        ------
        ProblemError
            If the grid has no place, or if points are on another slice or have too few axes.
        """
        given = np.asarray(points, dtype=np.float64)
        if self.place is None and unit != "mm":
            return given / (self.spacing if unit == "" else 1.0)
        if self.place is None:
            raise ProblemError(
                "grid",
                "has no position in the world. Pass the unit of the landmark file, as in "
                "grid.to_pixels(file.points, file.unit), or use the grid of a medical image.",
            )
        matrix = np.array(self.place.matrix)
        if unit != "mm":  # from the first pixel
            sizes = np.linalg.norm(matrix[:-1, :-1], axis=0) if unit == "" else 1.0
            matrix = np.diag([*np.broadcast_to(sizes, len(matrix) - 1), 1.0])
        if given.ndim != 2 or given.shape[1] != len(matrix) - 1:
            raise ProblemError(
                "points", f"have shape {given.shape}. Pass (N, {len(matrix) - 1}) numbers."
            )
        inside = (given - matrix[:-1, -1]) @ np.linalg.inv(matrix[:-1, :-1]).T
        others = list(self.place.others)
        apart = np.abs(inside[:, others] - np.array(self.place.index)[others]).max(initial=0.0)
        if apart > _IN_SLICE:
            raise ProblemError(
                "points",
                f"are up to {apart:.3g} slices away from the slice of the grid. Pass points on "
                "this slice.",
            )
        pixels: npt.NDArray[np.float64] = inside[:, list(self.place.plane)]
        return pixels

    def __repr__(self) -> str:
        place = "" if self.place is None else ", placed"
        sizes = f"{grid_in_words(self.spacing)} {self.unit}"
        return f"Grid({grid_in_words(self.shape)} sites of {sizes}{place})"


@dataclass(frozen=True, eq=False)
class Tissue:
    """Map of the tissue: from labels, from stiffness, from brightness, or from the image alone.

    Without labels, stiffness or a curve, all pixels are tissue of equal stiffness, except that dark
    surroundings of the image are a hundred times softer.

    Attributes
    ----------
    labels : ndarray of int, shape ([D,] H, W), optional
        Labels of the tissues; whole numbers stored as floats are converted to integers. Each
        label has a row in `materials`; without materials, all labels are equally stiff.
    materials : tuple of Material
        Materials of the labels.
    stiffness : ndarray, shape ([D,] H, W), optional
        Young's modulus; 0 in void, infinite in rigid tissue.
    curve : StiffnessCurve, optional
        Conversion of the image's intensity to stiffness.
    record : mapping
        Origin of the tissue map, in JSON types; stored with a solution.
    preset : Preset, optional
        Tissues for brushes if there is no table; by default the first preset. Only the ratios of
        their stiffnesses matter: the first tissue is as stiff as typical tissue, which has the
        median stiffness, or 1 without a stiffness or a curve. With a table, materials of strokes
        with a label that the table lacks.
    unit : str
        Unit of stiffness. It does not affect the displacement, which depends only on ratios.
    without_border : bool
        If True, dark surroundings with label 0 are void.

    Raises
    ------
    ProblemError
        If more than one of labels, stiffness and curve is given, or a label is not a whole number.
    ArgumentError
        If an attribute has an invalid type.
    """

    labels: Array | None = None
    materials: tuple[Material, ...] = ()
    stiffness: Array | None = None
    curve: StiffnessCurve | None = None
    preset: Preset | None = None
    unit: str = ""
    record: Mapping[str, Any] = field(default_factory=dict)
    without_border: bool = False

    @classmethod
    def from_maps(
        cls,
        maps: Mapping[str, npt.ArrayLike],
        materials: Mapping[str, Material | float] | Sequence[Material] | None = None,
        *,
        scale: float | None = None,
        unit: str = "",
    ) -> Tissue:
        """Create a tissue map from probability maps, for example from a segmentation.

        Each pixel is assigned its most likely tissue, or label 0 where "none" is more likely, as
        ``--maps`` does in the shell.

        Parameters
        ----------
        maps : mapping of str to array_like, shape ([D,] H, W)
            Probability map of each tissue, by name.
        materials : mapping of str to Material or float, or sequence of Material, optional
            Materials, or stiffnesses, by the names of the maps; by default the published values for
            these names, from `materials_by_name`. "none" is the material of pixels without a likely
            tissue; if it is missing, these pixels are as stiff as the first tissue.
        scale : {1, 100, 255}, optional
            Value that means certainty in all maps; by default the smallest of 1, 100 and 255 that
            no map exceeds. Pass the scale if the maps are parts of larger maps, such as slices,
            because all values of a part may be small.
        unit : str
            Unit of stiffness.

        Returns
        -------
        Tissue

        Raises
        ------
        ProblemError
            If maps differ in shape or scale, are negative, contain NaN or exceed the scale, or if a
            tissue has no material.
        ArgumentError
            If `maps` is not a mapping.
        """
        requirement = 'a mapping of names to maps, such as {"grey matter": grey}'
        refuse_unless(isinstance(maps, Mapping), "maps", maps, requirement)
        labels = most_likely(maps, scale)
        if materials is not None:
            rows = materials_of_maps([*maps], materials)
        else:
            published = materials_by_name(dict(enumerate(maps, 1)))
            if published.unknown:
                names = ", ".join(f"'{name}'" for name in published.unknown.values())
                requirement = (
                    f"has no published stiffness for {names}. Pass materials of these names."
                )
                raise ProblemError("tissue", requirement)
            rows, unit = published.materials, published.unit
        if 0 in labels and all(row.label for row in rows):
            rows = (default_material(0, rows), *rows)
        return cls(labels=labels, materials=rows, unit=unit)

    @property
    def stiffness_unit(self) -> str:
        """Unit of stiffness and stress: that of the tissue or of its curve; "" if relative."""
        return self.unit or ("" if self.curve is None else self.curve.unit)

    def __post_init__(self) -> None:
        _check_arrays(self, "labels", "stiffness")
        _take_whole_labels(self)
        require_kind(str, "unit", self.unit, '"kPa"')
        requirement = 'a unit of stiffness, such as "kPa"'
        refuse_unless(may_be_stiffness(self.unit), "unit", self.unit, requirement)
        materials = tuple_of(Material, "materials", self.materials, '(Material(1, "brain", 3.0),)')
        object.__setattr__(self, "materials", materials)
        require_kind(Preset | None, "preset", self.preset, "PRESETS[0]")
        example = "StiffnessCurve(((0, 10), (255, 40)))"
        require_kind(StiffnessCurve | None, "curve", self.curve, example)
        sources = "labels", "stiffness", "curve"
        given = [each for each in sources if getattr(self, each) is not None]
        if len(given) > 1:
            raise ProblemError(
                "tissue", f"is defined by its {' and by its '.join(given)}. Pass only one of them."
            )

    def __repr__(self) -> str:
        parts = [
            "labels" if self.labels is not None else "",
            f"{len(self.materials)} materials" if self.materials else "",
            "stiffness" if self.stiffness is not None else "",
            "brightness" if self.curve is not None else "",
            f"preset {self.preset.name!r}" if self.preset is not None else "",
            self.unit,
        ]
        return f"Tissue({_listed(parts) or 'as the image shows it'})"


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions:
    """Conditions on all tissue.

    The window offers them for each image: a field that is True or False as a check box, whose text
    and tooltip are in the metadata of the field, with the name of the undo step.

    Attributes
    ----------
    hold_edge : bool
        If True, fix the outer edge of the tissue: tissue next to void or to the dark surroundings,
        also diagonally, and tissue at the edge of the image. The edges of holes remain free.
    weight : tuple of float
        Body force on all tissue along each axis, which is density times acceleration, in the unit
        of stiffness per length; empty if there is no body force.
    cavity : Cavity
        Pressure and fluid that act where a label or a stroke removes tissue; by default, nothing.
    """

    hold_edge: bool = field(
        default=False,
        metadata={
            "text": "Fix outer edge",
            "tooltip": "Fix the outline of the tissue, and tissue at the edge of the image, unless "
            "a mark or the boundary moves it; edges of holes in the tissue stay free, and so does "
            "the edge around a pull that takes part of it along",
            "step": "changed whether the edge is held",
        },
    )
    weight: tuple[float, ...] = field(default=(), metadata={"step": "changed the weight"})
    cavity: Cavity = field(
        default_factory=Cavity, metadata={"step": "changed the contents of the cavity"}
    )

    @property
    def conditions(self) -> dict[str, Any]:
        """Values of the conditions, by name."""
        return {each.name: getattr(self, each.name) for each in fields(Conditions)}


#: Fields of `Conditions` that are True or False.
SWITCHES = tuple(each for each in fields(Conditions) if isinstance(each.default, bool))


@dataclass(frozen=True, eq=False)
class Motion(Conditions):
    """Prescribed motion of the tissue, and loads.

    Where prescribed motions overlap, the drawing takes precedence over labels, and labels over the
    observed displacement. `hold_edge` applies only to tissue without other prescribed motion.

    Attributes
    ----------
    hold_edge : bool
        If True, fix the outer edge of the tissue; see `Conditions`.
    labels : ndarray of int, shape ([D,] H, W), optional
        Painted boundary labels. Each label except 0 has a row in `rules`.
    rules : tuple of BoundaryRule
        Rules of the labels.
    observed : ndarray, shape ([D,] H, W, n), optional
        Observed material displacement, for example from a registration, in the order of the axes
        and in the unit of the grid.
    confidence : ndarray, shape ([D,] H, W) or ([D,] H, W, n), optional
        Confidence in the observed displacement, from 0 (none) to 1 (certain), as in a `Problem`.
        Required with `observed`.
    measured : MeasuredMotion, optional
        Measured displacements that tissue follows as far as its stiffness allows, for example of a
        registration; for the elastic model and large motion. Other motion takes precedence.
    drawing : Drawing
        Arrows, landmarks and brush strokes.
    weight, cavity
        Loads on all tissue; see `Conditions`.
    typical_strain : float
        Typical strain of the tissue, such as 0.1 for 10 %, against which landmarks with a standard
        deviation are weighed; see `StrainScale`. With a larger strain, tissue follows these
        landmarks more closely.
    drift : bool
        If True, a uniform strain of all tissue that costs no energy is estimated together with
        landmarks with a standard deviation; see `Landmarks`. For the elastic model only. Without
        such landmarks, no effect.

    Raises
    ------
    ProblemError
        If only one of `observed` and `confidence` is given.
    ArgumentError
        If an attribute has an invalid type.
    """

    hold_edge: bool = field(default=False, kw_only=False)
    labels: Array | None = None
    rules: tuple[BoundaryRule, ...] = ()
    _: KW_ONLY
    observed: Array | None = None
    confidence: Array | None = None
    drawing: Drawing = field(default_factory=Drawing)
    typical_strain: float = StrainScale.strain
    drift: bool = False
    measured: MeasuredMotion | None = None

    def __post_init__(self) -> None:
        for name in ("drift", *(each.name for each in SWITCHES)):
            require_flag(name, getattr(self, name))
        _check_arrays(self, "labels", "observed", "confidence")
        _take_whole_labels(self)
        rules = tuple_of(BoundaryRule, "rules", self.rules, '(BoundaryRule(1, "fixed"),)')
        object.__setattr__(self, "rules", rules)
        require_kind(Drawing, "drawing", self.drawing, "Drawing((Arrow(...),))")
        require_kind(Cavity, "cavity", self.cavity, "Cavity(pressure=0.1)")
        example = "registration.motion().measured"
        require_kind(MeasuredMotion | None, "measured", self.measured, example)
        along = convert(_Weight, self.weight, "weight")
        object.__setattr__(self, "weight", along)
        strain = convert(TypicalStrain, self.typical_strain, "typical_strain")
        object.__setattr__(self, "typical_strain", strain)
        if (self.observed is None) != (self.confidence is None):
            raise ProblemError("motion", "requires both the observed field and its confidence.")

    @property
    def unmeasured(self) -> Motion:
        """The motion without the measurement; an edge that the measurement freed is held again."""
        freed = self.measured is not None and self.measured.frees_edge
        return replace(self, measured=None, hold_edge=self.hold_edge or freed)

    def __repr__(self) -> str:
        parts = [
            "edge held" if self.hold_edge else "",
            f"labels, {len(self.rules)} rules" if self.labels is not None else "",
            "observed" if self.observed is not None else "",
            "measured" if self.measured is not None else "",
            repr(self.drawing) if self.drawing.marks else "",
            f"weight {self.weight}" if any(self.weight) else "",
            repr(self.cavity) if self.cavity.acts else "",
            ""
            if self.typical_strain == StrainScale.strain
            else f"typical strain {self.typical_strain:g}",
            "drift" if self.drift else "",
        ]
        return f"Motion({_listed(parts) or 'none'})"


@dataclass(frozen=True, eq=False)
class Pictures:
    """Image and labels to warp with the tissue.

    Attributes
    ----------
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
    labels : ndarray of int, shape ([D,] H, W), optional
    name, labels_name : str
        Names of the image and the labels, from which the names of results are derived.
    look, labels_look : dict
        Display settings of the image and the labels, such as the colormap, as keyword arguments of
        a new layer.

    Raises
    ------
    ArgumentError
        If the image or the labels are not an array.
    """

    image: Array | None = None
    labels: Array | None = None
    name: str = ""
    labels_name: str = ""
    look: Look = field(default_factory=dict)
    labels_look: Look = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_arrays(self, "image", "labels")

    def __repr__(self) -> str:
        parts = [
            "" if self.image is None else f"image {self.name!r} {self.image.dtype}",
            "" if self.labels is None else f"labels {self.labels_name!r}",
        ]
        return f"Pictures({_listed(parts) or 'none'})"


@dataclass(frozen=True, eq=False)
class Study:
    """All inputs of a displacement field: the tissue, its prescribed motion, and the model.

    Attributes
    ----------
    grid : Grid
    tissue : Tissue
    motion : Motion
    model : {"elastic", "large motion", "paper", "paper, converged"}, optional
        Name of a model, which determines `prior` and `optimizer`; by default elastic. If a prior or
        optimizer is also passed, it must belong to this model, and it replaces the model's default.
        `model` is only an argument; the attribute `model_name` is the name of the model.
    prior : ElasticPrior, NeoHookeanPrior or SeilerPrior
        Energy of the tissue. If tissues are given by labels, the Poisson's ratios of their
        materials apply.
    optimizer : ICM or Multigrid
        Minimizer of the energy.
    pictures : Pictures
        Image and labels to warp. The tissue may be derived from the image.
    names : mapping of str to str
        Names of the parts "image", "tissue", "boundary", "confidence" and "drawing" for error
        messages, such as names of layers or files.
    notes : tuple of str
        Clauses for the user about assumptions that were made when the study was read.

    Raises
    ------
    ProblemError
        If a part does not have the shape of the grid; the error names the part.
    ArgumentError
        If an attribute has an invalid type, if the model is unknown, or if the prior or the
        optimizer belongs to another model.

    Examples
    --------
    Pull tissue at a patch in its middle, and fix its edge.

    >>> import numpy as np
    >>> from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, Tissue, solve_study
    >>> pull = Drawing((Arrow(at=(10, 12), by=(0, 3), radius=2),))
    >>> study = Study(
    ...     Grid((20, 24), (0.5, 0.5), "mm"),
    ...     Tissue(stiffness=np.ones((20, 24))),
    ...     Motion(hold_edge=True, drawing=pull),
    ... )
    >>> solution = solve_study(study)
    >>> solution.provenance.model, solution.displacement[10, 12].round(2).tolist()
    ('elastic', [0.0, 3.0])
    """

    grid: Grid
    tissue: Tissue = field(default_factory=Tissue)
    motion: Motion = field(default_factory=Motion)
    model: InitVar[str] = ""
    prior: Annotated[Prior, ByClass()] = USUAL_PRIOR
    optimizer: Annotated[ICM | Multigrid, ByClass()] = USUAL_OPTIMIZER
    pictures: Pictures = field(default_factory=Pictures)
    names: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self, model: str) -> None:
        require_kind(Grid, "grid", self.grid, "Grid(image.shape, (1.0, 1.0))")
        require_kind(Tissue, "tissue", self.tissue, "Tissue(stiffness=...) or Tissue(labels=...)")
        require_kind(Motion, "motion", self.motion, "Motion(drawing=...) or Motion(labels=...)")
        require_kind(Pictures, "pictures", self.pictures, "Pictures(image)")
        require_kind(Prior, "prior", self.prior, "ElasticPrior()")
        require_kind(ICM | Multigrid, "optimizer", self.optimizer, "Multigrid()")
        if model:
            self._take_model(model)
        needed = self.grid.shape
        if len(self.motion.weight) not in (0, len(needed)):
            given = f"has a weight with {len(self.motion.weight)} components"
            raise ProblemError("motion", f"{given}. Pass {len(needed)}, one for each axis.")
        n = len(needed)
        along_axes, colours = (*needed, n), [(*needed, 3), (*needed, 4)]
        for name, part, shapes in (
            ("image", self.pictures.image, [needed, *colours]),
            ("tissue", self.tissue.labels, [needed]),
            ("tissue", self.tissue.stiffness, [needed]),
            ("boundary", self.motion.labels, [needed]),
            ("observed", self.motion.observed, [along_axes]),
            ("confidence", self.motion.confidence, [needed, along_axes]),
            ("measured motion", self.motion.measured, [along_axes]),
        ):
            if part is not None and tuple(part.shape) not in shapes:
                raise ProblemError(
                    name,
                    f"has shape {part.shape}, but the grid is {needed}. Use the shape "
                    f"{' or '.join(map(str, shapes))}.",
                )

    def _take_model(self, model: str) -> None:
        """Set the prior and the optimizer to those of a model, unless the caller passed others."""
        for name, usual in zip(("prior", "optimizer"), parts_of(model), strict=True):
            given = getattr(self, name)
            if is_by_name(given):
                object.__setattr__(self, name, usual)
            elif type(given) is not type(usual):
                needed, other = type(usual).__name__, type(given).__name__
                raise ArgumentError(
                    f"model {model!r} requires the {name} {needed}, not {other}. Pass "
                    f"{name}={needed}(), or omit one of the two."
                )

    def __repr__(self) -> str:
        parts = self.grid, self.tissue, self.motion, self.pictures
        return f"Study({', '.join(map(repr, parts))}, {self.model_name})"

    @property
    def model_name(self) -> str:
        """Name of the model, as in the provenance of a solution."""
        parts = {"prior": self.prior.parameters, "optimizer": self.optimizer.parameters}
        return model_name(parts)

    @property
    def intensities(self) -> Array | None:
        """Brightness of the image, or the luminance of a colour image."""
        image = self.pictures.image
        if image is None or image.ndim == len(self.grid.shape):
            return image
        return luminance(image)

    @property
    def moves(self) -> bool:
        """True if the study prescribes any motion or load in addition to a fixed edge."""
        motion = self.motion
        fields = motion.labels, motion.observed, motion.measured
        given = (motion.drawing.marks, *(each is not None for each in fields))
        return any(given) or self.bears_loads

    @property
    def bears_loads(self) -> bool:
        """True if the study has growth or forces."""
        return bool(self.loaded_parts)

    @property
    def loaded_parts(self) -> tuple[str, ...]:
        """Parts with growth or forces: some of "tissue", "boundary", "weight" and "cavity"."""
        motion = self.motion
        loaded = {
            "tissue": any(row.grows for row in self.tissue.materials),
            "boundary": any(rule.action in FORCES for rule in motion.rules),
            "weight": any(motion.weight),
            "cavity": motion.cavity.acts and self.removes,
        }
        return tuple(part for part, bears in loaded.items() if bears)

    @property
    def slides(self) -> bool:
        """True if tissue slides along a painted label or a stroke."""
        return self._has("slide")

    @property
    def removes(self) -> bool:
        """True if a painted label or a stroke removes tissue."""
        return self._has("remove")

    def _has(self, action: Literal["slide", "remove"]) -> bool:
        """Return whether a painted label or a stroke has an action."""
        marks, labels = self.motion.drawing.marks, self.motion.labels
        rules = [rule.label for rule in self.motion.rules if rule.action == action]
        drawn = any(isinstance(mark, Stroke) and mark.action == action for mark in marks)
        return drawn or (bool(rules) and labels is not None and bool(np.isin(labels, rules).any()))

    def named(self, *parts: str) -> str:
        """Return the name of the first given part with a name in `names`, else the first part."""
        return next((self.names[part] for part in parts if part in self.names), parts[0])

    def same_as(self, other: Study) -> bool:
        """Return whether another study has the same displacement field and the same image."""
        return (
            self.grid == other.grid
            and self.prior == other.prior
            and self.optimizer == other.optimizer
            and self.pictures.image is other.pictures.image
            and _same_parts(self.tissue, other.tissue)
            and _same_parts(self.motion, other.motion)
        )

    def has_same_ground(self, other: Study) -> bool:
        """Return whether another study differs at most in its drawing and its optimizer."""
        motion = replace(self.motion, drawing=other.motion.drawing)
        return replace(self, motion=motion, optimizer=other.optimizer).same_as(other)

    @contextmanager
    def naming(self, drawn: bool = True) -> Iterator[None]:
        """Replace argument names in error messages with the names of the study's parts.

        Parameters
        ----------
        drawn : bool
            If True, errors about boundary conditions refer to the drawing, if there is one.
        """
        names = self.names
        marks = self.motion.drawing.marks
        pairs = "Landmark" if marks and all(isinstance(mark, Landmark) for mark in marks) else ""
        boundary = ((pairs or names.get("drawing")) if drawn else "") or names.get("boundary")
        tissue = names.get("tissue") or names.get("image")
        with naming(
            stiffness=tissue,
            poisson=tissue,
            observed=boundary,
            drawing=boundary,
            confidence=names.get("confidence") or boundary,
            landmarks=boundary,
            spacing=names.get("image") or tissue,
            growth=tissue,
            sliding=tissue,
            surface=names.get("boundary"),
            precision=boundary,
            force=names.get("boundary"),
        ):
            yield

    def in_words(self, error: Exception) -> Exception:
        """Return an error with argument names replaced with the names of the study's parts."""
        try:
            with self.naming():
                raise error
        except Exception as named:  # noqa: BLE001 - any error is reworded
            return named


def _check_arrays(part: Tissue | Motion | Pictures, *names: str) -> None:
    """Raise an error for images that are not arrays, such as lists."""
    for name in names:
        value = getattr(part, name)
        is_array = value is None or hasattr(value, "shape")
        refuse_unless(is_array, name, value, "an array, such as np.array(values)")


def _take_whole_labels(part: Tissue | Motion) -> None:
    """Convert whole numbers stored as floats to integers; raise an error for other labels."""
    labels = part.labels
    if labels is not None and np.dtype(labels.dtype).kind not in "biu":
        object.__setattr__(part, "labels", whole_numbers("labels", labels))


def _listed(parts: Iterable[str]) -> str:
    return ", ".join(filter(None, parts))


def is_same(one: Any, other: Any) -> bool:
    """Return whether two values are the same: arrays by identity, other values by equality."""
    return one is other or not (hasattr(one, "dtype") or hasattr(other, "dtype") or one != other)


def _same_parts(one: Any, other: Any) -> bool:
    return all(is_same(value, getattr(other, name)) for name, value in vars(one).items())
