"""Smooth fields of sliding parts near their interfaces."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import NeoHookeanPrior, Problem
from napari_hmrf.solver.smooth_fields import SmoothFields
from napari_hmrf.solver.unfolded import unfolded
from napari_hmrf.tissue import SlidingParts


@pytest.fixture
def fields():
    """Return the fields of a disc and of the tissue around it, in an image with oblong pixels."""
    at = np.moveaxis(np.indices((30, 30)), 0, -1) - 15
    labels = np.linalg.norm(at, axis=-1) < 8
    problem = Problem(
        observed=0.0 * at,
        confidence=np.ones(at.shape),
        stiffness=np.ones(labels.shape),
        sliding=SlidingParts(labels.astype(int)),
    )
    parts, _ = unfolded(problem, NeoHookeanPrior())
    return SmoothFields(parts.coupling, parts.stiffness, np.array([1.0, 0.6]))


def around(fields, seed=0):
    """Return points up to 1.5 px on both sides of the edge of the disc, and their parts."""
    random = np.random.default_rng(seed)
    angle, radius = random.uniform(0, 2 * np.pi, 300), random.uniform(6.5, 9.5, 300)
    at = 15 + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return at * [1.0, 0.6], random.integers(0, 2, 300)


def test_an_affine_motion_of_a_part_continues_beyond_its_edge(fields):
    gradient, shift = np.array([[0.2, -0.1], [0.3, 0.05]]), np.array([1.0, -2.0])
    nodes = fields.nodes @ (fields.positions @ gradient.T + shift)
    at, part = around(fields)
    assert fields.knows(at, part).all()
    spline = fields.splines(at, part)
    found = np.einsum("nc,nca->na", spline.shares, nodes[spline.nodes])
    assert np.abs(found - at @ gradient.T - shift).max() <= 1e-8
    slopes = np.einsum("ncb,nca->nab", spline.slopes, nodes[spline.nodes])
    assert np.abs(slopes - gradient).max() <= 1e-8


def test_only_sites_near_a_point_beyond_the_edge_determine_its_motion(fields):
    at, part = around(fields)
    spline = fields.splines(at, part)
    shares = fields.nodes[spline.nodes.ravel()].tocoo()
    owner = shares.coords[0] // spline.nodes.shape[1]
    far = np.linalg.norm(fields.positions[shares.coords[1]] - at[owner], axis=1)
    assert far.max() <= 7
    assert (fields.part[shares.coords[1]] == part[owner]).all()


def test_slopes_and_curvatures_of_a_field_are_its_derivatives(fields):
    nodes = fields.nodes @ np.random.default_rng(1).normal(size=fields.positions.shape)
    at, part = around(fields)
    spline = fields.splines(at, part)
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-6
        ends = [fields.splines(at + sign * step, part) for sign in (1, -1)]
        same = (ends[0].nodes == ends[1].nodes).all(axis=1)
        values, slopes = (
            [np.einsum(how, getattr(end, what), nodes[end.nodes]) for end in ends]
            for how, what in (("nc,nca->na", "shares"), ("ncb,nca->nab", "slopes"))
        )
        found = np.einsum("nc,nca->na", spline.slopes[..., axis], nodes[spline.nodes])
        assert np.abs((values[0] - values[1]) / 2e-6 - found)[same].max() <= 1e-7
        bends = np.einsum("ncb,nca->nab", spline.curvatures[..., axis], nodes[spline.nodes])
        assert np.abs((slopes[0] - slopes[1]) / 2e-6 - bends)[same].max() <= 1e-7


def test_only_points_among_the_own_sites_of_a_part_are_inside_it(fields):
    at, part = around(fields)
    is_inside = fields.splines(at, part).inner
    radius = np.linalg.norm(at / [1.0, 0.6] - 15, axis=1)
    depth = np.where(part == 1, 8 - radius, radius - 8)
    assert not is_inside[depth < -0.5].any()
    deep = fields.splines(np.array([[15.0, 15 * 0.6 + 3.0 * 0.6]]), np.array([1]))
    assert deep.inner.all()
