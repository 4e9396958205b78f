"""Names of the tissue models and planes for display, for files and for the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, get_args

#: Names of the models: linear elasticity, finite strain, the paper's random field with its schedule
#: of sweeps, and the same random field at convergence.
ModelName = Literal["elastic", "large motion", "paper", "paper, converged"]
#: Plane stress, in which a slice can bulge, or plane strain.
Plane = Literal["stress", "strain"]
#: Models that have an elastic strain.
ELASTIC: tuple[ModelName, ...] = "elastic", "large motion"


def as_word(name: str) -> str:
    """Return the name of a model as one word, as typed in a shell or in a table."""
    return re.sub(r"[\s,_-]+", "-", name.strip().casefold())


#: Models by the word that users type.
MODELS: dict[str, ModelName] = {as_word(name): name for name in get_args(ModelName)}

# Largest `energy_change` of a schedule of sweeps that is considered converged.
_CONVERGED_CHANGE = 1e-7


def model_name(parameters: Mapping[str, Any]) -> str:
    """Return the name of the model of a result.

    Parameters
    ----------
    parameters : mapping
        Parameters of prior and optimizer, as in `Provenance.parameters`. Values may have any type,
        because they may come from a file.

    Returns
    -------
    str
        A `ModelName`, with "blanket" after "paper" if the prior uses the blanket reading, as in
        "paper, blanket, converged"; "" if the model is unknown.
    """
    prior, optimizer = _parts(parameters)
    if prior.get("name") == "ElasticPrior":
        return "elastic"
    if prior.get("name") == "NeoHookeanPrior":
        return "large motion"
    if prior.get("name") != "SeilerPrior":
        return ""
    blanket = ["blanket"] if prior.get("conditional") == "blanket" else []
    return ", ".join(["paper", *blanket, *(["converged"] if converged(optimizer) else [])])


def in_words(parameters: Mapping[str, Any]) -> str:
    """Describe the model and the schedule of a result; "unknown" if they are not recorded.

    Parameters
    ----------
    parameters : mapping
        As for `model_name`.
    """
    prior, optimizer = _parts(parameters)
    if prior.get("name") in ("ElasticPrior", "NeoHookeanPrior"):
        model = "elastic" if prior["name"] == "ElasticPrior" else "large motion"
        nu = prior.get("poisson")
        ratio = f"{nu:g}" if isinstance(nu, int | float) else "by tissue"
        plane = f", plane {prior['plane']}" if "plane" in prior else ""  # a volume has none
        description = f"{model} (Poisson's ratio {ratio}{plane})"
    elif prior.get("name") == "SeilerPrior":
        description = f"the paper's prior ({prior.get('conditional')})"
    else:
        return "unknown"
    if converged(optimizer):
        return f"{description}, converged"
    return f"{description}, {optimizer.get('iterations')} sweeps per level"


def is_multigrid(parameters: Mapping[str, Any]) -> bool:
    """Return whether a result was computed by multigrid cycles, rather than by sweeps."""
    return _parts(parameters)[1].get("name") == "Multigrid"


def converged(optimizer: Mapping[str, Any]) -> bool:
    """Return whether an optimizer with these parameters iterates until convergence."""
    change = optimizer.get("energy_change")
    exact = isinstance(change, int | float) and change <= _CONVERGED_CHANGE
    return optimizer.get("name") == "Multigrid" or exact


def _parts(parameters: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the parameters of the prior and of the optimizer; empty if they are missing."""
    known = parameters if isinstance(parameters, Mapping) else {}
    prior, optimizer = (known.get(part) for part in ("prior", "optimizer"))
    return (
        prior if isinstance(prior, Mapping) else {},
        optimizer if isinstance(optimizer, Mapping) else {},
    )
