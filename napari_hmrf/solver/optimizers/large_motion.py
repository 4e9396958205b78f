"""Large motion: where Newton's method begins, and what its field met of what was observed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.found import Beginning
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.optimizers.base import Convergence, LevelRun, Outcome, Reach, Report
from napari_hmrf.solver.optimizers.cycle import smoothing_of
from napari_hmrf.solver.optimizers.newton import Newton, norm
from napari_hmrf.solver.priors import NeoHookeanPrior
from napari_hmrf.solver.problem import Problem

_TINY = 1e-300
# What a beginning keeps of each corner's Jacobian on the way from one field to another.
_KEPT = 0.25
# What is this near, as a part of the tolerance, was met.
_MET = 1.0


def converge(
    tolerance: float,
    problem: Problem,
    prior: NeoHookeanPrior,
    backend: Backend[Any],
    report: Report,
    start: Beginning | None,
) -> Outcome:
    """Solve; lengths are in pixels from here on.

    Raises
    ------
    ConvergenceError
    """
    material = prior.material(problem)
    model = backend.finite_model(material)
    observed, held = host.prescribed(problem)
    d = _beginning(model, start, observed, held)
    newton = Newton(model, smoothing_of(material), report, tolerance)
    newton.run(d, observed, held)
    displacement, rounding = host.gathered(d, tolerance)
    _, least = model.energy(host.planes(displacement))
    if least <= 0:
        displacement = host.field(d).copy()
        _, least = model.energy(d)
    missing = np.where(held, observed - d, 0.0)
    reach = _reach(host.field(missing), host.field(observed), problem, tolerance, least)
    forces = norm(model.forces(d))
    host.reuse(observed, held)
    return Outcome(
        displacement=displacement,
        energy=np.array(newton.energies) / max(1, np.count_nonzero(problem.tissue)),
        levels=(LevelRun(0, problem.shape, len(newton.energies)),),
        convergence=Convergence(
            max(newton.estimate, rounding),
            newton.residual / max(forces, _TINY),
            "factors" if newton.by_factors else "cycles",
        ),
        reach=reach,
    )


def _beginning(
    model: FiniteModel, start: Beginning | None, observed: Planes, held: HeldPlanes
) -> Planes:
    """A field that is not folded: as near to what was found before as may be, or nothing."""
    nothing: Planes = np.zeros(observed.shape)
    if start is None:
        return nothing
    last, combined = host.planes(start.displacements[0] / start.unit), host.combined(start)
    if not model.energy(last)[1] > 0:
        last = nothing
    # How a drag went on before it will go on: but for where that would fold.
    way = combined - last
    if len(start.displacements) == 1:
        # Before the first frame tissue was at rest.
        there = last[held]
        square = float((there**2).sum())
        share = float((there * observed[held]).sum()) / square if square > 0 else 1.0
        way = (share - 1) * last
    length, _ = model.length(last, way, _KEPT, 0.0)
    return np.asarray(last + min(1.0, length) * way)


def _reach(
    missing: npt.NDArray[np.float64],
    observed: npt.NDArray[np.float64],
    problem: Problem,
    tolerance: float,
    least: float,
) -> Reach:
    """How far what was observed was met, and where not."""
    far = np.linalg.norm(missing, axis=-1)
    sites = far > _MET * tolerance
    if not sites.any():
        return Reach(least)
    where = tuple(int(index) for index in np.unravel_index(int(np.argmax(far)), far.shape))
    most = float(far[where])
    whole = max(float(np.linalg.norm(observed[where])), most)
    return Reach(least, 1.0 - most / whole, most * problem.unit, where, int(sites.sum()))
