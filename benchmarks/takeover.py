"""The loops take over from shaders in the middle of a drag: which pictures are late, and by what.

``python benchmarks/first.py --takeover`` runs this in a process of its own.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
from live import Drag

from napari_hmrf import ElasticPrior, Multigrid, Solution, solve
from napari_hmrf.solver.backends.compile_cache import compiler, kept, loader
from napari_hmrf.solver.live_solver import TOLERANCE, Update

#: Movements of the mouse a second; and for how long a drag goes on before and after.
_EVENTS, _BEFORE, _AFTER = 60.0, 8.0, 8.0
#: Somebody who drags and looks, in turns of so many seconds; and when that is given up.
_TURN, _LOOK, _MOST = 3.0, 3.0, 1500.0


def drag(size: int, compiled: bool) -> None:
    """Drag a patch until the loops have taken over; print how long pictures stood still.

    Parameters
    ----------
    size : int
        Sites along a side of the picture.
    compiled : bool
        Whether the loops lie in numba's folder already; they are told to be ready after a while.
        If not, the compiler runs beside the drag, which then has the pauses of a person: it takes
        only what nobody needs.
    """
    with _shown_later() if compiled else contextlib.nullcontext(_nothing) as show:
        hand, begun = Drag(size), time.perf_counter()
        noticed = taken = 0.0
        moments: list[float] = []
        pause = threading.Event()
        while not taken or time.perf_counter() < taken + _AFTER:
            now = time.perf_counter()
            if now > begun + _MOST:
                raise SystemExit(
                    f"the loops were not there after {_MOST:.0f} s: try a smaller size"
                )
            if moments and now > moments[0] + _BEFORE:
                show()
            turns, part = divmod(now - begun, _TURN + _LOOK)
            if compiled:
                hand.move(now - begun)
            elif part < _TURN:
                hand.move(turns * _TURN + part)
            pause.wait(1 / _EVENTS)
            noticed = noticed or (now if loader.begun() else 0.0)
            for update in hand.shown[len(moments) :]:
                moments.append(time.perf_counter())
                if not taken and update.solution.provenance.backend == "cpu":
                    taken = moments[-1]
    hand.live.wait()
    hand.live.close()
    first = moments.index(taken)
    loading = next(n for n, moment in enumerate(moments) if moment >= noticed)
    print(f"{size} x {size}, {len(moments)} pictures in {moments[-1] - begun:.0f} s")
    print("the loops", "told to be there" if compiled else "compiled meanwhile", end=", ")
    print(f"found after {noticed - begun:.1f} s, in use {taken - noticed:.1f} s later")
    print("from movement to picture:")
    for when, part in (
        ("before", slice(2, loading)),
        ("loading", slice(loading, first)),
        ("take-over", slice(first, first + 1)),
        ("next", slice(first + 1, first + 2)),
        ("after", slice(first + 2, None)),
    ):
        print(f"{when:10} {_milliseconds(hand.late[part])}")
    if compiled:
        print("from picture to picture, and how many gaps were of two pictures or more:")
        usual = float(np.median(np.diff(moments[1:loading])))
        for when, part in (
            ("before", slice(1, loading)),
            ("loading", slice(loading - 1, first)),
            ("take-over", slice(first - 1, first + 1)),
            ("next", slice(first, first + 2)),
            ("after", slice(first + 1, None)),
        ):
            gaps = np.diff(moments[part])
            lost = int((gaps >= 2 * usual).sum())
            print(f"{when:10} {_milliseconds(gaps)}, {lost}")
    print(_change("the last picture by shaders", hand.shown[first - 1], "cpu"))
    print(_change("the first picture by loops", hand.shown[first], "opengl"))


def _milliseconds(seconds: Sequence[float] | npt.NDArray[np.float64]) -> str:
    """The middle and the largest of some times, and how many they are."""
    middle, most = 1e3 * np.percentile(seconds, (50, 100)) if len(seconds) else (math.nan, math.nan)
    return f"{middle:6.0f} ms, at most {most:6.0f} ({len(seconds)})"


def _nothing() -> None:
    """There is nothing to show."""


@contextlib.contextmanager
def _shown_later() -> Iterator[Callable[[], None]]:
    """Hide that there are loops, from the compiler as well; what is given shows it again."""
    mark, compile_meanwhile = kept.mark(), compiler.compile_meanwhile
    if not mark.exists():
        raise SystemExit(
            f"{mark.parent} has no loops of this version. Compile them with "
            f"NUMBA_CACHE_DIR={mark.parent} python -m napari_hmrf.compiling"
        )
    parts = sorted(mark.parent.glob(f"{mark.stem}-*{mark.suffix}"))
    for each in (mark, *parts):
        each.rename(each.with_suffix(".hidden"))

    def show() -> None:
        for each in (*parts, mark):
            if each.with_suffix(".hidden").exists():
                each.with_suffix(".hidden").rename(each)

    # It would find all loops at once, and say so.
    compiler.compile_meanwhile = _nothing
    try:
        yield show
    finally:
        compiler.compile_meanwhile = compile_meanwhile
        show()


def _change(what: str, update: Update, backend: str) -> str:
    """How far the field would be from there by the others, and what both report."""
    assert update.problem is not None
    assert update.solution is not None
    shown: Solution = update.solution
    other = solve(update.problem, ElasticPrior(), optimizer=Multigrid(TOLERANCE), backend=backend)
    off = np.abs(other.displacement - shown.displacement).max() / update.problem.unit
    errors = [each.convergence.error for each in (shown, other) if each.convergence is not None]
    return (
        f"{what}: {off:.2g} px from the field of {backend}, both reporting "
        f"{' + '.join(f'{error:.2g}' for error in errors)} = {sum(errors):.2g} px"
    )
