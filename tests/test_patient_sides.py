"""Left and right of the patient stand at the edges of the canvas, where an image says so."""

import re
from itertools import product

import numpy as np
import pytest
from conftest import dock_in, quick
from napari.components import ViewerModel
from napari.layers import Image
from qtpy.QtWidgets import QLabel

from napari_hmrf import Arrow, Drawing
from napari_hmrf.contributions import open_scan
from napari_hmrf.io.fields import Place
from napari_hmrf.io.images import ImageFile, save_image
from napari_hmrf.layers.patient_axes import Sides, step_in_patient
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.ui.soft_tissue import SoftTissue

pytest.importorskip("SimpleITK")

#: How files store the same head: as it is, mirrored, turned on its side.
DIRECTIONS = {
    "LPS": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "turned": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}


def head(folder, direction=DIRECTIONS["LPS"]):
    """A head in a file with something bright far to the patient's left, front and top."""
    place = Place((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), direction)
    pixels = np.full((24, 24, 24), 60, np.int16)
    at = (direction.T @ [8, -8, 8] + 11.5).round().astype(int)  # x, y, z of the file
    pixels[tuple(at[::-1])] = 200
    centre = direction @ np.full(3, 11.5)
    place = place._replace(origin=tuple(-centre))
    return str(save_image(folder / "head.nii.gz", ImageFile(pixels, place)))


@pytest.fixture
def window(unstyled, make_napari_viewer, tmp_path, at_rest):
    """A window with the dock beside a head that is stored in some way."""

    def opened(direction=DIRECTIONS["LPS"]):
        viewer = make_napari_viewer(show=True)
        path = head(tmp_path, direction)
        ((data, attributes, _),) = open_scan(path)(path)
        image = viewer.add_image(data, **attributes)
        dock = quick(dock_in(viewer))
        at_rest(thread=False)
        return viewer, dock, image

    return opened


def edge_of_mark(viewer, image):
    """Which edges of the canvas the bright pixel lies nearest to: vertical, horizontal."""
    (pixel,) = np.argwhere(np.asarray(image.data) == 200)
    world = np.asarray(image.data_to_world(pixel))[list(viewer.dims.displayed)]
    down, right = viewer.scene.camera.orientation2d
    low = (world > 0) == (str(down) == "down")
    late = (world > 0) == (str(right) == "right")
    return ("bottom" if low[0] else "top"), ("right" if late[1] else "left")


@pytest.mark.parametrize("stored", DIRECTIONS)
def test_letters_stand_where_that_side_of_the_patient_is_seen(window, stored):
    viewer, dock, image = window(DIRECTIONS[stored])
    orders = ((0, 1, 2), (1, 0, 2), (2, 0, 1), (0, 2, 1))
    ways_round = (("down", "right"), ("up", "left"), ("up", "right"))
    for order, ways in product(orders, ways_round):
        viewer.dims.order = order
        viewer.scene.camera.orientation2d = ways
        found = dict(zip(Sides._fields, dock.sides, strict=True))
        # The mark lies to the left, to the front and to the top of the patient.
        marked = {found[edge] for edge in edge_of_mark(viewer, image)}
        assert marked == {"SAL"[axis] for axis in order[1:]}
        for one, other in (("top", "bottom"), ("left", "right")):
            assert {found[one], found[other]} in ({"S", "I"}, {"A", "P"}, {"L", "R"})


def test_an_axial_slice_is_seen_as_radiologists_see_it(window):
    _, dock, _ = window()
    assert dock.sides == Sides(top="A", bottom="P", left="R", right="L")
    letters = {
        each.text(): each.geometry().center()
        for each in dock.native.window().findChildren(QLabel)
        if each.isVisible() and each.text() in tuple("APRL")
    }
    assert letters["A"].y() < letters["R"].y() < letters["P"].y()
    assert letters["R"].x() < letters["A"].x() < letters["L"].x()


def test_in_3_d_and_where_nothing_is_known_there_are_none(window, at_rest):
    viewer, dock, image = window()
    viewer.dims.ndisplay = 3
    at_rest(thread=False)  # each change is drawn: vispy may draw what is gone else
    assert dock.sides == Sides()
    viewer.dims.ndisplay = 2
    at_rest(thread=False)
    assert dock.sides.right == "L"
    image.visible = False
    assert dock.sides == Sides()
    viewer.add_image(np.zeros((24, 24)), name="photo")
    assert dock.sides == Sides()
    image.visible = True
    at_rest(thread=False)
    viewer.layers.remove(image)
    assert dock.sides == Sides()
    at_rest(thread=False)


def test_they_go_with_the_dock(window):
    viewer, dock, _ = window()
    viewer.window.remove_dock_widget(dock.native)
    assert dock.sides == Sides()


@pytest.mark.parametrize("stored", ["LPS", "RAS"])
def test_a_step_is_said_by_the_sides_of_the_patient(tmp_path, stored):
    path = head(tmp_path, DIRECTIONS[stored])
    ((data, attributes, _),) = open_scan(path)(path)
    frame = frame_of(Image(data, **attributes))
    sign = 1 if stored == "LPS" else -1
    assert step_in_patient(frame, (sign * 1.25, sign * -0.5)) == "1.25 P, 0.5 R"
    assert step_in_patient(frame, (0.0, sign * 2.0)) == "2 L"
    assert step_in_patient(frame_of(Image(np.zeros((4, 4)))), (1.0, 1.0)) == ""


def test_the_status_bar_says_it_of_what_is_under_the_cursor(qtbot, wait_for, tmp_path):
    viewer, path = ViewerModel(), head(tmp_path)
    ((data, attributes, _),) = open_scan(path)(path)
    image = viewer.add_image(data, **attributes)
    viewer.dims.set_current_step(0, 12)
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    wait_for(lambda: not dock.busy)
    dock.drawing = Drawing((Arrow(at=(12, 12), by=(0.0, -3.0), radius=2.0),))
    wait_for(lambda: dock.solution is not None and not dock.busy)
    viewer.layers.selection.active = image
    viewer.mouse_over_canvas = True
    viewer.cursor.position = image.data_to_world((12, 12, 12))
    said = viewer.status["coordinates"]
    length = re.search(r"moves (\S+) mm", said)[1]
    assert f"moves {length} mm ({length} R)" in said, "and not that it moves to the left"
    assert dock.solution.frame["axis_labels"] == ("superior", "posterior", "left"), "kept in files"
