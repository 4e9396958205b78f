"""Input files and options of a case, and the energy selected by the options."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from napari_hmrf.arguments import checked_path, tuple_of
from napari_hmrf.checks import Budget, Choice, PerAxis, Positive, Words
from napari_hmrf.errors import HmrfError
from napari_hmrf.field.units import UNKNOWN_UNITS, is_length
from napari_hmrf.io.images import length_unit
from napari_hmrf.solver.model_names import ELASTIC, MODELS, as_word
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.solver.priors import Elastic, NeoHookeanPrior, Prior
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.study.models import parts_of
from napari_hmrf.study.study import Grid, Tissue
from napari_hmrf.tissue.boundary_rules import (
    USUAL_POISSON,
    default_material,
    unlisted,
)
from napari_hmrf.tissue.cavity import Cavity


def _cavity(value: Any) -> Any:
    """Create a cavity from text with its pressure, fluid and level."""
    numbers: Any = value.split("/") if isinstance(value, str) else None
    return value if numbers is None else Cavity(*numbers)


def _spacing(value: Any) -> Any:
    """Split text into the sizes of a pixel and their unit."""
    if not isinstance(value, str):
        return value
    sizes = "/".join(re.findall(r"[\d.]+", value))
    unit = length_unit(value.removeprefix(sizes).strip())
    if unit in UNKNOWN_UNITS or not is_length(unit):
        raise ValueError("it has no unit of length")
    return sizes.split("/"), unit


#: Types of the options that are not files, texts or flags.
OPTIONS: dict[str, Any] = {
    "spacing": Annotated[
        tuple[Annotated[tuple[Positive, ...], Field(min_length=2, max_length=3)], str],
        BeforeValidator(_spacing),
        Words("a size along each axis and a unit, such as 2.5/0.5/0.5um"),
    ],
    "plane": Annotated[Plane, Choice()],
    "tolerance": Positive,
    "budget": Budget,
    "penalty": Positive,
    "weight": PerAxis,
    "cavity": Annotated[
        Cavity,
        BeforeValidator(_cavity),
        Words("pressure/fluid/level, such as 0/0.00981/0.5"),
    ],
}


@dataclass(frozen=True)
class Case:
    """Input files and options of a case, as given on a command line.

    Paths can be given as text, and are stored as `Path`.

    Attributes
    ----------
    image : Path
        Image, or study file. A study file requires no other files.
    labels : Path, optional
        Image of tissue labels.
    materials : Path, optional
        Table of materials (.csv or .json), or table of label names of a segmentation tool, as read
        by `read_label_names`.
    maps : sequence of Path
        Probability images, one for each tissue, in place of `labels`. The label of a pixel is the
        1-based index of the most likely tissue, or 0 where the probability that there is no tissue,
        ``1 - sum(maps)``, is larger.
    boundary : Path, optional
        Motion of the tissue: a label image, with a table of `rules`; landmarks, as pairs (.csv) or
        with `targets`; or a displacement field, such as the result of a registration.
    targets : Path, optional
        Target positions of the landmarks of `boundary`, in the same order.
    rules : Path, optional
        Table of boundary rules (.csv).
    forward : bool
        True if `boundary` is a field that maps original to new positions, and its file does not
        state the direction.
    confidence : Path or "edges", optional
        Confidence of a field: an image with values from 0 to 1, or a mask; or "edges", which sets
        the confidence to 1 at edges in the image and to 0 elsewhere. By default, the confidence is
        1 wherever the field is defined.
    slice : int, optional
        Index of a slice along the first axis of a volume; by default, the whole volume is solved.
    spacing : (tuple of float, str), optional
        Size of a pixel along each axis of `image` and its unit, if it is a picture whose file does
        not state them, such as ``((2.5, 0.5, 0.5), "µm")``.
    hold_edge : bool
        True if the outer edge of the tissue is fixed.
    model : str, optional
        Name of the model; by default "elastic".
    poisson : float, optional
        Poisson's ratio of all tissue, in place of the values in `materials`.
    plane : {"stress", "strain"}, optional
        Plane stress (the default), in which a slice can bulge, or plane strain.
    tolerance : float, optional
        Largest estimated error of the field, in pixels; not available for the model "paper".
    budget : float, optional
        Largest work of a large-motion solve, in linear solves; infinite for no limit.
    penalty : float, optional
        Penalty K of eq. 19, which allows constrained sites to slip; by default, the penalty of the
        model.
    weight : tuple of float
        Body force on elastic tissue along each axis, in units of stiffness per length.
    cavity : Cavity, optional
        Pressure and fluid that act where a boundary rule removes tissue; by default, nothing.
    """

    image: Path
    labels: Path | None = None
    materials: Path | None = None
    maps: Sequence[Path] = ()
    boundary: Path | None = None
    targets: Path | None = None
    rules: Path | None = None
    forward: bool = False
    confidence: Path | Literal["edges"] | None = None
    slice: int | None = None
    spacing: tuple[tuple[float, ...], str] | None = None
    hold_edge: bool = False
    model: str | None = None
    poisson: float | None = None
    plane: Plane | None = None
    tolerance: float | None = None
    budget: float | None = None
    penalty: float | None = None
    weight: tuple[float, ...] = ()
    cavity: Cavity | None = None

    def __post_init__(self) -> None:
        for name in ("image", "labels", "materials", "boundary", "targets", "rules", "confidence"):
            path = getattr(self, name)
            if path is not None and (name, path) != ("confidence", "edges"):
                object.__setattr__(self, name, Path(checked_path(path, name)))
        maps = tuple_of(str | os.PathLike, "maps", self.maps, "('white.nii', 'grey.nii')")
        object.__setattr__(self, "maps", tuple(Path(checked_path(each, "maps")) for each in maps))

    @property
    def options(self) -> tuple[str, ...]:
        """Shell names of the options that are set, except the image."""
        names = [each.name for each in fields(self) if each.name != "image"]
        given = [name for name in names if getattr(self, name) not in (None, (), False)]
        return tuple(f"--{name.replace('_', '-')}" for name in given)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Paths of the input files and folders."""
        named = (
            self.image,
            self.labels,
            self.materials,
            self.boundary,
            self.targets,
            self.rules,
            *self.maps,
        )
        confidence = (self.confidence,) if isinstance(self.confidence, Path) else ()
        return tuple(path for path in (*named, *confidence) if path is not None)


def energy_of(case: Case, *, volume: bool = False) -> tuple[Prior, ICM | Multigrid]:
    """Return the prior and the optimizer selected by the options of a case.

    Parameters
    ----------
    case : Case
    volume : bool
        True if a whole volume is solved.

    Raises
    ------
    HmrfError
        If an option has no effect on the model; the message states the option and the reason.
    ArgumentError
        If the value of an option is invalid.
    """
    name = MODELS[as_word(case.model or "elastic")]
    prior, optimizer = parts_of(name)
    elastic = name in ELASTIC
    for given, option, is_valid, why in (
        (
            case.poisson is not None,
            "--poisson",
            elastic,
            "the paper's model has no Poisson's ratio",
        ),
        (
            case.plane is not None,
            "--plane",
            elastic,
            "the paper's model has neither plane stress nor plane strain",
        ),
        (
            case.plane is not None,
            "--plane",
            not volume,
            "plane stress and plane strain are defined for slices only",
        ),
        (bool(case.weight), "--weight", elastic, "the paper's model does not support forces"),
        (bool(case.cavity), "--cavity", elastic, "the paper's model does not support forces"),
        (
            case.tolerance is not None,
            "--tolerance",
            isinstance(optimizer, Multigrid),
            "the paper's schedule has a fixed length; --model paper-converged has a tolerance",
        ),
        (
            case.budget is not None,
            "--budget",
            isinstance(prior, NeoHookeanPrior),
            "only large motion has a budget",
        ),
    ):
        if given and not is_valid:
            raise HmrfError(f"{option} has no effect: {why}. Leave {option} out.")
    if isinstance(prior, Elastic):
        prior = replace(
            prior,
            poisson=prior.poisson if case.poisson is None else case.poisson,
            plane=case.plane or prior.plane,
        )
    if case.penalty is not None:
        prior = replace(prior, penalty=case.penalty)
    if case.tolerance is not None:
        optimizer = Multigrid(case.tolerance)
    if case.budget is not None and isinstance(optimizer, Multigrid):
        optimizer = replace(optimizer, budget=case.budget if case.budget < math.inf else None)
    return prior, optimizer


def weight_of(case: Case, grid: Grid) -> tuple[float, ...]:
    """Return the weight of a case; raise an error if it does not have one number per grid axis."""
    if case.weight and len(case.weight) != len(grid.shape):
        axes = "plane, row and col" if len(grid.shape) == 3 else "row and col"
        raise HmrfError(
            f"--weight has {len(case.weight)} numbers, but the grid has {len(grid.shape)} axes. "
            f"Give the weight along {axes}."
        )
    return case.weight


def notes_on_ratio(case: Case, tissue: Tissue) -> tuple[str, ...]:
    """Return notes on replaced Poisson's ratios, and on labels that are not in the table.

    Parameters
    ----------
    case : Case
    tissue : Tissue
        Labels of the tissue, and materials of the table.
    """
    notes = []
    if any(row.poisson not in (case.poisson, USUAL_POISSON) for row in tissue.materials):
        table = "the table" if case.materials is None else case.materials.name
        notes.append(f"--poisson {case.poisson:g} replaces the Poisson's ratios of {table}")
    labels = tissue.labels
    missing = [] if labels is None or tissue.materials else unlisted(labels, ())
    added = [default_material(label, ()) for label in missing]
    notes += [
        f"label {row.label} is not in the table, so its stiffness was set to {row.stiffness:g}"
        for row in added
    ]
    return tuple(notes)
