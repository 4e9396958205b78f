"""Model of the paper's cliques on the processor: levels, and forces in double precision."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Self

import numba
import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu import kernels, seiler, vectors, volume_seiler
from napari_hmrf.solver.backends.cpu.layout import rows
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Spans, Vector, all_sites
from napari_hmrf.solver.backends.cpu.transfer import padded
from napari_hmrf.solver.backends.cpu.volume_cliques import offsets
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.planes import inside
from napari_hmrf.solver.coarse_levels import grids
from napari_hmrf.solver.priors.cliques import SeilerMaterial

Lines = npt.NDArray[np.float64]

# Empty row totals, for calls that need no scalar product.
_NO_ROWS = np.zeros(0)
# Levels with fewer sites than this use one thread, because waking the other threads takes longer.
_SMALL = 8000


class CpuSeilerLevel(CpuLevel):
    """Level with cliques and springs.

    Attributes
    ----------
    stiffness : ndarray, shape (2, H + 4, W + 4) or (2, D + 4, H + 4, W + 4)
        Stiffness and its reciprocal, (m, 1/m); 0 in void.
    lines : ndarray, shape (4, 2), or None
        Weight of each line of cliques for each component; None selects the faster kernels for
        square pixels.
    even : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Factor that converts a weighted sum over the tissue around a site of the finer level to four
        times its mean, which is the residual on a grid with twice the spacing.
    """

    def __init__(
        self, grid: tuple[int, ...], lines: Vector, square: bool, blanket: bool, finest: bool
    ) -> None:
        super().__init__(grid, finest)
        self.lines, self.blanket = None if square else lines, blanket or None
        self._lines = lines
        self.stiffness, self.even = padded(2, grid), padded(1, grid)[0]
        self._diagonal, self.threads = self.vector(), 1

    def coarsen(self, finer: Self) -> None:
        """Compute the stiffness from the next finer level."""
        raise NotImplementedError

    def curvature(self, stiffness: Planes, lines: Lines) -> Planes:
        """Return the curvature of each site's cliques, in double precision."""
        raise NotImplementedError

    def even_out(self) -> None:
        """Multiply the load by `even` after its restriction from the finer level."""
        raise NotImplementedError

    def _residual(
        self,
        d: Vector,
        load: tuple[Vector, int],
        springs: tuple[Vector, np.float32],
        out: tuple[int, Vector],
        totals: npt.NDArray[np.float64],
    ) -> None:
        """Write a multiple of the residual; `load` and `out` are pairs of an array and a factor."""
        raise NotImplementedError

    def compute_diagonal(self, stiffness: Planes) -> None:
        """Compute the diagonal from a stiffness in double precision."""
        exactly = self.curvature(stiffness, self._lines.astype(np.float64))
        self._diagonal[...] = exactly if self.blanket else exactly > 0

    def write_diagonal(self, out: Vector) -> None:
        """Copy the diagonal to `out`."""
        np.copyto(out, self._diagonal)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level; sites without cliques are fixed."""
        alone = (self.stiffness[0] > 0) & (self._diagonal == 0)
        super().hold(held | alone)

    def descend(self, steps: Steps, coarse: Self | None, again: bool = False) -> None:
        """Smooth from zero, or continue if `again`; restrict the residual to `coarse.load`.

        With centred cliques, the coarse load is a mean over tissue sites.
        """
        numba.set_num_threads(self.threads)
        super().descend(steps, coarse, again)
        if coarse is not None and not self.blanket:
            coarse.even_out()

    def ascend(self, steps: Steps, coarse: Self) -> None:
        """Add the interpolated coarse correction, then smooth."""
        numba.set_num_threads(self.threads)
        super().ascend(steps, coarse)

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        self.multiply(direction, image, self._rows)
        with np.errstate(invalid="ignore"):  # the iteration checks for NaN
            return float(self._rows.sum())

    def multiply(
        self, direction: Vector, image: Vector, totals: npt.NDArray[np.float64] = _NO_ROWS
    ) -> None:
        """Compute ``image = A @ direction``; store ``direction . image`` per row in `totals`.

        Nothing is stored if `totals` is empty.
        """
        # Unused terms have a factor of 0 and refer to arrays that the kernel reads anyway.
        nothing, no_springs = (direction, 0), (self.inverse, np.float32(0))
        self._residual(direction, nothing, no_springs, (-1, image), totals)


class CpuImageSeilerLevel(CpuSeilerLevel):
    """Level of an image, with centred or blanket cliques and springs."""

    def coarsen(self, finer: Self) -> None:
        """Compute the stiffness from the next finer level."""
        seiler.coarsen(finer.stiffness, self.stiffness, self.even)

    def curvature(self, stiffness: Planes, lines: Lines) -> Planes:
        """Return the curvature of each site's cliques, in double precision."""
        out = np.zeros(self.inverse.shape)
        seiler.curvature(stiffness, lines, bool(self.blanket), out)
        return out

    def pull(self, d: Planes, stiffness: Planes, lines: Lines, spans: Spans, out: Planes) -> None:
        """Write -A d to `out` within the spans."""
        seiler.pull(d, stiffness, lines, self.blanket, spans, out)

    def work(self, d: Planes, stiffness: Planes, lines: Lines, spans: Spans, out: Planes) -> float:
        """Write -A d to `out` within the spans, and return the energy of the cliques."""
        share, totals = np.empty(self.grid), np.zeros(self.grid[0])
        kernels.energy(d, stiffness, spans, lines, share, totals)
        self.pull(d, stiffness, lines, spans, out)
        return float(totals.sum())

    def even_out(self) -> None:
        """Multiply the load by `even` after its restriction from the finer level."""
        seiler.even_out(self.load, self.even)

    def clear(self) -> None:
        """Set the correction and all arrays of the smoother to zero."""
        super().clear()
        for vector in (self._step, self._rest):
            vector.fill(0)

    @cached_property
    def _step(self) -> Vector:
        """Latest Chebyshev step."""
        return self.vector()

    def _begin(self, paces: Vector) -> int:
        arrays = self.load, self.inverse, self._step, self.correction
        vectors.smooth_first(*arrays, paces[0, 0])
        return 1

    def _smooth(self, paces: Vector) -> None:
        ((scale, momentum, _),) = paces
        seiler.smooth(
            self.correction,
            self.load,
            self.stiffness,
            self.inverse,
            *self._springs,
            self.lines,
            self.blanket,
            self.spans,
            self._step,
            self._other,
            scale,
            momentum,
        )

    def _write_rest(self) -> Vector:
        self._residual(self.correction, (self.load, 1), self._springs, (1, self._rest), _NO_ROWS)
        return self._rest

    def _residual(
        self,
        d: Vector,
        load: tuple[Vector, int],
        springs: tuple[Vector, np.float32],
        out: tuple[int, Vector],
        totals: npt.NDArray[np.float64],
    ) -> None:
        """Call `seiler.residual`; `load` and `out` are pairs of an array and a factor."""
        seiler.residual(
            d,
            load[0],
            np.float32(load[1]),
            self.stiffness,
            self.inverse,
            *springs,
            self.lines,
            self.blanket,
            self.spans,
            np.float32(out[0]),
            out[1],
            totals,
        )


class CpuVolumeSeilerLevel(CpuSeilerLevel):
    """Level of a volume, with centred cliques and springs."""

    @property
    def _tissue(self) -> tuple[Vector, Vector, npt.NDArray[np.int64]]:
        """Arrays that describe the tissue for the kernels."""
        return rows(self.stiffness), self._lines, offsets(self.grid)

    def coarsen(self, finer: Self) -> None:
        """Compute the stiffness as the mean of the finer level's tissue around each site."""
        tissue = finer.vector()
        tissue[0], tissue[1] = finer.stiffness[0], finer.stiffness[0] > 0
        finer._restrict(tissue, self, self.load)
        total, share, _ = inside(self.load)
        m, inverse = inside(self.stiffness)
        np.divide(total, share, out=m, where=total > 0)
        np.divide(share, total, out=inverse, where=total > 0)
        # The divisor is at least a quarter of the weight of complete surroundings.
        inside(self.even[None])[0] = 4 / np.maximum(share, 2)
        self.load.fill(0)

    def curvature(self, stiffness: Planes, lines: Lines) -> Planes:
        """Return the curvature of each site's cliques, in double precision."""
        out = np.zeros(self.inverse.shape)
        tissue = rows(stiffness), lines, offsets(self.grid)
        volume_seiler.curvature(*tissue, all_sites(self.grid), rows(out))
        return out

    def pull(self, d: Planes, stiffness: Planes, lines: Lines, spans: Spans, out: Planes) -> None:
        """Write -A d to `out` within the spans."""
        self.work(d, stiffness, lines, spans, out)

    def work(self, d: Planes, stiffness: Planes, lines: Lines, spans: Spans, out: Planes) -> float:
        """Write -A d to `out` within the spans, and return the energy of the cliques."""
        totals = np.zeros(len(spans))
        tissue = rows(stiffness), lines, offsets(self.grid)
        volume_seiler.pull(rows(d), *tissue, spans, rows(out), totals)
        return float(totals.sum())

    def even_out(self) -> None:
        """Multiply the load by `even` after its restriction from the finer level."""
        self.load *= self.even

    def _smooth(self, paces: Vector) -> None:
        weight, springs = self._springs
        volume_seiler.smooth.in_turns(
            len(paces),
            *map(rows, (self.correction, self._other, self.load)),
            *self._tissue,
            rows(self.inverse),
            rows(weight),
            springs,
            self.spans,
            paces,
        )

    def _write_rest(self) -> Vector:
        # `_other` can store the residual: the next step has no momentum and does not read `_other`.
        self._residual(self.correction, (self.load, 1), self._springs, (1, self._other), _NO_ROWS)
        return self._other

    def _residual(
        self,
        d: Vector,
        load: tuple[Vector, int],
        springs: tuple[Vector, np.float32],
        out: tuple[int, Vector],
        totals: npt.NDArray[np.float64],
    ) -> None:
        volume_seiler.residual(
            rows(d),
            rows(load[0]),
            np.float32(load[1]),
            *self._tissue,
            rows(self.inverse),
            rows(springs[0]),
            springs[1],
            self.spans,
            np.float32(out[0]),
            rows(out[1]),
        )
        if len(totals):
            vectors.product(rows(d), rows(out[1]), totals)


class CpuSeilerModel(HostModel):
    """`LinearModel` of the paper's cliques; other backends build their levels from this model.

    Parameters
    ----------
    material : SeilerMaterial
        Material on the finest grid.
    """

    def __init__(self, material: SeilerMaterial) -> None:
        self.material = material
        self.bounds = material.bounds
        self._held = None
        self._blanket = material.blanket or None
        # With blanket cliques, A is the gradient of the energy, which is twice the kernels' sum.
        self._lines = (2 if material.blanket else 1) * material.lines
        square = material.square and not material.blanket
        m = material.m / np.float64(material.m.max())
        inverse = np.divide(1.0, m, out=np.zeros_like(m), where=m > 0)
        kind = CpuImageSeilerLevel if m.ndim == 2 else CpuVolumeSeilerLevel
        self.levels = []
        for number, grid in enumerate(grids(m.shape)):
            # On the next coarser level, the same curvature of the displacement yields sixteen
            # times the energy per clique, but there are only a quarter as many cliques.
            share = 0.25**number if material.blanket else 1.0
            lines = (share * self._lines).astype(np.float32)
            self.levels.append(kind(grid, lines, square, material.blanket, number == 0))
        finest = self.levels[0]
        self._stiffness = np.zeros(finest.stiffness.shape)
        inside(self._stiffness)[...] = m, inverse
        finest.stiffness[...] = self._stiffness
        self._pull = np.zeros(finest.inverse.shape)
        self._rest = finest.vector()
        self._rows: npt.NDArray[np.float64] = np.zeros((2, len(finest.spans)))
        self._whole = all_sites(m.shape)
        finest.compute_diagonal(self._stiffness)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.coarsen(fine)
            coarse.compute_diagonal(coarse.stiffness.astype(np.float64))

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components on all levels."""
        threads = numba.get_num_threads()
        for level in self.levels:
            level.threads = 1 if math.prod(level.grid) < _SMALL else threads
        self._pull.fill(0)
        super().hold(held)

    def _start_cycles(self) -> None:
        for level in self.levels:
            level.start_cycles()

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        finest, pulls = self.levels[0], self._pull
        finest.pull(d, self._stiffness, self._lines, finest.spans, pulls)
        given, count = (pulls, 0.0) if load is None else (load, 1.0)
        most, squares = self._rows
        arrays = map(rows, (pulls, given))
        out = rows(self._rest)
        seiler.balance(*arrays, count, rows(finest.inverse), 1 / unit, out, most, squares)
        return float(most.max()), math.sqrt(squares.sum())

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision; valid until the next call."""
        if low is not None and self._blanket:
            pulls: Planes = self.material.pull(d, low)
            return pulls
        assert low is None  # extended-precision refinement exists only for blanket cliques
        self.levels[0].pull(d, self._stiffness, self._lines, self._whole, self._pull)
        return self._pull

    @property
    def steepness(self) -> Planes:
        """Second derivative of each site's energy; 0 at sites without cliques."""
        curvature: Planes = self.levels[0].curvature(self._stiffness, self._lines)
        return curvature if self._blanket else 2 * curvature

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the clique energy in U_total, and the norm of all forces."""
        pulls = self._pull
        energy = self.levels[0].work(d, self._stiffness, self._lines, self._whole, pulls)
        return energy / (2 if self._blanket else 1), math.sqrt(np.vdot(pulls, pulls))

    def clear_cache(self) -> None:
        """Forget the model, because vectors of the model may contain non-finite values."""
        _model.clear()


_model: Kept[CpuSeilerModel] = Kept()


def the_model(material: SeilerMaterial) -> CpuSeilerModel:
    """Return the model of a material, reusing the last model if possible.

    Users edit observations more often than tissue. Call this function only on the compute thread,
    because all solves share the model.
    """
    return _model.get(lambda last: last.material == material, lambda: CpuSeilerModel(material))
