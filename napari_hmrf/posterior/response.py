"""Motion of the tissue of a problem due to forces, with all observations at rest."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.posterior.forced import ForcedMultigrid, typical_size
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.neighbours import sites_of_elements
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.priors.elements import lame_ratio
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import CancelFlag, solve

Floats = npt.NDArray[np.floating]

#: Tolerance for forces of a known size, relative to the root mean square length of their
#: displacements.
_TOLERANCE = 0.03
#: Largest error of a response to forces of unknown size, in the same unit. It is smaller, because
#: the error estimate of the second run is less cautious than that of a run from rest.
_ACCURACY = 0.003
#: Largest ratio lambda / mu of compressible tissue: a Poisson's ratio of 0.46.
_MOST_RATIO = 12.0
#: Error of a response of which only the size is required, in the same unit.
_ROUGH = 0.5


class Response:
    """Motion of the tissue of a problem due to forces, with all observations at rest.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    backend : str
    cancel : threading.Event or similar, optional
    """

    def __init__(
        self,
        problem: Problem,
        prior: ElasticPrior,
        backend: str = "auto",
        cancel: CancelFlag | None = None,
    ) -> None:
        self._prior, self._backend = prior, backend
        self._cancel = cancel or threading.Event()
        # Loads, although the optimizer has the force, so that the backend supports forces.
        at_rest: dict[str, Any] = {"observed": np.zeros_like(problem.observed), "loads": Loads()}
        if problem.landmarks is not None:
            at_rest["landmarks"] = problem.landmarks.at_rest
        self._problem = variant_of(problem, **at_rest)
        self._connected = connected(self._problem, prior)
        # Lone pixels follow no other tissue, and stay at rest.
        self._lone = ~sites_of_elements(problem.tissue)
        self._moves = problem.tissue & ~problem.known.all(axis=-1)

    @property
    def is_incompressible(self) -> bool:
        """True if some tissue is so nearly incompressible that cycles find slow motions late."""
        material = self._prior.material(self._problem)
        return lame_ratio(material.largest_poisson, material.strain) > _MOST_RATIO

    def tolerance_for(self, force: Floats) -> float:
        """Return the tolerance at which the responses to forces of about this size are accurate.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)

        Returns
        -------
        float
            Largest error, in the unit of `spacing`; 1 if the force moves nothing.
        """
        size = typical_size(self._solved(force, accuracy=_ROUGH)[self._moves])
        return _TOLERANCE * size or 1.0

    def to(self, force: Floats, tolerance: float | None = None) -> Floats:
        """Return the displacement due to forces.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Forces in the unit of `Loads`; they may have any size.
        tolerance : float, optional
            Largest error, in the unit of `spacing`; by default 0.3 % of the root mean square length
            of the displacements, whose size takes one more cycle to find.

        Returns
        -------
        ndarray, shape (H, W, 2) or (D, H, W, 3)
            Displacement in the unit of `spacing`.
        """
        if tolerance is None:
            return self._solved(force, accuracy=_ACCURACY)
        return self._solved(force, tolerance / self._problem.unit)

    def _solved(
        self, force: Floats, tolerance: float = 1.0, accuracy: float | None = None
    ) -> Floats:
        pulled = host.planes(self._connected.carried(force))
        pulled /= self._prior.force_unit(self._problem)
        host.field(pulled)[self._lone] = 0
        solution = solve(
            self._problem,
            self._prior,
            optimizer=ForcedMultigrid(tolerance, force=pulled, accuracy=accuracy),
            backend=self._backend,
            cancel=self._cancel,
        )
        return solution.displacement
