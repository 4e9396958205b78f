"""Speed of this package: wall time, processor time and peak memory of small cases.

    python -m benchmarks.speed [name ...] [--sizes SIZE ...] [--turns 9] [--seconds 2.5]
    python -m benchmarks.speed [name ...] --against FOLDER_OF_ANOTHER_CHECKOUT
    python -m benchmarks.speed --list

Each case runs in a process of its own, after a warm-up. Times are medians of several turns; the
processor time is that of all threads. If a case has a baseline, such as a linear solve of the same
problem, it runs in each turn too, and the table has the ratio of the processor times. The memory is
the peak of a run above the memory before it. NUMBA_NUM_THREADS=1 limits the compiled loops to one
thread.

With another checkout, processes of both take turns, so that other load on the machine affects both
equally. The table then has the ratios to the other checkout with 95 % intervals, and, as a control,
the ratio of a second process of this checkout to the first: an interval without 1 in this column
means that the comparison cannot be trusted. On a busy machine, the processor time is more reliable.
"""

from __future__ import annotations

import argparse
import atexit
import importlib.util
import itertools
import math
import operator
import statistics
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.checkouts import (
    CheckoutWorker,
    Turn,
    checkout,
    in_turn,
    ratio,
    serve,
    start_workers,
)
from benchmarks.clock import conditions, now, repeated, with_memory
from benchmarks.table import duration, head, line
from napari_hmrf import (
    ElasticPrior,
    LiveSolver,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Solution,
    Update,
    solve,
)
from napari_hmrf.data import head_phantom, phantom
from validation.bodies import (
    bar,
    between_plates,
    dragged_ball,
    dragged_disc,
    framed,
    growing_ball,
    turned,
)

Array = npt.NDArray[Any]
#: Name of the phantom of most cases in images.
PHANTOM = "mass-effect"
ELASTIC, LARGE = ElasticPrior(), NeoHookeanPrior()
#: Tolerance of solves, in pixels.
WITHIN = Multigrid(0.01)
#: Tolerance of a frame of a drag in large motion, in voxels.
_LIVE_VOXELS = Multigrid(0.1)
# Short runs are repeated within a turn for this time, in seconds.
_SHORT = 0.05
# Longest wait for a picture, in seconds.
_LATEST = 300.0
# Number of cases after which all processes of a batch have started.
_STARTED = 8


def _forget(prior: Any = ELASTIC, axes: int = 2, backend: str = "cpu") -> None:
    """Solve another tissue, so that the memory that the solver keeps for the last one is freed."""
    small = phantom("bar", 24).problem if axes == 2 else growing(12)
    solve(small, prior, optimizer=WITHIN, backend=backend)


class Work(NamedTuple):
    """Work of a case that is timed.

    Attributes
    ----------
    run : callable
        Function that is timed; its argument is the result of `prepare`.
    prepare : callable
        Called before each run, and not timed.
    baseline : Work, optional
        Work whose time is compared.
    note : callable
        Returns remarks about the result of a run.
    sites : int
        Number of sites, for the memory of each; 0 to omit it.
    forget : callable
        Called before the memory of a run is measured.
    """

    run: Callable[[Any], Any]
    prepare: Callable[[], Any] = lambda: None
    baseline: Work | None = None
    note: Callable[[Any], str] = lambda _: ""
    sites: int = 0
    forget: Callable[[], Any] = _forget


@dataclass(frozen=True)
class Case:
    """Case of this benchmark.

    Attributes
    ----------
    name, text : str
        Name for the command line, and description.
    prepare : callable
        Returns the work of a size, by title.
    sizes : tuple of int
        Default sizes, in sites along an axis.
    baseline : str
        Name of the baseline in the table.
    is_long : bool
        True if the case runs only if it is named.
    """

    name: str
    text: str
    prepare: Callable[[int], dict[str, Work]]
    sizes: tuple[int, ...]
    baseline: str = ""
    is_long: bool = False


CASES: dict[str, Case] = {}


def case(name: str, *sizes: int, baseline: str = "", is_long: bool = False) -> Callable[..., Any]:
    """Add a function that prepares work to the list of cases."""

    def add(prepare: Callable[[int], dict[str, Work]]) -> Callable[[int], dict[str, Work]]:
        text = (prepare.__doc__ or "").partition("\n")[0].rstrip(".")
        CASES[name] = Case(name, text, prepare, sizes, baseline, is_long)
        return prepare

    return add


# Solves of linear elasticity.


def _solve(
    problem: Problem, prior: Any = ELASTIC, backend: str = "cpu", **options: Any
) -> Solution:
    return solve(problem, prior, optimizer=WITHIN, backend=backend, **options)


def _in_other_units(problem: Problem) -> Callable[[], Problem]:
    """Return a function that returns the problem in another unit of stiffness at each call.

    The set-up of an earlier solve cannot be reused for it, so its solve is a cold start.
    """
    units = itertools.count(2)

    def fresh() -> Problem:
        return Problem(
            observed=problem.observed,
            confidence=problem.confidence,
            stiffness=problem.stiffness * np.float32(next(units)),
            spacing=problem.spacing,
            loads=problem.loads,
        )

    return fresh


def _cycles(found: Solution) -> str:
    return _number_of(found.iterations, "cycle")


def _number_of(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _cold(problem: Problem, prior: Any = ELASTIC, backend: str = "cpu") -> Work:
    """Return the work of a cold start."""
    return Work(
        partial(_solve, prior=prior, backend=backend),
        _in_other_units(problem),
        note=_cycles,
        sites=math.prod(problem.shape),
        forget=partial(_forget, axes=len(problem.shape), backend=backend),
    )


@case("solve", 300, 1200)
def solve_image(size: int) -> dict[str, Work]:
    """Cold solve of an image: tissue that was not solved before."""
    return {PHANTOM: _cold(phantom(PHANTOM, size).problem)}


@case("edit", 300, baseline="cold solves")
def edit(size: int) -> dict[str, Work]:
    """Warm solve of an image, after an eighth of the tumour's rim moved by a pixel."""
    before = phantom(PHANTOM, size).problem
    cold = _cold(moved_patch(before))

    def first() -> tuple[Problem, Any]:
        return moved_patch(before), _solve(before)

    def again() -> tuple[Problem, Any]:
        earlier = _solve(before)
        return moved_patch(before), [earlier, _solve(moved_patch(before, 0.5), initial=earlier)]

    def warm(given: tuple[Problem, Any]) -> Solution:
        return _solve(given[0], initial=given[1])

    return {
        "first move": Work(warm, first, cold, _cycles),
        "moved before": Work(warm, again, cold, _cycles),
    }


def moved_patch(problem: Problem, pixels: float = 1.0) -> Problem:
    """Return the problem with an eighth of its moving boundary moved further down."""
    y = problem.observed.copy()
    moving = (problem.confidence > 0).all(axis=-1) & (np.abs(y).max(axis=-1) > 0)
    place = np.argwhere(moving)
    angle = np.arctan2(*(place - place.mean(axis=0)).T)
    patch = place[np.abs(angle) < np.pi / 8]
    y[patch[:, 0], patch[:, 1], 0] += pixels
    return Problem(
        observed=y,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
    )


@case("volume", 64)
def solve_volume(size: int) -> dict[str, Work]:
    """Cold solve of volumes in which a ball grows."""
    return {
        "ellipsoid held at its surface": _cold(ellipsoid(size)),
        "cube held at its faces": _cold(growing(size)),
        "ball held at a cap": _cold(growing(size, free=True)),
    }


def ellipsoid(size: int) -> Problem:
    """Return an ellipsoid, 41 % of its grid, held at its surface, in which a ball grows."""
    sites = np.moveaxis(np.indices((size,) * 3, dtype=np.float32), 0, -1)
    places = sites * np.float32(2 / size) - 1
    depth = np.linalg.norm(places / np.float32((0.98, 0.95, 0.84)), axis=-1)
    y, c = _growing_skin(places, size)
    c[(depth > 1 - 4 / size) & (depth < 1)] = 1
    return Problem(observed=y, confidence=c, stiffness=np.where(depth < 1, 1.0, 0.0))


def growing(size: int, free: bool = False) -> Problem:
    """Return tissue in which a ball grows: a cube with fixed faces, or a ball with a fixed cap."""
    places = np.moveaxis(np.indices((size,) * 3), 0, -1) * (2 / size) - 1
    y, c = _growing_skin(places, size)
    m, far = np.ones((size,) * 3), np.linalg.norm(places, axis=-1)
    if free:
        m[far > 0.95] = 0
        c[(far > 0.9) & (places[..., 0] > 0.6)] = 1
    else:
        c[[0, -1]] = c[:, [0, -1]] = c[:, :, [0, -1]] = 1
    return Problem(observed=y, confidence=c, stiffness=m)


def _growing_skin(places: Array, size: int) -> tuple[Array, Array]:
    """Return the observations and the confidence of the skin of a ball that grows."""
    from_middle = places - np.float32((0.15, 0.1, 0.0))
    r = np.linalg.norm(from_middle, axis=-1)
    skin = (r < 0.25) & (r > 0.25 - 3 / size)
    y, c = np.zeros((2, *places.shape), dtype=np.float32)
    y[skin], c[skin] = 0.12 * size * from_middle[skin], 1
    return y, c


@case("shaders", 300, baseline="solves by compiled loops")
def shaders(size: int) -> dict[str, Work]:
    """Cold solve of an image by shaders."""
    problem = phantom(PHANTOM, size).problem
    work = _cold(problem, backend="opengl")
    return {PHANTOM: work._replace(baseline=_cold(problem))}


# Drags and warps.


@case("drag", 300, 1200)
def drag_image(size: int) -> dict[str, Work]:
    """One frame of a drag without a window: from the movement to the picture in memory."""
    from napari_hmrf.field.live_warp import Warper
    from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Rendering

    drawn = phantom(PHANTOM, size)
    base = Canvas.blank(drawn.image.shape[:2], drawn.problem.spacing)
    base.observed[...], base.confidence[...] = drawn.problem.observed, drawn.problem.confidence
    rendering, frames = Rendering(base), itertools.count(1)
    warper = Warper(np.stack([drawn.image] * 3, axis=-1), spacing=(1, 1))
    updates: list[Update] = []

    def show(update: Update) -> None:
        if update.solution is None:
            raise SystemExit(f"the problem of the benchmark was refused: {update.error}")
        warper(update.solution.displacement, update.solution.tissue)
        updates[:] = [update]

    live = LiveSolver(show, ELASTIC, backend="cpu")

    def arrow() -> Arrow:
        # The hand moves in a circle, one turn in two seconds at 60 movements per second.
        angle, reach = 2 * math.pi * next(frames) / 120, 0.03 * size
        by = reach * math.sin(angle), reach * (1 - math.cos(angle))
        return Arrow((0.5 * size, 0.3 * size), by, 0.04 * size)

    def problem(arrow: Arrow) -> Problem:
        rendering.show(Drawing((arrow,)))
        canvas = rendering.canvas
        return Problem(
            observed=canvas.observed,
            confidence=canvas.confidence,
            stiffness=drawn.problem.stiffness,
        )

    def frame(arrow: Arrow) -> Solution:
        live.submit(lambda: problem(arrow))
        live.wait()
        assert updates[0].solution is not None
        return updates[0].solution

    return {"a patch of the brain": Work(frame, arrow, note=_cycles)}


@case("drag-volume", 96)
def drag_volume(size: int) -> dict[str, Work]:
    """One picture of a drag in the 3-D view without a window, in a head of 0.83 x 1 x 0.83."""
    from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, Tissue
    from napari_hmrf.field.volume_preview import CutPlane
    from napari_hmrf.study.drag_preview import as_dragged, drag_preview
    from napari_hmrf.study.engine import Engine
    from napari_hmrf.study.study import Pictures

    image = textured_head(size)
    grid, tissue = Grid(image.shape, (1.0, 1.0, 1.0)), Tissue(stiffness=np.float32(image > 0))
    middle = tuple(extent / 2 for extent in image.shape)
    at, pictures = (middle[0], middle[1], 0.12 * image.shape[2]), Pictures(image=image)

    def works(plane: CutPlane | None) -> Work:
        answers, ready, moves = list[Any](), threading.Event(), itertools.count()

        def deliver(moved: Any) -> None:
            answers[:] = [moved]
            ready.set()

        engine = Engine(deliver, "a benchmark")

        def study() -> Study:
            move = next(moves) % 40 * 0.5
            drawing = Drawing((Arrow(at, (0.0, move, 2 * move), 10.0),))
            return Study(grid, tissue, Motion(hold_edge=True, drawing=drawing), pictures=pictures)

        def picture(study: Study) -> Solution:
            ready.clear()
            engine.submit(as_dragged(study), preview=drag_preview(study, cut=plane))
            if not ready.wait(_LATEST) or answers[0].solution is None:
                raise SystemExit("there was no picture")
            return answers[0].solution

        def note(found: Solution) -> str:
            sites = " x ".join(map(str, found.displacement.shape[:3]))
            return f"solve {duration(found.provenance.seconds)}, {sites} sites"

        return Work(picture, study, note=note)

    return {
        "surface": works(None),
        "oblique cut plane": works(CutPlane(middle, (1.0, 0.3, 0.2))),
    }


def textured_head(size: int) -> npt.NDArray[np.uint8]:
    """Return a synthetic head: textured brain in bright skin, in black air."""
    shape = tuple(round(part * size) for part in (181 / 217, 1, 181 / 217))
    z, y, x = np.ogrid[tuple(slice(-1, 1, extent * 1j) for extent in shape)]
    radius = np.sqrt((z / 0.85) ** 2 + (y / 0.9) ** 2 + (x / 0.8) ** 2)
    brain = 120 + 40 * np.sin(9 * z) * np.sin(11 * y) * np.sin(10 * x)
    return np.where(radius < 0.9, brain, np.where(radius < 1, 230, 0)).astype(np.uint8)


@case("warp", 300, 1200, baseline="cold solves")
def warp_image(size: int) -> dict[str, Work]:
    """Warp of a colour image by its displacement."""
    from napari_hmrf.fields import Warper

    drawn = phantom(PHANTOM, size)
    found = _solve(drawn.problem)
    warper = Warper(np.stack([drawn.image] * 3, axis=-1), spacing=found.spacing)

    def warp(_: object) -> object:
        return warper(found.displacement, found.tissue)

    return {"colour image": Work(warp, baseline=_cold(drawn.problem))}


@case("warp-volume", 96, baseline="cold solves")
def warp_volume(size: int) -> dict[str, Work]:
    """Warp of a head, of one slice of it, and its result layers."""
    from napari_hmrf.field.deformation import arrows_apart, smallest_determinant
    from napari_hmrf.field.resample import resample
    from napari_hmrf.field.warp import inverse_map_and_overlaps
    from napari_hmrf.fields import Warper

    given = head_phantom(size)
    found = _solve(given.problem)
    field = (found.displacement, found.spacing, found.tissue)
    warper = Warper(given.image, spacing=found.spacing)
    middle = given.image.shape[0] // 2

    def layers(_: object) -> None:
        smallest_determinant(*field)
        origin, covered, _ = inverse_map_and_overlaps(*field)
        resample(given.image, origin, covered)
        arrows_apart(field[0], spacing=field[1], tissue=field[2], about=250)

    works: dict[str, Callable[[Any], object]] = {
        "one slice": lambda _: warper.slice(middle, found.displacement, found.tissue),
        "whole volume": lambda _: warper(found.displacement, found.tissue),
        "smallest determinants": lambda _: smallest_determinant(*field),
        "all result layers": layers,
    }
    cold = _cold(given.problem)
    return {title: Work(run, baseline=cold) for title, run in works.items()}


# Large motion.


def _large(problem: Problem, note: Callable[[Solution], str]) -> Work:
    """Return the work of a cold start in large motion, beside a linear solve."""
    run = partial(solve, prior=LARGE, backend="cpu")
    linear = Work(partial(solve, prior=ELASTIC, backend="cpu"), _in_other_units(problem))
    sites, forget = math.prod(problem.shape), partial(_forget, LARGE, len(problem.shape))
    return Work(run, _in_other_units(problem), linear, note, sites, forget)


def _steps(found: Solution) -> str:
    reach = found.reach
    assert reach is not None
    steps = _number_of(found.iterations, "step")
    return f"{steps}, smallest Jacobian {reach.least_jacobian:.3f}"


def _steps_and_rest(found: Solution) -> str:
    """Return the steps, and the distance to the targets and to equilibrium."""
    reach = found.reach
    assert reach is not None
    if not reach.stopped:
        return f"{_steps(found)}, reached"
    rest = f"{reach.missing:.2g} px missing, {reach.unbalanced:.2g} px from equilibrium"
    return f"{_steps(found)}, {rest}"


@case("large", 300, baseline="linear solves")
def large_image(size: int) -> dict[str, Work]:
    """Cold solve of an image in large motion."""
    problems = {
        "rim pushed by 8 px": _rim(size, 8),
        "rim pushed by 12 px": _rim(size, 12),
        "patch dragged by 60 px": dragged_disc(size, 15, 60),
        "bar pulled by half its length": bar(size, size, (0.0, (size - 1) / 2)),
    }
    return {title: _large(problem, _steps) for title, problem in problems.items()}


@case("large-drag", 300, baseline="linear solves")
def large_drag(size: int) -> dict[str, Work]:
    """One frame of a drag by 3 px a frame in large motion."""
    return {"patch": _frames(lambda far: dragged_disc(size, 15, far, begun=60), 3.0, WITHIN)}


@case("large-volume", 32, baseline="linear solves", is_long=True)
def large_volume(size: int) -> dict[str, Work]:
    """Cold solve of a volume in large motion."""
    problems = {
        "ball grown to twice its radius": growing_ball(size, 2.0),
        "bar bent by 90 degrees": _bent_bar(size),
        "patch dragged by a third": dragged_ball(size, size / 3, size / 6),
    }
    return {title: _large(problem, _steps_and_rest) for title, problem in problems.items()}


@case("large-volume-drag", 32, baseline="linear solves", is_long=True)
def large_volume_drag(size: int) -> dict[str, Work]:
    """One frame of a drag by half a voxel a frame in large motion."""
    return {"ball": _frames(partial(dragged_ball, size, off=size / 6), 0.5, _LIVE_VOXELS)}


def _frames(at: Callable[[float], Problem], step: float, optimizer: Multigrid) -> Work:
    """Return the work of one frame of a drag, beside a linear solve.

    Parameters
    ----------
    at : callable
        Returns the problem at a distance, in sites.
    step : float
        Distance of each frame, in sites.
    optimizer : Multigrid
        Tolerance of a frame.
    """
    numbers, last = itertools.count(1), list[Any]()

    def prepare() -> tuple[Problem, Any]:
        number = next(numbers) % 20
        if number == 0:
            last.clear()
        if not last:
            last.append(solve(at(step), LARGE, optimizer=optimizer, backend="cpu"))
        return at(step * (number + 1)), last[:2]

    def frame(given: tuple[Problem, Any]) -> tuple[Problem, Solution]:
        problem, earlier = given
        found = solve(problem, LARGE, optimizer=optimizer, backend="cpu", initial=earlier)
        last.insert(0, found)
        return problem, found

    def note(result: tuple[Problem, Solution]) -> str:
        problem, found = result
        tight = solve(problem, LARGE, optimizer=Multigrid(1e-4), backend="cpu", initial=found)
        error = float(np.abs(found.displacement - tight.displacement).max())
        return f"{_steps(found)}, error {error:.4f} px"

    linear = Work(partial(solve, prior=ELASTIC, backend="cpu"), _in_other_units(at(step)))
    return Work(frame, prepare, linear, note)


@case("budget", 512, baseline="linear solves", is_long=True)
def budget(size: int) -> dict[str, Work]:
    """Cold solve in large motion that the budget ends, and its pictures in a live solver."""
    problems = {
        "patch dragged by a fifth": dragged_disc(size, size / 20, size / 5),
        "patch dragged by two fifths": dragged_disc(size, size / 20, 2 * size / 5),
        "patch dragged across the sample": _across_sample(size),
        "free edge pulled into the tissue": _free_edge(size),
        "tissue pressed to 2 %": _pressed(size),
        "bar bent by 90 degrees": bar(size // 5, size, turned(size // 5, size, 90)),
    }

    def note(problem: Problem, found: Solution) -> str:
        updates: list[Update] = []
        with LiveSolver(updates.append, LARGE, backend="cpu") as live:
            live.submit(problem)
            live.wait()
        pictures = ", ".join(f"{update.seconds:.2f}" for update in updates)
        return f"{_steps_and_rest(found)}; live: pictures after {pictures} s"

    return {title: _large(problem, partial(note, problem)) for title, problem in problems.items()}


def _rim(size: int, far: float) -> Problem:
    """Return the sample with a rim of its tumour that is pushed by a distance, in pixels."""
    given = phantom(PHANTOM, size=size).problem
    length = np.linalg.norm(given.observed, axis=-1, keepdims=True)
    return Problem(
        observed=np.where(length > 0, given.observed / np.maximum(length, 1e-9) * far, 0),
        confidence=given.confidence,
        stiffness=given.stiffness,
    )


def _across_sample(size: int) -> Problem:
    """Return the sample with a patch that is dragged by half of its width, across the tumour."""
    given = phantom(PHANTOM, size=size).problem
    row, col = np.indices((size, size)) - size // 2
    patch = (np.hypot(row, col + size / 4) < size / 20) & given.tissue
    still = given.known & (given.observed == 0).all(axis=-1, keepdims=True)
    c, y = still.astype(float), np.zeros((size, size, 2))
    c[patch], y[patch] = 1, (0, size / 2)
    return Problem(observed=y, confidence=c, stiffness=given.stiffness)


def _free_edge(size: int) -> Problem:
    """Return a block that is held on its left, with a patch at its right edge pushed inwards."""
    row, col = np.indices((size, size))
    c, y = np.zeros((2, size, size, 2))
    c[:, 0] = 1
    patch = (np.abs(row - size // 2) < size // 30) & (col > size - size // 15)
    c[patch], y[patch] = 1, (size / 8, -size / 2)
    return Problem(observed=y, confidence=c, stiffness=np.ones((size, size)))


def _pressed(size: int) -> Problem:
    """Return a block with two patches that press the tissue between them to 2 % of its length."""
    row, col = np.indices((size, size))
    y, level = np.zeros((size, size, 2)), np.abs(row - size // 2) < size // 5
    for way, middle in ((1, size // 4), (-1, 3 * size // 4)):
        y[level & (np.abs(col - middle) < size // 10), 1] = way * 0.49 * (size / 2 - size / 5)
    return framed(y[..., 1] != 0, y)


def _bent_bar(size: int) -> Problem:
    """Return a bar of a sixth of its length whose end is turned by 90 degrees along an arc."""
    height = max(size // 6, 3)
    end = np.zeros((height, height, 3))
    end[..., :2] = turned(height, size, 90)[:, None, ::-1]  # the first axis is along the bar
    return between_plates(np.ones((size, height, height)), end)


# Registration, uncertainty and data for training.


@case("register", 150)
def register_image(size: int) -> dict[str, Work]:
    """Registration of an image to its deformed copy."""
    from napari_hmrf.registration import register

    drawn = phantom(PHANTOM, size)
    fixed = _solve(drawn.problem).warp(drawn.image)
    return {PHANTOM: Work(lambda _: register(fixed, drawn.image, spacing=1))}


@case("register-volume", 40)
def register_volume(size: int) -> dict[str, Work]:
    """Registration of a head to its deformed copy."""
    from napari_hmrf.registration import register

    given = head_phantom(size)
    fixed = _solve(given.problem).warp(given.image)
    spacing = given.problem.spacing
    return {"head": Work(lambda _: register(fixed, given.image, spacing=spacing))}


@case("sample", 300, baseline="solves after a change of the motion")
def posterior_sample(size: int) -> dict[str, Work]:
    """One sample of the posterior distribution of an image."""
    return {"image": _sample((size, size))}


@case("sample-volume", 96, baseline="solves after a change of the motion", is_long=True)
def posterior_sample_of_volume(size: int) -> dict[str, Work]:
    """One sample of the posterior distribution of a volume."""
    return {"volume": _sample((size, size, size))}


def _sample(grid: tuple[int, ...]) -> Work:
    """Return the work of one sample, beside a solve after a change of the motion."""
    from napari_hmrf.landmarks import StrainScale
    from napari_hmrf.posterior.noise import PosteriorNoise
    from napari_hmrf.posterior.sampling import Sampler, checked_prior, energy_of
    from napari_hmrf.solver.operator import Operator

    away = np.linalg.norm(np.indices(grid).T - (np.array(grid[::-1]) - 1) / 2, axis=-1).T
    m = np.where(away < grid[0] / 5, 5.0, 1.0)
    c, y = np.zeros((2, *grid, len(grid)))
    c[0], c[away < grid[0] / 20] = 1, 1
    patch = c[..., 0] * (away < grid[0] / 20)
    y[..., 0] = 3 * patch
    problem = Problem(observed=y, confidence=c, stiffness=m)
    prior = checked_prior(problem, None)
    noise = PosteriorNoise(problem, prior, energy_of(problem, StrainScale(0.1)))
    sampler = Sampler(Operator(problem, prior, "cpu"), noise, 0)
    seeds, moves = itertools.count(), itertools.count(1)

    def moved() -> Problem:
        motion = y.copy()
        motion[..., -1] += patch * (next(moves) % 6 + 1)
        return Problem(observed=motion, confidence=c, stiffness=m)

    again = Work(partial(solve, prior=prior, backend="cpu"), moved)
    sites, forget = math.prod(grid), partial(_forget, axes=len(grid))
    return Work(sampler.deviation, lambda: next(seeds), again, sites=sites, forget=forget)


@case("uncertainty", 150, baseline="cold solves")
def error_bars(size: int) -> dict[str, Work]:
    """Error bars of an image, from ten samples."""
    from napari_hmrf.landmarks import StrainScale
    from napari_hmrf.posterior import uncertainty

    problem, scale = phantom(PHANTOM, size).problem, StrainScale(0.1)

    def run(_: object) -> object:
        return uncertainty(problem, n=10, scale=scale, backend="cpu")

    return {PHANTOM: Work(run, baseline=_cold(problem))}


@case("random", 256)
def random_image(size: int) -> dict[str, Work]:
    """Random deformation of an image and its labels."""
    return _random((size, size))


@case("random-volume", 48)
def random_volume(size: int) -> dict[str, Work]:
    """Random deformation of a volume and its labels."""
    return _random((size, size, size))


def _random(shape: tuple[int, ...]) -> dict[str, Work]:
    """Return the work of a random field, and of a field with its deformed image and labels."""
    image, labels, deformation = random_deformation(shape)
    from napari_hmrf.fields import Picture

    pictures, seeds = (Picture(image), Picture(labels, order=0)), itertools.count()
    return {
        "field": Work(deformation.sample, lambda: next(seeds)),
        "field, image and labels": Work(
            lambda seed: deformation.sample(seed).pictures(*pictures), lambda: next(seeds)
        ),
    }


def random_deformation(shape: tuple[int, ...]) -> tuple[Array, Array, Any]:
    """Return an image, its labels and their random deformation: a round body with a bone."""
    from napari_hmrf import Material
    from napari_hmrf.random import RandomDeformation
    from napari_hmrf.tissue import RIGID

    at = np.moveaxis(np.indices(shape), 0, -1) / (np.array(shape) - 1) - 0.5
    labels = (np.linalg.norm(at, axis=-1) < 0.46).astype(np.uint8)
    labels[np.linalg.norm(at, axis=-1) < 0.12] = 2
    beside = (0.0,) * (len(shape) - 2) + (-0.2, 0.15)
    labels[np.linalg.norm(at - beside, axis=-1) < 0.06] = 3
    materials = (
        Material(0, "air", 0.0),
        Material(1, "soft", 3.0),
        Material(2, "tumour", 10.0, 0.45, 0.1),
        Material(3, "bone", RIGID),
    )
    image = np.random.default_rng(0).random(shape, dtype=np.float32)
    return image, labels, RandomDeformation(labels, materials, spacing=1)


@case("batch", 256, is_long=True)
def batch(size: int) -> dict[str, Work]:
    """Batch of 40 cases: read, solved and written."""
    from napari_hmrf.cases import read_cases, solve_cases
    from napari_hmrf.io.batch import one_thread
    from napari_hmrf.io.case import solve_case

    folder = tempfile.TemporaryDirectory()
    cases = read_cases(_write_cases(Path(folder.name), size, count=40))
    outputs = (Path(folder.name) / f"out {number}" for number in itertools.count())

    def loop(out: Path) -> list[float]:
        one_thread()
        moments = []
        for named in cases:
            solve_case(named.case, out / named.name, backend="cpu", changes=named.changes)
            moments.append(now().wall)
        return moments

    def run(out: Path, folder: object = folder, **workers: Any) -> list[float]:
        moments: list[float] = []
        solve_cases(cases, out, progress=lambda _: moments.append(now().wall), **workers)
        return moments

    def note(moments: list[float]) -> str:
        later = (moments[-1] - moments[_STARTED - 1]) / (len(moments) - _STARTED)
        return f"{duration(later)} a case, after the first {_STARTED}"

    works = {"loop in one process": loop, "2 processes": partial(run, jobs=2)}
    if importlib.util.find_spec("distributed"):
        works["dask, 2 workers"] = partial(run, scheduler=_dask_cluster())
    return {title: Work(work, lambda: next(outputs), note=note) for title, work in works.items()}


def _dask_cluster() -> str:
    """Start a cluster of two workers that ends with this process, and return its address."""
    import dask
    from distributed import LocalCluster

    # By default, workers return memory immediately and are profiled a hundred times per second,
    # which takes a fifth and a tenth of the time, respectively.
    dask.config.set(
        {
            "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
            "distributed.worker.profile.enabled": False,
        }
    )
    cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    atexit.register(cluster.close)
    return str(cluster.scheduler_address)


def _write_cases(folder: Path, size: int, count: int) -> Path:
    """Write a table of cases of one phantom that differ in the motion of the tumour's rim."""
    from napari_hmrf.io.images import ImageFile, write_image

    given = phantom(PHANTOM, size)
    images = {"image": given.image, "labels": given.tissue_labels, "rim": given.boundary_labels}
    for name, pixels in images.items():
        write_image(folder / f"{name}.tif", ImageFile(np.asarray(pixels).astype(np.uint8)))
    rows = [f"{row.label},{row.stiffness},{row.poisson}" for row in given.materials]
    (folder / "materials.csv").write_text("\n".join(["label,stiffness,poisson", *rows]))
    (folder / "rules.csv").write_text("label,action,amount\n1,fixed,\n2,expand,4\n")
    table = folder / "cases.csv"
    files = "image.tif,labels.tif,materials.csv,rim.tif,rules.csv"
    rows = [f"case {number},{files},{2 + 4 * number / count:g}" for number in range(count)]
    titles = "name,image,labels,materials,boundary,rules,amount:2"
    table.write_text("\n".join([titles, *rows]))
    return table


# The program.


def work(name: str, size: str) -> None:
    """Run the work of a case on request, in a worker."""
    works = CASES[name].prepare(int(size))
    ready = {}
    for title, each in works.items():
        each.run(each.prepare())  # loads compiled loops
        given = each.prepare()
        each.forget()
        result, megabytes = with_memory(partial(each.run, given))
        ready[title] = {"memory": megabytes, "sites": each.sites, "note": each.note(result)}
        if each.baseline is not None:
            each.baseline.run(each.baseline.prepare())

    def turn(request: Turn) -> Turn:
        asked = works[request["work"]]
        found = repeated(asked.run, asked.prepare, seconds=_SHORT)._asdict()
        if asked.baseline is not None:
            other = repeated(asked.baseline.run, asked.baseline.prepare, seconds=_SHORT)
            found["baseline"] = other.processor
        return found

    serve(ready, turn)


def rows(
    chosen: Case, size: int, against: Path | None, turns: int, seconds: float
) -> Iterator[list[str]]:
    """Yield the rows of the table of a case, each as soon as it is measured."""
    workers = start_workers("benchmarks.speed", (chosen.name, str(size)), against)
    try:
        for title in workers[0].ready:
            yield _row(chosen, size, title, workers, turns, seconds)
    finally:
        for worker in workers:
            worker.end()


def _row(
    chosen: Case,
    size: int,
    title: str,
    workers: Sequence[CheckoutWorker],
    turns: int,
    seconds: float,
) -> list[str]:
    answers = in_turn(workers, {"work": title}, turns, seconds)
    own, facts = answers[0], workers[0].ready[title]
    ways = ("wall", "processor")
    wall, processor = ([[turn[way] for turn in each] for each in answers] for way in ways)
    medians = (duration(statistics.median(times[0])) for times in (wall, processor))
    cells = [chosen.name, title, str(size), *medians]
    if len(workers) == 1:
        relative = ""
        if "baseline" in own[0]:
            middle = statistics.median(turn["processor"] / turn["baseline"] for turn in own)
            relative = f"{middle:.2f} {chosen.baseline}"
        return [*cells, relative, _memory(facts), facts["note"]]
    ratios = ratio(*wall[:2]), ratio(*processor[:2]), ratio(processor[2], processor[0])
    memory = (max(worker.ready[title]["memory"], 1.0) for worker in workers[:2])
    return [*cells, *map(str, ratios), f"{operator.truediv(*memory):.2f}", str(len(own))]


def _memory(facts: Turn) -> str:
    each = f" ({1e6 * facts['memory'] / facts['sites']:.0f} B a site)" if facts["sites"] else ""
    return f"{facts['memory']:.{0 if facts['memory'] >= 10 else 1}f} MB{each}"


_TITLES = ("case", "work", "size", "wall", "processor")
_ALONE = (*_TITLES, "relative to", "memory", "remarks")
_BESIDE = (*_TITLES, "wall / other", "processor / other", "control", "memory / other", "turns")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table of the chosen cases; return 1 if a case failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="name", help="cases; by default all short ones")
    parser.add_argument("--sizes", type=int, nargs="+", help="sites along an axis, for all cases")
    parser.add_argument("--against", type=checkout, metavar="FOLDER", help="another checkout")
    parser.add_argument("--turns", type=int, default=9, help="most turns (default: %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=2.5, help="time of the turns (default: %(default)s)"
    )
    parser.add_argument("--list", action="store_true", help="list the cases")
    options = parser.parse_args(arguments)
    if options.list:
        for each in CASES.values():
            print(f"{each.name:18}{each.text}{' (only if named)' if each.is_long else ''}")
        return 0
    if unknown := [name for name in options.names if name not in CASES]:
        parser.error(f"unknown cases: {', '.join(unknown)}; --list shows all")
    print(conditions(), end="\n\n")
    print(head(_ALONE if options.against is None else _BESIDE), flush=True)
    names = options.names or [name for name, each in CASES.items() if not each.is_long]
    failed = 0
    for name in names:
        for size in options.sizes or CASES[name].sizes:
            try:
                for row in rows(CASES[name], size, options.against, options.turns, options.seconds):
                    print(line(row), flush=True)
            except RuntimeError as error:
                failed = 1
                print(line([name, f"failed: {error}", size]), flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
