"""Colour maps and colour scales of strain and displacement, for the viewer and saved pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

#: Colour map of signed values; purple and orange are distinguishable with any colour blindness.
DIVERGING = "PuOr_r"
#: Colour map of non-negative values; its lightness increases monotonically.
RISING = "magma"
#: Colour of folds (blue). It differs from all colours of both maps, drawn over any grey, also for
#: colour-blind users: yellow resembles the pale end of `RISING` and, for tritanopia, white.
FOLDED = "#0050ff"
#: Largest opacity of a colour overlay on the image.
OPACITY = 0.8
# Fraction of the colour range above which colours have full opacity.
_OPAQUE = 0.4
# Percentile of the absolute values that sets the end of a scale; outliers at corners exceed it.
_WITHIN = 99.0
# Values beyond a scale by less than this fraction of its range are not reported.
_NEARLY = 0.01
#: Smallest end of a scale; for values in per cent, the smallest end is 100 times this value.
SMALLEST = 1e-3
# Possible ends of a symmetric scale, up to a power of ten. napari labels such a scale with at least
# two numbers. If the end were 0.45 or 0.8, for example, napari would label only the 0.
_ENDS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 10.0)


def opacity(part: npt.ArrayLike, signed: bool) -> npt.NDArray[np.float64]:
    """Return the opacity of colours, which is low for small values to keep the image visible.

    Parameters
    ----------
    part : array_like
        Position in the range of the colour map, from 0 to 1.
    signed : bool
        True if the middle of the range means no change; False if the lower end does.

    Returns
    -------
    ndarray
        Opacity from 0 (transparent) to 1 (opaque).
    """
    position = np.asarray(part, dtype=np.float64)
    amount = np.abs(2 * position - 1) if signed else position
    return np.minimum(1, amount / _OPAQUE)


def reach_of(values: npt.NDArray[Any], signed: bool = False, least: float = SMALLEST) -> float:
    """Return the end of a scale that starts at 0 and covers nearly all values.

    Parameters
    ----------
    values : ndarray
        Values; entries that are not finite are ignored.
    signed : bool
        If True, the scale is symmetric, and its end is rounded up to a number at which napari
        labels the scale. If False, its end is rounded up to two significant digits.
    least : float
        Smallest end of the scale.

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
    """Return a clause about the values beyond the ends of a scale; "" if there are none.

    Parameters
    ----------
    values : ndarray
    limits : (float, float)
        Lower and upper end of the scale.

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
    """Return the ends of a scale of area ratios, centred at 1; (0, 2) for folded tissue."""
    reach = 1.0 if folded else min(1.0, reach_of(jacobian - 1, True))
    return 1 - reach, 1 + reach
