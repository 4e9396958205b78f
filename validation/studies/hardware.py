"""Limits of the hardware: compiled loops beside the processor, and shaders beside a graphics card.

`roofline` solves a volume (an ellipsoid that fills 41 % of its grid, held at its surface, in which
a ball grows) and the sample image `expansion` to 0.001 pixels; ``--sizes 128 1200`` sets sizes.
Kernels skip void, so they are counted per site of tissue; operations are counted in the source of
the loops, and each array is read or written once, as if all neighbours came from a cache. With
NUMBA_NUM_THREADS=1, times are those of the processor, so that other programs hardly matter. `gpu`
solves to 0.01 pixels by shaders and by the loops on all cores; its times are medians of warm
solves, with set-up, upload and read-back.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import os
import statistics
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")

import numba
import numpy as np

from benchmarks.clock import Times, fastest, median_times, now, timed
from benchmarks.speed import ellipsoid, growing
from napari_hmrf import ICM, BackendError, ElasticPrior, Multigrid, Problem, Solution, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.cpu import elastic, endings, forces, hexahedra, vectors, volume
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import Prior, SeilerPrior
from validation.study import Options, Results, Table, Target, study

_PRIOR = ElasticPrior(0.45)

# Compiled loops.

# Number of float32 values that are copied, and number of repetitions of each measurement.
_COPIED_BY_LOOPS, _REPEATS = 2**25, 5
# Number of values that remain in registers or the first cache, and number of passes over them.
_RESIDENT, _PASSES = 256, 10_000


class Kernel(NamedTuple):
    """A kernel, the loops that it runs for each site, and the memory that it moves.

    Attributes
    ----------
    module : module
    name : str
    loops : tuple of (float, function)
        Loops of the kernel, and how often each runs for a site.
    size : float
        Bytes read and written for each site.
    """

    module: ModuleType
    name: str
    loops: tuple[tuple[float, Any], ...]
    size: float


_FORCES = ((3, hexahedra._faces), (1, hexahedra._elements), (3, hexahedra._gather))
_PULLS = ((1, forces._pulls), (1, forces.row_force))
_START = ((1, elastic._start_row), (1, elastic._smooth_row))
_ADVANCE = ((3, volume._advance_line), (3, volume._subtract_line), (3, volume._square_line))
_RESTRICT = ((27 / 4, volume._add_line), (3 / 8, volume._sum_pairs))
_INTERPOLATE = ((3 / 2, volume._mean_line), (3 / 2, volume._add_between))
VOLUME = (
    Kernel(volume, "smooth", (*_FORCES, (3, endings.smooth_line)), 64),
    Kernel(volume, "rest", (*_FORCES, (3, endings.residual_line)), 52),
    Kernel(volume, "start", ((3, volume.start),), 36),
    Kernel(volume, "restrict", _RESTRICT, 13.5),
    Kernel(volume, "interpolate", _INTERPOLATE, 37.5),
    Kernel(volume, "advance", _ADVANCE, 96),
    Kernel(vectors, "lean", ((1, vectors.lean),), 12),
    Kernel(vectors, "weigh", ((3, vectors.row_product),), 24),
    Kernel(vectors, "product", ((3, vectors.row_product),), 24),
)
IMAGE = (
    Kernel(elastic, "begin", (*_PULLS, *_START), 32),
    Kernel(elastic, "smooth", (*_PULLS, (1, elastic._smooth_row)), 48),
    Kernel(elastic, "leave", (*_PULLS, (1, elastic._rest_row)), 34),
    Kernel(elastic, "apply", (*_PULLS, (1, elastic._apply_row)), 32),
    Kernel(elastic, "interpolate", ((1, vectors.interpolate_row),), 26),
    Kernel(vectors, "advance", ((2, vectors.advance), (2, vectors.row_product)), 48),
    Kernel(vectors, "lean", ((2, vectors.lean),), 24),
    Kernel(vectors, "weigh", ((2, vectors.row_product),), 16),
)


class _Counter(ast.NodeVisitor):
    """Counter of additions, subtractions and multiplications, without those of indices."""

    def __init__(self) -> None:
        self.count = 0

    def visit_Subscript(self, node: ast.Subscript) -> None:
        """Skip the index."""
        self.visit(node.value)

    def visit_Assign(self, node: ast.Assign) -> None:
        """Skip assignments to the indices i and j."""
        if ast.unparse(node.targets[0]) not in ("i", "j"):
            self.visit(node.value)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Count the operation."""
        self.count += isinstance(node.op, ast.Add | ast.Sub | ast.Mult)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Count the operation."""
        self.count += 1
        self.visit(node.value)


class _WithoutData(ast.NodeTransformer):
    """Transformer that keeps only the branches for problems without a data term."""

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        """Replace a comparison with None by the branch for None."""
        self.generic_visit(node)
        test = ast.unparse(node.test)
        if test.endswith("is not None"):
            return node.orelse
        return node.body if test.endswith("is None") else node


def _has_loop(node: ast.AST) -> bool:
    return any(isinstance(each, ast.For) for each in ast.walk(node))


def operations(function: Any) -> int:
    """Return the number of operations in the innermost loops, or in all code without loops."""
    tree = _WithoutData().visit(
        ast.parse(
            textwrap.dedent(inspect.getsource(getattr(function, "compiled", function).py_func))
        )
    )
    counter = _Counter()
    loops = [each for each in ast.walk(tree) if isinstance(each, ast.For)]
    bodies = [each.body for each in loops if not any(map(_has_loop, each.body))]
    for statement in itertools.chain.from_iterable(bodies or [tree.body]):
        counter.visit(statement)
    return counter.count


@numba.njit(parallel=True)  # type: ignore[untyped-decorator]
def _copy(source, target):  # type: ignore[no-untyped-def]
    for i in numba.prange(len(source)):
        target[i] = source[i]


@numba.njit(parallel=True, fastmath={"contract"})  # type: ignore[untyped-decorator]
def _multiply_add(values, factor, term, passes):  # type: ignore[no-untyped-def]
    for thread in numba.prange(len(values)):
        for _ in range(passes):
            for i in range(_RESIDENT):
                value = values[thread, i]
                for _ in range(8):
                    value = value * factor + term
                values[thread, i] = value


def _seconds(times: Times) -> float:
    """Return the processor time if there is one thread, which other processes do not increase."""
    return times.processor if numba.get_num_threads() == 1 else times.wall


def _least(run: Callable[[], object]) -> float:
    """Return the least time of several runs, in seconds."""
    run()
    return _seconds(fastest(run, _REPEATS)[1])


def limits() -> tuple[float, float]:
    """Return bytes copied, and operations of fused multiply-adds, per nanosecond of all cores."""
    source, target = np.ones((2, _COPIED_BY_LOOPS), dtype=np.float32)
    copied = 8e-9 * _COPIED_BY_LOOPS / _least(lambda: _copy(source, target))
    values = np.ones((numba.get_num_threads(), _RESIDENT), dtype=np.float32)
    factor, term = np.float32(0.5), np.float32(0.5)
    seconds = _least(lambda: _multiply_add(values, factor, term, _PASSES))
    return copied, 2e-9 * 8 * values.size * _PASSES / seconds


class Timer:
    """Replacement of a kernel that measures its time on the finest level.

    Parameters
    ----------
    kernel : Kernel
    sites : int
        Number of tissue sites of the finest grid; smaller arrays belong to coarser levels.
    """

    def __init__(self, kernel: Kernel, sites: int) -> None:
        self._run, self._sites = getattr(kernel.module, kernel.name), sites
        self._batches = kernel.module is volume and kernel.name == "smooth"
        self._own = 0 if kernel.name != "interpolate" else 1  # the first array is coarse there
        self.seconds, self.calls = 0.0, 0

    def __call__(self, *arguments: Any) -> Any:
        """Run the kernel."""
        return self._timed(self._run, arguments)

    def in_turns(self, count: int, *arguments: Any) -> None:
        """Run the kernel in several turns."""
        self._timed(partial(self._run.in_turns, count), arguments)

    def _timed(self, run: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        arrays = [
            each
            for each in arguments
            if isinstance(each, np.ndarray) and each.ndim > 1 and each.dtype.kind == "f"
        ]
        result, times = timed(lambda: run(*arguments))
        if arrays[self._own][0].size >= self._sites:
            steps = len(arguments[-2]) if self._batches else 1
            self.seconds += _seconds(times)
            self.calls += steps
        return result


def grids(options: Options) -> dict[str, tuple[str, tuple[Kernel, ...], Problem, int]]:
    """Return the kernels, the problem and the number of solves of a volume and an image."""
    size, side = options.sizes_or((128, 1200), (24, 96))
    solves = options.count or options.choose(5, 1)
    return {
        "volume": ("volume", VOLUME, ellipsoid(size), solves),
        "image": ("image", IMAGE, phantom("expansion", size=side).problem, solves),
    }


_ROOFLINE = ("calls a cycle", "operations a site", "bytes a site", "ns a site")
_ROOFLINE += ("ns to copy", "ns to compute", "distance", "share of the solve")


@study("hardware.roofline", grids, lambda results: results.values(), page="roofline.md")
def roofline(case: tuple[str, tuple[Kernel, ...], Problem, int]) -> Table:
    """Compare each kernel with the speed of a copy and of arithmetic."""
    name, kernels, problem, solves = case

    def run() -> int:
        found = solve(problem, _PRIOR, optimizer=Multigrid(), backend="cpu")
        return found.iterations

    run()
    copied, computed = limits()
    least: defaultdict[str, float] = defaultdict(lambda: np.inf)
    for _ in range(solves):
        originals = [getattr(each.module, each.name) for each in kernels]
        timers = [Timer(each, int(problem.tissue.sum())) for each in kernels]
        for kernel, timer in zip(kernels, timers, strict=True):
            setattr(kernel.module, kernel.name, timer)
        cycles, times = timed(run)
        whole = _seconds(times)
        for kernel, original in zip(kernels, originals, strict=True):
            setattr(kernel.module, kernel.name, original)
        for kernel, timer in zip(kernels, timers, strict=True):
            least[kernel.name] = min(least[kernel.name], timer.seconds)
        rest = whole - sum(timer.seconds for timer in timers)
        least["rest of the solve"] = min(least["rest of the solve"], rest)
        copied, computed = map(max, zip((copied, computed), limits(), strict=True))
    sites = int(problem.tissue.sum())
    size = " x ".join(map(str, problem.shape))
    words = f"{size} sites, {100 * problem.tissue.mean():.0f} % tissue, {cycles} cycles"
    speeds = f"copied: {copied:.1f} GB/s; multiply-adds: {computed:.0f} GFLOP/s"
    rows = []
    whole = sum(least.values())
    for kernel, timer in zip(kernels, timers, strict=True):
        count = sum(times * operations(loop) for times, loop in kernel.loops)
        each = 1e9 * least[kernel.name] / max(timer.calls, 1) / sites
        memory, arithmetic = kernel.size / copied, count / computed
        rows.append(
            [
                kernel.name,
                f"{timer.calls / cycles:.1f}",
                f"{count:.0f}",
                f"{kernel.size:g}",
                f"{each:.2f}",
                f"{memory:.2f}",
                f"{arithmetic:.2f}",
                f"{each / max(memory, arithmetic):.1f}",
                f"{100 * least[kernel.name] / whole:.0f} %",
            ]
        )
    rest = 100 * least["rest of the solve"] / whole
    rows.append(["rest of the solve", *[""] * (len(_ROOFLINE) - 1), f"{rest:.0f} %"])
    print(f"{words}; {numba.get_num_threads()} threads; {speeds}")
    return Table((f"kernel of the {name}", *_ROOFLINE), lambda _: rows)


# Shaders.

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
                moments.append(now().wall)

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


class OnCard(NamedTuple):
    """Problem that is solved by shaders of some stages, and the number of repeated solves."""

    name: str
    problem: Problem
    speeds: dict[str, float]
    repeats: int


def on_card(options: Options) -> Iterator[tuple[str, OnCard]]:
    """Yield images, and volumes with a held and with a free border, with the speeds of copies."""
    speeds = copy_speeds()
    device = compute_thread.submit(the_device).result()
    print(f"{device.renderer}; loops on {os.cpu_count()} cores")
    for stage, speed in speeds.items():
        print(f"a {stage} shader copies {speed / 1e9:.0f} GB/s")
    repeats = options.count or options.choose(9, 1)
    for size in options.choose((300, 600, 1200, 2400), (48,)):
        name, problem = f"{size} x {size}", phantom("expansion", size).problem
        yield name, OnCard(name, problem, speeds, repeats)
    compute = {stage: speed for stage, speed in speeds.items() if stage == "compute"}
    for size, free in itertools.product(options.choose((64, 128, 192, 256), (12,)), (False, True)):
        name = f"{'ball' if free else 'cube'}, {size}^3"
        yield name, OnCard(name, growing(size, free), compute, repeats)


def _differences(results: Results) -> Iterator[Target]:
    apart = [float(row[7]) for rows in results.values() for row in rows if len(row) > 3]
    if apart:
        claim = "shaders to loops: largest difference in px"
        yield Target(claim, max(apart), 2 * TOLERANCE)


_CARD = ("tissue", "shaders", "solve, ms", "cycles", "a cycle, ms", "bytes a site")
_CARD += ("loops on all cores, ms", "difference, px", "paper's schedule, ms")


@study("hardware.gpu", on_card, _CARD, targets=_differences, page="gpu.md", on_request=True)
def shaders(case: OnCard) -> Iterator[list[Any]]:
    """Compare shaders with loops, and a cycle with the speed of the card's memory.

    *Bytes a site* is the amount that a copy moves in the time of a cycle.
    """
    optimizer, problem = Multigrid(TOLERANCE), case.problem
    loops = measure(problem, _PRIOR, optimizer, "cpu", max(1, case.repeats // 3))
    for stage, speed in case.speeds.items():
        try:
            found = measure(problem, _PRIOR, optimizer, f"opengl:{stage}", case.repeats)
        except BackendError as error:
            yield [case.name, stage, str(error)]
            continue
        paper = ""
        if not problem.is_volume:
            schedule = measure(problem, SeilerPrior(), ICM(), f"opengl:{stage}", case.repeats)
            paper = f"{1e3 * schedule.seconds:.1f}"
        apart = np.abs(found.solution.displacement - loops.solution.displacement).max()
        yield [
            case.name,
            stage,
            f"{1e3 * found.seconds:.1f}",
            found.solution.iterations,
            f"{1e3 * found.cycle:.2f}",
            f"{found.cycle * speed / math.prod(problem.shape):.0f}",
            f"{1e3 * loops.seconds:.1f}",
            f"{apart:.4f}",
            paper,
        ]
