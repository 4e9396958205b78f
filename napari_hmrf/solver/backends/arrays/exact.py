"""Displacements in double precision on the host, in NumPy: counterpart of the loops in `cpu.exact`.

Planes are float64 arrays (2, H + 4, W + 4), with the component as the first axis and a border of
zeros, two sites wide.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.planes import HeldPlanes, Planes

Values = npt.NDArray[np.floating[Any]]


def _inside(planes: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of planes without their border, with the component as the last axis."""
    return np.moveaxis(planes[:, 2:-2, 2:-2], 0, -1)


def prescribe(
    y: Values,
    observed: npt.NDArray[np.bool_],
    share: float,
    first: Values,
    one: float,
    second: Values,
    two: float,
    d: Planes,
    held: HeldPlanes,
) -> None:
    """Set `d` to ``share * y`` and `held` to True at observed components.

    Other components of `d` are set to ``one * first + two * second``. The arrays have shape
    (H, W, 2). An array with factor 0 may contain NaN.
    """
    terms = (one, first), (two, second)
    begun = sum(np.float64(weight) * values for weight, values in terms if weight != 0)
    _inside(held)[...] = observed
    _inside(d)[...] = np.where(observed, np.float64(share) * y, begun)


def blend(values: Values, weight: float, held: HeldPlanes, d: Planes) -> None:
    """Add ``weight * values``, shape (H, W, 2), to the unconstrained components of `d`."""
    _inside(d)[...] += np.where(_inside(held), 0.0, np.float64(weight) * values)


def settle(
    values: Values, tissue: npt.NDArray[np.bool_], unit: float, row_finite: npt.NDArray[np.bool_]
) -> None:
    """Multiply values by `unit` in tissue, set others to 0, and mark the rows of finite values."""
    row_finite[...] = np.isfinite(values).all(axis=(1, 2))
    values *= unit * tissue[..., None].astype(values.dtype)


def add(d: Planes, correction: npt.NDArray[np.float32], scale: float) -> None:
    """Add ``scale * correction`` to `d`."""
    d += np.float64(scale) * correction


def gather(d: Planes, out: npt.NDArray[np.float32]) -> None:
    """Copy planes to `out`, shape (H, W, 2), in single precision."""
    out[...] = _inside(d)
