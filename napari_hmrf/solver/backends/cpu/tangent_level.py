"""Part of the levels of large motion that is the same for images and volumes: springs and data."""

from __future__ import annotations

import numpy as np

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.cpu import data_weights
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector, rows
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps


class TangentLevelBase(CpuLevel):
    """Base class of the levels of large motion, whose diagonal changes with each linear model.

    With a data term, each smoothing step is a residual, followed by the blocks of (D + W)^-1.
    """

    def write_diagonal(self) -> None:
        """Write the diagonal of the matrix for cycles to `inverse`."""
        raise NotImplementedError

    def _write_rest(self) -> Vector:
        """Return the residual of the correction without the mixed components of the data term."""
        raise NotImplementedError

    def allow_data(self) -> None:
        """Allocate the arrays of a data term."""
        axes = len(self.grid)
        count = axes * (axes - 1) // 2
        self.data = self.layout.vector(axes + count)
        self.mixed = self.layout.vector(2 * count) if self.mixed is None else self.mixed
        self.weight = self.vector() if self.weight is None else self.weight

    def coarsen_data(self, coarse: TangentLevelBase) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        self.write_diagonal()
        self._restrict_data(coarse)

    def hold(self, held: HeldPlanes, springs: Planes | None = None) -> None:
        """Set the prescribed components and the springs of the finest level."""
        self._write_diagonals()
        compute_thread.check_cancelled()
        weight = None if springs is None else springs.astype(np.float32)
        if weight is not None:
            np.add(self.inverse, weight, out=self.inverse, where=self.inverse > 0)
        self._hold(held, self.inverse, self.spans)
        if weight is not None:
            np.add(self.pins, weight * self.inverse, out=self.pins)
        if self.data is None:
            self.weight = weight
            return
        assert self.weight is not None
        self.weight[...] = 0 if weight is None else weight
        self._couple()

    def hold_as(self, finer: TangentLevelBase) -> None:
        """Set the springs of sites near prescribed sites of the next finer level."""
        self._write_diagonals()
        self._set_springs(finer)

    def _write_diagonals(self) -> None:
        self.write_diagonal()
        if self.data is not None:
            self.diagonal = self.inverse.copy()

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on `correction` for `load`."""
        if self.data is None:
            self._relax_tissue(steps, from_zero)
        else:
            self._relax_with_data(steps, from_zero)

    def _relax_tissue(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps of a problem without a data term."""
        raise NotImplementedError

    def _step_simply(self, pace: Vector) -> None:
        assert self.mixed is not None
        arrays = self.correction, self._write_rest(), self.inverse, self.mixed, self._other
        data_weights.smooth(*map(rows, arrays), *pace)

    def _restrict_residual(self, coarse: TangentLevelBase) -> None:
        if self.data is None:
            self._restrict(self._write_rest(), coarse, coarse.load)
        else:
            self._restrict_with_data(coarse)

    def _add_data_image(self, direction: Vector, image: Vector) -> float:
        """Add the rest of W d to an image with the diagonal of W; return ``direction . image``."""
        assert self.mixed is not None
        arrays = direction, self.mixed, self.inverse, image
        data_weights.add_mixed(*map(rows, arrays))
        self.add_points(direction, self.inverse, image)
        return self.product(direction, image)
