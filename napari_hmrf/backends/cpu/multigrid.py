"""The steps of multigrid and conjugate gradients on the processor."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.coarsening import ElasticLevel
from napari_hmrf.priors.elastic import ElementShape

Planes = npt.NDArray[Any]


class CpuElasticLevel:
    """One level's model and work space, in the layout of the kernels.

    Parameters
    ----------
    level : ElasticLevel
    shape : ElementShape
    """

    def __init__(self, level: ElasticLevel, shape: ElementShape) -> None:
        from napari_hmrf.backends.cpu import elastic, transfer

        self._kernels = elastic
        self.grid = level.shape
        self._lame = transfer.padded(2, self.grid)
        self._lame[:, 2:-3, 2:-3] = level.lame
        self._inverse = self.planes(level.inverse)
        self._weight = None if level.weight is None else self.planes(level.weight)
        self._shape = np.array(shape, dtype=np.float32)
        self._spans = _spans(self._inverse)
        self._rows = np.zeros(self.grid[0])
        self.load, self.correction, self._other, self._step, self._rest = (
            transfer.padded(2, self.grid) for _ in range(5)
        )

    def planes(self, values: npt.NDArray[Any], dtype: Any = np.float32) -> Planes:
        """Values (H, W, 2) as padded planes."""
        made = np.zeros((2, *(size + 4 for size in self.grid)), dtype=dtype)
        made[:, 2:-2, 2:-2] = np.moveaxis(values, -1, 0)
        return made

    def relax(self, steps: list[tuple[float, float]], from_zero: bool) -> None:
        """Chebyshev-Jacobi steps on `correction` for `load`."""
        k = self._kernels
        for number, (scale, momentum) in enumerate(steps):
            if from_zero and number == 0:
                k.smooth_first(
                    self.load, self._inverse, self._step, self.correction, np.float32(scale)
                )
                continue
            k.smooth(
                self.correction,
                self.load,
                self._lame,
                self._inverse,
                self._weight,
                self._shape,
                self._spans,
                self._step,
                self._other,
                np.float32(scale),
                np.float32(momentum),
            )
            self.correction, self._other = self._other, self.correction

    def restrict_to(self, coarse: CpuElasticLevel) -> None:
        """Hand what is left of the load down."""
        self._kernels.residual(
            self.correction,
            self.load,
            self._lame,
            self._inverse,
            self._weight,
            self._shape,
            self._spans,
            self._rest,
        )
        self._kernels.restrict(self._rest, coarse.load)

    def correct_from(self, coarse: CpuElasticLevel) -> None:
        """Add the coarse correction."""
        self._kernels.interpolate(coarse.correction, self.correction, self._inverse)

    def exact_residual(self, d: Planes, load: Planes) -> Planes:
        """Load - A d in the precision of its arguments."""
        out = np.zeros_like(d)
        self._kernels.residual(
            d,
            load,
            self._lame.astype(d.dtype),
            self._inverse,
            None,
            self._shape.astype(d.dtype),
            self._spans,
            out,
        )
        return out

    def energy(self, d: Planes) -> float:
        """The elastic energy, in the precision of its argument."""
        rows = np.zeros(self.grid[0])
        self._kernels.work(d, self._lame.astype(d.dtype), self._shape.astype(d.dtype), rows)
        return float(rows.sum()) / 2

    def product(self, a: Planes, b: Planes) -> float:
        """The scalar product."""
        self._kernels.product(a, b, self._rows)
        return float(self._rows.sum())

    def apply(self, direction: Planes, image: Planes) -> float:
        """Image = A direction; their scalar product."""
        self._kernels.apply(
            direction,
            self._lame,
            self._inverse,
            self._shape,
            self._spans,
            image,
            self._rows,
        )
        return float(self._rows.sum())

    def advance(
        self, d: Planes, rest: Planes, direction: Planes, image: Planes, length: float
    ) -> float:
        """D += length direction, rest -= length image; the square of the rest."""
        self._kernels.advance(d, rest, direction, image, np.float32(length), self._rows)
        return float(self._rows.sum())

    def turn(self, steepest: Planes, direction: Planes, share: float) -> None:
        """Direction = steepest + share direction."""
        self._kernels.turn(steepest, direction, np.float32(share))


def _spans(inverse: Planes) -> npt.NDArray[np.int64]:
    """Where each row's moving sites begin and end, shape (H, 2)."""
    moves = np.any(inverse[:, 2:-2, 2:-2] > 0, axis=0)
    first = moves.argmax(axis=1)
    past = moves.shape[1] - moves[:, ::-1].argmax(axis=1)
    return np.stack([first, np.where(moves.any(axis=1), past, first)], axis=1)
