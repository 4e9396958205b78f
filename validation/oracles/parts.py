"""Cavities and sliding parts: forces of contents, and fields of parts by direct solutions.

Each part has a displacement of its own at all sites. An element with sites of several parts exists
once in the field of each, with the share of the stiffness of its own sites. `elasticity` adds the
elements of a part. Loops over faces and pairs of sites, which share no code with the package, add
weight, cavity loads and the coupling of parts. Only the fitted normals of an interface are taken
from the package.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.loads import Loads
from napari_hmrf.solver.interface_normals import interface_surface
from napari_hmrf.solver.problem import variant_of
from validation.oracles.elasticity import (
    at_corners,
    bodies_of,
    grid_matrix,
    growth_load,
    is_plane_stress,
    lame_of,
    rigid_coordinates,
    rigid_sites,
)
from validation.oracles.posterior import affine_motions, interpolation, with_data

if TYPE_CHECKING:
    from napari_hmrf.tissue.cavity import Cavity
    from validation.problems import Contents

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Sites = npt.NDArray[np.intp]

#: Least eigenvalue, of the matrix with a diagonal of 1, up to which it yields no correct digits.
UNRESOLVED = 1e-13


def pressure_of(contents: Contents | Cavity, heights: Array, surface: Array) -> Array:
    """Return the pressure of the contents of a cavity at some heights.

    The fluid fills the cavity, whose surface has the heights `surface`, up to its level.
    """
    low, high = surface.min(), surface.max()
    top = low + contents.level * (high - low)
    return np.asarray(contents.pressure + contents.fluid * np.maximum(0.0, top - heights))


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
    known = np.array(list(heights.values()))
    presses_at = dict(zip(heights, pressure_of(contents, known, known), strict=True))
    gauss = [0.5 - 12**-0.5, 0.5 + 12**-0.5]
    for axis, inwards, sites in faces:
        presses = [presses_at[at] for at in sites]
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


class Parts(NamedTuple):
    """Linear system of the fields of all parts.

    Attributes
    ----------
    matrix : csr_array, shape (unknowns, unknowns)
    right : ndarray, shape (unknowns,)
    basis : csr_array, shape (n, unknowns)
        Motion of the components of the fields, which are stored one after the other, by each
        unknown: a free component, a free rigid motion of a body, or a strain of the drift.
    start : ndarray, shape (n,)
        Displacement if all unknowns are 0.
    own : csr_array, shape (n, components of the image)
        1 for each component of the image in the field of the part that owns its site.
    problem : Problem
    """

    matrix: sp.csr_array
    right: Array
    basis: sp.csr_array
    start: Array
    own: sp.csr_array
    problem: Problem

    def image(self, solution: Array) -> Array:
        """Return the displacement of the image from the unknowns; 0 in void."""
        fields = self.start + self.basis @ solution
        return np.asarray(self.own.T @ fields).reshape(self.problem.observed.shape)


def assembled(
    problem: Problem, prior: ElasticPrior, force: Array | None, tilt: float, number: int
) -> Parts:
    """Return the system of all parts, without observations that may slip.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    force : ndarray, shape (H, W, 2) or (D, H, W, 3), or None
        Force at each site, in place of the forces of the problem.
    tilt : float
        Standard deviation of a random tilt of the normals of interfaces, in degrees.
    number : int
        Seed of the tilt.
    """
    m, axes = problem.stiffness.astype(np.float64), problem.stiffness.ndim
    labels = np.zeros(m.shape, np.int32) if problem.sliding is None else problem.sliding.labels
    owner = np.full(m.shape, -1)
    owner[m > 0] = np.unique(labels[m > 0], return_inverse=True)[1]
    count = int(owner.max()) + 1
    blocks, loads, bodies = zip(
        *(_elements(problem, prior, owner, part) for part in range(count)), strict=True
    )
    elastic = sp.block_diag(blocks, format="csr")
    moves = (elastic.diagonal() > 0) | np.repeat(np.ravel(bodies), axes)
    at = np.flatnonzero(owner >= 0)
    place = (owner.flat[at] * m.size + at)[:, None] * axes + np.arange(axes)
    component = at[:, None] * axes + np.arange(axes)
    own = sp.csr_array(
        (np.ones(place.size), (place.ravel(), component.ravel())),
        shape=(count * m.size * axes, m.size * axes),
    )
    if force is None and problem.loads is not None:
        force = problem.loads.force
    push = np.zeros(problem.observed.size) if force is None else np.ravel(force).astype(np.float64)
    only_precision = variant_of(problem, landmarks=None)
    data, push = with_data(only_precision, sp.csr_array((push.size, push.size)), push)
    in_elements = moves.reshape(count, *m.shape, axes)[..., 0]
    gaps, strength = _gaps(problem, owner, in_elements, tilt, number)
    added, pushed = own @ data @ own.T + gaps.T @ sp.diags_array(strength) @ gaps, own @ push
    if problem.landmarks is not None:
        marks = problem.landmarks
        weights = marks.scale.energy(problem.stiffness, problem.spacing) / marks.sd.ravel() ** 2
        at_points = _at_points(marks.points, owner, count)
        added = added + at_points.T @ sp.diags_array(weights) @ at_points
        pushed = pushed + at_points.T @ (weights * marks.displacement(problem.spacing).ravel())
    fixed = prescribed(problem, prior)
    held = own @ fixed.ravel().astype(np.float64) > 0
    start = own @ np.where(fixed, problem.observed, 0.0).ravel()
    of_parts = (bodies_of(problem, rigid, part * m.size) for part, rigid in enumerate(bodies))
    basis, start = rigid_coordinates(itertools.chain(*of_parts), moves, held, start)
    grown = np.concatenate(loads)
    matrix = basis.T @ (elastic + added) @ basis
    right = basis.T @ (grown + pushed - (elastic + added) @ start)
    if problem.landmarks is not None and problem.landmarks.drift:
        # The elastic energy is that of the displacement less the affine motion of the drift.
        affine = np.tile(affine_motions(problem), (count, 1))
        beside, own_part = basis.T @ (elastic @ affine), affine.T @ (elastic @ affine)
        blocks = [[matrix, sp.csr_array(-beside)], [sp.csr_array(-beside.T), own_part]]
        matrix = sp.block_array(blocks, format="csr")
        right = np.concatenate([right, affine.T @ (elastic @ start - grown)])
        basis = sp.hstack([basis, sp.csr_array(affine.shape)], format="csr")
    return Parts(sp.csr_array(matrix), right, sp.csr_array(basis), start, own, problem)


def prescribed(problem: Problem, prior: ElasticPrior) -> Flags:
    """Return the mask of the observed components that cannot slip."""
    limit = prior.limit(problem)
    return problem.known if limit is None else problem.known & np.isinf(limit)


def _at_points(points: Array, owner: Sites, count: int) -> sp.csr_array:
    """Return the matrix that interpolates each point in the field of the part at its nearest site.

    Points halfway between two sites belong to the first.
    """
    of_image = interpolation(points, owner.shape)
    nearest = np.ceil(points - 0.5).astype(int)
    parts = owner[tuple(nearest.T)]
    axes = owner.ndim
    made = of_image.tocoo()
    columns = made.col + parts[made.row // axes] * owner.size * axes
    return sp.csr_array(
        (made.data, (made.row, columns)), shape=(len(points) * axes, count * owner.size * axes)
    )


def _elements(
    problem: Problem, prior: ElasticPrior, owner: Sites, part: int
) -> tuple[sp.bsr_array, Array, Flags]:
    """Return matrix and forces of growth of a part's elements, and a mask of its rigid sites."""
    m, own = problem.stiffness.astype(np.float64), owner == part
    axes, full = m.ndim, is_plane_stress(problem, prior)
    exist = at_corners(owner >= 0, axes).all(axis=0)
    rigid = rigid_sites(np.where(own, m, np.where(owner >= 0, 1.0, 0.0)))
    young = np.where(exist, at_corners(np.where(own, m, 0.0), axes).mean(axis=0), 0.0)
    young[np.isinf(young)] = 0
    nu = np.broadcast_to(np.asarray(prior.poisson, np.float64), m.shape)
    ratio = at_corners(_extended(nu, own & np.isfinite(m)), axes).mean(axis=0)
    lame = lame_of(young, ratio, bulges=full)
    if problem.loads is not None and problem.loads.growth is not None:
        grown = _extended(problem.loads.growth, own & np.isfinite(m))
        problem = variant_of(problem, loads=Loads(growth=grown))
    matrix = grid_matrix(problem.spacing, *lame, full=full)
    return matrix, growth_load(problem, prior, *lame), rigid


def sliding_field(problem: Problem, prior: ElasticPrior) -> Array:
    """Return the field of least energy of a problem with sliding parts, by sparse algebra.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``; 0 in void.
    """
    system = assembled(problem, prior, None, 0.0, 0)
    return system.image(spl.spsolve(system.matrix.tocsc(), system.right))


def dense_solution(
    problem: Problem, prior: ElasticPrior, force: Array | None
) -> tuple[Array, float]:
    """Return the field of a small problem, and the least eigenvalue for a diagonal of 1.

    Parameters
    ----------
    problem : Problem
        Problem whose observations, all in or beside elements, are prescribed.
    prior : ElasticPrior
    force : ndarray, shape (H, W, 2) or (D, H, W, 3), or None
        Force at each site, in place of the forces of the problem.

    Returns
    -------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``; nan if the system cannot be solved in
        double precision.
    least : float
    """
    system = assembled(problem, prior, force, 0.0, 0)
    if not len(system.right):
        return system.image(system.right), 1.0
    inner = system.matrix.toarray()
    root = np.sqrt(np.diag(inner))
    inner = inner / root[:, None] / root
    least = float(scipy.linalg.eigvalsh(inner, subset_by_index=[0, 0])[0])
    if not system.right.any():
        solution = 0 * system.right  # nothing drives the tissue, even if nothing holds it
    elif least > UNRESOLVED:
        solution = np.linalg.solve(inner, system.right / root) / root
    else:
        solution = np.full(len(root), np.nan)
    return system.image(solution), least


def _extended(values: npt.NDArray[Any], own: Flags) -> Array:
    """Return values of a part's sites; other sites have the mean of those around."""
    found = np.zeros(values.shape)
    found[own] = values[own]
    for at in np.argwhere(~own):
        near = tuple(slice(max(i - 1, 0), i + 2) for i in at)
        if own[near].any():
            found[tuple(at)] = values[near][own[near]].mean(axis=0)
    return found


def _gaps(
    problem: Problem, owner: Sites, in_elements: Flags, tilt: float, number: int
) -> tuple[sp.csr_array, Array]:
    """Return the gap of each connection between parts along its normal, and its strength.

    Parameters
    ----------
    problem : Problem
    owner : ndarray of int, shape (H, W) or (D, H, W)
        Number of the part of each site; -1 in void.
    in_elements : ndarray of bool, shape (parts, H, W) or (parts, D, H, W)
        Mask of the sites of the elements of each part.
    tilt, number : float, int
        As for `assembled`.

    Returns
    -------
    gaps : csr_array, shape (connections, components of all fields)
    strength : ndarray, shape (connections,)
    """
    axes, m = owner.ndim, problem.stiffness.astype(np.float64)
    relative = 0.0 if problem.sliding is None else problem.sliding.strength
    stiffest = float(m.max(where=np.isfinite(m), initial=0.0)) or 1.0
    dice = np.random.default_rng(number)
    pairs, ways, strengths = [], [], []
    for one, two in itertools.combinations(range(len(in_elements)), 2):
        at = []
        for copied, home in ((one, two), (two, one)):
            for site in np.argwhere((owner == home) & in_elements[copied]):
                flat = int(np.ravel_multi_index(tuple(site), owner.shape))
                near = tuple(slice(max(i - 1, 0), i + 2) for i in site)
                soft = min(float(m[near][owner[near] == part].max()) for part in (one, two))
                soft = min(soft, stiffest)  # between two rigid bodies
                at.append(site)
                pairs.append((home * owner.size + flat, copied * owner.size + flat))
                strengths.append(relative * soft * problem.unit ** (axes - 2))
        if at:
            at_sites = np.array(at)
            normals, _ = interface_surface(owner == one, owner == two, at_sites, problem.spacing)
            normals = normals + math.radians(tilt) * dice.normal(size=normals.shape)
            ways.append(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    shape = (len(pairs), in_elements.size * axes)
    if not pairs:
        return sp.csr_array(shape), np.zeros(0)
    columns = (axes * np.array(pairs)[..., None] + np.arange(axes)).ravel()
    normals = np.concatenate(ways)
    entries = np.stack([normals, -normals], axis=1).ravel()
    rows = np.repeat(np.arange(len(pairs)), 2 * axes)
    return sp.csr_array((entries, (rows, columns)), shape=shape), np.array(strengths)
