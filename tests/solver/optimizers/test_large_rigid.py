"""Claims about rigid tissue within tissue that moves far."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from napari_hmrf import NeoHookeanPrior, Problem, ProblemError, Solution, solve
from napari_hmrf.loads import Loads, growth, reactions
from tests.support.finite_oracle import solved

Field = npt.NDArray[np.float64]

SIZE = 28
ROW, COL = np.indices((SIZE, SIZE))
BONE = (abs(ROW - 13) < 4) & (abs(COL - 10) < 4)
# Sites of elements that have a corner in it.
BODY = (abs(ROW - 13) < 5) & (abs(COL - 10) < 5)
STIFFNESS = np.where(BONE, np.inf, 1.0)


def framed(y: Field, at: npt.NDArray[np.bool_], loads: Loads | None = None) -> Problem:
    """Tissue that is held all around, and moved where it is said to."""
    c = np.zeros((SIZE, SIZE, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    c[at] = 1
    return Problem(np.where(at[..., None], y, 0), c, STIFFNESS, loads=loads)


def turned(degrees: float) -> Field:
    """How the bone's pixels move as it turns around its middle."""
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = np.stack([ROW - 13, COL - 10], axis=-1)
    return places @ turn.T - places


def shape_of(problem: Problem, found: Solution) -> tuple[float, float]:
    """How far the body is from its own shape, and how far it has turned, in degrees."""
    size = np.array(problem.spacing)
    before = np.stack([ROW[BODY], COL[BODY]], axis=-1) * size
    after = before + found.displacement[BODY]
    before, after = before - before.mean(axis=0), after - after.mean(axis=0)
    left, _, right = np.linalg.svd(before.T @ after)
    turn = left @ right
    angle = float(np.rad2deg(np.arctan2(turn[0, 1], turn[0, 0])))
    return float(np.abs(before @ turn - after).max()), angle


def test_a_bone_in_sheared_tissue_turns_as_one() -> None:
    c = np.zeros((SIZE, SIZE, 2))
    c[[0, -1]] = 1
    y = np.zeros_like(c)
    y[-1] = 0, 9
    found = solve(Problem(y, c, STIFFNESS), NeoHookeanPrior(), backend="cpu")
    off, angle = shape_of(Problem(y, c, STIFFNESS), found)
    assert off < 1e-5
    assert angle > 5
    # Stiffer and stiffer tissue comes as close as it is stiff.
    stiff = Problem(y, c, np.where(BONE, 1e5, 1.0))
    assert np.abs(found.displacement - solved(stiff, NeoHookeanPrior(), 4)).max() < 2e-3


def test_forces_turn_a_bone_as_those_of_very_stiff_tissue_do() -> None:
    force = np.zeros((SIZE, SIZE, 2))
    force[9, 6:15], force[17, 6:15] = (0, 0.4), (0, -0.4)
    nothing = np.zeros_like(force)
    problem = framed(nothing, BODY & False, Loads(force=force) + growth(0.3 * (COL > 20)))
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = shape_of(problem, found)
    assert off < 1e-5
    assert abs(angle) > 5
    c = problem.confidence
    stiff = Problem(nothing, c, np.where(BONE, 1e5, 1.0), loads=problem.loads)
    assert np.abs(found.displacement - solved(stiff, NeoHookeanPrior(), 1)).max() < 2e-3
    holds = reactions(problem, found, NeoHookeanPrior())
    assert np.abs(holds.sum(axis=(0, 1))).max() < 1e-2


@pytest.mark.parametrize("where", ["everywhere", "in two places"])
def test_a_bone_may_be_turned_far(where) -> None:
    at = BODY.copy()
    if where != "everywhere":
        at[:] = False
        at[10, 7] = at[16, 13] = True
    problem = framed(turned(50), at)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = shape_of(problem, found)
    assert off < 1e-5
    assert angle == pytest.approx(50, abs=1e-3)
    assert found.reach.part == 1
    assert NeoHookeanPrior().corner_jacobians(problem, found.displacement).min() > 0


def test_a_bone_that_is_dragged_at_one_pixel_turns_freely() -> None:
    at = BODY & False
    at[10, 7] = True
    problem = framed(np.broadcast_to([4.0, 3.0], (SIZE, SIZE, 2)), at)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = shape_of(problem, found)
    assert off < 1e-5
    assert abs(angle) > 5
    assert found.displacement[10, 7] == pytest.approx([4.0, 3.0], abs=1e-5)


def test_a_bone_that_cannot_go_on_stops_as_one() -> None:
    problem = framed(np.broadcast_to([0.0, 25.0], (SIZE, SIZE, 2)), BODY)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, _ = shape_of(problem, found)
    assert off < 1e-5
    assert NeoHookeanPrior().corner_jacobians(problem, found.displacement).min() > 0
    assert 0.2 < found.reach.part < 1
    assert found.reach.sites == BODY.sum()


def test_a_bone_that_would_be_stretched_is_refused() -> None:
    places = np.stack([ROW - 13, COL - 10], axis=-1)
    with pytest.raises(ProblemError, match=r"rigid body around \(13, 10\) against each"):
        solve(framed(0.2 * places, BODY), NeoHookeanPrior(), backend="cpu")
