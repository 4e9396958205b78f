"""Ratios of scalars on the device, for images and volumes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

ScalarType = TypeVar("ScalarType")


class Ratio(NamedTuple, Generic[ScalarType]):
    """Unevaluated ratio of two scalars on the device."""

    # Kernels compute the ratio with ``scalars.glsl`` or ``volume_scalars.glsl``.
    above: ScalarType
    below: ScalarType


def values_of(
    numbers: Sequence[ScalarType | Ratio[ScalarType]], value: Callable[[ScalarType], float]
) -> tuple[float, ...]:
    """Return the values of scalars and ratios on the host.

    As in the kernels, a ratio is 0 unless both of its scalars are positive.

    Parameters
    ----------
    numbers : sequence
        Scalars and ratios.
    value : callable
        Function that returns the value of a scalar.
    """
    found = []
    for number in numbers:
        if isinstance(number, Ratio):
            above, below = value(number.above), value(number.below)
            found.append(above / below if above > 0 and below > 0 else 0.0)
        else:
            found.append(value(number))
    return tuple(found)
