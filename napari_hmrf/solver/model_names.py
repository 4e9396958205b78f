"""What tissue was taken to be, in a name or a few words: of a result, of a choice, in files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, get_args

#: Linear elasticity; finite strain; the paper's random field by its schedule; and where its sweeps
#: would end.
ModelName = Literal["elastic", "large motion", "paper", "paper, converged"]
#: Those of tissue that is strained.
ELASTIC: tuple[ModelName, ...] = "elastic", "large motion"


def as_word(name: str) -> str:
    """The name of a model as one word, as it is typed in a shell or in a table."""
    return re.sub(r"[\s,_-]+", "-", name.strip().casefold())


#: The models by what is typed for them.
MODELS: dict[str, ModelName] = {as_word(name): name for name in get_args(ModelName)}

# Sweeps that may end only once the energy stands still to so many digits converge, too.
_STILL = 1e-7


def model_name(parameters: Mapping[str, Any]) -> str:
    """The name of the model that a result is of.

    Parameters
    ----------
    parameters : mapping
        Of prior and optimizer, as `Provenance.parameters` has them; from a file they may be
        anything.

    Returns
    -------
    str
        A `ModelName`, with "blanket" after "paper" where the prior is read so, as in "paper,
        blanket, converged"; "" if it is not told.
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
    """Which energy was minimised, and how; "unknown" if that is not told.

    Parameters
    ----------
    parameters : mapping
        As for `model_name`.
    """
    prior, optimizer = _parts(parameters)
    if prior.get("name") in ("ElasticPrior", "NeoHookeanPrior"):
        kind = "elastic" if prior["name"] == "ElasticPrior" else "large motion"
        nu = prior.get("poisson")
        ratio = f"{nu:g}" if isinstance(nu, int | float) else "by tissue"
        plane = f", plane {prior['plane']}" if "plane" in prior else ""  # a volume has none
        what = f"{kind} (Poisson's ratio {ratio}{plane})"
    elif prior.get("name") == "SeilerPrior":
        what = f"the paper's prior ({prior.get('conditional')})"
    else:
        return "unknown"
    if converged(optimizer):
        return f"{what}, converged"
    return f"{what}, {optimizer.get('iterations')} sweeps per level"


def is_multigrid(parameters: Mapping[str, Any]) -> bool:
    """Whether a result's iterations are cycles over all levels, not sweeps on each."""
    return _parts(parameters)[1].get("name") == "Multigrid"


def converged(optimizer: Mapping[str, Any]) -> bool:
    """Whether an optimizer of these parameters goes on until the field no longer changes."""
    # "tolerance" in older files.
    change = optimizer.get("energy_change", optimizer.get("tolerance"))
    exact = isinstance(change, int | float) and change <= _STILL
    return optimizer.get("name") == "Multigrid" or exact


def _parts(parameters: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """The parameters of the prior and of the optimizer, where there are such."""
    known = parameters if isinstance(parameters, Mapping) else {}
    prior, optimizer = (known.get(part) for part in ("prior", "optimizer"))
    return (
        prior if isinstance(prior, Mapping) else {},
        optimizer if isinstance(optimizer, Mapping) else {},
    )
