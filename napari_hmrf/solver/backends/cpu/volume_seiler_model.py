"""Model of the paper's cliques in a volume on the processor."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import (
    seiler_model,
    vectors,
    volume,
    volume_seiler,
)
from napari_hmrf.solver.backends.cpu.layout import rows
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Spans, Vector, all_sites
from napari_hmrf.solver.backends.cpu.seiler_model import (
    _NO_ROWS,
    CpuSeilerLevel,
    CpuSeilerModel,
    Lines,
)
from napari_hmrf.solver.backends.cpu.volume_cliques import offsets
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.backends.planes import inside
from napari_hmrf.solver.priors.cliques import SeilerMaterial


class CpuVolumeSeilerLevel(CpuSeilerLevel):
    """Level with centred cliques and springs."""

    @property
    def _tissue(self) -> tuple[Vector, Vector, npt.NDArray[np.int64]]:
        """Arrays that describe the tissue for the kernels."""
        return rows(self.stiffness), self._lines, offsets(self.grid)

    def coarsen(self, finer: CpuSeilerLevel) -> None:
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

    def clear(self) -> None:
        """Set the correction and its second array to zero."""
        CpuLevel.clear(self)

    def _begin(self, paces: Vector) -> int:
        load, inverse, correction = map(rows, (self.load, self.inverse, self.correction))
        volume.start(load, inverse, None, correction, paces[0, 0])
        return 1

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


class CpuVolumeSeilerModel(CpuSeilerModel):
    """`LinearModel` of the paper's cliques in a volume."""

    level = CpuVolumeSeilerLevel


def the_model(material: SeilerMaterial) -> CpuSeilerModel:
    """Return the model of a volume; see `seiler_model.the_model`."""
    return seiler_model.the_model(material, CpuVolumeSeilerModel)
