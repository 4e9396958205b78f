"""Size of the batches of work on the device, between two checks for a cancellation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from napari_hmrf.solver.backends.base import BATCH_SECONDS, Checkpoint

#: No pass may take longer: Windows resets a device that does not answer for two seconds, and a
#: desktop that shares the GPU stutters much earlier. It is cut into strips of rows instead.
MAX_PASS_SECONDS = 0.25

# Cost of the start of a pass, in sites; and assumed cost of a site before it was measured.
_PASS_SITES = 1000
_FIRST_GUESS = 1e-7


class Pace:
    """Counts the sites of the passes that were issued, and waits when they make a batch.

    A pair of sites, which share a texel, counts as one here.

    Parameters
    ----------
    finish : callable
        Waits until the device has done everything; lets other Python threads run.
    checkpoint : callable
        Called after each wait; raises to stop the work.
    longest : float
        How many seconds a pass may take before it is cut into strips.
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
        """Yield ranges of rows to run one after the other; None is all rows at once.

        The pass counts as issued when the next range is requested.
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
        """Wait for the device, measure how fast it was, and look whether to go on."""
        self._finish()
        elapsed = time.perf_counter() - self._since
        if self._sites and elapsed > 0:
            measured = elapsed / self._sites
            # One slow batch, on a machine busy with something else, must not shrink the next a lot.
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
        # The first pass is waited for alone: until then the speed of the device is unknown.
        if not self._measured or self._sites * self._seconds_per_site >= BATCH_SECONDS:
            self.wait()
