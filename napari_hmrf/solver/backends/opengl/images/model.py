"""Linear model of an image, with its levels on the device and double precision on the host."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.backends.earlier_results import EarlierResults, WarmStart
from napari_hmrf.solver.backends.linear import (
    Balance,
    HeldPlanes,
    LinearModel,
    OnDevice,
    Planes,
    Review,
    Steps,
)
from napari_hmrf.solver.backends.opengl.context.pace import Pace
from napari_hmrf.solver.backends.opengl.images.displacement import (
    MOST_SOLUTIONS,
    GLDisplacement,
    SolvedVectors,
)
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.relaxing import RelaxingLevel
from napari_hmrf.solver.backends.opengl.programs.source import Stage
from napari_hmrf.solver.backends.planes import held_planes
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.backends.rigid.deflation import Deflation
from napari_hmrf.solver.problem import Problem

# Largest number of sites of a kept model, which takes about 130 bytes per site.
_MOST_KEPT = 4_000_000


class GLModel:
    """Model with levels on the device; `LinearModel` documents the methods.

    The device keeps the model after a solve, with its observations and the latest solutions. The
    next solve of the same tissue therefore copies only changed observations to the device.

    Parameters
    ----------
    passes : Passes
        Runner of the model's kernels; `free` frees its textures.
    host : LinearModel
        Model of the same tissue on the host.
    levels : sequence of RelaxingLevel
        Levels on the device, finest first.
    """

    def __init__(self, passes: Passes, host: LinearModel, levels: Sequence[RelaxingLevel]) -> None:
        self._passes, self._host, self.levels = passes, host, levels
        self._material, self.bounds = host.material, host.bounds
        # Identifies the prescribed components that the levels have; None if they have none.
        self._held_since: EarlierResults | None = None
        self._known: npt.NDArray[np.bool_] | None = None
        self._vectors: SolvedVectors | None = None

    def serves(self, host: LinearModel, stage: Stage) -> bool:
        """Return whether the levels are those of a model on the host, for a shader stage."""
        is_same = host is self._host and host.material is self._material
        return is_same and stage == self._passes.stage

    def resume(self, pace: Pace) -> None:
        """Use the model for another solve, with its scheduler of batches."""
        self._passes.pace = pace

    def free(self) -> None:
        """Free all textures of the model."""
        self._passes.close()

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components on all levels."""
        self._host.hold(held)
        if self._held_since is self._host.earlier:
            return
        # Set only at the end, because of cancellation.
        self._held_since = self._known = None
        for level in self.levels:
            level.hold()
        self._held_since = self._host.earlier

    @property
    def material(self) -> Any:
        """Material of the model."""
        return self._host.material

    @property
    def mild(self) -> bool:
        """True if a V-cycle is known to reduce every error component in this material."""
        return self._host.mild

    @property
    def slow(self) -> bool:
        """True if a direct factorization is faster than V-cycles on this device."""
        return False

    @property
    def double_level(self) -> Any:
        """Always None, because only models of volumes iterate in double precision."""
        return None

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the finest level."""
        return self._host.moves

    @property
    def shape(self) -> tuple[int, ...]:
        """Finest grid, (H, W)."""
        return self._host.shape

    @property
    def bodies(self) -> Bodies | None:
        """Rigid bodies for the current prescribed components, or None if no tissue is rigid."""
        return self._host.bodies

    @property
    def iterates(self) -> bool:
        """True unless there are rigid bodies, which V-cycles on the device do not support."""
        return self.bodies is None

    @property
    def earlier(self) -> EarlierResults:
        """Results of earlier solves with the same prescribed components."""
        return self._host.earlier

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return None, because rigid bodies are supported on the host only."""
        return None

    def on_device(
        self, problem: Problem, load: Planes | None, start: WarmStart | None
    ) -> OnDevice | None:
        """Begin a solve on the device; return None if the tissue or the start needs the host."""
        too_many = start is not None and len(start.displacements) > MOST_SOLUTIONS
        if problem.has_rigid or too_many:
            return None
        self._prescribe(problem.known)
        if self._vectors is None:
            self._vectors = SolvedVectors(self.levels[0])
        self._vectors.observe(problem)
        return GLDisplacement(self._vectors, self._host, load, start)

    def _prescribe(self, known: npt.NDArray[np.bool_]) -> None:
        """Set the prescribed components from a mask, shape (H, W, 2)."""
        is_held = self._known is not None and self._held_since is self._host.earlier
        if is_held and are_equal(known, self._known):
            return
        self.hold(held_planes(known))
        self._known = known

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Return the residual ``load - A d``."""
        return self._host.balance(d, load, unit)

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return the force ``-A d`` on every component, in double precision."""
        return self._host.pull(d, low)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the norm of its forces ``A d``."""
        return self._host.work(d)

    def review(self, values: npt.NDArray[np.float32], load: Planes | None) -> Review:
        """Return what decides whether a displacement, shape (H, W, 2), is a solution."""
        return self._host.review(values, load)

    @property
    def steepness(self) -> Planes:
        """Diagonal of A on the finest level, including prescribed components."""
        return self._host.steepness

    def clear(self) -> None:
        """Ignore the call, because only rigid tissue and double precision require this method."""

    def clear_cache(self) -> None:
        """Remove the model from the device, because vectors may contain non-finite values."""
        self._passes.device.forget_model()

    def close(self) -> None:
        """Keep the model for the next solve, unless it takes too much memory."""
        if math.prod(self.shape) > _MOST_KEPT:
            self.clear_cache()
