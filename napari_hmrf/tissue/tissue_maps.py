"""Tissue from maps of likelihood: the most likely tissue of each pixel, and its material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.problem import as_numbers
from napari_hmrf.tissue.boundary_rules import Material

#: The name by which materials say what pixels without a likely tissue are.
NONE = "none"


def most_likely(maps: Sequence[npt.ArrayLike]) -> npt.NDArray[np.integer]:
    """Return the label of the most likely tissue of each pixel; 0 if "none" is more likely.

    Parameters
    ----------
    maps : sequence of array_like, all of one shape
        Likelihoods from 0 to 1, 100 or 255; "none" has the rest. NaN counts as 0.

    Returns
    -------
    ndarray of int
        The place of the most likely map in the sequence, from 1 on.

    Raises
    ------
    ProblemError
        If there are no maps, or they differ in shape, or a likelihood is negative.
    """
    arrays = [as_numbers("tissue", values) for values in maps]
    if not arrays:
        raise ProblemError("tissue", "has no maps. Give one for each tissue.")
    for number, array in enumerate(arrays, 1):
        if array.shape != arrays[0].shape:
            raise ProblemError(
                "tissue",
                f"has a first map of shape {arrays[0].shape}, but map {number} has shape "
                f"{array.shape}. Give all maps on the same pixels.",
            )
        if (array < 0).any():
            raise ProblemError(
                "tissue", f"has negative likelihoods in map {number}. Give 0 to 1, 100 or 255."
            )
    likely = np.nan_to_num(np.stack(arrays).astype(float))
    sure = max(1.0, float(likely.max()))  # 1, 100 or 255
    none = sure - likely.sum(axis=0)
    there = likely.max(axis=0) > np.maximum(none, 0.0)
    found = np.where(there, 1 + likely.argmax(axis=0), 0)
    return found.astype(np.min_scalar_type(len(arrays)))


def materials_of_maps(
    names: Sequence[str], materials: Mapping[str, Any] | Sequence[Material]
) -> tuple[Material, ...]:
    """Return the materials of tissues by name, with their place in `names`, from 1 on, as label.

    Parameters
    ----------
    names : sequence of str
    materials : mapping of str to Material or float, or sequence of Material
        By name, a number being a stiffness; "none" is for pixels without a likely tissue. The
        labels of materials are replaced.

    Raises
    ------
    ProblemError
        If a tissue has no material, or a material no tissue.
    """
    given = materials
    if not isinstance(given, Mapping):
        given = {row.name: row for row in given}
    labels = {NONE: 0} | {name: number for number, name in enumerate(names, 1)}
    missing, extra = [each for each in names if each not in given], [*given.keys() - labels.keys()]
    if missing or extra:
        wrong = f"has no material for {_quoted(missing)}" if missing else ""
        wrong += " and " if missing and extra else ""
        wrong += f"has no map for the material {_quoted(sorted(extra))}" if extra else ""
        raise ProblemError(
            "tissue", f'{wrong}. Give one for each of {_quoted(names)}; "{NONE}" is for the rest.'
        )
    rows = []
    for name, label in labels.items():
        if name not in given:
            continue
        row = given[name]
        if isinstance(row, Material):
            rows.append(replace(row, label=label, name=row.name or name))
            continue
        try:
            rows.append(Material(label, name, float(row)))
        except (TypeError, ValueError):
            raise ProblemError(
                "tissue", f"has {shown(row)} for '{name}'. Give a Material, or a stiffness."
            ) from None
    return tuple(rows)


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
