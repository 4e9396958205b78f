"""Tests of the rendering of volumes in the 3-D view."""

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.layers.volume_look import VolumeLook


def ball():
    at = np.indices((20, 20, 20)) - 9.5
    return np.where((at**2).sum(axis=0) < 64, 100.0, 10.0)


@pytest.mark.parametrize("ndisplay", [2, 3])
def test_a_3d_view_shows_the_surface_of_tissue_in_air_until_the_link_ends(ndisplay):
    viewer = ViewerModel(ndisplay=ndisplay)
    layers = viewer.add_image(ball()), viewer.add_image(ball())
    look = VolumeLook(viewer)
    look.link(*layers)
    viewer.dims.ndisplay = 3
    assert [each.rendering for each in layers] == ["iso", "iso"]
    assert all(10 <= each.iso_threshold < 100 for each in layers)
    look.release()
    assert [each.rendering for each in layers] == ["mip", "mip"]


def test_a_rendering_that_the_user_has_chosen_is_kept():
    viewer = ViewerModel(ndisplay=3)
    layers = viewer.add_image(ball()), viewer.add_image(ball())
    look = VolumeLook(viewer)
    look.link(*layers)
    layers[0].rendering = "mip"
    for _ in range(2):
        assert [each.rendering for each in layers] == ["mip", "mip"]
        look.release()
        look.link(*layers)


def test_a_volume_without_surroundings_has_no_surface():
    viewer = ViewerModel(ndisplay=3)
    inside = np.random.default_rng(0).normal(100, 10, (12, 12, 12))
    layers = viewer.add_image(inside), viewer.add_image(inside)
    VolumeLook(viewer).link(*layers)
    assert [each.rendering for each in layers] == ["mip", "mip"]
