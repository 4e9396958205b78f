"""Protocol of a linear model, A d = load, on ever coarser levels.

A *vector* is a displacement or a force on the sites of one level, kept on the device. A *scalar* is
a number kept there too: it goes from kernel to kernel without the host, which waits for the device
in `LinearLevel.read` only. Components that are held, or have no neighbours, do not move: a
correction is zero there.

On the host, fields are *planes*: float64, (2, H + 4, W + 4), the component first, in a ring of
zeros two sites wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.found import Found
from napari_hmrf.solver.backends.planes import HeldPlanes as HeldPlanes
from napari_hmrf.solver.backends.planes import Planes as Planes
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.backends.rigid.entrained import Entrained

#: (scale, momentum) of each Chebyshev step of a smoother.
Steps = tuple[tuple[float, float], ...]


class Balance(NamedTuple):
    """Residual of a load, load - A d: computed in double precision, 0 where held.

    Attributes
    ----------
    rest : ndarray of float32, planes
        In units of `unit`. The caller may change it; valid until the next call.
    unit : float
    most, norm : float
        The largest absolute value, and the norm; in the model's units.
    """

    rest: npt.NDArray[np.float32]
    unit: float
    most: float
    norm: float


class LinearLevel(Protocol):
    """One level of the model."""

    #: Load that the level is relaxed for: assign a vector on the finest level.
    load: Any
    #: Correction that `descend` and `ascend` change.
    correction: Any

    @property
    def worth_again(self) -> bool:
        """True if another visit within a cycle gains more than its passes cost."""
        ...

    def descend(self, steps: Steps, coarse: Any | None, again: bool = False) -> None:
        """Smooth from a correction of zero, and make what is left of the load `coarse`'s load.

        If `again`, smooth on from the correction there is. Each step of smoothing is
        step = scale D^-1 (load - A d) + momentum step, d += step.
        """
        ...

    #: True if `finish` visits all coarser levels, too.
    takes_rest: bool

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Find a correction for the load with `coarsest` steps, from zero."""
        ...

    def ascend(self, steps: Steps, coarse: Any) -> None:
        """Add the correction of the next coarser level, interpolated, and smooth."""
        ...

    def vector(self, values: npt.NDArray[np.float32] | None = None) -> Any:
        """Return a new vector: zero, or of what is in these planes, which it may change."""
        ...

    def passing(self) -> Any:
        """Return a vector of anything, which lasts until the next cycle."""
        ...

    def free(self, *vectors: Any) -> None:
        """Take vectors back that are no longer used."""
        ...

    def planes(self, vector: Any) -> npt.NDArray[np.float32]:
        """Bring a vector to the host."""
        ...

    def product(self, a: Any, b: Any) -> Any:
        """Return the scalar product."""
        ...

    def largest(self, a: Any) -> Any:
        """Return the largest absolute value."""
        ...

    def weigh(self, a: Any, b: Any) -> tuple[Any, Any]:
        """Return the largest absolute value of `a`, and the scalar product of both."""
        ...

    def ratio(self, a: Any, b: Any) -> Any:
        """Return a scalar over another; 0 unless both are positive."""
        ...

    def apply(self, direction: Any, image: Any) -> Any:
        """Compute image = A direction; return their scalar product."""
        ...

    def advance(self, d: Any, rest: Any, direction: Any, image: Any, length: Any) -> Any:
        """Add length direction to d, take length image from rest; return the square of the rest."""
        ...

    def turn(self, steepest: Any, direction: Any, share: Any) -> None:
        """Compute direction = steepest + share direction."""
        ...

    def project(self, vector: Any) -> None:
        """Replace a displacement or a force, in place, by that of bodies that move as one."""
        ...

    def read(self, *scalars: Any) -> tuple[float, ...]:
        """Wait for scalars."""
        ...


class UnsymmetricLevel(LinearLevel, Protocol):
    """One level of a model that is not symmetric: it takes another iteration, with more steps."""

    def multiply(self, direction: Any, image: Any) -> None:
        """Compute image = A direction, whose product with it means nothing here."""
        ...

    def quotient(self, a: Any, b: Any) -> Any:
        """Return a scalar over another of either sign; 0 where that is 0."""
        ...

    def times(self, a: Any, b: Any) -> Any:
        """Return a scalar times another."""
        ...

    def lean(self, rest: Any, direction: Any, image: Any, share: Any, stride: Any) -> None:
        """Compute direction = rest + share (direction - stride image)."""
        ...


class Hierarchy(Protocol):
    """Levels of a model, and the bounds of its spectrum."""

    @property
    def levels(self) -> Sequence[Any]:
        """`LinearLevel`s, finest first."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds of the spectrum of D^-1 A: the usual one, and one for any material."""
        ...


class LinearModel(Protocol):
    """A prior's model of one problem, and the same model again on coarser levels."""

    @property
    def levels(self) -> Sequence[LinearLevel]:
        """Finest first."""
        ...

    @property
    def material(self) -> Any:
        """Material of the model: an `Assembled` material."""
        ...

    @property
    def mild(self) -> bool:
        """True if a cycle sees every motion of such tissue."""
        ...

    @property
    def slow(self) -> bool:
        """True if factors are faster than cycles on this device."""
        ...

    @property
    def exactly(self) -> Any:
        """The finest level for an iteration in double precision; None if there is none."""
        ...

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level, with the present held ones."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """The finest grid, (H, W)."""
        ...

    @property
    def bodies(self) -> Bodies | None:
        """Rigid tissue, with what is held now."""
        ...

    @property
    def iterates(self) -> bool:
        """True if cycles can be used with such tissue."""
        ...

    @property
    def found(self) -> Found:
        """Earlier results for the tissue with the present held components."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds of the spectrum of D^-1 A: the usual one, and one for any material."""
        ...

    def hold(self, held: HeldPlanes) -> None:
        """Say which components do not move, on the finest level and therefore on all."""
        ...

    def entrained(self, steps: Steps, coarsest: Steps) -> Entrained | None:
        """Return what bodies that cycles hold take along, by so much smoothing; None without."""
        ...

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Find what a displacement leaves of a load.

        `unit` is a guess of what will be left, good to a few powers of ten.
        """
        ...

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return the pull of the tissue everywhere, held or not: -A d, in double precision.

        `low` is what rounding took from `d`. Valid until the next call.
        """
        ...

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the model's energy of a displacement, and the norm of all its forces."""
        ...

    @property
    def steepness(self) -> Planes:
        """The diagonal of A on the finest level, whatever is held."""
        ...

    def clear(self) -> None:
        """Make all corrections zero: numbers may have overflowed."""
        ...

    def forget(self) -> None:
        """Keep nothing for a later solve: numbers have overflowed."""
        ...

    def close(self) -> None:
        """Free what it has on the device."""
        ...
