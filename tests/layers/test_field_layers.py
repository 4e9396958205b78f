"""Tests of layers with displacement fields of other tools, as boundary or as reference."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Layer

from napari_hmrf import ProblemError
from napari_hmrf.contributions import open_scan, open_solution
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.fields import write_field
from napari_hmrf.layers.field_layer import field_layer, field_of
from napari_hmrf.layers.metadata import layer_metadata
from napari_hmrf.results.observation import PixelField
from napari_hmrf.tissue import edge_confidence
from napari_hmrf.ui.result.result_messages import overlay_choices
from tests.support.screen import Screen

pytest.importorskip("SimpleITK")
SHAPE = (40, 48)
in_pixels = Field.in_pixels
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])


def swirl(shape, spacing):
    """Return a smooth motion, in mm."""
    rows, cols = np.indices(shape) / np.array(shape).reshape(2, 1, 1) * np.pi
    return np.stack([np.sin(rows) * np.cos(cols), 1.5 * np.sin(cols)], axis=-1) * spacing


def open_file(path):
    """Return the layer that File > Open makes of a file."""
    ((data, attributes, kind),) = open_scan(str(path))(str(path))
    return Layer.create(data, attributes, kind)


@pytest.fixture
def dock_beside(frame, wait_for):
    """Return a function that replaces all layers and returns the dock and its viewer."""
    viewer, dock = frame.viewer, frame.open()

    def make(*layers):
        viewer.layers.clear()
        for layer in layers:
            viewer.add_layer(layer)
        wait_for(lambda: not dock.busy)
        return dock, viewer

    return make


def photo(**place):
    pixels = np.random.default_rng(3).integers(60, 200, SHAPE, dtype=np.uint8)
    return Layer.create(pixels, {"name": "photo", **place}, "image")


@pytest.mark.usefixtures("without_child")
@pytest.mark.parametrize("ending", [".mha", ".nrrd", ".nii.gz", ".h5"])
def test_a_field_file_is_opened_as_a_layer_at_its_place(tmp_path, ending):
    path, d = tmp_path / f"warp{ending}", swirl(SHAPE, 0.5)
    write_field(path, d, spacing=(0.5, 0.7), origin=(3.0, -4.0), direction=TURN)
    layer = open_file(path)
    assert layer.name == "warp"
    assert [str(unit) for unit in layer.units] == ["millimeter"] * 2
    x_first = [3.0, -4.0] + TURN @ [0.7 * 11, 0.5 * 20]
    np.testing.assert_allclose(layer.data_to_world((20, 11)), x_first[::-1], atol=1e-5)
    inner = np.s_[8:-8, 8:-8]
    held = field_of(layer).field.displacement
    np.testing.assert_allclose(held[inner], (d / [0.5, 0.7])[inner], atol=0.02)
    assert 100 < len(layer.data) < 500, "too few or too many arrows"
    assert arrows_match_field(layer, held)


def arrows_match_field(layer, held):
    starts = layer.data[:, 0].astype(int)
    return np.allclose(layer.data[:, 1], held[tuple(starts.T)], atol=1e-5)


def test_a_file_without_a_field_is_left_to_other_readers(tmp_path):
    foreign = tmp_path / "cells.h5"
    foreign.write_bytes(b"\x89HDF\r\n\x1a\n of another program")
    assert open_scan(str(foreign)) is None


def test_a_field_with_its_own_grid_is_the_boundary_of_a_slice_of_a_volume(
    tmp_path, dock_beside, wait_for
):
    """Convert the field of a volume, in mm on coarser voxels, to the pixels of the slice."""
    z, y, x = (np.indices((5, 30, 40)) * np.reshape([4.0, 2.0, 2.0], (3, 1, 1, 1))).astype(float)
    d = np.stack([0.2 + 0 * z, 0.02 * y + 0.01 * z, -0.01 * x], axis=-1)
    path = tmp_path / "warp.mha"
    volume = Layer.create(
        np.full((9, *SHAPE), 100, np.uint8),
        {"name": "T1", "scale": (2.0, 0.5, -0.8), "translate": (3, 10, 60), "units": ("mm",) * 3},
        "image",
    )
    write_field(path, d, spacing=(4.0, 2.0, 2.0), origin=(1.0, 2.0, 3.0))
    dock, viewer = dock_beside(volume, open_file(path))
    viewer.dims.set_current_step(0, 3)
    dock.boundary = viewer.layers["warp"]
    wait_for(lambda: not dock.busy)
    assert not dock.hold_edge, "the edge is prescribed, although the field sets its motion"
    motion = dock.study.motion
    rows, cols = np.indices(SHAPE)
    at_z, at_y, at_x = 3 + 2.0 * 3 - 3, 10 + 0.5 * rows - 2, 60 - 0.8 * cols - 1
    inside = motion.confidence[..., 0] > 0
    assert inside[:, 5:40].all()
    expected = np.stack([0.02 * at_y + 0.01 * at_z, 0.01 * at_x], axis=-1)
    np.testing.assert_allclose(motion.observed[inside], expected[inside], atol=0.02)
    assert any("displacements out of the slice" in note for note in dock.study.notes)


def test_a_field_is_weighted_by_a_mask_an_image_or_edges(tmp_path, dock_beside, wait_for):
    write_field(tmp_path / "warp.mha", swirl(SHAPE, 1.0), spacing=(1, 1))
    place = {"units": ("mm", "mm")}
    mask, sure = np.zeros(SHAPE, np.uint8), np.full(SHAPE, 0.25, np.float32)
    mask[10:20, 10:30] = 7
    layers = (
        photo(**place),
        Layer.create(mask, {"name": "mask", **place}, "labels"),
        Layer.create(sure, {"name": "sure", **place}, "image"),
    )
    layers[0].metadata = layer_metadata("image")
    dock, viewer = dock_beside(open_file(tmp_path / "warp.mha"), *layers)
    dock.image, dock.boundary = viewer.layers["photo"], viewer.layers["warp"]
    held = field_of(viewer.layers["warp"]).field.displacement
    for chosen, counts in (
        (None, np.ones(SHAPE)),
        (viewer.layers["mask"], mask > 0),
        (viewer.layers["sure"], sure),
        ("edges", edge_confidence(layers[0].data)),
    ):
        dock.confidence = chosen
        motion = dock.study.motion
        np.testing.assert_array_equal(motion.confidence, np.repeat(counts[..., None], 2, axis=-1))
        np.testing.assert_allclose(motion.observed, held, atol=1e-6)
    wait_for(lambda: not dock.busy)
    known = edge_confidence(layers[0].data) > 0
    away = np.linalg.norm(dock.solution.displacement - held, axis=-1)
    assert away[known & dock.solution.tissue].max() < 0.01, (
        "a site of full confidence does not follow the field"
    )


def test_a_zero_confidence_and_a_released_edge_are_reported(tmp_path, dock_beside, wait_for):
    write_field(tmp_path / "warp.mha", swirl(SHAPE, 1.0), spacing=(1, 1))
    empty = Layer.create(np.zeros(SHAPE, np.uint8), {"name": "mask", "units": ("mm", "mm")})
    dock, viewer = dock_beside(open_file(tmp_path / "warp.mha"), photo(units=("mm", "mm")))
    viewer.add_layer(empty)
    dock.image = viewer.layers["photo"]
    Screen(dock).choose("warp")
    wait_for(lambda: not dock.busy)
    assert not dock.hold_edge
    assert "The outer edge is no longer fixed, because 'warp' sets the motion" in dock.status
    dock.confidence = empty
    wait_for(lambda: not dock.busy)
    assert (
        "'mask' is 0 wherever 'warp' has a displacement, so no displacement is used" in dock.status
    )
    empty.data = np.ones(SHAPE, np.uint8)
    wait_for(lambda: not dock.busy)
    assert "is 0 wherever" not in dock.status


def test_a_field_in_pixels_is_applied_to_an_image_without_millimetres(tmp_path, dock_beside):
    write_field(tmp_path / "warp.mha", swirl(SHAPE, 0.5), spacing=(0.5, 0.5))
    dock, viewer = dock_beside(photo(), open_file(tmp_path / "warp.mha"))
    dock.boundary = viewer.layers["warp"]
    held = field_of(dock.boundary).field.displacement
    study = dock.study
    np.testing.assert_allclose(study.motion.observed, held, atol=1e-6)
    assert study.notes[-1].startswith("'warp' is in millimeter and the image in pixel: the")


def test_a_field_at_another_place_is_refused_by_name(tmp_path, dock_beside):
    write_field(tmp_path / "far.mha", swirl(SHAPE, 0.5), spacing=(0.5, 0.5), origin=(900, 900))
    write_field(tmp_path / "small.mha", swirl((20, 20), 0.5), spacing=(0.5, 0.5))
    in_mm, viewer = dock_beside(photo(units=("mm", "mm")), open_file(tmp_path / "far.mha"))
    in_mm.boundary = viewer.layers["far"]
    with pytest.raises(ProblemError, match="'far' does not overlap the image"):
        _ = in_mm.study
    in_pixels, viewer = dock_beside(photo(), open_file(tmp_path / "small.mha"))
    in_pixels.boundary = viewer.layers["small"]
    with pytest.raises(ProblemError, match="'small' is 20 x 20 in millimeter, but the image is 40"):
        _ = in_pixels.study


def test_a_dense_field_of_a_study_is_drawn_as_a_few_arrows(tmp_path, dock_beside, wait_for):
    write_field(tmp_path / "warp.mha", swirl((60, 60), 1.0), spacing=(1, 1))
    pixels = np.full((60, 60), 100, np.uint8)
    image = Layer.create(pixels, {"name": "photo", "units": ("mm", "mm")}, "image")
    dock, viewer = dock_beside(image, open_file(tmp_path / "warp.mha"))
    dock.boundary = viewer.layers["warp"]
    wait_for(lambda: not dock.busy)
    ours, path = dock.study.motion, dock.save_study(tmp_path / "case")
    dock_beside()
    dock.open_study(path)
    wait_for(lambda: not dock.busy)
    assert len(dock.boundary.data) < 500
    theirs = dock.study.motion
    np.testing.assert_allclose(theirs.observed, ours.observed, atol=1e-5)
    np.testing.assert_array_equal(theirs.confidence, ours.confidence)


def test_a_rotated_field_on_its_own_pixels_is_read_unchanged(tmp_path, dock_beside):
    d = swirl(SHAPE, 0.5)
    write_field(tmp_path / "warp.mha", d, spacing=(0.5, 0.7), origin=(3, -4), direction=TURN)
    field = open_file(tmp_path / "warp.mha")
    place = {name: getattr(field, name) for name in ("scale", "affine", "units")}
    dock, viewer = dock_beside(photo(**place), field)
    dock.boundary = viewer.layers["warp"]
    observed = dock.study.motion.observed
    np.testing.assert_allclose(observed, field_of(field).field.displacement * [0.5, 0.7], atol=1e-5)


@pytest.fixture
def pulled(dock_beside, wait_for, small_sample, run):
    """Return a function that solves a painted example in millimetres beside layers."""

    def make(*layers, **place):
        dock, viewer = dock_beside()
        dock.model, dock.live = "elastic", False
        small_sample(viewer, units=("mm", "mm"), scale=(0.5, 0.5), **place)
        for layer in layers:
            viewer.add_layer(layer)
        run(dock)
        wait_for(lambda: not dock.busy)
        return dock, viewer

    return make


def test_the_distance_of_a_result_from_a_reference_is_reported_and_shown(pulled, wait_for):
    dock, viewer = pulled()
    screen = Screen(dock)
    d = (dock.solution.displacement + np.array([0.3, -0.4])) / 0.5
    made = field_layer(in_pixels(d), {"scale": (0.5, 0.5), "units": ("mm", "mm")}, "t")
    assert "RMSD" not in screen.words
    menu = dock._form.result.overlay
    usual = [name for _, name in overlay_choices("mm")]
    assert [*menu.choices] == usual, "the order differs from that of a result in pixels"
    layer = viewer.add_layer(Layer.create(*made))
    dock.reference = layer
    wait_for(lambda: not dock.busy)
    assert dock.comparison.rmsd == pytest.approx(0.5, abs=1e-4)
    assert "RMSD from 't': 0.5 mm." in screen.words
    screen.choose("difference from known field (mm)")
    wait_for(lambda: not dock.busy)
    shown = viewer.layers["MR difference from t (mm), elastic"]
    seen = shown.data[np.isfinite(shown.data)]
    np.testing.assert_allclose(seen, 0.5, atol=1e-4)
    dock.percent = 50
    wait_for(lambda: not dock.busy)
    assert shown in viewer.layers, (
        "the layer of differences is hidden, but should move with the tissue"
    )
    dock.reference = None
    wait_for(lambda: not dock.busy)
    assert (dock.overlay, shown in viewer.layers) == ("nothing", False)
    assert "RMSD" not in screen.words


def test_a_reference_that_covers_a_part_of_the_tissue_is_compared_there(pulled, wait_for):
    dock, viewer = pulled()
    d = dock.solution.displacement[:, :12] / 0.5
    place = {"scale": (0.5, 0.5), "units": ("mm", "mm")}
    dock.reference = viewer.add_layer(Layer.create(*field_layer(in_pixels(d), place, "half")))
    wait_for(lambda: not dock.busy)
    assert dock.comparison.rmsd == pytest.approx(0, abs=1e-6)
    assert "over 50% of the tissue: " in Screen(dock).words
    far = {**place, "translate": (500, 500)}
    dock.reference = viewer.add_layer(Layer.create(*field_layer(in_pixels(d), far, "far")))
    wait_for(lambda: not dock.busy)
    assert dock.comparison is None
    assert "'far' does not overlap" in dock.status


def test_a_saved_result_of_another_model_is_a_reference(tmp_path, pulled, run, wait_for):
    dock, viewer = pulled()
    first = dock.solution.displacement.copy()
    path = str(dock.solution.write(tmp_path / "elastic.npz"))
    dock.model = "paper"
    run(dock)
    wait_for(lambda: not dock.busy)
    ((data, attributes, kind),) = open_solution(path)(path)
    opened = viewer.add_layer(Layer.create(data, attributes, kind))
    dock.result = viewer.layers["MR arrows, paper"]
    dock.reference = opened
    wait_for(lambda: not dock.busy)
    tissue = dock.solution.tissue
    apart = np.linalg.norm(dock.solution.displacement - first, axis=-1)[tissue]
    assert dock.comparison.rmsd == pytest.approx(np.sqrt((apart**2).mean()), rel=1e-4) != 0


def test_a_field_in_pixels_is_mapped_to_the_displayed_axes():
    """Test a slice with swapped axes and a slice in the middle of a volume."""
    d = swirl((8, 8), 1.0)
    known = PixelField(in_pixels(d), Frame.at((1.0, 1.0), ("mm", "mm")))
    turned = replace(Frame.at((2.0, 3.0), ("pixel", "pixel")), plane=(1, 0))
    seen = known.on(turned, (8, 8)).displacement
    np.testing.assert_allclose(seen, d.swapaxes(0, 1)[..., ::-1] * turned.spacing, rtol=1e-6)
    side = replace(Frame.at((1.0, 1.0, 1.0), ("mm",) * 3), plane=(0, 1))
    target = replace(Frame.at((1.0, 1.0, 1.0), ("pixel",) * 3), plane=(0, 1))
    seen = PixelField(in_pixels(side.put_field(d)), side).on(target, (8, 8)).displacement
    np.testing.assert_allclose(seen, d, rtol=1e-6)
