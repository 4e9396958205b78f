"""Scalars of an iteration, for images and volumes: numbers that stay on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

ScalarType = TypeVar("ScalarType")


class Ratio(NamedTuple, Generic[ScalarType]):
    """One number over another: the kernel that reads it divides."""

    # See ``scalars.glsl`` and ``volume_scalars.glsl``.
    above: ScalarType
    below: ScalarType


def values_of(
    numbers: Sequence[ScalarType | Ratio[ScalarType]], value: Callable[[ScalarType], float]
) -> tuple[float, ...]:
    """Return the values of numbers on the host, given those of scalars.

    As in the kernels, a ratio is 0 unless both of its scalars are positive.
    """
    found = []
    for number in numbers:
        if isinstance(number, Ratio):
            above, below = value(number.above), value(number.below)
            found.append(above / below if above > 0 and below > 0 else 0.0)
        else:
            found.append(value(number))
    return tuple(found)
