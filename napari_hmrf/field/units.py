"""Units of length, named as in layers and files, and rounding of displayed lengths.

The functions import pint on first use, because importing pint would take a third of the import time
of the package.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

from napari_hmrf.geometry import Geometry

#: Pattern of the names of units in layers. It excludes expressions, which pint may parse slowly.
_UNIT = re.compile(r"[^\W\d]+( / [^\W\d]+)*")
#: Fraction of a pixel, or of a per cent, below which a value is displayed as 0.
UNSEEN = 1e-3
#: Units of spacings without a known length.
UNKNOWN_UNITS = ("", "pixel")


def unit_factor(unit: str, to: str) -> float:
    """Return the factor that converts one unit to another; NaN if they are incompatible.

    Parameters
    ----------
    unit, to : str
        Names of the units.

    Returns
    -------
    float
        Number of `to` in one `unit`.
    """
    if unit == to:
        return 1.0
    try:
        return float(_units().Quantity(1, unit).to(to).magnitude)
    except Exception:  # noqa: BLE001 - pint raises errors of many types for invalid names
        return float("nan")


@lru_cache(maxsize=64, typed=True)  # units of two registries cannot be compared
def unit_name(unit: Any) -> str:
    """Return the name of a unit of a layer, because pint formats its units slowly."""
    return str(unit)


def has_same_spacing(
    shape: Sequence[int],
    spacing: Sequence[float],
    unit: str,
    other: Sequence[float],
    other_unit: str,
) -> bool:
    """Return whether two grids of the same shape have pixels of the same size.

    Parameters
    ----------
    shape : sequence of int
        Number of pixels along each axis.
    spacing, other : sequence of float
        Sizes of a pixel along each axis.
    unit, other_unit : str
        Units of the sizes. If one of the units is unknown, it is assumed to equal the other unit.

    Returns
    -------
    bool
        True if the grids, from the same first pixel, are in the same place; see
        `Geometry.same_as`. False if the units cannot be converted.
    """
    is_known = unit not in UNKNOWN_UNITS and other_unit not in UNKNOWN_UNITS
    factor = unit_factor(unit, other_unit) if is_known else 1.0
    own = Geometry.at_origin(shape, spacing).scaled(factor)
    return own.same_as(Geometry.at_origin(shape, other))


@lru_cache(maxsize=64)
def is_length(unit: str) -> bool:
    """Return whether a unit is one of length, or unknown."""
    common = ("millimeter", "mm", "micrometer", "um", *UNKNOWN_UNITS)
    return unit in common or unit_factor(unit, "millimeter") > 0


@lru_cache(maxsize=64)
def may_be_stiffness(unit: str) -> bool:
    """Return whether a unit is one of stiffness, or none that is known, such as "relative"."""
    if unit in ("", "Pa", "kPa", "MPa") or not is_unit(unit):
        return True
    return unit_factor(unit, "kPa") > 0 or unit_factor(unit, "dimensionless") > 0


def is_unit(unit: str) -> bool:
    """Return whether napari layers accept a unit with this name."""
    if not _UNIT.fullmatch(unit):
        return False
    try:
        _units().Unit(unit)
    except Exception:  # noqa: BLE001 - pint raises errors of many types for invalid names
        return False
    return True


def unit_symbol(unit: str) -> str:
    """Return the symbol of a unit of length, such as "px" or "mm", or its name if it has none."""
    if unit == "pixel":
        return "px"
    import pint  # heavy: pint

    try:
        return f"{_units().Unit(unit):~}" or unit
    except (pint.errors.PintError, ValueError):
        return unit


def as_seen(length: float, spacing: Iterable[float]) -> float:
    """Return a length for display: 0 if it is a negligible fraction of a pixel.

    Parameters
    ----------
    length : float
    spacing : iterable of float
        Size of a pixel along each axis, in the unit of the length.

    Returns
    -------
    float
    """
    return 0.0 if abs(length) < UNSEEN * min(spacing) else length


def _units() -> Any:
    """Return the unit registry of the layers, which an application may replace at any time."""
    import pint  # heavy: pint

    return pint.get_application_registry()  # type: ignore[no-untyped-call]
