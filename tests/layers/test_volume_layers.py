"""Tests of layers of a volume and of the layers of its result."""

from functools import partial

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Labels, Points

from napari_hmrf import Arrow, BoundaryRule, Drawing, Grid, Motion, ProblemError, Study, Tissue
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.deformation import arrows_in_slices
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.read import Request, study_from_layers, study_layers
from napari_hmrf.layers.result_layers import layer_on, overlay_of, result_layers
from napari_hmrf.layers.slice_view import View, directions_of, frame_of, plane_shown
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Pictures
from napari_hmrf.tissue.boundary_rules import Material

SHAPE, SCALE = (8, 12, 10), (2.0, 1.0, 1.5)
UNITS = ("mm",) * 3


@pytest.fixture
def viewer():
    viewer = ViewerModel()
    image = np.arange(np.prod(SHAPE)).reshape(SHAPE).astype(np.float32)
    viewer.add_image(image, scale=SCALE, units=UNITS, translate=(5, 6, 7))
    return viewer


def volume_view(viewer):
    return View.of(viewer.dims, volume=True)


def test_a_whole_volume_is_read_at_any_displayed_slice(viewer):
    image = viewer.layers[0]
    labels = Labels(np.ones(SHAPE, int), scale=SCALE, units=UNITS, translate=(5, 6, 7))
    rows = (Material(1, "tissue", 2.0),)
    for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0)):
        viewer.dims.order = order
        request = Request(
            tissue=labels, image=image, materials=rows, view=volume_view(viewer), drawing=Drawing()
        )
        study = study_from_layers(request)
        assert study.grid.shape == SHAPE
        assert study.grid.spacing == SCALE
        assert np.array_equal(study.pictures.image, image.data)
        assert np.array_equal(study.tissue.labels, labels.data)


def test_a_volume_in_time_is_read_at_the_displayed_time():
    viewer = ViewerModel()
    data = np.arange(3 * np.prod(SHAPE)).reshape(3, *SHAPE).astype(np.float32)
    image = viewer.add_image(data)
    viewer.dims.set_point(0, 2)
    study = study_from_layers(Request(image=image, view=volume_view(viewer), drawing=Drawing()))
    assert np.array_equal(study.pictures.image, data[2])
    assert study.grid.place.slice_name == "volume 2"


def test_a_two_dimensional_image_is_refused_as_a_volume(viewer):
    flat = Image(np.zeros(SHAPE[1:]))
    with pytest.raises(ProblemError, match="not a volume"):
        frame_of(flat, volume_view(viewer))


def test_layers_of_another_depth_are_refused(viewer):
    labels = Labels(np.ones((7, *SHAPE[1:]), int), scale=SCALE, units=UNITS, translate=(5, 6, 7))
    request = Request(
        tissue=labels, image=viewer.layers[0], view=volume_view(viewer), drawing=Drawing()
    )
    with pytest.raises(ProblemError, match=r"does not overlap|8 x 12 x 10"):
        study_from_layers(request)


@pytest.mark.parametrize(
    ("order", "point", "expected"),
    [
        ((0, 1, 2), (9, 0, 0), (0, 2)),
        ((1, 0, 2), (0, 10, 0), (1, 4)),
        ((2, 0, 1), (0, 0, 13), (2, 4)),
    ],
)
def test_the_displayed_slice_is_identified(viewer, order, point, expected):
    viewer.dims.order = order
    viewer.dims.point = point
    frame = frame_of(viewer.layers[0], volume_view(viewer))
    assert plane_shown(frame, View.of(viewer.dims)) == expected


def test_steps_in_a_volume_are_described_as_displayed(viewer):
    frame = frame_of(viewer.layers[0], volume_view(viewer))
    ways = directions_of(frame, viewer)
    assert ways.step(ways.to_display((1.0, 2.0, -3.0))) == "1 deeper, 2 down, 3 left"
    viewer.dims.order = (1, 0, 2)
    ways = directions_of(frame, viewer)
    assert ways.step(ways.to_display((1.0, 2.0, -3.0))) == "2 deeper, 1 down, 3 left"
    assert ways.from_display((4.0, 5.0)) == (4.0, 0.0, 5.0)
    assert ways.from_display(ways.to_display((1.0, 2.0, -3.0))) == (1.0, 2.0, -3.0)
    assert ways.to_display((2.0, -3.0)) == (2.0, 0.0, -3.0)


def test_steps_in_a_patient_are_described_by_anatomical_letters():
    viewer = ViewerModel()
    labels = ("superior", "posterior", "left")
    image = viewer.add_image(np.zeros(SHAPE), axis_labels=labels, units=UNITS)
    frame = frame_of(image, volume_view(viewer))
    ways = directions_of(frame, viewer)
    assert ways.step(ways.to_display((1.0, -2.0, 3.0))) == "1 S, 2 A, 3 L"


def test_a_study_of_a_volume_is_converted_to_the_layers_it_was_read_from(viewer):
    image = viewer.layers[0]
    boundary = np.zeros(SHAPE, int)
    boundary[0], boundary[3:5, 4:7, 3:6] = 1, 2
    rules = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(1, 0, 0.5)))
    place = {"scale": SCALE, "units": UNITS, "translate": (5, 6, 7)}
    request = Request(
        tissue=Labels(np.ones(SHAPE, int), **place),
        image=image,
        boundary=Labels(boundary, **place),
        materials=(Material(1, "tissue", 2.0),),
        rules=rules,
        view=volume_view(viewer),
    )
    study = study_from_layers(request)
    made = study_layers(study)
    again = study_from_layers(
        Request(
            tissue=made["tissue"],
            image=made["image"],
            boundary=made["boundary"],
            view=volume_view(viewer),
        )
    )
    assert again.grid == study.grid
    fields = [solve_study(each).displacement for each in (study, again)]
    assert np.array_equal(*fields)
    assert fields[0][4, 5, 4] == pytest.approx((1, 0, 0.5), abs=1e-4)


def test_the_result_of_a_volume_lies_at_the_place_of_the_volume(viewer):
    image = viewer.layers[0]
    pull = Arrow((4, 6, 5), (0.0, 1.0, 1.0), 2.0)
    request = Request(
        image=image, view=volume_view(viewer), hold_edge=True, drawing=Drawing((pull,))
    )
    study = study_from_layers(request)
    solution = solve_study(study)
    outputs = result_layers(solution, study.grid.place, study.pictures)
    moved = outputs.layers["image"]
    assert moved.data.shape == SHAPE
    assert moved.attributes["translate"].tolist() == [5, 6, 7]
    assert not moved.attributes["rgb"]
    arrows = outputs.layers["arrows"].data
    assert arrows.shape[1:] == (2, 3)
    assert len({*arrows[:, 0, 0]}) > 2, "only one slice has arrows"
    answer = outputs.layers["arrows"].attributes["metadata"]["napari-hmrf"]["answer"]
    for name in ("magnitude", "jacobian", "equivalent", "stretch"):
        made = compute_thread.submit(partial(overlay_of, answer, name)).result()
        assert made.layer.data.shape == SHAPE


def test_a_landmark_in_a_volume_may_have_its_target_on_another_slice(viewer):
    frame = frame_of(viewer.layers[0], volume_view(viewer))
    where = Points([[2.0, 3, 4], [5, 6, 7]], scale=SCALE, units=UNITS, translate=(5, 6, 7))
    should = Points([[3.0, 3, 4], [5, 6, 8]], scale=SCALE, units=UNITS, translate=(5, 6, 7))
    marks = read_landmarks(where, should, frame, SHAPE, volume_view(viewer))
    assert [mark.target for mark in marks] == [(3, 3, 4), (5, 6, 8)]
    study = Study(
        Grid(SHAPE, SCALE),
        Tissue(stiffness=np.ones(SHAPE)),
        Motion(hold_edge=True, drawing=Drawing(marks)),
    )
    assert solve_study(study).displacement[2, 3, 4] == pytest.approx((2, 0, 0), abs=1e-3)


def test_a_colour_volume_is_drawn_in_colour():
    image = np.zeros((*SHAPE, 3), np.uint8)
    study = Study(Grid(SHAPE, SCALE), pictures=Pictures(image))
    assert study.intensities.shape == SHAPE
    frame = frame_of(Image(image, rgb=True), View((1, 2), (0.0,) * 3, volume=True))
    assert layer_on(frame, image, "MR", {}, {}).attributes["rgb"]


def test_slices_perpendicular_to_each_axis_have_evenly_spaced_arrows():
    shape = (48, 56, 40)
    d = np.broadcast_to(np.float32((1, 1, 1)), (*shape, 3))
    starts = arrows_in_slices(d, spacing=1, about=60)[:, 0]
    for axis in range(3):
        others = [at for at in range(3) if at != axis]
        wanted = 60 * np.prod(np.take(shape, others)) / (56 * 40)
        for number in range(shape[axis]):
            there = starts[starts[:, axis] == number][:, others]
            assert 0.7 * wanted < len(there) < 1.4 * wanted
            apart = np.linalg.norm(there[:, None] - there[None], axis=-1)
            assert apart[~np.eye(len(there), dtype=bool)].min() >= 3
