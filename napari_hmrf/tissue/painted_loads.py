"""From painted labels and their tables to the loads that tissue bears."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import add

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import real, reals, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.body_forces import pressure, traction
from napari_hmrf.solver.loads import Loads, growth
from napari_hmrf.solver.problem import FloatArray
from napari_hmrf.tissue.boundary_rules import FORCES, BoundaryRule, Material, is_growth, quoted


def growth_loads(labels: npt.ArrayLike, materials: Iterable[Material]) -> Loads | None:
    """Return the growth of the tissues of an image, as their materials say.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
    materials : iterable of Material
        What has none does not grow.

    Returns
    -------
    Loads or None
        None if nothing grows.

    Raises
    ------
    ProblemError
        If a growth is no number above -1 and up to 10, nor such a number for each axis.
    """
    image, parts = np.asarray(labels), []
    for material in materials:
        there = image == material.label
        if not (material.grows and there.any()):
            continue
        along = np.ndim(material.growth) > 0
        amounts = reals(material.growth, image.ndim) if along else (real(material.growth),)
        if not all(map(is_growth, amounts)):
            raise ProblemError(
                "stiffness",
                f"gives {quoted(material)} a growth of {shown(material.growth)}. Give a number "
                f"above -1, up to 10 (0.1: a tenth longer), or {image.ndim}, one along each axis.",
            )
        ways = np.eye(image.ndim) if along else [None]
        parts += [growth(far * there, along=way) for far, way in zip(amounts, ways, strict=True)]
    return reduce(add, parts) if parts else None


def boundary_loads(
    labels: npt.ArrayLike,
    rules: Iterable[BoundaryRule],
    stiffness: FloatArray,
    *,
    spacing: Sequence[float],
) -> Loads | None:
    """Press and pull at the tissue's surface where rules say so of what is painted.

    Parameters
    ----------
    labels, rules, spacing
        As for `boundary_images`, which checks them.
    stiffness : ndarray, shape ([D,] H, W)
        0 where there is no tissue.

    Returns
    -------
    Loads or None
        None if nothing presses or pulls.

    Raises
    ------
    ProblemError
        If no surface of tissue is painted so.
    """
    image, parts = np.asarray(labels), []
    for rule in rules:
        painted = image == rule.label
        if rule.action not in FORCES or not painted.any():
            continue
        try:
            if rule.action == "press":
                parts.append(pressure(stiffness, painted, rule.amount, spacing=spacing))
            else:
                vector = (*(0.0,) * (image.ndim - len(rule.vector)), *rule.vector)
                parts.append(traction(stiffness, painted, vector, spacing=spacing))
        except ProblemError as error:
            if error.field != "surface":
                raise
            raise ProblemError(error.field, f"under {quoted(rule)} {error.message}") from None
    return reduce(add, parts) if parts else None
