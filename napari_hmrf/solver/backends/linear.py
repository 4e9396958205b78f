"""Protocol of a linear model, A d = load, on a hierarchy of levels.

A *vector* is a displacement or a force on the sites of one level, stored on the device. A *scalar*
is a number on the device, which kernels use without the host. Only `LinearLevel.read` makes the
host wait for the device. A component that is constrained or has no neighbours is *fixed*: its
correction is zero.

On the host, fields are *planes*: float64 arrays (2, H + 4, W + 4), with the component as the first
axis and a border of zeros, two sites wide. D is the diagonal of A.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.earlier_results import EarlierResults, WarmStart
from napari_hmrf.solver.backends.planes import HeldPlanes as HeldPlanes
from napari_hmrf.solver.backends.planes import Planes as Planes
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.backends.rigid.deflation import Deflation

if TYPE_CHECKING:
    from napari_hmrf.solver.problem import Problem

#: (scale, momentum) of each Chebyshev step of a smoother.
Steps = tuple[tuple[float, float], ...]


class Balance(NamedTuple):
    """Residual load - A d, computed in double precision; 0 at constrained components.

    Attributes
    ----------
    rest : ndarray of float32, or vector
        Residual divided by `unit`, as planes or in the layout of the finest level's vectors; see
        `LinearLevel.vector`. An array is valid until the next call and may be modified.
    unit : float
        Scale of `rest`, in the model's units.
    most, norm : float
        Largest absolute value and Euclidean norm of the residual, in the model's units.
    """

    rest: Any
    unit: float
    most: float
    norm: float


class Review(NamedTuple):
    """Properties of a displacement in single precision, computed in double precision.

    Attributes
    ----------
    most, norm : float
        Largest absolute value and Euclidean norm of the residual, as in `Balance`.
    energy, forces : float
        Energy of the tissue, and norm of its forces A d.
    work : float
        Work of the load over the displacement; 0 without a load.
    farthest : float
        Largest absolute value of the displacement, in pixels.
    """

    most: float
    norm: float
    energy: float
    forces: float
    work: float
    farthest: float


class LinearLevel(Protocol):
    """One level of the model."""

    #: Right-hand side of the level's system; on the finest level, the caller assigns a vector.
    load: Any
    #: Correction, which `descend` and `ascend` update.
    correction: Any

    @property
    def is_revisited(self) -> bool:
        """True if a second visit within a cycle is worth its cost."""
        ...

    def descend(self, steps: Steps, coarse: Any | None, again: bool = False) -> None:
        """Smooth, starting from zero, and restrict the residual to the load of `coarse`.

        A smoothing step is ``step = scale D^-1 (load - A d) + momentum step; d += step``.

        Parameters
        ----------
        steps : tuple of (float, float)
            Scale and momentum of each step.
        coarse : LinearLevel or None
            Next coarser level, or None for the coarsest level.
        again : bool
            True to start from the current correction instead of zero.
        """
        ...

    @property
    def finishes_cycle(self) -> bool:
        """True if `finish` also processes all coarser levels."""
        ...

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Compute a correction for the load, starting from zero.

        If `finishes_cycle`, all coarser levels are visited with `steps`, and the last level is
        smoothed with the steps `coarsest`. Otherwise this level is smoothed with `coarsest`.
        """
        ...

    def ascend(self, steps: Steps, coarse: Any) -> None:
        """Add the interpolated correction of the next coarser level and smooth."""
        ...

    def vector(self, values: npt.NDArray[np.float32] | None = None) -> Any:
        """Return a new vector of zeros, or one with `values`, which the call may overwrite."""
        ...

    def scratch_vector(self) -> Any:
        """Return an uninitialized vector that is valid until the next cycle."""
        ...

    def free(self, *vectors: Any) -> None:
        """Release vectors for reuse."""
        ...

    def planes(self, vector: Any) -> npt.NDArray[np.float32]:
        """Copy a vector to the host as planes."""
        ...

    def product(self, a: Any, b: Any) -> Any:
        """Return the scalar product."""
        ...

    def largest(self, a: Any) -> Any:
        """Return the largest absolute value."""
        ...

    def weigh(self, a: Any, b: Any) -> tuple[Any, Any]:
        """Return the largest absolute value of `a`, and the scalar product of `a` and `b`."""
        ...

    def ratio(self, a: Any, b: Any) -> Any:
        """Return a / b for two scalars; 0 unless both are positive."""
        ...

    def apply(self, direction: Any, image: Any) -> Any:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        ...

    def advance(self, d: Any, rest: Any, direction: Any, image: Any, length: Any) -> Any:
        """Compute d += length direction and rest -= length image; return rest . rest."""
        ...

    def turn(self, steepest: Any, direction: Any, share: Any) -> None:
        """Compute ``direction = steepest + share * direction``."""
        ...

    def project(self, vector: Any) -> None:
        """Project a displacement or a force onto the rigid motions of bodies, in place."""
        ...

    def read(self, *scalars: Any) -> tuple[float, ...]:
        """Wait for the device and return the values of scalars."""
        ...


class UnsymmetricLevel(LinearLevel, Protocol):
    """One level of a model with a nonsymmetric matrix, with the kernels of its iteration."""

    def multiply(self, direction: Any, image: Any) -> None:
        """Compute ``image = A @ direction``."""
        ...

    def quotient(self, a: Any, b: Any) -> Any:
        """Return a / b for two scalars of any sign; 0 if b is 0."""
        ...

    def times(self, a: Any, b: Any) -> Any:
        """Return a b for two scalars."""
        ...

    def lean(self, rest: Any, direction: Any, image: Any, share: Any, stride: Any) -> None:
        """Compute ``direction = rest + share * (direction - stride * image)``."""
        ...


class OnDevice(Protocol):
    """Displacement of a solve that stays on the device until its cycles are done.

    Observed components have the observed displacement, and all others begin with a warm start or at
    zero. The device computes in single precision, so `review` decides when a solve ends.
    """

    def balance(self) -> Balance:
        """Return the residual in single precision, with `rest` as a vector on the device.

        `most` is only an upper bound, the norm.
        """
        ...

    def add(self, correction: Any) -> None:
        """Add a vector of the finest level to the displacement."""
        ...

    def review(self) -> Review:
        """Copy the displacement to the host, and review it there."""
        ...

    @property
    def values(self) -> npt.NDArray[np.float32]:
        """Displacement at the last `review`, in pixels, shape (H, W, 2)."""
        ...

    def keep(self) -> None:
        """Keep the displacement on the device for warm starts that use the array `values`."""
        ...


class Hierarchy(Protocol):
    """Levels of a model, and upper bounds on its spectrum."""

    @property
    def levels(self) -> Sequence[Any]:
        """Levels (`LinearLevel`), finest first."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds on the spectrum of D^-1 A: for usual materials, and for all materials."""
        ...


class LinearModel(Protocol):
    """Linear model of one problem, with its coarser levels."""

    @property
    def levels(self) -> Sequence[LinearLevel]:
        """Levels, finest first."""
        ...

    @property
    def material(self) -> Any:
        """Material of the model: an `Assembled` material."""
        ...

    @property
    def mild(self) -> bool:
        """True if a cycle reduces the error of every motion of this tissue."""
        ...

    @property
    def slow(self) -> bool:
        """True if a direct factorization is faster than cycles on this device."""
        ...

    @property
    def double_level(self) -> Any:
        """Finest level for an iteration in double precision; None if the model has none."""
        ...

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the finest level."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Finest grid, (H, W) or (D, H, W)."""
        ...

    @property
    def bodies(self) -> Bodies | None:
        """Rigid bodies under the current constraints; None without rigid tissue."""
        ...

    @property
    def iterates(self) -> bool:
        """True if cycles can be used with this tissue."""
        ...

    @property
    def earlier(self) -> EarlierResults:
        """Results of earlier solves with the current constraints."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds on the spectrum of D^-1 A: for usual materials, and for all materials."""
        ...

    def hold(self, held: HeldPlanes) -> None:
        """Set the constrained components of the finest level and update the coarser levels."""
        ...

    def on_device(
        self, problem: Problem, load: Planes | None, start: WarmStart | None
    ) -> OnDevice | None:
        """Begin a solve on the device; return None for a solve with `hold` and `balance`.

        Parameters
        ----------
        problem : Problem
            Problem with the tissue of this model, whose observations never slip.
        load : ndarray, planes, or None
            Load, in the model's units, which the caller does not change.
        start : WarmStart, optional
            Warm start.
        """
        ...

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return the fields of the rigid bodies' motions for deflation; None if there are none.

        Parameters
        ----------
        steps, coarsest : tuple of (float, float)
            Smoothing steps for computing the fields; `coarsest` is used on the coarsest level.
        """
        ...

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Compute the residual load - A d.

        Parameters
        ----------
        d : ndarray, planes
            Displacement, in pixels.
        load : ndarray, planes, or None
            Load, in the model's units, or None if there is no load.
        unit : float
            Estimate of the largest value of the residual; a few orders of magnitude of error are
            harmless.
        """
        ...

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return the force of the tissue on every component, -A d, in double precision.

        The result is valid until the next call.

        Parameters
        ----------
        d : ndarray, planes
            Displacement, in pixels.
        low : ndarray, planes, optional
            Rounding error of `d`: the displacement is `d` + `low`.
        """
        ...

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the norm of its forces A d."""
        ...

    def review(self, values: npt.NDArray[np.float32], load: Planes | None) -> Review:
        """Return what decides whether a displacement, shape (H, W, 2), is a solution."""
        ...

    @property
    def steepness(self) -> Planes:
        """Diagonal of A on the finest level, including constrained components."""
        ...

    def clear(self) -> None:
        """Reset all corrections to zero, because they may contain values that are not finite."""
        ...

    def clear_cache(self) -> None:
        """Remove the model from the cache, because of an overflow."""
        ...

    def close(self) -> None:
        """Free the model's memory on the device."""
        ...
