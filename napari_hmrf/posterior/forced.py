"""Multigrid for tissue with a force on each site, for responses and samples.

The size of the motion due to a force is unknown before a solve, but the tolerance of multigrid is
absolute. With a relative accuracy, the first cycle therefore gives the size, from which the
tolerance of the other cycles follows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.optimizers.base import Convergence, LevelRun, Outcome, Report
from napari_hmrf.solver.optimizers.cycle import smoothing_of
from napari_hmrf.solver.optimizers.loading import work_of
from napari_hmrf.solver.optimizers.multigrid import is_firm
from napari_hmrf.solver.optimizers.refinement import Refinement
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem

#: Largest number of runs until the tolerance agrees with the size of the displacements.
_RUNS = 8
#: Tolerance of the first cycle, in pixels, which any displacement satisfies.
_ANY = 1e300
_TINY = 1e-300


@dataclass(frozen=True)
class ForcedMultigrid(Multigrid):
    """Multigrid for exactly held sites and a force on each site.

    It solves `ElasticPrior` without slipping observations. Displacements may have any size: they
    are not compared with the image.

    Parameters
    ----------
    tolerance, max_iterations
        As for `Multigrid`; `tolerance` is ignored if `accuracy` is given.
    force : ndarray, planes
        Force on each component, in the unit of the model; not changed.
    accuracy : float, optional
        Largest accepted error, relative to the root mean square length of the displacements of free
        tissue.
    """

    force: Planes = field(kw_only=True, repr=False, compare=False)
    accuracy: float | None = field(default=None, kw_only=True)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name, without the force."""
        return Multigrid(self.tolerance, max_iterations=self.max_iterations).parameters

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: WarmStart | None = None,
    ) -> Outcome:
        """Solve for the equilibrium of the tissue with the force."""
        d, held = host.prescribed(problem)
        assert isinstance(prior, ElasticPrior)
        material = prior.material(problem)
        model = backend.elastic_model(material)
        smoothing, firm = smoothing_of(material), is_firm(problem)
        refinement = Refinement(self.max_iterations, model, smoothing, report, firm)
        try:
            model.hold(held)
            tolerance = self._refine(refinement, problem, d)
            work = work_of(self.force, d)
            # At rest, half of the work of the forces is stored.
            stored = model.work(d)[0] if problem.observed.any() else work / 2
        except ConvergenceError:
            model.clear_cache()
            raise
        finally:
            model.close()
        displacement, rounding = host.gathered(d, tolerance)
        host.reuse(d, held)
        count = max(1, int(np.count_nonzero(problem.tissue)))
        return Outcome(
            displacement=displacement,
            energy=np.array([(stored - work) / count]),
            levels=(LevelRun(0, problem.shape, 0),),
            convergence=Convergence(
                max(refinement.estimate, rounding),
                refinement.residual / max(math.sqrt(work_of(self.force, self.force)), _TINY),
                "factors" if refinement.by_factors else "cycles",
            ),
        )

    def _refine(self, refinement: Refinement, problem: Problem, d: Planes) -> float:
        """Reduce the error to the tolerance, which is returned, in pixels."""
        if self.accuracy is None:
            refinement.run(d, self.force, self.tolerance)
            return self.tolerance
        free = problem.tissue & ~problem.known.all(axis=-1)
        tolerance = _ANY
        for _ in range(_RUNS):
            refinement.run(d, self.force, tolerance)
            tolerance = self.accuracy * typical_size(host.field(d)[free])
            if refinement.estimate <= tolerance or tolerance == 0:
                break
        return tolerance


def typical_size(displacements: npt.NDArray[np.floating]) -> float:
    """Return the root mean square length of displacements, shape (n, axes).

    The median would be 0 if a force moves only the smaller one of two pieces of tissue.
    """
    if not len(displacements):
        return 0.0
    square = np.einsum("ij,ij->", displacements, displacements, dtype=np.float64)
    return math.sqrt(float(square) / len(displacements))
