"""A linear model on the device: its levels; all that is done in double precision is the host's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from napari_hmrf.solver.backends.found import Found
from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, LinearModel, Planes, Steps
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.relaxing import RelaxingLevel
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.backends.rigid.entrained import Entrained


class GLModel:
    """`LinearModel`, which says what each method does.

    Parameters
    ----------
    passes : Passes
        Its own: they end with it.
    host : LinearModel
        The compiled loops' model of the same tissue.
    levels : sequence of RelaxingLevel
        Of that model, on the device.
    """

    def __init__(self, passes: Passes, host: LinearModel, levels: Sequence[RelaxingLevel]) -> None:
        self._passes, self._host, self.levels = passes, host, levels
        self.bounds = host.bounds

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on all levels."""
        self._host.hold(held)
        for level in self.levels:
            level.hold()

    @property
    def material(self) -> Any:
        """Material of the model."""
        return self._host.material

    @property
    def mild(self) -> bool:
        """True if a cycle sees every motion of such tissue."""
        return self._host.mild

    @property
    def slow(self) -> bool:
        """True if factors are faster than cycles on this device."""
        return False

    @property
    def exactly(self) -> Any:
        """None: cycles that are rounded by the host are for volumes."""
        return None

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level."""
        return self._host.moves

    @property
    def shape(self) -> tuple[int, ...]:
        """The finest grid, (H, W)."""
        return self._host.shape

    @property
    def bodies(self) -> Bodies | None:
        """Rigid tissue, with what is held now."""
        return self._host.bodies

    @property
    def iterates(self) -> bool:
        """True if cycles can be used: bodies are moved as one on the host only."""
        return self.bodies is None

    @property
    def found(self) -> Found:
        """Earlier results for the tissue with the present held components."""
        return self._host.found

    def entrained(self, steps: Steps, coarsest: Steps) -> Entrained | None:
        """Return None: see `iterates`."""
        return None

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Return the residual of a load for a displacement."""
        return self._host.balance(d, load, unit)

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d everywhere, in double precision."""
        return self._host.pull(d, low)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the model's energy, and the norm of its forces."""
        return self._host.work(d)

    @property
    def steepness(self) -> Planes:
        """The diagonal of A, whatever is held."""
        return self._host.steepness

    def clear(self) -> None:
        """Ignore the call: images have no better cycles."""

    def forget(self) -> None:
        """Ignore the call: no vector outlives a solve."""

    def close(self) -> None:
        """Free every texture."""
        self._passes.close()
