"""Priors and optimizers from their parameters, as solutions and files record them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior

_Kind = TypeVar("_Kind")


def prior_from_dict(parameters: Mapping[str, Any], poisson: Any = None) -> Prior:
    """The prior of these `parameters`; a map of Poisson's ratios is given beside them.

    Raises
    ------
    ArgumentError
        If there is none of that name or with such parameters.
    """
    kinds: dict[str, type[Prior]] = {
        "ElasticPrior": ElasticPrior,
        "NeoHookeanPrior": NeoHookeanPrior,
        "SeilerPrior": SeilerPrior,
    }
    more: dict[str, Any] = {} if poisson is None else {"poisson": poisson}
    if parameters.get("penalty") == "inf":
        more["penalty"] = math.inf
    return _made(kinds, {**parameters, **more})


def optimizer_from_dict(parameters: Mapping[str, Any]) -> Optimizer:
    """The optimizer of these `parameters`.

    Raises
    ------
    ArgumentError
        As of `prior_from_dict`.
    """
    kinds: dict[str, type[Optimizer]] = {"ICM": ICM, "Multigrid": Multigrid}
    return _made(kinds, parameters)


def _made(kinds: Mapping[str, type[_Kind]], parameters: Mapping[str, Any]) -> _Kind:
    values = dict(parameters)
    name = values.pop("name", None)
    if name not in kinds:
        raise ArgumentError(f"there is no {name!r}. Take one of {', '.join(kinds)}.")
    try:
        return kinds[name](**values)
    except TypeError as error:
        raise ArgumentError(f"{name} cannot have been made of {values}") from error
