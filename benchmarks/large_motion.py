"""Benchmark of large motion.

    python -m benchmarks.large_motion [exact] [textbook]

Measures the distance to an independent Newton's method and to textbook finite elements.
``python benchmarks/speed.py large`` measures the time. Random problems are those of
``python -m benchmarks.campaign large-motion``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import numpy as np

from napari_hmrf import NeoHookeanPrior, Problem, solve
from napari_hmrf.loads import growth, weight
from napari_hmrf.solver.backends.thread import compute_thread
from validation.oracles.large_motion import large_field
from validation.problems import bar, turned


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    given = parser.parse_args()
    for name, section in _SECTIONS.items():
        if not given.names or name in given.names:
            compute_thread.submit(section).result()


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
                off = float(np.abs(found.displacement - large_field(problem, prior, 6)).max())
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
        prior = NeoHookeanPrior(nu)
        found = solve(problem, prior, backend="cpu").displacement
        off = np.abs(found - large_field(problem, prior, 10, textbook=True))[:, 4:-4].max()
        print(
            f"textbook, pull 30 %, nu {nu}: error {off:.4f} px, four pixels from the clamps",
            flush=True,
        )


_SECTIONS: dict[str, Callable[[], None]] = {"exact": exact, "textbook": textbook}


if __name__ == "__main__":
    main()
