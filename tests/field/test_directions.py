"""Names of directions and slices as displayed, for any orientation of the pixels."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.metadata import BOUNDARY, layer_metadata
from napari_hmrf.layers.slice_view import View, directions_of, frame_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from tests.support.screen import head

TURNED = {"affine": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}  # rows to the left, columns down


@pytest.mark.parametrize(
    ("place", "seen"),
    [
        ({}, ("down", "right")),
        ({"scale": (0.5, 2.0)}, ("down", "right")),
        ({"scale": (-1, -1)}, ("up", "left")),
        ({"affine": [[1, 0, 5], [0, -1, 0], [0, 0, 1]]}, ("down", "left")),
        (TURNED, ("left", "down")),
        ({"rotate": 10}, ("down", "right")),
        ({"rotate": 30}, ("down", "right")),
        ({"rotate": -30}, ("down", "right")),
        ({"rotate": 60}, ("right", "up")),
        ({"rotate": 30, "scale": (-1, 1)}, ("up", "right")),
        ({"rotate": 30, "scale": (1, -1)}, ("down", "left")),
        ({"rotate": 44.9}, ("down", "right")),
        ({"affine": [[1, 1, 0], [0, 0.4, 0], [0, 0, 1]]}, ("", "")),
    ],
)
def test_directions_of_rows_and_columns_match_the_screen(place, seen):
    image = Image(np.zeros((20, 30)), **place)
    ways = Directions.of(frame_of(image))
    assert ways[:2] == seen
    # At any angle, a step along a named direction goes exactly there on the screen.
    pixels = np.divide(ways.from_display((3.0, 0.0)), frame_of(image).spacing)
    goes = np.subtract(image.data_to_world(pixels), image.data_to_world((0, 0)))
    if all(seen):
        towards = {"down": (3, 0), "up": (-3, 0), "right": (0, 3), "left": (0, -3)}[seen[0]]
        np.testing.assert_allclose(goes, towards, atol=1e-6)
        np.testing.assert_allclose(ways.to_display(ways.from_display((3.0, -2.0))), (3, -2))


def test_directions_follow_a_transposed_or_flipped_view():
    viewer = ViewerModel()
    image = viewer.add_image(np.zeros((20, 30)), scale=(1, -1))
    viewer.dims.order = (1, 0)
    frame = frame_of(image, View.of(viewer.dims))
    assert directions_of(frame, viewer)[:2] == ("up", "right"), (
        "the columns of the image should be displayed as rows"
    )
    camera = getattr(viewer, "scene", viewer).camera
    camera.orientation2d = ("up", "right")
    assert directions_of(frame, viewer) == Directions("down", "right"), (
        "the flipped camera should cancel the flipped columns"
    )


def test_labels_name_the_opposite_direction_and_no_direction_at_an_angle():
    flipped = Directions("up", "left")
    assert (flipped.label(0), flipped.label(1)) == ("up", "left")
    assert flipped.about(1).endswith("below 0: to the right")
    assert flipped.step((5, -10)) == "5 up, 10 right"
    assert (flipped.both(0), flipped.both(1)) == ("up and down", "left and right")
    aslant = Directions("", "")
    assert aslant.label(1) == "along columns"
    words = " ".join([aslant.label(1), aslant.about(1)])
    words += aslant.only(1) + aslant.both(1)
    assert not {"up", "down", "left", "right"} & set(words.split())


def test_the_table_header_names_the_direction_of_its_arrows(widget, run):
    viewer = widget._viewer
    place = {"scale": (-1, -1)}
    viewer.add_image(np.zeros((20, 30)), name="t1", **place)
    table = widget._form.motion.boundary.table
    boundary = np.zeros((20, 30), np.uint8)
    boundary[10, 10] = 1
    rule = BoundaryRule(1, "move", vector=(0.0, 10.0))
    layer = viewer.add_labels(
        boundary, name="Boundary", metadata=layer_metadata(BOUNDARY, (rule,)), **place
    )
    widget.boundary = layer
    run(widget)
    assert head(table, 4).startswith("left\n")
    arrows = viewer.layers["t1 arrows, paper"]
    start, step = arrows.data[np.abs(arrows.data[:, 1]).max(axis=1).argmax()]
    seen = np.subtract(arrows.data_to_world(start + step), arrows.data_to_world(start))
    assert seen[1] < -0.5, "the arrow should point to the left on the screen"
    assert layer.metadata == {**layer.metadata, **layer_metadata(BOUNDARY, (rule,))}, (
        "the stored rule should not change"
    )


def test_the_fields_of_the_move_brush_name_the_direction_on_the_screen(open_beside, settle):
    _, widget = open_beside(scale=(-1, -1))
    widget.tool = "move"
    widget.start()
    assert widget.fields.by_col.label.startswith("left")
    assert widget.fields.by_row.label.startswith("up")
    box = widget.fields.components.native
    words = [box.itemText(at) for at in range(box.count())]
    assert words[1:] == ["up and down only (rows)", "left and right only (columns)"]


@pytest.mark.parametrize("place", [{"rotate": 30}, {"rotate": 30, "scale": (-1, -1)}])
def test_tissue_of_a_rotated_layer_moves_in_the_direction_of_the_labels(open_beside, settle, place):
    _, widget = open_beside(**place)
    widget.tool = "move"
    widget.start()
    settle(widget)
    fields, layer = widget.fields, widget.image
    down = fields.by_row.label.split(" ")[0]
    fields.by_row.value = 5.0 if down == "up" else -5.0
    assert "as displayed" in fields.by_row.tooltip
    assert fields.words == "Push 5 up"

    def goes(by):
        return np.subtract(layer.data_to_world(by), layer.data_to_world((0, 0)))

    np.testing.assert_allclose(goes(fields.settings["by"]), (-5, 0), atol=1e-6)
    fields.show_settings(fields.settings)
    assert abs(fields.by_row.value) == 5
    assert fields.by_col.value == 0
    table = widget._form.motion.boundary.table
    table.layer = widget._viewer.add_labels(np.zeros(layer.data.shape, int), name="walls", **place)
    table.rows = (BoundaryRule(1, "move"),)
    for column, text in ((3, "7"), (4, "-2")):
        assert head(widget._form.motion.boundary.table, column)
        assert table.model().setData(table.model().index(0, column), text)
    shown = [table.item(0, column).text() for column in (3, 4)]
    assert shown == ["7", "-2"], "the table should show the values as typed"
    to = {"down": (7, -2), "up": (-7, 2)}[down]
    np.testing.assert_allclose(goes(table.rows[0].vector), to, atol=1e-6)


def test_a_single_direction_of_a_rotated_layer_refers_to_the_image_rows(open_beside, settle):
    _, widget = open_beside(rotate=30)
    widget.tool = "move"
    widget.start()
    settle(widget)
    fields = widget.fields
    fields.components.value = "row"
    fields.by_row.value = 4.0
    assert fields.words == "Push 3 down, 1.73 right, across the image's rows only"
    widget.image.rotate = 0
    settle(widget)
    assert fields.words.endswith("up and down only")
    assert fields.by_row.value == pytest.approx(4 * np.cos(np.pi / 6), abs=0.01), (
        "the motion should not change"
    )


def test_slice_numbers_match_the_slider():
    viewer = ViewerModel()
    image = viewer.add_image(np.zeros((9, 20, 30)), scale=(-1, -1, -1))
    viewer.dims.set_current_step(0, 2)
    frame = frame_of(image, View.of(viewer.dims))
    assert frame.index[0] == 6
    assert frame.slice_seen == "slice 2"
    assert frame.slice_name == "slice 6", "the stored name should use the data index"
    assert Frame.from_dict(frame.as_dict()) == frame
    spaced = viewer.add_image(np.zeros((9, 20, 30)), scale=(2, 1, 1))
    viewer.layers.remove(image)
    viewer.dims.set_current_step(0, 3)
    assert frame_of(spaced, View.of(viewer.dims)).slice_seen == "slice 3"


def test_the_message_about_a_slice_without_paint_uses_the_slider_number(widget):
    viewer = widget._viewer
    place = {"scale": (-1, -1, -1)}
    viewer.add_image(np.random.default_rng(0).random((9, 20, 30)), name="t1", **place)
    widget.make_layers()
    viewer.dims.set_current_step(0, 4)
    widget.deform()
    assert "no paint in slice 4" in widget.status


def test_the_status_without_an_image_does_not_mention_a_disabled_button(widget):
    widget._viewer.add_vectors(np.ones((3, 2, 2)))
    assert not widget._form.make.enabled
    assert "Make layers" not in widget.status
    assert widget.status.startswith("Choose an image above, or open one")
