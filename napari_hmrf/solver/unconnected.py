"""Scraps of tissue that hang on nothing: cut off by a threshold, they would keep the rest waiting.

Elastic tissue that could still move has no one answer, and is refused. But where tissue was told
from air by its intensity there are specks that nobody means anything by; they stay where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.rigid_modes import Firm, free_pieces

#: What is observed of a piece of this part of all tissue, or more, is meant: it is not a scrap.
_MATTERS = 0.01
# To leave a piece out may let another go; chains of more than this are for the solver to refuse.
_ROUNDS = 4


class _Known(NamedTuple):
    """What was found, for what, and whether nothing of the rest could move."""

    asked: Firm
    found: npt.NDArray[np.bool_]
    firm: bool

    def serves(self, tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> bool:
        """Whether it is what would be found again."""
        if not self.asked.covers(tissue, held):
            return False
        if not self.firm:
            return np.array_equal(self.asked.held, held)
        # What was left out may matter now.
        return not (self.found.any() and (held > self.asked.held)[self.found].any())


# The last that was found, and for what: to find it takes as long as a few cycles.
_known: list[_Known] = []


def scraps(tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Find tissue that could move freely and is not worth a refusal.

    Those are pieces of which nothing is observed, and small ones of which too little is. If
    nothing would be left that is observed, there are none: the solver says what is wrong.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W)
    held : ndarray of bool, shape (H, W, 2)
        Which components are observed.

    Returns
    -------
    ndarray of bool, shape (H, W)
        Not to be written to.
    """
    for known in _known:
        if known.serves(tissue, held):
            return known.found
    found, firm = _scraps(tissue, held)
    found.setflags(write=False)
    _known[:] = [_Known(Firm(tissue.copy(), held.copy()), found, firm)]
    return found


def _scraps(
    tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], bool]:
    rest, seen = tissue.copy(), held.any(axis=-1)
    enough = _MATTERS * tissue.sum()
    firm = False
    for _ in range(_ROUNDS):
        pieces, free = free_pieces(rest, held)
        firm = not len(free)
        if firm:
            break
        sizes = np.bincount(pieces.ravel(), minlength=free[-1] + 1)
        observed = np.bincount(pieces[seen], minlength=len(sizes)) > 0
        scrap = ~observed | (sizes < enough)
        scrap[0] = False
        if not scrap[free].any():
            break
        rest &= ~scrap[pieces]
    if not (seen & rest).any():
        return np.zeros_like(tissue), False
    return tissue & ~rest, firm


def left_at_rest(scrap: npt.NDArray[np.bool_]) -> str:
    """Say so, as a clause for people; "" if there are none."""
    _, count = scipy.ndimage.label(scrap, structure=np.ones((3, 3)))
    if not count:
        return ""
    pixels = int(scrap.sum())
    what = "1 piece" if count == 1 else f"{count} pieces"
    size = "1 pixel" if pixels == 1 else f"{pixels} pixels"
    verb = "holds stays where it is" if count == 1 else "holds stay where they are"
    return f"{what} of tissue that too little {verb} ({size})"
