"""Benchmark of the shaders on a graphics card: images and volumes, beside the speed of its memory.

    python benchmarks/gpu.py [--images 300 600 1200 2400] [--volumes 64 128 192 256] [--repeats 9]

Prints the renderer, and the speed at which a shader copies memory, in bytes read and written per
second. Then, for each image and volume: the wall time of a warm solve to 0.01 px, including set-up,
upload and read-back; the time of a multigrid cycle; the number of bytes a site that a copy moves in
the time of that cycle, which measures the distance of the kernels to the speed of the memory; the
time of the compiled loops on all cores; and the largest difference of the two fields. For images,
also the time of the paper's schedule. Exits with 1 if two fields differ by more than 0.02 px.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from clock import Times, median_times, timed
from speed import growing
from table import head, line

from napari_hmrf import ICM, BackendError, ElasticPrior, Multigrid, Problem, Solution, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import Prior, SeilerPrior

TOLERANCE = 0.01
#: Number of float32 values that the measurement of memory copies.
_COPIED = 2**26

_COPY_IMAGE = """
#version 330
uniform sampler2D source;
out vec4 copied;
void main() { copied = texelFetch(source, ivec2(gl_FragCoord.xy), 0); }
"""
_WHOLE_IMAGE = """
#version 330
void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.5, 1.0); }
"""
_COPY_BUFFER = """
#version 430
layout(local_size_x = 256) in;
layout(std430, binding = 0) readonly buffer Source { vec4 source[]; };
layout(std430, binding = 1) writeonly buffer Copied { vec4 copied[]; };
void main()
{
    uint item = gl_GlobalInvocationID.y * gl_NumWorkGroups.x * 256u + gl_GlobalInvocationID.x;
    copied[item] = source[item];
}
"""


class Measured(NamedTuple):
    """Solution, its wall time, and the median time of a cycle, in seconds."""

    solution: Solution
    seconds: float
    cycle: float


def measure(
    problem: Problem, prior: Prior, optimizer: Optimizer, backend: str, repeats: int
) -> Measured:
    """Return the median times of warm solves."""
    solve(problem, prior, optimizer=optimizer, backend=backend)
    times: list[Times] = []
    cycles: list[float] = []
    for _ in range(repeats):
        moments: list[float] = []

        def note(monitor: Monitor, moments: list[float] = moments) -> None:
            if monitor.message.startswith("cycle"):
                moments.append(time.perf_counter())

        run = partial(solve, problem, prior, optimizer=optimizer, backend=backend, progress=note)
        found, own = timed(run)
        times.append(own)
        cycles += np.diff(moments).tolist()
    cycle = statistics.median(cycles) if cycles else math.nan
    return Measured(found, median_times(times).wall, cycle)


def copy_speeds() -> dict[str, float]:
    """Return the bytes read and written per second when a shader of each stage copies memory."""
    return compute_thread.submit(_copy_speeds).result()


def _copy_speeds() -> dict[str, float]:
    device = the_device()
    ctx, side = device.ctx, math.isqrt(_COPIED // 4)
    speeds = {}
    textures = [device.texture((side, side), 4) for _ in range(2)]
    program = ctx.program(vertex_shader=_WHOLE_IMAGE, fragment_shader=_COPY_IMAGE)
    array = ctx.vertex_array(program, [])
    targets = [device.framebuffer([texture]) for texture in textures]

    def draw() -> None:  # there and back, because a software renderer skips overwritten draws
        for texture, target in zip(textures, reversed(targets), strict=True):
            target.use()
            texture.use()
            array.render(vertices=3)

    speeds["fragment"] = 2 * _bytes_per_second(draw, device.finish)
    device.free([*targets, *textures, array, program])
    if "compute" in device.stages:
        buffers = [device.buffer(4 * _COPIED) for _ in range(2)]
        copy = ctx.compute_shader(_COPY_BUFFER)
        for place, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(place)
        groups = _COPIED // 4 // 256
        speeds["compute"] = _bytes_per_second(lambda: copy.run(256, groups // 256), device.finish)
        device.free([*buffers, copy])
    device.check("measuring the speed of memory")
    return speeds


def _bytes_per_second(
    run: Callable[[], object], finish: Callable[[], object], times: int = 20
) -> float:
    """Return the bytes read and written per second by a function that copies the memory once."""

    def copies() -> None:
        for _ in range(times):
            run()
        finish()

    run()
    finish()
    return 2 * 4 * _COPIED * times / timed(copies)[1].wall


def print_row(
    name: str, problem: Problem, stages: Sequence[str], speeds: dict[str, float], repeats: int
) -> float:
    """Print the rows of a problem, and return the largest difference to the compiled loops."""
    prior, optimizer = ElasticPrior(0.45), Multigrid(TOLERANCE)
    loops = measure(problem, prior, optimizer, "cpu", max(1, repeats // 3))
    sites = math.prod(problem.shape)
    largest = 0.0
    for stage in stages:
        try:
            found = measure(problem, prior, optimizer, f"opengl:{stage}", repeats)
        except BackendError as error:
            print(line([name, stage, error]))
            continue
        apart = float(np.abs(found.solution.displacement - loops.solution.displacement).max())
        largest = max(largest, apart)
        paper = ""
        if not problem.is_volume:
            schedule = measure(problem, SeilerPrior(), ICM(), f"opengl:{stage}", repeats)
            paper = f"{1e3 * schedule.seconds:.1f}"
        cells = [
            name,
            stage,
            f"{1e3 * found.seconds:.1f}",
            found.solution.iterations,
            f"{1e3 * found.cycle:.2f}",
            f"{found.cycle * speeds[stage] / sites:.0f}",
            f"{1e3 * loops.seconds:.1f}",
            f"{apart:.4f}",
            paper,
        ]
        print(line(cells), flush=True)
    return largest


_TITLES = ("tissue", "shaders", "solve, ms", "cycles", "a cycle, ms", "bytes a site")
_TITLES += ("loops, ms", "difference, px", "paper's schedule, ms")


def main() -> int:
    """Print the tables; return 1 if a field of the shaders differs from that of the loops."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, nargs="*", default=[300, 600, 1200, 2400])
    parser.add_argument("--volumes", type=int, nargs="*", default=[64, 128, 192, 256])
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    speeds = copy_speeds()
    device = compute_thread.submit(the_device).result()
    print(f"{device.renderer}; loops on {os.cpu_count()} cores")
    for stage, speed in speeds.items():
        print(f"a {stage} shader copies {speed / 1e9:.0f} GB/s")
    print(f"\n{head(_TITLES)}")
    apart = 0.0
    for size in options.images:
        name = f"{size} x {size}"
        problem = phantom("expansion", size).problem
        apart = max(apart, print_row(name, problem, list(speeds), speeds, options.repeats))
    for size in options.volumes:
        for free, what in ((False, "cube"), (True, "ball")):
            problem = growing(size, free)
            row = print_row(f"{what}, {size}^3", problem, ["compute"], speeds, options.repeats)
            apart = max(apart, row)
    return int(apart > 2 * TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
