"""CalculiX, an open solver for ABAQUS decks: functions that write the deck and read the field.

CalculiX expands its plane-stress elements to bricks whose out-of-plane stress vanishes only in a
weak sense. For data without forces and with a single Poisson's ratio, textbook plane stress equals
plane strain with nu / (1 + nu), which CPE4 elements solve. x in the deck is our row, and y our
column.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf import Problem

from .assembly import element_modulus

Float64Array = npt.NDArray[np.float64]
ElementType = Literal["CPS3", "CPS4", "CPS4R", "CPE4"]

#: Installation instruction for the report.
HOW = "Debian and Ubuntu have it as `calculix-ccx`"
_AROUND = ((0, 0), (1, 0), (1, 1), (0, 1))  # corners of an element, anticlockwise in x, y
_TRIANGLES = (((0, 1, 2), (0, 2, 3)), ((0, 1, 3), (1, 2, 3)))  # diagonals alternate


def is_there() -> bool:
    """Return whether CalculiX is installed."""
    return shutil.which("ccx") is not None


def textbook_plane_stress(problem: Problem, poisson: float) -> Float64Array:
    """Solve textbook plane stress."""
    return solve(problem, "CPE4", poisson / (1 + poisson))


def solve(problem: Problem, element: ElementType, poisson: float) -> Float64Array:
    """Run CalculiX on a problem; components with confidence on an element are prescribed.

    Returns
    -------
    ndarray, shape (H, W, 2)
        Displacement, in the unit of the problem.

    Raises
    ------
    RuntimeError
        If the program fails; the message contains the end of its output.
    """
    numbers, values = run(deck(problem, element, poisson))
    displacement = np.where(
        (problem.confidence > 0) & problem.tissue[..., None], problem.observed, 0.0
    )
    displacement = displacement.astype(np.float64)
    displacement.reshape(-1, 2)[numbers - 1] = values[:, :2]
    return displacement


def run(text: str) -> tuple[npt.NDArray[np.int64], Float64Array]:
    """Run CalculiX on an input file, and return the node numbers and displacements that it prints.

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
        return read_displacements(results)


def deck(problem: Problem, element: ElementType, poisson: float) -> str:
    """Return the input file: a node per site, numbered by row, and one material per modulus."""
    modulus = element_modulus(problem)
    row, col = np.nonzero(modulus)
    number = 1 + np.arange(problem.stiffness.size).reshape(problem.shape)
    corners = np.stack([number[row + i, col + j] for i, j in _AROUND], axis=1)
    values, kind = np.unique(modulus[row, col], return_inverse=True)
    if element == "CPS3":
        turn = (row + col) % 2
        halves = [np.where(turn[:, None], corners[:, b], corners[:, a]) for a, b in _halves()]
        corners, kind = np.concatenate(halves), np.tile(kind, 2)
    nodes = np.unique(corners)
    places = np.stack(np.divmod(nodes - 1, problem.shape[1]), axis=1) * np.array(problem.spacing)
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{n}, {x:.9g}, {y:.9g}, 0" for n, (x, y) in zip(nodes, places, strict=True)]
    for index, young in enumerate(values):
        members = np.flatnonzero(kind == index)
        lines.append(f"*ELEMENT, TYPE={element}, ELSET=E{index}")
        lines += [f"{e + 1}, {', '.join(map(str, corners[e]))}" for e in members]
        lines += [f"*MATERIAL, NAME=M{index}", "*ELASTIC", f"{young:.12g}, {poisson:.12g}"]
        lines += [f"*SOLID SECTION, ELSET=E{index}, MATERIAL=M{index}", "1."]
    lines += ["*STEP", "*STATIC", "*BOUNDARY"]
    c, y = (field.reshape(-1, 2)[nodes - 1] for field in (problem.confidence, problem.observed))
    for component in (0, 1):
        held = np.flatnonzero(c[:, component] > 0)
        freedom = component + 1
        lines += [f"{nodes[n]}, {freedom}, {freedom}, {y[n, component]:.9g}" for n in held]
    lines += ["*NODE PRINT, NSET=ALL", "U", "*END STEP", ""]
    return "\n".join(lines)


def _halves() -> list[tuple[list[int], list[int]]]:
    """Return the corners of the first and second triangle, for either diagonal."""
    return [(list(a), list(b)) for a, b in zip(*_TRIANGLES, strict=True)]


def read_displacements(path: Path) -> tuple[npt.NDArray[np.int64], Float64Array]:
    """Return the node numbers and values of the last displacement table in a .dat file."""
    text = path.read_text(encoding="ascii")
    start = text.rindex("displacements (vx,vy,vz)")
    table = np.loadtxt(text[start:].splitlines()[2:], ndmin=2)
    return table[:, 0].astype(np.int64), table[:, 1:]
