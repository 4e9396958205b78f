"""V-cycle operations shared by the levels of images and volumes."""

from __future__ import annotations

from typing import Any, Generic, Self, TypeVar

from napari_hmrf.solver.backends.linear import Steps
from napari_hmrf.solver.backends.opengl.scalars import Ratio

ScalarType = TypeVar("ScalarType")


class CycleLevel(Generic[ScalarType]):
    """Base class of levels on the device; `LinearLevel` documents the methods."""

    @property
    def finishes_cycle(self) -> bool:
        """True if `finish` also processes all coarser levels; by default, False."""
        return False

    def descend(self, steps: Steps, coarse: Self | None, again: bool = False) -> None:
        """Smooth the correction, and restrict the residual to the load of `coarse`.

        The correction starts from zero, or from its current value if `again` is True.
        """
        self._relax(steps, from_zero=not again)
        if coarse is not None:
            self._restrict_residual(coarse)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Smooth the correction from zero with the steps `coarsest`."""
        self.descend(coarsest, None)

    def ratio(self, a: ScalarType, b: ScalarType) -> Ratio[ScalarType]:
        """Return a / b if both scalars are positive, otherwise 0."""
        return Ratio(a, b)

    def free(self, *vectors: Any) -> None:
        """Ignore the call; the memory of a vector is reused once the vector is unreferenced."""

    def project(self, vector: Any) -> None:
        """Ignore the call; problems with rigid tissue are solved on the host."""

    def _relax(self, steps: Steps, from_zero: bool) -> None:
        """Smooth the correction, from zero or from its current value."""
        raise NotImplementedError

    def _restrict_residual(self, coarse: Self) -> None:
        """Restrict the residual of the correction to the load of `coarse`."""
        raise NotImplementedError
