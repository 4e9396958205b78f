"""Level of an image with the V-cycle passes, for any prior.

A subclass for each prior adds the kernels that compute forces, the textures that these kernels
read, and the restriction of the residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.linear import Steps
from napari_hmrf.solver.backends.opengl.images.level import GLLevel, Scalar, Vector, stored_planes
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.programs.programs import Uniforms
from napari_hmrf.solver.backends.planes import inside

Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

# On a level with at most `_FEW_VALUES` values, more than `_FEW_STEPS` smoothing steps are run as a
# single pass with a dense matrix, which is faster.
_FEW_VALUES = 128
_FEW_STEPS = 2
# Largest number of values of a level from which the rest of a cycle is run as a single pass.
_FEW_TO_FINISH = 800

#: Levels with fewer sites are visited only once in a cycle.
WORTH_AGAIN = 40_000

# (scale, momentum) of a step that changes nothing.
_NO_STEP = (0.0, 0.0)

# Values of START in smooth.glsl: start from the current correction, from zero, or from the current
# correction plus the coarse correction.
AS_IS, FROM_ZERO, FROM_COARSE = 0, 1, 2


def without_momentum(steps: Steps) -> Steps:
    """Return two steps without momentum that have the same effect as the given two steps.

    Two steps with scales s_0 and s_1, and the momentum m_1, multiply the error by
    1 - (s_0 + s_1 + m_1 s_0) A + s_0 s_1 A^2, which is (1 - w_0 A) (1 - w_1 A). Momentum requires
    another texture. More steps keep it, because rounding errors would grow without it.
    """
    if len(steps) != 2:
        return steps
    (first, _), (second, momentum) = steps
    total, product = first + second + momentum * first, first * second
    root = math.sqrt(max(total**2 - 4 * product, 0.0))
    return ((total - root) / 2, 0.0), ((total + root) / 2, 0.0)


def _need_last(steps: Sequence[tuple[float, float]]) -> bool:
    """Return whether the first of some steps needs the step before it."""
    return bool(steps) and steps[0][1] != 0


class Model(NamedTuple):
    """Kernels of a prior, with their constants.

    Attributes
    ----------
    smooth, apply, residual : str
        Names of the kernels.
    defines : mapping of str to int
        Preprocessor definitions of all kernels of the prior.
    uniforms : mapping of str to ndarray
        Uniforms of all kernels of the prior.
    """

    smooth: str
    apply: str
    residual: str
    defines: Mapping[str, int]
    uniforms: Uniforms


class RelaxingLevel(GLLevel):
    """Level with a smoother; `LinearLevel` documents the methods.

    Parameters
    ----------
    passes : Passes
    host : CpuLevel or ArrayLevel
        The same level on the host, with the diagonal and the springs (``weight``).
    shown : ndarray of bool, shape (H, W)
        Mask of tissue.
    model : Model
    """

    def __init__(
        self, passes: Passes, host: Any, shown: npt.NDArray[np.bool_], model: Model
    ) -> None:
        super().__init__(passes, host.grid, shown)
        self._host, self._model = host, model
        self._inverse = passes.empty(self._pairs, 4)
        self._springs = None if host.weight is None else passes.empty(self._pairs, 4)
        self._defines = {"SPRINGS": int(self._springs is not None), **model.defines}
        # Textures that depend on the tissue, and on the prescribed components.
        self._tissue_textures: list[Any] = []
        self._held_textures = [self._inverse, self._springs or self._inverse]
        self.load, self.correction, self._last = self.vector(), self.vector(), self.vector()
        self._matrices: dict[Any, Any] = {}

    def _matrix(self) -> Float64Array:
        """Return the dense matrix of a small level, without springs, in texture order."""
        raise NotImplementedError

    def hold(self) -> None:
        """Copy the diagonal and the springs for the prescribed components from the host."""
        self._inverse.write(stored_planes(self._host.inverse))
        if self._springs is not None:
            self._springs.write(stored_planes(np.asarray(self._host.weight)))
        self._matrices.clear()

    @property
    def finishes_cycle(self) -> bool:
        """True if `finish` also processes all coarser levels, as those of the host can."""
        is_small = 4 * math.prod(self._pairs) <= _FEW_TO_FINISH
        return is_small and self._host.responses is not None

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Compute the correction, on all coarser levels in a single pass if that is possible."""
        if self.finishes_cycle:
            matrix_of = partial(self._cycle, steps, coarsest)
            self._apply_matrix(("cycle", steps, coarsest), matrix_of)
        else:
            super().finish(steps, coarsest)

    @property
    def is_revisited(self) -> bool:
        """True if a second visit within a cycle is worth its cost.

        The cost includes the passes of all coarser levels.
        """
        return math.prod(self.grid) >= WORTH_AGAIN

    def ascend(self, steps: Steps, coarse: Self) -> None:
        """Add the interpolated correction of the next coarser level, and smooth."""
        first, *others = without_momentum(steps)
        self._smooth(FROM_COARSE, *first, coarse=coarse, continues=_need_last(others))
        self._take(others)

    def _relax(self, steps: Steps, from_zero: bool) -> None:
        """Smooth the correction, from zero or from its current value.

        From zero, a single pass computes the first two steps, or all steps on a small level.
        """
        steps = without_momentum(steps)
        if from_zero:
            if len(steps) > _FEW_STEPS and 4 * math.prod(self._pairs) <= _FEW_VALUES:
                self._relax_at_once(steps)
                return
            (first, _), (scale, momentum), *_ = (*steps, _NO_STEP)
            steps = steps[2:]
            self._smooth(FROM_ZERO, scale, momentum, first=first, continues=_need_last(steps))
        self._take(steps)

    def _take(self, steps: Sequence[tuple[float, float]]) -> None:
        """Run steps from the current correction, of which the first may have a momentum."""
        for number, step in enumerate(steps, start=1):
            self._smooth(AS_IS, *step, continues=_need_last(steps[number:]))

    def apply(self, direction: Vector, image: Vector) -> Scalar:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        model = self._model
        inputs = [direction.texture, *self._tissue_textures, self._inverse]
        outputs = [image.texture, self._shares()]
        self._run(model.apply, model.defines, inputs, outputs, model.uniforms)
        return self._total()

    @property
    def nothing(self) -> Any:
        """Texture of a load that is zero at all sites."""
        return self._passes.zero

    def residual(self, d: Vector, load: Any) -> Vector:
        """Return ``load - A d``, for the texture of a load, and 0 at fixed components."""
        made, model = self.vector(), self._model
        inputs = [d.texture, load, *self._tissue_textures, *self._held_textures]
        self._run(model.residual, self._defines, inputs, [made.texture], model.uniforms)
        return made

    def prescribed(
        self, observed: Vector, parts: Sequence[Vector], shares: Sequence[float]
    ) -> Vector:
        """Return a weighted sum of vectors, with the observations at fixed components."""
        made, weights = self.vector(), np.zeros(4, np.float32)
        weights[: len(shares)] = shares
        unused = [self._inverse] * (len(weights) - len(parts))
        inputs = [observed.texture, self._inverse, *(each.texture for each in parts), *unused]
        self._run("prescribe", {}, inputs, [made.texture], {"weights": weights})
        return made

    def multiply(self, direction: Vector, image: Vector) -> None:
        """Compute ``image = A @ direction``."""
        self.apply(direction, image)

    def _smooth(
        self,
        start: int,
        scale: float,
        momentum: float,
        first: float = 0.0,
        coarse: RelaxingLevel | None = None,
        continues: bool = True,
    ) -> None:
        """Run one step of the smoother, or two steps if it starts from zero.

        The step is stored only if the next one needs it for its momentum.
        """
        d, last, unused = self.correction, self._last, self._inverse
        inputs = [
            unused if start == FROM_ZERO else d.texture,
            self.load.texture,
            *self._tissue_textures,
            *self._held_textures,
            last.texture if start == AS_IS and momentum != 0 else unused,
            unused if coarse is None else coarse.correction.texture,
        ]
        values = {"scale": scale, "momentum": momentum, "first_scale": first}
        numbers = {name: np.array([value], np.float32) for name, value in values.items()}
        needs = {"CONTINUES": int(continues), "MOMENTUM": int(momentum != 0)}
        defines = {"START": start, **needs, **self._defines}
        uniforms = {**self._model.uniforms, **numbers}
        outputs = [d.other, last.other] if continues else [d.other]
        self._run(self._model.smooth, defines, inputs, outputs, uniforms)
        d.turn()
        if continues:
            last.turn()

    def _relax_at_once(self, steps: Steps) -> None:
        """Run all steps from zero as a single pass."""
        self._apply_matrix(tuple(steps), partial(self._smoother, steps))

    def _apply_matrix(self, key: Any, texels_of: Callable[[Indices], FloatArray]) -> None:
        """Multiply the load by a matrix, which is computed once for its key, in a single pass.

        `texels_of` returns the matrix, shape (N, 4 N, 4), of the N pairs with the given indices:
        texel (p, 4 q + k) contains the effect of value k of pair q on the values of pair p.
        """
        if key not in self._matrices:
            rows, cols = self._pairs
            at = np.flatnonzero((stored_planes(self._host.inverse) > 0).any(axis=2))
            at = at if len(at) else np.zeros(1, np.int64)  # no texture is empty
            number = np.full((rows * cols, 1), -1, np.float32)
            number[at, 0] = np.arange(len(at))
            places = np.stack([at % cols, at // cols], axis=1).astype(np.float32)[None]
            arrays = texels_of(at), number.reshape(rows, cols, 1), places
            self._matrices[key] = [self._passes.texture(each) for each in arrays]
        program = self._passes.program("at_once")
        inputs = [self.load.texture, *self._matrices[key]]
        self._passes.run(program, inputs, [self.correction.other], self._pairs)
        self.correction.turn()

    def _cycle(self, steps: Steps, coarsest: Steps, at: Indices) -> FloatArray:
        """Return the matrix that maps a load to the correction after a cycle from this level.

        Each column is the correction that the host computes for a unit load.
        """
        unknown = np.flatnonzero(self._host.inverse > 0)
        component, row, col = np.nonzero(inside(self._host.inverse) > 0)
        pair = np.searchsorted(at, row * self._pairs[1] + col // 2)
        value = 4 * pair + 2 * (col % 2) + component
        made = np.zeros((4 * len(at), 4 * len(at)), np.float32)
        made[value[:, None], value] = self._host.responses(steps, coarsest, unknown)
        return np.moveaxis(made.reshape(4 * len(at), len(at), 4), 0, 1)

    def _smoother(self, steps: Steps, at: Indices) -> FloatArray:
        """Return the matrix that maps a load to the correction after all steps from zero."""
        # Use matrix products, because a decomposition would start the threads of LAPACK, which
        # then busy-wait on the cores that a software rasterizer needs.
        host, matrix = self._host, self._matrix()
        if host.weight is not None:
            matrix += np.diag(stored_planes(host.weight).astype(np.float64).ravel())
        inverse = stored_planes(host.inverse).astype(np.float64).reshape(-1, 1)
        moved = taken = np.zeros_like(matrix)
        for scale, momentum in steps:
            left = np.eye(len(matrix)) - matrix @ moved
            taken = scale * inverse * left + momentum * taken
            moved = moved + taken
        pairs = math.prod(self._pairs)
        blocks = moved.reshape(pairs, 4, pairs, 4)[at][:, :, at].astype(np.float32)
        return blocks.transpose(0, 2, 3, 1).reshape(len(at), -1, 4)
