"""Elastic model of an image on the device, with set-up and double precision on the host."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.solver.backends.arrays import elastic
from napari_hmrf.solver.backends.linear import LinearModel
from napari_hmrf.solver.backends.opengl.images.level import stored_planes
from napari_hmrf.solver.backends.opengl.images.model import GLModel
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.relaxing import Float64Array, Model, RelaxingLevel
from napari_hmrf.solver.priors.elements import ElasticMaterial, ElementShape, element_stiffness


class GLElasticLevel(RelaxingLevel):
    """Level of an elastic image, with its elements and springs as textures.

    Parameters
    ----------
    passes : Passes
    host : CpuElasticLevel or ArrayElasticLevel
        The same level on the host, with its elements and springs.
    shape : ElementShape
    """

    def __init__(self, passes: Passes, host: Any, shape: ElementShape) -> None:
        tissue = host.lame[1] > 0
        tissue[1:] |= tissue[:-1]
        tissue[:, 1:] |= tissue[:, :-1]
        model = Model(
            "smooth", "apply", "residual_elements", {}, {"shape": np.array(shape, np.float32)}
        )
        super().__init__(passes, host, tissue[2:-2, 2:-2], model)
        self._lame, self._element = host.lame, shape
        self._tissue_textures = [passes.texture(stored_planes(host.lame))]

    def _restrict_residual(self, coarse: Self) -> None:
        inputs = [
            self.correction.texture,
            self.load.texture,
            *self._tissue_textures,
            *self._held_textures,
        ]
        outputs = [coarse.load.texture]
        coarse._run("restrict", self._defines, inputs, outputs, self._model.uniforms)

    def _matrix(self) -> Float64Array:
        return _stiffness_matrix(stored_planes(self._lame).astype(np.float64), self._element)


class GLElasticModel(GLModel):
    """`LinearModel` of an elastic image.

    Parameters
    ----------
    passes : Passes
        Runner of the model's kernels; `free` frees its textures.
    host : LinearModel
        Result of `host_of`.
    """

    def __init__(self, passes: Passes, host: LinearModel) -> None:
        levels: list[GLElasticLevel] = []
        for level in host.levels:
            levels.append(GLElasticLevel(passes, level, host.material.shape))
            if levels[-1].finishes_cycle:
                break
        super().__init__(passes, host, levels)

    @staticmethod
    def host_of(material: ElasticMaterial) -> LinearModel:
        """Return the model on the host, which uses NumPy until the compiled loops are ready."""
        return model_of_loops(material) if loops.in_use() else elastic.the_model(material)


def model_of_loops(material: ElasticMaterial) -> LinearModel:
    """Return the model of the compiled loops, which also support a data term."""
    from napari_hmrf.solver.backends.cpu import elastic_model  # heavy: numba

    return elastic_model.the_model(material)


def _stiffness_matrix(stored_lame: Float64Array, element: ElementShape) -> Float64Array:
    """Return the dense stiffness matrix of a small level, with unknowns in texture order."""
    first, shear = element_stiffness(element)
    lame = stored_lame.reshape(stored_lame.shape[0], -1, 2)
    number = np.arange(lame.size).reshape(lame.shape)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]]
    values = np.stack(corners, axis=2).reshape(-1, 8)
    of_first, of_shear = lame[:-1, :-1].reshape(-1, 2).T[..., None, None]
    total = np.zeros((lame.size, lame.size))
    np.add.at(total, (values[:, :, None], values[:, None]), of_first * first + of_shear * shear)
    return total
