"""Rigid tissue in large motion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from napari_hmrf import NeoHookeanPrior, Problem, ProblemError, Solution, solve
from napari_hmrf.loads import Loads, growth, reactions
from validation.bodies import framed
from validation.oracles.large_motion import large_field

Field = npt.NDArray[np.float64]

SIZE = 28
ROW, COL = np.indices((SIZE, SIZE))
BONE = (abs(ROW - 13) < 4) & (abs(COL - 10) < 4)
# Sites of all elements with a corner in the bone.
BODY = (abs(ROW - 13) < 5) & (abs(COL - 10) < 5)
STIFFNESS = np.where(BONE, np.inf, 1.0)


def rotated(degrees: float) -> Field:
    """Return the displacement of a rotation around the middle of the bone."""
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = np.stack([ROW - 13, COL - 10], axis=-1)
    return places @ turn.T - places


def deviation_and_angle(problem: Problem, found: Solution) -> tuple[float, float]:
    """Return the deviation of the body from a rigid motion, and its rotation in degrees."""
    size = np.array(problem.spacing)
    before = np.stack([ROW[BODY], COL[BODY]], axis=-1) * size
    after = before + found.displacement[BODY]
    before, after = before - before.mean(axis=0), after - after.mean(axis=0)
    left, _, right = np.linalg.svd(before.T @ after)
    turn = left @ right
    angle = float(np.rad2deg(np.arctan2(turn[0, 1], turn[0, 0])))
    return float(np.abs(before @ turn - after).max()), angle


def test_a_bone_in_sheared_tissue_rotates_rigidly() -> None:
    c = np.zeros((SIZE, SIZE, 2))
    c[[0, -1]] = 1
    y = np.zeros_like(c)
    y[-1] = 0, 9
    found = solve(
        Problem(observed=y, confidence=c, stiffness=STIFFNESS), NeoHookeanPrior(), backend="cpu"
    )
    off, angle = deviation_and_angle(Problem(observed=y, confidence=c, stiffness=STIFFNESS), found)
    assert off < 1e-5
    assert angle > 5
    # Very stiff tissue approximates rigid tissue.
    stiff = Problem(observed=y, confidence=c, stiffness=np.where(BONE, 1e5, 1.0))
    assert np.abs(found.displacement - large_field(stiff, NeoHookeanPrior(), 4)).max() < 2e-3


def test_forces_rotate_a_bone_like_very_stiff_tissue() -> None:
    force = np.zeros((SIZE, SIZE, 2))
    force[9, 6:15], force[17, 6:15] = (0, 0.4), (0, -0.4)
    nothing = np.zeros_like(force)
    problem = framed(
        BODY & False, nothing, Loads(force=force) + growth(0.3 * (COL > 20)), stiffness=STIFFNESS
    )
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = deviation_and_angle(problem, found)
    assert off < 1e-5
    assert abs(angle) > 5
    c = problem.confidence
    stiff = Problem(
        observed=nothing, confidence=c, stiffness=np.where(BONE, 1e5, 1.0), loads=problem.loads
    )
    assert np.abs(found.displacement - large_field(stiff, NeoHookeanPrior(), 1)).max() < 2e-3
    holds = reactions(problem, found)
    assert np.abs(holds.sum(axis=(0, 1))).max() < 1e-2


@pytest.mark.parametrize("where", ["everywhere", "in two places"])
def test_a_bone_can_be_rotated_far(where) -> None:
    at = BODY.copy()
    if where != "everywhere":
        at[:] = False
        at[10, 7] = at[16, 13] = True
    problem = framed(at, rotated(50), stiffness=STIFFNESS)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = deviation_and_angle(problem, found)
    assert off < 1e-5
    assert angle == pytest.approx(50, abs=1e-3)
    assert found.reach.part == 1
    assert NeoHookeanPrior().corner_jacobians(problem, found.displacement).min() > 0


def test_a_bone_pulled_at_one_pixel_rotates_freely() -> None:
    at = BODY & False
    at[10, 7] = True
    problem = framed(at, (4.0, 3.0), stiffness=STIFFNESS)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, angle = deviation_and_angle(problem, found)
    assert off < 1e-5
    assert abs(angle) > 5
    assert found.displacement[10, 7] == pytest.approx([4.0, 3.0], abs=1e-5)


def test_a_bone_stopped_by_tissue_keeps_its_shape() -> None:
    problem = framed(BODY, (0.0, 25.0), stiffness=STIFFNESS)
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    off, _ = deviation_and_angle(problem, found)
    assert off < 1e-5
    assert NeoHookeanPrior().corner_jacobians(problem, found.displacement).min() > 0
    assert 0.2 < found.reach.part < 1
    assert found.reach.sites == BODY.sum()


def test_a_prescribed_stretch_of_a_bone_is_rejected() -> None:
    places = np.stack([ROW - 13, COL - 10], axis=-1)
    with pytest.raises(ProblemError, match=r"rigid body around \(13, 10\) relative to"):
        solve(framed(BODY, 0.2 * places, stiffness=STIFFNESS), NeoHookeanPrior(), backend="cpu")
