"""A volume that is tilted out of its slices is worked on where napari draws it."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image

from napari_hmrf.field.frame import PATIENT_AXES
from napari_hmrf.layers.screen_directions import directions_of
from napari_hmrf.layers.slice_view import View, frame_of, plane_shown
from tests.support.person import only
from tests.support.screen import Screen

SHAPE, SIZE = (8, 24, 24), (2.0, 0.8, 0.8)
#: Pixels to the world: turned within the slices, and then out of them about the patient's left.
_IN, _OUT = np.radians(10), np.radians(20)
WITHIN = [[1, 0, 0], [0, np.cos(_IN), -np.sin(_IN)], [0, np.sin(_IN), np.cos(_IN)]]
ASIDE = [[np.cos(_OUT), -np.sin(_OUT), 0], [np.sin(_OUT), np.cos(_OUT), 0], [0, 0, 1]]
TILTED = np.eye(4)
TILTED[:3, :3] = np.array(ASIDE) @ WITHIN @ np.diag(SIZE)
TILTED[:3, 3] = -TILTED[:3, :3] @ [3.5, 11.5, 11.5] + [4, -7, 3]
PLACE = {"affine": TILTED, "axis_labels": tuple(PATIENT_AXES), "units": ("mm",) * 3}
#: The ways of its axes, and how far they are seen to go: within the slices alone.
TURNED = TILTED[:3, :3] / SIZE

pytestmark = pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")


def numbered():
    """A volume whose slices are as bright as their numbers across the first axis."""
    return np.broadcast_to(np.arange(SHAPE[0], dtype=np.uint8)[:, None, None], SHAPE).copy()


def drawn_at(pixel):
    """Where napari draws a pixel of a slice across the first axis: without the tilt."""
    return TILTED[1:3, 1:3] @ pixel + TILTED[1:3, 3]


@pytest.fixture
def tilted(open_beside, settle):
    """Somebody with *Pull* in the hand before a slice of a tilted volume."""
    person, widget = open_beside(numbered(), contrast_limits=(0, 8), **PLACE)
    Screen(widget).choose("the whole volume")
    person.viewer.dims.set_point(0, 4)
    settle(widget)
    Screen(widget).press("Pull")
    settle(widget)
    return person, widget


def number_seen(viewer):
    """Which slice is drawn, by how bright its picture is."""
    (picture,) = (layer for layer in viewer.layers if layer.name == "MR")
    return round(float(picture.thumbnail[..., 0].max()) / 255 * 8)


def test_the_slice_that_is_said_to_be_seen_is_the_one_that_is_drawn():
    viewer = ViewerModel()
    image = viewer.add_image(numbered(), name="MR", contrast_limits=(0, 8), **PLACE)
    frame, seen = frame_of(image, View.of(viewer.dims, volume=True)), set()
    for depth in (-1, 1.5, 4, 6, 9):
        viewer.dims.set_point(0, depth)
        view = View.of(viewer.dims)
        assert plane_shown(frame, view) == (0, number_seen(viewer))
        seen.add(number_seen(viewer))
        # And back: the slider that shows this slice.
        viewer.dims.set_point(0, view.point_at(frame, (number_seen(viewer), 0, 0))[0])
        assert plane_shown(frame, View.of(viewer.dims)) == (0, number_seen(viewer))
    assert len(seen) > 3


def test_the_tissue_under_the_pointer_is_what_moves(tilted, settle):
    person, widget = tilted
    here, there = np.array((9.0, 14.0)), np.array((12.0, 14.0))
    person.drag(drawn_at(here), drawn_at(there))
    settle(widget)
    mark, number = only(widget), number_seen(person.viewer)
    np.testing.assert_allclose(mark.at, (number, *here), atol=0.01)
    np.testing.assert_allclose(mark.by, (0, *np.subtract(there, here) * SIZE[1]), atol=0.01)
    moved = widget.solution.displacement[number, 9, 14]
    np.testing.assert_allclose(moved, (0, 3 * SIZE[1], 0), atol=0.3)
    probe = widget.at((person.viewer.dims.point[0], *drawn_at(there)))
    np.testing.assert_allclose(probe.site, (number, *here), atol=1)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 0, 1)])
def test_components_are_along_the_patient_s_own_ways(order):
    viewer = ViewerModel()
    image = viewer.add_image(numbered(), **PLACE)
    viewer.dims.order = order
    ways = directions_of(frame_of(image, View.of(viewer.dims, volume=True)), viewer)
    by = TURNED.T @ (0, -3.1, 6.35)  # along the axes of the image
    said = ways.step(tuple(round(part, 2) + 0.0 for part in ways.to_display(tuple(by))))
    assert set(said.split(", ")) == {"3.1 A", "6.35 L"}
    goes = TURNED @ ways.from_display((0.0, 2.0, -1.0))
    np.testing.assert_allclose(goes[list(order)], (0, 2, -1), atol=1e-6)
    np.testing.assert_allclose(goes, TURNED @ ways.from_display((2.0, -1.0)), atol=1e-6)


def test_that_its_places_are_said_as_if_it_were_not_is_said(tilted, settle):
    person, widget = tilted
    person.drag(drawn_at((9.0, 14.0)), drawn_at((11.0, 14.0)))
    settle(widget)
    assert "does not display the tilt of" in widget.warning
    level = Image(numbered())
    assert not View.of(person.viewer.dims).tilts(level)


def test_a_slice_of_it_is_refused_and_the_whole_volume_is_offered(tilted, settle):
    _, widget = tilted
    Screen(widget).choose("this slice")
    settle(widget)
    assert "at an oblique angle" in widget.status
    assert "choose 'the whole volume'" in widget.status
