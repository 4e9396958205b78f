"""Motion of the tissue of a problem due to forces, with all observations at rest."""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.neighbours import around_sites, in_elements
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import CancelFlag, solve

Floats = npt.NDArray[np.floating]
Float64Array = npt.NDArray[np.float64]

#: Largest error of a sample, relative to the median of its displacements.
_ACCURACY = 0.03
#: Median to which displacements are scaled for the solver, relative to the diagonal of the image.
_SIZE = 0.01
#: Limit of the largest displacement, in the same unit; the solver refuses 2.
_LARGEST = 0.3
#: Factor on forces that move nothing within the tolerance, for the next trial.
_LARGER = 1e3
#: Ratio of two factors that are close enough to end the trials.
_CLOSE = 2.0
#: Number of trial solves until the size of the displacements is known.
_TRIALS = 8


class Units(NamedTuple):
    """Units in which the solver computes the displacement due to small or large forces.

    Attributes
    ----------
    factor : float
        Factor on the forces.
    tolerance : float
        Tolerance of the scaled displacement, in pixels.
    """

    factor: float
    tolerance: float


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
        at_rest: dict[str, Any] = {"observed": np.zeros_like(problem.observed), "loads": None}
        if problem.landmarks is not None:
            at_rest["landmarks"] = problem.landmarks.at_rest
        self._problem = variant_of(problem, **at_rest)
        # Single pixels belong to no element, and are held by their own precision only.
        single = problem.tissue & ~around_sites(in_elements(problem.tissue), np.logical_or)
        self._single = np.nonzero(single)
        self._moves = problem.tissue & ~problem.known.all(axis=-1)

    def units_for(self, force: Floats) -> Units:
        """Return the units in which the displacements due to such forces are accurate.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)
        """
        return self._try(force)[0]

    def moved_by(self, force: Floats) -> Float64Array:
        """Return the displacement due to forces of unknown size, as `to`, with fewer solves.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Forces in the unit of `Loads`.
        """
        units, moved = self._try(force)
        return self.to(force, units) if moved is None else moved

    def _try(self, force: Floats) -> tuple[Units, Float64Array | None]:
        """Return the units for forces, and the displacement if the last trial was accurate."""
        diagonal = math.hypot(*self._problem.shape)
        # Begin with forces that cannot move the softest tissue far, even all in one direction.
        soft = self._problem.stiffness[self._moves & np.isfinite(self._problem.stiffness)]
        least = self._prior.force_unit(self._problem) * self._problem.unit
        least *= float(soft.min() / soft.max()) if soft.size else 1.0
        total = float(np.abs(force).sum()) * self._problem.unit
        begin = _SIZE * diagonal * least / total if total > 0 else 1.0
        units = Units(begin, _ACCURACY * _SIZE * diagonal)
        for _ in range(_TRIALS):
            moved = self.to(force, units)
            sizes = np.sqrt((moved[self._moves] ** 2).sum(axis=-1)) / self._problem.unit
            if not sizes.any():
                units = units._replace(factor=_LARGER * units.factor)
                continue
            size = float(np.median(sizes)) or float(sizes.mean())
            before = units.factor
            factor = diagonal * min(_SIZE / size, _LARGEST / float(sizes.max()))
            units = Units(factor, _ACCURACY * size * factor)
            if 1 / _CLOSE < factor / before < _CLOSE:
                return units, moved
        return units, None

    def to(self, force: Floats, units: Units) -> Float64Array:
        """Return the displacement due to forces.

        Parameters
        ----------
        force : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Forces in the unit of `Loads`.
        units : Units

        Returns
        -------
        ndarray, shape (H, W, 2) or (D, H, W, 3)
            Displacement in the unit of `spacing`.
        """
        pulled = np.multiply(force, units.factor, dtype=np.float32, casting="same_kind")
        pulled[self._single] = 0
        loads = Loads(force=pulled, spacing=self._problem.spacing)
        solution = solve(
            variant_of(self._problem, loads=loads),
            self._prior,
            optimizer=Multigrid(tolerance=units.tolerance),
            backend=self._backend,
            cancel=self._cancel,
        )
        moved = solution.displacement / np.float64(units.factor)
        if self._problem.precision is not None:
            tensors = self._problem.precision[self._single]
            own = np.einsum("sij,sj->si", np.linalg.pinv(tensors), force[self._single])
            moved[self._single] = own
        return moved
