"""Exact solution with the L1 observations of eq. 19: each is fixed, or slips with its full force.

The solution d satisfies ``A d + force = 0``. The force of an observed component is between -p and p
if d = y, and p sign(d - y) otherwise. For a symmetric A, this is the minimum of the energy. The
states (fixed or slipping) are found by exchanging all states that contradict the solution. If this
fails, they are found by a primal-dual interior-point method (symmetric A), or by nested policy
iteration (the centred A, an M-matrix). In all cases the result is verified by the conditions above
in double-double precision.

All fields of least energy have the same forces. Therefore they differ only by zero-energy motions
that do not move the fixed components with a force below p. The field with the smallest sum of
squares is returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.optimize
import scipy.sparse
from scipy.sparse import csgraph

from validation.oracles.exact import double_double as dd
from validation.oracles.exact.double_double import Array, Factors, Matrix, Numbers

# Tolerance for contradictions of a state: in pixels, or as a fraction of the limit.
_SLACK = 1e-10
#: Relative difference between a force and its limit below which they are considered equal.
TIE = 1e-9
# Relative difference below which they may be considered equal in single precision.
_NEARLY = 1e-6
_EXCHANGES = 40
_SINGLE = 200
_STEPS = 100
# The interior-point method stops if no product of slack and passage exceeds this value.
_GAP = 1e-22
_SIDE = np.array([[1.0], [-1.0]])

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Marks:
    """Observations of components that move.

    Attributes
    ----------
    at : ndarray of int
        Indices of the components.
    y : ndarray
        Observed positions, in pixels.
    limit : ndarray
        Largest force p on each component.
    """

    at: Numbers
    y: Array
    limit: Array


@dataclass(frozen=True, eq=False)
class Balance:
    """Displacement in equilibrium.

    Attributes
    ----------
    displacement : ndarray, shape (n,)
        Displacement, in pixels.
    motions : int
        Number of independent motions by which other fields of the same energy differ.
    edge : bool
        True if a relative change of an observation's limit by 1e-6 would change `motions`.
    last_step : float
        Change in the last refinement step, in pixels.
    held : ndarray of bool, shape (marks,)
        Mask of the observations that do not slip.
    """

    displacement: Array
    motions: int
    edge: bool
    last_step: float
    held: Flags


def balance(
    matrix: Matrix, moving: npt.NDArray[np.bool_], marks: Marks, rest: Array
) -> Balance | None:
    """Find the displacement in equilibrium; return None if the search fails.

    Parameters
    ----------
    matrix : Matrix
        Matrix of the tissue.
    moving : ndarray of bool, shape (n,)
        Mask of the components with forces; other components stay at `rest`.
    marks : Marks
        Observations that may slip.
    rest : ndarray, shape (n,)
        Initial displacement, and values of the components that do not move.
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
    """Consistent states: 0 if fixed, otherwise the sign of d - y."""

    states: Array
    displacement: Array
    forces: Array
    last_step: float


class _Point(NamedTuple):
    """Iterate of the interior-point method; `past` and `slack` have shape (2, observations)."""

    past: Array
    slack: Array
    weights: Array
    out: Array
    apart: Array


class _Search:
    """Search for the states of the observations."""

    def __init__(self, matrix: Matrix, moving: Flags, marks: Marks) -> None:
        self._matrix, self._moving, self._marks = matrix, moving, marks

    def exchange(self, states: Array, start: Array, singly: bool = False) -> _Found | None:
        """Exchange contradicting states until all are consistent; return None if this fails.

        With `singly`, only the last contradicting state is exchanged in later iterations (Murty's
        rule).
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
        """Return the displacement with the least sum of squares for these forces."""
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
        """Return the states and the displacement found by Mehrotra's method."""
        marks, size = self._marks, self._matrix.size
        at, limit = marks.at, marks.limit
        unknowns = np.flatnonzero(self._moving)
        d, low = np.where(self._moving, 0.0, start), np.zeros(size)
        # Distance past the mark on each side, and distance of the force from each limit.
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
        """Return the changes of all variables for which slack times passage equals `aim`."""
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
        """Return the states of nested policy iteration, which terminates if A is an M-matrix.

        The equation is ``max(A d - p, min(A d + p, d - y)) = 0``. The outer iteration determines
        the components whose first argument is the maximum. The inner iteration determines which of
        the other two arguments is the minimum.
        """
        marks = self._marks
        below = np.zeros(len(marks.at), np.bool_)
        above = np.zeros(len(marks.at), np.bool_)
        for _ in range(_STEPS):
            for _ in range(_STEPS):
                states = np.where(below, -1.0, np.where(above, 1.0, 0.0))
                displacement, forces = self._for_states(states, start)
                off = displacement[marks.at] - marks.y
                # Either A d + p or d - y is 0, so the unit of the nonzero term does not matter.
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
        """Return the displacement, and the forces on observations, for given states."""
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
        """Return d plus motions with the least norm; slipping components stay on their side."""
        marks, slips = self._marks, states != 0
        return shortest(self._matrix, d, motions, marks.at[slips], states[slips], marks.y[slips])


def shortest(
    matrix: Matrix, d: Array, motions: Array, at: Numbers, signs: Array, y: Array
) -> Array:
    """Add motions that minimize ||d|| subject to ``signs (d[at] - y) >= 0``.

    Return d unchanged if there is no such field. Each piece of tissue is a separate problem.
    """
    d = d.copy()
    graph = scipy.sparse.csr_matrix(
        (np.ones(len(matrix.rows)), (matrix.rows, matrix.columns)), shape=(matrix.size,) * 2
    )
    _, piece = csgraph.connected_components(graph, directed=False)
    # The nonzero components of a motion belong to a single piece.
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
    """Return the shortest x with ``rows x >= needed``, or None (Lawson and Hanson, chapter 23)."""
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
    # Solve the active constraints exactly.
    active = pressed > 0
    return np.asarray(np.linalg.lstsq(rows[active], needed[active], rcond=None)[0])


def _balanced(motions: Array, load: Array) -> bool:
    """Return whether a load does no work in any of the motions."""
    most = np.abs(motions).max(axis=1, initial=0.0) * np.abs(load).max(initial=0.0)
    return bool((np.abs(motions @ load) <= _SLACK * most).all())


def _part(slack: Array, narrower: Array, past: Array, wider: Array, most: float) -> float:
    """Return the fraction of a step, at most 1, after which all values are still positive."""
    parts = [1.0]
    for value, change in ((slack, narrower), (past, wider)):
        falls = change < 0
        if falls.any():
            parts.append(most * float((-value[falls] / change[falls]).min()))
    return min(parts)
