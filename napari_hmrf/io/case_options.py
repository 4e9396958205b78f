"""Files and options of a case, and the energy that they select."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from napari_hmrf.errors import HmrfError
from napari_hmrf.solver.model_names import ELASTIC, MODELS, as_word
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.study.models import parts_of
from napari_hmrf.study.study import Grid, Tissue
from napari_hmrf.tissue.boundary_rules import (
    USUAL_POISSON,
    default_material,
    unlisted,
)


@dataclass(frozen=True)
class Case:
    """Files and options of one case, as given on a command line.

    Attributes
    ----------
    image : Path
        An image; or the file of a study, which needs no other file.
    labels, materials : Path, optional
        An image of tissue labels and a table of materials, .csv or .json; or a table of label names
        from a segmentation tool, as read by `read_label_names`.
    maps : sequence of Path
        Probability images, one for each tissue, instead of `labels`. The label of a pixel is the
        position in this list, counted from 1, of the most likely tissue; it is 0 where the
        probability of no tissue, which is the rest to 1, is larger.
    boundary : Path, optional
        Motion of the tissue: an image of labels with a table of `rules`; pairs of landmarks in a
        .csv; or a displacement field, such as a registration's.
    rules : Path, optional
        A .csv.
    forward : bool
        True if a boundary that is a field maps old positions of tissue to new ones and the file
        does not state this direction.
    confidence : Path or "edges", optional
        Confidence of a field: an image with values from 0 to 1, or a mask; or "edges", which is 1
        at the edges in the image and 0 elsewhere. By default 1 wherever the field is defined.
    slice : int, optional
        Slice of a volume along its first axis; by default the whole volume is solved.
    hold_edge : bool
        True if the outer edge of the tissue stays in place.
    model : str, optional
        Name of the model; by default "elastic".
    poisson : float, optional
        Poisson's ratio of all tissue; it replaces the values in `materials`.
    plane : {"stress", "strain"}, optional
        Plane stress, in which a slice may bulge (the default), or plane strain.
    tolerance : float, optional
        Largest estimated error of the field, in pixels; for all models but "paper".
    penalty : float, optional
        Penalty K of eq. 19, which lets held sites slip; by default that of the model.
    weight : tuple of float
        Body force on elastic tissue along each axis, in the unit of stiffness per length.
    """

    image: Path
    labels: Path | None = None
    materials: Path | None = None
    maps: Sequence[Path] = ()
    boundary: Path | None = None
    rules: Path | None = None
    forward: bool = False
    confidence: Path | Literal["edges"] | None = None
    slice: int | None = None
    hold_edge: bool = False
    model: str | None = None
    poisson: float | None = None
    plane: Plane | None = None
    tolerance: float | None = None
    penalty: float | None = None
    weight: tuple[float, ...] = ()

    @property
    def options(self) -> tuple[str, ...]:
        """Options given in addition to the image, as typed in a shell."""
        names = [each.name for each in fields(self) if each.name != "image"]
        given = [name for name in names if getattr(self, name) not in (None, (), False)]
        return tuple(f"--{name.replace('_', '-')}" for name in given)


def energy_of(case: Case, *, volume: bool = False) -> tuple[Prior, Optimizer]:
    """Return the energy that a case selects, and its optimizer.

    Parameters
    ----------
    case : Case
    volume : bool
        True if a whole volume is solved.

    Raises
    ------
    HmrfError
        If the model has no such parameter; the message names the option and the reason.
    ArgumentError
        If the value of a parameter is invalid.
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
        (case.plane is not None, "--plane", elastic, "the paper's model has no plane"),
        (case.plane is not None, "--plane", not volume, "a volume is strained in all directions"),
        (bool(case.weight), "--weight", elastic, "the paper's model bears no forces"),
        (
            case.tolerance is not None,
            "--tolerance",
            isinstance(optimizer, Multigrid),
            "the paper's schedule ends after its sweeps; --model paper-converged has a tolerance",
        ),
    ):
        if given and not is_valid:
            raise HmrfError(f"{option} has no effect here: {why}. Leave {option} out.")
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
    return prior, optimizer


def weight_of(case: Case, grid: Grid) -> tuple[float, ...]:
    """Return the weight of a case; refuse a weight whose length differs from the grid's axes."""
    if case.weight and len(case.weight) != len(grid.shape):
        axes = "plane, row and col" if len(grid.shape) == 3 else "row and col"
        raise HmrfError(
            f"--weight has {len(case.weight)} numbers, but the grid has {len(grid.shape)} axes. "
            f"Give the weight along {axes}."
        )
    return case.weight


def notes_on_ratio(case: Case, tissue: Tissue) -> tuple[str, ...]:
    """Return notes on Poisson's ratios that a case replaces, and on labels without a row.

    Parameters
    ----------
    case : Case
    tissue : Tissue
        Tissue by labels, with the materials of the table.
    """
    notes = []
    if any(row.poisson not in (case.poisson, USUAL_POISSON) for row in tissue.materials):
        table = "the table" if case.materials is None else case.materials.name
        notes.append(f"--poisson {case.poisson:g} replaces the Poisson's ratios of {table}")
    missing = [] if tissue.labels is None else unlisted(tissue.labels, tissue.materials)
    added = [default_material(label, tissue.materials) for label in missing]
    notes += [
        f"label {row.label} is not in the table and got stiffness {row.stiffness:g}"
        for row in added
    ]
    return tuple(notes)
