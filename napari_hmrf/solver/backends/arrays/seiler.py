"""The paper's cliques as arrays: their levels and their forces in double precision.

`stiffness` is (m, 1/m) as planes, and 0 in void. `lines` is the weight of each line of cliques for
each component. With centred cliques, the model is A d = d - q(d), where q is the minimizer of the
local energy. With blanket cliques, A d is half the gradient of the cliques in U_total; twice the
weights give the whole gradient.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.arrays.level import ArrayLevel, Real, Vector, restricted
from napari_hmrf.solver.backends.arrays.model import ArrayModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.coarse_levels import grids
from napari_hmrf.solver.priors.cliques import SeilerMaterial, cliques

Float64Array = npt.NDArray[np.float64]


class ArraySeilerLevel(ArrayLevel):
    """Cliques and springs of one level.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (H, W) or (D, H, W).
    stiffness : ndarray, shape (2, H + 4, W + 4) or (2, D + 4, H + 4, W + 4)
        (m, 1/m), 0 in void.
    even : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Factor that converts a weighted sum over the tissue around a site of the finer level to four
        times the weighted mean.
    material : SeilerMaterial
    share : float
        Weight of all cliques on this level.
    finest : bool
        True for the finest level.
    """

    def __init__(
        self,
        grid: tuple[int, ...],
        stiffness: Float64Array,
        even: Float64Array,
        material: SeilerMaterial,
        share: float,
        finest: bool,
    ) -> None:
        super().__init__(grid, finest)
        self.blanket = material.blanket or None
        #: Weights for the kernels; None if the special kernels for square pixels are used.
        plain = material.square and not material.blanket
        self.lines = None if plain else (share * material.lines).astype(np.float32)
        self._lines = share * material.lines
        self.stiffness: Vector = stiffness.astype(np.float32)
        self.even: Vector = even.astype(np.float32)
        at_rest = np.zeros((len(grid), *stiffness[0].shape))
        found = cliques(at_rest, stiffness[0], self._lines, material.blanket)
        self.steep = found.curvature.astype(np.float32)
        pulled = (self.steep > 0).astype(np.float32)
        self.diagonal = self.steep if material.blanket else pulled

    def _pinned(self, held: HeldPlanes) -> HeldPlanes:
        return np.asarray((self.stiffness[:1] > 0) & ((self.steep == 0) | held))

    def apply(self, direction: Vector, image: Vector) -> None:
        """Compute ``image = A @ direction``."""
        image[...] = -pull(direction, self.stiffness[0], self._lines, bool(self.blanket))
        image[self.inverse == 0] = 0


def pull(d: Real, m: Real, lines: Float64Array, blanket: bool) -> Float64Array:
    """Return -A d at all components."""
    curvature, slope, _ = cliques(d, m, lines, blanket)
    return slope if blanket else slope / np.maximum(curvature, 1e-30)


class ArraySeilerModel(ArrayModel):
    """NumPy implementation of the host's part of `LinearModel` for the paper's cliques.

    Parameters
    ----------
    material : SeilerMaterial
    """

    def __init__(self, material: SeilerMaterial) -> None:
        super().__init__(material)
        self.bounds = material.bounds
        self._lines = (2 if material.blanket else 1) * material.lines
        m = material.m / np.float64(material.m.max())
        stiffness = np.zeros((2, *(size + 4 for size in m.shape)))
        stiffness[0][(slice(2, -2),) * m.ndim] = m
        np.divide(1.0, stiffness[0], out=stiffness[1], where=stiffness[0] > 0)
        self._m, even = stiffness[0], np.zeros(stiffness.shape[1:])
        self.levels = []
        for number, grid in enumerate(grids(m.shape)):
            if number > 0:
                stiffness, even = _coarser(stiffness[0], grid)
            # For the same curvature of the displacement, the energy of a clique is sixteen times as
            # large on the next coarser level, but there are a quarter as many cliques.
            share = 2 * 0.25**number if material.blanket else 1.0
            self.levels.append(
                ArraySeilerLevel(grid, stiffness, even, material, share, number == 0)
            )
        self._rest = self.levels[0].vector()

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision."""
        if low is not None:
            assert self.material.blanket
            pulls: Planes = self.material.pull(d, low)
            return pulls
        return pull(d, self._m, self._lines, self.material.blanket)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the energy of the cliques in U_total, and the norm of all forces."""
        curvature, slope, energy = cliques(d, self._m, self._lines, self.material.blanket)
        pulls = slope if self.material.blanket else slope / np.maximum(curvature, 1e-30)
        return float(energy.sum()) / (2 if self.material.blanket else 1), float(
            np.linalg.norm(pulls)
        )

    @property
    def steepness(self) -> Planes:
        """Second derivative of each site's energy; 0 at sites without a clique."""
        at_rest = np.zeros((self._m.ndim, *self._m.shape))
        found = cliques(at_rest, self._m, self._lines, self.material.blanket).curvature
        return found if self.material.blanket else 2 * found

    def clear_cache(self) -> None:
        """Clear the model cache."""
        _model.clear()


def _coarser(fine: Float64Array, grid: tuple[int, ...]) -> tuple[Float64Array, Float64Array]:
    """Return (m, 1/m) and `even` of a coarser level; m is the mean over nearby fine tissue."""
    total, share = (restricted(each[None], grid)[0] for each in (fine, (fine > 0).astype(float)))
    made = np.zeros((3, *(size + 4 for size in grid)))
    inner = made[(slice(None), *[slice(2, -2)] * len(grid))]
    np.divide(total, share, out=inner[0], where=total > 0)
    np.divide(share, total, out=inner[1], where=total > 0)
    # The divisor is at least a quarter of the weight of a complete neighbourhood.
    inner[2] = 4 / np.maximum(share, 2 ** len(grid) / 4)
    return made[:2], made[2]


_model: Kept[ArraySeilerModel] = Kept()


def the_model(material: SeilerMaterial) -> ArraySeilerModel:
    """Return the model of a material, reusing the last one if possible."""
    return _model.get(lambda last: last.material == material, lambda: ArraySeilerModel(material))
