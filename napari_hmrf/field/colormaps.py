"""Colour maps and scales of strain and displacement, for the viewer and for saved pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

#: Colour map of signed values: purple and orange differ for every kind of colour blindness.
DIVERGING = "PuOr_r"
#: Colour map of values from 0 upwards: its lightness rises monotonically.
RISING = "magma"
#: Colour of folds: bright on the dark purple of tissue that is nearly folded.
FOLDED = "#ffee00"
#: Largest opacity of the colours over the image.
OPACITY = 0.8
# Fraction of the range of values from which on colours are fully opaque.
_OPAQUE = 0.4
# Percentile of the absolute values at which a scale ends; larger values are a few at corners.
_WITHIN = 99.0
# Values beyond a scale by less than this fraction of its length are not reported.
_NEARLY = 0.01
#: Smallest end of a scale; a hundred times this for values in per cent.
SMALLEST = 1e-3
# Ends of a scale with 0 in its middle, up to a power of ten. For these ends napari writes at least
# two numbers beside the scale; for ends such as 0.45 or 0.8 it writes only the 0.
_ENDS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 10.0)


def opacity(part: npt.ArrayLike, signed: bool) -> npt.NDArray[np.float64]:
    """Return the opacity of colours; it is low near no change, so that the image stays visible.

    Parameters
    ----------
    part : array_like
        Position in the range of the colour map, from 0 to 1.
    signed : bool
        True if no change is in the middle of the range; False if it is at the lower end.

    Returns
    -------
    ndarray
        From 0, transparent, to 1, opaque.
    """
    position = np.asarray(part, dtype=np.float64)
    amount = np.abs(2 * position - 1) if signed else position
    return np.minimum(1, amount / _OPAQUE)


def reach_of(values: npt.NDArray[Any], signed: bool = False, least: float = SMALLEST) -> float:
    """Return the end of a scale from 0 that covers nearly all values.

    Parameters
    ----------
    values : ndarray
        Values that are not finite are ignored.
    signed : bool
        True for a scale from the negative end to the positive end: the end is then rounded up to a
        number for which napari labels the scale. Otherwise it is rounded up to two digits.
    least : float
        Smallest end.

    Returns
    -------
    float
    """
    sizes = np.abs(values[np.isfinite(values)])
    reach = float(np.percentile(sizes, _WITHIN)) if sizes.size else 0.0
    if reach <= least:
        return least
    power = 10.0 ** math.floor(math.log10(reach))
    if signed:
        end = next(end for end in _ENDS if reach <= end * power * (1 + 1e-9))
    else:
        end = math.ceil(10 * reach / power - 1e-9) / 10
    return float(f"{end * power:.3g}")


def beyond(values: npt.NDArray[Any], limits: tuple[float, float]) -> str:
    """Describe, in a clause, the values beyond the ends of a scale; "" if there are none.

    Parameters
    ----------
    values : ndarray
    limits : (float, float)
        Ends of the scale.

    Returns
    -------
    str
    """
    low, high = limits
    known = values[np.isfinite(values)]
    least, most = float(known.min(initial=low)), float(known.max(initial=high))
    near = _NEARLY * (high - low)
    below = f"{low:.3g} (values to {least:.3g})" if low - least > near else ""
    above = f"{high:.3g} (values to {most:.3g})" if most - high > near else ""
    ends = " and at ".join(filter(None, (below, above)))
    return ends and f"Colours end at {ends}"


def area_limits(jacobian: npt.NDArray[Any], folded: bool) -> tuple[float, float]:
    """Return the ends of a scale of area ratios, with 1 in its middle; (0, 2) for folded tissue."""
    reach = 1.0 if folded else min(1.0, reach_of(jacobian - 1, True))
    return 1 - reach, 1 + reach
