"""Normals of the staircase between two labels."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf.field.neighbours import around_sites, of_corners
from napari_hmrf.solver.interface_normals import interface_surface


def ball(axes):
    away = np.moveaxis(np.indices((9, 10, 11)[:axes]), 0, -1) - (4.2, 4.9, 5.1)[:axes]
    return np.linalg.norm(away, axis=-1) <= 3.3


def layer(axes):
    return np.indices((9, 10, 11)[:axes]).sum(axis=0) // 2 == 6


@pytest.mark.parametrize("shape", [ball, layer])
@pytest.mark.parametrize("axes", [2, 3])
def test_normals_depend_neither_on_the_order_of_labels_nor_on_that_of_axes(shape, axes):
    one, spacing = shape(axes), (1.0, 0.5, 2.0)[:axes]
    both = of_corners(one, np.logical_or) & of_corners(~one, np.logical_or)
    sites = np.argwhere(around_sites(both, np.logical_or))
    normals, _ = interface_surface(one, ~one, sites, spacing)
    swapped, _ = interface_surface(~one, one, sites, spacing)
    turned = interface_surface(one.T, ~one.T, sites[:, ::-1], spacing[::-1])[0][:, ::-1]
    for other in swapped, turned:
        assert np.abs((normals * other).sum(axis=1)) == pytest.approx(1, abs=1e-12)
