"""Linear elasticity in images and volumes: matrices with elements by scikit-fem, direct solutions.

An element is a block of 2 x 2 or 2 x 2 x 2 sites of tissue, in which the displacement is bilinear
or trilinear. Its energy is

    U = 1/2 integral of  lambda (div u)^2 + 2 mu e : e

with Lame parameters from the means of Young's modulus and of Poisson's ratio over its sites. In
plane strain and in volumes, div u is evaluated at the middle of the element; in plane stress, it is
integrated. All elements of a grid have the same shape, so scikit-fem integrates the two matrices of
a single element, for lambda = 1 and for mu = 1.

Lengths are in the unit of ``Problem.spacing``, and moduli in that of ``Problem.stiffness``. The
components of a displacement, shape (H, W, 2) or (D, H, W, 3), have the order of the flattened
array. An element with a void site has no energy. Neither has one with a rigid site: the sites of
such elements move as rigid bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import skfem
from scipy import ndimage
from scipy.sparse.linalg import SuperLU, splu
from skfem.helpers import ddot, div, sym_grad

from napari_hmrf import ElasticPrior, Problem
from validation.oracles import followed

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Solver = Callable[[Any, Array], Array]

#: Estimated error of `exact_field`, in pixels: an upper bound of its last correction.
KNOWN = 1e-6
_MOST_CORRECTIONS = 30
# Singular value of the prescribed part of a rigid motion below which the motion is free.
_FREE = 1e-9


@skfem.BilinearForm
def _change_of_volume(u, v, w):  # type: ignore[no-untyped-def]
    return div(u) * div(v)


@skfem.BilinearForm
def _change_of_shape(u, v, w):  # type: ignore[no-untyped-def]
    return 2 * ddot(sym_grad(u), sym_grad(v))


@lru_cache(maxsize=256)
def element_matrices(spacing: tuple[float, ...], *, full: bool) -> tuple[Array, Array]:
    """Return the matrices of one element for lambda = 1 and for mu = 1.

    Parameters
    ----------
    spacing : tuple of float
        Sides of the element.
    full : bool
        True to integrate changes of volume; False to evaluate them at the middle.

    Returns
    -------
    volume, shape : ndarray, shape (4, 2, 4, 2) or (8, 3, 8, 3)
        Matrices between the components of the corners, which are in the order of `corners_of`.
    """
    axes = len(spacing)
    sides = [np.array([0.0, side]) for side in spacing]
    if axes == 2:
        mesh, nodal = skfem.MeshQuad.init_tensor(*sides), skfem.ElementQuad1()
    else:
        mesh, nodal = skfem.MeshHex.init_tensor(*sides), skfem.ElementHex1()
    kind = skfem.ElementVector(nodal)
    middle = np.full((axes, 1), 0.5), np.ones(1)
    exact = skfem.Basis(mesh, kind, intorder=4)
    reduced = exact if full else skfem.Basis(mesh, kind, quadrature=middle)
    corner = np.rint(mesh.p / np.array(spacing)[:, None]).astype(int)
    order = np.argsort(np.ravel_multi_index(tuple(corner), (2,) * axes))
    at = exact.nodal_dofs[:, order].T.ravel()
    matrices = []
    for form, basis in ((_change_of_volume, reduced), (_change_of_shape, exact)):
        matrix = form.assemble(basis).toarray()[np.ix_(at, at)]
        matrix = (matrix + matrix.T).reshape(2**axes, axes, 2**axes, axes) / 2
        matrix.setflags(write=False)
        matrices.append(matrix)
    return matrices[0], matrices[1]


def corners_of(axes: int) -> list[tuple[int, ...]]:
    """Return the corners of an element: 0 or 1 along each axis, the last axis fastest."""
    return list(product((0, 1), repeat=axes))


def sites_at(corner: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the sites at a corner of all elements."""
    return tuple(slice(1, None) if end else slice(None, -1) for end in corner)


def at_corners(values: npt.NDArray[Any], axes: int) -> npt.NDArray[Any]:
    """Return the values of sites at the corners of each element, (4, H - 1, W - 1, ...)."""
    return np.stack([values[sites_at(corner)] for corner in corners_of(axes)])


def lame_parameters(problem: Problem, prior: ElasticPrior) -> tuple[Array, Array]:
    """Return lambda and mu of each element; 0 if a site is void or rigid."""
    axes, shape = problem.stiffness.ndim, problem.stiffness.shape
    m = at_corners(problem.stiffness.astype(np.float64), axes)
    ratios = np.broadcast_to(np.asarray(prior.poisson, np.float64), shape)
    nu = at_corners(ratios, axes).mean(axis=0)
    elastic = (m.min(axis=0) > 0) & (m.max(axis=0) < np.inf)
    young = np.where(elastic, np.where(elastic, m, 0.0).mean(axis=0), 0.0)
    return lame_of(young, nu, bulges=is_plane_stress(problem, prior))


def lame_of(young: Array, nu: Array, *, bulges: bool) -> tuple[Array, Array]:
    """Return lambda, in plane stress its plane counterpart, and mu of isotropic tissue."""
    shear = young / (2 * (1 + nu))
    return 2 * shear * nu / (1 - (nu if bulges else 2 * nu)), shear


def is_plane_stress(problem: Problem, prior: ElasticPrior) -> bool:
    """Return True for an image whose tissue is free to bulge out of it."""
    return problem.stiffness.ndim == 2 and prior.plane == "stress"


def grid_matrix(
    spacing: tuple[float, ...], first: Array, shear: Array, *, full: bool
) -> sp.bsr_array:
    """Return the matrix of a grid of elements, in blocks of 2 x 2 or 3 x 3.

    Parameters
    ----------
    spacing : tuple of float
    first, shear : ndarray, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
        Lame parameters lambda and mu of the elements.
    full : bool
        True to integrate changes of volume; False to evaluate them at the middle of an element.
    """
    axes, grid = first.ndim, tuple(size + 1 for size in first.shape)
    volume, shape = element_matrices(tuple(map(float, spacing)), full=full)
    # blocks[site, n] couples a site with its neighbour number n of the 3 x 3 sites around it.
    blocks = np.zeros((*grid, 3**axes, axes, axes))
    corners = corners_of(axes)
    for (here, corner), (there, other) in product(enumerate(corners), repeat=2):
        # No two elements have the same site at the same corner, so += adds all contributions.
        way = np.subtract(other, corner) + 1
        own = first[..., None, None] * volume[here, :, there]
        own += shear[..., None, None] * shape[here, :, there]
        blocks[sites_at(corner)][..., np.ravel_multi_index(way, (3,) * axes), :, :] += own
    number = np.pad(np.arange(np.prod(grid)).reshape(grid), 1, constant_values=-1)
    near = np.stack(
        [
            number[tuple(slice(i, i + size) for i, size in zip(way, grid, strict=True))]
            for way in product(range(3), repeat=axes)
        ],
        axis=-1,
    ).reshape(-1, 3**axes)
    is_site = near >= 0
    starts = np.concatenate([[0], np.cumsum(is_site.sum(axis=1))])
    blocks = blocks.reshape(*near.shape, axes, axes)[is_site]
    return sp.bsr_array((blocks, near[is_site], starts), shape=(axes * len(near),) * 2)


def block_matrix(problem: Problem, prior: ElasticPrior, *, locking: bool = False) -> sp.bsr_array:
    """Return the stiffness matrix of a problem's tissue, without data and constraints.

    With `locking`, changes of volume are integrated in plane strain and in volumes too.
    """
    full = locking or is_plane_stress(problem, prior)
    return grid_matrix(problem.spacing, *lame_parameters(problem, prior), full=full)


def stiffness_matrix(problem: Problem, prior: ElasticPrior) -> sp.csr_array:
    """Return the stiffness matrix of a problem's tissue; half of its form is the energy."""
    matrix = block_matrix(problem, prior).tocsr()
    matrix.eliminate_zeros()
    return matrix


def growth_of(problem: Problem) -> tuple[Array, Array]:
    """Return the growth strain of each element: the mean over its sites.

    Returns
    -------
    strain : ndarray, shape (H - 1, W - 1, 2, 2) or (D - 1, H - 1, W - 1, 3, 3)
        Growth along the axes of the grid.
    across : ndarray, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
        Growth perpendicular to an image; 0 in volumes.
    """
    axes, loads = problem.stiffness.ndim, problem.loads
    if loads is None or loads.growth is None:
        elements = tuple(size - 1 for size in problem.shape)
        return np.zeros((*elements, axes, axes)), np.zeros(elements)
    growth = loads.growth.astype(np.float64)
    if growth.ndim == axes:
        growth = growth[..., None, None] * np.eye(3)
    beyond = growth.shape[-1] - axes
    growth = at_corners(growth, axes).mean(axis=0)
    return growth[..., beyond:, beyond:], growth[..., 0, 0] if beyond else 0 * growth[..., 0, 0]


def load_vector(problem: Problem, prior: ElasticPrior) -> Array:
    """Return the forces of growth and the external forces of a problem, flattened."""
    total = growth_load(problem, prior, *lame_parameters(problem, prior))
    if problem.loads is not None and problem.loads.force is not None:
        total += problem.loads.force.ravel()
    return total


def growth_load(problem: Problem, prior: ElasticPrior, first: Array, shear: Array) -> Array:
    """Return the forces of growth of elements with given Lame parameters, flattened.

    The force of growth is that of the displacement of an element that has grown freely. In plane
    strain, growth perpendicular to the image presses on the slice.
    """
    axes, total = problem.stiffness.ndim, np.zeros(problem.observed.shape)
    if problem.loads is not None and problem.loads.growth is not None:
        strain, across = growth_of(problem)
        if is_plane_stress(problem, prior):
            across = 0 * across
        volume, shape = element_matrices(tuple(map(float, problem.spacing)), full=True)
        corners = np.array(corners_of(axes)) * problem.spacing
        moved = np.einsum("...kl,cl->...ck", strain, corners)
        # An expansion of 1 changes the volume as much as a growth of 1 perpendicular to the image.
        pressed = across[..., None, None] * corners / axes
        own = np.einsum("akcl,...cl->...ak", volume, first[..., None, None] * (moved + pressed))
        own += np.einsum("akcl,...cl->...ak", shape, shear[..., None, None] * moved)
        for number, corner in enumerate(corners_of(axes)):
            total[sites_at(corner)] += own[..., number, :]
    return total.ravel()


def factorise(matrix: Any) -> SuperLU:
    """Factorize a symmetric positive definite matrix in symmetric mode by minimum degree."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def by_superlu(matrix: Any, right: Array) -> Array:
    """Solve a symmetric positive definite system by SuperLU."""
    return np.asarray(factorise(matrix).solve(right))


@followed(lambda prior, *_: prior)
def direct_solution(
    problem: Problem,
    prior: ElasticPrior,
    *,
    locking: bool = False,
    force: npt.ArrayLike | None = None,
    held: Mask | None = None,
    solved: Solver = by_superlu,
) -> Array:
    """Return the field of least energy, with its loads and with rigid bodies.

    Parameters
    ----------
    problem : Problem
        Problem to solve. All components that are observed are prescribed exactly.
    prior : ElasticPrior
    locking : bool
        True to integrate changes of volume in plane strain and in volumes too.
    force : array_like, shape (H, W, 2) or (D, H, W, 3), optional
        Further forces, as in `Loads`, such as those of observations that slip.
    held : ndarray of bool, same shape, optional
        Mask of the prescribed components, if these are not all observed ones.
    solved : callable
        Function that solves a positive definite system from its matrix and right-hand side.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``.
    """
    matrix = block_matrix(problem, prior, locking=locking)
    held = (problem.known if held is None else held).ravel()
    field = np.where(held, problem.observed.ravel(), 0).astype(np.float64)
    basis, field = rigid_coordinates(
        bodies_of(problem, rigid_sites(problem.stiffness)), matrix.diagonal() > 0, held, field
    )
    right = load_vector(problem, prior) - matrix @ field
    if force is not None:
        right += np.ravel(force)
    if basis.shape[1]:
        field += basis @ solved((basis.T @ matrix.tocsr() @ basis).tocsc(), basis.T @ right)
    return field.reshape(problem.observed.shape)


def rigid_coordinates(
    bodies: Iterable[tuple[npt.NDArray[np.intp], Array]], moves: Mask, held: Mask, field: Array
) -> tuple[sp.csr_array, Array]:
    """Return P and b of all fields d = P v + b that move rigid bodies as such.

    Parameters
    ----------
    bodies : iterable of (ndarray of int, ndarray)
        Components of each rigid body, and their displacement in its rigid motions, as columns.
    moves : ndarray of bool, shape (n,)
        Mask of the components of elements that are not rigid.
    held : ndarray of bool, shape (n,)
        Mask of the prescribed components.
    field : ndarray, shape (n,)
        Displacement of the prescribed components; 0 elsewhere.
    """
    field = field.copy()
    alone, columns = ~held & moves, []
    for at, motions in bodies:
        alone[at] = False
        free, field[at] = free_motions(motions, held[at], field[at])
        rows, cols = np.broadcast_arrays(at[:, None], np.arange(free.shape[1]))
        entries = free.ravel(), (rows.ravel(), cols.ravel())
        columns.append(sp.csc_array(entries, shape=(field.size, free.shape[1])))
    columns.append(sp.eye_array(field.size, format="csc")[:, np.flatnonzero(alone)])
    return sp.hstack(columns, format="csr"), field


def rigid_sites(m: npt.NDArray[Any]) -> Mask:
    """Return a mask of the sites of all elements that have a rigid corner and no void corner."""
    axes = m.ndim
    corners = at_corners(m, axes)
    is_rigid = np.isinf(corners).any(axis=0) & (corners > 0).all(axis=0)
    sites = np.zeros(m.shape, dtype=bool)
    for corner in corners_of(axes):
        sites[sites_at(corner)] |= is_rigid
    return sites


def bodies_of(
    problem: Problem, rigid: Mask, start: int = 0
) -> Iterator[tuple[npt.NDArray[np.intp], Array]]:
    """Yield the components of each rigid body, and their displacement in its rigid motions.

    Adjacent sites of the mask `rigid` belong to the same body. The number of the first site of the
    field is `start`.
    """
    axes = rigid.ndim
    labels, count = ndimage.label(rigid, np.ones((3,) * axes))
    for number in range(1, count + 1):
        sites = np.argwhere(labels == number)
        first = axes * (start + np.ravel_multi_index(tuple(sites.T), rigid.shape))
        places = (sites - sites.mean(axis=0)) * problem.spacing / problem.unit
        yield (first[:, None] + np.arange(axes)).ravel(), rigid_motions(places)


def rigid_motions(places: Array) -> Array:
    """Return the displacement of places, (N, n), in each rigid motion, as columns of n N rows.

    Translations along each axis are followed by rotations in the plane of each pair of axes.
    """
    motions = [np.broadcast_to(step, places.shape) for step in np.eye(places.shape[1])]
    for i, j in combinations(range(places.shape[1]), 2):
        turn = np.zeros_like(places)
        turn[:, i], turn[:, j] = -places[:, j], places[:, i]
        motions.append(turn)
    return np.stack([motion.ravel() for motion in motions], axis=-1)


def free_motions(motions: Array, held: Mask, observed: Array) -> tuple[Array, Array]:
    """Return the rigid motions of a body that its prescribed components leave free, as columns.

    The second array is the rigid motion with the observed displacement of these components.
    """
    stops = motions[held]
    _, strength, modes = np.linalg.svd(stops, full_matrices=True)
    free = motions @ modes[(strength > _FREE).sum() :].T
    return free, motions @ np.linalg.lstsq(stops, observed[held])[0]


class System(NamedTuple):
    """Linear system of the free sites, in pixels and relative to the stiffest tissue.

    Attributes
    ----------
    matrix : bsr_array, blocks of 2 x 2 or 3 x 3
        Symmetric positive definite matrix. A prescribed component of a free site has only its
        diagonal entry.
    load : ndarray, shape (n * sites,)
        Right-hand side.
    free : ndarray, shape (H, W) or (D, H, W), bool
        Mask of the sites with an unknown component, in the order of the system.
    start : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Prescribed displacement in pixels; 0 elsewhere.
    """

    matrix: sp.bsr_array
    load: Array
    free: Mask
    start: Array

    def field(self, solution: Array) -> Array:
        """Return the displacement, in pixels, of a solution of the system."""
        field = self.start.copy()
        field[self.free] = solution.reshape(-1, field.shape[-1])
        return field


def assemble(problem: Problem, prior: ElasticPrior) -> System:
    """Assemble the system of tissue without rigid parts and loads, for other solvers.

    Boundaries are prescribed exactly where c > 0.
    """
    axes = problem.stiffness.ndim
    matrix = block_matrix(problem, prior)
    matrix.data /= _unit_of(problem)
    diagonal = matrix.diagonal().reshape(-1, axes)
    held = problem.known.reshape(-1, axes)
    start = np.where(held, problem.observed.reshape(-1, axes) / np.float64(problem.unit), 0.0)
    load = np.where(held, diagonal * start, -(matrix @ start.ravel()).reshape(-1, axes))
    free = (diagonal > 0).all(axis=1) & ~held.all(axis=1)
    rows, cols = np.repeat(np.arange(len(free)), np.diff(matrix.indptr)), matrix.indices
    inside = free[rows] & free[cols]
    rows, cols, blocks = rows[inside], cols[inside], matrix.data[inside]
    # A prescribed component of a free site is reduced to its diagonal entry.
    blocks *= ~held[rows][:, :, None] & ~held[cols][:, None, :]
    component, own = np.arange(axes), np.flatnonzero(rows == cols)
    blocks[own[:, None], component, component] = diagonal[free]
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(free))[free])])
    number = np.cumsum(free) - 1
    size = axes * int(free.sum())
    inner = sp.bsr_array((blocks, number[cols], starts), shape=(size, size))
    free_load = np.ascontiguousarray(load[free]).ravel()
    return System(
        inner, free_load, free.reshape(problem.shape), start.reshape(problem.observed.shape)
    )


def _unit_of(problem: Problem) -> float:
    """Return the unit of a system: the stiffness of the stiffest tissue, for pixels."""
    m = problem.stiffness
    stiffest = float(m.max(where=np.isfinite(m), initial=0.0))
    return stiffest * float(problem.unit) ** (m.ndim - 2)


def refined(
    problem: Problem,
    prior: ElasticPrior,
    system: System,
    factor: Callable[[Array], Array],
    solution: Array,
) -> Array:
    """Return the exact field in pixels, refined from a direct solution.

    The residual is computed from differences of the displacement within each element, in extended
    precision if available: at a contrast of 1e7, the matrix loses the forces of the soft part by
    rounding.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    system : System
        System of the problem and the prior.
    factor : callable
        Function that solves the system for another load.
    solution : ndarray
        Direct solution for the load of the system.

    Raises
    ------
    RuntimeError
        If the corrections do not decrease below `KNOWN`.
    """
    field = system.field(solution).astype(np.longdouble)
    held = problem.known[system.free].ravel()
    sizes: list[float] = []
    for _ in range(_MOST_CORRECTIONS):
        rest = -_pull(problem, prior, field)[system.free].ravel()
        rest[held] = 0
        correction = factor(rest.astype(np.float64))
        field[system.free] += correction.reshape(-1, field.shape[-1])
        sizes.append(float(np.abs(correction).max()))
        if sizes[-1] <= KNOWN:
            return field.astype(np.float64)
    raise RuntimeError(f"the reference stays {sizes[-1]:.2g} px from exact")


def exact_field(problem: Problem, prior: ElasticPrior) -> Array:
    """Return the field of least energy, in pixels, refined until it is exact."""
    system = assemble(problem, prior)
    factor = factorise(system.matrix)
    return refined(problem, prior, system, factor.solve, factor.solve(system.load))


def _pull(problem: Problem, prior: ElasticPrior, d: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the total force of the elements at each site, in the precision of `d`."""
    axes = problem.stiffness.ndim
    parts = element_matrices(
        tuple(map(float, problem.spacing)), full=is_plane_stress(problem, prior)
    )
    moduli = [each / _unit_of(problem) for each in lame_parameters(problem, prior)]
    # A translation exerts no force, so displacements are relative to the first corner.
    ways = at_corners(d, axes)
    ways = ways[1:] - ways[0]
    total = np.zeros_like(d)
    for here, corner in enumerate(corners_of(axes)):
        for modulus, part in zip(moduli, parts, strict=True):
            own = np.einsum("c...l,kcl->...k", ways, part[here, :, 1:].astype(d.dtype))
            total[sites_at(corner)] += modulus[..., None].astype(d.dtype) * own
    return total
