"""Small loose pieces of tissue, which are excluded from a solve.

If elastic tissue can move freely, the solution is not unique, and the solver raises an error.
However, a mask of tissue from an intensity threshold may contain specks. Such specks stay at rest
instead.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.field.followers import followers_of
from napari_hmrf.notes import Note
from napari_hmrf.solver.rigid_modes import HeldTissue, free_pieces

#: Smallest size of an observed piece that is never excluded, as a fraction of all tissue.
_LARGE_PIECE = 0.01
# Largest number of exclusion rounds, because the exclusion of a piece may free another piece. If
# pieces are still loose after the last round, the solver raises an error.
_ROUNDS = 4


class _Search(NamedTuple):
    """Result of a search: constraints, loose pieces, and whether the rest is constrained."""

    constraints: HeldTissue
    pieces: npt.NDArray[np.bool_]
    is_rest_held: bool

    def is_valid_for(self, tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> bool:
        """Return whether a search with the given constraints would find the same pieces."""
        if not self.constraints.covers(tissue, held):
            return False
        if not self.is_rest_held:
            return np.array_equal(self.constraints.held, held)
        # A new constraint may constrain a piece that was excluded.
        return not (self.pieces.any() and (held > self.constraints.held)[self.pieces].any())


# A search takes as long as a few cycles.
_search: Kept[_Search] = Kept()


def scraps(tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Find the loose pieces of tissue to exclude from a solve.

    These are the loose pieces without an observation, and small loose pieces with too few
    observations. If no observed tissue would remain, the result is empty, and the solver raises an
    error with the reason.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W)
        Mask of tissue.
    held : ndarray of bool, shape (H, W, 2)
        Mask of the observed components.

    Returns
    -------
    ndarray of bool, shape (H, W)
        Mask of the loose pieces; read-only.
    """
    held = _with_held_followers(tissue, held)

    def search() -> _Search:
        pieces, is_rest_held = _scraps(tissue, held)
        pieces.setflags(write=False)
        return _Search(HeldTissue(tissue.copy(), held.copy()), pieces, is_rest_held)

    return _search.get(lambda last: last.is_valid_for(tissue, held), search).pieces


def _with_held_followers(
    tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Return a mask that includes the nearest connected sites of orphans with an observation."""
    found = followers_of(tissue)
    if found is None:
        return held
    flat = held.reshape(-1, held.shape[-1])
    if not flat[found.sites].any():
        return held
    wider = flat.copy()
    np.logical_or.at(wider, found.nearest, flat[found.sites])
    return wider.reshape(held.shape)


def _scraps(
    tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], bool]:
    rest, observed = tissue.copy(), held.any(axis=-1)
    large = _LARGE_PIECE * tissue.sum()
    is_rest_held = False
    for _ in range(_ROUNDS):
        pieces, free = free_pieces(rest, held)
        is_rest_held = not len(free)
        if is_rest_held:
            break
        sizes = np.bincount(pieces.ravel(), minlength=free[-1] + 1)
        has_observation = np.bincount(pieces[observed], minlength=len(sizes)) > 0
        scrap = ~has_observation | (sizes < large)
        scrap[0] = False
        if not scrap[free].any():
            break
        rest &= ~scrap[pieces]
    if not (observed & rest).any():
        return np.zeros_like(tissue), False
    return tissue & ~rest, is_rest_held


def left_at_rest(scrap: npt.NDArray[np.bool_]) -> str:
    """Describe the excluded pieces as a clause for the user; "" if there are none."""
    _, count = scipy.ndimage.label(scrap, structure=np.ones((3,) * scrap.ndim))
    if not count:
        return ""
    pixels = int(scrap.sum())
    pieces = "1 piece" if count == 1 else f"{count} pieces"
    size = "1 pixel" if pixels == 1 else f"{pixels} pixels"
    verb = "stays at rest" if count == 1 else "stay at rest"
    return Note(
        f"{pieces} of tissue with too few constraints {verb} ({size})",
        short=f"{pieces} of tissue {verb}",
    )
