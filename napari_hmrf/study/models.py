"""Which energy tissue has and how far it is minimised: chosen in a word, and told in a few."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.model_names import ModelName, converged, model_name, parts
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior, SeilerPrior

#: The paper's Markov random field, or linear elasticity.
Model = Literal["paper", "elastic"]
#: By the paper's schedule, or until the field no longer changes.
Schedule = Literal["paper", "converged"]


def chosen(name: str) -> tuple[Prior, Optimizer]:
    """The energy of a model, and how it is minimised.

    Raises
    ------
    ArgumentError
        If there is no model of that name.
    """
    if name not in get_args(ModelName):
        listed = ", ".join(f'"{each}"' for each in get_args(ModelName))
        raise ArgumentError(f"there is no model {name!r}. Take one of {listed}.")
    if name == "elastic":
        return ElasticPrior(), Multigrid()
    return SeilerPrior(), Multigrid() if name == "paper, converged" else ICM()


def converges(optimizer: Optimizer) -> bool:
    """Whether an optimizer goes on until the field no longer changes."""
    return converged(optimizer.parameters)


def is_multigrid(parameters: Mapping[str, Any]) -> bool:
    """Whether a result's iterations are cycles over all levels, not sweeps on each."""
    return parts(parameters)[1].get("name") == "Multigrid"


def short_name(parameters: Mapping[str, Any]) -> str:
    """What tells a result from that of the paper's prior and schedule; nothing, for those.

    Parameters
    ----------
    parameters : mapping
        Of a solution's provenance; from a file they may be anything.

    Returns
    -------
    str
        Such as "elastic", "converged" or "".
    """
    return model_name(parameters).removeprefix("paper").removeprefix(", ")


def in_words(parameters: Mapping[str, Any]) -> str:
    """Which energy was minimised, and how; "unknown" if that is not told.

    Parameters
    ----------
    parameters : mapping
        As for `short_name`.
    """
    prior, optimizer = parts(parameters)
    if prior.get("name") == "ElasticPrior":
        nu = prior.get("poisson")
        ratio = f"{nu:g}" if isinstance(nu, int | float) else "by tissue"
        what = f"elastic (Poisson's ratio {ratio}, plane {prior.get('plane')})"
    elif prior.get("name") == "SeilerPrior":
        what = f"the paper's prior ({prior.get('conditional')})"
    else:
        return "unknown"
    if converged(optimizer):
        return f"{what}, converged"
    return f"{what}, {optimizer.get('iterations')} sweeps per level"
