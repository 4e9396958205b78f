"""Elastic energy as an assembled matrix, for the direct solver and PyAMG.

Bilinear quadrilaterals on a regular grid all have the same 8 x 8 stiffness matrix except for their
modulus. The matrix is therefore assembled by adding slices of the image, without sorting a list of
triplets. It is tested against `ElasticPrior.forces`, which shares no code with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from napari_hmrf import ElasticPrior, Problem

Float64Array = npt.NDArray[np.float64]
CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))


class System(NamedTuple):
    """Linear system of the free sites.

    Attributes
    ----------
    matrix : bsr_array, 2 x 2 blocks
        Symmetric positive definite matrix. A prescribed component of a free site has only its
        diagonal entry.
    load : ndarray, shape (2 * sites,)
        Right-hand side.
    free : ndarray, shape (H, W), bool
        Mask of the sites with an unknown component, in the order of the system.
    start : ndarray, shape (H, W, 2)
        Prescribed displacement in pixels; 0 elsewhere.
    """

    matrix: sp.bsr_array
    load: Float64Array
    free: npt.NDArray[np.bool_]
    start: Float64Array

    def field(self, solution: Float64Array) -> Float64Array:
        """Return the displacement (H, W, 2), in pixels, of a solution of the system."""
        field = self.start.copy()
        field[self.free] = solution.reshape(-1, 2)
        return field


def element_stiffness(prior: ElasticPrior, spacing: tuple[float, ...]) -> Float64Array:
    """Return K, (4, 2, 4, 2), of a quadrilateral with Young's modulus 1, by 2 x 2 Gauss points.

    Corners are ordered as in `CORNERS`, and components as (row, col). In plane strain, the change
    of volume is evaluated only at the middle (selective reduced integration).
    """
    nu = float(prior.poisson)
    shear = 1 / (2 * (1 + nu))
    strain = prior.plane == "strain"
    first = nu / ((1 + nu) * (1 - 2 * nu)) if strain else nu / (1 - nu**2)
    point = 1 / np.sqrt(3)
    four = [(a * point, b * point, 1.0) for a in (-1, 1) for b in (-1, 1)]
    by_volume = [(0.0, 0.0, 4.0)] if strain else four
    area = spacing[0] * spacing[1] / 4
    k = np.zeros((8, 8))
    for points, bulk, slide in ((by_volume, first, 0.0), (four, 0.0, shear)):
        law = np.array(
            [[bulk + 2 * slide, bulk, 0], [bulk, bulk + 2 * slide, 0], [0, 0, slide]], dtype=float
        )
        for along, across, weight in points:
            b = np.zeros((3, 4, 2))
            for corner, (i, j) in enumerate(CORNERS):
                s, t = 2 * i - 1, 2 * j - 1
                by_row = s * (1 + t * across) / 4 * 2 / spacing[0]
                by_col = t * (1 + s * along) / 4 * 2 / spacing[1]
                b[0, corner, 0] = b[2, corner, 1] = by_row
                b[1, corner, 1] = b[2, corner, 0] = by_col
            b = b.reshape(3, 8)
            k += weight * area * b.T @ law @ b
    return k.reshape(4, 2, 4, 2)


def element_modulus(problem: Problem) -> Float64Array:
    """Return Young's modulus of each 2 x 2 block of sites, (H - 1, W - 1); 0 if one is void."""
    m = problem.stiffness.astype(np.float64) / float(problem.stiffness.max())
    corners = (m[:-1, :-1], m[:-1, 1:], m[1:, :-1], m[1:, 1:])
    whole = np.logical_and.reduce([corner > 0 for corner in corners])
    mean: Float64Array = np.where(whole, sum(corners) / 4, 0.0)
    return mean


def assemble(problem: Problem, prior: ElasticPrior) -> System:
    """Assemble the system of a problem, with boundaries prescribed exactly where c > 0."""
    k = element_stiffness(prior, problem.spacing).transpose(0, 2, 1, 3)
    modulus = element_modulus(problem)
    row, col = np.nonzero(modulus)
    modulus = modulus[row, col, None, None]
    exists = np.zeros(problem.shape, dtype=bool)
    for i, j in CORNERS:
        exists[row + i, col + j] = True
    number = np.full((problem.shape[0] + 2, problem.shape[1] + 2), -1, dtype=np.int32)
    number[1:-1, 1:-1][exists] = np.arange(exists.sum(), dtype=np.int32)
    # blocks[n, 3 a + b] couples site n with its neighbour a - 1 rows and b - 1 columns away.
    blocks = np.zeros((int(exists.sum()), 9, 2, 2))
    for here, (i, j) in enumerate(CORNERS):
        # No two elements have the same site at the same corner, so += adds all contributions.
        sites = number[1 + row + i, 1 + col + j]
        for there, (a, b) in enumerate(CORNERS):
            blocks[sites, 3 * (a - i + 1) + (b - j + 1)] += modulus * k[here, there]
    at_row, at_col = np.nonzero(exists)
    near = np.stack([number[at_row + a, at_col + b] for a in range(3) for b in range(3)], axis=1)
    held = ((problem.confidence > 0) & problem.tissue[..., None])[exists]
    start = np.where(
        (problem.confidence > 0) & problem.tissue[..., None],
        problem.observed / np.float64(problem.unit),
        0.0,
    )
    matrix, load = _free_part(blocks, near, held, start[exists])
    exists[exists] = ~held.all(axis=1)
    return System(matrix, load, exists, start)


def _free_part(
    blocks: Float64Array,
    near: npt.NDArray[np.int32],
    held: npt.NDArray[np.bool_],
    start: Float64Array,
) -> tuple[sp.bsr_array, Float64Array]:
    """Return rows and columns of the free sites, and the load of the prescribed components."""
    load = np.zeros_like(start)
    is_near_held = ((near >= 0) & held.any(axis=1)[near]).any(axis=1)
    seen = near[is_near_held]
    values = np.where((seen >= 0)[..., None], start[seen], 0.0)
    load[is_near_held] = -np.einsum("nokl,nol->nk", blocks[is_near_held], values)
    for component in (0, 1):
        # A prescribed component of a free site is reduced to its diagonal entry.
        at = held[:, component] & ~held.all(axis=1)
        diagonal = blocks[at, 4, component, component]
        blocks[at, :, component, :] = 0
        by, slot = np.nonzero((near >= 0) & at[near])
        blocks[by, slot, :, component] = 0
        blocks[at, 4, component, component] = diagonal
        load[at, component] = diagonal * start[at, component]
    free = ~held.all(axis=1)
    count = int(free.sum())
    renumber = np.full(len(free) + 1, -1, dtype=np.int32)  # the last entry is for index -1
    renumber[:-1][free] = np.arange(count, dtype=np.int32)
    columns = renumber[near[free]]
    there = columns >= 0
    indptr = np.concatenate([[0], np.cumsum(there.sum(axis=1))]).astype(np.int32)
    data, indices = blocks[free][there], columns[there]
    matrix = sp.bsr_array((data, indices, indptr), shape=(2 * count, 2 * count))
    return matrix, load[free].ravel()


def factorise(matrix: sp.sparray) -> SuperLU:
    """Factorize a symmetric positive definite matrix in symmetric mode by minimum degree."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def solve_directly(problem: Problem, prior: ElasticPrior) -> Float64Array:
    """Return the field of least energy, (H, W, 2), in pixels, by SuperLU in float64."""
    system = assemble(problem, prior)
    return system.field(factorise(system.matrix).solve(system.load))
