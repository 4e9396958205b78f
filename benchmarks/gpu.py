"""Work of the host beside the shaders: time, dispatches, and bytes to and from the device.

    python -m benchmarks.gpu --host [--sizes SIZE ...] [--turns 5]

Solves the sample "mass-effect" to 0.01 pixels, warm, and one frame of a drag, with fragment and
with compute shaders. *Host* is the time outside of OpenGL calls; the time inside them is that of a
software renderer, or of waiting for a card. Bytes are given per site, beside those of m, y and c
(20 bytes per site). The medians of several turns are printed.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import moderngl

from benchmarks.clock import conditions
from benchmarks.speed import ELASTIC, PHANTOM, WITHIN, moved_patch
from benchmarks.table import head, line
from napari_hmrf import LiveSolver, Problem, Update, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.opengl.context.device import the_device

# Methods of moderngl that call OpenGL; those that start a shader; and those that copy data.
_CALLS = {
    moderngl.Context: (
        "texture", "framebuffer", "buffer", "memory_barrier", "vertex_array", "depth_texture",
    ),
    moderngl.Texture: ("use", "bind_to_image", "release"),
    moderngl.Framebuffer: ("use", "clear", "release"),
    moderngl.Buffer: ("bind_to_storage_buffer", "clear", "release"),
    moderngl.Uniform: ("write",),
}  # fmt: skip
_STARTS = {moderngl.ComputeShader: ("run",), moderngl.VertexArray: ("render",)}
_UP = {moderngl.Texture: ("write",), moderngl.Buffer: ("write",)}
_DOWN = {moderngl.Texture: ("read", "read_into"), moderngl.Buffer: ("read", "read_into")}


@dataclass
class Meter:
    """Totals of OpenGL calls.

    Attributes
    ----------
    seconds : float
        Time inside the calls.
    dispatches, up, down : int
        Number of shaders that were started, and bytes that were written and read.
    """

    seconds: float = 0.0
    dispatches: int = 0
    up: int = 0
    down: int = 0
    _depth: int = 0

    def watch(self, call: Callable[..., Any], kind: str) -> Callable[..., Any]:
        """Return a call that is measured; calls inside of it belong to it."""

        @functools.wraps(call)
        def watched(*given: Any, **named: Any) -> Any:
            begun, self._depth = time.perf_counter(), self._depth + 1
            try:
                found = call(*given, **named)
            finally:
                self._depth -= 1
            if self._depth:
                return found
            self.seconds += time.perf_counter() - begun
            self.dispatches += kind == "start"
            if kind == "up":
                self.up += memoryview(given[1]).nbytes
            elif kind == "down":
                self.down += memoryview(given[1] if found is None else found).nbytes
            return found

        return watched

    @contextlib.contextmanager
    def on(self) -> Iterator[None]:
        """Measure the calls inside the block."""
        with contextlib.ExitStack() as stack:
            kinds = {"": _CALLS, "start": _STARTS, "up": _UP, "down": _DOWN}
            for kind, classes in kinds.items():
                for of, names in classes.items():
                    for name in names:
                        self._replace(stack, of, name, kind)
            device = compute_thread.result_of(the_device, "opening the device")
            self._replace(stack, device, "finish", "")
            yield

    def _replace(self, stack: contextlib.ExitStack, owner: Any, name: str, kind: str) -> None:
        before = getattr(owner, name)
        stack.callback(setattr, owner, name, before)
        setattr(owner, name, self.watch(before, kind))


# Bytes of m, y and c per site.
_GIVEN = 20
# Number of turns before those that are measured.
_WARM = 4


class Work(NamedTuple):
    """Work that is measured.

    Attributes
    ----------
    prepare : callable
        Returns the problem of a turn, given its number.
    run : callable
        Solves a problem.
    """

    prepare: Callable[[int], Problem]
    run: Callable[[Problem], object]


def measured(work: Work, turns: int) -> list[float]:
    """Return medians: host and OpenGL in ms, dispatches, and bytes up and down."""
    for turn in range(_WARM):
        work.run(work.prepare(turn))
    found = []
    for turn in range(_WARM, _WARM + turns):
        meter, problem = Meter(), work.prepare(turn)
        with meter.on():
            begun = time.perf_counter()
            work.run(problem)
            seconds = time.perf_counter() - begun
        host = 1e3 * (seconds - meter.seconds)
        found.append((host, 1e3 * meter.seconds, meter.dispatches, meter.up, meter.down))
    return [statistics.median(column) for column in zip(*found, strict=True)]


def works(size: int, backend: str) -> dict[str, Work]:
    """Return a warm solve, and a frame of a drag that moves a patch by a pixel."""
    given = phantom(PHANTOM, size).problem
    solve(given, ELASTIC, optimizer=WITHIN, backend="cpu")  # compiles the loops of the host's part
    frames = [moved_patch(given, pixels) for pixels in (0.0, 1.0, 0.5)]
    answers: list[Update] = []

    def warm(problem: Problem) -> None:
        solve(problem, ELASTIC, optimizer=WITHIN, backend=backend)

    live = LiveSolver(answers.append, ELASTIC, backend=backend)

    def frame(problem: Problem) -> None:
        live.submit(problem)
        live.wait()
        if answers[-1].solution is None:
            raise SystemExit(f"the problem of the benchmark was refused: {answers[-1].error}")

    return {
        "solve": Work(lambda _: _copy(given), warm),
        "drag frame": Work(lambda turn: _copy(frames[turn % len(frames)]), frame),
    }


def _copy(problem: Problem) -> Problem:
    """Return an equal problem that was validated again, from other arrays."""
    names = "observed", "confidence", "stiffness"
    return replace(problem, **{name: getattr(problem, name).copy() for name in names})


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--host", action="store_true", help="measure the work of the host")
    parser.add_argument("--sizes", type=int, nargs="+", default=[300, 600, 1200])
    parser.add_argument("--turns", type=int, default=5)
    options = parser.parse_args()
    if not options.host:
        parser.error("give --host; for the speed of the shaders, see benchmarks.speed shaders")
    print(conditions())
    titles = "size", "shaders", "work", "host, ms", "OpenGL, ms", "dispatches", "up", "down"
    print(head(titles))
    for size in options.sizes:
        for stage in ("fragment", "compute"):
            for title, work in works(size, f"opengl:{stage}").items():
                host, inside, starts, up, down = measured(work, options.turns)
                sites = size * size
                cells = (
                    f"{size}", stage, title, f"{host:.1f}", f"{inside:.0f}", f"{starts:.0f}",
                    f"{up / sites:.1f}", f"{down / sites:.1f}",
                )  # fmt: skip
                print(line(cells), flush=True)
    print(f"Bytes up and down: per site; m, y and c have {_GIVEN}.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
