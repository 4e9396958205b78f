"""Large motion past an arrow that cannot be met: the others are met, in any order of edits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from napari_hmrf import Multigrid, NeoHookeanPrior, Problem, Solution, solve
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.caveats import shortfall
from napari_hmrf.solver.optimizers import newton
from napari_hmrf.solver.optimizers.base import Reach
from napari_hmrf.solver.optimizers.obstruction import folding

PRIOR, LIVE = NeoHookeanPrior(), Multigrid(0.01, budget=None)
# Centre, radius and motion of a pulled disc or ball.
Arrow = tuple[tuple[int, ...], float, tuple[float, ...]]
HELD_PATCH = (16, 28), 4.5, (0, 0)
ONTO_PATCH = (16, 12), 3, (0, 16)
FAR_AWAY = (48, 40), 3, (0, 8)


def pulled(size: int, arrows: Sequence[Arrow]) -> Problem:
    """Return a block with a held border and pulled discs or balls."""
    ndim = len(arrows[0][0])
    sites = np.indices((size,) * ndim)
    c, y = np.zeros((2, *sites.shape[1:], ndim))
    c[(sites % (size - 1) == 0).any(axis=0)] = 1
    for centre, radius, motion in arrows:
        offsets = sites - np.reshape(centre, (ndim, *(1,) * ndim))
        at = np.linalg.norm(offsets, axis=0) <= radius
        c[at], y[at] = 1, motion
    return Problem(observed=y, confidence=c, stiffness=np.ones(c.shape[:-1]))


def solved(problem: Problem, initial: Solution | None = None) -> Solution:
    return solve(problem, PRIOR, optimizer=LIVE, backend="cpu", initial=initial)


@cache
def added_later(other: Arrow) -> tuple[Solution, Solution]:
    """Solve with an arrow, and again with another arrow onto the held patch."""
    earlier = solved(pulled(64, [HELD_PATCH, other]))
    return earlier, solved(pulled(64, [HELD_PATCH, ONTO_PATCH, other]), earlier)


def gap(arrow: Arrow, solution: Solution) -> float:
    """Return the distance of the centre of an arrow from its target."""
    centre, _, motion = arrow
    return float(np.linalg.norm(solution.displacement[centre] - motion))


@pytest.mark.parametrize(
    ("size", "blocked", "free"),
    [
        pytest.param(
            64,
            ((28, 23), 4, (-19.4, 4.9)),
            ((41, 18), 2, (13.8, 14.5)),
            id="image",
            marks=pytest.mark.campaign,
        ),
        pytest.param(8, ((2, 4, 5), 1, (0, 0, 7)), ((5, 4, 2), 1, (0, 0, 2.0)), id="volume"),
    ],
)
def test_an_arrow_that_cannot_be_met_keeps_no_other_from_its_target(size, blocked, free):
    arrows = [HELD_PATCH, blocked, free] if len(blocked[0]) == 2 else [blocked, free]
    found = solved(pulled(size, arrows))
    assert gap(blocked, found) > 5
    assert gap(free, found) < 0.01
    assert found.count_folds() == 0


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(FAR_AWAY, id="far away"),
        pytest.param(((16, 44), 3, (0, -8)), id="on the other side", marks=pytest.mark.campaign),
    ],
)
def test_the_order_of_arrows_has_no_effect_if_one_cannot_be_met(other):
    _, later = added_later(other)
    at_once = solved(pulled(64, [HELD_PATCH, ONTO_PATCH, other]))
    assert np.array_equal(later.displacement, at_once.displacement)


def test_all_arrows_that_are_not_met_are_named(tmp_path):
    edge = (48, 48), 3, (0, 30)
    found = solved(pulled(64, [HELD_PATCH, ONTO_PATCH, edge]))
    assert found.reach.regions[0] == found.reach.where
    far, near = (np.array(arrow[0]) for arrow in (edge, ONTO_PATCH))
    first, second = found.reach.regions
    assert np.linalg.norm(first - far) <= 3
    assert np.linalg.norm(second - near) <= 3
    assert f"the pixel at {first} by" in shortfall(found.reach, "mm")
    assert f"and others at {second}" in shortfall(found.reach, "mm")
    assert Solution.read(found.write(tmp_path / "two.hmrf")).reach == found.reach


def test_a_message_names_a_few_of_many_arrows():
    regions = tuple((row, 0) for row in range(9))
    said = shortfall(Reach(0.5, where=(0, 0), regions=regions), "mm")
    assert "others at (1, 0), (2, 0), (3, 0) and in 5 more regions" in said


@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 5)])
def test_the_folding_of_elements_is_measured_relative_to_the_step(shape):
    random, sides = np.random.default_rng(2), (0.7, 1.4, 1.0)[: len(shape)]
    d = host.planes(random.uniform(-0.1, 0.1, (*shape, len(shape))))
    sites = np.moveaxis(np.indices(shape), 0, -1)
    way = host.planes(-sites * np.array(sides))
    elements = np.zeros([size - 1 for size in shape], dtype=bool)
    elements[..., 1:3] = True
    assert (folding(d, way, sides, elements) * way).sum() == pytest.approx(elements.sum())


def test_a_region_that_folds_tissue_beyond_a_rigid_body_keeps_no_other_from_its_target(monkeypatch):
    # Only elements far from both regions obstruct the pull.
    monkeypatch.setattr(newton, "_OBSTRUCTION", 0.1)
    arrow = (28, 12), 2.5, (0, 4)
    problem = pulled(40, [arrow])
    c, y, m = (np.array(a) for a in (problem.confidence, problem.observed, problem.stiffness))
    m[4:21, 5:20], m[8:17, 19:31] = 1000, np.inf
    c[8:17, 10:15], y[8:17, 10:15] = 1, (0, 16)
    found = solved(Problem(observed=y, confidence=c, stiffness=m))
    assert found.reach.regions == (found.reach.where,)
    assert found.reach.sites == 45
    assert gap(arrow, found) < 0.01


def test_a_solve_that_used_up_its_budget_is_continued_past_an_obstruction(monkeypatch):
    monkeypatch.setattr(newton, "_SLOW_PULL", math.inf)  # no start from coarser grids
    earlier, later = added_later(FAR_AWAY)
    unfinished = replace(earlier, reach=replace(earlier.reach, stopped=True))
    problem = pulled(64, [HELD_PATCH, ONTO_PATCH, FAR_AWAY])
    continued = solved(problem, unfinished)
    assert gap(FAR_AWAY, continued) < 0.01
    assert gap(ONTO_PATCH, continued) == pytest.approx(gap(ONTO_PATCH, later), abs=0.5)
    assert not np.array_equal(continued.displacement, later.displacement), "begun again from rest"
