"""Units of length by their names, as layers and files spell them; rounded lengths.

Pint is imported with the first unit, as it takes a third of the time of importing the package.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

#: Names of units, as layers spell them. Pint also evaluates sums, which can take hours.
_UNIT = re.compile(r"[^\W\d]+( / [^\W\d]+)*")
#: Lengths below this part of a pixel, and shares below this part of a per cent, are rounding.
UNSEEN = 1e-3


def unit_factor(unit: str, to: str) -> float:
    """Return the size of one `unit` in `to`; NaN if they measure different quantities."""
    if unit == to:
        return 1.0
    import pint  # heavy: pint

    try:
        return float(_units().Quantity(1, unit).to(to).magnitude)
    except pint.errors.PintError:
        return float("nan")


def is_unit(unit: str) -> bool:
    """Return whether layers know a unit of that name."""
    if not _UNIT.fullmatch(unit):
        return False
    try:
        _units().Unit(unit)
    except Exception:  # noqa: BLE001 - parsing text of others raises what it likes
        return False
    return True


def unit_symbol(unit: str) -> str:
    """Return the symbol of a unit of length for tables: "px", "mm"."""
    if unit == "pixel":
        return "px"
    import pint  # heavy: pint

    try:
        return f"{_units().Unit(unit):~}" or unit
    except (pint.errors.PintError, ValueError):
        return unit


def as_seen(length: float, spacing: Iterable[float]) -> float:
    """Return a length to print: 0 if it is rounding, at the size of a pixel."""
    return 0.0 if abs(length) < UNSEEN * min(spacing) else length


def _units() -> Any:
    """Return the registry of units; not cached, as an application may set another."""
    import pint  # heavy: pint

    return pint.get_application_registry()  # type: ignore[no-untyped-call]
