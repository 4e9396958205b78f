"""Corrections that move sliding parts together in large motion, solved by factorizations.

Parts that have slid far along each other move together where they touch *now*. Such motions have
two corrections. The matrix of each is that of the linear model in its basis (Galerkin).

- At the contact, the basis consists of all components of the sites on which gaps depend.
- Everywhere, it consists of the displacements that are continuous in space: those interpolated on a
  coarse grid at the deformed position of each site.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.sparse_factors import SymmetricFactors
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.backends.planes import inside
from napari_hmrf.solver.contact import Contact

Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Matrix: TypeAlias = scipy.sparse.csr_array

#: Size of a coarse cell, in sites, and about the largest number of coarse nodes, for which cells
#: are larger.
_CELL, _MOST_NODES = 4.0, {2: 20_000, 3: 3_000}
#: Factor on the diagonal of the tissue, after which it bounds the matrix of the tissue.
_SAFE = 2.5
#: Shares of the diagonal that are added, one after the other, until a matrix is positive.
_SHIFTS = 1e-9, 0.03, 0.3, 3.0


class Elements(NamedTuple):
    """Some elements of a linear model.

    Attributes
    ----------
    places : ndarray of int, shape (n, c)
        Components of each element, in the order of a flattened displacement.
    matrices : ndarray, shape (n, c, c)
    """

    places: Indices
    matrices: Float64Array

    def assembled(self, size: int) -> Matrix:
        """Return the sum of the matrices, as a matrix of all components."""
        rows, columns = np.broadcast_arrays(self.places[:, :, None], self.places[:, None])
        entries = self.matrices.ravel(), (rows.ravel(), columns.ravel())
        return Matrix(scipy.sparse.coo_array(entries, shape=(size, size)))


class NearContact:
    """Correction of the sites in contact, with a diagonal matrix D in place of that of the tissue.

    With the rows G of the contact, ``(D + G^T G)^-1 = D^-1 - D^-1 G^T (1 + G D^-1 G^T)^-1 G D^-1``:
    the matrix that is factorized has one row for each pair.

    Parameters
    ----------
    rows : csr_array, shape (pairs, components)
        G, by the free components.
    diagonal : ndarray, shape (components,)
        Diagonal of the matrix of the tissue.
    """

    def __init__(self, rows: Matrix, diagonal: Float64Array) -> None:
        self._near = np.unique(rows.indices[rows.data != 0])
        self._inverse = 1 / (_SAFE * diagonal[self._near])
        self._rows = Matrix(rows[:, self._near])
        inner = (self._rows * self._inverse) @ self._rows.T
        self._factors = _factorized(inner + scipy.sparse.eye_array(inner.shape[0]))

    def correction(self, load: npt.NDArray[Any]) -> Planes:
        """Return the correction for a load, shape (axes, *grid), without border."""
        flat = np.moveaxis(load, 0, -1).ravel()[self._near] * self._inverse
        moved = np.zeros(load.size)
        pulls = self._rows.T @ self._factors.solve(self._rows @ flat)
        moved[self._near] = flat - self._inverse * pulls
        return np.moveaxis(moved.reshape(*load.shape[1:], len(load)), -1, 0)


class Everywhere:
    """Correction by the displacements that are continuous in the deformed image.

    Parameters
    ----------
    basis : csr_array, shape (components, size)
        Motion of each component, in the order of a flattened displacement, by each unknown.
    matrix : sparse array, shape (size, size)
        Matrix of the linear model in this basis.
    """

    def __init__(self, basis: Matrix, matrix: Any) -> None:
        self._basis, self._transposed = basis, Matrix(basis.T)
        self._factors = _factorized(matrix)

    def correction(self, load: npt.NDArray[Any]) -> Planes:
        """Return the correction for a load, shape (axes, *grid), without border."""
        flat = np.moveaxis(load, 0, -1).ravel().astype(np.float64)
        moved = self._basis @ self._factors.solve(self._transposed @ flat)
        return np.moveaxis(moved.reshape(*load.shape[1:], len(load)), -1, 0)


def corrections(
    positions: Float64Array, moves: HeldPlanes, tissue: Iterable[Elements], contact: Contact
) -> tuple[NearContact, Everywhere]:
    """Return the corrections at the contact and everywhere.

    Parameters
    ----------
    positions : ndarray, shape (axes, *unfolded grid)
        Deformed position of each site, in sites.
    moves : ndarray of bool, planes
        Mask of the free components.
    tissue : iterable of Elements
        All elements of the tissue, including the tensors of the contact.
    contact : Contact
    """
    free = np.moveaxis(inside(moves), 0, -1)
    basis, lumped = _continuous(positions, free), contact.lumped()
    rows = Matrix(contact.rows() @ scipy.sparse.diags_array(free.ravel().astype(np.float64)))
    gaps, across = rows @ basis, Matrix(basis.T)
    inner, diagonal = gaps.T @ gaps - across @ (lumped @ basis), -lumped.diagonal()
    for some in tissue:
        compute_thread.check_cancelled()
        matrix = some.assembled(free.size)
        inner = inner + across @ (matrix @ basis)
        diagonal += matrix.diagonal()
    return NearContact(rows, diagonal), Everywhere(basis, inner)


def _continuous(positions: Float64Array, free: npt.NDArray[np.bool_]) -> Matrix:
    """Return the displacements that are interpolated on a coarse grid in space."""
    axes = len(positions)
    sites = np.flatnonzero(free.any(axis=-1))
    at = positions.reshape(axes, -1)[:, sites].T
    low, size = at.min(axis=0), np.ptp(at, axis=0)
    nodes = math.prod(size / _CELL + 1)
    cell = _CELL * max(1.0, (nodes / _MOST_NODES[axes]) ** (1 / axes))
    grid = tuple(int(count) + 2 for count in size / cell)
    at = (at - low) / cell
    ends = np.array(list(np.ndindex(*(2,) * axes)))
    cells = np.floor(at).astype(np.intp)
    shares = np.where(ends, (at - cells)[:, None], 1 - (at - cells)[:, None]).prod(axis=-1)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(cells[:, None] + ends, -1, 0)), grid)
    rows = sites[:, None, None] * axes + np.arange(axes)
    columns = numbers[:, :, None] * axes + np.arange(axes)
    rows, columns = np.broadcast_arrays(rows, columns)
    values = shares[:, :, None] * free.reshape(-1, axes)[sites][:, None]
    shape = (free.size, math.prod(grid) * axes)
    basis = scipy.sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
    used = np.flatnonzero(abs(basis).sum(axis=0) > 0)
    return scipy.sparse.csr_array(basis[:, used])


def _factorized(matrix: Any) -> SymmetricFactors:
    """Return the factorization of a matrix, which is made positive if it is not.

    Raises
    ------
    Singular
        If the matrix contains numbers that are not finite.
    """
    diagonal = np.abs(matrix.diagonal())
    diagonal[diagonal == 0] = 1.0
    for shift in _SHIFTS:
        with suppress(Singular):
            shifted = matrix + scipy.sparse.diags_array(shift * diagonal)
            factors = SymmetricFactors(shifted, "MMD_AT_PLUS_A")
            if (factors.pivots() > 0).all():
                return factors
    return SymmetricFactors(scipy.sparse.diags_array(diagonal))
