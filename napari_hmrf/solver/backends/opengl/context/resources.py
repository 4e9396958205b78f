"""Memory of one solve on the device, and the wait for the device."""

from __future__ import annotations

from typing import Any

from napari_hmrf.solver.backends.opengl.context.device import Device
from napari_hmrf.solver.backends.opengl.context.pace import Pace


class DeviceResources:
    """Textures or buffers that end with a solve.

    Parameters
    ----------
    device : Device
    pace : Pace
        Decides when to wait for the device.
    """

    def __init__(self, device: Device, pace: Pace) -> None:
        self.device, self.pace = device, pace
        self._own: list[Any] = []

    def wait(self) -> None:
        """Wait for the device; check that it works, and that the solve is not cancelled."""
        self.pace.wait()
        self.device.check("computing")

    def close(self) -> None:
        """Free the textures or buffers, the last first."""
        self.device.free(reversed(self._own))
        self._own.clear()
