"""Which energy tissue has and how far it is minimised, chosen in a word."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, get_args

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.model_names import ELASTIC, MODELS, ModelName, as_word
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.solver.priors.seiler import Conditional
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON

#: The holding force in the form from which on all observations are held exactly, doubted or not.
HOLD_ALL = 1e6


def _form_field(usual: Any, label: str, tooltip: str, **options: Any) -> Any:
    """A field with what a form says of it, and what that lets people choose."""
    options["tooltip"] = tooltip
    return field(default=usual, metadata={"label": label, "options": options})


@dataclass(frozen=True)
class SolverDetails:
    """How a model is solved: what is the paper's own, or usual, and need not be chosen.

    A form is made from these fields; `asked` says which of them a model knows.

    Attributes
    ----------
    reading : {"centred", "blanket"}
    method : {"steps", "closed form"}
    sweeps : int
    energy_change : float
        0: a level is never left early.
    penalty : float
        K of eq. 19 of the paper's model; 0: large enough to hold.
    grip : float
        K of eq. 19 of the elastic models; 0: held as confidence says; `HOLD_ALL`: all exactly.
    accuracy : float
        In pixels.
    device : str
        As `solve` takes it for its backend.
    """

    reading: Conditional = _form_field(  # noqa: RUF009 - a field of its own each time
        "centred",
        "reading",
        "With which lines of three pixels (the paper's cliques) a pixel is compared.\n"
        "centred: those whose middle it is. Nearest to finite elements.\n"
        "blanket: all that contain it. Borders of stiff and soft tissue hardly move.",
    )
    # Of a `Literal` with choices magicgui would show the values, not their words.
    method: str = _form_field(
        "steps",
        "steps",
        "Of a pixel in each sweep. Candidate steps: the paper's, of 1, 0.1, 0.01 and 0.001 "
        "pixels.\nClosed form: straight to where it fits best.",
        choices=[("candidate steps", "steps"), ("closed form", "closed form")],
    )
    sweeps: int = _form_field(
        ICM().iterations,
        "sweeps per level",
        "How often all pixels of a level are gone through, at most",
        min=1,
        max=100_000,
    )
    energy_change: float = _form_field(
        0.0,
        "stop when stable to",
        "Leave a level when its energy changes by less than this in ten sweeps",
        choices=[("never early", 0.0)]
        + [(f"{100 * part:g} %", part) for part in (1e-2, 1e-3, 1e-4, 1e-5)],
    )
    penalty: float = _form_field(
        0.0,
        "penalty K",
        "How firmly boundaries hold: energy per pixel of deviation from them",
        max=1e9,
        step=1000,
    )
    grip: float = _form_field(
        0.0,
        "holding force",
        "The greatest force that holds a boundary pixel, times its confidence: 1 strains the "
        "stiffest tissue by 1. Where tissue pulls harder, the pixel slips.\n"
        "By confidence: pixels of confidence 1 are held exactly, the others with a force of their "
        "confidence.\n1,000,000: all are held exactly, whatever their confidence",
        max=HOLD_ALL,
        step=0.01,
    )
    accuracy: float = _form_field(
        Multigrid.tolerance,
        "converged to",
        "No pixel is estimated to be further than this from where the model has it in the end",
        choices=[(f"{distance:g} px", distance) for distance in (1e-1, 1e-2, 1e-3, 1e-4)],
    )
    device: str = _form_field(
        "auto",
        "device",
        "Automatic: the graphics card if there is one, else compiled loops on the CPU",
        choices=[
            ("automatic", "auto"),
            ("OpenGL", "opengl"),
            ("OpenGL, fragment", "opengl:fragment"),
            ("OpenGL, compute", "opengl:compute"),
            ("CPU", "cpu"),
        ],
    )


_USUAL = SolverDetails()


def asked(model: ModelName) -> tuple[str, ...]:
    """The details that a model knows, in their order."""
    if model in ELASTIC:
        return "grip", "accuracy", "device"
    if model == "paper":
        return "reading", "method", "sweeps", "energy_change", "penalty", "device"
    return "reading", "penalty", "accuracy", "device"


def prior_of(
    model: ModelName,
    details: SolverDetails = _USUAL,
    plane: Plane = "stress",
    poisson: float = USUAL_POISSON,
) -> Prior:
    """The energy of a model; of tissue by labels their table has Poisson's ratios."""
    if model in ELASTIC:
        kind = ElasticPrior if model == "elastic" else NeoHookeanPrior
        penalty = math.inf if details.grip >= HOLD_ALL else details.grip or None
        return kind(poisson, plane=plane, penalty=penalty)
    return SeilerPrior(penalty=details.penalty or None, conditional=details.reading)


def optimizer_of(model: ModelName, details: SolverDetails = _USUAL) -> Optimizer:
    """How the energy of a model is minimised."""
    if model != "paper":
        return Multigrid(details.accuracy)
    steps: dict[str, Any] = {} if details.method == "steps" else {"steps": None}
    return ICM(details.sweeps, energy_change=details.energy_change or None, **steps)


def chosen(name: str) -> tuple[Prior, Optimizer]:
    """Return the energy of a model, and how it is minimised.

    Parameters
    ----------
    name : str
        A `ModelName`, or the same with dashes, as the shell writes it: "large-motion".

    Raises
    ------
    ArgumentError
        If there is no model of that name.
    """
    model = MODELS.get(as_word(name)) if isinstance(name, str) else None
    if model is None:
        listed = ", ".join(f'"{each}"' for each in get_args(ModelName))
        raise ArgumentError(f"there is no model {name!r}. Take one of {listed}.")
    return prior_of(model), optimizer_of(model)


def details_of(prior: Prior, optimizer: Optimizer) -> SolverDetails:
    """The details by which `prior_of` and `optimizer_of` make these two."""
    details = _USUAL
    if isinstance(prior, SeilerPrior):
        details = replace(details, reading=prior.conditional, penalty=prior.penalty or 0.0)
    elif prior.penalty is not None:
        details = replace(details, grip=min(prior.penalty, HOLD_ALL))
    if isinstance(optimizer, ICM):
        method, change = "steps" if optimizer.steps else "closed form", optimizer.energy_change
        return replace(
            details, sweeps=optimizer.iterations, method=method, energy_change=change or 0.0
        )
    return replace(details, accuracy=optimizer.parameters["tolerance"])


def family_of(prior: Prior, optimizer: Optimizer) -> ModelName:
    """The model of a menu that these two belong to."""
    if isinstance(prior, NeoHookeanPrior):
        return "large motion"
    if isinstance(prior, ElasticPrior):
        return "elastic"
    return "paper, converged" if isinstance(optimizer, Multigrid) else "paper"
