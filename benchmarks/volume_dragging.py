"""How a volume follows a hand: pictures a second of the slice that is seen, and all of it after.

    python benchmarks/volume_dragging.py [--size 190] [--moves 20] [--image FILE]

By default the drawn head, whose voxels are 1 mm wide at a size of 190; or a scan in a file. A patch
in its middle is dragged by a voxel at a time in a slice, and let go. No window is opened: what a
window adds is drawing one slice.
"""

from __future__ import annotations

import argparse
import queue
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from napari_hmrf import Arrow, Drawing, Grid, Motion, Pictures, Study, solve
from napari_hmrf.data import head_phantom
from napari_hmrf.io.images import read_image
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.coarse_grid import CoarseGrid, Glance
from napari_hmrf.study.drag_preview import PREVIEW_SITES
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.ground import build_problem


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=190)
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--image", type=Path)
    options = parser.parse_args()
    if options.image is None:
        head = head_phantom(options.size)
        pixels, spacing = head.image, head.spacing
    else:
        image = read_image(options.image)
        pixels = image.pixels
        spacing = (1.0,) * 3 if image.place is None else image.place.spacing
    still = Study(
        Grid(pixels.shape, tuple(spacing), "millimeter"),
        motion=Motion(hold_edge=True),
        optimizer=Multigrid(TOLERANCE),
        pictures=Pictures(pixels),
    )
    middle = tuple(size / 2 for size in pixels.shape)
    glance = Glance(CoarseGrid.of_at_most(PREVIEW_SITES, pixels.shape), 0, pixels.shape[0] // 2)
    print(f"{' x '.join(map(str, pixels.shape))} voxels; every {glance.grid.step}th while it moves")
    answers: queue.Queue[Deformation] = queue.Queue()
    engine = Engine(answers.put, "a benchmark")

    def pulled(far: float) -> Study:
        by = (0.0, 0.6 * far, 0.8 * far)
        marks = (Arrow(middle, by, 10.0 * min(spacing)),)
        return replace(still, motion=replace(still.motion, drawing=Drawing(marks)))

    def wait(study: Study, glance: Glance | None) -> float:
        since = time.perf_counter()
        engine.submit(study, glance=glance)
        answer = answers.get(timeout=600)
        if answer.error is not None:
            raise answer.error
        return time.perf_counter() - since

    try:
        print(f"first picture: {wait(pulled(1), glance):.2f} s")
        seconds = [wait(pulled(2 + 0.5 * step), glance) for step in range(options.moves)]
        print(
            f"then one in {np.median(seconds):.3f} s, {1 / np.median(seconds):.1f} a second "
            f"(slowest {max(seconds):.3f} s)"
        )
        for which in ("the first time", "again"):
            wait(pulled(3.0), glance)
            last = pulled(2 + 0.5 * options.moves)
            after = wait(last, None)
            print(f"all of it {after:.2f} s after that, {which}")
        stated = build_problem(last)
        since = time.perf_counter()
        solution = solve(stated.problem, stated.prior, optimizer=stated.optimizer)
        alone = time.perf_counter() - since
        print(
            f"a solve alone {alone:.2f} s ({solution.iterations} cycles): "
            f"again took {after / alone:.2f} times as long"
        )
    finally:
        engine.close()


if __name__ == "__main__":
    main()
