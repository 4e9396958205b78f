"""Where intensities and stiffnesses lie on a plot of a curve, and what to write beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from napari_hmrf.tissue.stiffness_curve import Point, StiffnessCurve

#: Of a plot: how far the stiffnesses reach beyond those of the points, so that there is room to
#: drag a point up.
_ROOM_LOGARITHMIC, _ROOM = 2.5, 1.3


@dataclass(frozen=True)
class CurveAxes:
    """The ranges of a plot; places in it are fractions, from the left and from the bottom.

    Attributes
    ----------
    left, right : float
        Intensities.
    bottom, top : float
        Stiffnesses.
    logarithmic : bool
        Whether factors of stiffness are equally far apart, and not amounts.
    """

    left: float
    right: float
    bottom: float
    top: float
    logarithmic: bool

    @classmethod
    def around(cls, curve: StiffnessCurve, lowest: float, highest: float) -> CurveAxes:
        """Have room for all intensities and all points of a curve, and some more."""
        marks = [intensity for intensity, _ in curve.points]
        marks += [] if curve.void_below is None else [curve.void_below]
        left, right = min(lowest, *marks), max(highest, *marks)
        softest, stiffest = curve.range
        if curve.logarithmic:
            bottom, top = softest / _ROOM_LOGARITHMIC, stiffest * _ROOM_LOGARITHMIC
        else:
            bottom, top = 0.0, stiffest * _ROOM
        return cls(left, right, bottom, top, curve.logarithmic)

    def place(self, point: Point) -> tuple[float, float]:
        """Where a point lies: fractions from the left and from the bottom."""
        intensity, stiffness = point
        across = (intensity - self.left) / (self.right - self.left)
        if not self.logarithmic:
            return across, (stiffness - self.bottom) / (self.top - self.bottom)
        stiffness = max(stiffness, 1e-300)
        return across, math.log(stiffness / self.bottom) / math.log(self.top / self.bottom)

    def point(self, across: float, up: float) -> Point:
        """What lies at a place, as near as it lies in the plot; to four digits."""
        across, up = (min(max(part, 0.0), 1.0) for part in (across, up))
        intensity = self.left + across * (self.right - self.left)
        step = 10 ** math.floor(math.log10(self.right - self.left) - 3)
        if self.logarithmic:
            stiffness = self.bottom * (self.top / self.bottom) ** up
        else:
            stiffness = max(self.bottom + up * (self.top - self.bottom), self.top / 1000)
        return round(intensity / step) * step, float(f"{stiffness:.3g}")

    def stiffness_ticks(self) -> list[float]:
        """Round stiffnesses, three to six or so."""
        if not self.logarithmic:
            return _round_numbers(self.bottom, self.top)
        first, last = math.floor(math.log10(self.bottom)), math.ceil(math.log10(self.top))
        for parts in ((1, 2, 5), (1, 3), (1,)):
            ticks = [
                part * 10.0**power
                for power in range(first, last + 1)
                for part in parts
                if self.bottom <= part * 10.0**power <= self.top
            ]
            if len(ticks) <= 6:
                break
        return ticks[:: max(1, len(ticks) // 6)]

    def intensity_ticks(self) -> list[float]:
        """Round intensities, three to six or so."""
        return _round_numbers(self.left, self.right)


def _round_numbers(low: float, high: float) -> list[float]:
    step = 10.0 ** math.floor(math.log10((high - low) / 3))
    step *= next(part for part in (5, 2, 1) if part * step * 3 <= (high - low) * 1.000001)
    ticks = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [number * step for number in ticks]
