"""Estimate of the uncertainty of a result, in the background."""

from __future__ import annotations

import logging
import threading
from functools import partial

from psygnal import Signal

from napari_hmrf.errors import Cancelled, in_words
from napari_hmrf.layers.result_layers import PlacedSolution
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.ui.jobs import GuiThread
from napari_hmrf.ui.result.result_messages import NO_UNCERTAINTY
from napari_hmrf.wording import in_words_of

_log = logging.getLogger("napari_hmrf")


class UncertaintyEstimator:
    """Runner that estimates the uncertainty of one result at a time.

    The samples are solved one by one, so that edits of the user are solved between two samples.
    All methods must be called on the GUI thread.
    """

    #: Emitted with the result and its `Uncertainty`.
    estimated = Signal(object, object)
    #: Emitted with the reason why a result has no uncertainty.
    refused = Signal(str)

    def __init__(self) -> None:
        self._gui = GuiThread()
        self._answer: PlacedSolution | None = None
        self._cancel = threading.Event()
        self._monitor = Monitor("starting", 0.0)

    @property
    def monitor(self) -> Monitor | None:
        """Progress of the running estimate, or None."""
        return None if self._answer is None else self._monitor

    def start(self, answer: PlacedSolution) -> None:
        """Estimate the uncertainty of a result, and cancel the estimate of another result."""
        if answer is self._answer:
            return
        self.cancel()
        if answer.estimate is None:
            self.refused.emit(NO_UNCERTAINTY)
            return
        self._answer, self._cancel = answer, threading.Event()
        self._monitor = Monitor("starting", 0.0)
        job = partial(self._run, answer, self._cancel)
        threading.Thread(target=job, name="uncertainty", daemon=True).start()

    def cancel(self) -> None:
        """Stop the estimate; nothing is reported."""
        self._cancel.set()
        self._answer = None

    def release(self) -> None:
        """Stop the estimate, and report nothing any more."""
        self.cancel()
        self._gui.release()

    def _run(self, answer: PlacedSolution, cancel: threading.Event) -> None:
        """Estimate the uncertainty, on a thread of its own."""
        assert answer.estimate is not None
        try:
            found = answer.estimate(progress=self._report, cancel=cancel)
        except Cancelled:
            return
        except Exception as error:  # noqa: BLE001 - every error is reported to the user
            _log.debug("the uncertainty is unknown", exc_info=True)
            reason = in_words_of("window", in_words(error))
            self._gui.submit(partial(self._finish, cancel, partial(self.refused.emit, reason)))
        else:
            report = partial(self.estimated.emit, answer, found)
            self._gui.submit(partial(self._finish, cancel, report))

    def _report(self, monitor: Monitor) -> None:
        self._monitor = monitor

    def _finish(self, cancel: threading.Event, report: partial[None]) -> None:
        if not cancel.is_set():
            self._answer = None
            report()
