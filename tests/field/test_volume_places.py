"""Frames of volumes: any order of the axes, and volumes of a time series."""

import json
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from napari_hmrf.field.frame import Frame
from napari_hmrf.solver.solution import Provenance, Solution

SHAPE = (4, 5, 6)
SIZE = (3.0, 1.5, 0.5)
ORDERS = list(permutations(range(3)))


def place(plane=(0, 1, 2), **options):
    return replace(Frame.at(SIZE, ("mm",) * 3, volume=True, **options), plane=plane)


def time_series(moment=2):
    """Return the frame of one volume of a time series."""
    units = ("s", "mm", "mm", "mm")
    return Frame.at((2.0, *SIZE), units, index=(moment, 0, 0, 0), volume=True)


def solution(shape=SHAPE, frame=None):
    return Solution(
        np.zeros((*shape, len(shape)), np.float32),
        np.zeros(1),
        (),
        np.ones(shape, bool),
        SIZE[-len(shape) :],
        Provenance("cpu", "here"),
        frame=frame,
    )


@pytest.mark.parametrize("plane", ORDERS)
def test_a_volume_is_reordered_to_the_axes_of_its_frame_and_back(plane):
    data = np.arange(np.prod(SHAPE)).reshape(SHAPE)
    colours = np.stack([data, -data, 2 * data], axis=-1)
    frame = place(plane)
    for pixels in (data, colours):
        taken = frame.take(pixels)
        assert taken.shape[:3] == tuple(SHAPE[axis] for axis in plane)
        site = (1, 2, 3)
        at = [0, 0, 0]
        for axis, number in zip(plane, site, strict=True):
            at[axis] = number
        np.testing.assert_array_equal(taken[site], pixels[tuple(at)])
        np.testing.assert_array_equal(frame.put_image(taken), pixels)
    masked = frame.take(np.ma.masked_equal(data, 7))
    assert masked.mask.sum() == 1


@pytest.mark.parametrize("plane", ORDERS)
def test_components_of_fields_and_arrows_follow_the_axes_of_the_layer(plane):
    frame = place(plane)
    steps = np.random.default_rng(0).normal(size=(*(SHAPE[axis] for axis in plane), 3))
    placed = frame.put_field(steps)
    assert placed.shape == (*SHAPE, 3)
    for axis, layer_axis in enumerate(plane):
        component = frame.put_image(steps[..., axis])
        np.testing.assert_array_equal(placed[..., layer_axis], component)
    arrows = np.array([[[1.0, 2, 3], [0.1, 0.2, 0.3]]])
    (arrow,) = frame.put_vectors(arrows)
    np.testing.assert_allclose(arrow[:, plane], arrows[0])
    assert frame.put_vectors(np.zeros((0, 2, 3))).shape == (0, 2, 3)


@pytest.mark.parametrize("plane", ORDERS)
def test_the_frame_of_a_volume_has_a_spacing_but_no_slice(plane):
    frame = place(plane)
    assert frame.spacing == pytest.approx([SIZE[axis] for axis in plane])
    assert (frame.unit, frame.others, frame.slice_name, frame.slice_seen) == ("mm", (), "", "")
    assert frame.skew == 0
    slanted = place(plane, affine=[[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    assert slanted.skew == pytest.approx(np.degrees(np.arctan(0.1)))


def test_voxel_sizes_in_mixed_units_are_converted_to_the_unit_of_the_rows():
    frame = Frame.at((0.1, 2.0, 3000.0), ("cm", "mm", "um"), volume=True)
    assert frame.unit == "mm"
    assert frame.spacing == pytest.approx((1, 2, 3))


def test_one_volume_of_a_time_series_is_selected():
    data = np.random.default_rng(0).normal(size=(3, *SHAPE))
    frame = time_series(2)
    np.testing.assert_array_equal(frame.take(data), data[2])
    assert frame.put_image(data[2]).shape == (1, *SHAPE)
    field = frame.put_field(np.ones((*SHAPE, 3)))
    assert field.shape == (1, *SHAPE, 4)
    assert not field[..., 0].any()
    assert frame.put_vectors(np.ones((2, 2, 3)))[:, 0].tolist() == [[2, 1, 1, 1]] * 2
    assert frame.others == (0,)
    assert frame.slice_name == frame.slice_seen == "volume 2"
    assert frame.spacing == SIZE


def test_a_shifted_volume_is_at_another_place():
    away = place(affine=np.eye(4) + np.diag([0.4] * 3, k=1) * [0, 0, 0, 1])
    assert place().same_place(place(), SHAPE)
    assert not place().same_place(away, SHAPE)
    assert not place().same_place(place((0, 2, 1)), SHAPE)
    first = Frame.at(SIZE, ("mm",) * 3)
    assert not place().same_place(first, SHAPE), "a slice should not be at the place of a volume"
    assert not first.same_place(place(), SHAPE[1:])
    assert time_series(0).same_place(time_series(0), SHAPE)
    assert not time_series(0).same_place(time_series(1), SHAPE)
    assert place().same_place(time_series(1), SHAPE), (
        "a volume without a time axis should match every time"
    )


@pytest.mark.parametrize("plane", ORDERS)
def test_the_frame_of_a_volume_survives_a_file_round_trip(plane):
    frame = place(plane)
    assert Frame.from_dict(json.loads(json.dumps(frame.as_dict()))) == frame
    assert solution(frame=frame.as_dict()).place == frame


@pytest.mark.parametrize("plane", [(0, 1, 1), (0, 1, 3), (0, 1, 2, 3), (0,)])
def test_a_frame_with_invalid_axes_is_rejected(plane):
    with pytest.raises(ValueError, match="its plane "):
        Frame.from_dict({**place().as_dict(), "plane": plane})


def test_a_solution_without_a_frame_is_at_the_origin():
    frame = solution().place
    assert (frame.plane, frame.spacing, frame.unit) == ((0, 1, 2), SIZE, "pixel")
    assert replace(solution(), unit="mm").place.unit == "mm"
    assert solution(SHAPE[1:]).place.plane == (0, 1)
    with pytest.raises(ValueError, match="match a solution with 3 axes"):
        _ = solution(frame=Frame.at(SIZE, ("mm",) * 3).as_dict()).place
