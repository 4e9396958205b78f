"""Base class of the levels of all image models, with its vectors and scalars.

A vector has two textures: a kernel reads the first texture and writes to the second. A scalar is a
texture of one texel. When a vector or scalar is deleted, its textures become free for reuse, so
iterations do not allocate memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.opengl.cycle import CycleLevel
from napari_hmrf.solver.backends.opengl.images.fields import as_stored, pairs
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.totals import BLOCK
from napari_hmrf.solver.backends.opengl.programs.programs import Uniforms
from napari_hmrf.solver.backends.opengl.scalars import Ratio, values_of

# Width of the border of zeros around planes, in sites.
_PAD = 2
# Side of the blocks after the first reduction: fewer passes, each with fewer invocations.
_LATER_BLOCK = 16
# Side of all blocks if an invocation has combined several rows.
_LARGE_BLOCK = 32


class Vector:
    """Vector of two components on a level's sites, stored in pairs.

    The textures are created on first use.

    Parameters
    ----------
    acquire : callable
        Function that returns a texture of zeros.
    spare : list of moderngl.Texture
        List of free textures, to which the vector's textures are added on deletion.
    """

    def __init__(self, acquire: Callable[[], Any], spare: list[Any]) -> None:
        self._zero_texture, self._spare = acquire, spare
        self._textures: list[Any] = []

    @property
    def texture(self) -> Any:
        """Texture with the current values."""
        return self._made(1)[0]

    @property
    def other(self) -> Any:
        """Texture to which a kernel writes the next values; 0 outside tissue."""
        return self._made(2)[1]

    def turn(self) -> None:
        """Swap the two textures, so that the next values become the current values."""
        self._made(2).reverse()

    def shed(self) -> None:
        """Release the texture for the next values."""
        self._spare += self._textures[1:]
        del self._textures[1:]

    def _made(self, count: int) -> list[Any]:
        """Return the textures, after creating the first `count` of them."""
        while len(self._textures) < count:
            self._textures.append(self._zero_texture())
        return self._textures

    def __del__(self) -> None:
        self._spare += self._textures


class Scalar:
    """Scalar on the device.

    Parameters
    ----------
    texture : moderngl.Texture
        Texture of one texel.
    spare : list of moderngl.Texture
        List of free textures, to which the texture is added on deletion.
    """

    def __init__(self, texture: Any, spare: list[Any]) -> None:
        self.texture, self._spare = texture, spare

    def __del__(self) -> None:
        self._spare.append(self.texture)


Number = Scalar | Ratio[Scalar]


class Product:
    """Unevaluated product of two scalars, as an argument of `GLLevel.quotient`."""

    def __init__(self, first: Scalar, second: Scalar) -> None:
        self.first, self.second = first, second


class GLLevel(CycleLevel[Scalar]):
    """Base class of the levels of images; `LinearLevel` documents the methods.

    Parameters
    ----------
    passes : Passes
    grid : tuple of int
        Grid of the level, (H, W).
    shown : ndarray of bool, shape (H, W)
        Mask of tissue.
    """

    def __init__(self, passes: Passes, grid: tuple[int, ...], shown: npt.NDArray[np.bool_]) -> None:
        self._passes, self.grid = passes, grid
        self._pairs = pairs(grid)
        either = np.zeros((self._pairs[0], 2 * self._pairs[1]), np.bool_)
        either[:, : grid[1]] = shown
        self._tissue = passes.tissue(either[:, ::2] | either[:, 1::2])
        self._spare: list[Any] = []
        self._spare_scalars: list[Any] = []
        self._blocks: dict[tuple[int, ...], Any] = {}
        self._share: Any = None
        self._peak: Any = None

    def vector(self, values: FloatArray | Vector | None = None) -> Vector:
        """Return a vector of zeros, a vector with the given planes, or the given vector."""
        if isinstance(values, Vector):
            return values
        made = Vector(self._zero_texture, self._spare)
        if values is not None:
            made.texture.write(stored_planes(values))
            self._passes.device.check("uploading a vector")
        return made

    def scratch_vector(self) -> Vector:
        """Return a vector that is valid until the next cycle."""
        return self.vector()

    def planes(self, vector: Vector) -> FloatArray:
        """Copy a vector to the host as planes.

        Also run the test kernel, to check that the device still computes correctly.
        """
        rows, cols = self.grid
        planes = np.zeros((2, rows + 2 * _PAD, cols + 2 * _PAD), np.float32)
        planes[:, _PAD:-_PAD, _PAD:-_PAD] = np.moveaxis(self.values(vector), -1, 0)
        return planes

    def values(self, vector: Vector) -> FloatArray:
        """Copy a vector to the host, shape (H, W, 2), and check the device as `planes` does."""
        self._passes.wait()
        rows, cols = self._pairs
        stored = np.empty((rows, 2 * cols, 2), np.float32)
        vector.texture.read_into(stored)
        self._passes.device.check("reading a vector")
        self._passes.device.canary(self._passes.stage)
        return np.ascontiguousarray(stored[:, : self.grid[1]])

    def write(
        self, vector: Vector, values: npt.NDArray[Any], unit: float, row: int = 0, col: int = 0
    ) -> None:
        """Copy ``values / unit``, shape (H, W, 2), to the sites of a vector from a row and column.

        The column must be even.
        """
        stored = as_stored(np.divide(values, unit, dtype=np.float32))
        rows, cols = stored.shape[:2]
        vector.texture.write(stored, (col // 2, row, cols // 2, rows))
        self._passes.device.check("uploading a vector")

    def product(self, a: Vector, b: Vector) -> Scalar:
        """Return the scalar product of two vectors."""
        self._run("product", {}, [a.texture, b.texture], [self._shares()])
        return self._total()

    def largest(self, a: Vector) -> Scalar:
        """Return the largest absolute value in a vector."""
        return self.weigh(a, a)[0]

    def weigh(self, a: Vector, b: Vector) -> tuple[Scalar, Scalar]:
        """Return the largest absolute value in `a`, and the scalar product of `a` and `b`."""
        self._run("weigh", {}, [a.texture, b.texture], [self._shares(), self._peaks()])
        product, largest = self._totals("weighed", self._share, self._peak)
        return largest, product

    def quotient(self, a: Scalar | Product, b: Scalar | Product) -> Scalar:
        """Return a / b for scalars or products of any sign, or 0 if b is 0."""
        made = Scalar(self._scalar_texture(), self._spare_scalars)
        inputs = [*self._factor_textures(a), *self._factor_textures(b)]
        self._passes.run(self._passes.program("quotient"), inputs, [made.texture], (1, 1))
        return made

    def times(self, a: Scalar, b: Scalar) -> Product:
        """Return the unevaluated product a b, as an argument for `quotient`."""
        return Product(a, b)

    def advance(
        self, d: Vector, rest: Vector, direction: Vector, image: Vector, length: Number
    ) -> Scalar:
        """Update `d` and `rest` for a step along `direction`; return ``rest . rest``.

        The update is ``d += length * direction`` and ``rest -= length * image``.
        """
        inputs = [
            d.texture,
            rest.texture,
            direction.texture,
            image.texture,
            *self._ratio_textures(length),
        ]
        signed = {"SIGNED": int(isinstance(length, Scalar))}
        self._run("advance", signed, inputs, [d.other, rest.other, self._shares()])
        d.turn()
        rest.turn()
        return self._total()

    def add(self, d: Vector, correction: Vector) -> None:
        """Add a vector to `d`, in place."""
        unit = self._passes.unit
        self._run("turn", {}, [d.texture, correction.texture, unit, unit], [d.other])
        d.turn()

    def turn(self, steepest: Vector, direction: Vector, share: Number) -> None:
        """Compute ``direction = steepest + share * direction``."""
        inputs = [steepest.texture, direction.texture, *self._ratio_textures(share)]
        self._run("turn", {}, inputs, [direction.other])
        direction.turn()

    def lean(
        self, rest: Vector, direction: Vector, image: Vector, share: Scalar, stride: Scalar
    ) -> None:
        """Compute ``direction = rest + share * (direction - stride * image)``."""
        vectors = [each.texture for each in (rest, direction, image)]
        self._run("lean", {}, [*vectors, share.texture, stride.texture], [direction.other])
        direction.turn()

    def read(self, *scalars: Number) -> tuple[float, ...]:
        """Wait for the device, and return the values of scalars and ratios."""
        self._passes.wait()

        @cache
        def value(scalar: Scalar) -> float:
            return float(np.frombuffer(scalar.texture.read(), "<f4")[0])

        values = values_of(scalars, value)
        self._passes.device.check("reading scalars")
        return values

    def _run(
        self,
        name: str,
        defines: Mapping[str, int],
        inputs: list[Any],
        outputs: list[Any],
        uniforms: Uniforms | None = None,
    ) -> None:
        """Run a kernel on the level's tissue."""
        program = self._passes.program(name, defines)
        program.set(uniforms or {})
        self._passes.run(program, inputs, outputs, self._pairs, tissue=self._tissue)

    def _zero_texture(self) -> Any:
        """Return a texture of zeros, reusing a free texture if possible."""
        if not self._spare:
            return self._passes.blank(self._pairs, 4)
        texture = self._spare.pop()
        self._passes.clear(texture)
        return texture

    def _shares(self) -> Any:
        """Return the texture of contributions to a sum, one for each invocation of a kernel."""
        if self._share is None:
            self._share = self._passes.blank(self._invocations, 1)
        return self._share

    def _peaks(self) -> Any:
        """Return the texture of largest values, one for each invocation of a kernel."""
        if self._peak is None:
            self._peak = self._passes.blank(self._invocations, 1)
        return self._peak

    @property
    def _invocations(self) -> tuple[int, int]:
        """Grid of the invocations of a kernel for tissue, (rows, cols)."""
        rows, cols = self._pairs
        return -(-rows // self._passes.rows), cols

    def _total(self) -> Scalar:
        """Return the sum of the contributions of the last kernel."""
        (total,) = self._totals("sum", self._share)
        return total

    def _totals(self, kernel: str, *values: Any) -> list[Scalar]:
        """Combine all values of each texture with the kernel "sum" or "weighed"."""
        cols, rows = values[0].size
        block = BLOCK if self._passes.rows == 1 else _LARGE_BLOCK
        while True:
            rows, cols = -(-rows // block), -(-cols // block)
            program = self._passes.program(kernel, {"BLOCK": block})
            if (rows, cols) == (1, 1):
                found = [Scalar(self._scalar_texture(), self._spare_scalars) for _ in values]
                self._passes.run(program, values, [each.texture for each in found], (1, 1))
                return found
            outputs = [self._block((rows, cols), number) for number in range(len(values))]
            self._passes.run(program, values, outputs, (rows, cols))
            values, block = tuple(outputs), max(block, _LATER_BLOCK)

    def _scalar_texture(self) -> Any:
        return self._spare_scalars.pop() if self._spare_scalars else self._passes.empty((1, 1), 1)

    def _block(self, grid: tuple[int, ...], number: int) -> Any:
        """Return the texture of block totals for a grid and one of several sorts of totals."""
        key = (*grid, number)
        if key not in self._blocks:
            self._blocks[key] = self._passes.empty(grid, 1)
        return self._blocks[key]

    def _ratio_textures(self, number: Number) -> list[Any]:
        """Return the textures of a number's numerator and denominator, as inputs of a kernel."""
        if isinstance(number, Ratio):
            return [number.above.texture, number.below.texture]
        return [number.texture, self._passes.unit]

    def _factor_textures(self, number: Scalar | Product) -> list[Any]:
        """Return the textures of a number's two factors, as inputs of a kernel."""
        if isinstance(number, Product):
            return [number.first.texture, number.second.texture]
        return [number.texture, self._passes.unit]


def stored_planes(planes: npt.NDArray[np.float32]) -> FloatArray:
    """Convert planes, shape (2, H + 4, W + 4), to texture layout, shape (H, pairs, 4)."""
    inner = planes[:, _PAD:-_PAD, _PAD:-_PAD]
    rows, cols = pairs(inner.shape[1:])
    made = np.zeros((rows, 2 * cols, 2), "<f4")
    for component in (0, 1):
        made[:, : inner.shape[2], component] = inner[component]
    return made.reshape(rows, cols, 4)
