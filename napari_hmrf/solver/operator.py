"""Motion of elastic tissue due to forces, with all observations at rest.

Without loads, and with all observations at zero, the energy of a problem is ``1/2 d . H d``, where
H contains the elastic energy, the precision and the landmarks. Forces f move the tissue by
d = H^-1 f. `Operator` prepares H once, and solves for any number of forces.

The size of a motion is unknown before a solve, but the tolerance of multigrid is absolute. The
first cycle therefore gives the size, from which the tolerance of the other cycles follows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.optimizers.base import Report
from napari_hmrf.solver.optimizers.cycle import smoothing_of
from napari_hmrf.solver.optimizers.multigrid import is_firm
from napari_hmrf.solver.optimizers.refinement import Refinement
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import (
    CancelFlag,
    Progress,
    on_compute_thread,
    open_device,
    settle,
)
from napari_hmrf.solver.volume_memory import check_memory

Floats = npt.NDArray[np.floating]

# Largest number of runs until the tolerance agrees with the size of the displacements.
_RUNS = 8
# Tolerance of the first cycle, in pixels, which any displacement satisfies.
_ANY = 1e300


class Operator:
    """Matrix H of a problem of elastic tissue, prepared for solves with any forces.

    Parameters
    ----------
    problem : Problem
        Tissue, its constraints, precision and landmarks. Loads and observed displacements have no
        effect. Observations that may slip, sliding parts and a drift are not supported.
    prior : ElasticPrior
    backend : str
        As for `solve`.

    Attributes
    ----------
    problem : Problem
        Problem whose matrix is solved: without loads, with all observations at rest and at sites
        with an equation.
    prior : ElasticPrior
        Prior of this problem.
    material : ElasticMaterial
        Properties of the tissue that determine the matrix.
    moves : ndarray of bool, shape (H, W) or (D, H, W)
        Mask of the tissue that is not held.

    Raises
    ------
    ProblemError
        If tissue can move freely, or a volume does not fit into memory.
    """

    def __init__(self, problem: Problem, prior: ElasticPrior, backend: str = "auto") -> None:
        # Empty loads, so that the backend is one that supports forces.
        at_rest = variant_of(problem, observed=np.zeros_like(problem.observed), loads=Loads())
        check_memory(at_rest)
        self._joined = connected(at_rest, prior)
        self.problem = self._joined.without_orphans
        self.prior = prior.resolved(self.problem)
        self.moves = problem.tissue & ~problem.known.all(axis=-1)
        self._backend, self._optimizer = backend, Multigrid()
        self.material = self.prior.material(self.problem)
        self._is_firm = is_firm(self.problem)
        # Lone pixels follow no other tissue, and stay at rest.
        self._lone = ~sites_of_elements(problem.tissue)

    def solve(
        self,
        force: Floats,
        rtol: float = 3e-3,
        atol: float = 0.0,
        *,
        progress: Progress | None = None,
        cancel: CancelFlag | None = None,
    ) -> Floats:
        """Return the displacement due to forces, by conjugate gradients with multigrid.

        The error is at most the larger one of both tolerances. Unlike that of `napari_hmrf.solve`,
        the displacement may have any size: it is not compared with the image.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Force on each site, in the unit of `Loads`; not changed.
        rtol : float
            Largest error, relative to the root mean square length of the displacements of `moves`.
        atol : float
            Largest error, in the unit of `spacing`. If it is known, one cycle less is required.
        progress, cancel
            As for `napari_hmrf.solve`.

        Returns
        -------
        ndarray, shape (H, W, 2) or (D, H, W, 3)
            Displacement, in the unit of `spacing`.

        Raises
        ------
        BackendError, ConvergenceError, Cancelled
            As for `napari_hmrf.solve`.
        """
        load = host.planes(self._joined.carried(force))
        load /= self.prior.force_unit(self.problem)
        host.field(load)[self._lone] = 0
        given = self.problem, self.prior, self._optimizer, self._backend

        def work(progress: Progress | None) -> Floats:
            with open_device(*given, progress) as (choice, report):
                d = self._solved(choice.backend, load, rtol, atol / self.problem.unit, report)
            settle(d, self._joined, choice.backend.renderer)
            return d

        return on_compute_thread(work, progress, cancel)

    def _solved(
        self, device: Backend[Any], load: Planes, rtol: float, atol: float, report: Report
    ) -> Floats:
        """Return the displacement due to a load, in pixels and in the units of the model."""
        d, held = host.prescribed(self.problem)
        model, smoothing = device.elastic_model(self.material), smoothing_of(self.material)
        most = self._optimizer.max_iterations
        refinement = Refinement(most, model, smoothing, report, self._is_firm)
        tolerance = atol or _ANY
        try:
            model.hold(held)
            for _ in range(_RUNS):
                refinement.run(d, load, tolerance)
                if refinement.estimate <= atol:
                    break
                tolerance = max(atol, rtol * typical_size(host.field(d)[self.moves]))
                if refinement.estimate <= tolerance or tolerance == 0:
                    break
        except ConvergenceError:
            model.clear_cache()
            raise
        finally:
            model.close()
        displacement, _ = host.gathered(d, tolerance)
        host.reuse(d, held)
        return displacement


def typical_size(displacements: Floats) -> float:
    """Return the root mean square length of displacements, shape (n, axes).

    The median would be 0 if a force moves only the smaller one of two pieces of tissue.
    """
    if not len(displacements):
        return 0.0
    square = np.einsum("ij,ij->", displacements, displacements, dtype=np.float64)
    return math.sqrt(float(square) / len(displacements))
