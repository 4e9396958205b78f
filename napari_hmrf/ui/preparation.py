"""Preparation of the computer during the first session: its order, and its bar in the dock."""

from __future__ import annotations

from qtpy.QtWidgets import QWidget

from napari_hmrf.compute.compile_cache import compiler, sets
from napari_hmrf.compute.compile_cache.loops import are_compiled
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.study.study import Study
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import repeating

#: Interval between two updates of the bar, in milliseconds.
_INTERVAL = 500


class Preparation:
    """Background preparation of the computer, with a bar in the dock until it is complete.

    Another process compiles first what the session needs; the bar shows this part. It then
    continues with everything else, of which the user sees nothing.

    Parameters
    ----------
    native : QWidget
        The dock.
    controller : Controller
    """

    def __init__(self, native: QWidget, controller: Controller) -> None:
        self._controller = controller
        self._requested: list[str] = []
        self._timer = repeating(native, _INTERVAL, self.update)
        controller.slice_changed.connect(self._on_slice)

    def release(self) -> None:
        """Stop all updates; the preparation goes on until napari is closed."""
        self._timer.stop()

    def _on_slice(self, _: Study) -> None:
        if not are_compiled(sets.EVERYTHING):
            self._timer.start()

    def update(self) -> None:
        """Request what the session needs, show the bar, and use what has become ready."""
        study, form = self._controller.session.study, self._controller.form
        if study is None:
            return
        needed = needed_sets(study, has_pair=form.result.second.value is not None)
        missing = [job for job in needed if not are_compiled(job)]
        if needed != self._requested:
            self._requested = needed
            compiler.request(*missing, priority=compiler.IDLE)
        compiler.compile_meanwhile()
        is_shown = bool(missing) and compiler.is_compiling()
        form.footer.show_preparation(compiler.progress(*needed) if is_shown else None)
        self._controller.unfold_latest()
        if are_compiled(sets.EVERYTHING):
            self._timer.stop()


def needed_sets(study: Study, *, has_pair: bool) -> list[str]:
    """Return the sets of loops that a session with a study needs, in this order.

    Parameters
    ----------
    study : Study
    has_pair : bool
        True if a second image is chosen, to which the image can be registered.
    """
    grid = study.grid
    volume = sets.VOLUMES, sets.LARGE_VOLUMES
    flat = "elastic", sets.PICTURES, "slipping", "rigid", sets.LARGE_IMAGES
    about = grid.shape, grid.spacing, study.prior, study.optimizer
    chosen = SolveJob(*about).loops
    pair = [SolveJob(*about, has_data=True).loops] if has_pair else []
    return [*dict.fromkeys([*(volume if len(grid.shape) == 3 else flat), chosen, *pair])]
