"""Elastic tissue on the device; set-up and double precision are the compiled loops' work."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.cpu.elastic_model import CpuElasticLevel, the_model
from napari_hmrf.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.backends.opengl.level import GLLevel, Scalar, Vector, stored_planes
from napari_hmrf.backends.opengl.passes import Passes
from napari_hmrf.priors.elastic import ElasticMaterial, ElementShape, Lame, element_forces

Float64Array = npt.NDArray[np.float64]

# All steps of a level with so few values are one matrix; two passes would be no slower.
_FEW_VALUES = 128
_FEW_STEPS = 2

# A step that changes nothing.
_NO_STEP = (0.0, 0.0)

# START of smooth.glsl: from what the correction is, from zero, or with the coarse correction added.
_AS_IS, _FROM_ZERO, _FROM_COARSE = 0, 1, 2


class GLElasticLevel(GLLevel):
    """One level's elements and springs; `LinearLevel` says what each method does.

    Parameters
    ----------
    passes : Passes
    host : CpuElasticLevel
        Where elements and springs come from.
    shape : ElementShape
    """

    def __init__(self, passes: Passes, host: CpuElasticLevel, shape: ElementShape) -> None:
        there = host.lame[1] > 0
        there[1:] |= there[:-1]
        there[:, 1:] |= there[:, :-1]
        super().__init__(passes, host.grid, there[2:-2, 2:-2])
        self._host, self._element = host, shape
        self._shape = {"shape": np.array(shape, np.float32)}
        self._lame = passes.texture(stored_planes(host.lame))
        self._inverse = passes.blank(self._pairs, 4)
        self._springs = None if host.weight is None else passes.blank(self._pairs, 4)
        self._model = [self._lame, self._inverse, self._springs or self._inverse]
        self._defines = {"SPRINGS": int(self._springs is not None)}
        self.load, self.correction, self._last = self.vector(), self.vector(), self.vector()
        self._matrices: dict[Any, Any] = {}

    def hold(self) -> None:
        """Bring what is held from the host."""
        self._inverse.write(stored_planes(self._host.inverse))
        if self._springs is not None:
            self._springs.write(stored_planes(np.asarray(self._host.weight)))
        self._matrices.clear()

    #: Each level is visited by itself.
    takes_rest = False

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Relax from zero as the coarsest level."""
        self.descend(coarsest, None)

    def descend(self, steps: Steps, coarse: GLElasticLevel | None) -> None:
        """Relax from zero, and hand what is left of the load down."""
        (first, _), (scale, momentum), *others = (*steps, _NO_STEP)[: max(2, len(steps))]
        if len(steps) > _FEW_STEPS and 4 * math.prod(self._pairs) <= _FEW_VALUES:
            self._relax_at_once(steps)
        else:
            self._smooth(_FROM_ZERO, scale, momentum, first=first)
            for step in others:
                self._smooth(_AS_IS, *step)
        if coarse is not None:
            inputs = [self.correction.texture, self.load.texture, *self._model]
            coarse._run("restrict", self._defines, inputs, [coarse.load.texture], self._shape)

    def ascend(self, steps: Steps, coarse: GLElasticLevel) -> None:
        """Add the coarse correction, and relax."""
        self._smooth(_FROM_COARSE, *steps[0], coarse=coarse)
        for step in steps[1:]:
            self._smooth(_AS_IS, *step)

    def apply(self, direction: Vector, image: Vector) -> Scalar:
        """Image = A direction; their scalar product."""
        inputs = [direction.texture, self._lame, self._inverse]
        self._run("apply", {}, inputs, [image.texture, self._shares()], self._shape)
        return self._sum_of_shares()

    def _smooth(
        self,
        start: int,
        scale: float,
        momentum: float,
        first: float = 0.0,
        coarse: GLElasticLevel | None = None,
    ) -> None:
        """One step of the smoother, or two from zero."""
        d, last, unused = self.correction, self._last, self._inverse
        inputs = [
            unused if start == _FROM_ZERO else d.texture,
            self.load.texture,
            *self._model,
            last.texture if start == _AS_IS else unused,
            unused if coarse is None else coarse.correction.texture,
        ]
        values = {"scale": scale, "momentum": momentum, "first_scale": first}
        numbers = {name: np.array([value], np.float32) for name, value in values.items()}
        defines = {"START": start, **self._defines}
        self._run("smooth", defines, inputs, [d.other, last.other], {**self._shape, **numbers})
        d.turn()
        last.turn()

    def _relax_at_once(self, steps: Steps) -> None:
        """All steps from zero as one pass: they are a polynomial of the level's matrix."""
        key = tuple(steps)
        if key not in self._matrices:
            matrix = _smoother_matrix(self._host, self._element, steps)
            count = matrix.shape[0] // 4
            texels = matrix.reshape(count, 4, -1).swapaxes(1, 2)
            self._matrices[key] = self._passes.texture(texels.astype(np.float32))
        program = self._passes.program("at_once")
        inputs, outputs = [self.load.texture, self._matrices[key]], [self.correction.other]
        self._passes.run(program, inputs, outputs, self._pairs)
        self.correction.turn()


class GLElasticModel:
    """`LinearModel` of elastic tissue.

    Parameters
    ----------
    passes : Passes
        Its own: they end with it.
    material : ElasticMaterial
    """

    def __init__(self, passes: Passes, material: ElasticMaterial) -> None:
        self._passes = passes
        self._host = the_model(material)
        self.bounds = self._host.bounds
        self.levels = [GLElasticLevel(passes, level, material.shape) for level in self._host.levels]

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on all levels."""
        self._host.hold(held)
        for level in self.levels:
            level.hold()

    def residual(self, d: Planes, load: Planes | None) -> Planes:
        """Load - A d in double precision, 0 where held."""
        return self._host.residual(d, load)

    def pull(self, d: Planes) -> Planes:
        """- A d everywhere, in double precision."""
        return self._host.pull(d)

    def work(self, d: Planes) -> tuple[float, float]:
        """The elastic energy, and the norm of the forces."""
        return self._host.work(d)

    @property
    def steepness(self) -> Planes:
        """The diagonal of the stiffness matrix."""
        return self._host.steepness

    def forget(self) -> None:
        """Nothing to do: no vector outlives a solve."""

    def close(self) -> None:
        """Free every texture."""
        self._passes.close()


def _smoother_matrix(host: CpuElasticLevel, element: ElementShape, steps: Steps) -> Float64Array:
    """What all steps from zero make of a load: a matrix for values in pairs, row by row.

    With the diagonal's roots on both sides the level's matrix is symmetric, and the steps are the
    same polynomial of each of its eigenvalues.
    """
    root = np.sqrt(stored_planes(host.inverse).astype(np.float64)).ravel()
    matrix = _stiffness_matrix(stored_planes(host.lame).astype(np.float64), element)
    if host.weight is not None:
        matrix += np.diag(stored_planes(host.weight).astype(np.float64).ravel())
    eigenvalues, modes = np.linalg.eigh(root[:, None] * matrix * root)
    moved = taken = np.zeros_like(eigenvalues)
    for scale, momentum in steps:
        taken = scale * (1 - eigenvalues * moved) + momentum * taken
        moved = moved + taken
    smoother: Float64Array = root[:, None] * ((modes * moved) @ modes.T) * root
    return smoother


def _stiffness_matrix(stored_lame: Float64Array, element: ElementShape) -> Float64Array:
    """The stiffness matrix of a small level."""
    first, shear = _element_matrices(element)
    lame = stored_lame.reshape(stored_lame.shape[0], -1, 2)
    number = np.arange(lame.size).reshape(lame.shape)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]]
    values = np.stack(corners, axis=2).reshape(-1, 8)
    of_first, of_shear = lame[:-1, :-1].reshape(-1, 2).T[..., None, None]
    total = np.zeros((lame.size, lame.size))
    np.add.at(total, (values[:, :, None], values[:, None]), of_first * first + of_shear * shear)
    return total


@lru_cache(maxsize=16)
def _element_matrices(element: ElementShape) -> tuple[Float64Array, Float64Array]:
    """The stiffness of one element, 8 x 8: its parts in the first of Lame's parameters and mu."""
    impulses = np.eye(8).reshape(8, 2, 2, 2)
    both = []
    for lame in (Lame(np.ones((1, 1)), np.zeros((1, 1))), Lame(np.zeros((1, 1)), np.ones((1, 1)))):
        both.append(np.array([element_forces(lame, element, d).ravel() for d in impulses]))
    return both[0], both[1]
