"""Converged field: a Krylov iteration, preconditioned by a V-cycle over the hierarchy.

The work per pixel does not depend on the size of the image, because each level removes the error at
the wavelengths that it resolves.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, asdict
from typing import Any

import numpy as np

from napari_hmrf.checks import Count, Positive, checked
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.real_arrays import FloatArray
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.earlier_results import (
    Quality,
    StartQuality,
    WarmStart,
    remember,
    start_quality_of,
)
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.bending_modes import check_bending
from napari_hmrf.solver.optimizers import centred, large_motion
from napari_hmrf.solver.optimizers.base import Convergence, LevelRun, Outcome, Report
from napari_hmrf.solver.optimizers.bending_slip import BendingSlip
from napari_hmrf.solver.optimizers.cycle import BENDING, smoothing_of
from napari_hmrf.solver.optimizers.loading import (
    LoadForces,
    check_balanced,
    check_reach,
    load_forces,
    with_data,
)
from napari_hmrf.solver.optimizers.refinement import Refinement
from napari_hmrf.solver.optimizers.slip import Slip
from napari_hmrf.solver.optimizers.work import LINEAR_SOLVE, SLIDING_SOLVE, USUAL_BUDGET, Work
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import holding_strength

_TINY = 1e-300
# Fraction of the tolerance up to which a distance is negligible.
_NEGLIGIBLE = 0.01
# Smallest value of `holding_strength` at which cycles reduce rotations of tissue well. On coarse
# levels, constraints extend over wider regions, so weak constraints are represented poorly.
_MILD_GRIP = 0.05


@checked
class Multigrid:
    """Schedule of a Krylov iteration with a V-cycle, Chebyshev-Jacobi smoothing, and refinement.

    The iteration runs in single precision. The residual that decides when the solve ends is
    computed in double precision. Priors with an energy, `ElasticPrior` and `SeilerPrior` in its
    blanket reading, are solved by conjugate gradients. The centred reading is not symmetric and is
    solved by stabilized biconjugate gradients (`napari_hmrf.solver.optimizers.centred`). For
    `NeoHookeanPrior`, conjugate gradients solve the steps of Newton's method
    (`napari_hmrf.solver.optimizers.newton`).

    Parameters
    ----------
    tolerance : float
        Largest accepted error, in pixels. The error is the largest distance of any site from its
        position in the converged field. After each cycle, the error is estimated as ``s r / e``,
        where s is the largest correction of the cycle, r the ratio of the residual after the cycle
        to the residual before it, and e the smallest eigenvalue of the preconditioned system found
        so far. For tissue with high contrast, thin parts or weak constraints, the estimate is first
        tested on a field with a known solution. If the test fails, the system is factorized. In the
        centred reading, the estimate is a proven bound from a maximum principle. Large motion of
        crushed tissue may exceed the tolerance, as reported in `Solution.reach`. Any other solve
        that does not reach the tolerance raises a `ConvergenceError`.
    max_iterations : int
        Number of cycles after which the solve fails with an error. If observations may slip, the
        number applies to each set of slipping observations. In a volume that requires double
        precision, eight times as many cycles may run. Does not apply to large motion.
    budget : float or None
        Largest work of a large-motion solve, in solves of the same problem with linear elasticity;
        None for no limit: tissue is then pulled for up to 2.5 times the work of the default, and
        tissue that is at its target by then settles to the tolerance. A small image may take more,
        up to half a second. If the budget is used up, the result is the best field without folds so
        far, and `Solution.reach` contains how far it is from the observations and from equilibrium.
        A warm start from this result continues the solve. Any other warm start from which
        observations are out of reach is given up within half of the budget; the solve then begins
        again from rest, with the whole budget.
    """

    tolerance: Positive = 1e-3
    _: KW_ONLY
    max_iterations: Count = 300
    budget: Positive | None = USUAL_BUDGET

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only), without the default budget."""
        values = {"name": "Multigrid", **asdict(self)}
        if self.budget == Multigrid.budget:
            del values["budget"]  # it has no effect on most models
        return values

    @property
    def kernels(self) -> str:
        """Name of the kernels of the iteration."""
        return "cycles"

    def rehearsal(self) -> Multigrid:
        """Return an iteration with the same kernels that converges on the trial problem."""
        return Multigrid()

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: WarmStart | None = None,
    ) -> Outcome:
        """Solve the problem; from here on, lengths are in pixels."""
        if isinstance(prior, SeilerPrior) and prior.conditional == "centred":
            return centred.converge(
                self.tolerance, self.max_iterations, problem, prior, backend, report, start
            )
        if isinstance(prior, NeoHookeanPrior):
            cost = LINEAR_SOLVE if problem.coupling is None else SLIDING_SOLVE
            work = Work(self.budget, problem.shape, cost)
            return large_motion.converge(
                self.tolerance, problem, prior, backend, report, start, work
            )
        limit = prior.limit(problem)
        pulls, stored = load_forces(problem, prior)
        if isinstance(prior, ElasticPrior):
            material = prior.material(problem)
            pulls, stored = with_data(material.data, problem, pulls, stored)
            model, smoothing = backend.elastic_model(material), smoothing_of(material)
        else:
            assert isinstance(prior, SeilerPrior)
            check_bending(problem)
            model, smoothing = backend.seiler_model(prior.material(problem)), BENDING
        holds = limit is None and isinstance(prior, ElasticPrior)
        firm = not (problem.is_volume or holds) or is_firm(problem)
        met = None if start is None else start_quality_of(start)

        def refined(of: LinearModel) -> Refinement:
            return Refinement(self.max_iterations, of, smoothing, report, firm, met)

        refinement = refined(model)
        try:
            if limit is None:
                loads = LoadForces(pulls, stored)
                found = self._solve_on_device(problem, model, loads, start, refinement)
                if found is not None:
                    return found
                refinement = refined(model)
            d, observed = host.prescribed(problem, start if limit is None else None)
            if limit is None:
                model.hold(observed)
                if start is not None:
                    _reset_idle(problem, model, observed, d)
                if model.bodies is not None:
                    model.bodies.make_rigid(d)
                refinement.run(d, pulls, self.tolerance, self._quality(start, model))
                compute_thread.check_cancelled()
                energy, forces = model.work(d)
                refinement.set_energy(energy + stored - host.work_of(pulls, d))
            else:
                y, d = d, d.copy()
                moves = model.steepness > 0
                if start is not None:
                    np.copyto(d, host.combined(start), where=moves)
                observed_moves, limits = observed & moves, host.planes(limit)
                check_balanced(problem, observed_moves, limits, pulls)
                kind = Slip if isinstance(prior, ElasticPrior) else BendingSlip
                slip = kind(
                    problem,
                    backend,
                    model,
                    observed_moves,
                    y,
                    limits,
                    pulls,
                    stored,
                    refined,
                    report,
                )
                slip.run(d, self.tolerance)
                refinement = slip.refinement
                _, forces = model.work(d)
        except ConvergenceError:
            model.clear_cache()
            if pulls is not None:
                check_reach(d, problem)
            raise
        finally:
            model.close()
        if pulls is not None:
            check_reach(d, problem)
        compute_thread.check_cancelled()
        displacement, rounding = host.gathered(d, self.tolerance)
        if problem.is_volume:
            rounding *= 3  # the coefficients of the model are rounded, too
        host.reuse(d, observed)
        if limit is None:
            _remember_for_warm_starts(displacement, model, refinement)
        return _outcome(problem, displacement, rounding, refinement, forces)

    def _solve_on_device(
        self,
        problem: Problem,
        model: LinearModel,
        loads: LoadForces,
        start: WarmStart | None,
        refinement: Refinement,
    ) -> Outcome | None:
        """Solve a problem whose observations never slip on the device; None if the host must."""
        d = model.on_device(problem, loads.pulls, start)
        if d is None:
            return None
        try:
            review = refinement.run_on_device(d, self.tolerance, self._quality(start, model))
        except ConvergenceError:
            return None  # in double precision, the host may succeed
        if review is None:
            return None
        rounding = host.rounding_error(review.farthest, len(problem.shape))
        if rounding > self.tolerance:
            return None
        if loads.pulls is not None:
            check_reach(host.planes(d.values), problem)
        refinement.set_energy(review.energy + loads.energy - review.work)
        d.keep()
        _remember_for_warm_starts(d.values, model, refinement)
        return _outcome(problem, d.values, rounding, refinement, review.forces)

    def _quality(self, start: WarmStart | None, model: LinearModel) -> Quality | None:
        """Return the quality of the start, or None if it is unknown or observations are not met."""
        if start is None or start.missing > _NEGLIGIBLE * self.tolerance:
            return None
        return model.earlier.quality(start)


def _remember_for_warm_starts(
    displacement: FloatArray, model: LinearModel, refinement: Refinement
) -> None:
    model.earlier.add(displacement, Quality(refinement.error, refinement.residual))
    remember(displacement, StartQuality(refinement.least, refinement.estimate))


def _outcome(
    problem: Problem,
    displacement: FloatArray,
    rounding: float,
    refinement: Refinement,
    forces: float,
) -> Outcome:
    """Return the outcome of a solve; `forces` is the norm of the forces of the tissue."""
    # Tissue without an equation has one energy, after no iteration.
    energies = np.array(refinement.energies if refinement.cycles else refinement.energies[-1:])
    energies /= max(1, np.count_nonzero(problem.tissue))
    return Outcome(
        displacement=displacement,
        energy=energies,
        levels=(LevelRun(0, problem.shape, len(energies) if refinement.cycles else 0),),
        convergence=Convergence(
            max(refinement.estimate, rounding),
            refinement.residual / max(forces, _TINY),
            "factors" if refinement.by_factors else "cycles",
        ),
    )


def is_firm(problem: Problem) -> bool:
    """Return whether cycles reduce rotations of the held tissue well."""
    return holding_strength(problem) >= _MILD_GRIP


def _reset_idle(problem: Problem, model: LinearModel, observed: HeldPlanes, d: Planes) -> None:
    """Set unobserved tissue without any force to zero, in place, as after a cold start.

    Cycles do not move this tissue, so it would keep the displacement of the warm start.
    """
    earlier = model.earlier
    if earlier.idle is None:
        idle = ~(model.moves | observed)
        for plane in idle:
            host.inside(plane[None])[0] &= problem.tissue
        earlier.idle = np.flatnonzero(idle)
    d.reshape(-1)[earlier.idle] = 0
