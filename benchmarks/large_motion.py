"""Benchmark of large motion.

    python -m benchmarks.large_motion [exact] [textbook]

``--random 3000`` solves random problems; ``--first 400 --random 200`` solves a part of them.

Measures the distance to an independent Newton's method and to textbook finite elements, and
failures on random problems. ``python benchmarks/speed.py large`` measures the time.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from benchmarks import random_large_motion
from napari_hmrf import NeoHookeanPrior, Problem, solve
from napari_hmrf.loads import growth, weight
from napari_hmrf.solver.backends.thread import compute_thread
from tests.support.finite_oracle import bar, solved, turned

# Default number of random problems.
_FEW = 200


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT")
    parser.add_argument("--first", type=int, default=0, help="number of the first random problem")
    given = parser.parse_args()
    everything = not given.names and not given.random
    for name, section in _SECTIONS.items():
        if everything or name in given.names:
            compute_thread.submit(section).result()
    count = _FEW if everything else given.random
    if count:
        compute_thread.submit(lambda: random_large_motion.run(given.first, count)).result()


def exact(size: int = 48) -> None:
    """Print the largest distance of any site from an independent method, in pixels."""
    ends = {
        **{f"pull {part} %": np.array([0.0, part / 100 * (size - 1)]) for part in (10, 30, 50)},
        "shear": np.array([0.3 * size, 0.0]),
        # A block as high as it is long creases on its inner side, and has several solutions.
        "bend 60": turned(size // 3, size, 60),
    }
    problems = {}
    for name, end in ends.items():
        height = len(end) if end.ndim == 2 else size
        m = np.ones((height, size))
        m[: height // 2] = 5
        problems[name] = bar(height, size, np.broadcast_to(end, (height, 2)), m)
    problems |= _loaded(size)
    worst = 0.0
    for name, problem in problems.items():
        for nu in (0.3, 0.45):
            for plane in ("stress", "strain"):
                prior = NeoHookeanPrior(nu, plane=plane)  # type: ignore[arg-type]
                found = solve(problem, prior, backend="cpu")
                off = float(np.abs(found.displacement - solved(problem, prior, 6)).max())
                worst = max(worst, off)
                print(f"{name:16} nu {nu:4} plane {plane:6} error {off:.5f} px", flush=True)
    print(f"worst {worst:.5f} px", flush=True)


def _loaded(size: int) -> dict[str, Problem]:
    """Return a disc that doubles its area within a frame, and a beam that sags under its weight."""
    row, col = np.indices((size, size))
    disc = np.hypot(row - size / 2, col - size / 2) < size / 5
    c = np.zeros((size, size, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    m = np.where(disc, 5.0, 1.0)
    strain = growth((math.sqrt(2) - 1) * disc)
    height = size // 3
    beam = bar(height, size, np.zeros((height, 2)), 1.0)
    heavy = weight(beam.stiffness, (2e-3, 0.0), spacing=1)
    return {
        "area + 100 %": Problem(observed=0 * c, confidence=c, stiffness=m, loads=strain),
        "beam that sinks": Problem(
            observed=beam.observed,
            confidence=beam.confidence,
            stiffness=beam.stiffness,
            loads=heavy,
        ),
    }


def textbook(size: int = 48, stretch: float = 0.3) -> None:
    """Print the distance to finite elements with 2 x 2 Gauss points and no barrier."""
    for nu in (0.3, 0.45):
        problem = bar(size, size, np.broadcast_to([0.0, stretch * (size - 1)], (size, 2)))
        found = solve(problem, NeoHookeanPrior(nu), backend="cpu").displacement
        off = np.abs(found - _gauss(problem, nu))[:, 4:-4].max()
        print(
            f"textbook, pull 30 %, nu {nu}: error {off:.4f} px, four pixels from the clamps",
            flush=True,
        )


def _gauss(problem: Problem, nu: float) -> Any:
    """Solve plane-stress neo-Hooke with 2 x 2 Gauss points by Newton's method."""
    height, width = problem.shape
    numbers = np.arange(2 * height * width).reshape(height, width, 2)
    corners = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
    nodes = np.stack(corners, axis=2).reshape(-1, 8)
    mu = 1 / (2 * (1 + nu))
    lam = 2 * mu * nu / (1 - 2 * nu)
    whole, g = mu + lam / 2, 0.5 / np.sqrt(3)
    free, known = np.flatnonzero(~problem.known), np.flatnonzero(problem.known)
    turn = np.zeros((4, 4))
    turn[0, 3] = turn[3, 0] = 1
    turn[1, 2] = turn[2, 1] = -1
    gradients = []
    for r, s in ((-g, -g), (-g, g), (g, -g), (g, g)):
        along_rows = np.array([-(0.5 - s), -(0.5 + s), 0.5 - s, 0.5 + s])
        along_cols = np.array([-(0.5 - r), 0.5 - r, -(0.5 + r), 0.5 + r])
        gradients.append(np.kron(np.stack([along_rows, along_cols]), np.eye(2)))
    d = np.zeros(problem.observed.size)
    for part in range(1, 11):
        for _ in range(30):
            load, blocks = np.zeros_like(d), np.zeros((len(nodes), 8, 8))
            for gradient in gradients:
                f = d[nodes] @ gradient.T + np.array([1.0, 0, 0, 1.0])
                cofactor = f @ turn
                j = f[:, 0] * f[:, 3] - f[:, 1] * f[:, 2]
                thick = mu + lam * j**2 / 2
                slope = -whole * mu / (j * thick)
                bend = whole * mu * (thick + lam * j**2) / (j * thick) ** 2
                stress = mu * f + slope[:, None] * cofactor
                np.add.at(load, nodes.ravel(), (stress @ gradient / 4).ravel())
                tangent = mu * np.eye(4) + slope[:, None, None] * turn
                tangent = tangent + bend[:, None, None] * cofactor[:, :, None] * cofactor[:, None]
                blocks += gradient.T @ tangent @ gradient / 4
            rows = np.repeat(nodes[..., None], 8, axis=-1)
            at = rows.ravel(), rows.swapaxes(1, 2).ravel()
            matrix = scipy.sparse.csc_matrix((blocks.ravel(), at), shape=(d.size, d.size))
            way = np.zeros_like(d)
            way[known] = problem.observed.ravel()[known] * part / 10 - d[known]
            rest = -load - matrix @ way
            way[free] = scipy.sparse.linalg.spsolve(matrix[free][:, free], rest[free])
            d += way
            if np.abs(way).max() < 1e-9:
                break
    return d.reshape(height, width, 2)


_SECTIONS: dict[str, Callable[[], None]] = {"exact": exact, "textbook": textbook}


if __name__ == "__main__":
    main()
