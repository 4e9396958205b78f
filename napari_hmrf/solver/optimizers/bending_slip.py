"""Blanket reading with observations that may slip: systems that cycles hardly reduce.

Tissue can bend almost without energy, so a small error of a force moves it far. Each Newton step is
solved by a factorization of the model with the springs of the observations on its diagonal, and
consistent states are confirmed to within rounding errors.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.bending_modes import free_bends
from napari_hmrf.solver.optimizers.base import factorizing
from napari_hmrf.solver.optimizers.external_forces import SoftObservations
from napari_hmrf.solver.optimizers.null_space import find_free_motions, refuse_free, resolves
from napari_hmrf.solver.optimizers.refinement import BARELY_HELD, Directions, check_factors_fit
from napari_hmrf.solver.optimizers.slip import Slip

Float64Array = npt.NDArray[np.float64]

# Accuracy of consistent states, relative to the largest displacement, or to 1 pixel if larger.
_EXACT = 1e-11
# Stiffness of springs on all components, as a fraction of the diagonal. The weakest springs with
# which the factorization succeeds are used; they affect the corrections of a step, not the step.
_PROXIMAL = (0.0, *(10.0**power for power in range(-16, -10)))
# Largest number of corrections of a step, and largest last one, in widths of the kink.
_CORRECTIONS, _LAST_CORRECTION = 30, 0.1


class BendingSlip(Slip):
    """Minimum of the energy of the blanket reading with observations that may slip."""

    def run(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place."""
        self._low = np.zeros_like(d)
        self._is_exact = self._is_singular = self._is_thorough = False
        self._last: tuple[HeldPlanes, list[Float64Array]] | None = None
        super().run(d, tolerance)

    def _free(self, held: HeldPlanes) -> list[Float64Array]:
        """Return the free motions of each piece, or all free motions for the narrowest kink."""
        if self._is_thorough:
            return self._all_free(held)
        return [ways for *_, ways in free_bends(self._problem, host.field(held))]

    def _exchange(self, d: Planes, tolerance: float) -> bool:
        """Exchange states at the tolerance, then to within rounding errors."""
        exact = _EXACT * max(1.0, float(np.abs(d).max()))
        self._is_exact = super()._exchange(d, tolerance) and super()._exchange(d, exact)
        return self._is_exact

    def _soften(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place, if the system can be factorized."""
        check_factors_fit(self._model)
        super()._soften(d, tolerance)

    def _accept(self, d: Planes, soft: SoftObservations, error: float, tolerance: float) -> None:
        """Exchange states once more; accept the result for the narrowest kink if this fails."""
        rounded, self._is_thorough = d.copy(), True
        if not (self._is_singular and self._exchange(d, tolerance)):
            np.copyto(d, rounded)
            super()._accept(d, soft, error, tolerance)

    def _solve(self, d: Planes, tolerance: float, pins: HeldPlanes) -> Float64Array:
        """Solve for the current states, in place, and remember whether the system is singular."""
        try:
            return super()._solve(d, tolerance, pins)
        except ConvergenceError:
            self._is_singular = True
            raise

    def _all_free(self, held: HeldPlanes) -> list[Float64Array]:
        """Return all free motions of tissue, which takes many solves."""
        if self._last is None or not np.array_equal(held, self._last[0]):
            free = find_free_motions(self._model, held, self.refinement, self._report)
            self._last = held, free
        return self._last[1]

    def _free_in_result(self, holds: npt.NDArray[np.bool_]) -> list[Float64Array]:
        """Return all free motions of the result, also those that rounding hides."""
        is_clear = self._is_exact and np.array_equal(holds, self._sides == 0)
        if is_clear and not self._is_singular and resolves(self._model):
            return []
        quality = self.refinement.estimate, self.refinement.residual
        free = self._all_free(self._held(holds))
        if free:
            every = self._held(np.ones_like(holds))
            refuse_free(self._model, every, self.refinement, self._report)
        self.refinement.estimate, self.refinement.residual = quality
        return free

    def _newton_step(self, d: Planes, soft: SoftObservations, width: float) -> Planes:
        """Return the Newton step from `d` for a rounded kink, by factorization."""
        model, springs, low = self._model, soft.springs(d), np.zeros_like(d)
        model.hold(self._fixed)
        moves = model.moves
        load = model.pull(d, self._low) - soft.forces(d)
        load[~moves] = 0

        def image(way: Planes) -> Planes:
            forces: Planes = springs * way - model.pull(way, low)
            forces[~moves] = 0
            return forces

        report_part = factorizing(self._report)
        for proximal in _PROXIMAL:
            more = springs + proximal * model.steepness
            try:
                factors = Factors(model.material, moves, report_part, more)
            except Singular:
                continue
            step, rest, directions = np.zeros_like(d), load, Directions(image)
            for _ in range(_CORRECTIONS):
                with np.errstate(over="ignore", invalid="ignore"):
                    correction = directions.next(factors.solve(rest), rest)
                    step += correction
                    rest = load - image(step)
                if np.abs(correction).max() <= _LAST_CORRECTION * width:
                    return step
                if not np.isfinite(rest).all():
                    break
        raise ConvergenceError(BARELY_HELD)
