"""Priors and optimizers of the named models."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, get_args

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.model_names import ELASTIC, MODELS, ModelName, Plane, as_word
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior
from napari_hmrf.solver.priors.seiler import Conditional
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON

#: Default prior and default optimizer of a study.
USUAL_PRIOR, USUAL_OPTIMIZER = ElasticPrior(), Multigrid()
#: Budgets of large motion in the form, in linear solves.
WORK_STEPS = 60.0, 300.0, 1500.0
#: Spring strength in the form that enforces all observations exactly, regardless of confidence.
HOLD_ALL = 1e6


def _form_field(usual: Any, label: str, tooltip: str, **options: Any) -> Any:
    """Return a dataclass field with the label, tooltip and choices of its form control."""
    options["tooltip"] = tooltip
    return field(default=usual, metadata={"label": label, "options": options})


@dataclass(frozen=True)
class SolverDetails:
    """Optional settings of a solve.

    A form is generated from these fields; `detail_names` lists the fields that apply to a model.
    Zero stands for None in the priors and optimizers.

    Attributes
    ----------
    reading : {"centred", "blanket"}
        Argument `conditional` of `SeilerPrior`.
    method : {"steps", "closed form"}
        Candidate steps or exact steps of `ICM`.
    sweeps : int
        Argument `iterations` of `ICM`.
    energy_change : float
        Argument `energy_change` of `ICM`; 0 to perform all sweeps of each level.
    penalty : float
        K of eq. 19 in the paper's model; 0 for a value that enforces boundary conditions.
    grip : float
        K of eq. 19 in the elastic models; 0 to constrain observations according to their
        confidence; `HOLD_ALL` to enforce all observations exactly.
    accuracy : float
        Tolerance of `Multigrid`, in pixels.
    budget : float
        Budget of `Multigrid` for large motion, in linear solves; 0 for no limit.
    """

    reading: Conditional = _form_field(  # noqa: RUF009 - a new field on each call
        "centred",
        "reading",
        "Lines of three pixels (the paper's cliques) used to compare a pixel with others.\n"
        "centred: lines with the pixel in the middle. Closest to finite elements.\n"
        "blanket: all lines that contain the pixel. Borders of stiff and soft tissue hardly move.",
    )
    # Annotated as str, because magicgui shows the values of a `Literal` instead of the labels.
    method: str = _form_field(
        "steps",
        "steps",
        "Steps of a pixel in each sweep.\nCandidate steps: the steps of the paper, 1, 0.1, 0.01 "
        "and 0.001 pixels.\nClosed form: a single step to the best position.",
        choices=[("candidate steps", "steps"), ("closed form", "closed form")],
    )
    sweeps: int = _form_field(
        ICM().iterations,
        "sweeps per level",
        "Largest number of passes over all pixels of a level",
        min=1,
        max=100_000,
    )
    energy_change: float = _form_field(
        0.0,
        "stop when stable to",
        "End a level when its energy changes by less than this fraction in ten sweeps",
        choices=[("never early", 0.0)]
        + [(f"{100 * part:g} %", part) for part in (1e-2, 1e-3, 1e-4, 1e-5)],
    )
    penalty: float = _form_field(
        0.0,
        "penalty K",
        "Strength of the boundary conditions: energy per pixel of deviation from them",
        max=1e9,
        step=1000,
    )
    grip: float = _form_field(
        0.0,
        "spring strength",
        "Largest force of the spring that holds a boundary pixel, multiplied by its confidence. A "
        "force of 1 strains the stiffest tissue by 1. Where tissue pulls harder, the pixel slips.\n"
        "By confidence: pixels with confidence 1 are held exactly, other pixels with a force equal "
        "to their confidence.\n1,000,000: all pixels are held exactly, regardless of confidence",
        max=HOLD_ALL,
        step=0.01,
    )
    accuracy: float = _form_field(
        Multigrid.tolerance,
        "tolerance",
        "Largest accepted error of any pixel, as estimated by the solver.\n"
        "The error is the distance from the field that further iterations would reach.",
        choices=[(f"{distance:g} px", distance) for distance in (1e-1, 1e-2, 1e-3, 1e-4)],
    )
    budget: float = _form_field(
        0.0,
        "largest work",
        "Work after which a solve of large motion stops, in solves of linear elasticity.\n"
        "It then shows the best motion so far and what is missing; 'Continue' goes on.",
        choices=[*((f"{times:g} linear solves", times) for times in WORK_STEPS), ("no limit", 0.0)],
    )


_USUAL = SolverDetails()


def detail_names(model: ModelName) -> tuple[str, ...]:
    """List the details that apply to a model, in the order of the form."""
    if model == "large motion":
        return "grip", "accuracy", "budget"
    if model == "elastic":
        return "grip", "accuracy"
    if model == "paper":
        return "reading", "method", "sweeps", "energy_change", "penalty"
    return "reading", "penalty", "accuracy"


def prior_of(
    model: ModelName,
    details: SolverDetails = _USUAL,
    plane: Plane = "stress",
    poisson: float = USUAL_POISSON,
) -> Prior:
    """Return the prior of a model; the materials of tissue labels override `poisson`."""
    if model in ELASTIC:
        kind = ElasticPrior if model == "elastic" else NeoHookeanPrior
        penalty = math.inf if details.grip >= HOLD_ALL else details.grip or None
        return kind(poisson, plane=plane, penalty=penalty)
    return SeilerPrior(penalty=details.penalty or None, conditional=details.reading)


def optimizer_of(model: ModelName, details: SolverDetails = _USUAL) -> ICM | Multigrid:
    """Return the optimizer of a model."""
    if model == "large motion":
        return Multigrid(details.accuracy, budget=details.budget or None)
    if model != "paper":
        return Multigrid(details.accuracy)
    steps: dict[str, Any] = {} if details.method == "steps" else {"steps": None}
    return ICM(details.sweeps, energy_change=details.energy_change or None, **steps)


#: Prior and optimizer of each model, with default details.
_BY_NAME: dict[ModelName, tuple[Prior, ICM | Multigrid]] = {
    name: (prior_of(name), optimizer_of(name)) for name in MODELS.values()
}


def parts_of(name: str) -> tuple[Prior, ICM | Multigrid]:
    """Return the prior and the optimizer of a model, with default settings.

    Parameters
    ----------
    name : str
        A `ModelName`, or its spelling with dashes as in the shell, such as "large-motion".

    Raises
    ------
    ArgumentError
        If the name is unknown.
    """
    model = MODELS.get(as_word(name)) if isinstance(name, str) else None
    if model is None:
        listed = ", ".join(f'"{each}"' for each in get_args(ModelName))
        raise ArgumentError(f"unknown model {name!r}. Use one of {listed}.")
    return _BY_NAME[model]


def is_by_name(part: Prior | Optimizer) -> bool:
    """Return whether a prior or optimizer is a default or was returned by `parts_of`."""
    known = [(USUAL_PRIOR, USUAL_OPTIMIZER), *_BY_NAME.values()]
    return any(part is each for pair in known for each in pair)


def details_of(prior: Prior, optimizer: Optimizer) -> SolverDetails:
    """Return the details for which `prior_of` and `optimizer_of` return the given objects."""
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
    parameters = optimizer.parameters
    details = replace(details, accuracy=parameters["tolerance"])
    if not isinstance(prior, NeoHookeanPrior):
        return details
    return replace(details, budget=parameters.get("budget", Multigrid.budget) or 0.0)


def larger_budget(budget: float) -> float:
    """Return the next larger budget of the form, or 0, which stands for no limit."""
    return min((larger for larger in WORK_STEPS if larger > budget), default=0.0)


def family_of(prior: Prior, optimizer: Optimizer) -> ModelName:
    """Return the name of the model to which a prior and an optimizer belong."""
    if isinstance(prior, NeoHookeanPrior):
        return "large motion"
    if isinstance(prior, ElasticPrior):
        return "elastic"
    return "paper, converged" if isinstance(optimizer, Multigrid) else "paper"
