"""The colours of what a displacement does, the same in the viewer and in saved pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

#: From less over no change to more: purple and orange, which no colour blindness confuses.
DIVERGING = "PuOr_r"
#: From nothing upwards: ever lighter, whatever the colour vision.
RISING = "magma"
#: Of folds among those: bright on dark purple, the colour of what is nearly folded.
FOLDED = "#ffee00"
#: How much of the image such colours hide where they hide the most.
OPACITY = 0.8
# From this part of their range on colours hide the image under them.
_OPAQUE = 0.4
# So many of a hundred pixels lie within the limits of a scale; the others are a few at corners.
_WITHIN = 99.0
# Values do not go beyond a scale if it is by less than this part of it.
_NEARLY = 0.01
#: The shortest scale; of what is in per cent a hundred times that.
SMALLEST = 1e-3
# Where a scale with 0 in its middle may end, but for powers of ten: between its ends napari then
# writes at least two numbers beside it, where for 0.45 or 0.8 it has room for the 0 alone.
_ENDS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 10.0)


def opacity(part: npt.ArrayLike, signed: bool) -> npt.NDArray[np.float64]:
    """How opaque a colour is: where hardly anything happens the image is seen.

    Parameters
    ----------
    part : array_like
        Where in the range it is, 0 to 1.
    signed : bool
        Whether no change is in the middle, and not at the lower end.

    Returns
    -------
    ndarray
        0 (clear) to 1.
    """
    place = np.asarray(part, dtype=np.float64)
    much = np.abs(2 * place - 1) if signed else place
    return np.minimum(1, much / _OPAQUE)


def reach_of(values: npt.NDArray[Any], signed: bool = False, least: float = SMALLEST) -> float:
    """How far from 0 a scale should go to show nearly all values.

    Rounded up to two digits, or, if it goes to both sides, so that numbers can stand beside it.
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
    """Say how far values go beyond a scale, which ends where nearly all do; "" if none does.

    Parameters
    ----------
    values : ndarray
    limits : (float, float)
        Where the scale begins and ends.
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
    """The limits of a scale of area ratios, 1 in its middle; from 0 on where tissue folds."""
    reach = 1.0 if folded else min(1.0, reach_of(jacobian - 1, True))
    return 1 - reach, 1 + reach
