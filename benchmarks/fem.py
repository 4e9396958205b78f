"""Finite-element reference solution of the same problem by a textbook method.

The elements are bilinear quadrilaterals on the pixel grid: nodes are sites, and an element is a
2 x 2 block of tissue sites. Young's modulus is the mean over the four sites; plane stress and small
strain are assumed. scikit-fem assembles the system, and a direct solver solves it in float64.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad1, ElementVector, MeshQuad
from skfem.helpers import ddot, eye, sym_grad, trace

from napari_hmrf import Problem, fields

Float64Array = npt.NDArray[np.float64]


def plane_stress_displacement(problem: Problem, poisson: float = 0.3) -> Float64Array:
    """Solve for the displacement by finite elements.

    Parameters
    ----------
    problem : Problem
        Problem to solve. Every observed component with positive confidence in tissue is prescribed
        exactly.
    poisson : float
        Uniform Poisson's ratio, above -1 and below 1/2.

    Returns
    -------
    ndarray, shape (H, W, 2), float64
        Material displacement in (row, col) order, in the unit of ``problem.spacing``. Tissue that
        belongs to no element has its prescribed value, or 0.

    Raises
    ------
    ValueError
        If a connected part of the elements could move freely.
    """
    sites = np.arange(problem.stiffness.size).reshape(problem.shape)
    corners = np.stack(
        [sites[:-1, :-1], sites[1:, :-1], sites[1:, 1:], sites[:-1, 1:]]
    )  # shape (4, H - 1, W - 1), in order around each element
    exists = problem.tissue.ravel()[corners].all(axis=0)
    corners = corners[:, exists]
    prescribed = (problem.confidence > 0) & problem.tissue[..., None]
    displacement = np.where(prescribed, problem.observed.astype(np.float64), 0.0)
    if corners.size == 0:
        return displacement
    nodes, elements = np.unique(corners, return_inverse=True)
    elements = elements.reshape(corners.shape)
    places = np.argwhere(np.ones(problem.shape, dtype=bool))[nodes] * np.asarray(problem.spacing)
    basis, stiffness = _assembled(problem, poisson, corners, elements, places)
    values = np.zeros(basis.N)
    values[basis.nodal_dofs] = displacement.reshape(-1, 2)[nodes].T
    known = np.zeros(basis.N, dtype=bool)
    known[basis.nodal_dofs] = prescribed.reshape(-1, 2)[nodes].T
    _refuse_loose_parts(elements, known[basis.nodal_dofs], places)
    if not known.all():
        rows = stiffness.tocsr()[~known]
        load = -(rows[:, known] @ values[known])
        factor = splu(
            rows[:, ~known].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        values[~known] = factor.solve(load)
    displacement.reshape(-1, 2)[nodes] = values[basis.nodal_dofs].T
    return displacement


def plane_stress_matrix(problem: Problem, poisson: float = 0.3) -> Float64Array:
    """Return the dense matrix of a small problem without void, assembled by scikit-fem.

    Returns
    -------
    ndarray, shape (2 H W, 2 H W)
        Half of its quadratic form is the energy of a displacement, in the order of an array of
        shape (H, W, 2).
    """
    sites = np.arange(problem.stiffness.size).reshape(problem.shape)
    corners = np.stack([sites[:-1, :-1], sites[1:, :-1], sites[1:, 1:], sites[:-1, 1:]])
    corners = corners.reshape(4, -1)
    places = np.argwhere(np.ones(problem.shape, dtype=bool)) * np.asarray(problem.spacing)
    basis, stiffness = _assembled(problem, poisson, corners, corners, places)
    order = basis.nodal_dofs.T.ravel()
    return np.asarray(stiffness.toarray()[np.ix_(order, order)])


def _assembled(
    problem: Problem,
    poisson: float,
    corners: npt.NDArray[np.int64],
    elements: npt.NDArray[np.int64],
    places: Float64Array,
) -> tuple[Basis, scipy.sparse.csr_matrix]:
    """Return the basis and the matrix of elements with the given corners."""
    modulus = problem.stiffness.astype(np.float64).ravel()[corners].mean(axis=0)
    mesh = MeshQuad(places.T.copy(), elements, sort_t=False, validate=False)
    basis = Basis(mesh, ElementVector(ElementQuad1()), intorder=2)
    return basis, _stiffness_form(poisson).assemble(basis, modulus=modulus[:, None])


def _stiffness_form(poisson: float) -> BilinearForm:
    """Return the virtual work of plane stress, per unit of thickness."""
    if not -1 < poisson < 0.5:
        raise ValueError(f"poisson must be between -1 and 1/2, not {poisson!r}")

    @BilinearForm
    def virtual_work(u, v, w):  # type: ignore[no-untyped-def]
        strain = sym_grad(u)
        stress = (1 - poisson) * strain + poisson * eye(trace(strain), 2)
        return w.modulus / (1 - poisson**2) * ddot(stress, sym_grad(v))

    return virtual_work


def _refuse_loose_parts(
    elements: npt.NDArray[np.int64], known: npt.NDArray[np.bool_], places: Float64Array
) -> None:
    """Raise an error unless the prescribed components prevent rigid motion of every part."""
    number = len(places)
    first = np.repeat(elements[0], 3)
    graph = scipy.sparse.coo_matrix(
        (np.ones(first.size), (first, elements[1:].T.ravel())), shape=(number, number)
    )
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # The three rigid motions at the prescribed components; rank 3 means that all are prevented.
    row, col = (places - places.mean(axis=0)).T
    scale = max(np.ptp(row), np.ptp(col))
    one, none = np.ones(number), np.zeros(number)
    by_row = np.stack([one, none, -col / scale], axis=-1) * known[0][:, None]
    by_col = np.stack([none, one, row / scale], axis=-1) * known[1][:, None]
    products = np.einsum("ni,nj->nij", by_row, by_row) + np.einsum("ni,nj->nij", by_col, by_col)
    gram = np.zeros((parts, 3, 3))
    np.add.at(gram, part, products)
    loose = np.linalg.matrix_rank(gram, hermitian=True, tol=1e-10) < 3
    if loose.any():
        centre = places[part == np.argmax(loose)].mean(axis=0)
        raise ValueError(
            f"the tissue around {tuple(np.round(centre, 1))} could move freely: prescribe both "
            "components of at least one of its sites, and a component of another site"
        )


def rmsd(a: npt.ArrayLike, b: npt.ArrayLike, where: npt.ArrayLike, unit: float = 1.0) -> float:
    """Return the root mean square deviation of two displacements (eq. 20).

    Parameters
    ----------
    a, b : array_like, shape (H, W, 2)
        Displacements in the same unit of length.
    where : array_like of bool, shape (H, W)
        Mask of the sites to include, inside the body.
    unit : float
        Length of a pixel (`Problem.unit`), for a result in pixels.
    """
    return fields.rmsd(a, b, where) / unit
