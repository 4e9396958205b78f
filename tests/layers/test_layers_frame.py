"""Tests of the place of layers: tolerance, comparison and validation."""

import json
from dataclasses import replace

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Layer

from napari_hmrf.contributions import open_solution
from napari_hmrf.errors import FileFormatError, ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.solver.optimizers.base import LevelRun
from napari_hmrf.solver.solution import Provenance, Solution

SHAPE = (12, 15)


def frame(shape=SHAPE, **place):
    return frame_of(Image(np.zeros(shape), **place))


def differ(first, second, shape=SHAPE):
    """Return whether two places differ, by a comparison in both directions."""
    there, back = first.same_place(second, shape), second.same_place(first, shape)
    assert there == back
    return not there


@pytest.mark.parametrize("pixels", [0.5, -0.3])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_third_of_a_pixel_away_is_another_place(pixels, axis):
    offset = np.zeros(2)
    offset[axis] = pixels
    assert differ(frame(), frame(translate=offset))
    scale = np.array([0.5, 2.0])
    assert differ(frame(scale=scale), frame(scale=scale, translate=offset * scale))


@pytest.mark.parametrize("scale", [(1.0, 1.0), (1e-6, 1e-3), (1e4, 3.0)])
def test_rounding_in_a_header_is_not_another_place(scale):
    offset = np.array([-187.3, 911.7]) * scale
    exact = frame((512, 512), scale=scale, translate=offset)
    rounded = frame((512, 512), scale=np.float32(scale), translate=np.float32(offset))
    assert exact != rounded
    assert not differ(exact, rounded, (512, 512))


def test_the_tolerance_does_not_depend_on_the_distance_from_the_origin():
    """Use world coordinates of a million pixels, as of a microscope stage."""
    far = np.array([1e6, -1e6])
    assert differ(frame(translate=far), frame(translate=np.add(far, (0, 0.5))))
    assert not differ(frame(translate=far), frame(translate=np.add(far, (0, 1e-5))))


def test_the_tolerance_does_not_depend_on_steps_along_other_axes():
    """Use slices that are a metre apart, or frames that are an hour apart."""
    for place in ({"scale": (1e6, 1.0, 1.0)}, {"translate": (1e7, 0.0, 0.0)}):
        first = frame((3, *SHAPE), **place)
        shifted = {**place, "translate": np.add(place.get("translate", (0, 0, 0)), (0, 0, 1.0))}
        assert differ(first, frame((3, *SHAPE), **shifted))
        assert not differ(first, frame((3, *SHAPE), **place))


def test_a_rotated_image_is_compared_along_its_own_pixels():
    place = {"rotate": 30.0, "scale": (100.0, 0.01)}
    along = np.array(
        [[np.cos(np.pi / 6), -np.sin(np.pi / 6)], [np.sin(np.pi / 6), np.cos(np.pi / 6)]]
    )
    across = along @ (0, 0.005)  # Half of the narrow side of a pixel.
    assert differ(frame(**place), frame(**place, translate=across))
    assert not differ(frame(**place), frame(**place, translate=along @ (0.005, 0)))


def test_another_slice_is_another_place():
    stack = Image(np.zeros((5, *SHAPE)), scale=(4.0, 1.0, 1.0))
    viewer = ViewerModel()
    viewer.add_layer(stack)
    seen = []
    for step in (1, 2):
        viewer.dims.set_current_step(0, step)
        seen.append(frame_of(stack, View.of(viewer.dims)))
    assert differ(*seen)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("attribute", "value"),
    [("scale", (np.nan, 1.0)), ("translate", (np.nan, 1.0)), ("translate", (1.0, np.inf))],
)
def test_a_place_with_nan_or_infinity_is_refused(attribute, value):
    layer = Image(np.zeros(SHAPE), name="MR")
    setattr(layer, attribute, value)
    with pytest.raises(ProblemError, match=r"'MR'.*NaN or infinity"):
        frame_of(layer)


def test_a_singular_affine_is_refused():
    layer = Image(np.zeros(SHAPE), name="MR", affine=[[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    with pytest.raises(ProblemError, match=r"'MR'.*singular"):
        frame_of(layer)


def test_a_shear_stored_as_a_matrix_is_converted_and_back():
    layer = Image(np.zeros(SHAPE), shear=np.array([[1.0, 0.0], [0.2, 1.0]]))
    found = frame_of(layer)
    again = Image(np.zeros(SHAPE), **found.placement())
    np.testing.assert_allclose(again.data_to_world((3, 4)), layer.data_to_world((3, 4)))
    assert Frame.from_dict(json.loads(json.dumps(found.as_dict()))) == found


# Frames from files


def saved(tmp_path, stored):
    solution = Solution(
        displacement=np.ones((8, 9, 2), np.float32),
        energy=np.array([1.0]),
        levels=(LevelRun(0, (8, 9), 1),),
        tissue=np.ones((8, 9), bool),
        spacing=(1.0, 1.0),
        provenance=Provenance("cpu", "a test"),
        frame=stored,
    )
    return str(solution.write(tmp_path / "odd.npz"))


def good_frame():
    stack = Image(np.zeros((5, 8, 9)), scale=(2.0, 1.0, 1.0), units=("s", "mm", "mm"))
    return frame_of(stack).as_dict()


def one_at(values, at, value):
    changed = np.array(values, dtype=object)
    changed[at] = value
    return changed.tolist()


BAD = {
    "an axis that is not there": ("plane", (0, 7)),
    "a negative axis": ("plane", (-1, 1)),
    "one axis twice": ("plane", (0, 0)),
    "one axis": ("plane", (1,)),
    "half an axis": ("plane", (0.5, 1)),
    "no axes": ("index", ()),
    "one axis too few": ("index", (0, 0)),
    "an index beyond numbers": ("index", (float("inf"), 0, 0)),
    "an index beyond slices": ("index", (10**30, 0, 0)),
    "an index that is a word": ("index", ("a", 0, 0)),
    "a number for an index": ("index", 3),
    "NaN scale": ("scale", (float("nan"), 1.0, 1.0)),
    "scale 0": ("scale", (1.0, 0.0, 1.0)),
    "short scale": ("scale", (1.0, 1.0)),
    "a word for a scale": ("scale", "big"),
    "nothing for a scale": ("scale", None),
    "infinite translate": ("translate", (0.0, float("inf"), 0.0)),
    "flat rotation": ("rotate", np.ones((3, 3)).tolist()),
    "small rotation": ("rotate", np.eye(2).tolist()),
    "long shear": ("shear", (0.0, 0.0, 0.0, 0.0)),
    "affine of another size": ("affine", np.eye(3).tolist()),
    "ragged affine": ("affine", [[1, 0], [0]]),
    "affine with NaN": ("affine", one_at(np.eye(4), (0, 3), float("nan"))),
    "flat affine": ("affine", np.diag([1.0, 0.0, 1.0, 1.0]).tolist()),
    "affine with perspective": ("affine", one_at(np.eye(4), (3, 0), 1.0)),
    "empty matrix": ("matrix", []),
    "matrix of nothing": ("matrix", np.zeros((4, 4)).tolist()),
    "unknown unit": ("units", ("banana", "banana", "banana")),
    "a sum for a unit": ("units", ("9**9**9", "pixel", "pixel")),
    "time for rows": ("units", ("mm", "s", "mm")),
    "short units": ("units", ("mm", "mm")),
    "a word for units": ("units", "mmm"),
    "numbers for units": ("units", (1, 2, 3)),
    "short labels": ("axis_labels", ("y", "x")),
    "a number for labels": ("axis_labels", 3),
}


def is_refused(stored):
    try:
        Frame.from_dict(stored)
    except ValueError:
        return True
    return False


def test_every_invalid_place_is_refused():
    good = good_frame()
    assert not is_refused(good)
    assert [
        name for name, (key, value) in BAD.items() if not is_refused({**good, key: value})
    ] == []
    needed = good.keys() - {"file_axes"}
    lacking = [{other: good[other] for other in good if other != key} for key in needed]
    assert all(map(is_refused, lacking))


def test_a_file_with_an_invalid_place_is_refused_by_name(tmp_path):
    path = saved(tmp_path, {**good_frame(), "scale": (1.0, 0.0, 1.0)})
    with pytest.raises(FileFormatError, match=r"odd\.npz.*invalid slice position"):
        open_solution(path)(path)


JUNK = [
    None,
    0,
    -1,
    1e400,
    "a",
    [],
    [[]],
    {},
    [1],
    [1, 2, 3],
    ["a"] * 3,
    [[1e300] * 4] * 4,
    [{}] * 3,
]


@pytest.mark.parametrize("key", good_frame())
def test_any_stored_place_is_refused_or_is_the_place_of_a_layer(key):
    for value in JUNK:
        try:
            frame = Frame.from_dict({**good_frame(), key: value})
        except ValueError:
            continue
        layer = Image(np.zeros((5, 8, 9)), **frame.placement())
        assert np.isfinite(layer.data_to_world((0, 0, 0))).all(), value


def test_a_valid_stored_place_sets_the_units_of_the_layer(tmp_path):
    path = saved(tmp_path, good_frame())
    ((data, attributes, kind),) = open_solution(path)(path)
    assert [str(unit) for unit in Layer.create(data, attributes, kind).units] == [
        "second",
        "millimeter",
        "millimeter",
    ]


def test_a_stored_place_is_read_back_equal():
    found = frame_of(Image(np.zeros(SHAPE)))
    assert Frame.from_dict(json.loads(json.dumps(found.as_dict()))) == found
    moved = replace(found, translate=(3.0, 4.0))
    assert Frame.from_dict(moved.as_dict()) != found
