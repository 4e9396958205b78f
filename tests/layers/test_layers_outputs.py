"""Tests of the layers made from a solution."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Labels, Layer

from napari_hmrf import Problem, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.warp import warp
from napari_hmrf.layers.field_layer import result_of
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.result_layers import ARROWS, Pictures, overlay_of, result_layers
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.solver.optimizers.base import LevelRun
from napari_hmrf.solver.solution import Provenance, Solution

SHAPE = (30, 40)
#: Names of the overlays, of which one is shown at a time.
OVER = (
    "grid",
    "labels",
    "folds",
    "stiffness",
    "observed",
    "confidence",
    "magnitude",
    "jacobian",
)


def solution(displacement=(2.0, 0.0), spacing=(1.0, 1.0), shape=SHAPE):
    """Return a solution in which all tissue moves by the same vector."""
    field = np.broadcast_to(np.float32(displacement), (*shape, len(shape))).copy()
    return Solution(
        displacement=field,
        energy=np.array([1.0]),
        levels=(LevelRun(0, shape, 1),),
        tissue=np.ones(shape, bool),
        spacing=spacing,
        provenance=Provenance("cpu", "a test"),
    )


def spot(shape=SHAPE, at=(10, 20)):
    image = np.zeros(shape, np.float32)
    image[at] = 1
    return image


def layers_of(outputs, over=()):
    """Return the layers of a result by kind, with the overlays of some names."""
    layers = {kind: Layer.create(*made) for kind, made in outputs.layers.items()}
    answer = result_of(layers["arrows"])
    for name in over:
        made = compute_thread.submit(partial(overlay_of, answer, name)).result()
        layers |= {} if made is None else {name: Layer.create(*made.layer)}
    return layers


def test_arrows_and_image_move_in_the_same_direction():
    outputs = result_layers(solution((3.0, -2.0)), pictures=Pictures(image=spot(), name="MR"))
    layers = layers_of(outputs)
    assert list(layers) == ["image", "arrows"]
    np.testing.assert_allclose(layers["arrows"].data[:, 1], [[3, -2]] * len(layers["arrows"].data))
    assert np.unravel_index(layers["image"].data.argmax(), SHAPE) == (13, 18)


def test_every_layer_is_named_after_its_source():
    labels = (spot() > 0).astype(np.uint8)
    pictures = Pictures(spot(), labels, "MR", "Tissue")
    layers = layers_of(result_layers(solution(), pictures=pictures), OVER)
    # There is neither a problem nor a fold, so the layers of inputs and folds are missing.
    assert {kind: layer.name for kind, layer in layers.items()} == {
        "image": "MR deformed",
        "arrows": "MR arrows",
        "grid": "MR grid",
        "labels": "Tissue deformed",
        "magnitude": "MR displacement (px)",
        "jacobian": "MR area change (ratio)",
    }
    assert layers["labels"].data[12, 20] == 1
    assert layers["arrows"].vector_style == "arrow"
    assert layers["grid"].vector_style == "line"


def test_a_result_without_an_image_has_no_deformed_image():
    made = layers_of(result_layers(solution()), ("grid", "labels"))
    assert list(made) == ["arrows", "grid"]


def test_the_number_of_arrows_is_limited():
    outputs = result_layers(solution(shape=(300, 300)))
    assert ARROWS / 2 < len(outputs.layers["arrows"].data) < 2 * ARROWS


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (4.0, 1.0)])
def test_long_arrows_of_true_length_do_not_overlap(spacing):
    outputs = result_layers(solution((0.0, 50.0), spacing, (200, 300)))
    arrows = outputs.layers["arrows"].data
    np.testing.assert_allclose(arrows[:, 1], [[0, 50]] * len(arrows))
    assert len(arrows) > 20
    for row in np.unique(arrows[:, 0, 0]):
        starts = np.sort(arrows[arrows[:, 0, 0] == row, 0, 1])
        assert (np.diff(starts) > 50).all()


@pytest.mark.parametrize("shape", [(60, 60), (4, 60, 60)])
def test_motion_below_a_twentieth_of_the_smallest_side_of_a_pixel_has_no_arrows(shape):
    def count(across):
        spacing = (4.0, 2.0, 2.0)[: len(shape)]
        step = (across, *[0.0] * (len(shape) - 1))
        arrows = result_layers(solution(step, spacing, shape)).layers["arrows"].data
        return int(arrows[:, 1].any(axis=1).sum())

    assert count(0.09) == 0
    assert count(0.11) > 50


def test_arrows_have_equal_distances_in_millimetres_along_both_axes():
    arrows = result_layers(solution((0.0, 0.1), (4.0, 1.0), (60, 240))).layers["arrows"].data
    rows, cols = (np.unique(arrows[:, 0, axis]) for axis in (0, 1))
    assert 0.6 < 4 * np.diff(rows).min() / np.diff(cols).min() < 1.6


def test_pixels_vacated_by_tissue_have_the_darkest_intensity():
    air = spot() - 1000
    moved = result_layers(solution((5.0, 0.0)), pictures=Pictures(air)).layers["image"].data
    assert moved[0, 0] == -1000


def test_a_deformed_colour_image_is_in_colour():
    colours = np.zeros((*SHAPE, 3), np.uint8)
    colours[10, 20] = (255, 0, 9)
    image = layers_of(result_layers(solution(), pictures=Pictures(colours)))["image"]
    assert image.rgb
    np.testing.assert_array_equal(image.data[12, 20], [255, 0, 9])


@pytest.mark.parametrize(
    "place",
    [
        {"scale": (0.5, 2.0), "units": ("mm", "mm"), "axis_labels": ("row", "col")},
        {"translate": (10.0, -4.0)},
        {"rotate": 25.0},
        {"shear": [0.2]},
        {"affine": np.array([[0.0, 2.0, 5.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])},
        {"scale": (-1.0, 1.0), "rotate": 90.0, "translate": (3.0, 3.0)},
    ],
    ids=lambda place: next(iter(place)),
)
def test_results_lie_at_the_place_of_their_source(place):
    source = Image(spot(), **place)
    frame = frame_of(source)
    spacing = frame.spacing
    moved = solution((2.0 * spacing[0], 3.0 * spacing[1]), spacing)
    outputs = result_layers(moved, frame, Pictures(spot(), name="MR"))
    target = np.array(source.data_to_world((12, 23)))
    for kind, layer in layers_of(outputs, OVER).items():
        assert layer.units == source.units, kind
        assert layer.axis_labels == source.axis_labels, kind
        np.testing.assert_allclose(layer.data_to_world((12, 23)), target, err_msg=kind)
    arrows = layers_of(outputs)["arrows"]
    np.testing.assert_allclose(arrows.data[0, 1], [2, 3], rtol=1e-5)
    tip = arrows.data_to_world(arrows.data[0].sum(axis=0))
    tail = source.data_to_world(arrows.data[0, 0] + [2, 3])
    np.testing.assert_allclose(tip, tail, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (2, 1, 0)])
def test_results_of_a_stack_lie_on_their_slice_for_any_order_of_axes(order):
    viewer = ViewerModel()
    data = np.random.default_rng(0).random((30, 31, 32))
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    affine[:3, 3] = (1, 2, 3)
    source = viewer.add_image(
        data, scale=(4.0, 0.5, 2.0), translate=(9, 8, 7), affine=affine, axis_labels=("z", "y", "x")
    )
    viewer.dims.order = order
    viewer.dims.set_current_step(order[0], 5)
    frame = frame_of(source, View.of(viewer.dims))
    picture = frame.take(source.data)
    still = solution((0.0, 0.0), frame.spacing, picture.shape)
    pictures = Pictures(picture, picture > 0, "MR", "T")
    layers = layers_of(result_layers(still, frame, pictures), OVER)
    for name, layer in layers.items():
        assert layer.ndim == 3, name
        assert layer.name.endswith(f"({'zyx'[order[0]]} = 5)"), name
        assert layer.metadata[METADATA]["slice"] == f"{'zyx'[order[0]]} = 5", name
    # The deformed image equals the source at its place: compare pixels through the world.
    at = [3, 4, 6]
    at[order[0]] = 5
    own = layers["image"].world_to_data(source.data_to_world(at))
    assert layers["image"].data[tuple(np.rint(own).astype(int))] == data[tuple(at)]
    starts = layers["arrows"].data[:, 0]
    assert (starts[:, order[0]] == 5).all()


def test_arrows_store_the_solution_with_its_frame():
    frame = frame_of(Labels(np.ones(SHAPE, int), scale=(2.0, 2.0)))
    outputs = result_layers(solution(), frame)
    kept = outputs.layers["arrows"].attributes["metadata"][METADATA]["solution"]
    assert Frame.from_dict(kept.frame) == frame
    # The stored solution gives the same layers.
    again = result_layers(kept)
    np.testing.assert_array_equal(again.layers["arrows"].data, outputs.layers["arrows"].data)


def test_folds_are_counted():
    field = np.zeros((*SHAPE, 2), np.float32)
    field[:, 20] = (0, 5)
    folded = replace(solution((0.0, 0.0)), displacement=field)
    outputs = result_layers(folded, pictures=Pictures())
    assert outputs.folds > 0
    layer = layers_of(outputs, ["folds"])["folds"]
    assert outputs.folds < layer.data.sum() <= outputs.folds + 2 * outputs.overlaps, (
        "folds and both parts that overlap are marked"
    )
    unfolded = result_layers(solution())
    assert unfolded.folds == 0


def test_a_scale_of_strain_is_capped_and_folds_are_named():
    field, columns = np.zeros((*SHAPE, 2), np.float32), np.minimum(np.arange(SHAPE[1]), 20)
    field[..., 1] = 2 * columns  # 3 times as wide: a strain of 400 %
    stretched = replace(solution((0.0, 0.0)), displacement=field)
    answer = result_of(Layer.create(*result_layers(stretched).layers["arrows"]))
    overlay = overlay_of(answer, "stretch")
    assert overlay.limits == (-100, 100)
    assert overlay.beyond == "Colours end at 100 (values to 400)"
    assert "folded" not in overlay.layer.attributes["name"]
    field[:, 2, 1] -= 5  # the array of which the solution has a read-only view
    folded = overlay_of(answer, "stretch")
    assert "(%; blue: folded)" in folded.layer.attributes["name"]
    assert (folded.layer.data == np.inf).any()
    assert "inf" not in folded.beyond


def test_overlapping_pieces_without_folds_are_counted():
    two = solution((0.0, 0.0))
    two.tissue[:, 14:16] = False
    field = two.displacement.copy()
    field[:, :14] = (0, 6)
    two = replace(two, displacement=field)
    outputs = result_layers(two, pictures=Pictures())
    assert outputs.folds == 0
    assert outputs.overlaps == 30 * 4  # Sites up to column 13 + 6 cover sites from column 16.
    assert result_layers(solution(), pictures=Pictures()).overlaps == 0


@pytest.mark.parametrize("dtype", [np.int64, np.uint64, np.int8, bool])
def test_an_image_of_the_largest_integers_is_deformed_without_overflow(dtype):
    largest = 1 if dtype is bool else np.iinfo(dtype).max
    image = np.full(SHAPE, largest, dtype)
    moved = result_layers(solution((5.0, 0.0)), pictures=Pictures(image)).layers["image"].data
    assert moved.dtype == dtype
    assert moved[0, 0] == largest
    assert abs(int(moved[20, 20]) - largest) <= largest / 2**50


def test_making_layers_can_be_stopped_between_steps():
    calls = []

    def stop():
        calls.append(1)
        if len(calls) == 3:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        result_layers(solution(), pictures=Pictures(spot()), checkpoint=stop)


def test_the_inputs_of_a_problem_are_shown_as_layers():
    y, c, m = np.zeros((20, 24, 2)), np.zeros((20, 24, 2)), np.full((20, 24), 5.0)
    c[0], c[-1] = 1, (0.5, 0.25)
    y[-1] = (0, 3)
    m[:, 12:] = 20
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=(1.0, 2.0))
    solved = solve(problem)
    outputs = result_layers(solved, problem=problem)
    layers = layers_of(outputs, ("stiffness", "observed", "confidence"))
    for name, given in (("stiffness", m), ("confidence", c.max(axis=-1))):
        moved = warp(given, solved.displacement, spacing=(1.0, 2.0), order=0, fill=np.nan)
        np.testing.assert_allclose(
            layers[name].data, moved, err_msg="an input does not move with the tissue"
        )
    assert layers["confidence"].contrast_limits == [0.0, 1.0]
    starts, steps = layers["observed"].data[:, 0], layers["observed"].data[:, 1]
    assert set(starts[:, 0]) == {0, 19}, "observations are not shown, or are shown elsewhere"
    np.testing.assert_allclose(steps[starts[:, 0] == 19], [(0, 1.5)] * 24)
    assert not steps[starts[:, 0] == 0].any(), "a fixed site has an arrow instead of a dot"
