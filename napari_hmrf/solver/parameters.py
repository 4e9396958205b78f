"""Construction of priors and optimizers from the parameters recorded in solutions and files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior

_Kind = TypeVar("_Kind")


def prior_from_dict(parameters: Mapping[str, Any], poisson: Any = None) -> Prior:
    """Return the prior with the given parameters.

    Parameters
    ----------
    parameters : mapping
        Name and parameters, as in `ElasticPrior.parameters`.
    poisson : ndarray, shape (H, W) or (D, H, W), optional
        Map of Poisson's ratios; `parameters` contains only its digest.

    Raises
    ------
    ArgumentError
        If there is no prior with this name or with these parameters.
    """
    kinds: dict[str, type[Prior]] = {
        "ElasticPrior": ElasticPrior,
        "NeoHookeanPrior": NeoHookeanPrior,
        "SeilerPrior": SeilerPrior,
    }
    replaced: dict[str, Any] = {} if poisson is None else {"poisson": poisson}
    if parameters.get("penalty") == "inf":
        replaced["penalty"] = math.inf
    return _construct(kinds, {**parameters, **replaced})


def optimizer_from_dict(parameters: Mapping[str, Any]) -> Optimizer:
    """Return the optimizer with the given parameters.

    Parameters
    ----------
    parameters : mapping
        Name and parameters, as in `Multigrid.parameters`.

    Raises
    ------
    ArgumentError
        If there is no optimizer with this name or with these parameters.
    """
    kinds: dict[str, type[Optimizer]] = {"ICM": ICM, "Multigrid": Multigrid}
    return _construct(kinds, parameters)


def _construct(kinds: Mapping[str, type[_Kind]], parameters: Mapping[str, Any]) -> _Kind:
    values = dict(parameters)
    name = values.pop("name", None)
    if name not in kinds:
        raise ArgumentError(f"name is {name!r}. Pass one of {', '.join(kinds)}.")
    try:
        return kinds[name](**values)
    except TypeError as error:
        raise ArgumentError(f"{name} does not accept the parameters {values}") from error
