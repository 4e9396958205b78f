"""How long the device takes for elastic tissue: uploads and read-back apart, and what bounds it.

    python benchmarks/elastic_device.py [size ...]

prints, for each size and stage, the time of all cycles of a solve to 0.01 px, and the time in which
the memory could have carried what the cycles read and write, at the bandwidth that the simplest
pass over the same fields (two read, one written) reaches there.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from napari_hmrf import BackendError, ElasticPrior, Multigrid, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends import compute_thread, host
from napari_hmrf.solver.backends.opengl import OpenGLBackend
from napari_hmrf.solver.optimizers.cycle import Cycle
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients

STAGES = ("compute", "fragment")
# Fields of 8 bytes a site that a cycle reads and writes, if none is read twice: on every level
# (two steps from zero, what is left, two steps with the coarse correction), and on the finest
# (turn, apply with its shares, advance with its shares, a product and a largest value).
_ON_EACH_LEVEL = (3 + 2) + 4 + (4 + 2) + (5 + 2) + 1
_ON_THE_FINEST = 3 + (3 + 1.25) + (4 + 2.25) + 2 + 1


def least(job: Callable[[], Any], times: int) -> float:
    """The shortest time of several, in seconds."""
    best = np.inf
    for _ in range(times):
        started = time.perf_counter()
        job()
        best = min(best, time.perf_counter() - started)
    return float(best)


def measure(size: int, stage: str, times: int = 7) -> str:
    """Time the iteration of one solve; on the compute thread."""
    problem, prior = phantom("mass-effect", size).problem, ElasticPrior()
    cycles = solve(problem, prior, optimizer=Multigrid(0.01), backend=f"opengl:{stage}").iterations
    backend = OpenGLBackend(lambda: None, stage)
    try:
        model = backend.elastic_model(prior.material(problem))
        d, held = host.prescribed(problem)
        model.hold(held)
        residual = model.balance(d, None).rest.copy()
        finest, iteration = model.levels[0], ConjugateGradients(Cycle(model))

        def run(steps: int) -> None:
            left = iter(range(steps - 1))
            iteration.run(residual.copy(), lambda _: next(left, None) is None)

        run(cycles)
        # One step has all the uploads and read-back that many have.
        whole, one = least(lambda: run(cycles), times), least(lambda: run(1), times)
        seconds = (whole - one) / (cycles - 1) * cycles
        a, b, unit = finest.vector(), finest.vector(), finest.product(*[finest.vector()] * 2)

        def stream() -> None:
            for _ in range(20):
                finest.turn(a, b, unit)
            finest.read(unit)

        stream()
        sites = size * size
        bandwidth = 20 * 3 * 8 * sites / least(stream, times)
        moved = 8 * sites * cycles * (_ON_EACH_LEVEL * 5 / 3 + _ON_THE_FINEST)
        return (
            f"{size:5} {stage:9} {cycles:3} cycles {1e3 * seconds:9.2f} ms, "
            f"bound by {bandwidth / 1e9:6.0f} GB/s: {1e3 * moved / bandwidth:9.2f} ms"
        )
    finally:
        backend.close()


def main() -> None:
    """Measure the sizes that are asked for."""
    sizes = [int(word) for word in sys.argv[1:]] or [300, 600, 1200]
    for size in sizes:
        for stage in STAGES:
            try:
                print(compute_thread.submit(lambda s=size, k=stage: measure(s, k)).result())
            except BackendError as error:
                print(f"{size:5} {stage:9} {error}")


if __name__ == "__main__":
    main()
