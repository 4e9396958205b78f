"""Claims about layers of stiffness made from an image's intensity."""

import dask.array as da
import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Layer
from study_reader import read_layers

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import BOUNDARY, described
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.stiffness_layers import (
    StiffnessStack,
    curve_of,
    first_curve,
    intensities_of,
    source_name,
    stiffness_layer,
    update_stiffness,
)
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve, luminance

CURVE = StiffnessCurve(((0, 1), (255, 100)), void_below=20, unit="kPa")


def layer_of(image, curve=CURVE):
    return Layer.create(*stiffness_layer(image, curve))


def picture(shape, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, 256, shape).astype(dtype)


def test_stiffness_lies_where_its_image_lies():
    place = {
        "scale": (3.0, 0.5, 0.7),
        "translate": (1.0, 2.0, 3.0),
        "rotate": 20.0,
        "shear": (0.1, 0.0, 0.2),
        "units": ("s", "mm", "mm"),
        "axis_labels": ("t", "y", "x"),
    }
    affine = np.eye(4)
    affine[1, 3] = 5
    image = Image(picture((4, 12, 15)), name="MR", affine=affine, **place)
    layer = layer_of(image)
    for name in ("scale", "translate", "rotate", "shear", "units", "axis_labels"):
        np.testing.assert_array_equal(getattr(layer, name), getattr(image, name))
    corner = (3, 11, 14)
    np.testing.assert_allclose(layer.data_to_world(corner), image.data_to_world(corner))


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.float64])
@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("stack", [(), (3,), (2, 3)])
def test_every_slice_of_every_image_gets_the_stiffness_of_its_pixels(dtype, lazy, coloured, stack):
    pixels = picture((*stack, 6, 7, *([3] if coloured else [])), dtype)
    if coloured and dtype != np.uint8:
        pixels = (pixels / 255).astype(np.float32)
    image = Image(da.from_array(pixels, chunks=2) if lazy else pixels, rgb=coloured)
    curve = (
        StiffnessCurve(((0, 1), (200, 9))) if pixels.max() > 1 else StiffnessCurve(((0, 1), (1, 9)))
    )
    layer = layer_of(image, curve)
    expected = curve(luminance(pixels) if coloured else pixels)
    assert layer.data.shape == expected.shape
    assert layer.data.dtype == np.float32
    np.testing.assert_array_equal(np.asarray(layer.data), expected)
    if stack:
        np.testing.assert_array_equal(layer.data[..., 2:4, 1], expected[..., 2:4, 1])
        np.testing.assert_array_equal(layer.data[0], expected[0])


def test_of_a_stack_only_what_is_looked_at_is_computed():
    read = []

    class Disk:
        shape, ndim, dtype = (1000, 64, 64), 3, np.dtype(np.uint8)

        def __getitem__(self, index):
            read.append(index)
            return (
                picture(self.shape)[index] if not isinstance(index[0], int) else picture((64, 64))
            )

    stack = StiffnessStack(Disk(), CURVE)
    assert read == []
    assert stack[5, :, :].shape == (64, 64)
    assert [index[0] for index in read] == [5]


def test_a_layer_keeps_its_curve_and_where_it_comes_from():
    image = Image(picture((12, 15)), name="MR")
    layer = layer_of(image)
    assert curve_of(layer) == CURVE
    assert source_name(layer) == "MR"
    assert layer.name == "MR stiffness (kPa)"
    for other in (image, Image(np.zeros((3, 3)), metadata={"napari-hmrf": {"curve": [1]}})):
        assert curve_of(other) is None


def test_another_curve_changes_the_layer_and_not_its_looks():
    image = Image(picture((12, 15)), name="MR")
    layer = layer_of(image)
    layer.opacity, layer.colormap = 0.9, "gray"
    softer = StiffnessCurve(((0, 1), (255, 10)))
    update_stiffness(layer, image, softer)
    np.testing.assert_array_equal(layer.data, softer(image.data))
    assert curve_of(layer) == softer
    assert (layer.opacity, layer.colormap.name) == (0.9, "gray")
    assert layer.contrast_limits[1] == 10
    image.data = picture((12, 16))
    with pytest.raises(ProblemError, match="'MR' is not of the size"):
        update_stiffness(layer, image, CURVE)
    assert curve_of(layer) == softer


def test_what_is_no_tissue_lets_the_image_through():
    image = Image(np.array([[0, 30], [100, 255]], np.uint8))
    layer = layer_of(image)
    low, high = layer.contrast_limits
    shown = layer.colormap.map((layer.data.ravel() - low) / (high - low))
    assert shown[0, 3] == 0
    assert (shown[1:, 3] == 1).all()


def test_a_first_curve_leaves_out_the_dark_surroundings_and_keeps_dark_places_inside():
    head = np.full((40, 40), 3.0) + np.random.default_rng(0).random((40, 40))
    head[8:32, 8:32] = 100 + 20 * np.random.default_rng(1).random((24, 24))
    head[18:22, 18:22] = 12  # fluid
    curve = first_curve(Image(head))
    m = curve(head)
    assert (m[:8] == 0).mean() > 0.97
    assert (m[8:32, 8:32] > 0).all()
    assert first_curve(Image(head[8:32, 8:32])).void_below is None


def test_a_first_curve_is_that_of_the_slice_that_is_shown():
    stack = np.stack([picture((20, 20)), picture((20, 20)) // 4])
    viewer = ViewerModel()
    image = viewer.add_image(stack)
    viewer.dims.set_current_step(0, 1)
    assert first_curve(image, View.of(viewer.dims)).points[-1][0] < 64
    viewer.dims.set_current_step(0, 0)
    assert first_curve(image, View.of(viewer.dims)).points[-1][0] > 200


def test_an_image_of_one_value_is_refused_by_name():
    with pytest.raises(ProblemError, match="'flat' is of one value in this slice"):
        first_curve(Image(np.full((5, 5), 7), name="flat"))


@pytest.mark.parametrize("coloured", [False, True])
def test_the_solver_reads_from_a_stack_what_is_shown(coloured):
    pixels = picture((3, 16, 18, 3) if coloured else (3, 16, 18))
    image = Image(pixels, rgb=coloured, name="MR")
    layer = layer_of(image)
    boundary = Layer.create(
        np.ones((3, 16, 18), np.uint8),
        {"metadata": described(BOUNDARY, (BoundaryRule(1, "fixed"),))},
        "labels",
    )
    view = View((1, 2), (2.0, 0.0, 0.0))
    request = Request(layer, boundary, image, rules=(BoundaryRule(1, "fixed"),), view=view)
    expected = CURVE(luminance(pixels[2]) if coloured else pixels[2])
    np.testing.assert_array_equal(read_layers(request).problem.stiffness, expected)
    np.testing.assert_array_equal(CURVE(intensities_of(image, view)), expected)
