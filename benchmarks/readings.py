"""The two readings of "U_total at a site", solved exactly and compared with finite elements.

    python benchmarks/readings.py [--sizes 64 128 256]

Both readings are solved by a sparse direct method in float64, so the table compares the models and
not the progress of an iteration. docs/method.md cites the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from fem import plane_stress_displacement, rmsd

from napari_hmrf import Problem
from napari_hmrf.data import phantom
from napari_hmrf.solver.priors import line_steps, line_weights

BAR_LENGTHS = (8, 64, 256, 1200)
PHANTOMS = ("expansion", "mass-effect")


def solve_exactly(problem: Problem, reading: str) -> npt.NDArray[np.float64]:
    """Return the field, (H, W, 2), at which every site is at its minimum, prescribed where c > 0.

    Parameters
    ----------
    problem : Problem
        Problem to solve.
    reading : {"centred", "blanket"}
        Blanket is the exact minimizer of eq. 7; centred is the fixed point of the site updates.
    """
    height, width = problem.shape
    number = np.arange(height * width).reshape(problem.shape)
    m = problem.stiffness.astype(np.float64)
    field = np.where(problem.confidence > 0, problem.observed, 0).astype(np.float64)
    weights = line_weights(problem.spacing)
    for component in (0, 1):
        parts = []
        for line, (di, dj) in enumerate(line_steps(2)):
            i, j = np.mgrid[
                abs(di) : max(height - abs(di), abs(di)), abs(dj) : max(width - abs(dj), abs(dj))
            ]
            s, t, u = (number[i + k * di, j + k * dj].ravel() for k in (-1, 0, 1))
            ms, mt, mu = (m.ravel()[site] for site in (s, t, u))
            exist = (ms > 0) & (mt > 0) & (mu > 0) & (weights[line, component] > 0)
            s, t, u, ms, mt, mu = (values[exist] for values in (s, t, u, ms, mt, mu))
            to_s, to_u, one = mt / ms, mt / mu, np.ones(len(t))
            scale = np.sqrt(weights[line, component])
            parts.append((s, t, u, -to_u * scale, (1 + to_u) * scale, -one * scale))
            parts.append((s, t, u, -one * scale, (1 + to_s) * scale, -to_s * scale))
        s, t, u, at_s, at_t, at_u = (np.concatenate(each) for each in zip(*parts, strict=True))
        row = np.arange(len(t))
        shape = (len(t), height * width)
        middle = sp.csr_matrix((at_t, (row, t)), shape=shape)
        residual = middle + sp.csr_matrix(
            (np.concatenate([at_s, at_u]), (np.tile(row, 2), np.concatenate([s, u]))), shape=shape
        )
        matrix = (middle if reading == "centred" else residual).T @ residual
        if not len(t):
            continue
        free = (problem.confidence[..., component].ravel() == 0) & (
            np.asarray(matrix.diagonal()) > 0
        )
        values = field[..., component].ravel()
        right = -(matrix[free][:, ~free] @ values[~free])
        values[free] = spl.spsolve(matrix[free][:, free].tocsc(), right)
        field[..., component] = values.reshape(problem.shape)
    return field


def bar_strain_ratio(length: int, ratio: float, reading: str) -> float:
    """Return the strain ratio of the soft and stiff halves of a bar with prescribed ends."""
    m = np.ones((1, length))
    m[:, : length // 2] = ratio
    y, c = np.zeros((1, length, 2)), np.zeros((1, length, 2))
    c[:, [0, -1]] = 1
    y[0, -1, 1] = 1
    along = solve_exactly(Problem(observed=y, confidence=c, stiffness=m), reading)[0, :, 1]
    middle = length // 2
    return float((along[-1] - along[middle]) / (along[middle - 1] - along[0]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    sizes = parser.parse_args(arguments).sizes
    print("RMSD to finite elements in px, and the field's own rms, for image sizes", *sizes)
    for name in PHANTOMS:
        rows: dict[str, list[float]] = {"centred": [], "blanket": [], "rms of the field": []}
        for size in sizes:
            problem = phantom(name, size).problem
            truth = plane_stress_displacement(problem)
            for reading in ("centred", "blanket"):
                found = solve_exactly(problem, reading)
                rows[reading].append(rmsd(found, truth, problem.tissue))
            rows["rms of the field"].append(rmsd(truth, 0 * truth, problem.tissue))
        for label, values in rows.items():
            print(f"  {name:12} {label:18}", "  ".join(f"{value:6.3f}" for value in values))
    print("\nStrain ratio of a bar whose halves have stiffness ratio 5 (truth: 5), by length in px")
    print(f"  {'':12} {'':18}", "  ".join(f"{length:6d}" for length in BAR_LENGTHS))
    for reading in ("centred", "blanket"):
        ratios = [bar_strain_ratio(length, 5.0, reading) for length in BAR_LENGTHS]
        print(f"  {'bar':12} {reading:18}", "  ".join(f"{ratio:6.2f}" for ratio in ratios))
    return 0


if __name__ == "__main__":
    sys.exit(main())
