"""Reference solutions of elastic volumes by third-party finite elements and a direct solve."""

import subprocess

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import skfem
from scipy import ndimage
from skfem.helpers import ddot, div, sym_grad

from napari_hmrf import ElasticPrior
from validation.oracles.followed import followed

MIDDLE = np.full((3, 1), 0.5), np.ones(1)


@skfem.BilinearForm
def change_of_volume(u, v, w):
    return w.modulus * div(u) * div(v)


@skfem.BilinearForm
def change_of_shape(u, v, w):
    return 2 * w.modulus * ddot(sym_grad(u), sym_grad(v))


def assembled(spacing, first, shear, locking=False):
    """Return the stiffness matrix of elements, ordered by site and component.

    Changes of volume are evaluated at the middle of an element, or everywhere if `locking`.
    """
    grid = tuple(size + 1 for size in first.shape)
    mesh = skfem.MeshHex.init_tensor(
        *(np.arange(size) * step for size, step in zip(grid, spacing, strict=True))
    )
    kind = skfem.ElementVector(skfem.ElementHex1())
    steps = np.array(spacing)[:, None]
    element = tuple(np.floor(mesh.p[:, mesh.t].mean(axis=1) / steps).astype(int))
    full = skfem.Basis(mesh, kind, intorder=3)  # exact for bricks
    reduced = full if locking else skfem.Basis(mesh, kind, quadrature=MIDDLE)
    total = sp.csr_matrix((full.N, full.N))
    pairs = (change_of_volume, reduced, first), (change_of_shape, full, shear)
    for form, basis, modulus in pairs:
        at_points = np.repeat(modulus[element][:, None], basis.X.shape[1], axis=1)
        total = total + form.assemble(basis, modulus=at_points)
    component = np.empty(full.N, dtype=int)
    for along in range(3):
        component[full.nodal_dofs[along]] = along
    site = np.rint(full.doflocs / steps).astype(int)
    number = np.ravel_multi_index((*site, component), (*grid, 3))
    matrix = total.tocoo()
    places = number[matrix.row], number[matrix.col]
    return sp.csr_matrix((matrix.data, places), shape=matrix.shape)


def by_superlu(matrix, right):
    """Solve a symmetric system by SuperLU."""
    return spl.spsolve(matrix, right, permc_spec="MMD_AT_PLUS_A")


@followed(lambda poisson, *_: ElasticPrior(poisson))
def direct_solution(problem, poisson, locking=False, load=None, held=None, solved=by_superlu):
    """Return the field of least energy, in the unit of the problem.

    Boundaries are prescribed exactly, and rigid tissue moves as rigid bodies. For observations that
    slip, `load` contains the forces, in units of the energy's derivative with respect to voxels,
    and `held` is the mask of prescribed components. `solved` solves a positive definite system.
    """
    first, shear = parameters(problem, poisson)
    matrix = assembled(problem.spacing, first, shear, locking)
    held = (problem.known if held is None else held).ravel()
    field = np.where(held, problem.observed.ravel(), 0).astype(float)
    ways = [motions_of(problem, sites) for sites in rigid_bodies(problem.stiffness)]
    in_body = np.zeros(field.size, dtype=bool)
    columns = []
    for at, motions in ways:
        in_body[at] = True
        stops = motions[held[at]]
        shares = np.linalg.lstsq(stops, field[at[held[at]]])[0]
        field[at] = motions @ shares
        _, strength, modes = np.linalg.svd(stops, full_matrices=True)
        free = modes[(strength > 1e-9).sum() :].T
        columns.append(sp.csc_matrix(_placed(motions @ free, at, field.size)))
    alone = ~held & ~in_body & (matrix.diagonal() > 0)
    columns.append(sp.eye(field.size, format="csc")[:, alone])
    basis = sp.hstack(columns, format="csc")
    right = -(matrix @ field)
    if load is not None:
        right += load.ravel() * problem.unit**2
    reduced = (basis.T @ matrix @ basis).tocsc()
    field += basis @ solved(reduced, basis.T @ right)
    return field.reshape(*problem.shape, 3)


def rigid_bodies(m):
    """Return the sites of each connected group of elements with an infinitely stiff corner."""
    sites = np.zeros(m.shape, dtype=bool)
    for at in np.argwhere(np.isinf(m)):
        for element in np.ndindex(2, 2, 2):
            begin = at - element
            block = tuple(slice(index, index + 2) for index in begin)
            if (begin >= 0).all() and m[block].shape == (2, 2, 2) and m[block].min() > 0:
                sites[block] = True
    labels, count = ndimage.label(sites, np.ones((3, 3, 3)))
    return [np.argwhere(labels == number) for number in range(1, count + 1)]


def motions_of(problem, sites):
    """Return the components of a body, and their displacement in its six rigid motions."""
    flat = np.ravel_multi_index(sites.T, problem.shape)
    places = (sites - sites.mean(axis=0)) * problem.spacing / problem.unit
    moves = [np.broadcast_to(axis, places.shape) for axis in np.eye(3)]
    turns = [np.cross(axis, places) for axis in np.eye(3)]
    motions = np.stack([each.ravel() for each in (*moves, *turns)], axis=-1)
    return (3 * flat[:, None] + np.arange(3)).ravel(), motions


def _placed(values, at, size):
    whole = np.zeros((size, values.shape[1]))
    whole[at] = values
    return whole


def parameters(problem, poisson):
    """Return Lame's parameters of each element from corner means; 0 if one is void or rigid."""
    corners = [slice(None, -1), slice(1, None)]

    def eight(values):
        values = np.broadcast_to(values, problem.shape).astype(float)
        return np.stack([values[a, b, c] for a in corners for b in corners for c in corners])

    corner = eight(problem.stiffness)
    elastic = (corner.min(axis=0) > 0) & (corner.max(axis=0) < np.inf)
    young = np.where(elastic, corner.mean(axis=0), 0)
    nu = eight(poisson).mean(axis=0)
    return young * nu / ((1 + nu) * (1 - 2 * nu)), young / (2 * (1 + nu))


def calculix_solution(problem, poisson, folder):
    """Return the field of CalculiX with fully integrated bricks (C3D8), as another reference."""
    sites = np.moveaxis(np.indices(problem.shape), 0, -1).reshape(-1, 3)
    number = 1 + np.arange(len(sites)).reshape(problem.shape)
    around = [(*face, level) for level in (0, 1) for face in ((0, 0), (1, 0), (1, 1), (0, 1))]
    _, shear = parameters(problem, poisson)
    lines = ["*NODE, NSET=ALL"]
    for node, place in zip(number.flat, sites * problem.spacing, strict=True):
        lines.append(f"{node}, {', '.join(f'{x:.12g}' for x in place)}")
    for index, at in enumerate(np.ndindex(shear.shape), start=1):
        corners = (number[tuple(np.add(at, corner))] for corner in around)
        young = 2 * (1 + poisson) * shear[at]
        lines += [f"*ELEMENT, TYPE=C3D8, ELSET=E{index}"]
        lines += [f"{index}, {', '.join(map(str, corners))}"]
        lines += [f"*MATERIAL, NAME=M{index}", "*ELASTIC", f"{young:.12g}, {poisson:.12g}"]
        lines += [f"*SOLID SECTION, ELSET=E{index}, MATERIAL=M{index}"]
    lines += ["*STEP", "*STATIC", "*BOUNDARY"]
    for *at, along in np.argwhere(problem.known):
        node, y = number[tuple(at)], problem.observed[(*at, along)]
        lines.append(f"{node}, {along + 1}, {along + 1}, {y:.12g}")
    lines += ["*NODE PRINT, NSET=ALL", "U", "*END STEP", ""]
    (folder / "job.inp").write_text("\n".join(lines), encoding="ascii")
    subprocess.run(["ccx", "job"], cwd=folder, check=True, capture_output=True)
    table = (folder / "job.dat").read_text(encoding="ascii").splitlines()[3:]
    return np.loadtxt(table)[:, 1:].reshape(*problem.shape, 3)
