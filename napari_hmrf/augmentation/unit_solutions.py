"""The solutions of one case from which all others are sums: one of each thing that moves it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import psutil
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.problem import grid_in_words
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Grid, Motion, Study, Tissue
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material, stiffness_image
from napari_hmrf.tissue.normals import outer_rim

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Largest error of a sum, in pixels, from the errors of its parts.
WRONG = 5e-3
# Values that are summed at once: they stay in the cache.
_BLOCK = 1 << 16
_GIB = 2.0**30


@dataclass(frozen=True, eq=False)
class Causes:
    """Causes of motion, each in its own measure, as a sample draws them.

    Attributes
    ----------
    pulls : ndarray, shape (patches, n)
        How far each control patch is pulled along each axis, in the unit of the spacing.
    growth : ndarray, shape (tissues,)
        Which part of its material's growth each tissue grows by that may grow.
    weight : ndarray, shape (n,)
        What pulls at each part of all tissue along each axis, in the unit of stiffness per length.
    """

    pulls: Array
    growth: Array
    weight: Array

    def __mul__(self, scale: float) -> Causes:
        """The same, so many times."""
        return Causes(scale * self.pulls, scale * self.growth, scale * self.weight)

    @property
    def values(self) -> Array:
        """All of them in a row."""
        return np.concatenate([self.pulls.ravel(), self.growth, self.weight])


@dataclass(frozen=True, eq=False)
class MovableTissue:
    """Labels with their materials, and what may move this tissue.

    Attributes
    ----------
    grid : Grid
    labels : ndarray of int, shape ([D,] H, W)
    materials : tuple of Material
    hold_edge : bool
        Whether the outer edge of the tissue stays where it is.
    patches : ndarray of int, shape ([D,] H, W)
        Which patch is where, from 1 on.
    centres : ndarray, shape (patches, n)
        Of each, in the unit of the spacing.
    amplitude : (float, float)
        How far that patch is pulled that is pulled farthest, at least and at most.
    smoothness : float
        Length over which the pulls of patches are alike.
    weight : float
        Largest weight of a sample.
    least_jacobian : float
        Smallest part of its area, or its volume, that tissue is squeezed to.
    """

    grid: Grid
    labels: npt.NDArray[np.integer]
    materials: tuple[Material, ...]
    hold_edge: bool
    patches: npt.NDArray[np.int32]
    centres: Array
    amplitude: tuple[float, float]
    smoothness: float
    weight: float
    least_jacobian: float

    @cached_property
    def growing(self) -> tuple[Material, ...]:
        """The tissues here that may grow."""
        present = set(np.unique(self.labels).tolist())
        return tuple(row for row in self.materials if row.grows and row.label in present)

    @property
    def units(self) -> list[Causes]:
        """Each cause alone, as much of it as a sample may have: what a unit solution is of."""
        n, tissues = len(self.grid.shape), len(self.growing)
        none = Causes(np.zeros_like(self.centres), np.zeros(tissues), np.zeros(n))
        pulls = [self.amplitude[1] * each for each in np.eye(self.centres.size)]
        alone = [replace(none, pulls=each.reshape(-1, n)) for each in pulls]
        alone += [replace(none, growth=each) for each in np.eye(tissues)]
        if self.weight:
            alone += [replace(none, weight=self.weight * each) for each in np.eye(n)]
        return alone

    def study(self, causes: Causes, tolerance: float = 1e-3) -> Study:
        """Return the study of this tissue with these causes, to be solved in full."""
        shares = {row.label: share for row, share in zip(self.growing, causes.growth, strict=True)}
        rules = tuple(
            BoundaryRule(number, "move", vector=tuple(pull), name=f"patch {number}")
            for number, pull in enumerate(causes.pulls.tolist(), start=1)
        )
        rows = tuple(
            replace(row, growth=_part(row.growth, float(shares.get(row.label, 0.0))))
            for row in self.materials
        )
        weight = tuple(causes.weight.tolist()) if causes.weight.any() else ()
        return Study(
            self.grid,
            Tissue(labels=self.labels, materials=rows),
            Motion(hold_edge=self.hold_edge, labels=self.patches, rules=rules, weight=weight),
            optimizer=Multigrid(tolerance),
        )


def _part(growth: float | tuple[float, ...], share: float) -> float | tuple[float, ...]:
    if isinstance(growth, tuple):
        return tuple(share * along for along in growth)
    return share * growth


def control_patches(
    labels: npt.NDArray[np.integer],
    materials: Sequence[Material],
    spacing: Sequence[float],
    *,
    count: int,
    radius: float,
    hold_edge: bool,
) -> tuple[npt.NDArray[np.int32], Array]:
    """Spread patches over soft tissue, far from each other, from its edge and from what is rigid.

    Parameters
    ----------
    labels : ndarray of int, shape ([D,] H, W)
    materials : sequence of Material
    spacing : sequence of float, shape (n,)
    count : int
        At most so many: where there is no room left, there are fewer.
    radius : float
        Of a patch, in the unit of the spacing.
    hold_edge : bool
        Whether tissue ends where it is held.

    Returns
    -------
    patches : ndarray, shape ([D,] H, W), int32
        0 where there is none, else its number from 1 on.
    centres : ndarray, shape (patches, n)
        In the unit of the spacing.

    Raises
    ------
    ProblemError
        If there is no room for a patch.
    """
    m = stiffness_image(labels, materials)
    soft = (m > 0) & np.isfinite(m)
    if hold_edge:
        soft &= ~outer_rim(m > 0)
    # Tissue at the edge of the image ends there.
    inner = tuple(slice(1, -1) for _ in m.shape)
    depth = scipy.ndimage.distance_transform_edt(np.pad(soft, 1), sampling=spacing)[inner]
    sites = np.argwhere(depth > radius)
    if not len(sites):
        raise ProblemError(
            "labels",
            f"have no soft tissue in which a control patch of radius {radius:g} has room. Give "
            "a smaller radius.",
        )
    at = sites * np.asarray(spacing)
    room = depth[tuple(sites.T)].astype(np.float64)  # as far as that from all that holds
    patches, centres = np.zeros(m.shape, dtype=np.int32), np.empty((0, m.ndim))
    axes = np.ogrid[tuple(map(slice, m.shape))]
    # The next is where most room is: half of what lies between two patches is for each.
    while len(centres) < count and room.max() > radius:
        centre = at[room.argmax()]
        centres = np.concatenate([centres, centre[None]])
        off = sum(
            (axis * size - middle) ** 2
            for axis, size, middle in zip(axes, spacing, centre, strict=True)
        )
        patches[off <= radius**2] = len(centres)
        room = np.minimum(room, np.linalg.norm(at - centre, axis=1) / 2)
    return patches, centres


@dataclass(frozen=True, eq=False)
class UnitSolutions:
    """Motion of tissue by one unit of each cause, and so by any combination.

    Attributes
    ----------
    case : MovableTissue
    displacements : ndarray, shape (causes, sites, n), float32
        Of each of its units, of all sites of tissue.
    tissue : ndarray of bool, shape ([D,] H, W)
        What moves.
    """

    case: MovableTissue
    displacements: npt.NDArray[np.float32]
    tissue: BoolArray

    @cached_property
    def _most(self) -> Array:
        return np.array([unit.values.max() for unit in self.case.units])

    @cached_property
    def _places(self) -> npt.NDArray[np.intp]:
        """Index of each component of tissue, in a flat field."""
        return np.flatnonzero(np.repeat(self.tissue.ravel(), self.tissue.ndim))

    def field(self, causes: Causes) -> npt.NDArray[np.float32]:
        """Return the displacement by all causes together, ([D,] H, W, n).

        Its bits are the same on every machine: each product is rounded before it is added.
        """
        # Without a weight there are no unit solutions of it.
        shares = (causes.values[: len(self._most)] / self._most).astype(np.float32)
        units = self.displacements.reshape(len(shares), -1)
        total = np.zeros(units.shape[1], dtype=np.float32)
        part = np.empty(_BLOCK, dtype=np.float32)
        for begin in range(0, total.size, _BLOCK):
            block, sums = units[:, begin : begin + _BLOCK], total[begin : begin + _BLOCK]
            for unit, share in zip(block, shares, strict=True):
                sums += np.multiply(unit, share, out=part[: sums.size])
        n = self.tissue.ndim
        made = np.zeros(self.tissue.size * n, dtype=np.float32)
        made[self._places] = total
        return made.reshape(*self.tissue.shape, n)


def solve_units(
    case: MovableTissue,
    *,
    backend: str = "auto",
    memory: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> UnitSolutions:
    """Solve a case for each of its units.

    Parameters
    ----------
    case : MovableTissue
    backend : str
        As for `solve`.
    memory : float, optional
        What they may take, in bytes; by default half of what is free.
    progress : callable, optional
        Called with how many are solved, and of how many.

    Raises
    ------
    ProblemError
        If they take more memory, or if the case makes no problem.
    ConvergenceError, BackendError
        As of `solve`.
    """
    units, n = case.units, len(case.grid.shape)
    there = stiffness_image(case.labels, case.materials) > 0
    needed = 4 * len(units) * n * int(there.sum())
    allowed = psutil.virtual_memory().available / 2 if memory is None else memory
    if needed > allowed:
        raise ProblemError(
            "labels",
            f"are {grid_in_words(case.grid.shape)}, of which {len(units)} unit solutions take "
            f"{needed / _GIB:.2g} GiB of memory, and {allowed / _GIB:.2g} GiB are allowed: "
            f"{int(allowed / needed * len(units))} of them. Crop the labels, take fewer patches, "
            "or allow more memory.",
        )
    # Each unit is as much of its cause as a sample has: a sum is wrong by no more than all.
    tolerance = WRONG / len(units)
    displacements = np.empty((0, 0, n), dtype=np.float32)
    for number, unit in enumerate(units):
        solution = solve_study(case.study(unit, tolerance), backend=backend)
        tissue = solution.tissue
        if not number:  # tissue that nothing holds is left out
            displacements = np.empty((len(units), int(tissue.sum()), n), dtype=np.float32)
        displacements[number] = solution.displacement[tissue]
        if progress is not None:
            progress(number + 1, len(units))
    return UnitSolutions(case, displacements, tissue)
