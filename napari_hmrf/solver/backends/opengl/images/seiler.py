"""Model of the paper's cliques on the device, with set-up and double precision on the host."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.solver.backends.arrays import seiler
from napari_hmrf.solver.backends.linear import LinearModel
from napari_hmrf.solver.backends.opengl.images.fields import singles
from napari_hmrf.solver.backends.opengl.images.level import stored_planes
from napari_hmrf.solver.backends.opengl.images.model import GLModel
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.relaxing import (
    AS_IS,
    Float64Array,
    Model,
    RelaxingLevel,
)
from napari_hmrf.solver.priors.cliques import SeilerMaterial


class GLSeilerLevel(RelaxingLevel):
    """Level of the paper's model, with its cliques and springs as textures.

    Parameters
    ----------
    passes : Passes
    host : CpuSeilerLevel or ArraySeilerLevel
        The same level on the host, with its stiffness and springs.
    """

    def __init__(self, passes: Passes, host: Any) -> None:
        defines = {"BLANKET": int(bool(host.blanket)), "SQUARE": int(host.lines is None)}
        weights = {} if host.lines is None else {"weights": host.lines}
        model = Model("smooth_cliques", "apply_cliques", "residual", defines, weights)
        super().__init__(passes, host, host.stiffness[0, 2:-2, 2:-2] > 0, model)
        self._cliques = host
        self._tissue_textures = [passes.empty(singles(host.grid), 4) for _ in range(2)]
        stiffness = [passes.texture(stored_planes(host.stiffness))]
        passes.run(passes.program("ratios"), stiffness, self._tissue_textures, singles(host.grid))
        self._left = passes.blank(self._pairs, 4)
        # With centred cliques, a load is a mean over sites. `even` normalizes the restricted load.
        self._even = None
        if not host.blanket:
            self._even = passes.texture(stored_planes(np.stack([host.even] * 2)))

    def _restrict_residual(self, coarse: Self) -> None:
        inputs = [
            self.correction.texture,
            self.load.texture,
            *self._tissue_textures,
            *self._held_textures,
        ]
        self._run("residual", self._defines, inputs, [self._left], self._model.uniforms)
        even = {"EVEN": int(coarse._even is not None)}
        coarse._run("gather", even, [self._left, coarse._even or self._left], [coarse.load.texture])

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

        With blanket cliques, an extra pass computes the start unless `start` is `AS_IS`.
        """
        if self._cliques.blanket and start != AS_IS:
            d, last, unused = self.correction, self._last, self._inverse
            other = unused if coarse is None else coarse.correction.texture
            inputs = [d.texture, self.load.texture, self._inverse, other]
            number = {"first_scale": np.array([first], np.float32)}
            self._run("begin", {"START": start}, inputs, [d.other, last.other], number)
            d.turn()
            last.turn()
            start, coarse = AS_IS, None
        super()._smooth(start, scale, momentum, first, coarse, continues)

    def _matrix(self) -> Float64Array:
        """Assemble the matrix by columns from the host's forces for unit displacements."""
        host = self._cliques
        count = 4 * self._pairs[0] * self._pairs[1]
        grid = (*self._pairs, 2, 2)
        model = np.zeros((count, count))
        image = host.vector()
        for number in range(count):
            row, pair, second, component = np.unravel_index(number, grid)
            col = 2 * pair + second
            if col < host.grid[1]:
                single = host.vector()
                single[component, row + 2, col + 2] = 1
                host.apply(single, image)
                model[:, number] = stored_planes(image).ravel()
                host.free(single)
        return model


class GLSeilerModel(GLModel):
    """`LinearModel` of the paper's cliques.

    Parameters
    ----------
    passes : Passes
        Runner of the model's kernels; `free` frees its textures.
    host : LinearModel
        Result of `host_of`.
    """

    def __init__(self, passes: Passes, host: LinearModel) -> None:
        super().__init__(passes, host, [GLSeilerLevel(passes, level) for level in host.levels])

    @property
    def slow(self) -> bool:
        """True for blanket cliques on a software renderer, where a factorization is faster.

        Blanket cliques need many V-cycles, and their kernels read many texels. On a software
        renderer, V-cycles take twice as long as a direct factorization for any image size, plus
        the time for compiling the shaders.
        """
        return bool(self.material.blanket and self._passes.device.software)

    @staticmethod
    def host_of(material: SeilerMaterial) -> LinearModel:
        """Return the model on the host, which uses NumPy until the compiled loops are ready."""
        if loops.in_use():
            from napari_hmrf.solver.backends.cpu import seiler_model  # heavy: numba

            return seiler_model.the_model(material)
        return seiler.the_model(material)
