"""The L1 observations of eq. 19, exactly: each is held, or slips with its whole force.

Wanted is d with ``A d + force = 0``, where the force of an observed component is anything from -p
to p at its mark y, and p sign(d - y) elsewhere; for a symmetric A, that is the least energy. The
states are found by exchanging all that contradict themselves. Where that fails, a primal-dual
interior point (symmetric A), or nested policy iteration (the centred A, an M-matrix), finds them.
Whatever the way, the result is proven by its own conditions, in double double.

The forces of all fields of least energy are the same. So these fields differ by motions that cost
nothing and that the components held by less than p stop; the one of least length is returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.optimize
import scipy.sparse
from scipy.sparse import csgraph

from exact import double_double as dd
from exact.direct import Factors
from exact.matrices import Array, Matrix, Numbers

# A component may contradict its state by so many pixels, or by this part of its limit.
_SLACK = 1e-10
#: A force that is the limit but for this part of it is the limit.
TIE = 1e-9
# A force so close to the limit may be the limit to somebody who computes in single precision.
_NEARLY = 1e-6
_EXCHANGES = 40
_SINGLE = 200
_STEPS = 100
# An interior point ends where no product of slack and passage is more.
_GAP = 1e-22
_SIDE = np.array([[1.0], [-1.0]])

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Marks:
    """What is observed of components that move.

    Attributes
    ----------
    at : ndarray of int
        Which components.
    y : ndarray
        Where they were seen, in pixels.
    limit : ndarray
        The greatest force p on each.
    """

    at: Numbers
    y: Array
    limit: Array


@dataclass(frozen=True, eq=False)
class Balance:
    """A displacement in balance.

    Attributes
    ----------
    displacement : ndarray, shape (n,)
    motions : int
        The number of independent motions by which other fields of the same energy differ.
    edge : bool
        Whether a part of 1e-6 of an observation's limit decides if there are others.
    last_step : float
        What the last step of refinement changed, in pixels.
    held : ndarray of bool, shape (marks,)
        Which observations do not slip.
    """

    displacement: Array
    motions: int
    edge: bool
    last_step: float
    held: Flags


def balance(
    matrix: Matrix, moving: npt.NDArray[np.bool_], marks: Marks, rest: Array
) -> Balance | None:
    """Find the displacement in balance; None if it is not found.

    Parameters
    ----------
    matrix : Matrix
    moving : ndarray of bool, shape (n,)
        The components that anything pulls at; the others stay where `rest` says.
    marks : Marks
    rest : ndarray, shape (n,)
    """
    search = _Search(matrix, moving, marks)
    found = search.exchange(np.zeros(len(marks.at)), rest)
    if found is None and matrix.symmetric:
        found = search.exchange(*search.interior_point(rest), singly=True)
    elif found is None:
        found = search.exchange(search.policy(rest), rest, singly=True)
    return None if found is None else search.least(found)


@dataclass(frozen=True, eq=False)
class _Found:
    """States that do not contradict themselves: 0 held, else the sign of d - y."""

    states: Array
    displacement: Array
    forces: Array
    last_step: float


class _Point(NamedTuple):
    """Where an interior point is: `past` and `slack` (2, observations) are of either side."""

    past: Array
    slack: Array
    weights: Array
    out: Array
    apart: Array


class _Search:
    """The search for the states of observations."""

    def __init__(self, matrix: Matrix, moving: Flags, marks: Marks) -> None:
        self._matrix, self._moving, self._marks = matrix, moving, marks

    def exchange(self, states: Array, start: Array, singly: bool = False) -> _Found | None:
        """Exchange states that contradict themselves until none does; None if that fails.

        `singly`: in the end one after the other, the last of them (Murty's rule).
        """
        marks = self._marks
        for number in range(_EXCHANGES + _SINGLE * singly):
            held = states == 0
            factors = self._factors(held)
            load = np.zeros(self._matrix.size)
            load[marks.at] = -marks.limit * states
            if not _balanced(factors.motions, load):
                return None
            begin = start.copy()
            begin[marks.at[held]] = marks.y[held]
            high, low = factors.displaced(begin, load)
            forces = -self._matrix.times(high, low)[0][marks.at]
            if len(factors.motions):
                high = self._shortest(high, factors.motions, states)
            passed = -states * (high[marks.at] - marks.y)
            wrong = np.where(held, np.abs(forces) > marks.limit * (1 + _SLACK), passed > _SLACK)
            if not wrong.any():
                return _Found(states, high, forces, factors.last_step)
            if number >= _EXCHANGES:
                wrong[: np.flatnonzero(wrong)[-1]] = False
            states = np.where(wrong, np.where(held, np.sign(forces), 0.0), states)
        return None

    def least(self, found: _Found) -> Balance:
        """Of all fields with these forces, the one of least length."""
        part = np.abs(found.forces) / self._marks.limit
        held = found.states == 0
        tied, nearly = held & (part >= 1 - TIE), held & (part >= 1 - _NEARLY)
        displacement = found.displacement
        motions = self._factors(held & ~tied).motions
        if len(motions):
            states = np.where(tied, np.sign(found.forces), found.states)
            displacement = self._shortest(displacement, motions, states)
        more = len(self._factors(held & ~nearly).motions) if (nearly & ~tied).any() else 0
        return Balance(displacement, len(motions), more > len(motions), found.last_step, held)

    def interior_point(self, start: Array) -> tuple[Array, Array]:
        """States, and the displacement, to which Mehrotra's method leads."""
        marks, size = self._marks, self._matrix.size
        at, limit = marks.at, marks.limit
        unknowns = np.flatnonzero(self._moving)
        d, low = np.where(self._moving, 0.0, start), np.zeros(size)
        # What is past its mark on either side, and how far the force is from either limit.
        room = max(float(np.abs(marks.y).max()), 1e-3)
        past = np.stack([np.maximum(s * (d[at] - marks.y), 0) + room for s in (1, -1)])
        slack = np.stack([limit, limit])
        force = np.zeros(len(at))
        for _ in range(_STEPS):
            gap = past * slack / limit
            if gap.max() < _GAP * room:
                break
            weights = 1 / (past / slack).sum(axis=0)
            springs = np.zeros(size)
            springs[at] = weights
            factors = Factors(self._matrix, unknowns, springs)
            out = self._matrix.times(d, low)[0]
            out[at] += force
            apart = (d[at] - marks.y) - (past[0] - past[1]) + low[at]

            point = _Point(past, slack, weights, out, apart)
            *_, narrower, wider = self._step(factors, point, np.zeros_like(past))
            part = _part(slack, narrower, past, wider, 1.0)
            before, after = gap.mean(), 0.0
            after = ((past + part * wider) * (slack + part * narrower) / limit).mean()
            aim = limit * before * min((after / before) ** 3, 1.0) - narrower * wider
            way, pull, narrower, wider = self._step(factors, point, aim)
            part = _part(slack, narrower, past, wider, 0.9995)
            d, low = dd.add((d, low), dd.multiply((part, 0.0), way))
            force = force + part * pull
            slack, past = slack + part * narrower, past + part * wider
        slips = past * self._matrix.diagonal[at] > slack
        return np.where(slips[0], 1.0, np.where(slips[1], -1.0, 0.0)), d

    def _step(
        self, factors: Factors, point: _Point, aim: Array
    ) -> tuple[tuple[Array, Array], Array, Array, Array]:
        """How all changes if products of slack and passage are to become `aim`."""
        past, slack, weights, out, apart = point
        at = self._marks.at
        shift = apart + (_SIDE * (past * slack - aim) / slack).sum(axis=0)
        right = -out
        right[at] -= weights * shift
        way = factors.solution(right)
        pull = weights * (way[0][at] + shift)
        narrower = -_SIDE * pull
        wider = (aim - past * slack - past * narrower) / slack
        return way, pull, narrower, wider

    def policy(self, start: Array) -> Array:
        """States by nested policy iteration, which ends for certain where A is an M-matrix.

        Wanted is ``max(A d - p, min(A d + p, d - y)) = 0``: outside, which components take the
        first; within, which of the other two the rest takes.
        """
        marks = self._marks
        below = np.zeros(len(marks.at), np.bool_)
        above = np.zeros(len(marks.at), np.bool_)
        for _ in range(_STEPS):
            for _ in range(_STEPS):
                states = np.where(below, -1.0, np.where(above, 1.0, 0.0))
                displacement, forces = self._for_states(states, start)
                off = displacement[marks.at] - marks.y
                # One of A d + p and d - y is 0; the unit of the other does not matter.
                takes = np.where(above, off >= 0, marks.limit - forces < 0) & ~below
                if (takes == above).all():
                    break
                above = takes
            follows = np.where(below, off <= 0, forces < -marks.limit)
            if (follows == below).all():
                break
            below, above = follows, above & ~follows
        return states

    def _for_states(self, states: Array, start: Array) -> tuple[Array, Array]:
        """The displacement, and the forces on what is observed, for some states."""
        marks, held = self._marks, states == 0
        begin, load = start.copy(), np.zeros(self._matrix.size)
        begin[marks.at[held]] = marks.y[held]
        load[marks.at] = -marks.limit * states
        high, low = self._factors(held).displaced(begin, load)
        return high, -self._matrix.times(high, low)[0][marks.at]

    def _factors(self, held: Flags) -> Factors:
        free = self._moving.copy()
        free[self._marks.at[held]] = False
        return Factors(self._matrix, np.flatnonzero(free))

    def _shortest(self, d: Array, motions: Array, states: Array) -> Array:
        """The field of least length among d and motions, what slips staying on its side."""
        marks, slips = self._marks, states != 0
        return shortest(self._matrix, d, motions, marks.at[slips], states[slips], marks.y[slips])


def shortest(
    matrix: Matrix, d: Array, motions: Array, at: Numbers, signs: Array, y: Array
) -> Array:
    """Add motions such that the sum of squares is least, and ``signs (d[at] - y) >= 0``.

    Returns d as it is where there is no such field. Every piece of tissue is its own problem.
    """
    d = d.copy()
    graph = scipy.sparse.csr_matrix(
        (np.ones(len(matrix.rows)), (matrix.rows, matrix.columns)), shape=(matrix.size,) * 2
    )
    _, piece = csgraph.connected_components(graph, directed=False)
    # The components that are not 0 of a motion are of one piece.
    owner = piece[np.abs(motions).argmax(axis=1)] if len(motions) else np.zeros(0, int)
    for number in np.unique(owner):
        here = np.flatnonzero(piece == number)
        basis = np.linalg.qr(motions[owner == number][:, here].T)[0]
        of = piece[at] == number
        local = np.searchsorted(here, at[of])
        rows = signs[of, None] * basis[local]
        along = basis.T @ d[here]
        needed = signs[of] * (y[of] - d[at[of]]) + rows @ along
        turned = _least_distance(rows, needed)
        if turned is not None:
            d[here] += basis @ (turned - along)
    return d


def _least_distance(rows: Array, needed: Array) -> Array | None:
    """The shortest x with ``rows x >= needed`` (Lawson and Hanson 1974, chapter 23), or None."""
    matters = np.abs(rows).max(axis=1, initial=0.0) > 1e-12
    if (needed[~matters] > _SLACK).any():
        return None
    rows, needed = rows[matters], needed[matters]
    if not (needed > 0).any():
        return np.zeros(rows.shape[1])
    scale = float(np.abs(needed).max())
    stacked = np.vstack([rows.T, needed / scale])
    goal = np.zeros(len(stacked))
    goal[-1] = 1
    try:
        pressed, rest = scipy.optimize.nnls(stacked, goal, maxiter=50 * stacked.shape[1])
    except RuntimeError:
        return None
    if rest < 1e-10:
        return None
    # What is touched is touched exactly.
    active = pressed > 0
    return np.asarray(np.linalg.lstsq(rows[active], needed[active], rcond=None)[0])


def _balanced(motions: Array, load: Array) -> bool:
    """Whether a load does no work in any of the motions."""
    most = np.abs(motions).max(axis=1, initial=0.0) * np.abs(load).max(initial=0.0)
    return bool((np.abs(motions @ load) <= _SLACK * most).all())


def _part(slack: Array, narrower: Array, past: Array, wider: Array, most: float) -> float:
    """The part of a step after which everything positive still is."""
    parts = [1.0]
    for value, change in ((slack, narrower), (past, wider)):
        falls = change < 0
        if falls.any():
            parts.append(most * float((-value[falls] / change[falls]).min()))
    return min(parts)
