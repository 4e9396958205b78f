"""Model of an elastic volume on the device, with residuals in double precision.

The host stores the displacement of a solve, and reads only sums and maxima during iterations.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends import planes
from napari_hmrf.solver.backends.earlier_results import EarlierResults
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.backends.opengl.programs.programs import Uniforms
from napari_hmrf.solver.backends.opengl.programs.volume_programs import Buffers
from napari_hmrf.solver.backends.opengl.volumes.volume_level import GLVolumeLevel, exact
from napari_hmrf.solver.backends.opengl.volumes.volume_passes import VolumePasses
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import ElasticMaterial, Lame, lame_ratio, stiffest

_INSIDE = (slice(2, -2),) * 3
_ELEMENTS = (slice(None), *(slice(2, -3),) * 3)


class _System(NamedTuple):
    """System of equations, with results that are stored for later solves."""

    material: ElasticMaterial
    held: HeldPlanes
    earlier: EarlierResults


_system: Kept[_System] = Kept()


class GLVolumeModel(HostModel):
    """`LinearModel` of an elastic volume.

    Parameters
    ----------
    passes : VolumePasses
        Runner of the model's kernels; `close` frees its buffers.
    material : ElasticMaterial
    """

    def __init__(self, passes: VolumePasses, material: ElasticMaterial) -> None:
        self._passes, self.material = passes, material
        self.bounds = smoother_bounds(material)
        nu = material.poisson
        parameters = 1 if isinstance(nu, float) else 2
        share = lame_ratio(nu, strain=True) if isinstance(nu, float) else 1.0
        self.levels = [
            GLVolumeLevel(passes, grid, parameters, number == 0)
            for number, grid in enumerate(grids(material.m.shape))
        ]
        self._shape = exact(shape=list(material.shape), share=share)
        self._assemble(parameters)
        for level in self.levels:
            level.set_elements(material.shape, share)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.coarsen(fine)
        finest = self.levels[0]
        self._residual = finest.vector()
        # The residual stays on the device, because the iteration reads it there.
        self._rest = cast(Any, self._residual)
        self._exactly = [passes.buffer(finest.values, np.float64) for _ in range(3)]
        self._shares = passes.buffer(2 * finest.everywhere.number, np.float64)
        self._moves: HeldPlanes | None = None

    def _assemble(self, parameters: int) -> None:
        """Compute the Lame parameters of the finest level's elements."""
        finest, material = self.levels[0], self.material
        scale = 0.125 / stiffest(material.m)
        if isinstance(material.poisson, float):
            scale /= 2 + 2 * material.poisson
        # Upload the values of sites to the buffers of a vector that is not in use yet.
        passing = finest.correction.buffers
        for buffer, values in zip(passing, (material.m, material.poisson), strict=False):
            if not isinstance(values, float):
                self._passes.device.write_buffer(buffer, _padded(values))
        buffers = {"stiffness": passing[:1], "poisson": passing[1:2], "lame": finest.lame}
        defines = {"PARAMETERS": parameters}
        place = finest.everywhere
        self._passes.run("volume_elements", buffers, place, exact(scale=scale), defines)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components on all levels."""
        finest, self._moves = self.levels[0], None
        finest.hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.hold_as(fine)
        self.clear()
        for buffer in self._residual.buffers:
            self._passes.device.clear_buffer(buffer)

        def is_same(last: _System) -> bool:
            return last.material == self.material and np.array_equal(last.held, held)

        def new() -> _System:
            return _System(self.material, held, EarlierResults())

        self.earlier = _system.get(is_same, new).earlier

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the finest level."""
        if self._moves is None:
            finest = self.levels[0]
            self._moves = finest.fetch(finest.inverse) > 0
        return self._moves

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        if load is not None:
            raise NotImplementedError("shaders support loads in images only")
        self._send(d)
        buffers = {"rest": self._residual.buffers, "inverse": self.levels[0].inverse}
        shares = self._add_up("volume_balance", buffers, exact(unit=unit))
        return float(shares[:, 1].max(initial=0.0)), math.sqrt(shares[:, 0].sum())

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy of a displacement, and the norm of its forces ``A d``."""
        self._send(d)
        work, square = (
            float(
                self._add_up("volume_work", {}, {"power": np.array([power], np.int32)})[:, 0].sum()
            )
            for power in (1, 2)
        )
        return work / 2, math.sqrt(square)

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return the force ``-A d`` on every component, in double precision on the host."""
        finest, share = self.levels[0], float(self._shape["share"][0])
        stored = finest.fetch(finest.lame)[_ELEMENTS].astype(np.float64)
        lame = Lame(share * stored[-1], stored[0])
        exactly: Planes = (d if low is None else d + low)[(slice(None), *_INSIDE)]
        pulls: Planes = -self.material.shape.forces(lame, np.moveaxis(exactly, 0, -1))
        return planes.planes(pulls)

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix of the finest level, as planes."""
        finest = self.levels[0]
        out = finest.vector()
        finest.diagonal(out.buffers)
        return np.asarray(finest.fetch(out.buffers), np.float64)

    def clear_cache(self) -> None:
        """Clear the results that are stored for later solves."""
        _system.clear()

    def close(self) -> None:
        """Free all buffers of the model."""
        self._passes.close()

    def _send(self, d: Planes) -> None:
        """Copy a displacement to the device in double precision."""
        for buffer, values in zip(self._exactly, d, strict=True):
            self._passes.device.write_buffer(buffer, values)
        self._passes.device.check("uploading a displacement")

    def _add_up(self, name: str, buffers: Buffers, uniforms: Uniforms) -> npt.NDArray[np.float64]:
        """Run a double-precision kernel, and return (total, largest value) for each work group."""
        finest = self.levels[0]
        about = {"displacement": self._exactly, "lame": finest.lame, "shares": [self._shares]}
        defines = {"PARAMETERS": len(finest.lame)}
        every, numbers = finest.everywhere, {**self._shape, **uniforms}
        self._passes.run(name, {**about, **buffers}, every, numbers, defines)
        shares = self._passes.read(self._shares, np.float64, 2 * every.number)
        return np.asarray(shares.reshape(-1, 2))


def _padded(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the values of sites with a border of zeros that is two sites wide."""
    made = np.zeros([size + 4 for size in values.shape], np.float32)
    made[_INSIDE] = values
    return made
