"""Compile all loops for the processor, and keep them: ``python -m napari_hmrf.compiling``.

Solves a small problem in every way there is, as only what is called is compiled. Prints how many of
them are done.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends import loops
from napari_hmrf.backends.thread import compute_thread
from napari_hmrf.optimizers import ICM, Multigrid
from napari_hmrf.priors import ElasticPrior, SeilerPrior
from napari_hmrf.problem import Problem
from napari_hmrf.solve import solve
from napari_hmrf.warp import warp
from napari_hmrf.warper import Picture, Warper

_SIZE = 40


def jobs() -> list[Callable[[], Any]]:
    """What brings the loops to disk, the ones that are asked for first at the beginning."""
    square, oblong = (1.0, 1.0), (2.0, 0.5)
    mapped = np.full((_SIZE, _SIZE), 0.3)
    return [
        lambda: _solve(ElasticPrior(0.3), Multigrid(), square),
        _pictures,
        lambda: _solve(SeilerPrior(), ICM(iterations=2), square),
        lambda: _solve(SeilerPrior(), Multigrid(), square),
        lambda: _solve(ElasticPrior(mapped, penalty=1.0), Multigrid(), square),
        lambda: _solve(SeilerPrior(), ICM(iterations=2), oblong),
        lambda: _solve(SeilerPrior(), Multigrid(), oblong),
        lambda: _solve(SeilerPrior(conditional="blanket"), ICM(iterations=2), square),
        lambda: _solve(SeilerPrior(conditional="blanket"), Multigrid(), square),
        lambda: _solve(SeilerPrior(), ICM(iterations=2, steps=None), square),
    ]


def _solve(prior: Any, optimizer: Any, spacing: tuple[float, float]) -> None:
    c = np.zeros((_SIZE, _SIZE, 2))
    c[0] = c[-1] = 1
    problem = Problem(c, c, np.ones((_SIZE, _SIZE)), spacing)
    solve(problem, prior, optimizer, backend="cpu")


def _pictures() -> None:
    still = np.zeros((9, 9, 2), np.float32)
    for kind in (np.uint8, np.float32):
        image = np.zeros((9, 9), kind)
        warp(image, still)
        compute_thread.submit(partial(_follow, image, still)).result()


def _follow(image: npt.NDArray[Any], still: npt.NDArray[np.float32]) -> None:
    """Move a picture, by tissue of its own and by a solution's, which to numba is another type."""
    warper = Warper(Picture(image, order=0 if image.dtype.kind == "u" else 1))
    warper(still)
    tissue = np.ones(image.shape, dtype=bool)
    tissue.setflags(write=False)
    warper(still, tissue)


def _kept() -> bool:
    """Whether numba could keep what it has compiled."""
    from napari_hmrf.backends.cpu import exact

    folder = exact.measure.stats.cache_path
    return folder is not None and any(Path(folder).glob("*.nbi"))


def main() -> int:
    """Compile; 0 if all of it is kept."""
    if not loops.begin():
        return 1
    compiled = False
    try:
        todo = jobs()
        for number, job in enumerate(todo, start=1):
            job()
            print(f"{number} of {len(todo)}", flush=True)
        compiled = _kept()
    finally:
        loops.end(compiled)
    return 0 if compiled else 1


if __name__ == "__main__":
    sys.exit(main())
