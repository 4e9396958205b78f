"""What pulls at tissue that moves far besides the tissue itself."""

from __future__ import annotations

from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.optimizers.loading import work_of


class Outside:
    """Dead loads: forces that stay as they are, wherever tissue gets to.

    Parameters
    ----------
    load : ndarray, planes
    """

    def __init__(self, load: Planes) -> None:
        self._load = load

    def energy(self, d: Planes) -> float:
        """What they add to the energy of a displacement."""
        return -work_of(self._load, d)

    def forces(self, d: Planes) -> Planes:
        """The derivative of that."""
        return -self._load

    def springs(self, d: Planes) -> Planes | None:
        """How much that changes with the motion of each component; None if it does not."""
        return None
