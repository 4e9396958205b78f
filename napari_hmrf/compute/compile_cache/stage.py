"""Stage of the preparation of a computer, and its description for the user."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from napari_hmrf.compute.compile_cache.sets import COSTS

#: Beginning of the description, by which messages about the preparation are recognized.
PREPARING = "preparing for this computer, once"
# Displayed times are multiples of this one, in seconds, so that the text rarely changes.
_STEP = 5
# Largest part of a set that counts as compiled before the set is complete.
_MOST = 0.95


class Progress(NamedTuple):
    """Progress of the compilation of some sets.

    Attributes
    ----------
    fraction : float
        Compiled part, from 0 to 1.
    seconds : float
        Time left; 0 if it is unknown.
    """

    fraction: float
    seconds: float

    @property
    def words(self) -> str:
        """Description, in the middle of a sentence."""
        if not self.seconds:
            return PREPARING
        if self.seconds > 90:
            return f"{PREPARING}: about {math.ceil(self.seconds / 60)} minutes left"
        left = max(_STEP * math.ceil(self.seconds / _STEP), _STEP)
        return f"{PREPARING}: about {left} s left"


class Stage(NamedTuple):
    """State of the compiling process.

    Attributes
    ----------
    job : str
        Set that is being compiled; "" if there is none yet.
    loops : int
        Number of its loops that are compiled or loaded.
    pace : float
        Seconds of this computer per second of `sets.COSTS`; 0 if unknown.
    """

    job: str = ""
    loops: int = 0
    pace: float = 0.0

    @property
    def part(self) -> float:
        """Completed part of the current set."""
        return min(self.loops / COSTS[self.job].loops, _MOST) if self.job else 0.0

    def progress(self, jobs: Iterable[str], missing: Iterable[str]) -> Progress:
        """Return the progress of some sets.

        Parameters
        ----------
        jobs : iterable of str
            The sets.
        missing : iterable of str
            Those of them that are not compiled.
        """
        whole = sum(COSTS[job].seconds for job in jobs)
        left = sum(
            COSTS[job].seconds * (1 - self.part if job == self.job else 1) for job in missing
        )
        return Progress(1 - left / whole if whole else 1.0, self.pace * left)
