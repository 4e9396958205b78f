"""Unit solutions of a case, one for each cause of motion, and their linear combinations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt
import psutil
import scipy
from pydantic import Field, NonNegativeFloat, PositiveFloat

from napari_hmrf.archive import STORED
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import FiniteArray, grid_in_words
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Grid, Motion, Study, Tissue
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material, stiffness_image
from napari_hmrf.tissue.normals import outer_rim

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Largest allowed error of a linear combination, in pixels.
WRONG = 5e-3
# Number of values that are summed together, small enough to fit into the CPU cache.
_BLOCK = 1 << 16
_GIB = 2.0**30


@dataclass(frozen=True, eq=False)
class Causes:
    """Causes of the motion of a sample.

    Attributes
    ----------
    pulls : ndarray, shape (patches, n)
        Displacement of each control patch along each axis, in the unit of the spacing.
    growth : ndarray, shape (tissues,)
        Growth of each tissue that may grow, as a fraction of its material's growth.
    weight : ndarray, shape (n,)
        Body force on all tissue along each axis, in the unit of stiffness per length.
    """

    pulls: Array
    growth: Array
    weight: Array

    def __mul__(self, scale: float) -> Causes:
        """Return all causes multiplied by a scale."""
        return Causes(scale * self.pulls, scale * self.growth, scale * self.weight)

    @property
    def values(self) -> Array:
        """Values of all causes in one array: pulls, growth and weight."""
        return np.concatenate([self.pulls.ravel(), self.growth, self.weight])


@dataclass(frozen=True, eq=False)
class MovableTissue:
    """Tissue of a case, with the possible causes of its motion.

    Attributes
    ----------
    grid : Grid
    labels : ndarray of int, shape ([D,] H, W)
        Label of the tissue at each pixel.
    materials : tuple of Material
        Materials of the labels.
    hold_edge : bool
        If True, the outer edge of the tissue is fixed.
    patches : ndarray of int, shape ([D,] H, W)
        Number of the control patch at each pixel, counted from 1; 0 outside patches.
    centres : ndarray, shape (patches, n)
        Centre of each patch, in the unit of the spacing.
    amplitude : (float, float)
        Bounds of the largest pull of a sample, in the unit of the spacing.
    smoothness : float
        Correlation length of the pulls of patches, in the unit of the spacing.
    weight : float
        Largest body force of a sample, in the unit of stiffness per length.
    least_jacobian : float
        Smallest allowed ratio of the deformed to the original area, or volume.
    """

    grid: Grid
    labels: npt.NDArray[np.integer]
    materials: tuple[Material, ...]
    hold_edge: bool
    patches: npt.NDArray[np.int32]
    centres: Array
    amplitude: tuple[NonNegativeFloat, PositiveFloat]
    smoothness: PositiveFloat
    weight: NonNegativeFloat
    least_jacobian: Annotated[float, Field(gt=0, lt=1)]

    @cached_property
    def growing(self) -> tuple[Material, ...]:
        """Materials that may grow and occur in the labels."""
        present = set(np.unique(self.labels).tolist())
        return tuple(row for row in self.materials if row.grows and row.label in present)

    @property
    def units(self) -> list[Causes]:
        """Causes of each unit solution: a single cause, with its largest value in any sample."""
        n, tissues = len(self.grid.shape), len(self.growing)
        none = Causes(np.zeros_like(self.centres), np.zeros(tissues), np.zeros(n))
        pulls = [self.amplitude[1] * each for each in np.eye(self.centres.size)]
        alone = [replace(none, pulls=each.reshape(-1, n)) for each in pulls]
        alone += [replace(none, growth=each) for each in np.eye(tissues)]
        if self.weight:
            alone += [replace(none, weight=self.weight * each) for each in np.eye(n)]
        return alone

    def study(self, causes: Causes, tolerance: float = 1e-3) -> Study:
        """Return the study in which the given causes deform the tissue.

        Parameters
        ----------
        causes : Causes
            Causes of the motion.
        tolerance : float
            Tolerance of the optimizer, in pixels.

        Returns
        -------
        Study
        """
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
    """Distribute patches over soft tissue, far from each other, from edges and from rigid tissue.

    Parameters
    ----------
    labels : ndarray of int, shape ([D,] H, W)
        Label of the tissue at each pixel.
    materials : sequence of Material
        Materials of the labels.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    count : int
        Maximum number of patches; fewer are used if the tissue does not have enough room.
    radius : float
        Radius of a patch, in the unit of the spacing.
    hold_edge : bool
        If True, the outermost pixels of the tissue are fixed, and patches do not overlap them.

    Returns
    -------
    patches : ndarray, shape ([D,] H, W), int32
        Number of the patch at each pixel, counted from 1; 0 outside patches.
    centres : ndarray, shape (patches, n)
        Centre of each patch, in the unit of the spacing.

    Raises
    ------
    ProblemError
        If the tissue does not have room for a patch.
    """
    m = stiffness_image(labels, materials)
    if min(m.shape) < 2:
        raise ProblemError(
            "labels",
            f"have shape {m.shape}. Pass an image (H, W) or a volume (D, H, W), without axes for "
            "batches or channels.",
        )
    soft = (m > 0) & np.isfinite(m)
    if not soft.any():
        raise ProblemError(
            "labels", "have no soft tissue. Give a label a stiffness above 0 that is not rigid."
        )
    if hold_edge:
        soft &= ~outer_rim(m > 0, diagonal=True)
    # The padding makes the edge of the image an edge of the tissue.
    inner = tuple(slice(1, -1) for _ in m.shape)
    depth = scipy.ndimage.distance_transform_edt(np.pad(soft, 1), sampling=spacing)[inner]
    sites = np.argwhere(depth > radius)
    if not len(sites):
        raise ProblemError(
            "labels",
            f"have no soft tissue with room for a control patch of radius {radius:g}. Use a "
            "smaller radius.",
        )
    at = sites * np.asarray(spacing)
    room = depth[tuple(sites.T)].astype(np.float64)  # distance to edges, fixed and rigid tissue
    patches, centres = np.zeros(m.shape, dtype=np.int32), np.empty((0, m.ndim))
    axes = np.ogrid[tuple(map(slice, m.shape))]
    # Place each patch at the site with the most room. Each placed patch limits the room of a site
    # to half the distance between the site and the patch.
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
    """Displacement fields of a tissue, for one unit of each cause.

    Attributes
    ----------
    case : MovableTissue
    displacements : ndarray, shape (causes, sites, n), float32
        Material displacement of all tissue sites, for each of `case.units`.
    tissue : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue that moves.
    """

    __pydantic_config__ = STORED

    case: MovableTissue
    displacements: FiniteArray
    tissue: BoolArray

    def __post_init__(self) -> None:
        case, grid = self.case, self.case.grid.shape
        shapes = {each.shape for each in (case.labels, case.patches, self.tissue)}
        needed = (len(case.units), int(self.tissue.sum()), len(grid))
        is_same_grid = shapes == {grid} and case.centres.shape[1:] == (len(grid),)
        if not (is_same_grid and self.displacements.shape == needed):
            raise ProblemError(
                "labels",
                f"are {grid_in_words(grid)}, but their patches, tissue or solutions have another "
                "grid. Solve them again.",
            )

    @cached_property
    def _most(self) -> Array:
        return np.array([unit.values.max() for unit in self.case.units])

    @cached_property
    def _places(self) -> npt.NDArray[np.intp]:
        """Indices of the displacement components of tissue sites in a flattened field."""
        return np.flatnonzero(np.repeat(self.tissue.ravel(), self.tissue.ndim))

    def field(self, causes: Causes) -> npt.NDArray[np.float32]:
        """Return the material displacement due to all causes together, ([D,] H, W, n).

        The result is bit-identical on all machines, because each product is rounded before it is
        added.
        """
        # If the weight of the case is 0, there are no unit solutions for the weight.
        shares = (causes.values[: len(self._most)] / self._most).astype(np.float32)
        units = self.displacements.reshape(len(shares), -1)
        total = np.zeros(units.shape[1], dtype=np.float32)
        part = np.empty(_BLOCK, dtype=np.float32)
        for begin in range(0, total.size, _BLOCK):
            block, sums = units[:, begin : begin + _BLOCK], total[begin : begin + _BLOCK]
            for unit, share in zip(block, shares, strict=True):
                sums += np.multiply(unit, share, out=part[: sums.size])
        n = self.tissue.ndim
        field = np.zeros(self.tissue.size * n, dtype=np.float32)
        field[self._places] = total
        return field.reshape(*self.tissue.shape, n)


def solve_units(
    case: MovableTissue,
    *,
    backend: str = "auto",
    memory: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> UnitSolutions:
    """Solve a case for each of its unit causes.

    Parameters
    ----------
    case : MovableTissue
    backend : str
        As for `solve`.
    memory : float, optional
        Maximum memory of the solutions, in bytes. The default is half of the free memory.
    progress : callable, optional
        Function called after each solve with the number of finished solves and the total.

    Returns
    -------
    UnitSolutions

    Raises
    ------
    ProblemError
        If the solutions require more than `memory`, or if the case is not a valid problem.
    ConvergenceError, BackendError
        As for `solve`.
    """
    units, n = case.units, len(case.grid.shape)
    tissue = stiffness_image(case.labels, case.materials) > 0
    needed = 4 * len(units) * n * int(tissue.sum())
    allowed = psutil.virtual_memory().available / 2 if memory is None else memory
    if needed > allowed:
        raise ProblemError(
            "labels",
            f"are {grid_in_words(case.grid.shape)}; their {len(units)} unit solutions require "
            f"{needed / _GIB:.2g} GiB of memory, but only {allowed / _GIB:.2g} GiB are allowed, "
            f"enough for {int(allowed / needed * len(units))}. Crop the labels, use fewer patches, "
            "or allow more memory.",
        )
    # The causes of a sample do not exceed the units, so the error of a linear combination is at
    # most the sum of the errors of the unit solutions.
    tolerance = WRONG / len(units)
    displacements = np.empty((0, 0, n), dtype=np.float32)
    for number, unit in enumerate(units):
        solution = solve_study(case.study(unit, tolerance), backend=backend)
        tissue = solution.tissue
        if not number:  # the solution excludes unconstrained tissue
            displacements = np.empty((len(units), int(tissue.sum()), n), dtype=np.float32)
        displacements[number] = solution.displacement[tissue]
        if progress is not None:
            progress(number + 1, len(units))
    return UnitSolutions(case, displacements, tissue)
