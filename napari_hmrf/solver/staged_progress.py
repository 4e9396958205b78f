"""Progress of a solve in several stages, as one fraction that never decreases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.solver.optimizers.base import Monitor

# Fraction of the remaining progress that a preview takes.
_PREVIEW_SHARE = 0.5


class StagedProgress:
    """Progress report whose completed fraction never decreases, also from one stage to the next.

    Reports about the preparation of the computer are forwarded unchanged.

    Parameters
    ----------
    report : callable
        Called with each `Monitor`.
    """

    def __init__(self, report: Callable[[Monitor], object]) -> None:
        self._report = report
        self._fraction = self._first = 0.0
        self._share = 1.0

    def begin(self, *, preview: bool) -> None:
        """Begin a stage: a preview, which another stage follows, or the last stage."""
        self._first = self._fraction
        self._share = _PREVIEW_SHARE if preview else 1.0

    def __call__(self, monitor: Monitor) -> None:
        """Report the progress of the current stage."""
        if not monitor.message.startswith(PREPARING):
            done = self._first + (1 - self._first) * self._share * monitor.fraction
            self._fraction = max(self._fraction, done)
            monitor = replace(monitor, fraction=self._fraction)
        self._report(monitor)
