"""Kernel passes over storage buffers, for volumes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.opengl.context.device import Device
from napari_hmrf.solver.backends.opengl.context.pace import Pace
from napari_hmrf.solver.backends.opengl.context.resources import DeviceResources
from napari_hmrf.solver.backends.opengl.programs.programs import Uniforms
from napari_hmrf.solver.backends.opengl.programs.volume_programs import (
    Buffers,
    Places,
    VolumeProgram,
)

#: Approximate memory per voxel, in bytes: parameters, inverse diagonal and five vectors in single
#: precision, a displacement in double precision, plus one tenth for the coarser levels.
BYTES_PER_VOXEL = 112

# Number of pairs in the buffer of scalars.
_PAIRS = 64


class Scalar:
    """Scalar on the device.

    Parameters
    ----------
    slot : int
        Index in the buffer of scalars.
    pair : object
        Reservation of the slot, which ends when the object is deleted.
    """

    def __init__(self, slot: int, pair: object) -> None:
        self.slot, self._pair = slot, pair


class _Pair:
    """Reservation of two consecutive slots, which ends when the object is deleted."""

    def __init__(self, slot: int, spare: list[int]) -> None:
        self.slot, self._spare = slot, spare

    def __del__(self) -> None:
        self._spare.append(self.slot)


class VolumePasses(DeviceResources):
    """Runner of kernels for one solve of a volume, which owns the solve's buffers.

    Parameters
    ----------
    device : Device
    pace : Pace
        Scheduler of batches, which waits for the device.
    """

    def __init__(self, device: Device, pace: Pace) -> None:
        super().__init__(device, pace)
        self._scalars = self.buffer(2 * _PAIRS)
        self._spare_slots = list(range(2, 2 * _PAIRS, 2))
        device.write_buffer(self._scalars, np.ones(1, np.float32))
        #: Scalar with the value 1.
        self.unit = Scalar(0, None)

    def buffer(self, count: int, kind: type[np.generic] = np.float32) -> Any:
        """Create a buffer of `count` zeros of a NumPy type."""
        made = self.device.buffer(count * np.dtype(kind).itemsize)
        self._own.append(made)
        return made

    def run(
        self,
        name: str,
        buffers: Buffers,
        places: Places,
        uniforms: Uniforms,
        defines: Mapping[str, int] | None = None,
    ) -> None:
        """Run a kernel on groups of a level, in strips if there are many groups."""
        listed = self._scalars if places.buffer is None else places.buffer
        bound = {**buffers, "scalars": [self._scalars], "places": [listed]}
        program = self._program(name, bound, places, uniforms, defines)
        for strip in self.pace.strips((places.number, places.groups.sites)):
            first, past = (0, places.number) if strip is None else strip
            if past > first:
                program.run(first, past)

    def run_alone(
        self,
        name: str,
        buffers: Buffers,
        places: Places,
        uniforms: Uniforms,
        defines: Mapping[str, int] | None = None,
    ) -> None:
        """Run a kernel on a level as a single work group."""
        program = self._program(name, buffers, places, uniforms, defines)
        for _ in self.pace.strips((1, places.groups.sites)):
            program.run(0, 1)

    def _program(
        self,
        name: str,
        buffers: Buffers,
        places: Places,
        uniforms: Uniforms,
        defines: Mapping[str, int] | None,
    ) -> VolumeProgram:
        """Return the program of a kernel, with its places, uniforms and buffers set."""
        program = self.device.volume_program(name, defines)
        program.visit(places)
        program.set(uniforms)
        program.bind(buffers)
        return program

    def total(self, shares: Any, count: int) -> tuple[Scalar, Scalar]:
        """Return the sum of the totals of `count` groups, and their largest value."""
        pair = _Pair(self._spare_slots.pop(), self._spare_slots)
        program = self.device.volume_program("volume_total")
        program.set({"count": np.array([count], np.int32), "slot": np.array([pair.slot], np.int32)})
        program.bind({"shares": [shares], "scalars": [self._scalars]})
        program.run(0, 1)
        return Scalar(pair.slot, pair), Scalar(pair.slot + 1, pair)

    def read_scalars(self) -> npt.NDArray[np.float32]:
        """Wait for the device, and return all scalars."""
        return self.read(self._scalars, np.float32, 2 * _PAIRS)

    def read(self, buffer: Any, kind: type[np.generic], count: int) -> npt.NDArray[Any]:
        """Wait for the device, and return the first `count` values of a buffer."""
        self.wait()
        found = np.frombuffer(buffer.read(size=count * np.dtype(kind).itemsize), kind)
        self.device.check("reading numbers")
        return found
