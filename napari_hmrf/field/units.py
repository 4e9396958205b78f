"""Units of length by their names, as layers and files spell them."""

from __future__ import annotations

import re
from typing import Any

import pint

#: Names of units, as layers spell them. What pint reads can be a sum that takes for ever.
_UNIT = re.compile(r"[^\W\d]+( / [^\W\d]+)*")


def unit_factor(unit: str, to: str) -> float:
    """How many `to` make one `unit`; NaN if they measure different things."""
    if unit == to:
        return 1.0
    try:
        return float(_units().Quantity(1, unit).to(to).magnitude)
    except pint.errors.PintError:
        return float("nan")


def is_unit(unit: str) -> bool:
    """Whether layers know a unit of that name."""
    if not _UNIT.fullmatch(unit):
        return False
    try:
        _units().Unit(unit)
    except Exception:  # noqa: BLE001 - parsing text of others raises what it likes
        return False
    return True


def unit_symbol(unit: str) -> str:
    """A unit of length as tables show it: "px", "mm"."""
    if unit == "pixel":
        return "px"
    try:
        return f"{_units().Unit(unit):~}" or unit
    except (pint.errors.PintError, ValueError):
        return unit


def _units() -> Any:
    """The units that layers know; asked for anew, as an application may set others."""
    return pint.get_application_registry()  # type: ignore[no-untyped-call]
