"""Tissue that slides along a painted surface keeps its distance and is not locked by its pixels."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import (
    BoundaryRule,
    ElasticPrior,
    Grid,
    Motion,
    Problem,
    ProblemError,
    Study,
    Tissue,
    solve,
    solve_study,
)
from napari_hmrf.tissue.sliding import sliding_precision, sliding_surface


def slipped(y, c, m, painted, spacing=1.0):
    """Return the sites and normals of a sliding surface, and their displacement."""
    surface = sliding_surface(m, painted, spacing=spacing)
    data = sliding_precision(m, painted, spacing=spacing)
    spacing = np.broadcast_to(spacing, m.ndim).tolist()
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=m, precision=data, spacing=spacing),
        ElasticPrior(0.3),
        backend="cpu",
    )
    return surface, solution.displacement[surface.sites]


def tilted_plane(degrees, spacing=(1, 1), size=48):
    """Return the normal, the direction along a plane, and the position of each pixel."""
    angle = np.radians(degrees)
    normal, along = (np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))
    place = (np.moveaxis(np.indices((size, size)), 0, -1) - size / 2) * spacing
    return np.array(normal), np.array(along), place


@pytest.mark.parametrize(
    ("degrees", "spacing"), [(0, (1, 1)), (5, (1, 1)), (17, (1, 1)), (45, (1, 1)), (17, (1, 2))]
)
def test_a_block_slides_along_the_staircase_of_a_tilted_wall(degrees, spacing):
    normal, along, place = tilted_plane(degrees, spacing)
    depth = place @ normal
    m = (depth < 0.6).astype(float)
    far = (depth < -16)[..., None]
    surface, motion = slipped(4 * along * far, far * np.ones(2), m, np.abs(depth) <= 2.5, spacing)
    middle = np.abs(place[surface.sites] @ along) < 12
    assert (motion[middle] @ along).min() > 0.99 * 4
    assert np.abs(motion[middle] @ normal).max() < 0.05
    # At the end of the wall, half of the sites of a fit are missing.
    assert (motion @ along).min() > 0.98 * 4


@pytest.mark.parametrize(("axes", "radius"), [(2, 13), (3, 8)])
def test_a_ball_turns_in_a_round_socket(axes, radius):
    place = np.moveaxis(np.indices((2 * radius + 9,) * axes), 0, -1) - (radius + 3.9)
    away = np.linalg.norm(place, axis=-1)
    turn = np.zeros_like(place)
    turn[..., -2], turn[..., -1] = -0.2 * place[..., -1], 0.2 * place[..., -2]
    core = (away <= 3)[..., None]
    m = (away <= radius + 0.5).astype(float)
    surface, motion = slipped(turn * core, core * np.ones(axes), m, away > radius - 2)
    normal = place[surface.sites] / away[surface.sites][:, None]
    ideal = turn[surface.sites]
    square = (ideal**2).sum(axis=1)
    moving = square > 0.01 * square.max()
    assert ((motion * ideal).sum(axis=1) / square)[moving].min() > 0.95
    assert np.abs((motion * normal).sum(axis=1)).max() < 0.1
    assert ((surface.normals * normal).sum(axis=1) > 0.99).all()  # outward


def test_thick_paint_around_a_corner_does_not_lock_the_side_along_which_a_block_slides():
    y, c, m = np.zeros((30, 40, 2)), np.zeros((30, 40, 2)), np.zeros((30, 40))
    m[5:25, 8:32] = 1
    y[5:8, 8:32], c[5:8, 8:32] = (0, 3), 1
    painted = np.zeros(m.shape, bool)
    painted[23:] = True
    _, motion = slipped(y, c, m, painted)
    assert motion[:, 1].min() > 0.9 * 3


@pytest.mark.parametrize("margin", [0, 4])
def test_a_block_is_stretched_along_three_walls_with_labels_of_their_own(margin):
    m = np.zeros((32, 40))
    block = (slice(margin, 32 - margin), slice(margin, 40 - margin))
    m[block] = 1
    walls = np.zeros(m.shape, int)
    walls[block][:, 0], walls[block][-1], walls[block][0] = 3, 1, 2
    rules = (
        BoundaryRule(1, "slide", amount=1.0),
        BoundaryRule(2, "slide"),
        BoundaryRule(3, "slide"),
    )
    study = Study(Grid(m.shape, 1.0), Tissue(stiffness=m), Motion(labels=walls, rules=rules))
    rows, cols = np.indices(m[block].shape)
    strain = 1 / (len(rows) - 1)
    uniform = strain * np.stack([rows, -0.45 * cols], axis=-1)
    assert np.abs(solve_study(study).displacement[block] - uniform).max() < 0.005


def test_the_unit_of_stiffness_has_no_effect_on_a_slip():
    normal, along, place = tilted_plane(30)
    depth = place @ normal
    far = (depth < -16)[..., None]
    paint = np.abs(depth) <= 2.5
    kpa, pa = (
        slipped(4 * along * far, far * np.ones(2), unit * (depth < 0.6), paint)[1]
        for unit in (1.0, 1000.0)
    )
    assert np.abs(kpa - pa).max() < 2e-3


def test_a_line_inside_tissue_has_the_normal_of_the_line():
    normal, _, place = tilted_plane(17)
    surface = sliding_surface(np.ones((48, 48)), np.abs(place @ normal) <= 0.5, spacing=1.0)
    assert np.abs(surface.normals @ normal).min() > np.cos(np.radians(5))
    middle = np.abs(np.argwhere(surface.sites) - 24).max(axis=1) < 12
    assert np.abs(surface.normals[middle] @ normal).min() > np.cos(np.radians(1))


def test_paint_of_another_shape_or_with_fractions_is_refused():
    with pytest.raises(ProblemError, match=r"0\.5"):
        sliding_surface(np.ones((4, 4)), np.full((4, 4), 0.5), spacing=1.0)
    with pytest.raises(ProblemError, match="has shape"):
        sliding_surface(np.ones((4, 4)), np.ones((4, 5)), spacing=1.0)
