"""Part of a level's V-cycle that images and volumes share."""

from __future__ import annotations

from typing import Any, Generic, Self, TypeVar

from napari_hmrf.solver.backends.linear import Steps
from napari_hmrf.solver.backends.opengl.scalars import Ratio

ScalarType = TypeVar("ScalarType")


class CycleLevel(Generic[ScalarType]):
    """Level that smooths and restricts by passes on the device; see `LinearLevel`."""

    #: False, because `finish` does not visit coarser levels.
    finishes_cycle = False

    def descend(self, steps: Steps, coarse: Self | None, again: bool = False) -> None:
        """Smooth from zero, or again, and restrict the residual to the load of `coarse`."""
        self._relax(steps, from_zero=not again)
        if coarse is not None:
            self._restrict_residual(coarse)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Smooth from zero with `coarsest` steps."""
        self.descend(coarsest, None)

    def ratio(self, a: ScalarType, b: ScalarType) -> Ratio[ScalarType]:
        """Return a / b; 0 unless both are positive."""
        return Ratio(a, b)

    def free(self, *vectors: Any) -> None:
        """Ignore the call; a vector is reused after its last reference."""

    def project(self, vector: Any) -> None:
        """Ignore the call; rigid tissue is solved by direct factors or by the compiled loops."""

    def _relax(self, steps: Steps, from_zero: bool) -> None:
        """Smooth the correction for the load."""
        raise NotImplementedError

    def _restrict_residual(self, coarse: Self) -> None:
        """Restrict the residual of the correction to the load of `coarse`."""
        raise NotImplementedError
