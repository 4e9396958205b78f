"""Which energy tissue has and how far it is minimised: chosen in a word, and told in a few."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from napari_hmrf.solver.optimizers import Optimizer

#: The paper's Markov random field, or linear elasticity.
Model = Literal["paper", "elastic"]
#: By the paper's schedule, or until the field no longer changes.
Schedule = Literal["paper", "converged"]

# Sweeps that may end only once the energy stands still to so many digits converge, too.
_STILL = 1e-7


def converges(optimizer: Optimizer) -> bool:
    """Whether an optimizer goes on until the field no longer changes."""
    return _converges(optimizer.parameters)


def is_multigrid(parameters: Mapping[str, Any]) -> bool:
    """Whether a result's iterations are cycles over all levels, not sweeps on each."""
    return _parts(parameters)[1].get("name") == "Multigrid"


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
    prior, optimizer = _parts(parameters)
    if prior.get("name") == "ElasticPrior":
        return "elastic"
    words = ["blanket"] if prior.get("conditional") == "blanket" else []
    return ", ".join([*words, "converged"] if _converges(optimizer) else words)


def in_words(parameters: Mapping[str, Any]) -> str:
    """Which energy was minimised, and how; "unknown" if that is not told.

    Parameters
    ----------
    parameters : mapping
        As for `short_name`.
    """
    prior, optimizer = _parts(parameters)
    if prior.get("name") == "ElasticPrior":
        nu = prior.get("poisson")
        ratio = f"{nu:g}" if isinstance(nu, int | float) else "by tissue"
        what = f"elastic (Poisson's ratio {ratio}, plane {prior.get('plane')})"
    elif prior.get("name") == "SeilerPrior":
        what = f"the paper's prior ({prior.get('conditional')})"
    else:
        return "unknown"
    if _converges(optimizer):
        return f"{what}, converged"
    return f"{what}, {optimizer.get('iterations')} sweeps per level"


def _parts(parameters: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    prior, optimizer = (parameters.get(part) for part in ("prior", "optimizer"))
    return (
        prior if isinstance(prior, Mapping) else {},
        optimizer if isinstance(optimizer, Mapping) else {},
    )


def _converges(optimizer: Mapping[str, Any]) -> bool:
    change = optimizer.get("energy_change")
    exact = isinstance(change, int | float) and change <= _STILL
    return optimizer.get("name") == "Multigrid" or exact
