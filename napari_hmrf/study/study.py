"""A study: all that a field is computed from. The same in a window, in Python and in files.

Nothing here needs napari or Qt. A study does not change; an edit makes another, which shares with
the one before what is the same in both. So parts are compared by identity, and no array ever is.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import InitVar, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError, naming
from napari_hmrf.field.brightness import luminance
from napari_hmrf.field.frame import Frame
from napari_hmrf.solver.model_names import model_name
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.study.models import chosen
from napari_hmrf.tissue.boundary_rules import FORCES, BoundaryRule, Material
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.tissue.tissue_maps import materials_of_maps, most_likely

Array = npt.NDArray[Any]
#: Distance from the middle of a slice, in slices, up to which a point is in it.
_IN_SLICE = 0.5 + 1e-3


class SimpleItkImage(Protocol):
    """The part of a SimpleITK image that tells its place."""

    def GetSize(self) -> Sequence[int]: ...  # noqa: D102
    def GetSpacing(self) -> Sequence[float]: ...  # noqa: D102
    def GetOrigin(self) -> Sequence[float]: ...  # noqa: D102
    def GetDirection(self) -> Sequence[float]: ...  # noqa: D102
    def GetDimension(self) -> int: ...  # noqa: D102


class NibabelImage(Protocol):
    """The part of a nibabel image that tells its place."""

    @property
    def affine(self) -> Any: ...  # noqa: D102
    @property
    def dataobj(self) -> Any: ...  # noqa: D102


@dataclass(frozen=True)
class Grid:
    """The pixels on which everything lies.

    Attributes
    ----------
    shape : tuple of int
        (H, W), or (D, H, W) of a volume.
    spacing : tuple of float
        Size of a pixel along each axis, in `unit`.
    unit : str
        Of all lengths: displacements, radii.
    place : Frame, optional
        The place of the pixels in the world, and the slice that they are; see `from_image`. Files
        for other tools need it; the field does not depend on it.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    unit: str = "pixel"
    place: Frame | None = None

    def __post_init__(self) -> None:
        place = self.place
        if place is None:
            return
        if not isinstance(place, Frame):
            raise ProblemError(
                "grid",
                f"has a place of type {type(place).__name__}. Give a Frame, as of Grid.from_image.",
            )
        if len(place.plane) != len(self.shape):
            raise ProblemError(
                "grid",
                f"has {len(self.shape)} axes, but its place has {len(place.plane)}. Give the place "
                "of the same slice or volume.",
            )

    @property
    def known_place(self) -> Frame:
        """Place of a grid that has one, as every grid that was read from layers."""
        assert self.place is not None
        return self.place

    def to_pixels(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return points of the patient in pixels of this grid.

        Parameters
        ----------
        points : array_like, shape (N, 3) or (N, 2)
            In mm, as `load_points` gives them: z, y, x of a volume or of a slice of one, towards
            superior, posterior and left; y, x of an image of 2 axes.

        Returns
        -------
        ndarray, shape (N, n)

        Raises
        ------
        ProblemError
            If the grid has no place, or points lie on another slice or have too few axes.
        """
        if self.place is None:
            raise ProblemError("grid", "has no place. Take Grid.from_image(image).")
        matrix, given = np.array(self.place.matrix), np.asarray(points, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != len(matrix) - 1:
            raise ProblemError(
                "points", f"have shape {given.shape}. Give (N, {len(matrix) - 1}) numbers in mm."
            )
        inside = (given - matrix[:-1, -1]) @ np.linalg.inv(matrix[:-1, :-1]).T
        others = list(self.place.others)
        apart = np.abs(inside[:, others] - np.array(self.place.index)[others]).max(initial=0.0)
        if apart > _IN_SLICE:
            raise ProblemError(
                "points", f"lie up to {apart:.3g} slices away from the slice of the grid."
            )
        found: npt.NDArray[np.float64] = inside[:, list(self.place.plane)]
        return found

    @classmethod
    def from_image(
        cls,
        image: str | os.PathLike[str] | SimpleItkImage | NibabelImage,
        *,
        slice: int | None = None,  # noqa: A002
        axis: int = 0,
    ) -> Grid:
        """Return the grid of an image, or of one slice of a volume, with its place.

        Parameters
        ----------
        image : path-like, SimpleITK image or nibabel image
            A path is read as images are: NIfTI, MetaImage, NRRD, a folder of DICOM or a picture.
            The axes are those of its array: [z,] y, x of a file or of SimpleITK's
            ``GetArrayFromImage``, and x, y, z of nibabel's ``dataobj``.
        slice : int, optional
            Number of a slice of a volume; by default the grid is that of the whole image.
        axis : int
            The axis of the array that the slice lies across.

        Raises
        ------
        ArgumentError
            If it is no such image, or has no such slice.
        ProblemError
            If the image's axes are not at right angles.
        FileFormatError, HmrfError, OSError
            If a file cannot be read.
        """
        # Reading files is the work of `io`, which is built on studies.
        from napari_hmrf.io.image_grid import grid_of_image

        return grid_of_image(image, slice=slice, axis=axis)

    def __repr__(self) -> str:
        place = "" if self.place is None else ", placed"
        sizes = f"{grid_in_words(self.spacing)} {self.unit}"
        return f"Grid({grid_in_words(self.shape)} sites of {sizes}{place})"


@dataclass(frozen=True, eq=False)
class Tissue:
    """Which tissue is where: by labels, by its stiffness, by brightness, or as the image shows it.

    Without any of these all that is in the image is tissue of one stiffness, and its dark
    surroundings, if it has any, are a hundred times softer.

    Attributes
    ----------
    labels : ndarray of int, shape ([D,] H, W), optional
        With a row of `materials` each; one without a row gets a usual one.
    materials : tuple of Material
    stiffness : ndarray, shape ([D,] H, W), optional
        Young's modulus; 0 where there is no tissue, infinite where it is rigid.
    curve : StiffnessCurve, optional
        By which the image's intensity says how stiff tissue is.
    record : mapping
        What it was made from, in JSON types, to be kept with a solution.
    preset : Preset, optional
        Which tissues a brush can paint where there is no table; by default the first of all.
    unit : str
        Of stiffness; of no consequence, for only ratios matter.
    without_border : bool
        Whether what is dark around the image is no tissue where its label is 0.
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
        unit: str = "",
    ) -> Tissue:
        """Return the tissue of maps of likelihood, such as those of a segmentation.

        Each pixel gets the most likely tissue, and label 0 where "none" is more likely, as by
        ``--maps`` in the shell.

        Parameters
        ----------
        maps : mapping of str to array_like, shape ([D,] H, W)
            Likelihood of each tissue, by name, from 0 to 1, 100 or 255.
        materials : mapping of str to Material or float, or sequence of Material, optional
            By the names of the maps; a number is a stiffness. "none" is the material of pixels
            without a likely tissue, which else are as stiff as the first tissue. By default the
            published values of tissues of these names, as of `materials_by_name`.
        unit : str
            Of stiffness.

        Raises
        ------
        ProblemError
            If maps differ in shape, or a tissue has no material.
        """
        labels = most_likely([*maps.values()])
        if materials is not None:
            return cls(labels=labels, materials=materials_of_maps([*maps], materials), unit=unit)
        # Published values are in the tables of `io`, which is built on studies.
        from napari_hmrf.io.tissue_names import materials_by_name

        found = materials_by_name(dict(enumerate(maps, 1)))
        if found.unknown:
            names = ", ".join(f"'{name}'" for name in found.unknown.values())
            raise ProblemError(
                "tissue", f"has no published stiffness for {names}. Give materials of these names."
            )
        return cls(labels=labels, materials=found.materials, unit=found.unit)

    def __post_init__(self) -> None:
        given = [
            each for each in ("labels", "stiffness", "curve") if getattr(self, each) is not None
        ]
        if len(given) > 1:
            raise ProblemError(
                "tissue", f"is given by its {' and by its '.join(given)}. Give one of them."
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


@dataclass(frozen=True, eq=False)
class Motion:
    """How tissue moves where that is known. Of what overlaps, the later part counts.

    Attributes
    ----------
    hold_edge : bool
        Whether the outer edge of the tissue stays where it is: beside what is no tissue or the dark
        surroundings, and at the edge of the image. Holes in it are free.
    labels : ndarray of int, shape ([D,] H, W), optional
        What is painted, with a row of `rules` each; one without a row stays where it is.
    rules : tuple of BoundaryRule
    observed : ndarray, shape ([D,] H, W, n), optional
        A displacement, in the order of the axes and the grid's unit, such as a registration's.
    confidence : ndarray, shape ([D,] H, W) or ([D,] H, W, n), optional
        Confidence in what is observed, 0 (none) to 1 (certain), as of a `Problem`. Needed beside
        `observed`.
    drawing : Drawing
        What was drawn with a pointer: pulls, landmarks, and strokes of a brush.
    weight : tuple of float
        What pulls at each part of all tissue, along each axis: density times acceleration, in the
        unit of stiffness per length; empty if nothing does.
    """

    hold_edge: bool = False
    labels: Array | None = None
    rules: tuple[BoundaryRule, ...] = ()
    observed: Array | None = None
    confidence: Array | None = None
    drawing: Drawing = field(default_factory=Drawing)
    weight: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if (self.observed is None) != (self.confidence is None):
            raise ProblemError("motion", "needs both what is observed and how sure that is.")

    def __repr__(self) -> str:
        parts = [
            "edge held" if self.hold_edge else "",
            f"labels, {len(self.rules)} rules" if self.labels is not None else "",
            "observed" if self.observed is not None else "",
            repr(self.drawing) if self.drawing.marks else "",
            f"weight {self.weight}" if any(self.weight) else "",
        ]
        return f"Motion({_listed(parts) or 'none'})"


@dataclass(frozen=True, eq=False)
class Pictures:
    """What may be deformed along with the field.

    Attributes
    ----------
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
    labels : ndarray of int, shape ([D,] H, W), optional
    name, labels_name : str
        Of what they came from; results are named after them.
    look, labels_look : dict
        How they are drawn: colormap and the like, as a new layer takes it.
    """

    image: Array | None = None
    labels: Array | None = None
    name: str = ""
    labels_name: str = ""
    look: dict[str, Any] = field(default_factory=dict)
    labels_look: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = [
            "" if self.image is None else f"image {self.name!r} {self.image.dtype}",
            "" if self.labels is None else f"labels {self.labels_name!r}",
        ]
        return f"Pictures({_listed(parts) or 'none'})"


@dataclass(frozen=True, eq=False)
class Study:
    """What somebody knows of a piece of tissue: where it is, how it moves, and by which energy.

    Attributes
    ----------
    grid : Grid
    tissue : Tissue
    motion : Motion
    model : {"elastic", "large motion", "paper", "paper, converged"}, optional
        What tissue is taken to be, and how far that is solved, in a word; it sets the two that
        follow. By default elastic. `model_name` says which it is.
    prior : ElasticPrior, NeoHookeanPrior or SeilerPrior
        The energy; where tissues are labels, Poisson's ratios are those of their table.
    optimizer : ICM or Multigrid
        How it is minimised.
    pictures : Pictures
        What is deformed along with the tissue, and what it may be told from.
    names : mapping of str to str
        What people call the parts: "image", "tissue", "boundary", "confidence" and "drawing". What
        is wrong is said of these.
    notes : tuple of str
        What people should know of how it was read, as clauses.

    Raises
    ------
    ProblemError
        Naming the part that is not of the grid's shape.
    ArgumentError
        If there is no such model.

    Examples
    --------
    Tissue is pulled by a patch in its middle, and held where it ends.

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
    prior: Prior = field(default_factory=ElasticPrior)
    optimizer: Optimizer = field(default_factory=Multigrid)
    pictures: Pictures = field(default_factory=Pictures)
    names: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self, model: str) -> None:
        if model:
            for name, value in zip(("prior", "optimizer"), chosen(model), strict=True):
                object.__setattr__(self, name, value)
        needed = self.grid.shape
        if len(self.motion.weight) not in (0, len(needed)):
            given = f"has a weight of {len(self.motion.weight)} components"
            raise ProblemError("motion", f"{given}. Give {len(needed)}, one along each axis.")
        for what, part in (
            ("image", self.pictures.image),
            ("tissue", self.tissue.labels),
            ("tissue", self.tissue.stiffness),
            ("boundary", self.motion.labels),
            ("boundary", self.motion.observed),
            ("confidence", self.motion.confidence),
        ):
            if part is not None and part.shape[: len(needed)] != needed:
                raise ProblemError(
                    what, f"has shape {part.shape}, but the grid is {needed}. Give one of its size."
                )

    def __repr__(self) -> str:
        parts = self.grid, self.tissue, self.motion, self.pictures
        return f"Study({', '.join(map(repr, parts))}, {self.model_name})"

    @property
    def model_name(self) -> str:
        """The name of the model, as results have it."""
        parts = {"prior": self.prior.parameters, "optimizer": self.optimizer.parameters}
        return model_name(parts)

    @property
    def intensities(self) -> Array | None:
        """How bright the image is; of colours, the luminance."""
        image = self.pictures.image
        if image is None or image.ndim == len(self.grid.shape):
            return image
        return luminance(image)

    @property
    def moves(self) -> bool:
        """Whether anything is said of how tissue moves, but that its edge is held."""
        motion = self.motion
        given = (motion.drawing.marks, motion.labels is not None, motion.observed is not None)
        return any(given) or self.bears_loads

    @property
    def bears_loads(self) -> bool:
        """Whether tissue is to grow, or forces pull at it."""
        motion = self.motion
        forces = any(motion.weight) or any(rule.action in FORCES for rule in motion.rules)
        return forces or any(row.grows for row in self.tissue.materials)

    def named(self, *parts: str) -> str:
        """What people call a part: the first of these that has a name."""
        return next((self.names[part] for part in parts if part in self.names), parts[0])

    def same_as(self, other: Study) -> bool:
        """Whether a field of the other would be the same, and move the same image."""
        return (
            self.grid == other.grid
            and self.prior == other.prior
            and self.optimizer == other.optimizer
            and self.pictures.image is other.pictures.image
            and _same_parts(self.tissue, other.tissue)
            and _same_parts(self.motion, other.motion)
        )

    def lies_as(self, other: Study) -> bool:
        """Whether the other differs in its drawing, in how it is solved, or in nothing."""
        motion = replace(self.motion, drawing=other.motion.drawing)
        return replace(self, motion=motion, optimizer=other.optimizer).same_as(other)

    @contextmanager
    def naming(self, drawn: bool = True) -> Iterator[None]:
        """Let errors about the inputs of a problem name the parts that these came from.

        Of what holds and moves that is the drawing, if there is any, unless nothing is `drawn` yet.
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
            confidence=names.get("confidence") or boundary,
            spacing=names.get("image") or tissue,
            growth=tissue,
            surface=names.get("boundary"),
            force=names.get("boundary"),
        ):
            yield

    def in_words(self, error: Exception) -> Exception:
        """An error, said of the parts that people know."""
        try:
            with self.naming():
                raise error
        except Exception as named:  # noqa: BLE001 - that is what is wanted
            return named


def _listed(parts: Iterable[str]) -> str:
    return ", ".join(filter(None, parts))


def is_same(one: Any, other: Any) -> bool:
    """Whether arrays are one and the same; all else is compared by value."""
    return one is other or not (hasattr(one, "dtype") or hasattr(other, "dtype") or one != other)


def _same_parts(one: Any, other: Any) -> bool:
    return all(is_same(value, getattr(other, name)) for name, value in vars(one).items())
