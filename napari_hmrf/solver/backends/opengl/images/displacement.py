"""Displacements that stay on the device during a solve and for later warm starts."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.linear import Balance, LinearModel, Planes, Review
from napari_hmrf.solver.backends.opengl.images.level import Vector
from napari_hmrf.solver.backends.opengl.images.relaxing import RelaxingLevel
from napari_hmrf.solver.problem import Problem

#: Largest number of solutions in a warm start, which is that of inputs of `prescribe.glsl`. As many
#: solutions are kept.
MOST_SOLUTIONS = 4


class SolvedVectors:
    """Observations, load and latest solutions of one tissue, as vectors of its finest level.

    Parameters
    ----------
    level : RelaxingLevel
        Finest level.
    """

    def __init__(self, level: RelaxingLevel) -> None:
        self.level = level
        self.observed = level.vector()
        self._at: Any = None
        self._values: Any = None
        self._load: tuple[Planes, Vector] | None = None
        self._solutions: list[tuple[weakref.ref[Any], Vector]] = []

    def observe(self, problem: Problem) -> None:
        """Copy the observations to the device, or the smallest rectangle that has changed.

        Also release the solutions that no warm start can use any more.
        """
        self._solutions = self._alive
        at = problem.known_at
        values = np.divide(problem.known_values, problem.unit, dtype=np.float32)
        if not are_equal(at, self._at):
            changed = at if self._at is None else np.union1d(at, self._at)
        else:
            changed = at[values != self._values]
        self._at = None  # set only at the end, because the copy may fail
        if len(changed):
            rows, cols = np.divmod(changed // 2, problem.shape[1])
            left = int(cols.min()) // 2 * 2
            around = np.s_[int(rows.min()) : int(rows.max()) + 1, left : int(cols.max()) + 1]
            here = np.where(problem.known[around], problem.observed[around], np.float32(0))
            self.level.write(self.observed, here, problem.unit, int(rows.min()), left)
        self._at, self._values = at, values

    def load(self, load: Planes | None) -> Any:
        """Return the texture of a load, which is copied unless it is the same array as before."""
        if load is None:
            return self.level.nothing
        if self._load is None or self._load[0] is not load:
            self._load = load, self.level.vector(load.astype(np.float32))
        return self._load[1].texture

    def solution(self, displacement: npt.NDArray[Any], unit: float) -> Vector:
        """Return an earlier solution, in pixels, which is copied unless the device has it."""
        for known, vector in self._solutions:
            if known() is displacement:
                return vector
        made = self.level.vector()
        self.level.write(made, displacement, unit)
        self.keep(displacement, made)
        return made

    def keep(self, displacement: npt.NDArray[Any], vector: Vector) -> None:
        """Keep the vector of a solution as long as the solution is alive and one of the latest."""
        self._solutions = [(weakref.ref(displacement), vector), *self._alive][:MOST_SOLUTIONS]

    @property
    def _alive(self) -> list[tuple[weakref.ref[Any], Vector]]:
        return [each for each in self._solutions if each[0]() is not None]


class GLDisplacement:
    """Displacement of a solve; `OnDevice` documents the methods.

    Parameters
    ----------
    vectors : SolvedVectors
        Vectors of the tissue, with the observations of the solve.
    host : LinearModel
        Model of the same tissue on the host.
    load : ndarray, planes, or None
        Load of the solve.
    start : WarmStart, optional
        Warm start of at most `MOST_SOLUTIONS` solutions.
    """

    def __init__(
        self,
        vectors: SolvedVectors,
        host: LinearModel,
        load: Planes | None,
        start: WarmStart | None,
    ) -> None:
        self._vectors, self._host, self._load = vectors, host, load
        self._level = vectors.level
        self._texture = vectors.load(load)
        self._read: FloatArray | None = None
        parts: Sequence[Vector] = []
        shares: Sequence[float] = []
        if start is not None:
            parts = [vectors.solution(each, start.unit) for each in start.displacements]
            shares = start.shares
        self._d = self._level.prescribed(vectors.observed, parts, shares)

    def balance(self) -> Balance:
        """Return the residual in single precision, with `rest` as a vector on the device."""
        level = self._level
        rest = level.residual(self._d, self._texture)
        (square,) = level.read(level.product(rest, rest))
        norm = float(np.sqrt(square))
        return Balance(rest, 1.0, norm, norm)

    def add(self, correction: Vector) -> None:
        """Add a vector of the finest level to the displacement."""
        self._level.add(self._d, correction)

    def review(self) -> Review:
        """Copy the displacement to the host, and review it there."""
        self._read = self._level.values(self._d)
        return self._host.review(self._read, self._load)

    @property
    def values(self) -> FloatArray:
        """Displacement at the last `review`, in pixels, shape (H, W, 2)."""
        assert self._read is not None
        return self._read

    def keep(self) -> None:
        """Keep the displacement on the device for warm starts that use the array `values`."""
        self._d.shed()
        self._vectors.keep(self.values, self._d)
