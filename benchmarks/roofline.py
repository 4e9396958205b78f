"""Roofline of the compiled loops: operations and bytes of each kernel, and its distance to limits.

    python benchmarks/roofline.py [--volume 128] [--image 1200] [--solves 5]

Two limits are measured between the solves: bytes copied per second, read and written, and fused
multiply-adds per second in single precision. A volume (an ellipsoid that fills 41 % of its grid,
held at its surface, in which a ball grows) and the sample image `expansion` are solved to 0.001
pixels, with Poisson's ratio 0.45. For each kernel on the finest level, the table lists:

- the number of calls in a cycle;
- operations a site: additions, subtractions and multiplications in the loops of the kernel, counted
  in their source;
- bytes a site: each array read or written once, as if all neighbours came from a cache;
- the time of a call, in nanoseconds a site, as the smallest of all solves;
- the time that copying the bytes, or computing the operations, would take;
- the distance: time divided by the larger limit.

With NUMBA_NUM_THREADS=1, times are those of the processor, so that other programs hardly matter.
Kernels skip void, so they are counted per site of tissue. The last row contains all work outside
these kernels: coarser levels, set-up, and checks.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import itertools
import os
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")

import numba
import numpy as np
from clock import Times, timed
from speed import ellipsoid
from table import markdown

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.cpu import elastic, forces, hexahedra, vectors, volume

_POISSON = 0.45
# Number of float32 values that are copied, and number of repetitions of each measurement.
_COPIED, _REPEATS = 2**25, 5
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
    Kernel(volume, "smooth", (*_FORCES, (3, volume._smooth_line)), 64),
    Kernel(volume, "rest", (*_FORCES, (3, volume._rest_line)), 52),
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
    tree = _WithoutData().visit(ast.parse(textwrap.dedent(inspect.getsource(function.py_func))))
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
    return min(_seconds(timed(run)[1]) for _ in range(_REPEATS))


def limits() -> tuple[float, float]:
    """Return bytes copied, and operations of fused multiply-adds, per nanosecond of all cores."""
    source, target = np.ones((2, _COPIED), dtype=np.float32)
    copied = 8e-9 * _COPIED / _least(lambda: _copy(source, target))
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
        arrays = [
            each
            for each in arguments
            if isinstance(each, np.ndarray) and each.ndim > 1 and each.dtype.kind == "f"
        ]
        result, times = timed(lambda: self._run(*arguments))
        if arrays[self._own][0].size >= self._sites:
            steps = len(arguments[-2]) if self._batches else 1
            self.seconds += _seconds(times)
            self.calls += steps
        return result


def measure(kernels: tuple[Kernel, ...], problem: Problem, solves: int) -> str:
    """Return the table of a problem."""

    def run() -> int:
        found = solve(problem, ElasticPrior(_POISSON), optimizer=Multigrid(), backend="cpu")
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
    found = f"{size} sites, {100 * problem.tissue.mean():.0f} % tissue, {cycles} cycles"
    speeds = f"copied: {copied:.1f} GB/s; multiply-adds: {computed:.0f} GFLOP/s"
    titles = (
        "kernel",
        "calls a cycle",
        "operations a site",
        "bytes a site",
        "ns a site",
        "ns to copy",
        "ns to compute",
        "distance",
        "share of the solve",
    )
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
    rows.append(["rest of the solve", *[""] * (len(titles) - 2), f"{rest:.0f} %"])
    return f"{found}; {numba.get_num_threads()} threads; {speeds}\n\n{markdown(titles, rows)}"


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--volume", type=int, default=128, metavar="SIZE", help="0: skip")
    parser.add_argument("--image", type=int, default=1200, metavar="SIZE", help="0: skip")
    parser.add_argument("--solves", type=int, default=5)
    options = parser.parse_args()
    if options.volume:
        print(measure(VOLUME, ellipsoid(options.volume), options.solves), flush=True)
    if options.image:
        problem = phantom("expansion", size=options.image).problem
        print(f"\n{measure(IMAGE, problem, options.solves)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
