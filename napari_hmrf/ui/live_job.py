"""Deformations that follow edits, computed away from the window: the newest of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import Cancelled
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness
from napari_hmrf.layers.inputs import Inputs, Snapshot, prepare
from napari_hmrf.layers.layer_names import naming
from napari_hmrf.layers.result_layers import Kind, result_layers
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.live_solver import LiveSolver, Update
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.ui.job import Done

_log = logging.getLogger("napari_hmrf")
# What those who wait for it are told.
_DOING = "an edit that 'Deform tissue' follows, which its Cancel stops"
_DRAWING = "the layers of a result of 'Deform tissue', which its next edit stops"


@dataclass(frozen=True, eq=False)
class News:
    """What became of an edit.

    Attributes
    ----------
    snapshot : Snapshot
        What was solved.
    picture : ndarray, optional
        The image moved with the tissue: what can be shown at once.
    done : Done, optional
        All layers; once an edit has come to rest.
    error : Exception, optional
        Why there is nothing new, in words of the layers.
    """

    snapshot: Snapshot
    picture: npt.NDArray[Any] | None = None
    done: Done | None = None
    error: Exception | None = None


class _Solved(NamedTuple):
    """The newest solution, and what it was made from."""

    snapshot: Snapshot
    inputs: Inputs
    solution: Solution


class LiveJob:
    """Solves what is submitted, as `LiveSolver`, and draws it.

    It holds copies only, and neither layers nor anything of Qt's.

    Parameters
    ----------
    tell : callable
        Called with `News` on the compute thread.
    optimizer : Optimizer
    backend : str
    """

    def __init__(self, tell: Callable[[News], None], optimizer: Optimizer, backend: str) -> None:
        self.made_with = (optimizer, backend)
        self._tell = tell
        self._optimizer = optimizer
        self._monitor = Monitor("starting", 0.0)
        self._live = LiveSolver(
            self._deliver,
            optimizer=optimizer,
            backend=backend,
            progress=self._on_progress,
            doing=_DOING,
        )
        # Only the compute thread looks at these.
        self._read: tuple[Snapshot, Inputs | None] | None = None
        self._solved: _Solved | None = None
        self._pictured: tuple[npt.NDArray[Any], tuple[float, ...], Warper] | None = None

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._live.busy

    @property
    def monitor(self) -> Monitor:
        """What is going on."""
        delay = self._live.delay
        return Monitor(delay, 0.0) if delay else self._monitor

    def submit(self, snapshot: Snapshot, prior: Prior) -> None:
        """Have this solved instead of whatever waits."""
        self._live.submit(lambda: self._problem(snapshot, prior))

    def complete(self, kinds: Collection[Kind]) -> None:
        """Have all layers drawn of the newest solution, unless there is a newer edit then."""
        compute_thread.submit(lambda: self._complete(kinds), _DRAWING)

    def forget(self) -> None:
        """Drop what waits, what is being solved and what was found."""
        self._live.forget()

    def close(self) -> None:
        """Drop everything, for good."""
        self._live.close()

    def _on_progress(self, monitor: Monitor) -> None:
        self._monitor = monitor

    def _problem(self, snapshot: Snapshot, prior: Prior) -> tuple[Problem, Prior]:
        self._read = (snapshot, None)
        inputs = prepare(snapshot, prior, self._optimizer, complete=True)
        self._read = (snapshot, inputs)
        return inputs.problem, inputs.prior

    def _deliver(self, update: Update) -> None:
        assert self._read is not None
        snapshot, inputs = self._read
        if update.solution is None or inputs is None:
            self._tell(News(snapshot, error=_named(update.error, snapshot)))
            return
        solution = update.solution
        self._solved = _Solved(snapshot, inputs, solution)
        picture = self._moved(solution, inputs.pictures.image)
        self._tell(News(snapshot, picture))

    def _moved(self, solution: Solution, image: npt.NDArray[Any] | None) -> npt.NDArray[Any] | None:
        if image is None:
            return None
        known, spacing = self._pictured, tuple(solution.spacing)
        if known is None or known[1] != spacing or not _same(image, known[0]):
            warper = Warper(Picture(image, fill=emptiness(image)), spacing=spacing)
            known = self._pictured = (image, spacing, warper)
        return known[2](solution.displacement, solution.tissue)[0]

    def _complete(self, kinds: Collection[Kind]) -> None:
        if self._solved is not None and not self.busy:
            self._draw(self._solved, kinds)

    def _draw(self, solved: _Solved, kinds: Collection[Kind]) -> None:
        try:
            inputs = solved.inputs
            outputs = result_layers(
                solved.solution, inputs.frame, inputs.pictures, kinds, self._checkpoint
            )
        except Cancelled:
            return
        except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
            _log.exception("a live result could not be drawn")
            self._tell(News(solved.snapshot, error=error))
            return
        done = Done(outputs, solved.snapshot, inputs.ignored, inputs.notes)
        self._tell(News(solved.snapshot, done=done))

    def _checkpoint(self) -> None:
        if self.busy:
            raise Cancelled


def _same(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    return one is other or (
        one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    )


def _named(error: Exception | None, snapshot: Snapshot) -> Exception:
    """What is wrong, said of the layers."""
    tissue, boundary = snapshot.tissue_name, snapshot.boundary_name
    try:
        with naming(stiffness=tissue, poisson=tissue, observed=boundary, confidence=boundary):
            raise error or RuntimeError("there is no solution")
    except Exception as named:  # noqa: BLE001 - that is what is wanted
        return named
