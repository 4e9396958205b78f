"""Tests of anatomical letters at the canvas edges and in texts."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image
from qtpy.QtWidgets import QFileDialog, QLabel

from napari_hmrf import Arrow, Drawing
from napari_hmrf.contributions import open_scan
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.frame import PATIENT_AXES
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.slice_view import Sides, View, directions_of, frame_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from tests.support.docks import dock_in, quick
from tests.support.screen import Screen
from tests.support.screen import head as table_head

pytest.importorskip("SimpleITK")

#: Directions in which files store the same head: unchanged, mirrored and with permuted axes.
DIRECTIONS = {
    "LPS": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "turned": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}


def head(folder, direction=DIRECTIONS["LPS"]):
    """Write a head with a bright mark at the patient's left, front and top; return the path."""
    pixels = np.full((24, 24, 24), 60, np.int16)
    at = (direction.T @ [8, -8, 8] + 11.5).round().astype(int)  # In the order x, y, z of the file.
    pixels[tuple(at[::-1])] = 200
    centre = direction @ np.full(3, 11.5)
    place = Geometry.of_itk(pixels.shape, (1.0, 1.0, 1.0), tuple(-centre), direction)
    return str(write_image(folder / "head.nii.gz", ImageFile(pixels, place)))


def add_head(viewer, folder, direction=DIRECTIONS["LPS"]):
    """Open a head with the given directions as an image layer."""
    path = head(folder, direction)
    ((data, attributes, _),) = open_scan(path)(path)
    return viewer.add_image(data, **attributes)


@pytest.fixture
def window(unstyled, without_controls, make_napari_viewer, tmp_path, at_rest):
    """Return a window, the dock and the image of a head."""
    viewer = make_napari_viewer(show=True)
    image = add_head(viewer, tmp_path)
    dock = quick(dock_in(viewer))
    at_rest(thread=False)
    return viewer, dock, image


def turned_views(viewer):
    """Yield the order of axes for many views of a viewer."""
    orders = ((0, 1, 2), (1, 0, 2), (2, 0, 1), (0, 2, 1))
    ways_round = (("down", "right"), ("up", "left"), ("up", "right"))
    for order, ways in product(orders, ways_round):
        viewer.dims.order = order
        camera_of(viewer).orientation2d = ways
        yield order


def edge_of_mark(viewer, image):
    """Return the vertical and the horizontal canvas edge nearest to the bright mark."""
    (pixel,) = np.argwhere(np.asarray(image.data) == 200)
    world = np.asarray(image.data_to_world(pixel))[list(viewer.dims.displayed)]
    down, right = camera_of(viewer).orientation2d
    low = (world > 0) == (str(down) == "down")
    late = (world > 0) == (str(right) == "right")
    return ("bottom" if low[0] else "top"), ("right" if late[1] else "left")


@pytest.mark.parametrize("stored", DIRECTIONS)
def test_a_letter_is_at_the_canvas_edge_of_its_side_of_the_patient(tmp_path, stored):
    viewer = ViewerModel()
    image = add_head(viewer, tmp_path, DIRECTIONS[stored])
    for order in turned_views(viewer):
        found = dict(zip(Sides._fields, Sides.of(image, viewer), strict=True))
        # The mark lies at the left, the front and the top of the patient.
        marked = {found[edge] for edge in edge_of_mark(viewer, image)}
        assert marked == {"SAL"[axis] for axis in order[1:]}
        for one, other in (("top", "bottom"), ("left", "right")):
            assert {found[one], found[other]} in ({"S", "I"}, {"A", "P"}, {"L", "R"})


def test_letters_at_the_canvas_edges_follow_the_view_the_image_and_the_dock(window, at_rest):
    viewer, dock, image = window
    assert dock.sides == Sides(top="A", bottom="P", left="R", right="L")
    letters = {
        each.text(): each.geometry().center()
        for each in dock.native.window().findChildren(QLabel)
        if each.isVisible() and each.text() in tuple("APRL")
    }
    assert letters["A"].y() < letters["R"].y() < letters["P"].y()
    assert letters["R"].x() < letters["A"].x() < letters["L"].x()
    seen = set()
    for _ in turned_views(viewer):
        assert dock.sides == Sides.of(image, viewer)
        seen.add(dock.sides)
    assert len(seen) > 8
    viewer.dims.ndisplay = 3
    at_rest(thread=False)  # Draw each change; otherwise vispy may draw removed objects.
    assert dock.sides == Sides()
    viewer.dims.ndisplay = 2
    at_rest(thread=False)
    assert dock.sides in seen
    viewer.dims.order = (0, 1, 2)
    camera_of(viewer).orientation2d = ("down", "right")
    at_rest.until(lambda: not dock.busy)  # Otherwise an image of the result may be added.
    dock.image = viewer.add_image(np.zeros((24, 24)), name="photo")
    assert dock.sides == Sides()
    dock.image = None
    assert dock.sides == Sides()
    dock.image = image
    at_rest(thread=False)
    assert dock.sides.right == "L"
    # Remove neither image: napari alone exits on Mesa's rasterizer if one of two images is removed.
    viewer.window.remove_dock_widget(dock.native)
    assert dock.sides == Sides()


def test_fields_and_tables_use_the_anatomical_letters_of_the_status_bar(frame, tmp_path, wait_for):
    viewer = frame.viewer
    image = add_head(viewer, tmp_path)
    dock = quick(frame.open())
    dock.tool = "move"
    dock.start()
    wait_for(lambda: not dock.busy)
    fields = dock.fields
    assert (fields.by_row.label, fields.by_col.label) == ("to P (mm)", "to L (mm)")
    assert "to L, the patient's left" in fields.by_col.tooltip
    assert "below 0: to R, the patient's right" in fields.by_col.tooltip
    fields.by_col.value = -5.0
    assert fields.words == "Push 5 R"
    fields.components.value = "col"
    assert fields.words == "Push 5 R, R-L only"
    box = fields.components.native
    words = [box.itemText(at) for at in range(box.count())]
    assert words[1:] == ["A-P only (rows)", "R-L only (columns)"]
    table = dock._form.motion.boundary.table
    place = frame_of(image).placement()
    dock.boundary = viewer.add_labels(np.zeros(image.data.shape, int), name="walls", **place)
    dock.rules = (BoundaryRule(1, "move"),)
    assert table_head(table, 3).startswith("to P")
    assert table_head(table, 4).startswith("to L")
    said = " ".join([fields.by_row.label, fields.by_col.label, *words, fields.words])
    assert not {"up", "down", "left", "right"} & set(re.findall(r"\w+", said))


def oblique(angle, mirrored):
    """Return an image of a head rotated in the scanner, optionally with mirrored columns."""
    turn, sign = np.eye(4), -1 if mirrored else 1
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn[1:3, 1:3] = [[cosine, -sine * sign], [sine, cosine * sign]]
    return Image(np.zeros((4, 20, 20)), affine=turn, axis_labels=tuple(PATIENT_AXES))


@pytest.mark.parametrize(
    ("angle", "mirrored"), [(0, True), (20, False), (70, True), (90, False), (-110, True)]
)
def test_letters_of_a_rotated_or_mirrored_scan_refer_to_the_patient(angle, mirrored):
    image = oblique(angle, mirrored)
    ways = Directions.of(frame_of(image))
    towards = {"P": (1, 0), "A": (-1, 0), "L": (0, 1), "R": (0, -1)}
    for axis, typed in enumerate(((3.0, 0.0), (0.0, 3.0))):
        goes = np.subtract(
            image.data_to_world((0, *ways.from_display(typed))), image.data_to_world((0, 0, 0))
        )
        letter = ways.label(axis).removeprefix("to ")
        np.testing.assert_allclose(goes[1:], np.multiply(3, towards[letter]), atol=1e-6)
        assert ways.step(typed) == f"3 {letter}"
        opposite = {"P": "A", "A": "P", "L": "R", "R": "L"}[letter]
        assert ways.step(tuple(np.negative(typed))) == f"3 {opposite}"


@pytest.mark.parametrize("stored", DIRECTIONS)
def test_letters_depend_neither_on_the_camera_nor_on_the_storage_order(tmp_path, stored):
    viewer, path = ViewerModel(), head(tmp_path, DIRECTIONS[stored])
    ((data, attributes, _),) = open_scan(path)(path)
    image = viewer.add_image(data, **attributes)
    frame = frame_of(image, View.of(viewer.dims))
    ways = directions_of(frame, viewer)
    camera = getattr(viewer, "scene", viewer).camera
    camera.orientation2d = ("up", "left")
    assert directions_of(frame, viewer) == ways
    (at,) = np.argwhere(np.asarray(data) == 200)  # At the left, the front and the top.
    centre = np.array(data.shape) // 2
    said = ways.step(ways.to_display(tuple(np.sign(at - centre)[list(frame.plane)].astype(float))))
    assert {part.split()[1] for part in said.split(", ")} == {"A", "L"}
    assert Directions.of(frame_of(Image(np.zeros((4, 4))))).step((1.0, 1.0)) == "1 down, 1 right"


def test_the_status_bar_describes_motion_by_anatomical_letters(frame, wait_for, tmp_path):
    viewer, dock, path = frame.viewer, frame.open(), head(tmp_path)
    ((data, attributes, _),) = open_scan(path)(path)
    image = viewer.add_image(data, **attributes)
    viewer.dims.set_current_step(0, 12)
    wait_for(lambda: not dock.busy)
    dock.drawing = Drawing((Arrow(at=(12, 12), by=(0.0, -3.0), radius=2.0),))
    wait_for(lambda: dock.solution is not None and not dock.busy)
    viewer.layers.selection.active = image
    viewer.mouse_over_canvas = True
    viewer.cursor.position = image.data_to_world((12, 12, 12))
    said = viewer.status["coordinates"]
    length = re.search(r"moves (\S+) mm", said)[1]
    assert f"moves {length} mm ({length} R)" in said, "the status bar uses directions of the canvas"
    assert dock.solution.frame["axis_labels"] == ("superior", "posterior", "left"), (
        "axis labels are missing in the stored frame"
    )


def test_a_slice_is_named_by_its_position_before_and_after_saving(
    frame, wait_for, tmp_path, monkeypatch
):
    proposed = []

    def choose(*given):
        proposed.append(given[2])
        return str(tmp_path / given[2]), ""

    monkeypatch.setattr(QFileDialog, "getSaveFileName", choose)
    viewer, first, path = frame.viewer, frame.open(), head(tmp_path)
    ((data, attributes, _),) = open_scan(path)(path)
    viewer.add_image(data, **{**attributes, "name": "a/b: head"})
    viewer.dims.set_current_step(0, 17)
    wait_for(lambda: not first.busy)
    first.stop()  # otherwise the status is a hint about the tool
    first.drawing = Drawing((Arrow(at=(12, 12), by=(0.0, -3.0), radius=2.0),))
    wait_for(lambda: first.solution is not None and not first.busy)
    made = "a/b: head deformed, elastic (S 5.5 mm)"
    assert made in viewer.layers, "the name is not that of the 18th of 24 slices, 1 mm apart"
    assert first.status.startswith("S 5.5 mm: tissue moved")
    Screen(first).press("Save study ...")
    assert proposed == ["a-b- head S 5.5 mm.study"]
    viewer.dims.set_current_step(0, 0)
    assert "mm in S 5.5 mm" in first._form.result.how_far.value
    viewer.layers.clear()
    first.open_study(tmp_path / proposed[0])
    wait_for(lambda: first.solution is not None and not first.busy)
    first.deform()
    wait_for(lambda: not first.busy)
    assert made in viewer.layers


@pytest.mark.parametrize(
    ("step", "number", "name", "angle"),
    [
        (1.2, 5, "I 14.14 mm", 15),
        (-1.2, 5, "I 26.14 mm", 0),
        (1.2, 30, "S 15.86 mm", 0),
        (0.0004, 1, "I 20.1352 mm", 15),
        (40.0, 7, "S 259.9 mm", 0),
    ],
)
@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")
def test_oblique_slices_are_named_by_their_position_along_the_normal(step, number, name, angle):
    matrix = np.eye(4)
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    matrix[:2, :2] = [[cosine * step, -sine], [sine * step, cosine]]
    matrix[:2, 3] = np.array([[cosine, -sine], [sine, cosine]]) @ [-20.1356, 3.0]
    known = {"units": ("mm",) * 3, "axis_labels": tuple(PATIENT_AXES)}
    image = Image(np.zeros((40, 4, 4)), affine=matrix, **known)
    frame = replace(frame_of(image), index=(number, 0, 0))
    assert frame.slice_seen == name
    assert frame.slice_name == f"superior = {number}", (
        "files would not distinguish results of different slices"
    )
    unknown = replace(frame, units=("pixel",) * 3)
    assert unknown.slice_seen == f"superior = {number}"
