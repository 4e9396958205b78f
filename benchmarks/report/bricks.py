"""Volumes: comparison with CalculiX, a uniform strain, and a hollow sphere."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from report.page import Section, Settings, Target
from validation.oracles import calculix
from validation.oracles.elasticity import direct_solution

Float64Array = npt.NDArray[np.float64]
POISSON = 0.3
OBLONG = (1.0, 1.7, 0.6)


def section(settings: Settings) -> Section:
    """Return the section with the independent assembly, the patch test and the order."""
    page = Section("Volumes")
    _assembly(page, settings)
    _patch(page)
    _sphere(page, settings)
    return page


def mixed(size: int) -> Problem:
    """Return voxels of random stiffness, with a contrast of 100, between two plates."""
    shape = (size, size, size)
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[[0, -1]], y[-1] = 1, np.array((1.0, 0.5, -0.3)) * OBLONG
    return Problem(
        observed=y,
        confidence=c,
        stiffness=100 ** np.random.default_rng(0).random(shape),
        spacing=OBLONG,
    )


def _assembly(page: Section, settings: Settings) -> None:
    size = settings.choose(20, 8)
    problem = mixed(size)
    prior = ElasticPrior(POISSON)
    direct = direct_solution(problem, prior)
    found = solve(problem, prior, optimizer=Multigrid(1e-3), backend="cpu")
    off = _apart(found.displacement, direct, problem)
    page.say(
        f"""**Question.** Does the field of a volume equal finite elements? {size} x {size} x
        {size} oblong voxels of random stiffness, up to a hundred times as stiff, are solved
        directly in double precision with a matrix that scikit-fem assembled. The largest
        difference of any site is {off:.1e} voxels, at a tolerance of 1e-3, after
        {found.iterations} cycles."""
    )
    page.targets.append(Target("volume to a direct solve: largest error in voxels", off, 1e-3))
    if not calculix.is_there():
        page.say(f"CalculiX is not installed: {calculix.HOW}.")
        return
    locking = direct_solution(problem, prior, locking=True)
    theirs = calculix.solve(problem, "C3D8", POISSON)
    agree, reduced = (_apart(each, locking, problem) for each in (theirs, direct))
    page.say(
        f"""CalculiX's bricks C3D8 are fully integrated. The same assembly with full integration
        agrees with CalculiX within {agree:.1e} voxels. **Conclusion.** Here the change of volume
        is computed at the middle of each brick, so that nearly incompressible tissue does not
        lock. This moves the field by up to {reduced:.2g} voxels. It is a choice of element, not
        an error of a solver."""
    )
    page.targets.append(Target("volume, assembly to CalculiX C3D8, in voxels", agree, 1e-5))


def _patch(page: Section) -> None:
    shape = (24, 20, 28)
    places = np.moveaxis(np.indices(shape), 0, -1) * OBLONG
    strain = np.array([[0.02, -0.01, 0.03], [0.03, 0.015, 0.01], [-0.02, 0.01, 0.01]])
    c = np.ones((*shape, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    problem = Problem(
        observed=places @ strain.T, confidence=c, stiffness=np.ones(shape), spacing=OBLONG
    )
    found = solve(problem, ElasticPrior(0.45), optimizer=Multigrid(1e-5), backend="cpu")
    off = _apart(found.displacement, places @ strain.T, problem)
    page.say(
        f"""**Question.** The patch test: a uniform strain on the faces of a box must fill it.
        Largest error of any site: {off:.1e} voxels."""
    )
    page.targets.append(Target("volume, patch test: largest error in voxels", off, 1e-4))


def _sphere(page: Section, settings: Settings) -> None:
    sizes = settings.choose((24, 40, 64), (16, 24))
    errors = [hollow_sphere(size) for size in sizes]
    order = math.log(errors[0] / errors[-1]) / math.log(sizes[-1] / sizes[0])
    page.say(
        """**Question.** How fast does the error fall with the voxel size, in Lame's hollow
        sphere, u = r + b / r^2? The exact field is prescribed in skins of equal thickness on
        every grid, to exclude the effect of the staircase of voxels."""
    )
    header = [f"{size} voxels" for size in sizes]
    page.table(["rms error", *header], [["", *(f"{error:.1e}" for error in errors)]])
    page.say(
        f"""**Conclusion.** The order is {order:.2f}: second order, as trilinear bricks should
        have."""
    )
    page.targets.append(Target("hollow sphere: observed order", order, 1.7, at_least=True))


def hollow_sphere(size: int) -> float:
    """Return the rms error of Lame's hollow sphere, in units of half a side."""
    places = np.moveaxis((np.indices((size,) * 3) - (size - 1) / 2) / (size / 2), 0, -1)
    r = np.linalg.norm(places, axis=-1)
    tissue = (r > 0.3) & (r < 0.97)
    skins = tissue & ((r < 0.45) | (r > 0.82))
    exact = 0.05 * (1 + 0.1 / np.maximum(r, 0.1) ** 3)[..., None] * places
    c = np.repeat(skins[..., None], 3, axis=-1).astype(float)
    problem = Problem(
        observed=exact, confidence=c, stiffness=tissue.astype(float), spacing=(2 / size,) * 3
    )
    found = solve(problem, ElasticPrior(POISSON), optimizer=Multigrid(1e-4), backend="cpu")
    off = (found.displacement - exact)[tissue & ~skins]
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


def _apart(one: npt.ArrayLike, other: npt.ArrayLike, problem: Problem) -> float:
    """Return the largest difference, in voxels."""
    return float(np.abs(np.asarray(one) - np.asarray(other)).max()) / problem.unit
