"""Tests of reading layers and tables into a problem, or into an error that names the layer."""

import json
from dataclasses import replace

import dask.array as da
import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Labels, Vectors

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from tests.support.study_reader import read_layers

MATERIALS = (Material(0, "air", 0.0), Material(1, "normal", 20.0), Material(2, "soft", 10.0))
RULES = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 3.0)))
SHAPE = (12, 15)


def tissue_labels(shape=SHAPE):
    tissue = np.zeros(shape, np.uint8)
    tissue[..., 2:-2, 2:-2] = 1
    tissue[..., 2:-2, 8:-2] = 2
    return tissue


def boundary_labels(shape=SHAPE):
    boundary = np.zeros(shape, np.uint8)
    boundary[..., 2:-2, 2] = 1
    boundary[..., 2:-2, -3] = 2
    return boundary


def picture(shape=SHAPE, dtype=np.float32):
    return (np.arange(np.prod(shape)) % 251).reshape(shape).astype(dtype)


def request(shape=SHAPE, image=None, tissue=None, boundary=None, view=None, **place):
    """Return a request with painted layers of a solvable problem; each layer can be replaced."""
    return Request(
        image=Image(picture(shape), name="MR", **place) if image is None else image,
        tissue=Labels(tissue_labels(shape), name="Tissue", **place) if tissue is None else tissue,
        boundary=Labels(boundary_labels(shape), name="Boundary", **place)
        if boundary is None
        else boundary,
        materials=MATERIALS,
        rules=RULES,
        view=view,
    )


def refusal(wanted: Request) -> ProblemError:
    """Return the error raised for a request, after a check that no layer was changed."""
    before = [(np.array(layer.data), layer.name) for layer in wanted.grid_layers]
    with pytest.raises(ProblemError) as caught:
        read_layers(wanted)
    for layer, (data, name) in zip(wanted.grid_layers, before, strict=True):
        np.testing.assert_array_equal(layer.data, data)
        assert layer.name == name
    return caught.value


def test_painted_layers_make_a_problem():
    inputs = read_layers(request())
    assert inputs.problem.shape == SHAPE
    assert inputs.problem.stiffness[5, 3] == 20
    assert inputs.problem.stiffness[5, 9] == 10
    assert inputs.problem.stiffness[0, 0] == 0
    np.testing.assert_array_equal(inputs.problem.observed[5, -3], [0, 3])
    np.testing.assert_array_equal(inputs.problem.confidence[5, 2], [1, 1])
    assert inputs.notes == ()


def test_painting_after_the_reading_does_not_change_the_inputs():
    wanted = request()
    inputs = read_layers(wanted)
    before = inputs.pictures.image.copy()
    wanted.image.data[:] = -1
    wanted.tissue.data[:] = 0
    np.testing.assert_array_equal(inputs.pictures.image, before)
    assert inputs.pictures.labels.any()


def test_reading_again_detects_changed_layers():
    wanted, copies = request(), LayerCopies()
    first = study_from_layers(wanted, copies=copies)
    assert first.same_as(study_from_layers(wanted, copies=copies))
    wanted.tissue.data[5, 5] = 2
    wanted.tissue.refresh()
    second = study_from_layers(wanted, copies=copies)
    assert not first.same_as(second)
    assert second.motion.labels is first.motion.labels, "an unchanged layer was copied again"
    wanted.boundary.data[6, 6] = 2
    copies.invalidate()
    assert not second.same_as(study_from_layers(wanted, copies=copies)), (
        "a change without an event was missed"
    )


def test_unchanged_arrows_give_an_equal_study():
    arrows = Vectors(np.array([[[5.0, 5.0], [1.0, 0.0]]]), name="Arrows")
    wanted, copies = request(boundary=arrows), LayerCopies()
    first = study_from_layers(wanted, copies=copies)
    assert first.same_as(study_from_layers(wanted, copies=copies))
    arrows.data = arrows.data * 2
    assert not first.same_as(study_from_layers(wanted, copies=copies))


@pytest.mark.parametrize(("part", "name"), [("tissue", "Tissue"), ("boundary", "Boundary")])
def test_a_label_without_a_row_is_refused(part, name):
    wanted = request()
    getattr(wanted, part).data[5, 5] = 9
    with pytest.raises(ProblemError) as error:
        read_layers(wanted)
    assert error.value.field == name


def test_anisotropic_pixels_set_the_spacing_and_lengths_retain_their_unit():
    inputs = read_layers(request(scale=(0.5, 2.0), units=("mm", "mm")))
    assert inputs.problem.spacing == pytest.approx((0.5, 2.0))
    assert inputs.frame.unit == "millimeter"
    np.testing.assert_array_equal(
        inputs.problem.observed[5, -3], [0, 3]
    )  # 3 mm instead of 3 pixels.


def test_a_negative_scale_is_a_positive_spacing():
    assert read_layers(request(scale=(-1.0, 2.0))).problem.spacing == pytest.approx((1.0, 2.0))


def test_the_scale_of_an_affine_sets_the_spacing():
    affine = np.diag([3.0, 4.0, 1.0])
    assert read_layers(request(affine=affine)).problem.spacing == pytest.approx((3.0, 4.0))


def test_columns_in_another_unit_of_length_are_converted():
    inputs = read_layers(request(scale=(1.0, 1000.0), units=("mm", "um")))
    assert inputs.problem.spacing == pytest.approx((1.0, 1.0))


def test_millimetres_mixed_with_pixels_are_refused():
    error = refusal(request(units=("mm", "pixel")))
    assert "'MR'" in str(error)
    assert "unit" in str(error)


def test_sheared_pixels_are_read_as_rectangles_with_a_note():
    inputs = read_layers(request(shear=[0.2]))
    assert any("sheared by 11.3 degrees" in note for note in inputs.notes)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("attribute", ["scale", "translate"])
@pytest.mark.parametrize("which", ["image", "tissue", "boundary"])
def test_a_place_with_nan_is_refused_with_the_name_of_the_layer(attribute, which):
    wanted = request()
    setattr(getattr(wanted, which), attribute, (np.nan, 1.0))
    error = refusal(wanted)
    assert error.field == getattr(wanted, which).name
    assert "NaN" in error.message


def test_layers_of_different_sizes_are_refused_with_both_sizes():
    error = refusal(request(tissue=Labels(tissue_labels((12, 14)), name="Tissue")))
    assert "have 12 x 14 and 12 x 15 pixels" in str(error)


@pytest.mark.parametrize(
    "place",
    [
        {"scale": (2.0, 1.0)},
        {"translate": (0.0, 0.5)},
        {"rotate": 10.0},
        {"shear": [0.1]},
        {"affine": np.diag([1.0, 1.1, 1.0])},
        {"units": ("mm", "mm")},
    ],
    ids=lambda place: next(iter(place)),
)
def test_layers_at_different_places_are_refused_with_both_names(place):
    error = refusal(request(boundary=Labels(boundary_labels(), name="Boundary", **place)))
    assert error.field == "Boundary"
    assert "is not on the grid of 'MR'" in error.message


def test_equivalent_descriptions_of_a_place_are_the_same_place():
    tissue = Labels(tissue_labels(), name="Tissue", affine=np.diag([2.0, 1.0, 1.0]))
    boundary = Labels(boundary_labels(), scale=(2.0, 1.0), units=("pixel", "pixel"))
    image = Image(picture(), scale=(2.0, 1.0), translate=(1e-9, 0.0))
    assert read_layers(request(image=image, tissue=tissue, boundary=boundary)).notes == ()


def test_equal_lengths_in_micrometres_and_millimetres_are_the_same_place():
    image = Image(picture(), scale=(1.0, 1.0), units=("mm", "mm"))
    place = {"scale": (1000.0, 1000.0), "units": ("um", "um")}
    tissue = Labels(tissue_labels(), **place)
    boundary = Labels(boundary_labels(), **place)
    inputs = read_layers(request(image=image, tissue=tissue, boundary=boundary))
    assert inputs.problem.spacing == pytest.approx((1.0, 1.0))


def test_an_image_is_in_colour_if_its_layer_has_colours():
    small = np.zeros((*SHAPE, 3), np.uint8)
    inputs = read_layers(request(image=Image(small, rgb=True)))
    assert inputs.pictures.image.shape == (*SHAPE, 3)


def test_a_colour_image_is_refused_as_stiffness():
    tissue = Image(np.ones((*SHAPE, 3), np.uint8), rgb=True, name="photo")
    error = refusal(request(tissue=tissue))
    assert "'photo'" in str(error)
    assert "colour" in str(error)


def test_an_image_can_be_the_stiffness():
    tissue = Image(tissue_labels().astype(float) * 3, name="stiffness")
    inputs = read_layers(request(tissue=tissue))
    assert inputs.problem.stiffness[5, 9] == 6
    assert inputs.pictures.labels is None


@pytest.mark.parametrize(("value", "said"), [(-1.0, "negative"), (np.nan, "NaN")])
def test_an_invalid_stiffness_is_refused_with_the_name_of_its_layer(value, said):
    m = np.ones(SHAPE)
    m[3, 4] = value
    error = refusal(request(tissue=Image(m, name="stiffness", contrast_limits=(0, 1))))
    assert str(error).startswith("'stiffness' has ")
    assert said in str(error)
    assert "(3, 4)" in str(error)


BONE = (*MATERIALS, Material(3, "bone", np.inf))


def with_bone(tissue=None):
    """Return a request with rigid tissue, in an image of stiffness or in labels and table."""
    if tissue is None:
        painted = tissue_labels()
        painted[5:8, 4:7] = 3
        tissue = Labels(painted, name="Tissue")
    return replace(request(tissue=tissue), materials=BONE)


def stiffness_with_bone():
    m = np.ones(SHAPE)
    m[5:8, 4:7] = np.inf
    return Image(m, name="stiffness", contrast_limits=(0, 1))


@pytest.mark.parametrize("made", [lambda: None, stiffness_with_bone], ids=["labels", "image"])
def test_rigid_tissue_is_infinitely_stiff_in_the_elastic_problem(made):
    m = read_layers(with_bone(made()), ElasticPrior()).problem.stiffness
    assert np.isinf(m[5:8, 4:7]).all()
    assert np.isinf(m).sum() == 9


def test_a_stiffness_beyond_single_precision_is_refused_with_its_largest_value():
    m = np.full(SHAPE, 1e39)
    error = refusal(request(tissue=Image(m, name="stiffness", contrast_limits=(0, 1))))
    assert "1e+39" in str(error)


def test_an_extreme_stiffness_ratio_is_refused():
    m = np.ones(SHAPE)
    m[0, 0] = 1e9
    assert "million times" in str(refusal(request(tissue=Image(m, name="stiffness"))))


def test_an_unpainted_boundary_is_refused_with_the_name_of_its_layer():
    error = refusal(request(boundary=Labels(np.zeros(SHAPE, np.uint8), name="Boundary")))
    assert str(error) == (
        "'Boundary' has no paint yet. Choose a row, then paint a region that is fixed or moved."
    )


def test_errors_name_layers_instead_of_symbols_of_the_solver():
    void = request()
    airy = tuple(Material(label, "air", 0.0) for label in range(3))
    error = refusal(replace(void, materials=airy))
    assert str(error).startswith("'Tissue' is 0 everywhere: there is no tissue")
    unsure = tuple(BoundaryRule(label, "fixed", confidence=(0.0, 0.0)) for label in (1, 2))
    error = refusal(replace(void, rules=unsure))
    assert str(error).startswith("'Boundary' is 0 everywhere: nothing determines how tissue moves")


def test_a_boundary_only_in_void_is_refused():
    boundary = np.zeros(SHAPE, np.uint8)
    boundary[0] = 1
    error = refusal(request(boundary=Labels(boundary, name="Boundary")))
    assert "'Boundary'" in str(error)
    assert "no tissue" in str(error)


def test_a_note_counts_boundary_pixels_outside_tissue():
    boundary = boundary_labels()
    boundary[0, :4] = 1
    inputs = read_layers(request(boundary=Labels(boundary)))
    assert inputs.notes[0] == "4 boundary pixels outside tissue were ignored"


def test_a_note_reports_tissue_that_touches_no_boundary():
    tissue = tissue_labels((12, 30))
    tissue[:, 14:16] = 0
    boundary = np.zeros((12, 30), np.uint8)
    boundary[2:-2, 2] = 1
    inputs = read_layers(request((12, 30), tissue=Labels(tissue), boundary=Labels(boundary)))
    assert any("touches no boundary" in note for note in inputs.notes)


def test_an_image_with_nan_causes_a_note_and_an_image_of_only_nan_is_refused():
    holes = picture()
    holes[0, :3] = np.nan
    (note,) = read_layers(request(image=Image(holes, name="MR"))).notes
    assert note.startswith("'MR' is NaN or infinite at 3 pixels")
    nothing = Image(np.full(SHAPE, np.nan), name="MR", contrast_limits=(0, 1))
    assert "'MR'" in str(refusal(request(image=nothing)))


def test_a_constant_image_is_accepted():
    assert read_layers(request(image=Image(np.full(SHAPE, 7)))).pictures.image.min() == 7


@pytest.mark.parametrize(
    "make",
    [
        lambda a: a.astype(">f4"),
        lambda a: np.asfortranarray(a),
        lambda a: a[::-1][::-1],
        lambda a: np.broadcast_to(a, a.shape),
        lambda a: a.astype(np.float16),
        lambda a: da.from_array(a, chunks=5),
    ],
    ids=["big-endian", "Fortran", "strides", "read-only", "float16", "dask"],
)
def test_the_memory_layout_of_a_stiffness_has_no_effect(make):
    m = tissue_labels().astype(np.float32)
    tissue = Image(make(m), name="stiffness", contrast_limits=(0, 2))
    np.testing.assert_array_equal(read_layers(request(tissue=tissue)).problem.stiffness, m)


def test_a_boolean_mask_is_read_as_tissue():
    mask = tissue_labels() > 0
    assert read_layers(request(tissue=Labels(mask))).problem.stiffness.max() == 20


def test_a_multiscale_image_is_read_at_its_finest_level_with_a_note():
    levels = [picture(), picture()[::2, ::2]]
    inputs = read_layers(request(image=Image(levels, multiscale=True)))
    assert inputs.problem.shape == SHAPE
    assert inputs.notes == ("computed on the finest level, 12 x 15",)


def test_one_row_of_pixels_is_accepted_and_one_pixel_is_refused():
    row = np.ones((1, 9), np.uint8)
    ends = np.array([[1, 0, 0, 0, 0, 0, 0, 0, 2]], np.uint8)
    tables = {"materials": MATERIALS, "rules": RULES}
    inputs = read_layers(Request(tissue=Labels(row), boundary=Labels(ends), **tables))
    assert inputs.problem.shape == (1, 9)
    one = Labels(np.ones((1, 1), np.uint8), name="dot")
    assert "single pixel" in str(refusal(Request(tissue=one, boundary=one, **tables)))


@pytest.mark.parametrize("kind", ["numpy", "dask", "multiscale"])
@pytest.mark.parametrize("which", ["image", "tissue", "confidence"])
def test_masked_values_are_refused_with_the_name_of_the_layer(which, kind):
    data = np.ma.masked_array(np.ones(SHAPE), mask=np.zeros(SHAPE, bool))
    data.mask[3, 4:6] = True
    layer = Image(
        {
            "numpy": data,
            "dask": da.from_array(data, chunks=5),
            "multiscale": [data, data[::2, ::2]],
        }[kind],
        name="holes",
        contrast_limits=(0, 1),
        multiscale=kind == "multiscale",
    )
    wanted = replace(request(boundary=arrow_layer([(5, 3), (1, 1)])), **{which: layer})
    with pytest.raises(ProblemError, match="masked array with 2 masked values") as caught:
        read_layers(wanted)
    assert caught.value.field == "holes"


def test_an_empty_mask_is_accepted():
    m = np.ma.masked_array(np.ones(SHAPE), mask=np.zeros(SHAPE, bool))
    inputs = read_layers(request(image=Image(m), tissue=Image(m)))
    assert type(inputs.pictures.image) is np.ndarray
    np.testing.assert_array_equal(inputs.problem.stiffness, 1)


@pytest.mark.parametrize("which", ["image", "confidence"])
def test_a_mask_on_another_slice_has_no_effect(which):
    data = np.ma.masked_array(np.ones((4, *SHAPE)), mask=np.zeros((4, *SHAPE), bool))
    data.mask[2] = True
    wanted = request((4, *SHAPE), boundary=Vectors([[(0, 5, 3), (0, 1, 1)]]))
    assert read_layers(replace(wanted, hold_edge=True, **{which: Image(data)})).notes == ()


@pytest.mark.parametrize("dtype", [np.int64, np.uint64])
def test_the_largest_integers_are_a_valid_stiffness(dtype):
    m = np.full(SHAPE, np.iinfo(dtype).max)
    inputs = read_layers(request(tissue=Image(m, name="stiffness", contrast_limits=(0, 1))))
    assert (inputs.problem.stiffness == np.float32(np.iinfo(dtype).max)).all()


class Unreadable:
    """Array that raises an error on reading."""

    shape, dtype, ndim = SHAPE, np.dtype("float32"), 2

    def __init__(self):
        self.gone = None

    def __getitem__(self, key):
        if self.gone is not None:
            raise self.gone
        return picture()[key]

    def __array__(self, dtype=None, copy=None):
        return picture()


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        (OSError("no such file"), "no such file"),
        (ZeroDivisionError("chunk 3"), "chunk 3"),
        (AssertionError(), "AssertionError"),
        (MemoryError(), "MemoryError"),
        (type("ReaderError", (Exception,), {})("bad magic."), "bad magic"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_unreadable_file_is_refused_with_the_name_of_its_layer(gone, said):
    data = Unreadable()
    image = Image(data, name="far away", contrast_limits=(0, 1))
    data.gone = gone
    with pytest.raises(ProblemError, match=rf"'far away'.*could not be read: {said}\. Check"):
        read_layers(request(image=image))


# Arrows as boundary


def arrow_layer(*arrows, **place):
    return Vectors(np.array(arrows, dtype=float).reshape(-1, 2, 2), ndim=2, name="arrows", **place)


def test_arrows_are_observed_in_the_unit_of_the_image():
    place = {"scale": (1.0, 2.0)}
    boundary = arrow_layer([(5, 3), (1, 1.5)], [(6, 4), (0, 0)], **place)
    inputs = read_layers(request(boundary=boundary, **place))
    np.testing.assert_array_equal(inputs.problem.observed[5, 3], [1, 3])
    assert (inputs.problem.confidence > 0).all(axis=-1).sum() == 2


def test_confidence_can_be_an_image():
    boundary = arrow_layer([(5, 3), (1, 1)], [(6, 4), (0, 1)])
    sure = np.full(SHAPE, 0.25)
    wanted = replace(request(boundary=boundary), confidence=Image(sure, name="sure"))
    c = read_layers(wanted).problem.confidence
    np.testing.assert_array_equal(c[5, 3], [0.25, 0.25])
    assert (c > 0).sum() == 4
    wanted.confidence.data = sure * 8
    error = refusal(wanted)
    said = "'sure' has values at 2 pixels outside 0 to 1, the first at (5, 3). Scale the confidence"
    assert said in str(error)


@pytest.mark.parametrize(
    ("arrows", "said"),
    [
        ([[(40, 3), (1, 1)]], "vector 0 at (40, 3)"),
        ([[(5, 3), (1, 1)], [(5.2, 3), (2, 1)]], "vector 0 at (5, 3)"),
        ([], "'arrows' is 0 everywhere: nothing determines how tissue moves"),
    ],
    ids=["outside", "conflict", "none"],
)
def test_unusable_arrows_are_refused_by_number(arrows, said):
    error = refusal(request(boundary=arrow_layer(*arrows)))
    assert "'arrows'" in str(error)
    assert said in str(error)


def test_an_arrow_with_nan_is_refused_by_number():
    boundary = arrow_layer([(5, 3), (1, 1)])
    boundary.data[0, 1, 0] = np.nan  # Without an event: napari cannot draw NaN.
    assert "vector 0" in str(refusal(request(boundary=boundary)))


def test_arrows_out_of_the_slice_are_counted_and_do_not_fix_the_tissue():
    """Use only the component of an arrow within the slice, and nothing if there is none."""
    vectors = np.array(
        [
            [(1, 5, 3), (2, 0, 0)],  # Perpendicular to the slice.
            [(1, 6, 3), (2, 1, 0)],  # Out of the slice and down.
            [(1, 7, 3), (0, 0, 0)],  # No motion.
            [(0, 8, 3), (2, 0, 0)],  # On another slice.
        ],
        float,
    )
    viewer = ViewerModel()
    wanted = request((4, *SHAPE), boundary=Vectors(vectors, name="arrows"))
    for layer in wanted.grid_layers:
        viewer.add_layer(layer)
    viewer.dims.set_current_step(0, 1)
    inputs = read_layers(seen(viewer, wanted))
    assert not inputs.problem.confidence[5, 3].any()
    assert inputs.problem.confidence[6, 3].all()
    np.testing.assert_array_equal(inputs.problem.observed[6, 3], (1, 0))
    assert inputs.problem.confidence[7, 3].all()
    assert inputs.notes == ("'arrows' also has displacements out of the slice, which are ignored",)


def test_equal_arrows_in_one_pixel_are_merged():
    boundary = arrow_layer([(5, 3), (1, 1)], [(5, 3), (1, 1)])
    assert read_layers(request(boundary=boundary)).problem.observed[5, 3, 0] == 1


# Stacks


def stack(viewer_shape=(4, *SHAPE), **place):
    viewer = ViewerModel()
    wanted = request(viewer_shape, **place)
    for layer in wanted.grid_layers:
        viewer.add_layer(layer)
    return viewer, wanted


def seen(viewer, wanted):
    return replace(wanted, view=View.of(viewer.dims))


def test_the_displayed_slice_is_read():
    viewer, wanted = stack(scale=(5.0, 1.0, 1.0), translate=(7.0, 0.0, 0.0))
    viewer.dims.set_current_step(0, 2)
    inputs = read_layers(seen(viewer, wanted))
    assert inputs.frame.index == (2, 0, 0)
    assert inputs.frame.slice_name == "slice 2"
    np.testing.assert_array_equal(inputs.pictures.image, picture((4, *SHAPE))[2])


def test_the_slice_is_found_if_viewer_and_layer_have_different_units():
    viewer, wanted = stack(scale=(5.0, 1.0, 1.0), units=("mm", "mm", "mm"))
    viewer.add_image(
        np.zeros((4, *SHAPE)), scale=(5000.0, 1000.0, 1000.0), units=("um", "um", "um")
    )
    viewer.dims.set_current_step(0, 3)
    assert read_layers(seen(viewer, wanted)).frame.index[0] == 3


def test_rolled_axes_select_another_plane_and_swapped_axes_transpose_it():
    viewer, wanted = stack((12, *SHAPE))
    viewer.dims.set_current_step(0, 5)
    upright = read_layers(seen(viewer, wanted))
    viewer.dims.order = (0, 2, 1)
    turned = read_layers(seen(viewer, wanted))
    np.testing.assert_array_equal(turned.pictures.image, upright.pictures.image.T)
    np.testing.assert_array_equal(turned.problem.stiffness, upright.problem.stiffness.T)
    viewer.dims.order = (1, 0, 2)
    viewer.dims.set_current_step(1, 4)
    other = read_layers(seen(viewer, wanted))
    np.testing.assert_array_equal(other.pictures.image, wanted.image.data[:, 4])


def test_a_slice_outside_the_layer_is_refused():
    viewer, wanted = stack()
    viewer.add_image(np.zeros((9, *SHAPE)))
    viewer.dims.set_current_step(0, 8)
    error = refusal(seen(viewer, wanted))
    assert "slice 8" in str(error)
    assert "'MR'" in str(error)


def test_an_error_names_an_axis_that_a_layer_lacks():
    viewer, wanted = stack(SHAPE)
    viewer.add_image(np.zeros((4, *SHAPE)))
    viewer.dims.order = (1, 0, 2)
    assert "world axis 0" in str(refusal(seen(viewer, wanted)))


def test_two_dimensional_labels_apply_to_every_slice():
    viewer, wanted = stack()
    tissue, boundary = Labels(tissue_labels()), Labels(boundary_labels())
    flat = replace(seen(viewer, wanted), tissue=tissue, boundary=boundary)
    assert read_layers(flat).frame.ndim == 3


def test_labels_with_an_additional_axis_are_read_at_the_displayed_slice():
    viewer = ViewerModel()
    labels = np.zeros((4, *SHAPE), np.uint8)
    labels[2] = tissue_labels()
    wanted = request(tissue=Labels(labels, name="Tissue", axis_labels=("z", "y", "x")))
    for layer in wanted.grid_layers:
        viewer.add_layer(layer)
    viewer.dims.set_current_step(0, 2)
    inputs = read_layers(seen(viewer, wanted))
    assert inputs.frame.slice_name == ""
    np.testing.assert_array_equal(inputs.pictures.labels, tissue_labels())


@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")
def test_an_oblique_slice_is_refused():
    tilted = Image(picture((4, *SHAPE)), rotate=(0.0, 20.0, 0.0), name="tilted")
    viewer = ViewerModel()
    viewer.add_layer(tilted)
    wanted = Request(tissue=tilted, boundary=tilted, view=View.of(viewer.dims))
    assert "at an oblique angle" in str(refusal(wanted))


def test_only_one_slice_of_a_lazy_stack_is_computed():
    touched = []

    def block(block_info=None):
        touched.append(block_info[None]["chunk-location"][0])
        return picture((1, *SHAPE))

    lazy = da.map_blocks(
        block,
        dtype=np.float32,
        chunks=((1,) * 6, (SHAPE[0],), (SHAPE[1],)),
        meta=np.zeros((0,) * 3),
    )
    image = Image(lazy, contrast_limits=(0, 1), name="lazy")
    viewer = ViewerModel()
    viewer.add_layer(image)
    viewer.dims.set_current_step(0, 4)
    touched.clear()
    read_layers(seen(viewer, request(image=image)))
    assert set(touched) == {4}


def test_a_frame_is_restored_from_json():
    viewer, wanted = stack(scale=(5.0, 0.5, 1.0), units=("mm", "mm", "mm"))
    frame = frame_of(wanted.image, View.of(viewer.dims))
    assert Frame.from_dict(json.loads(json.dumps(frame.as_dict()))) == frame
    with pytest.raises(ValueError, match="invalid slice position"):
        Frame.from_dict({"plane": [0, 1]})


@pytest.mark.parametrize(("width", "thin"), [(1, True), (3, False), (6, False)])
def test_a_note_reports_a_boundary_too_thin_for_coarse_levels(width, thin):
    rows, cols = np.mgrid[:160, :160]
    r = np.hypot(rows - 80, cols - 80)
    labels = ((r > 50) & (r <= 50 + width)).astype(np.uint8)
    wanted = request(
        (160, 160),
        tissue=Labels(np.ones((160, 160), np.uint8), name="Tissue"),
        boundary=Labels(labels, name="Boundary"),
    )
    told = any("at least 3 pixels wide" in note for note in read_layers(wanted).notes)
    assert told == thin
