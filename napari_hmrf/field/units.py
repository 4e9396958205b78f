"""Units of length by their names, as layers and files spell them; lengths as people see them.

Whoever needs no units does not wait for pint, which takes a third of the time that importing the
package does.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

#: Names of units, as layers spell them. What pint reads can be a sum that takes for ever.
_UNIT = re.compile(r"[^\W\d]+( / [^\W\d]+)*")
#: What is less than this part of a pixel, or of a per cent, is rounding, and nobody sees it.
UNSEEN = 1e-3


def unit_factor(unit: str, to: str) -> float:
    """How many `to` make one `unit`; NaN if they measure different things."""
    if unit == to:
        return 1.0
    import pint

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
    import pint

    try:
        return f"{_units().Unit(unit):~}" or unit
    except (pint.errors.PintError, ValueError):
        return unit


def as_seen(length: float, spacing: Iterable[float]) -> float:
    """A length for people to read: 0 if it is too small a part of a pixel to be seen."""
    return 0.0 if abs(length) < UNSEEN * min(spacing) else length


def _units() -> Any:
    """The units that layers know; asked for anew, as an application may set others."""
    import pint

    return pint.get_application_registry()  # type: ignore[no-untyped-call]
