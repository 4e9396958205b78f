"""Tissue from probability maps: the most likely tissue of each pixel, and its material."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.tissue.boundary_rules import Material

#: Name of the material of pixels without a likely tissue.
NONE = "none"
#: Allowed scales of probability maps: the values that mean certainty.
SCALES = 1, 100, 255
#: Factor by which the largest value may exceed the scale, because maps may be interpolated.
_BEYOND = 1.001


class MapRange(NamedTuple):
    """Type and range of the values of a probability map.

    Attributes
    ----------
    kind : numpy.dtype
    low, high : float
        Smallest and largest value; NaN if the map has NaN.
    """

    kind: np.dtype[Any]
    low: float
    high: float

    @classmethod
    def of(cls, values: npt.ArrayLike) -> MapRange:
        """Return the type and range of an array; the range of an empty array is (0, 0)."""
        array = as_numbers("tissue", values)
        if not array.size:
            return cls(array.dtype, 0.0, 0.0)
        return cls(array.dtype, float(array.min()), float(array.max()))


def scale_of(
    maps: Mapping[str, MapRange], scale: float | None = None, *, fix: str = "pass its scale="
) -> float:
    """Return the common scale of all maps: 1, 100 or 255, the value that means certainty.

    Parameters
    ----------
    maps : mapping of str to MapRange
        Ranges of the whole maps by name. (The range of a single slice may be too small.)
    scale : {1, 100, 255}, optional
        Known scale. The default is the smallest scale that no value of the maps exceeds.
    fix : str
        Additional remedy for error messages, in the words of the user interface. The messages
        always suggest probabilities from 0 to 1.

    Returns
    -------
    float

    Raises
    ------
    ProblemError
        If a map has negative values or NaN, if it exceeds the scale, if its scale differs from the
        scale of other maps, or if the scale of 8-bit maps is ambiguous (100 or 255). The message
        names the map.
    """
    if scale is not None and not any(scale == each for each in SCALES):
        raise ProblemError("tissue", f"has a scale of {shown(scale)}. Use 1, 100 or 255.")
    give = "Use probabilities from 0 to 1 in all maps"
    for number, (name, each) in enumerate(maps.items(), 1):
        wrong = ""
        if not math.isfinite(each.low) or not math.isfinite(each.high):
            wrong = "NaN or infinite values"
        elif each.low < 0:
            wrong = f"negative values, down to {each.low:g}"
        elif each.high > SCALES[-1] * _BEYOND:
            wrong = f"values up to {each.high:g}"
        elif scale is not None and each.high > scale * _BEYOND:
            wrong = f"values up to {each.high:g}, above the scale of {scale:g}"
        if wrong:
            raise ProblemError("tissue", f"has {wrong} in map {number} ({name}). {give}.")
    if scale is not None:
        return float(scale)
    large = max(each.high for each in maps.values())
    if large <= _BEYOND:
        return 1.0
    most = next(name for name, each in maps.items() if each.high == large)
    for number, (name, each) in enumerate(maps.items(), 1):
        if 0 < each.high <= _BEYOND:
            raise ProblemError(
                "tissue",
                f"has values up to {each.high:g} in map {number} ({name}), but up to {large:g} in "
                f"the map {most}. {give}{fix and f', or {fix}'}.",
            )
    is_bytes = any(each.kind == np.uint8 for each in maps.values() if each.high)
    if is_bytes and large < 100:
        number = [*maps].index(most) + 1
        raise ProblemError(
            "tissue",
            f"has values up to {large:g} in map {number} ({most}), whose scale may be 100 or 255. "
            f"{give}{fix and f', or {fix}'}.",
        )
    return next(float(each) for each in SCALES if large <= each * _BEYOND)


def scale_in_words(scale: float) -> str:
    """Return a clause that describes the scale of maps; "" for probabilities from 0 to 1."""
    words = {100: "per cent", 255: "probabilities from 0 to 255"}.get(int(scale))
    return f"the maps are read as {words}" if words else ""


def most_likely(
    maps: Mapping[str, npt.ArrayLike],
    scale: float | None = None,
) -> npt.NDArray[np.integer]:
    """Return the label of the most likely tissue of each pixel; 0 if "none" is more likely.

    Parameters
    ----------
    maps : mapping of str to array_like, all of one shape
        Probability maps of the tissues by name, with a common scale. The remaining probability is
        the probability of "none".
    scale : {1, 100, 255}, optional
        As for `scale_of`.

    Returns
    -------
    ndarray of int
        Position of the most likely map in `maps`, counted from 1; 0 for "none".

    Raises
    ------
    ProblemError
        If there are no maps, if the maps differ in shape, or as for `scale_of`.
    """
    arrays = [as_numbers("tissue", values) for values in maps.values()]
    if not arrays:
        raise ProblemError("tissue", "has no maps. Pass one for each tissue.")
    for number, array in enumerate(arrays, 1):
        if array.shape != arrays[0].shape:
            raise ProblemError(
                "tissue",
                f"has a first map of shape {arrays[0].shape}, but map {number} has shape "
                f"{array.shape}. Use the same pixel grid for all maps.",
            )
    ranges = dict(zip(maps, map(MapRange.of, arrays), strict=True))
    certain = scale_of(ranges, scale)
    likely = np.stack(arrays).astype(float)
    none = certain - likely.sum(axis=0)
    is_tissue = likely.max(axis=0) > np.maximum(none, 0.0)
    labels = np.where(is_tissue, 1 + likely.argmax(axis=0), 0)
    return labels.astype(np.min_scalar_type(len(arrays)))


def materials_of_maps(
    names: Sequence[str], materials: Mapping[str, Any] | Sequence[Material]
) -> tuple[Material, ...]:
    """Assign materials by name to the labels that `most_likely` returns.

    Parameters
    ----------
    names : sequence of str
        Names of the tissues in the order of their maps.
    materials : mapping of str to Material or float, or sequence of Material
        Materials, or stiffnesses, by name; "none" is for pixels without a likely tissue. The labels
        of the materials are ignored.

    Returns
    -------
    tuple of Material
        Materials with new labels: the position of the name in `names`, counted from 1, or 0 for
        "none".

    Raises
    ------
    ProblemError
        If a tissue has no material, or a material has no tissue.
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
            "tissue", f'{wrong}. Pass one for each of {_quoted(names)}; "{NONE}" is for the rest.'
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
                "tissue", f"has {shown(row)} for '{name}'. Pass a Material or a stiffness."
            ) from None
    return tuple(rows)


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
