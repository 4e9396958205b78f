"""Level of an elastic volume on the device; compute shaders run the multigrid operations.

Each buffer stores one component of an array in the layout of the compiled loops
(`backends.cpu.volume`), with a border of void that is two sites wide on every side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.linear import HeldPlanes, Steps
from napari_hmrf.solver.backends.opengl.cycle import CycleLevel
from napari_hmrf.solver.backends.opengl.programs.programs import Uniforms
from napari_hmrf.solver.backends.opengl.programs.volume_programs import Buffers, Places, groups_of
from napari_hmrf.solver.backends.opengl.programs.volume_source import MOST_STEPS, SITES
from napari_hmrf.solver.backends.opengl.scalars import Ratio, values_of
from napari_hmrf.solver.backends.opengl.volumes.volume_passes import Scalar, VolumePasses
from napari_hmrf.solver.coarse_levels import MOST_PINS, SPRING

_AXES = 3


Number = Scalar | Ratio[Scalar]


class Vector:
    """Vector of three components on a level's sites.

    Parameters
    ----------
    buffers : list of moderngl.Buffer
        One buffer for each component.
    spare : list
        List of free buffers, to which the vector's buffers are added on deletion.
    """

    def __init__(self, buffers: list[Any], spare: list[list[Any]]) -> None:
        self.buffers, self._spare = buffers, spare

    def __del__(self) -> None:
        self._spare.append(self.buffers)


class GLVolumeLevel(CycleLevel[Scalar]):
    """Level of an elastic volume; `LinearLevel` documents the methods.

    Parameters
    ----------
    passes : VolumePasses
    grid : (int, int, int)
        Grid of the level, (D, H, W).
    parameters : int
        Number of parameters of an element: 2 for mu and lambda, or 1 if lambda is a fixed multiple
        of mu.
    finest : bool
        True for the finest level.

    Attributes
    ----------
    lame : list of moderngl.Buffer
        Lame parameters of the elements; 0 in void.
    inverse : list of moderngl.Buffer
        Reciprocal of the diagonal; 0 where a component is fixed.
    """

    #: True because a second visit within a cycle is worth its cost on every level.
    is_revisited = True

    def __init__(
        self, passes: VolumePasses, grid: tuple[int, ...], parameters: int, finest: bool
    ) -> None:
        self._passes, self.grid = passes, grid
        self.padded = tuple(size + 4 for size in grid)
        self.values = math.prod(self.padded)
        self.lame = [passes.buffer(self.values) for _ in range(parameters)]
        self.inverse = [passes.buffer(self.values) for _ in range(_AXES)]
        self._springs = [] if finest else [passes.buffer(_AXES * self.values)]
        self._defines = {"PARAMETERS": parameters, "SPRINGS": int(not finest)}
        groups = groups_of(grid, passes.device.software)
        self.everywhere = Places(groups, None, groups.count)
        self._region = self.everywhere
        self._list = passes.buffer(groups.count, np.int32)
        self._shares = passes.buffer(2 * groups.count)
        self._spare: list[list[Any]] = []
        #: Load of the level; the iteration assigns the load of the finest level.
        self.load: Any = None if finest else self.vector()
        self.correction, self._other = self.vector(), self.vector()
        self.shape: Uniforms = {}

    # Parameters of the tissue

    def set_elements(self, shape: Sequence[float], share: float) -> None:
        """Set the uniforms of the elements.

        Parameters
        ----------
        shape : sequence of float
            Factors of the derivatives along the (plane, row, column) axes (`BrickShape`).
        share : float
            Ratio lambda / mu of all elements; 1 if lambda is a separate parameter.
        """
        self.shape = {"shape": np.array(shape, np.float32), "share": np.array([share], np.float32)}

    def coarsen(self, finer: Self) -> None:
        """Compute the parameters of the elements from the elements of the next finer level."""
        _, height, width = finer.grid
        sizes = _integers(fine_height=height, fine_width=width)
        for fine, coarse in zip(finer.lame, self.lame, strict=True):
            buffers = {"fine": [fine], "coarse": [coarse]}
            self._passes.run("volume_coarsen", buffers, self.everywhere, sizes)

    def diagonal(self, out: Sequence[Any]) -> None:
        """Write the diagonal of the stiffness matrix to buffers."""
        self._run_everywhere("volume_diagonal", {"lame": self.lame, "diagonal": out}, self.shape)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level."""
        for buffer, each in zip(self._other.buffers, held, strict=True):
            self._passes.device.write_buffer(buffer, each.astype(np.float32))
        self.diagonal(self.inverse)
        self._invert_diagonal("volume_hold", {})

    def hold_as(self, finer: Self) -> None:
        """Set springs at sites near prescribed components of the next finer level."""
        self.diagonal(self.inverse)
        self._restrict(finer, finer._other, self._other, self.everywhere)
        self._invert_diagonal("volume_spring", _numbers(most_pins=MOST_PINS, strength=SPRING))

    def _invert_diagonal(self, name: str, uniforms: Uniforms) -> None:
        """Invert the diagonal, and list the groups with free sites.

        The vector `_other` contains the pins: the counts of prescribed components at each site.
        """
        buffers = {"inverse": self.inverse, "pins": self._other.buffers, "springs": self._springs}
        self._run_everywhere(name, {**buffers, "shares": [self._shares]}, uniforms)
        count = self.everywhere.number
        most = self._passes.read(self._shares, np.float32, 2 * count)[1::2]
        numbers = np.flatnonzero(most > 0).astype(np.int32)
        if len(numbers):
            self._passes.device.write_buffer(self._list, numbers)
        self._region = self.everywhere._replace(buffer=self._list, number=len(numbers))

    def clear(self) -> None:
        """Set the correction and the second vector of the cycle to zero."""
        for vector in (self.correction, self._other):
            self._clear(vector.buffers)

    # The cycle

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Smooth from zero with the steps `coarsest`, in a single pass if the level is small."""
        if math.prod(self.grid) > SITES or len(coarsest) > MOST_STEPS:
            super().finish(steps, coarsest)
            return
        paces = np.zeros((MOST_STEPS, 2), np.float32)
        paces[: len(coarsest)] = coarsest
        buffers = {
            "load": self.load.buffers,
            "inverse": self.inverse,
            "lame": self.lame,
            "springs": self._springs,
            "correction": self.correction.buffers,
        }
        uniforms = {**self.shape, "paces": paces, **_integers(count=len(coarsest))}
        self._passes.run_alone("volume_finish", buffers, self._region, uniforms, self._defines)

    def _restrict_residual(self, coarse: Self) -> None:
        """Restrict the residual of the correction to the load of `coarse`."""
        buffers = {
            "displacement": self.correction.buffers,
            "load": self.load.buffers,
            "inverse": self.inverse,
            "lame": self.lame,
            "springs": self._springs,
            "rest": self._other.buffers,
        }
        self._run("volume_residual", buffers, self.shape, self._defines)
        coarse._restrict(self, self._other, coarse.load, coarse._region)

    def ascend(self, steps: Steps, coarse: Self) -> None:
        """Add the interpolated correction of the next coarser level, and smooth."""
        _, height, width = coarse.grid
        self._run(
            "volume_interpolate",
            {
                "correction": self.correction.buffers,
                "coarse": coarse.correction.buffers,
                "inverse": self.inverse,
            },
            _integers(coarse_height=height, coarse_width=width),
        )
        self._relax(steps, from_zero=False)

    def _relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on the correction for the load."""
        about = {"load": self.load.buffers, "inverse": self.inverse}
        begun = 0
        if from_zero:
            buffers = {**about, "begun": self.correction.buffers}
            self._run("volume_begin", buffers, _numbers(scale=steps[0][0]))
            begun = 1
        about |= {"lame": self.lame, "springs": self._springs}
        for number, (scale, momentum) in enumerate(steps[begun:], begun):
            # `back` multiplies the correction before the previous step. The first step has no such
            # correction, and for the second step after a start from zero, the correction is zero.
            back = momentum if number > begun else 0.0
            pace = _numbers(scale=scale, ahead=momentum, back=back)
            taken = {"displacement": self.correction.buffers, "other": self._other.buffers}
            self._run("volume_smooth", {**about, **taken}, {**self.shape, **pace}, self._defines)
            self.correction, self._other = self._other, self.correction

    def _restrict(self, finer: Self, fine: Vector, coarse: Vector, places: Places) -> None:
        """Restrict a vector of the next finer level to this level."""
        _, height, width = finer.grid
        buffers = {"fine": fine.buffers, "coarse": coarse.buffers}
        sizes = _integers(fine_height=height, fine_width=width)
        self._passes.run("volume_restrict", buffers, places, sizes)

    # Vectors

    def vector(self, values: FloatArray | Vector | None = None) -> Vector:
        """Return a vector of zeros or a vector with the given planes.

        If `values` is already a vector, return it unchanged.
        """
        if isinstance(values, Vector):
            return values
        if self._spare:
            buffers = self._spare.pop()
            if values is None:
                self._clear(buffers)
        else:
            buffers = [self._passes.buffer(self.values) for _ in range(_AXES)]
        if values is not None:
            for buffer, each in zip(buffers, values, strict=True):
                self._passes.device.write_buffer(buffer, np.asarray(each, np.float32))
            self._passes.device.check("uploading a vector")
        return Vector(buffers, self._spare)

    def scratch_vector(self) -> Vector:
        """Return a vector that the level uses only during cycles, to save memory."""
        return self._other

    def planes(self, vector: Vector) -> FloatArray:
        """Copy a vector to the host as planes.

        Also run the test kernel, to check that the device still computes correctly.
        """
        made = self.fetch(vector.buffers)
        self._passes.device.canary("compute")
        return made

    def fetch(self, buffers: Sequence[Any]) -> FloatArray:
        """Copy buffers to the host as an array of shape (buffers, D + 4, H + 4, W + 4)."""
        self._passes.wait()
        made = np.empty((len(buffers), *self.padded), np.float32)
        for buffer, each in zip(buffers, made, strict=True):
            buffer.read_into(each)
        self._passes.device.check("reading a volume")
        return made

    # Conjugate gradients

    def product(self, a: Vector, b: Vector) -> Scalar:
        """Return the scalar product of two vectors."""
        return self.weigh(a, b)[1]

    def largest(self, a: Vector) -> Scalar:
        """Return the largest absolute value in a vector."""
        return self.weigh(a, a)[0]

    def weigh(self, a: Vector, b: Vector) -> tuple[Scalar, Scalar]:
        """Return the largest absolute value in `a`, and the scalar product of `a` and `b`."""
        buffers = {"one": a.buffers, "other": b.buffers, "shares": [self._shares]}
        self._run("volume_weigh", buffers, {})
        product, most = self._passes.total(self._shares, self._region.number)
        return most, product

    def apply(self, direction: Vector, image: Vector) -> Scalar:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        buffers = {
            "displacement": direction.buffers,
            "inverse": self.inverse,
            "lame": self.lame,
            "springs": self._springs,
            "image": image.buffers,
            "shares": [self._shares],
        }
        self._run("volume_apply", buffers, self.shape, self._defines)
        return self._passes.total(self._shares, self._region.number)[0]

    def advance(
        self, d: Vector, rest: Vector, direction: Vector, image: Vector, length: Number
    ) -> Scalar:
        """Update `d` and `rest` for a step along `direction`; return ``rest . rest``.

        The update is ``d += length * direction`` and ``rest -= length * image``.
        """
        vectors = {"found": d, "rest": rest, "direction": direction, "image": image}
        buffers = {name: vector.buffers for name, vector in vectors.items()}
        self._run(
            "volume_advance", {**buffers, "shares": [self._shares]}, self._ratio_uniforms(length)
        )
        return self._passes.total(self._shares, self._region.number)[0]

    def turn(self, steepest: Vector, direction: Vector, share: Number) -> None:
        """Compute ``direction = steepest + share * direction``."""
        buffers = {"steepest": steepest.buffers, "direction": direction.buffers}
        self._run("volume_turn", buffers, self._ratio_uniforms(share))

    def read(self, *scalars: Number) -> tuple[float, ...]:
        """Wait for the device, and return the values of scalars and ratios."""
        numbers = self._passes.read_scalars()
        return values_of(scalars, lambda scalar: float(numbers[scalar.slot]))

    # Passes

    def _run(
        self,
        name: str,
        buffers: Buffers,
        uniforms: Uniforms,
        defines: Mapping[str, int] | None = None,
    ) -> None:
        """Run a kernel on the groups with free sites."""
        self._passes.run(name, buffers, self._region, uniforms, defines)

    def _run_everywhere(self, name: str, buffers: Buffers, uniforms: Uniforms) -> None:
        """Run a kernel on all groups, during the set-up of the level."""
        defines = {"PARAMETERS": len(self.lame)} if "lame" in buffers else None
        self._passes.run(name, buffers, self.everywhere, uniforms, defines)

    def _clear(self, buffers: Sequence[Any]) -> None:
        for buffer in buffers:
            self._passes.device.clear_buffer(buffer)

    def _ratio_uniforms(self, number: Number) -> Uniforms:
        """Return the uniforms `above` and `below` of a kernel for a scalar or a ratio."""
        above, below = number if isinstance(number, Ratio) else (number, self._passes.unit)
        return _integers(above=above.slot, below=below.slot)


def _integers(**values: int) -> Uniforms:
    return {name: np.array([value], np.int32) for name, value in values.items()}


def _numbers(**values: float) -> Uniforms:
    return {name: np.array([value], np.float32) for name, value in values.items()}


def exact(**values: float | Sequence[float]) -> dict[str, npt.NDArray[np.float64]]:
    """Return uniforms in double precision."""
    return {name: np.atleast_1d(np.array(value, np.float64)) for name, value in values.items()}
