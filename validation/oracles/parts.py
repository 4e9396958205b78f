"""Cavities and sliding parts: forces of contents, and a dense system in double precision.

scikit-fem integrates the matrix of one element. Loops over elements, faces and pairs of sites,
which share no code with the package, add elements, weight, cavity loads and the coupling of parts.
Only the fitted normals of an interface are taken from the package.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy.linalg

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.solver.interface_normals import interface_normals
from validation.oracles.elasticity import element_matrices

if TYPE_CHECKING:
    from validation.problems import Contents

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Sites = npt.NDArray[np.intp]

#: Least eigenvalue, of the matrix with a diagonal of 1, up to which it yields no correct digits.
UNRESOLVED = 1e-13


def _lame(young: float, nu: float, bulges: bool) -> tuple[float, float]:
    """Return the first Lame parameter, in plane stress its plane counterpart, and the shear."""
    shear = young / (2 * (1 + nu))
    if bulges:
        return young * nu / (1 - nu**2), shear
    return young * nu / ((1 + nu) * (1 - 2 * nu)), shear


def forces_of(contents: Contents, m: npt.NDArray[Any], spacing: tuple[float, ...]) -> Array:
    """Return the force of weight and of the contents of a cavity at each site.

    The surface of the cavity consists of the faces between elements of tissue and elements with a
    removed corner. The pressure is interpolated between the corners, and two Gauss points along
    each axis integrate its product with the shape functions.
    """
    grid, axes = m.shape, m.ndim
    force = np.zeros((*grid, axes))
    size = np.array(spacing)
    corners = list(itertools.product((0, 1), repeat=axes))
    tissue = m > 0
    elements = list(itertools.product(*(range(side - 1) for side in grid)))
    remains, gone = {}, {}
    for at in elements:
        sites = [tuple(np.add(at, corner)) for corner in corners]
        hole = [bool(contents.removed[site]) for site in sites]
        body = [bool(tissue[site]) for site in sites]
        remains[at] = all(body)
        gone[at] = any(hole) and all(a or b for a, b in zip(hole, body, strict=True))
        if remains[at]:
            for site in sites:
                force[site] += contents.gravity * size.prod() / 2**axes
    faces = []
    for at in elements:
        for axis, side in itertools.product(range(axes), (0, 1)):
            beside = list(at)
            beside[axis] += 2 * side - 1
            if remains[at] and gone.get(tuple(beside), False):
                ends = [corner for corner in corners if corner[axis] == side]
                faces.append((axis, 1 - 2 * side, [tuple(np.add(at, end)) for end in ends]))
    if not faces:
        return force
    down = contents.gravity / np.linalg.norm(contents.gravity)
    heights = {site: -float(down @ (site * size)) for *_, sites in faces for site in sites}
    low, high = min(heights.values()), max(heights.values())
    surface = low + contents.level * (high - low)
    gauss = [0.5 - 12**-0.5, 0.5 + 12**-0.5]
    for axis, inwards, sites in faces:
        presses = [
            contents.pressure + contents.fluid * max(0.0, surface - heights[at]) for at in sites
        ]
        area = size.prod() / size[axis]
        ends = list(itertools.product((0, 1), repeat=axes - 1))
        for point in itertools.product(gauss, repeat=axes - 1):
            shares = [
                math.prod(x if end else 1 - x for x, end in zip(point, corner, strict=True))
                for corner in ends
            ]
            there = sum(share * p for share, p in zip(shares, presses, strict=True))
            for site, share in zip(sites, shares, strict=True):
                force[(*site, axis)] += inwards * there * share * area / 2 ** (axes - 1)
    return force


def dense_solution(
    problem: Problem, prior: ElasticPrior, force: Array | None, tilt: float = 0.0, number: int = 0
) -> tuple[Array, float]:
    """Return the field of a dense system and its least eigenvalue, for a diagonal of 1.

    Parameters
    ----------
    problem : Problem
        Problem whose observations, all in or beside elements, are prescribed.
    prior : ElasticPrior
    force : ndarray, shape (H, W, 2) or (D, H, W, 3), optional
        Force at each site, in place of the loads of the problem.
    tilt : float
        Standard deviation of a random tilt of the normals of interfaces, in degrees.
    number : int
        Seed of the tilt.

    Returns
    -------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement in pixels; nan if the system cannot be solved in double precision.
    least : float
    """
    m, axes = problem.stiffness.astype(np.float64), problem.stiffness.ndim
    grid, tissue, held = m.shape, m > 0, problem.known
    sites = np.arange(m.size).reshape(grid)
    corners = np.array(list(itertools.product((0, 1), repeat=axes)))
    firsts = np.argwhere(np.ones([side - 1 for side in grid], np.bool_))
    around = sites[tuple(np.moveaxis(firsts[:, None] + corners, -1, 0))]
    around = around[tissue.ravel()[around].all(axis=1)]
    labels = np.zeros(grid, np.int32) if problem.sliding is None else problem.sliding.labels
    parts = np.unique(labels[tissue])
    owner = np.full(m.size, -1)
    for part, label in enumerate(parts):
        owner[(tissue & (labels == label)).ravel()] = part
    full = axes == 2 and prior.plane == "stress"
    volume, shear = (
        each.reshape(axes * 2**axes, -1) for each in element_matrices(problem.spacing, full=full)
    )
    node = np.full((len(parts), m.size), -1)
    for part in range(len(parts)):
        for element in around:
            if (owner[element] == part).any():
                node[part, element] = 0
    node[node == 0] = np.arange(np.count_nonzero(node == 0))
    size = axes * (int(node.max()) + 1)
    matrix, load = np.zeros((size, size)), np.zeros(size)
    nu = np.broadcast_to(np.asarray(prior.poisson, np.float64), grid)
    for part in range(len(parts)):
        ratios = _extended(nu, (owner == part).reshape(grid))
        for element in around:
            own = owner[element] == part
            if own.any():
                young = float(m.ravel()[element][own].sum() / len(element))
                both = _lame(young, float(ratios[element].mean()), full)
                dofs = (axes * node[part, element][:, None] + np.arange(axes)).ravel()
                matrix[np.ix_(dofs, dofs)] += both[0] * volume + both[1] * shear
    for first, second, normal, strength in _pairs(problem, owner.reshape(grid), node, tilt, number):
        dofs = np.concatenate([axes * first + np.arange(axes), axes * second + np.arange(axes)])
        gap = np.concatenate([normal, -normal])
        matrix[np.ix_(dofs, dofs)] += strength * np.outer(gap, gap)
    fixed, values = np.zeros(size, np.bool_), np.zeros(size)
    at = np.flatnonzero(owner >= 0)
    at = at[node[owner[at], at] >= 0]
    mine = axes * node[owner[at], at][:, None] + np.arange(axes)
    if force is not None:
        load[mine] = force.reshape(-1, axes)[at]
    fixed[mine] = held.reshape(-1, axes)[at]
    given = problem.observed.astype(np.float64).reshape(-1, axes)
    values[mine] = np.where(fixed[mine], given[at], 0.0)
    free = ~fixed
    right = (load - matrix @ values)[free]
    inner = matrix[np.ix_(free, free)]
    least = 1.0
    if len(inner):
        root = np.sqrt(np.diag(inner))
        inner = inner / root[:, None] / root
        least = float(scipy.linalg.eigvalsh(inner, subset_by_index=[0, 0])[0])
        if not right.any():
            values[free] = 0.0  # nothing drives the tissue, even if nothing holds it
        elif least > UNRESOLVED:
            values[free] = np.linalg.solve(inner, right / root) / root
        else:
            values[free] = np.nan
    field = np.where(held.reshape(-1, axes), given, 0.0)
    field[at] = values[mine]
    return field.reshape(problem.observed.shape) / problem.unit, least


def _extended(values: Array, own: Flags) -> Array:
    """Return values of a part's sites, flattened; other sites have the mean of those around."""
    found = np.where(own, values, 0.0)
    for at in np.argwhere(~own):
        near = tuple(slice(max(i - 1, 0), i + 2) for i in at)
        if own[near].any():
            found[tuple(at)] = values[near][own[near]].mean()
    return found.ravel()


def _pairs(
    problem: Problem, owner: Sites, node: Sites, tilt: float, number: int
) -> list[tuple[int, int, Array, float]]:
    """Return the two nodes, the normal and the strength of each connection between parts."""
    axes, m = problem.stiffness.ndim, problem.stiffness.astype(np.float64)
    dice = np.random.default_rng(number)
    found = []
    for one, two in itertools.combinations(range(len(node)), 2):
        at, pairs, strengths = [], [], []
        for copied, home in ((one, two), (two, one)):
            for site in np.argwhere(owner == home):
                flat = int(np.ravel_multi_index(tuple(site), owner.shape))
                if node[copied, flat] < 0:
                    continue
                near = tuple(slice(max(i - 1, 0), i + 2) for i in site)
                soft = min(float(m[near][owner[near] == part].max()) for part in (one, two))
                at.append(site)
                pairs.append((int(node[home, flat]), int(node[copied, flat])))
                strengths.append(100.0 * soft * problem.unit ** (axes - 2))
        if at:
            normals = interface_normals(owner == one, owner == two, np.array(at), problem.spacing)
            normals = normals + math.radians(tilt) * dice.normal(size=normals.shape)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            for pair, normal, strength in zip(pairs, normals, strengths, strict=True):
                found.append((*pair, normal, strength))
    return found
