"""CalculiX, an open finite-element program: decks of problems, and the fields that it prints.

A node is a site, numbered from 1 in the order of the array. Axes x, y and z are the first, second
and third axis of the grid.

CalculiX expands its plane-stress elements to bricks whose out-of-plane stress vanishes only in a
weak sense. With a single Poisson's ratio, textbook plane stress equals plane strain with
nu / (1 + nu) and other constants, which CPE4 elements solve. C3D8 and CPE4 integrate the change of
volume, whereas this package evaluates it at the middle of an element.

In large motion, CalculiX has the law of `NeoHookeanPrior`: the user material CIARLET_EL, with the
second Piola-Kirchhoff stress mu (1 - C^-1) + lambda/2 (det C - 1) C^-1. It subtracts thermal
expansion from the deformation gradient, instead of dividing by it. Growth is therefore not a
thermal expansion there: each element that grows is a separate brick of the grown size, and
equations tie its corners to the sites.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf import Problem

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
ElementType = Literal["CPS3", "CPS4", "CPS4R", "CPE4", "C3D8"]

#: Message for tests and studies that are skipped.
MISSING = "CalculiX is not installed: Debian and Ubuntu have it as `calculix-ccx`"
#: Number of load increments of large motion.
PARTS = 5
# Corners of an element in the order of CalculiX, and the corner numbers of its faces.
_CORNERS = {
    2: ((0, 0), (1, 0), (1, 1), (0, 1)),
    3: tuple((*face, k) for k in (0, 1) for face in ((0, 0), (1, 0), (1, 1), (0, 1))),
}
_FACES = {
    2: ((0, 1), (1, 2), (2, 3), (3, 0)),
    3: ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 4, 5), (1, 2, 5, 6), (2, 3, 6, 7), (3, 0, 7, 4)),
}
# Corners of the two triangles of an element; diagonals alternate.
_TRIANGLES = (((0, 1, 2), (0, 1, 3)), ((0, 2, 3), (1, 2, 3)))


def is_there() -> bool:
    """Return whether CalculiX is installed."""
    return shutil.which("ccx") is not None


def is_missing() -> bool:
    """Return whether CalculiX is not installed, and print how to install it."""
    if not is_there():
        print(MISSING)
    return not is_there()


class _Mesh(NamedTuple):
    """Elements of tissue: first sites, (N, n), corner nodes, (N, 4) or (N, 8), and moduli, (N,)."""

    first: Numbers
    corners: Numbers
    modulus: Array


def _mesh(m: npt.NDArray[Any]) -> _Mesh:
    """Return the elements without void sites, with the mean modulus of their sites."""
    around = np.array(_CORNERS[m.ndim])
    first = np.argwhere(np.ones([size - 1 for size in m.shape], dtype=bool))
    sites = np.ravel_multi_index(tuple(np.moveaxis(first[:, None] + around, -1, 0)), m.shape)
    values = m.ravel()[sites].astype(np.float64)
    exist = values.min(axis=1) > 0
    return _Mesh(first[exist], 1 + sites[exist], values[exist].mean(axis=1))


def _node_lines(numbers: Iterable[int], places: Array) -> list[str]:
    """Return lines with nodes at places, (N, 2) or (N, 3)."""
    places = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
    return [
        f"{n}, {x:.12g}, {y:.12g}, {z:.12g}" for n, (x, y, z) in zip(numbers, places, strict=True)
    ]


def _element_lines(
    element: str, corners: Numbers, modulus: Array, material: Callable[[int, float], list[str]]
) -> list[str]:
    """Return lines with elements, numbered from 1, and one material for each modulus."""
    lines = []
    values, kind = np.unique(modulus, return_inverse=True)
    for index, young in enumerate(values.tolist()):
        lines.append(f"*ELEMENT, TYPE={element}, ELSET=E{index}")
        for number in np.flatnonzero(kind == index):
            lines.append(f"{number + 1}, {', '.join(map(str, corners[number]))}")
        name, *rest = material(index, young)
        lines += [f"*MATERIAL, NAME={name}", *rest]
        lines += [f"*SOLID SECTION, ELSET=E{index}, MATERIAL={name}"]
        lines += ["1."] * (element != "C3D8")
    return lines


def _boundary_lines(problem: Problem, nodes: Numbers) -> list[str]:
    """Return lines with the prescribed components of some nodes."""
    lines, shape = ["*BOUNDARY"], problem.shape
    for number, *site in np.column_stack([nodes, *np.unravel_index(nodes - 1, shape)]).tolist():
        for along in np.flatnonzero(problem.known[tuple(site)]):
            y = problem.observed[(*site, along)]
            lines.append(f"{number}, {along + 1}, {along + 1}, {y:.12g}")
    return lines


def _places(nodes: Numbers, shape: tuple[int, ...], spacing: tuple[float, ...]) -> Array:
    return np.stack(np.unravel_index(nodes - 1, shape), axis=-1) * np.array(spacing)


def solve(problem: Problem, element: ElementType, poisson: float) -> Array:
    """Return the field of linear tissue; components that are observed on an element are prescribed.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of the problem.
    """
    mesh = _mesh(problem.stiffness)
    corners, modulus = mesh.corners, mesh.modulus
    if element == "CPS3":
        turn = mesh.first.sum(axis=1) % 2
        halves = [
            np.where(turn[:, None], corners[:, other], corners[:, one])
            for one, other in ((list(a), list(b)) for a, b in _TRIANGLES)
        ]
        corners, modulus = np.concatenate(halves), np.tile(modulus, 2)
    nodes = np.unique(corners)

    def material(index: int, young: float) -> list[str]:
        return [f"M{index}", "*ELASTIC", f"{young:.12g}, {poisson:.12g}"]

    lines = [
        "*NODE, NSET=ALL",
        *_node_lines(nodes, _places(nodes, problem.shape, problem.spacing)),
        *_element_lines(element, corners, modulus, material),
        *("*STEP", "*STATIC", *_boundary_lines(problem, nodes)),
        *("*NODE PRINT, NSET=ALL", "U", "*END STEP", ""),
    ]
    start = np.where(problem.known, problem.observed, 0.0).astype(np.float64)
    return _run("\n".join(lines), start)


def textbook_plane_stress(problem: Problem, poisson: float) -> Array:
    """Return the field of textbook plane stress, without loads."""
    return solve(problem, "CPE4", poisson / (1 + poisson))


def loaded_field(
    stiffness: Array,
    spacing: tuple[float, ...],
    poisson: float,
    *,
    stress: bool,
    strain: Array,
    pull: tuple[float, ...],
    surface: npt.NDArray[np.bool_],
    pressure: float | Array,
) -> Array:
    """Return the field of tissue that is fixed at its first sites, with loads of CalculiX.

    Growth is a thermal expansion, weight is gravity, and pressure is a load on faces of elements.

    Parameters
    ----------
    stiffness : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    poisson : float
    stress : bool
        True for plane stress, which is plane strain with other constants.
    strain : ndarray, same shape as `stiffness`
        Growth in all directions.
    pull : tuple of float
        Weight of the tissue per volume.
    surface : ndarray of bool, same shape
        Sites whose free faces are pressed.
    pressure : float or ndarray
        Pressure of all sites or of each site; a face bears the mean of its corners.
    """
    axes, shape = stiffness.ndim, stiffness.shape
    first, corners, modulus = _mesh(stiffness)
    nodes = np.unique(corners)
    young, nu, expansion = 1.0, poisson, 1.0
    if stress:
        young = (1 + 2 * nu) / (1 + nu) ** 2
        expansion, nu = (1 + nu) / (1 + 2 * nu), nu / (1 + nu)

    def material(index: int, modulus: float) -> list[str]:
        elastic = f"{young * modulus:.12g}, {nu:.12g}"
        expands = "*EXPANSION, ZERO=0", f"{expansion:.12g}", "*DENSITY", "1."
        return [f"M{index}", "*ELASTIC", elastic, *expands]

    lines = ["*NODE, NSET=ALL", *_node_lines(nodes, _places(nodes, shape, spacing))]
    lines += _element_lines("CPE4" if axes == 2 else "C3D8", corners, modulus, material)
    lines += ["*ELSET, ELSET=EVERY", *map(str, range(1, len(first) + 1))]
    lines += ["*INITIAL CONDITIONS, TYPE=TEMPERATURE", "ALL, 0.", "*STEP", "*STATIC", "*BOUNDARY"]
    lines += [f"{node}, 1, {axes}" for node in nodes if node <= stiffness[0].size]
    lines += ["*TEMPERATURE", *(f"{node}, {strain.flat[node - 1]:.12g}" for node in nodes)]
    size, presses = math.hypot(*pull), np.broadcast_to(pressure, shape)
    way = ", ".join(f"{each / size:.15g}" for each in (*pull, 0.0)[:3])
    lines += ["*DLOAD", f"EVERY, GRAV, {size:.15g}, {way}"]
    named = {tuple(at): number for number, at in enumerate(first.tolist(), start=1)}
    for at, (face, ends) in itertools.product(named, enumerate(_FACES[axes], start=1)):
        places = np.array([_CORNERS[axes][corner] for corner in ends])
        (axis,) = np.flatnonzero(np.ptp(places, axis=0) == 0)
        step = 2 * int(places[0, axis]) - 1
        beyond = tuple(i + step * (along == axis) for along, i in enumerate(at))
        painted = all(surface[tuple(place)] for place in places + at)
        if beyond not in named and painted:
            amount = np.mean([presses[tuple(place)] for place in places + at])
            lines.append(f"{named[at]}, P{face}, {amount:.12g}")
    lines += ["*NODE PRINT, NSET=ALL", "U", "*END STEP", ""]
    return _run("\n".join(lines), np.zeros((*shape, axes)))


def large_field(problem: Problem, poisson: float) -> Array:
    """Return the field of a volume without void in large motion.

    Growth is equal in all directions. Corners of elements that grow have the numbers after those of
    the sites and of a node whose first displacement is the part of the growth that is applied.
    """
    mesh = _mesh(problem.stiffness)
    corners = mesh.corners
    sites = 1 + np.arange(problem.stiffness.size)
    places = _places(sites, problem.shape, problem.spacing)
    lines = ["*NODE, NSET=SITES", *_node_lines(sites, places)]
    ties, scale = [], len(places) + 1
    if problem.loads is not None and problem.loads.growth is not None:
        growth = problem.loads.growth.ravel().astype(np.float64)[corners - 1].mean(axis=-1)
        grows = np.flatnonzero(growth)
        at = places[corners[grows] - 1]
        offsets = growth[grows, None, None] * (at - at.mean(axis=1, keepdims=True))
        own = scale + 1 + np.arange(offsets[..., 0].size).reshape(-1, 8)
        lines += ["*NODE", *_node_lines([scale], np.zeros((1, 3)))]
        lines += _node_lines(own.ravel(), (at + offsets).reshape(-1, 3))
        ties = ["*EQUATION", *_ties(own, corners[grows], scale, offsets)]
        corners[grows] = own

    def material(index: int, young: float) -> list[str]:
        constants = f"{young:.12g}, {poisson:.12g}, 0."
        return [f"CIARLET_EL{index}", "*USER MATERIAL, CONSTANTS=2", constants]

    lines += _element_lines("C3D8", corners, mesh.modulus, material)
    lines += [*ties, "*STEP, NLGEOM, INC=1000", "*STATIC, SOLVER=ITERATIVE CHOLESKY"]
    lines += [f"{1 / PARTS:.9g}, 1.", "*CONTROLS, PARAMETERS=FIELD", "1.E-7, 1.E-6"]
    lines += _boundary_lines(problem, sites)
    if ties:
        lines += [f"{scale}, 1, 1, 1.", f"{scale}, 2, 3, 0."]
    lines += ["*NODE PRINT, NSET=SITES", "U", "*END STEP", ""]
    return _run("\n".join(lines), np.zeros(problem.observed.shape))


def _ties(own: Numbers, sites: Numbers, scale: int, offsets: Array) -> list[str]:
    """Return the equations u_own - u_site + (applied part of the growth) offset = 0."""
    lines = []
    for index in np.ndindex(own.shape):
        for along, offset in enumerate(offsets[index], start=1):
            ends = f"{own[index]}, {along}, 1., {sites[index]}, {along}, -1."
            lines += ["3", f"{ends}, {scale}, 1, {offset:.12g}"]
    return lines


def _run(text: str, field: Array) -> Array:
    """Run CalculiX on an input file, and return a field with the displacements that it prints.

    Parameters
    ----------
    text : str
        Input file.
    field : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement of sites that are in no element.

    Raises
    ------
    RuntimeError
        If the program fails; the message contains the end of its output.
    """
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "job.inp").write_text(text, encoding="ascii")
        threads = {"OMP_NUM_THREADS": str(os.cpu_count() or 1)}
        done = subprocess.run(
            ["ccx", "job"],
            cwd=folder,
            env={**os.environ, **threads},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        results = Path(folder) / "job.dat"
        if done.returncode or not results.exists() or "*ERROR" in done.stdout:
            raise RuntimeError(f"CalculiX failed:\n{done.stdout[-800:]}")
        printed = results.read_text(encoding="ascii")
    # The last table is that of the last increment.
    start = printed.rindex("displacements (vx,vy,vz)")
    table = np.loadtxt(printed[start:].splitlines()[2:], ndmin=2)
    axes = field.shape[-1]
    field.reshape(-1, axes)[table[:, 0].astype(np.intp) - 1] = table[:, 1 : axes + 1]
    return field
