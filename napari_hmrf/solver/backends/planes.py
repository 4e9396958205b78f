"""Fields on the host: planes, float64, in a ring of zeros two sites wide."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

#: A displacement or forces, (2, H + 4, W + 4): the component first.
Planes = npt.NDArray[np.float64]
#: Of each component, whether something is so.
HeldPlanes = npt.NDArray[np.bool_]
