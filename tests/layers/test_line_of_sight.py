"""Tests of lines of sight in the 3-D view, in voxels of a volume."""

from types import SimpleNamespace

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.layers.line_of_sight import DepthDrag, LineOfSight, cut_of
from napari_hmrf.layers.slice_view import View, frame_of

SHAPE = (10, 12, 14)


def shown(**place):
    """Return a volume in a 3-D view, with its frame and the view."""
    viewer = ViewerModel()
    layer = viewer.add_image(np.zeros(SHAPE, np.uint8), **place)
    viewer.dims.ndisplay = 3
    view = View.of(viewer.dims, volume=True)
    return viewer, layer, frame_of(layer, view), view


def line(start, ahead, spacing=(1.0, 1.0, 1.0)):
    return LineOfSight(np.array(start), np.array(ahead, float), np.array(spacing))


@pytest.mark.parametrize(
    "place",
    [
        {"scale": (2, 1, 0.5)},
        {"scale": (2, 1, 1), "translate": (5, -3, 8)},
        {"scale": (2, 1, 1), "rotate": (40, 20, -70)},
    ],
)
@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")
def test_a_line_passes_the_voxels_under_the_mouse(place):
    _, layer, frame, view = shown(**place)
    near, far = np.array([1.0, 2.0, 3.0]), np.array([8.0, 9.0, 4.0])
    begin, end = (np.array(layer.data_to_world(each)) for each in (near, far))
    direction = (end - begin) / np.linalg.norm(end - begin)
    event = SimpleNamespace(position=begin - 3 * direction, view_direction=direction)
    sight = LineOfSight.of(event, layer, frame, view)
    ends = [(tuple(near), 1e-6), (tuple(far), 1e-6)]
    assert all(sight.nearest([point], reach) == point for point, reach in ends)
    assert (far - near) @ sight.ahead > 0


def test_points_of_a_line_are_inside_the_volume_from_the_camera_onwards():
    sight = line((-50.0, 6.0, 7.0), (1, 0, 0))
    points = sight.points_in(SHAPE)
    assert points[0] == pytest.approx((-0.5, 6, 7))
    assert points[-1] == pytest.approx((9.5, 6, 7))
    assert np.diff(points[:, 0]).min() > 0
    assert np.diff(points[:, 0]).max() <= 0.5
    assert not len(line((-50.0, 20.0, 7.0), (1, 0, 0)).points_in(SHAPE))


def test_a_drag_stays_on_a_plane_parallel_to_the_screen_and_moves_in_depth():
    ahead = np.array([1, 1, 0]) / np.sqrt(2)
    drag = DepthDrag((4.0, 5.0, 6.0), line((0.0, 1.0, 6.0), ahead))
    assert drag.point == pytest.approx(drag.begin)
    drag.line = line((1.0, 0.0, 9.0), ahead)
    away = np.array(drag.point) - drag.begin
    assert away @ ahead == pytest.approx(0)
    assert away == pytest.approx((1, -1, 3))
    drag.push(2)
    assert (np.array(drag.point) - drag.begin) @ ahead == pytest.approx(2)


def test_the_nearest_end_of_a_mark_is_found_within_reach():
    sight = line((0.0, 5.0, 5.0), (1, 0, 0), spacing=(2.0, 1.0, 1.0))
    ends = [(3.0, 7.0, 5.0), (8.0, 5.5, 5.0)]
    assert sight.nearest(ends, 1.0) == ends[1]
    assert sight.nearest(ends, 0.4) is None


def test_the_cut_of_a_layer_has_the_order_of_its_axes():
    viewer, layer, frame, _ = shown()
    assert cut_of(layer, frame, View.of(viewer.dims)) is None
    viewer.dims.order = (2, 0, 1)
    layer.depiction, layer.plane.position, layer.plane.normal = "plane", (1, 2, 3), (1, 0, 0)
    cut = cut_of(layer, frame, View.of(viewer.dims))
    assert cut.position == (2, 3, 1)
    assert cut.normal == (0, 0, 1)
    viewer.dims.ndisplay = 2
    assert cut_of(layer, frame, View.of(viewer.dims)) is None
