"""Parts that slide along each other: two fields beside a layer that is soft in shear.

    python -m benchmarks.sliding_interfaces [rivals] [spheres] [cycles] [normals] [errors]

`rivals` moves blocks along tilted planes and up a wedge, and turns a disc in a ring; the exact
motion is rigid on both sides. It prints the slip as a fraction of the exact slip, the gap along the
normal and the kink of two rivals: one field for each part, and a layer of elements between the
parts that transmits only forces along the normal. `spheres` turns a ball in a shell. `cycles`
compares the numbers of cycles and the times with those of connected tissue, in images and volumes.
`normals` prints the errors of normals that are fitted to labels, beside those of blurred labels.
`errors` compares random problems with sparse direct solutions.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import ConvergenceError, ElasticPrior, Problem, Solution, solve
from napari_hmrf.loads import Loads
from napari_hmrf.solver.interface_normals import interface_normals
from napari_hmrf.solver.neighbours import corner_slices, in_elements
from napari_hmrf.tissue import SlidingParts
from validation.oracles.elasticity import grid_matrix, lame_parameters
from validation.oracles.posterior import sliding_field

Array = npt.NDArray[np.float64]
_SLIP, _NU = 4.0, 0.3
# Distance from the interface at which both sides are compared, in pixels.
_BESIDE = 2.5
# Distance between points of an interface, in pixels; the kink is measured over one pixel.
_STEP = 0.1
_GAUSS = (0.5 - 12**-0.5, 0.5 + 12**-0.5)


@dataclass(frozen=True)
class Case:
    """Two parts with a known rigid motion.

    Attributes
    ----------
    name : str
    inner : ndarray of bool, shape (H, W)
        Sites of the part that moves.
    stiffness : ndarray, shape (H, W)
    held : ndarray of bool, shape (H, W, 2)
        Prescribed components.
    exact : ndarray, shape (H, W, 2)
        Exact displacement.
    points, normals, slips : ndarray, shape (n, 2)
        Points of the interface, normals towards the part at rest, and exact motion.
    """

    name: str
    inner: npt.NDArray[np.bool_]
    stiffness: Array
    held: npt.NDArray[np.bool_]
    exact: Array
    points: Array
    normals: Array
    slips: Array

    def problem(self, *, connected: bool = False) -> Problem:
        """Return the problem, with parts that slide unless they are connected."""
        parts = None if connected else SlidingParts(self.inner.astype(int))
        return Problem(
            observed=self.exact,
            confidence=self.held.astype(float),
            stiffness=self.stiffness,
            sliding=parts,
        )


def plane(degrees: float, size: int = 64) -> Case:
    """Return a block that is dragged along a tilted plane by its far side."""
    angle = np.radians(degrees)
    normal = np.array([np.cos(angle), -np.sin(angle)])
    along = np.array([np.sin(angle), np.cos(angle)])
    place = np.moveaxis(np.indices((size, size)), 0, -1) - (size - 1) / 2
    depth = place @ normal - 0.2
    inner = depth < 0
    exact = np.where(inner[..., None], _SLIP * along, 0.0)
    held = np.repeat((np.abs(depth) > 0.3 * size)[..., None], 2, axis=-1)
    at = np.arange(-0.35 * size, 0.35 * size, _STEP)[:, None]
    points = at * along + 0.2 * normal + (size - 1) / 2
    every = np.ones_like(at)
    name = f"plane at {degrees:g} degrees"
    stiffness = np.ones((size, size))
    return Case(name, inner, stiffness, held, exact, points, every * normal, every * _SLIP * along)


def wedge(degrees: float = 17.0, size: int = 64) -> Case:
    """Return a block that is pushed horizontally up a wedge, and is free to rise."""
    angle = np.radians(degrees)
    normal = np.array([np.cos(angle), -np.sin(angle)])
    along = np.array([np.sin(angle), np.cos(angle)])
    place = np.moveaxis(np.indices((size, size)), 0, -1) - (size - 1) / 2
    depth = place @ normal - 6.2
    inner = depth < 0
    block = (place[..., 1] > -14) & (place[..., 1] < 12) & (place[..., 0] > -16)
    tissue = ~inner | block
    slip = _SLIP / along[1] * along
    exact = np.where((inner & tissue)[..., None], slip, 0.0)
    held = np.zeros((size, size, 2), np.bool_)
    held[-1] = True
    held[..., 1] |= inner & tissue & (place[..., 1] < -12.9)
    at = np.arange(-9.0, 8.0, _STEP)[:, None]
    points, every = at * along + 6.2 * normal + (size - 1) / 2, np.ones_like(at)
    stiffness = tissue.astype(float)
    name = f"wedge of {degrees:g} degrees"
    return Case(name, inner, stiffness, held, exact, points, every * normal, every * slip)


def disc(radius: float, size: int = 64, contrast: float = 1.0) -> Case:
    """Return a disc that turns in a ring, by its core."""
    middle = (size - 1) / 2 + np.array([0.13, 0.29])
    place = np.moveaxis(np.indices((size, size)), 0, -1) - middle
    away = np.linalg.norm(place, axis=-1)
    inner, turn = away < radius, _SLIP / radius
    exact = np.where(inner[..., None], turn * np.stack([-place[..., 1], place[..., 0]], -1), 0.0)
    held = np.zeros((size, size, 2), np.bool_)
    held[away < radius / 3] = held[0] = held[-1] = held[:, 0] = held[:, -1] = True
    angles = np.arange(0, 2 * np.pi, _STEP / radius)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    slips = _SLIP * np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    stiffness = np.where(inner, 1.0, contrast)
    name = f"disc of radius {radius:g}" + f", ring {contrast:g} times as stiff" * (contrast != 1)
    return Case(name, inner, stiffness, held, exact, middle + radius * normals, normals, slips)


def layer(case: Case, soft: float, *, along: bool) -> Array:
    """Return the field of one grid, whose elements between the parts transmit normal forces.

    Parameters
    ----------
    case : Case
    soft : float
        Stiffness of the layer in shear, relative to the tissue.
    along : bool
        True if the layer resists strain along the interface as tissue does (a transversely
        isotropic layer); False if it is as soft along the interface as in shear.
    """
    corners = np.stack([case.inner[at] for at in corner_slices((63, 63))], axis=-1)
    cut = corners.any(-1) & ~corners.all(-1) & in_elements(case.stiffness)
    problem = case.problem(connected=True)
    moduli = (np.where(cut, 0.0, each) for each in lame_parameters(problem, ElasticPrior(_NU)))
    matrix = grid_matrix(problem.spacing, *moduli, full=True)
    first = np.argwhere(cut)
    centre = first + 0.5
    nearest = scipy.spatial.cKDTree(case.points).query(centre)[1]
    r, c = case.normals[nearest].T
    kinds = np.stack(
        [
            np.stack([r * r, c * c, r * c], -1),
            np.stack([c * c, r * r, -r * c], -1),
            np.stack([-2 * r * c, 2 * r * c, r * r - c * c], -1),
        ]
    )
    shares = (1.0, 1.0 if along else soft, soft / 2)
    law = sum(
        share * kind[:, :, None] * kind[:, None, :]
        for share, kind in zip(shares, kinds, strict=True)
    )
    own = sum(np.einsum("ai,nab,bj->nij", b, law, b) / 4 for b in _strains())
    sites = np.arange(64 * 64).reshape(64, 64)
    at = np.stack([sites[corner][cut] for corner in corner_slices((63, 63))], axis=-1)
    places = (2 * at[..., None] + np.arange(2)).reshape(len(at), 8)
    rows, cols = np.broadcast_arrays(places[:, :, None], places[:, None, :])
    matrix = matrix + sp.coo_array((own.ravel(), (rows.ravel(), cols.ravel())), matrix.shape)
    matrix = matrix.tocsr()
    field, held = np.where(case.held, case.exact, 0.0).ravel(), case.held.ravel()
    free = ~held & (matrix.diagonal() > 0)
    field[free] = spl.spsolve(matrix[free][:, free].tocsc(), -(matrix @ field)[free])
    return field.reshape(case.exact.shape)


def _strains() -> list[Array]:
    """Return the strains (rr, cc, 2 rc) of an element's corners at its four Gauss points."""
    made = []
    for r in _GAUSS:
        for c in _GAUSS:
            by_row = np.array([c - 1, -c, 1 - c, c])
            by_col = np.array([r - 1, 1 - r, -r, r])
            strain = np.zeros((3, 8))
            strain[0, ::2], strain[1, 1::2] = by_row, by_col
            strain[2, ::2], strain[2, 1::2] = by_col, by_row
            made.append(strain)
    return made


def _at(field: Array, points: Array) -> Array:
    """Return a field, shape (H, W, 2), at points."""
    planes = np.moveaxis(field, -1, 0)
    values = [scipy.ndimage.map_coordinates(each, points.T, order=1) for each in planes]
    return np.stack(values, axis=-1)


def measure(case: Case, field: Array) -> tuple[float, float, float]:
    """Return slip (worst fraction), gap and kink, beside the interface."""
    errors, sides = [], []
    for side in (-1, 1):
        at = case.points + side * _BESIDE * case.normals
        sides.append(_at(field, at))
        errors.append(sides[-1] - _at(case.exact, at))
    jump = sides[0] - sides[1]
    true = jump - (errors[0] - errors[1])
    slips = (jump * case.slips).sum(axis=1) / (true * case.slips).sum(axis=1)
    gaps = np.abs(((errors[0] - errors[1]) * case.normals).sum(axis=1))
    kink = max(float(np.abs(np.diff(each[:: round(1 / _STEP)], axis=0)).max()) for each in errors)
    worst = float(slips[np.abs(slips - 1).argmax()])
    return worst, float(gaps.max()), kink


def _field_of(problem: Problem) -> Solution:
    return solve(problem, ElasticPrior(_NU), backend="cpu")


def rivals() -> None:
    """Print the table of the rivals."""
    print("| case | method | slip | gap (px) | kink (px) |\n| --- | --- | --- | --- | --- |")
    for case in (plane(0), plane(17), plane(45), wedge(), disc(20.3)):
        fields = {
            "two fields": _field_of(case.problem()).displacement.astype(float),
            "layer, shear 1e-2": layer(case, 1e-2, along=False),
            "layer, shear 1e-4": layer(case, 1e-4, along=False),
            "layer, shear 1e-4, stiff along": layer(case, 1e-4, along=True),
        }
        for method, field in fields.items():
            slip, gap, kink = measure(case, field)
            print(f"| {case.name} | {method} | {slip:.3f} | {gap:.4f} | {kink:.4f} |")


def _ball(size: int) -> tuple[Problem, Problem]:
    """Return a ball that turns in a shell, with parts that slide and with connected parts."""
    place = np.moveaxis(np.indices((size,) * 3), 0, -1) - (size - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    inner = away < 0.32 * size
    turn = 0.1 * np.stack([0 * away, -place[..., 2], place[..., 1]], axis=-1)
    core = away < 0.1 * size
    held = core.copy()
    for axis in range(3):
        held.swapaxes(0, axis)[[0, -1]] = True
    y, c = np.where(core[..., None], turn, 0.0), np.repeat(held[..., None], 3, axis=-1)
    one = np.ones((size,) * 3)
    return (
        Problem(
            observed=y,
            confidence=c.astype(float),
            stiffness=one,
            sliding=SlidingParts(inner.astype(int)),
        ),
        Problem(observed=y, confidence=c.astype(float), stiffness=one),
    )


def spheres() -> None:
    """Print slip and gap of a ball that turns in a shell."""
    print("| ball | slip | gap | along |\n| --- | --- | --- | --- |")
    for size in (24, 36, 48):
        problem, _ = _ball(size)
        place = np.moveaxis(np.indices((size,) * 3), 0, -1) - (size - 1) / 2
        away, radius = np.linalg.norm(place, axis=-1), 0.32 * size
        turn = 0.1 * np.stack([0 * away, -place[..., 2], place[..., 1]], axis=-1)
        field = _field_of(problem).displacement
        near, inner = np.abs(away - radius) < 1.5, away < radius
        fast = near & inner & (np.linalg.norm(turn, axis=-1) > 0.05 * radius)
        slips = ((field * turn).sum(axis=-1) / np.maximum((turn**2).sum(axis=-1), 1e-9))[fast]
        gap = np.abs((field * place).sum(axis=-1) / away)[near].max()
        print(f"| radius {radius:.1f} | {slips.min():.3f} | {gap:.3f} px | {0.1 * radius:.1f} px |")


def cycles() -> None:
    """Print the numbers of cycles and the times beside those of connected tissue."""
    print("| case | cycles | connected | time, as a ratio |\n| --- | --- | --- | --- |")
    cases = [plane(17), plane(45), wedge(), disc(20.3), disc(20.3, contrast=10.0)]
    cases += [disc(20.3, contrast=1000.0), plane(17, 256), disc(82.0, 256)]
    pairs = [(case.name, case.problem(), case.problem(connected=True)) for case in cases]
    pairs += [(f"ball in {size}^3 voxels", *_ball(size)) for size in (24, 48)]
    for name, sliding, connected in pairs:
        counts, seconds = [], []
        for problem in (sliding, connected):
            times = []
            for _ in range(3):
                begun = time.perf_counter()
                found = _field_of(problem)
                times.append(time.perf_counter() - begun)
            counts.append(len(found.energy) - 1)
            seconds.append(min(times))
        print(f"| {name} | {counts[0]} | {counts[1]} | {seconds[0] / seconds[1]:.1f} |", flush=True)


def _random(seed: int) -> tuple[Problem, ElasticPrior]:
    """Return a random problem with two to four parts, and its prior."""
    rng = np.random.default_rng(seed)
    grids = (((30, 40), (1, 1)), ((28, 24), (1, 2)), ((11, 12, 13), (1, 1, 1)))
    grid, spacing = (*grids, ((12, 10, 9), (2, 1, 1.5)))[seed % 4]
    axes, count = len(grid), 2 + seed % 3
    place = np.moveaxis(np.indices(grid), 0, -1)
    seeds = rng.random((count, axes)) * grid
    labels = np.linalg.norm(place[..., None, :] - seeds, axis=-1).argmin(axis=-1)
    y = rng.normal(size=(*grid, axes))
    c = np.repeat((rng.random(grid) < 0.2)[..., None], axes, axis=-1)
    loads = Loads(force=rng.normal(size=y.shape), growth=0.05 * rng.random(grid))
    problem = Problem(
        observed=y,
        confidence=c.astype(float),
        stiffness=(10.0 ** rng.uniform(0, 2, count))[labels] * rng.uniform(1, 2, grid),
        spacing=spacing,
        loads=loads if seed % 3 == 0 else None,
        precision=rng.random(grid) * (rng.random(grid) < 0.1),
        sliding=SlidingParts(labels),
    )
    return problem, ElasticPrior(rng.uniform(0.2, 0.45, grid) if seed % 2 else _NU)


def errors(count: int = 24) -> None:
    """Print the largest errors of random problems, beside direct solutions."""
    found, failed = [], 0
    for seed in range(count):
        problem, prior = _random(seed)
        try:
            solution = solve(problem, prior, backend="cpu")
        except ConvergenceError:
            failed += 1
            continue
        far = np.abs(solution.displacement - sliding_field(problem, prior)).max() / problem.unit
        assert solution.convergence is not None
        found.append((float(far), solution.convergence.error, len(solution.energy) - 1))
    largest = max(error for error, _, _ in found)
    beyond = sum(error > reported for error, reported, _ in found)
    print(f"{count} random problems: {failed} refused; largest error {largest:.1e} px, {beyond}")
    print(f"beyond the reported error; up to {max(cycles for *_, cycles in found)} cycles")


def _blurred(case: Case, sites: npt.NDArray[np.intp]) -> Array:
    """Return the normals of a label that is blurred by 3 pixels."""
    blurred = scipy.ndimage.gaussian_filter(np.where(case.inner, -1.0, 0.0), 3, mode="nearest")
    slopes = np.stack(np.gradient(blurred), axis=-1)[tuple(sites.T)]
    return np.asarray(slopes / np.linalg.norm(slopes, axis=1, keepdims=True))


def normals() -> None:
    """Print the mean and the largest errors of fitted and of blurred normals, in degrees."""
    print("| interface | fitted, mean | largest | blurred, mean | largest |")
    print("| --- | --- | --- | --- | --- |")
    cases = [plane(angle) for angle in (0, 2, 5, 17, 30, 45)]
    for case in cases + [disc(radius) for radius in (5.3, 9.3, 14.7, 20.3, 26.4)]:
        sites = np.unique(np.round(case.points).astype(int), axis=0)
        true = case.normals[scipy.spatial.cKDTree(case.points).query(sites)[1]]
        fitted = interface_normals(case.inner, ~case.inner, sites, (1.0, 1.0))
        row = []
        for found in (fitted, _blurred(case, sites)):
            degrees = np.degrees(np.arccos(np.clip((found * true).sum(axis=1), -1, 1)))
            row += [f"{degrees.mean():.2f}", f"{degrees.max():.2f}"]
        print(f"| {case.name} | {' | '.join(row)} |")


def main() -> None:
    """Run the chosen parts, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parts = {
        "rivals": rivals,
        "spheres": spheres,
        "cycles": cycles,
        "normals": normals,
        "errors": errors,
    }
    parser.add_argument("parts", nargs="*", choices=[*parts, []], default=list(parts))
    for name in parser.parse_args().parts or parts:
        parts[name]()


if __name__ == "__main__":
    main()
