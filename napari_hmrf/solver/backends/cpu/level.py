"""Level on the processor: all of it that does not depend on the model.

Scalars are plain Python numbers, because the processor is the host.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.base import BATCH_SECONDS
from napari_hmrf.solver.backends.cpu import data_weights, vectors
from napari_hmrf.solver.backends.cpu.layout import Layout, Table, flat, rows, whole_rows
from napari_hmrf.solver.backends.cpu.point_smoother import PointSmoother
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.coarse_levels import MOST_PINS, SPRING
from napari_hmrf.solver.data_term import DataTerm, PointTerm

_TINY = 1e-300
# Approximate time of a smoothing step for one voxel on one thread, in seconds.
_VOXEL_SECONDS = 20e-9
# Coefficients (scale, ahead, back) of a step of size 1.
_UNIT_STEP = np.array([1, 0, 0], dtype=np.float32)
Vector = npt.NDArray[np.float32]
Spans = npt.NDArray[np.int64]


class CpuLevel:
    """Level on the processor; `LinearLevel` documents the methods.

    A subclass holds the matrix of one model on this level, and calls its loops: `write_diagonal`,
    `_begin`, `_smooth`, `_write_rest` and `apply`. All else is the same for all models.

    In a volume, arrays have shape (3, D + 4, H + 4, W + 4), and there is a span for each of its
    `rows`. If the layout stores only tissue, vectors have other shapes (`layout`).

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (H, W) or (D, H, W).
    finest : bool
        True for the finest level, which has no springs at first.
    layout : Layout, optional
        Layout of all vectors of the level; by default, that of planes.
    memory : mapping of str to ndarray, optional
        Memory of the arrays "inverse", "load", "correction", "other", "pins" and "weight"; that of
        arrays that are not given is allocated.

    Attributes
    ----------
    inverse : ndarray, shape (2, H + 4, W + 4)
        Reciprocal of the diagonal; 0 where a component does not move.
    weight : ndarray, shape (2, H + 4, W + 4), or None
        Strength of the springs; None on the finest level.
    mixed : ndarray, shape (2, H + 4, W + 4), or None
        With a data term, the off-diagonal component of the springs, and that of the smoother's
        blocks, whose diagonal is `inverse`; three of each in a volume. None without a data term.
    data : ndarray, shape (3, H + 4, W + 4), or None
        Tensors of the data term, packed (`data_weights`).
    exact_data : ndarray of float64, or None
        The same in double precision, without landmarks; only on the finest level.
    points : PointTerm or None
        Landmarks; only on the finest level. Cycles use a precision at the corners instead.
    reach : ndarray, shape (H + 4, 2) or (D + 4, H + 4, 2)
        Start and stop column of the moving sites in each padded row.
    spans : ndarray, shape (R - 4, 2)
        View of `reach` as a list of all padded rows, without the first and the last two.
    """

    weight: Vector | None
    mixed: Vector | None = None
    data: Vector | None = None
    exact_data: npt.NDArray[np.float64] | None = None
    points: PointTerm | None = None
    #: Correction of smoothing steps for landmarks.
    point_smoother: PointSmoother | None = None
    #: Diagonal of the tissue's matrix, if residuals are restricted with the data term.
    diagonal: Vector | None = None
    #: Cycle over this level and all coarser levels in a single call, if there is one.
    cycle_to_coarsest: Callable[[Steps, Steps], Vector] | None = None
    #: Corrections of that cycle for several unit loads (`SmallLevels.responses`).
    responses: Callable[[Steps, Steps, npt.NDArray[np.int64]], Vector] | None = None
    #: True if the loops of the model apply the blocks of the data term.
    loops_apply_data: bool = False
    #: True if a second visit within a cycle is worth its cost.
    is_revisited: bool = True
    #: True if an iteration updates the displacement directly, to save memory in volumes.
    sums_up: bool = False
    #: Rigid bodies on the finest level.
    bodies: Bodies | None = None

    def __init__(
        self,
        grid: tuple[int, ...],
        finest: bool = False,
        layout: Layout | None = None,
        memory: Mapping[str, Vector] | None = None,
    ) -> None:
        self.grid, self.is_volume = grid, len(grid) == 3
        #: `image_loops` or `volume_loops`.
        self.loops = loops_of(len(grid))
        #: Number of smoothing steps between two checks for cancellation.
        self.steps_at_once = 1
        if self.is_volume:
            self.steps_at_once = max(1, int(BATCH_SECONDS / (_VOXEL_SECONDS * math.prod(grid))))
        planes = tuple(size + 2 * PAD for size in grid)
        self.layout = Layout.whole(planes) if layout is None else layout
        self._spare: list[Vector] = []
        given = {} if memory is None else memory

        def array(name: str) -> Vector:
            return given[name] if name in given else self.vector()

        self.inverse, self.load = array("inverse"), array("load")
        #: Result of the smoother, and the array with which it alternates. Memory is scarce in
        #: volumes: outside of cycles, the second array also serves as `pins` and `scratch_vector`.
        self.correction, self._other = array("correction"), array("other")
        self.weight = None if finest else array("weight")
        self._pins = given.get("pins")
        if self._pins is None and not self.is_volume:
            self._pins = padded(len(grid), grid)
        self.reach: Spans = np.zeros((*planes[:-1], 2), dtype=np.int64)
        self.spans: Spans = self.reach.reshape(-1, 2)[PAD:-PAD]
        self._written_spans = self.spans.copy()
        spans = self.reach if self.is_volume else self.spans
        #: Table of rows, spans of the moving sites and width of a padded row, for the loops.
        self.where = self.layout.starts, spans, planes[-1]
        self._rows, self._most = np.zeros((2, rows(self.inverse).shape[1] - 2 * PAD))
        if self.is_volume and memory is None:
            # The operating system allocates memory at the first write, which is slow. Write to the
            # arrays one by one, so that the solve can be cancelled between two arrays.
            for component in (*self.inverse, *self.correction, *self._other):
                component.fill(0)
                compute_thread.check_cancelled()

    @property
    def pins(self) -> Vector:
        """Prescribed components: 1 or 0, and a restricted count on coarser levels.

        In images, they are planes of their own. In volumes, they are for the next coarser level
        only, which reads them once, and `start_cycles` clears them.
        """
        return self._other if self._pins is None else self._pins

    @property
    def finishes_cycle(self) -> bool:
        """True if `finish` also visits all coarser levels."""
        return self.cycle_to_coarsest is not None

    def write_diagonal(self, out: Vector) -> None:
        """Write the diagonal of the matrix, without springs and data, to `out`."""
        raise NotImplementedError

    def _write_diagonals(self) -> None:
        """Write the diagonal to `inverse`, and to `diagonal` if it is still read after that."""
        self.write_diagonal(self.inverse)
        if self.diagonal is not None:
            np.copyto(self.diagonal, self.inverse)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level."""
        self.hold_with_springs(held, None)

    def hold_with_springs(self, held: HeldPlanes, springs: Planes | None) -> None:
        """Set the prescribed components of the finest level, and values added to its diagonal."""
        self._write_diagonals()
        compute_thread.check_cancelled()
        weight = None if springs is None else springs.astype(np.float32)
        if weight is not None:
            np.add(self.inverse, weight, out=self.inverse, where=self.inverse > 0)
        self._hold(held, self.inverse, self.spans)
        if weight is not None:
            np.add(self.pins, weight * self.inverse, out=self.pins)
        if self.data is None:
            self.weight = weight
            return
        assert self.weight is not None
        self.weight[...] = 0 if weight is None else weight
        self._couple()

    def hold_as(self, finer: Self) -> None:
        """Set the springs of sites near prescribed sites of the next finer level.

        The diagonal is replaced with its reciprocal, including the springs.
        """
        self._write_diagonals()
        assert self.weight is not None
        finer._restrict(finer.pins, self, self.pins)
        starts, _, tissue = self.layout.rows
        vectors.spring(
            flat(self.inverse),
            flat(self.weight),
            starts,
            flat(self.pins),
            self._rows_of(self.pins),
            np.float32(MOST_PINS),
            np.float32(SPRING),
            tissue,
            self.spans,
        )
        self._couple()

    def start_cycles(self) -> None:
        """Clear the corrections if they have held pins, or if the spans have shrunk.

        To be called on each level once all levels are constrained. Loops write only within the
        spans, and expect zeros elsewhere.
        """
        before = self._written_spans
        shrunk = (self.spans[:, 0] > before[:, 0]).any() or (self.spans[:, 1] < before[:, 1]).any()
        if shrunk or self._pins is None:
            self.clear()
        np.copyto(before, self.spans)

    def _hold(self, held: HeldPlanes, inverse: Vector, spans: Spans) -> None:
        """Replace a diagonal with its reciprocal, or 0 where `held` is True, and set the pins."""
        starts, _, tissue = self.layout.rows
        held_and_pins = flat(held), self._rows_of(held), flat(self.pins), self._rows_of(self.pins)
        vectors.hold(flat(inverse), starts, *held_and_pins, tissue, spans)

    def _rows_of(self, values: npt.NDArray[Any]) -> Table:
        """Return the table of rows of planes or of a vector."""
        layout = self.layout
        return (whole_rows(layout.planes) if values.shape[1:] == layout.planes else layout.rows)[0]

    def allow_data(self) -> None:
        """Allocate the arrays of a data term."""
        axes = len(self.grid)
        count = axes * (axes - 1) // 2
        self.data = self.layout.vector(axes + count)
        self.mixed = self.layout.vector(2 * count) if self.mixed is None else self.mixed
        self.weight = self.vector() if self.weight is None else self.weight
        if not self.loops_apply_data:
            self.diagonal = self.vector()

    def set_data(self, data: DataTerm) -> None:
        """Set the data term of the finest level."""
        assert self.data is not None
        self.exact_data, self.points = data.weights, data.points
        np.copyto(self.data, data.weights, casting="same_kind")
        if self.loops_apply_data:
            self.diagonal = None if data.points is None else self.vector()

    def _coarsened_data(self) -> Vector:
        """Return the tensors for the next coarser level, with those of landmarks at the corners."""
        assert self.data is not None
        if self.points is None:
            return self.data
        # A landmark is a precision of at most D at each corner. A larger one would move the corners
        # together.
        data, diagonal = self.data.copy(), self.inverse
        at, sums = self.points.lumped()
        flat = data.reshape(len(data), -1)
        mean = diagonal.reshape(len(diagonal), -1)[:, at].mean(axis=0)
        flat[: len(sums), at] += (sums * mean / np.maximum(sums + mean, _TINY)).astype(np.float32)
        return data

    def coarsen_data(self, coarse: Self) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        self.write_diagonal(self.inverse)
        assert self.weight is not None
        assert self.mixed is not None
        assert coarse.data is not None
        # The springs of this level are not set yet, so that their arrays can store W T.
        axes = len(self.grid)
        arrays = self._coarsened_data(), self.inverse, self.weight, self.mixed
        data_weights.limit(*map(rows, arrays))
        self._restrict(self.weight, coarse, coarse.data[:axes])
        self._restrict(self.mixed, coarse, coarse.data[axes:])

    def _couple(self) -> None:
        """Add the data term to the springs and to the smoother, if there is one."""
        if self.data is not None:
            assert self.weight is not None
            assert self.mixed is not None
            arrays = self.inverse, self.data, self.weight, self.mixed
            data_weights.couple(*map(rows, arrays))
        self.point_smoother = None
        if self.points is not None:
            assert self.mixed is not None
            self.point_smoother = PointSmoother(self.points, self.inverse, self.mixed)

    @property
    def _springs(self) -> tuple[Vector, np.float32]:
        """Strength of the springs for the kernels, and its factor, 0 or 1."""
        # If there are no springs, the kernel reads another array and multiplies it by 0.
        if self.weight is None:
            return self.inverse, np.float32(0)
        return self.weight, np.float32(1)

    def add_data(self, d: Any, inverse: Vector | None, out: Any, scale: float = 1.0) -> float:
        """Add ``scale * W d`` of the data term to `out`; return d . W d.

        Components that are fixed according to `inverse` are left out. Without a data term, nothing
        is added.
        """
        data = self.exact_data
        if data is None:
            return 0.0
        free = None if inverse is None else rows(inverse)
        data_weights.add(rows(d), rows(data), scale, free, rows(out), self._rows)
        return float(self._rows.sum()) + self.add_points(d, inverse, out, scale)

    def add_points(self, d: Any, inverse: Vector | None, out: Any, scale: float = 1.0) -> float:
        """Add ``scale * H^T w H d`` of the landmarks to `out`; return d . H^T w H d."""
        if self.points is None:
            return 0.0
        moved = self.points.at_points(d)
        forces = self.points.weights * moved
        self.points.add_forces(forces, out, scale)
        if inverse is not None:
            at = np.unique(self.points.corners)
            flat, fixed = out.reshape(len(out), -1), inverse.reshape(len(out), -1) == 0
            flat[:, at] = np.where(fixed[:, at], 0, flat[:, at])
        return float((forces * moved).sum())

    def _restrict(self, forces: Vector, coarse: Self, out: Vector) -> None:
        """Restrict forces on this level to `out`, a vector of the next coarser level."""
        self.loops.restrict(self, forces, coarse, out)

    @cached_property
    def _rest(self) -> Vector:
        """Memory for a residual beside the correction and the array with which it alternates."""
        return self.vector()

    def _write_rest(self) -> Vector:
        """Return the residual of the correction; valid until the next smoothing step."""
        raise NotImplementedError

    @property
    def _adds_data(self) -> bool:
        """True if data or landmarks are added to each step of the model's loops."""
        has_data = self.data is not None and not self.loops_apply_data
        return has_data or self.point_smoother is not None

    def _restrict_residual(self, coarse: Self) -> None:
        """Restrict the residual of the correction to the load of `coarse`."""
        if self._adds_data:
            self._restrict_with_data(coarse)
        else:
            self._leave(coarse)

    def _leave(self, coarse: Self) -> None:
        """Restrict the residual by the model's loops alone."""
        self._restrict(self._write_rest(), coarse, coarse.load)

    def _add_coarse(self, coarse: Self) -> None:
        """Add the interpolated correction of the next coarser level, filtered if there are data."""
        if self.mixed is None:
            self.loops.interpolate(self, coarse)
            return
        smoother = self.point_smoother
        out = self.correction if smoother is None else np.zeros_like(self.correction)
        self.loops.add_relaxed(self, coarse, out)
        if smoother is not None:
            smoother.subtract(smoother.moved(out), out)
            self.correction += out

    def _step_simply(self, pace: Vector) -> None:
        """Compute one Chebyshev step, without landmarks, from `correction` to `_other`."""
        if self.loops_apply_data:
            self._smooth(pace[None])
            return
        assert self.mixed is not None
        arrays = self.correction, self._write_rest(), self.inverse, self.mixed, self._other
        data_weights.smooth(*map(rows, arrays), *pace)

    def _step_with_data(self, pace: Vector) -> None:
        """Compute one Chebyshev step, with any landmarks, from `correction` to `_other`."""
        smoother, (scale, ahead, back) = self.point_smoother, map(float, pace)
        if smoother is None:
            self._step_simply(pace)
            return
        now, before = smoother.moved(self.correction), smoother.moved(self._other)
        self._step_simply(pace)
        step = smoother.moved(self._other) - (1 + ahead) * now + back * before
        smoother.subtract(step + scale * now, self._other)

    def _relax_with_data(self, steps: Steps, from_zero: bool) -> None:
        """Run smoothing steps, with the landmarks if there are any."""
        if from_zero:
            self.correction.fill(0)
            self._other.fill(0)
        for pace in paces_of(steps, from_zero=False):
            self._step_with_data(pace)
            self.correction, self._other = self._other, self.correction
            compute_thread.check_cancelled()

    def _restrict_with_data(self, coarse: Self) -> None:
        """Restrict the filtered residual, which is D times a step of size 1."""
        self._step_with_data(_UNIT_STEP)
        assert self.diagonal is not None
        self._other -= self.correction
        self._other *= self.diagonal
        self._restrict(self._other, coarse, coarse.load)

    def _add_data_image(self, direction: Vector, image: Vector) -> float:
        """Add the rest of W d to an image with the diagonal of W; return ``direction . image``."""
        assert self.mixed is not None
        arrays = direction, self.mixed, self.inverse, image
        data_weights.add_mixed(*map(rows, arrays))
        self.add_points(direction, self.inverse, image)
        return self.product(direction, image)

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        raise NotImplementedError

    def descend(self, steps: Steps, coarse: Self | None, again: bool = False) -> None:
        """Smooth from zero, or continue if `again`; restrict the residual to `coarse.load`."""
        self.relax(steps, from_zero=not again)
        if coarse is not None:
            self._restrict_residual(coarse)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Compute the correction, on all coarser levels in a single call if that is possible."""
        if self.cycle_to_coarsest is None:
            self.descend(coarsest, None)
        else:
            self.correction = self.cycle_to_coarsest(steps, coarsest)

    def ascend(self, steps: Steps, coarse: Self) -> None:
        """Add the interpolated coarse correction, then smooth."""
        self._add_coarse(coarse)
        self.relax(steps, from_zero=False)

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on `correction` for `load`."""
        if self._adds_data:
            self._relax_with_data(steps, from_zero)
            return
        paces = paces_of(steps, from_zero)
        if from_zero:
            paces = paces[self._begin(paces) :]
        for first in range(0, len(paces), self.steps_at_once):
            some = paces[first : first + self.steps_at_once]
            self._smooth(some)
            if len(some) % 2 == 1:
                self.correction, self._other = self._other, self.correction
            if self.is_volume:  # in images, a check would take a tenth of the time of a step
                compute_thread.check_cancelled()

    def _begin(self, paces: Vector) -> int:
        """Run the first steps from zero, to `correction`; return their number."""
        return int(self.loops.begin(self, paces))

    def _smooth(self, paces: Vector) -> None:
        """Run Chebyshev steps (scale, ahead, back), alternating `correction` and `_other`."""
        raise NotImplementedError

    def clear(self) -> None:
        """Set the correction and its second array to zero."""
        self.correction.fill(0)
        compute_thread.check_cancelled()
        self._other.fill(0)
        compute_thread.check_cancelled()

    def vector(self, values: Vector | None = None) -> Vector:
        """Return a zero vector, or one with the given values: planes, or already a vector."""
        if values is not None:
            is_planes = values.shape[1:] == self.layout.planes
            return self.layout.packed(values) if is_planes else values
        if not self._spare:
            return self.layout.vector()
        vector = self._spare.pop()
        vector.fill(0)
        return vector

    def scratch_vector(self) -> Vector:
        """Return a vector that is valid until the next cycle."""
        return self._other if self.is_volume else self.vector()

    def free(self, *vectors: Vector) -> None:
        """Store vectors of images for reuse; allocation takes longer than clearing a vector."""
        if not self.is_volume:
            self._spare += vectors

    def planes(self, vector: Vector) -> Vector:
        """Return a vector as planes."""
        return self.layout.unpacked(vector)

    def product(self, a: Vector, b: Vector) -> float:
        """Return the scalar product of two vectors."""
        vectors.product(rows(a), rows(b), self._rows)
        return float(self._rows.sum())

    def largest(self, a: Vector) -> float:
        """Return the largest absolute value in a vector."""
        vectors.largest(rows(a), self._most)
        return float(self._most.max())

    def weigh(self, a: Vector, b: Vector) -> tuple[float, float]:
        """Return the largest absolute value in `a`, and the scalar product of `a` and `b`."""
        vectors.weigh(rows(a), rows(b), self._most, self._rows)
        return float(self._most.max()), float(self._rows.sum())

    def ratio(self, a: float, b: float) -> float:
        """Return a / b, or 0 unless both numbers are positive."""
        return a / b if a > 0 and b > 0 else 0.0

    def quotient(self, a: float, b: float) -> float:
        """Return a / b, or 0 if b is 0."""
        return a / b if b != 0 else 0.0

    def times(self, a: float, b: float) -> float:
        """Return the product of two numbers."""
        return a * b

    def advance(
        self, d: Vector, rest: Vector, direction: Vector, image: Vector, length: float
    ) -> float:
        """Add ``length * direction`` to `d`, and subtract ``length * image`` from `rest`.

        Return ``rest . rest``.
        """
        return self.advance_by(d, length, rest, direction, image, length)

    def advance_by(
        self, d: Any, share: float, rest: Vector, direction: Vector, image: Vector, length: float
    ) -> float:
        """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

        Return ``rest . rest``.
        """
        of_d, *others = map(rows, (d, rest, direction, image))
        shares = d.dtype.type(share), rest.dtype.type(length)
        vectors.advance(of_d, shares[0], *others, shares[1], self._rows)
        return float(self._rows.sum())

    def project(self, vector: Vector) -> None:
        """Project a vector onto the rigid motions of bodies, in place."""
        if self.bodies is not None:
            self.bodies.project(vector)

    def turn(self, steepest: Vector, direction: Vector, share: float) -> None:
        """Compute ``direction = steepest + share * direction``."""
        self.lean(steepest, direction, steepest, share, 0.0)

    def lean(
        self, rest: Vector, direction: Vector, image: Vector, share: float, stride: float
    ) -> None:
        """Compute ``direction = rest + share * (direction - stride * image)``."""
        arrays = [rows(each) for each in (rest, direction, image)]
        shares = direction.dtype.type(share), direction.dtype.type(stride)
        if not self.is_volume:
            vectors.lean(*arrays, *shares)
            return
        for component in range(len(direction)):
            compute_thread.check_cancelled()
            vectors.lean(*(each[component : component + 1] for each in arrays), *shares)

    def read(self, *scalars: float) -> tuple[float, ...]:
        """Return the scalars, which are already plain numbers."""
        return scalars


def loops_of(axes: int) -> Any:
    """Return the module with the loops of images or of volumes, which have the same functions."""
    if axes == 3:
        from napari_hmrf.solver.backends.cpu import volume_loops  # heavy: the loops of volumes

        return volume_loops
    from napari_hmrf.solver.backends.cpu import image_loops  # heavy: the loops of images

    return image_loops


@lru_cache(maxsize=16)
def paces_of(steps: Steps, from_zero: bool) -> Vector:
    """Return (scale, ahead, back) of each step, for kernels that store displacements, not steps.

    These kernels compute ``out = d + scale * D^-1 (load - A d) + ahead * d - back * out``, where
    `out` on the right-hand side is the displacement before the previous step.
    """
    # The momentum multiplies the previous step, d - out. The first step has no momentum. In an
    # iteration from zero, `back` is also 0 in the second step, because the displacement before the
    # first step is zero and is not stored.
    made = np.zeros((len(steps), 3), dtype=np.float32)
    made[:, :2] = steps
    begun = 2 if from_zero else 1
    made[begun:, 2] = made[begun:, 1]
    return made


def all_sites(grid: tuple[int, ...]) -> Spans:
    """Return spans that cover whole rows; in volumes, the spans of border rows are empty."""
    whole = np.zeros((*(size + 2 * PAD for size in grid[:-1]), 2), dtype=np.int64)
    whole[(slice(PAD, -PAD),) * (len(grid) - 1)] = 0, grid[-1]
    return whole.reshape(-1, 2)[PAD:-PAD]
