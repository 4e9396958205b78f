"""Elastic tissue on the processor: its levels, and its forces in double precision."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.cpu import assembly, elastic, vectors
from napari_hmrf.backends.cpu.level import CpuLevel, Vector
from napari_hmrf.backends.linear import HeldPlanes, Planes
from napari_hmrf.coarsening import MOST_PINS, SPRING, grids, smoother_bounds
from napari_hmrf.priors.elastic import ElasticMaterial


class CpuElasticLevel(CpuLevel):
    """One level's elements and springs.

    Attributes
    ----------
    lame : ndarray, shape (2, H + 4, W + 4)
        Lame's parameters of the elements; 0 in void.
    weight : ndarray, shape (2, H + 4, W + 4), or None
        The springs; the finest level has none.
    pins : ndarray, shape (2, H + 4, W + 4)
        How much of what is held counts at each site.
    spans : ndarray, shape (H, 2)
        Where each row's moving sites begin and end.
    """

    def __init__(self, grid: tuple[int, ...], shape: Vector, finest: bool) -> None:
        super().__init__(grid)
        self.shape = shape
        self.lame, self.pins = self.vector(), self.vector()
        self.weight = None if finest else self.vector()
        self.spans: npt.NDArray[np.int64] = np.zeros((grid[0], 2), dtype=np.int64)

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on the finest level."""
        assembly.hold(self.lame, self.shape, held, self.inverse, self.pins, self.spans)
        self._forget()

    def hold_as(self, finer: CpuElasticLevel) -> None:
        """Put the sites near those that the finer level holds on springs."""
        vectors.restrict(finer.pins, self.pins)
        assembly.spring(
            self.lame,
            self.shape,
            self.pins,
            np.float32(MOST_PINS),
            np.float32(SPRING),
            self.inverse,
            self.weight,
            self.spans,
        )
        self._forget()

    def _forget(self) -> None:
        """The kernels write within the spans only: beyond them there must be 0."""
        for vector in (self.correction, self._other, self._step, self._rest):
            vector.fill(0)

    def _smooth(self, scale: np.float32, momentum: np.float32) -> None:
        elastic.smooth(
            self.correction,
            self.load,
            self.lame,
            self.inverse,
            self.weight,
            self.shape,
            self.spans,
            self._step,
            self._other,
            scale,
            momentum,
        )

    def _leave(self) -> None:
        elastic.residual(
            self.correction,
            self.load,
            self.lame,
            self.inverse,
            self.weight,
            self.shape,
            self.spans,
            self._rest,
        )

    def apply(self, direction: Vector, image: Vector) -> float:
        """Image = A direction; their scalar product."""
        elastic.apply(direction, self.lame, self.inverse, self.shape, self.spans, image, self._rows)
        return float(self._rows.sum())


class CpuElasticModel:
    """`LinearModel` of elastic tissue; other backends take their levels from it.

    Parameters
    ----------
    material : ElasticMaterial
    """

    def __init__(self, material: ElasticMaterial) -> None:
        shape = np.array(material.shape, dtype=np.float32)
        self.bounds = smoother_bounds(material)
        self.levels = [
            CpuElasticLevel(grid, shape, finest=number == 0)
            for number, grid in enumerate(grids(material.m.shape))
        ]
        each = None if isinstance(material.poisson, float) else material.poisson
        assembly.elements(
            material.m,
            np.float32(0 if each is not None else material.poisson),
            each,
            material.strain,
            np.float32(0.25 / float(material.m.max())),
            self.levels[0].lame,
        )
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            assembly.coarsen(fine.lame, coarse.lame)
        # Exactly what the kernels in single precision see.
        self._lame = self.levels[0].lame.astype(np.float64)
        self._shape = shape.astype(np.float64)

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on all levels."""
        self.levels[0].hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.hold_as(fine)

    def residual(self, d: Planes, load: Planes | None) -> Planes:
        """Load - A d in double precision, 0 where held."""
        finest, out = self.levels[0], np.zeros_like(d)
        elastic.residual(
            d,
            np.zeros_like(d) if load is None else load,
            self._lame,
            finest.inverse,
            None,
            self._shape,
            finest.spans,
            out,
        )
        return out

    def pull(self, d: Planes) -> Planes:
        """- A d everywhere, in double precision."""
        return self._pull(d)[0]

    def energy(self, d: Planes) -> float:
        """The elastic energy."""
        return self._pull(d)[1] / 2

    def _pull(self, d: Planes) -> tuple[Planes, float]:
        out, rows = np.zeros_like(d), np.zeros(d.shape[1] - 4)
        elastic.pull(d, self._lame, self._shape, out, rows)
        return out, float(rows.sum())

    def close(self) -> None:
        """Nothing to do: memory goes with the last reference."""
