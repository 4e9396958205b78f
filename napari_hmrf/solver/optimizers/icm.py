"""Algorithm of the paper: iterated conditional modes on every level of the quadtree."""

from __future__ import annotations

from dataclasses import KW_ONLY, asdict, dataclass, replace
from typing import Any

import numpy as np

from napari_hmrf.checks import Count, Positive, Steps, checked
from napari_hmrf.errors import ArgumentError, ConvergenceError
from napari_hmrf.solver.backends.base import Backend, FloatArray, SiteRule
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.optimizers.base import LevelRun, Monitor, Outcome, Report
from napari_hmrf.solver.priors import Prior, SeilerPrior, line_weights
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.quadtree import Level, levels, sampled

#: Number of sweeps between checks of the mean energy and between progress reports.
BLOCK = 10
# Number of sites of a level below which all of its sweeps run in one call.
_SMALL = 10_000
# Largest number of sweeps in one call.
_MOST = 1000
# Damping below which sweeps over blanket cliques cannot raise the energy in closed form, for any
# stiffness: a clique has three sites, so all sites together overshoot at most threefold, and the
# sweeps converge if the damping reduces this factor to less than 2.
_SAFE_DAMPING = 2 / 3
# Relative rise of the energy above its least value on a level that shows a divergence. The energy
# of a divergence rises exponentially; at this rise, the field is still hardly affected.
_RISE = 0.01
# Rise that can be due to rounding, relative to the square of the largest observed displacement.
_ROUNDING = 1e-8


@checked
class ICM:
    """Schedule of the paper: top-down through the quadtree, all sites simultaneously (Alg. 3.7).

    For a volume the tree is an octree; the algorithm is the same.

    Parameters
    ----------
    iterations : int
        Number of sweeps on each level; the maximum number if `energy_change` is given.
    steps : tuple of float or None
        Step sizes of the candidate set Gamma, in pixels. For each step e, each component of a site
        may change by -e, 0 or e. If None, a site moves to the exact minimizer of its local energy,
        in closed form.
    energy_change : float, optional
        Relative change in the mean energy over ten sweeps up to which a level counts as converged.
        By default, all sweeps run.
    """

    iterations: Count = 70
    _: KW_ONLY
    steps: Steps | None = (1.0, 0.1, 0.01, 0.001)
    energy_change: Positive | None = None

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only)."""
        steps = None if self.steps is None else list(self.steps)
        return {"name": "ICM", **asdict(self), "steps": steps}

    @property
    def kernels(self) -> str:
        """Name of the kernels of the sweeps."""
        return "exact sweeps" if self.steps is None else "sweeps"

    def rehearsal(self) -> ICM:
        """Return a schedule with the same kernels and one sweep on each level."""
        return replace(self, iterations=1, energy_change=None)

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: WarmStart | None = None,
    ) -> Outcome:
        """Run the schedule on a backend; from here on, lengths are in pixels.

        Raises
        ------
        ArgumentError
            If there is a warm start, or the prior is not a `SeilerPrior`.
        ConvergenceError
            If the sweeps diverge, because the damping of the prior is too large.
        """
        if start is not None:
            raise ArgumentError(
                "ICM starts from zero on its coarsest level. Leave initial out, or use Multigrid"
            )
        if not isinstance(prior, SeilerPrior):
            name = type(prior).__name__
            raise ArgumentError(f"ICM is for SeilerPrior. Use Multigrid for {name}")
        rule = SiteRule(
            blanket=prior.conditional == "blanket",
            relaxation=prior.relaxation,
            steps=self.steps or (),
            weights=line_weights(problem.spacing),
        )
        finest = _Images(
            backend.upload(_stiffness(problem)), backend.upload(_observation(problem, prior))
        )
        tree = levels(problem.shape)
        progress = _Progress(report, tree, self.iterations)
        energies: list[float] = []
        runs: list[LevelRun] = []
        displacement = backend.zeros(tree[-1])
        coarser: _Images | None = None
        for level in reversed(tree):
            images = finest.projected(backend, level)
            if coarser is not None:
                coarse = displacement
                displacement = backend.prolong(coarse, coarser.stiffness, images.stiffness)
                backend.release(coarse, coarser.stiffness, coarser.observation)
            coarser = images
            tissue = int(sampled(problem.tissue, level).sum())
            displacement, level_energies = self._relax(
                backend, displacement, images, rule, max(1, tissue), progress, level
            )
            if rule.blanket and not rule.steps and rule.relaxation >= _SAFE_DAMPING:
                _refuse_divergence(level_energies, problem, rule.relaxation)
            energies += level_energies
            runs.append(LevelRun(level.number, level.shape, len(level_energies)))
        result = backend.download(displacement)
        return Outcome(result, np.array(energies), tuple(runs))

    def _relax(
        self,
        backend: Backend[Any],
        displacement: Any,
        images: _Images,
        rule: SiteRule,
        tissue_sites: int,
        progress: _Progress,
        level: Level,
    ) -> tuple[Any, list[float]]:
        """Run the sweeps of a level; return the displacement and the mean energy per sweep."""
        stiffness, observation = images.stiffness, images.observation
        before: list[float] = []
        while len(before) < self.iterations and not self._has_converged(before):
            # The sweeps of a small level end too quickly for progress reports.
            block = (
                self.iterations if level.sites < _SMALL and self.energy_change is None else BLOCK
            )
            sweeps = min(block, self.iterations - len(before), _MOST)
            displacement, totals = backend.relax(displacement, stiffness, observation, rule, sweeps)
            before += [float(total) / tissue_sites for total in totals]
            progress.swept(level, len(before), before[-1])
        last = backend.energy(displacement, stiffness, observation, rule) / tissue_sites
        return displacement, [*before[1:], last]

    def _has_converged(self, energies: list[float]) -> bool:
        if self.energy_change is None or len(energies) <= BLOCK:
            return False
        change = abs(energies[-1] - energies[-1 - BLOCK])
        return change <= self.energy_change * abs(energies[-1])


@dataclass(frozen=True, eq=False)
class _Images:
    """Stiffness (m, 1/m) and observation (y, p) on one level."""

    stiffness: Any
    observation: Any

    def projected(self, backend: Backend[Any], level: Level) -> _Images:
        if level.number == 0:
            return self
        return _Images(
            backend.project(self.stiffness, level), backend.project(self.observation, level)
        )


class _Progress:
    """Progress reports of a schedule, with the completed fraction of all site updates."""

    def __init__(self, report: Report, tree: tuple[Level, ...], iterations: int) -> None:
        self._report = report
        self._iterations = iterations
        self._total = sum(level.sites for level in tree)
        self._coarser = {
            level.number: sum(other.sites for other in tree if other.number > level.number)
            for level in tree
        }

    def swept(self, level: Level, sweeps: int, energy: float) -> None:
        done = self._coarser[level.number] + level.sites * sweeps / self._iterations
        size = " x ".join(str(size) for size in level.shape)
        self._report(
            Monitor(
                f"level {level.number} ({size}), sweep {sweeps}, energy {energy:.3g}",
                done / self._total,
            )
        )


def _stiffness(problem: Problem) -> FloatArray:
    """Return (m, 1/m), scaled to a largest m of 1; 0 in void.

    The result has shape (H, W, 2) or (D, H, W, 2).
    """
    m = problem.stiffness / problem.stiffness.max()
    inverse = np.divide(1.0, m, out=np.zeros_like(m), where=problem.tissue)
    return np.stack([m, inverse], axis=-1)


def _observation(problem: Problem, prior: SeilerPrior) -> FloatArray:
    """Return (y, p = K c), with y in pixels; 0 in void.

    The result has shape (H, W, 4) or (D, H, W, 6).
    """
    axes = len(problem.shape)
    observation = np.empty((*problem.shape, 2 * axes), dtype=np.float32)
    np.divide(problem.observed, np.float32(problem.unit), out=observation[..., :axes])
    np.multiply(
        problem.confidence, np.float32(prior.penalty_for(problem)), out=observation[..., axes:]
    )
    observation *= problem.tissue[..., None]
    return observation


def _refuse_divergence(energies: list[float], problem: Problem, damping: float) -> None:
    """Raise an error if the energy rose above its least value on a level.

    Raises
    ------
    ConvergenceError
    """
    farthest = np.abs(problem.observed[problem.known]).max(initial=0.0) / problem.unit
    least = min(energies)
    allowed = (1 + _RISE) * least + _ROUNDING * farthest**2
    if not energies[-1] <= allowed:  # also if the energy is NaN
        raise ConvergenceError(
            f"the sweeps diverge with the damping {damping:g}: their energy rises instead of "
            "falling. With blanket cliques and moves in closed form (`steps=None`), use a damping "
            "below 2/3, such as the default of 0.6."
        )
