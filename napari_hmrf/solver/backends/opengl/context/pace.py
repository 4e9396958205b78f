"""Batches of device work, with a check for cancellation after each batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from napari_hmrf.solver.backends.base import BATCH_SECONDS, Checkpoint

#: Longest duration of a pass, in seconds. A longer pass is split into strips of rows. Windows
#: resets a device that does not respond for two seconds, and a desktop on the same GPU stutters
#: even earlier.
MAX_PASS_SECONDS = 0.25

# Overhead of a pass, as an equivalent number of sites, and the assumed time per site before the
# first measurement, in seconds.
_PASS_SITES = 1000
_FIRST_GUESS = 1e-7


class Pace:
    """Scheduler that divides device work into batches and waits after each batch.

    Work is measured in sites. A pair of sites in one texel counts as one site.

    Parameters
    ----------
    finish : callable
        Function that waits until the device has finished, and releases the GIL while it waits.
    checkpoint : callable
        Function called after each wait. It raises an exception to cancel the solve.
    longest : float
        Longest duration of a pass, in seconds; a longer pass is split into strips.
    """

    def __init__(
        self,
        finish: Callable[[], None],
        checkpoint: Checkpoint,
        longest: float = MAX_PASS_SECONDS,
    ) -> None:
        self._finish = finish
        self._checkpoint = checkpoint
        self._longest = longest
        self._seconds_per_site = _FIRST_GUESS
        self._measured = False
        self._sites = 0
        self._since = 0.0

    def strips(self, grid: tuple[int, ...]) -> Iterator[tuple[int, int] | None]:
        """Yield the rows (begin, end) of each strip of a pass, or None if the pass is not split.

        The work of a strip is recorded when the next strip is requested.
        """
        height, width = grid
        seconds = height * width * self._seconds_per_site
        if seconds <= self._longest:
            self._begin()
            yield None
            self._issued(height * width)
            return
        begin = 0
        while begin < height:
            rows = max(1, int(BATCH_SECONDS / (width * self._seconds_per_site)))
            end = min(begin + rows, height)
            self._begin()
            yield begin, end
            self._issued((end - begin) * width)
            begin = end

    def wait(self) -> None:
        """Wait for the device, measure its speed, and check for cancellation."""
        self._finish()
        elapsed = time.perf_counter() - self._since
        if self._sites and elapsed > 0:
            measured = elapsed / self._sites
            # Limit the change, because other work on the machine may have slowed down the batch.
            known = self._seconds_per_site if self._measured else measured
            self._seconds_per_site = min(max(measured, known / 2), known * 2)
            self._measured = True
        self._sites = 0
        self._checkpoint()

    def _begin(self) -> None:
        if not self._sites:
            self._since = time.perf_counter()

    def _issued(self, sites: int) -> None:
        self._sites += sites + _PASS_SITES
        # Wait after the first pass to measure the speed of the device.
        if not self._measured or self._sites * self._seconds_per_site >= BATCH_SECONDS:
            self.wait()
