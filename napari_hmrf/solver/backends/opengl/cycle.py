"""Part of a level's V-cycle that is the same for images and volumes."""

from __future__ import annotations

from typing import Any, Generic, Self, TypeVar

from napari_hmrf.solver.backends.linear import Steps
from napari_hmrf.solver.backends.opengl.scalars import Ratio

ScalarType = TypeVar("ScalarType")


class CycleLevel(Generic[ScalarType]):
    """Level whose smoothing and restriction are passes on the device; see `LinearLevel`."""

    #: Each level is visited by itself.
    takes_rest = False

    def descend(self, steps: Steps, coarse: Self | None, again: bool = False) -> None:
        """Relax from zero, or on, and hand what is left of the load down."""
        self._relax(steps, from_zero=not again)
        if coarse is not None:
            self._hand_down(coarse)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Relax from zero as the coarsest level."""
        self.descend(coarsest, None)

    def ratio(self, a: ScalarType, b: ScalarType) -> Ratio[ScalarType]:
        """Return a over b; 0 unless both are positive."""
        return Ratio(a, b)

    def free(self, *vectors: Any) -> None:
        """Ignore the call: memory comes back with the last reference to a vector."""

    def project(self, vector: Any) -> None:
        """Ignore the call: rigid tissue is solved by factors or by the compiled loops."""

    def _relax(self, steps: Steps, from_zero: bool) -> None:
        """Smooth the correction for the load."""
        raise NotImplementedError

    def _hand_down(self, coarse: Self) -> None:
        """Make what the correction leaves of the load the coarser level's load."""
        raise NotImplementedError
