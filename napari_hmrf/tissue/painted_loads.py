"""Conversion of painted labels and their tables to loads on tissue."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from operator import add

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.body_forces import pressure, traction
from napari_hmrf.solver.loads import Loads, growth
from napari_hmrf.solver.problem import FloatArray
from napari_hmrf.tissue.boundary_rules import FORCES, BoundaryRule, Material, quoted


def growth_loads(labels: npt.ArrayLike, materials: Iterable[Material]) -> Loads | None:
    """Return the growth of the tissues of an image.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
        Label of the tissue at each pixel.
    materials : iterable of Material
        Materials with their growth; labels without a material do not grow.

    Returns
    -------
    Loads or None
        Loads of the growth, or None if no tissue grows.

    Raises
    ------
    ProblemError
        If a growth does not have one number for each axis of the image.
    """
    image, parts = np.asarray(labels), []
    for material in materials:
        mask = image == material.label
        if not (material.grows and mask.any()):
            continue
        if not isinstance(material.growth, tuple):
            parts.append(growth(material.growth * mask))
            continue
        if len(material.growth) != image.ndim:
            raise ProblemError(
                "stiffness",
                f"gives {quoted(material)} a growth of {material.growth}. Use {image.ndim} "
                "numbers, one per axis.",
            )
        axes = zip(material.growth, np.eye(image.ndim), strict=True)
        parts += [growth(part * mask, along=axis) for part, axis in axes]
    return reduce(add, parts) if parts else None


def boundary_loads(
    labels: npt.ArrayLike,
    rules: Iterable[BoundaryRule],
    stiffness: FloatArray,
    *,
    spacing: Sequence[float],
) -> Loads | None:
    """Return the pressure and traction on the surface of tissue under painted labels.

    Parameters
    ----------
    labels, rules, spacing
        As for `boundary_images`, which checks them.
    stiffness : ndarray, shape ([D,] H, W)
        Stiffness of each pixel; 0 where there is no tissue.

    Returns
    -------
    Loads or None
        Loads of the forces, or None if no rule applies a force.

    Raises
    ------
    ProblemError
        If a label with a force does not cover any surface of tissue.
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
