"""Contact of sliding parts in large motion: its energy, forces and second derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import NeoHookeanPrior, Problem
from napari_hmrf.solver.contact import Contact
from napari_hmrf.solver.data_term import packed_axes
from napari_hmrf.solver.interface_level import Interface
from napari_hmrf.solver.unfolded import unfolded
from napari_hmrf.tissue import SlidingParts


def places(size, axes):
    """Return the position of each pixel relative to a centre that is no pixel."""
    centre = size / 2 - np.array([0.4, 0.7, 0.2])[:axes]
    return np.moveaxis(np.indices((size,) * axes), 0, -1) - centre


def turn(degrees, axes):
    angle, matrix = np.radians(degrees), np.eye(axes)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return matrix


class Ball:
    """Ball in tissue that fills the rest of the image, and their contact."""

    def __init__(self, axes, size):
        self.axes, self.at, self.radius = axes, places(size, axes), 0.3 * size
        inside = np.linalg.norm(self.at, axis=-1) < self.radius
        problem = Problem(
            observed=0 * self.at,
            confidence=np.ones(self.at.shape),
            stiffness=np.ones(inside.shape),
            sliding=SlidingParts(inside.astype(int)),
        )
        parts, _ = unfolded(problem, NeoHookeanPrior())
        self.coupling = parts.coupling
        self.contact = Contact(self.coupling, parts.stiffness, (1.0,) * axes, 1.0)
        self.inner = (slice(None), *(slice(2, -2),) * axes)

    def planes(self, around, ball):
        """Return planes in which the tissue around the ball and the ball have given fields."""
        made = np.zeros((self.axes, *(size + 4 for size in self.coupling.own.shape)))
        for box, field in zip(self.coupling.boxes, (around, ball), strict=True):
            made[self.inner][(slice(None), *box.unfolded)] = np.moveaxis(field[box.image], -1, 0)
        return made

    def forces(self, d):
        out = np.zeros_like(d)
        self.contact.add_forces(d, out)
        return out

    def image(self, way):
        """Return the image of a motion by all second derivatives of the last linear model."""
        out = np.zeros_like(way)
        self.contact.add_image(way, out, 1.0)
        pairs = packed_axes(self.axes)
        for values, (i, j) in zip(self.contact.tensors(), pairs, strict=True):
            out[self.inner][i] += values * way[self.inner][j]
            if i != j:
                out[self.inner][j] += values * way[self.inner][i]
        return out


@pytest.fixture(scope="module", params=[2, 3])
def ball(request):
    return Ball(request.param, {2: 24, 3: 10}[request.param])


@pytest.fixture(scope="module")
def rough(ball):
    """Return a turn of a growing ball in strained tissue, with noise."""
    noise = np.random.default_rng(0).normal(scale=0.05, size=(2, *ball.at.shape))
    turned = ball.at @ (1.03 * turn(25, ball.axes) - np.eye(ball.axes)).T
    return ball.planes(0.02 * ball.at[..., ::-1] + noise[0], turned + noise[1])


def test_forces_and_second_derivatives_of_a_contact_are_those_of_its_energy(ball, rough):
    random = np.random.default_rng(1)
    way = np.zeros_like(rough)
    way[ball.inner] = random.normal(size=way[ball.inner].shape)
    step = 1e-6 * way
    rise = (ball.contact.energy(rough + step) - ball.contact.energy(rough - step)) / 2e-6
    assert (ball.forces(rough) * way).sum() == pytest.approx(rise, rel=1e-6)
    ball.contact.linearise(rough)
    change = (ball.forces(rough + step) - ball.forces(rough - step)) / 2e-6
    assert np.abs(ball.image(way) - change).max() <= 1e-8 * np.abs(change).max()


def test_the_matrix_of_a_contact_is_what_its_linear_model_applies(ball, rough):
    for positive in (0.0, 1.0):
        ball.contact.linearise(rough, positive)
        way = np.zeros_like(rough)
        way[ball.inner] = np.random.default_rng(2).normal(size=way[ball.inner].shape)
        flat = np.moveaxis(way[ball.inner], 0, -1).ravel()
        both = ball.contact.matrix() + ball.contact.lumped()
        image = np.moveaxis(ball.image(way)[ball.inner], 0, -1).ravel()
        assert np.abs(both @ flat - image).max() <= 1e-12 * np.abs(image).max()
    rows = ball.contact.rows()
    assert np.abs(rows.T @ (rows @ flat) - image).max() <= 1e-12 * np.abs(image).max()


def test_a_contact_pushes_at_one_place_in_opposite_directions_so_that_nothing_turns():
    disc = Ball(2, 40)
    d = disc.planes(0.02 * disc.at[..., ::-1], disc.at @ (1.05 * turn(30, 2) - np.eye(2)).T)
    forces = np.moveaxis(disc.forces(d)[disc.inner], 0, -1)
    at = np.zeros((*disc.coupling.own.shape, 2))
    for box in disc.coupling.boxes:
        at[box.unfolded] = disc.at[box.image]
    at += np.moveaxis(d[disc.inner], 0, -1)
    torque = at[..., 0] * forces[..., 1] - at[..., 1] * forces[..., 0]
    size = np.abs(forces).sum()
    assert np.abs(forces.sum(axis=(0, 1))).max() <= 1e-12 * size
    assert abs(torque.sum()) <= 1e-4 * size * 12
    # The disc presses outwards, and the pressure hardly turns it.
    ((_, inner),) = disc.coupling.boxes[1:]
    assert abs(torque[inner].sum()) <= 0.02 * size * 12


def test_a_ball_may_turn_without_energy_but_may_not_enter_other_tissue(ball):
    rest = np.zeros(ball.at.shape)
    turned = ball.at @ (turn(40, ball.axes) - np.eye(ball.axes)).T
    energy = ball.contact.energy(ball.planes(rest, turned))
    assert energy <= 0.1 * ball.contact.energy(ball.planes(rest, turned + 1.0))
    for far in (3.0, 6.0):
        assert ball.contact.energy(ball.planes(rest, turned + far)) == np.inf


@pytest.mark.parametrize(("gap", "energy"), [(1.0, pytest.approx(0.6, rel=0.1)), (2.0, np.inf)])
def test_a_shrunken_disc_pulls_until_it_is_too_far_from_the_tissue_around_it(gap, energy):
    disc = Ball(2, 24)
    apart = disc.planes(np.zeros(disc.at.shape), -gap / disc.radius * disc.at)
    total = disc.contact.energy(apart)
    assert total / disc.coupling.strength.sum() == energy


def test_a_layer_that_slides_beyond_the_end_of_another_loses_contact_smoothly():
    line = np.stack([np.zeros(40), np.arange(40.0)], axis=1)
    interface = Interface(line, np.tile([1.0, 0.0], (40, 1)), 3.0, 8.0)
    along = np.linspace(37, 43, 6001)
    at = np.stack([np.full_like(along, 0.5), along], axis=1)
    found = interface.levels(at)
    assert (found.presence[along < 39] == 1).all()
    assert (found.presence[along > 42] == 0).all()
    assert found.values[along < 39] == pytest.approx(0.5)
    slope = np.gradient(found.presence, along)
    assert np.abs(slope - found.presence_slopes[:, 1]).max() <= 2e-3 * np.abs(slope).max()
    assert (np.diff(found.presence) <= 0).all()


def test_layers_cannot_be_pushed_through_each_other_however_far():
    rows = np.indices((60, 6))[0]
    problem = Problem(
        observed=np.zeros((60, 6, 2)),
        confidence=np.ones((60, 6, 2)),
        stiffness=np.ones((60, 6)),
        sliding=SlidingParts((rows >= 30).astype(int)),
    )
    parts, _ = unfolded(problem, NeoHookeanPrior())
    contact = Contact(parts.coupling, parts.stiffness, (1.0, 1.0), 1.0)
    grid, upper = parts.coupling.own.shape, parts.coupling.boxes[0].unfolded
    for far in (2, 8, 13, 20, 28):
        d = np.zeros((2, *(size + 4 for size in grid)))
        d[0, 2:-2, 2:-2][upper] = far
        assert contact.energy(d) == np.inf
