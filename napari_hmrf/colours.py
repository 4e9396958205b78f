"""The colours of what a displacement does, the same in the viewer and in saved pictures."""

from __future__ import annotations

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
