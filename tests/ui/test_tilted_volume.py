"""Tests of a volume that is rotated out of its slices; napari draws slices without the tilt."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image

from napari_hmrf.field.frame import PATIENT_AXES
from napari_hmrf.layers.slice_view import View, directions_of, frame_of, plane_shown
from tests.support.person import only
from tests.support.pulling import pull_volume
from tests.support.screen import Screen

SHAPE, SIZE = (8, 24, 24), (2.0, 0.8, 0.8)
#: Pixels to world: rotated within the slices, then out of the slices about the left axis.
_IN, _OUT = np.radians(10), np.radians(20)
WITHIN = [[1, 0, 0], [0, np.cos(_IN), -np.sin(_IN)], [0, np.sin(_IN), np.cos(_IN)]]
ASIDE = [[np.cos(_OUT), -np.sin(_OUT), 0], [np.sin(_OUT), np.cos(_OUT), 0], [0, 0, 1]]
TILTED = np.eye(4)
TILTED[:3, :3] = np.array(ASIDE) @ WITHIN @ np.diag(SIZE)
TILTED[:3, 3] = -TILTED[:3, :3] @ [3.5, 11.5, 11.5] + [4, -7, 3]
PLACE = {"affine": TILTED, "axis_labels": tuple(PATIENT_AXES), "units": ("mm",) * 3}
#: Directions of the axes, without the voxel size.
TURNED = TILTED[:3, :3] / SIZE

pytestmark = pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")


def numbered_slices():
    """Return a volume in which the intensity of each slice is its number along the first axis."""
    return np.broadcast_to(np.arange(SHAPE[0], dtype=np.uint8)[:, None, None], SHAPE).copy()


def drawn_at(pixel):
    """Return the position at which napari draws a pixel of a slice: without the tilt."""
    return TILTED[1:3, 1:3] @ pixel + TILTED[1:3, 3]


@pytest.fixture
def tilted(open_beside, settle):
    """Return a simulated user with *Pull* at a slice of a tilted volume, and the dock."""
    opened = open_beside(numbered_slices(), contrast_limits=(0, 8), **PLACE)
    return pull_volume(*opened, settle, depth=4)


def displayed_number(viewer):
    """Return the number of the drawn slice, read from the intensity of its thumbnail."""
    (picture,) = (layer for layer in viewer.layers if layer.name == "MR")
    return round(float(picture.thumbnail[..., 0].max()) / 255 * 8)


@pytest.mark.usefixtures("thumbnails")
def test_the_slice_reported_as_displayed_is_the_drawn_slice():
    viewer = ViewerModel()
    image = viewer.add_image(numbered_slices(), name="MR", contrast_limits=(0, 8), **PLACE)
    frame, seen = frame_of(image, View.of(viewer.dims, volume=True)), set()
    for depth in (-1, 1.5, 4, 6, 9):
        viewer.dims.set_point(0, depth)
        view = View.of(viewer.dims)
        assert plane_shown(frame, view) == (0, displayed_number(viewer))
        seen.add(displayed_number(viewer))
        # The inverse: the position of the slider that shows this slice.
        viewer.dims.set_point(0, view.point_at(frame, (displayed_number(viewer), 0, 0))[0])
        assert plane_shown(frame, View.of(viewer.dims)) == (0, displayed_number(viewer))
    assert len(seen) > 3


@pytest.mark.usefixtures("thumbnails")
def test_the_tissue_under_the_pointer_is_pulled(tilted, settle):
    person, widget = tilted
    here, there = np.array((9.0, 14.0)), np.array((12.0, 14.0))
    person.drag(drawn_at(here), drawn_at(there))
    settle(widget)
    mark, number = only(widget), displayed_number(person.viewer)
    np.testing.assert_allclose(mark.at, (number, *here), atol=0.01)
    np.testing.assert_allclose(mark.by, (0, *np.subtract(there, here) * SIZE[1]), atol=0.01)
    moved = widget.solution.displacement[number, 9, 14]
    np.testing.assert_allclose(moved, (0, 3 * SIZE[1], 0), atol=0.3)
    probe = widget.at((person.viewer.dims.point[0], *drawn_at(there)))
    np.testing.assert_allclose(probe.site, (number, *here), atol=1)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 0, 1)])
def test_components_are_parallel_to_the_axes_of_the_patient(order):
    viewer = ViewerModel()
    image = viewer.add_image(numbered_slices(), **PLACE)
    viewer.dims.order = order
    ways = directions_of(frame_of(image, View.of(viewer.dims, volume=True)), viewer)
    by = TURNED.T @ (0, -3.1, 6.35)  # Along the axes of the image.
    said = ways.step(tuple(round(part, 2) + 0.0 for part in ways.to_display(tuple(by))))
    assert set(said.split(", ")) == {"3.1 A", "6.35 L"}
    goes = TURNED @ ways.from_display((0.0, 2.0, -1.0))
    np.testing.assert_allclose(goes[list(order)], (0, 2, -1), atol=1e-6)
    np.testing.assert_allclose(goes, TURNED @ ways.from_display((2.0, -1.0)), atol=1e-6)


def test_a_warning_reports_that_the_tilt_is_ignored(tilted, settle):
    person, widget = tilted
    person.drag(drawn_at((9.0, 14.0)), drawn_at((11.0, 14.0)))
    settle(widget)
    assert "tilted relative to the slice plane" in widget.warning
    level = Image(numbered_slices())
    assert not View.of(person.viewer.dims).tilts(level)


def test_a_slice_of_a_tilted_volume_is_refused_with_a_hint_to_use_the_volume(tilted, settle):
    _, widget = tilted
    Screen(widget).choose("this slice")
    settle(widget)
    assert "at an oblique angle" in widget.status
    assert "choose 'the whole volume'" in widget.status
