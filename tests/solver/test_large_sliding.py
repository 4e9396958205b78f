"""Parts that slide along each other in large motion."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import campaign as campaigns
from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.tissue import SlidingParts

CENTRE = 19.63, 19.29
SIZE, RADIUS = 40, 12.0


def places():
    return np.moveaxis(np.indices((SIZE, SIZE)), 0, -1) - np.array(CENTRE)


def turned(degrees):
    """Return the displacement of a rotation around the centre."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return places() @ turn.T - places()


def disc_in_a_ring(degrees, growth=1.0, strength=100.0):
    """Return a disc whose core turns and grows in tissue whose edge is held, and its mask."""
    away = np.linalg.norm(places(), axis=-1)
    held = away < RADIUS / 2
    y = np.where(held[..., None], turned(degrees) * growth + places() * (growth - 1), 0.0)
    for axis in range(2):
        held.swapaxes(0, axis)[[0, -1]] = True
    inside = away < RADIUS
    return Problem(
        observed=y,
        confidence=np.repeat(held[..., None], 2, axis=-1),
        stiffness=np.ones(away.shape),
        sliding=SlidingParts(inside.astype(int), strength=strength),
    ), inside


def test_a_disc_that_turns_by_40_degrees_strains_neither_itself_nor_the_ring():
    problem, inside = disc_in_a_ring(40)
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    error = found.displacement - np.where(inside[..., None], turned(40), 0.0)
    assert np.abs(error).max() <= 0.2
    assert found.reach.least_jacobian >= 0.9
    assert found.reach.where is None
    assert found.convergence.error <= 1e-3


def test_small_motion_along_a_straight_interface_is_that_of_the_linear_model():
    upper = np.arange(24) < 12
    labels = np.repeat(upper[:, None], 20, axis=1).astype(int)
    held = np.zeros((24, 20, 2))
    held[[0, -1]] = 1
    y = np.zeros_like(held)
    y[0] = 1e-3, 3e-3
    problem = Problem(
        observed=y, confidence=held, stiffness=1.0 + labels, sliding=SlidingParts(labels)
    )
    fields = [
        solve(problem, prior, optimizer=Multigrid(1e-7), backend="cpu").displacement
        for prior in (NeoHookeanPrior(0.3), ElasticPrior(0.3))
    ]
    assert np.abs(fields[0] - fields[1]).max() <= 1e-5
    slip = fields[0][11, 10, 1] - fields[0][12, 10, 1]
    assert slip == pytest.approx(3e-3, rel=0.01)


@pytest.mark.parametrize("strength", [1.0, 100.0])
def test_a_disc_that_grows_while_it_turns_enters_the_ring_by_less_than_its_strength_allows(
    strength,
):
    problem, inside = disc_in_a_ring(20, growth=1.3, strength=strength)
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    before, after = (np.linalg.norm(places() + d, axis=-1) for d in (0, found.displacement))
    # Sites beside the interface at the same distance from the centre move outwards alike.
    moves = after - before
    near = np.abs(before - RADIUS) < 2
    fits = [np.polyfit(before[near & side], moves[near & side], 1) for side in (inside, ~inside)]
    disc, ring = (np.polyval(fit, RADIUS) for fit in fits)
    assert ring > 0.5
    assert abs(disc - ring) <= 0.03 + 0.05 / strength


def layers(push, slip, curve=0.0, soft=1.0, size=24):
    """Return two layers, of which the upper is pushed towards the lower and along it."""
    rows, columns = np.indices((size, size))
    labels = (rows < size / 2 - 0.5 + curve * np.sin(2 * np.pi * columns / size)).astype(int)
    held, y = np.zeros((2, size, size, 2))
    held[[0, -1]] = 1
    y[0] = push, slip
    return Problem(
        observed=y,
        confidence=held,
        stiffness=np.where(labels, 1.0, soft),
        sliding=SlidingParts(labels),
    )


def test_a_layer_slides_freely_by_a_third_of_its_length_and_keeps_its_shape():
    problem = layers(0.0, 8.0)
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    upper = problem.sliding.labels == 1
    assert np.abs(found.displacement[upper] - [0, 8]).max() <= 1e-3
    assert np.abs(found.displacement[~upper]).max() <= 1e-3


@pytest.mark.parametrize(
    "problem",
    [
        layers(7.0, 0.0),
        layers(3.0, 5.0, curve=2.5, soft=4.0),
        layers(-2.0, 3.0, curve=1.5),
    ],
)
def test_layers_that_are_pressed_pulled_and_moved_along_each_other_stay_in_contact(problem):
    found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    assert found.reach.where is None
    assert found.convergence.error <= 1e-3
    # Beside the interface, the layers are as far apart as at rest: no pixel of one is in the other.
    rows, columns = np.indices(problem.shape)
    moved = np.stack([rows, columns], axis=-1) + found.displacement
    upper = problem.sliding.labels == 1
    last = upper & ~np.roll(upper, -1, axis=0)
    first = ~upper & np.roll(upper, 1, axis=0) & (rows > 0)
    edges = [moved[side][np.argsort(moved[side][:, 1])] for side in (last, first)]
    middle = np.linspace(9, 15, 50)
    apart = np.diff([np.interp(middle, edge[:, 1], edge[:, 0]) for edge in edges], axis=0)
    assert abs(apart.mean() - 1) <= 0.5
    assert apart.min() > 0


def test_a_drag_that_starts_from_the_last_field_ends_where_a_new_solve_does():
    fields = []
    for warm in (True, False):
        found = None
        for share in (0.5, 1.0) if warm else (1.0,):
            problem = layers(share, 3 * share, curve=1.0, size=16)
            found = solve(problem, NeoHookeanPrior(0.3), initial=found, backend="cpu")
        fields.append(found)
    warm, cold = fields
    limit = warm.convergence.error + cold.convergence.error
    assert np.abs(warm.displacement - cold.displacement).max() <= limit


def test_three_parts_that_meet_and_parts_that_share_no_element_slide():
    rows, columns = np.indices((24, 20))
    labels = np.where(rows < 12, 0, np.where(columns < 10, 1, 2))
    held, y = np.zeros((2, 24, 20, 2))
    held[[0, -1]], y[0] = 1, (1, 2)
    gap = np.where((rows == 11) | (rows == 12), 0.0, 1.0)
    for stiffness in (np.ones(labels.shape), gap):
        problem = Problem(
            observed=y,
            confidence=held,
            stiffness=stiffness,
            spacing=(1.0, 0.6),
            sliding=SlidingParts(labels),
        )
        found = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
        assert found.convergence.error <= 1e-3
        assert found.reach.where is None
    assert np.abs(found.displacement[:11] - y[0]).max() <= 1e-3


@pytest.mark.campaign
def test_random_parts_come_to_rest_where_an_independent_method_does():
    run = campaigns.run("large-sliding", (0, 1, 3, 4, 5, 14))
    outcomes = [verdict.outcome for _, verdict in run.verdicts]
    assert outcomes.count("right") == len(outcomes)
    assert run.is_right, campaigns.report(run)
