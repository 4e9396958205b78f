"""Device memory of one solve."""

from __future__ import annotations

from typing import Any

from napari_hmrf.solver.backends.opengl.context.device import Device
from napari_hmrf.solver.backends.opengl.context.pace import Pace


class DeviceResources:
    """Owner of textures or buffers that are freed at the end of a solve.

    Parameters
    ----------
    device : Device
    pace : Pace
        Scheduler of batches, which waits for the device.
    """

    def __init__(self, device: Device, pace: Pace) -> None:
        self.device, self.pace = device, pace
        self._own: list[Any] = []

    def wait(self) -> None:
        """Wait for the device, and check for errors and for cancellation."""
        self.pace.wait()
        self.device.check("computing")

    def close(self) -> None:
        """Free the textures or buffers, in reverse order of creation."""
        self.device.free(reversed(self._own))
        self._own.clear()
