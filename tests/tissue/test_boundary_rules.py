"""Tests of the images that painted labels and tables are converted to."""

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    boundary_images,
    poisson_image,
    stiffness_image,
    stiffness_in_words,
    unlisted,
)
from napari_hmrf.tissue.material_presets import PRESETS

TISSUES = [Material(0, "air", 0.0), Material(1, "normal", 20.0), Material(7, "tumour", 40.0)]


def _ellipse(shape, radii, spacing=(1.0, 1.0)):
    """Return a filled ellipse and the outward unit normals of concentric similar ellipses."""
    axes = [
        (np.arange(size) - (size - 1) / 2) * step for size, step in zip(shape, spacing, strict=True)
    ]
    row, col = np.meshgrid(*axes, indexing="ij")
    inside = (row / radii[0]) ** 2 + (col / radii[1]) ** 2 <= 1
    normal = np.stack([row / radii[0] ** 2, col / radii[1] ** 2], axis=-1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return inside, normal / np.where(length > 0, length, 1)


def _rim(filled, width):
    return filled & ~ndimage.binary_erosion(filled, iterations=width)


def _angles(found, expected):
    """Return the angles between two fields of vectors, in degrees."""
    cosine = (found * expected).sum(axis=-1) / np.linalg.norm(found, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_every_pixel_has_the_stiffness_of_its_material():
    labels = np.array([[0, 1], [7, 1]], dtype=np.uint8)
    for stored in (labels, labels.astype(np.float32)):  # MONAI reads labels as floats
        m = stiffness_image(stored, TISSUES)
        assert m.dtype == np.float32
        np.testing.assert_array_equal(m, [[0, 20], [40, 20]])


def test_an_error_names_all_labels_without_a_stiffness():
    with pytest.raises(ProblemError, match="labels without a material: 3, 9") as caught:
        stiffness_image(np.array([[1, 3], [9, 1]]), TISSUES)
    assert caught.value.field == "stiffness"


def test_two_materials_for_a_label_are_refused():
    with pytest.raises(ProblemError, match="two materials for label 1"):
        stiffness_image(np.ones((3, 3), int), [*TISSUES, Material(1, "again", 3.0)])


def test_a_rigid_material_is_infinitely_stiff_and_has_no_poisson_ratio():
    materials = [
        Material(0, "air", 0.0),
        Material(1, "bone", np.inf),
        Material(2, "gel", 3.0, 0.3),
        Material(3, "fat", 2.0, 0.4),
    ]
    labels = np.array([[0, 1], [2, 1]])
    np.testing.assert_array_equal(stiffness_image(labels, materials), [[0, np.inf], [3, np.inf]])
    assert poisson_image(labels, materials) == 0.3
    labels = np.array([[0, 1], [2, 3]])
    np.testing.assert_array_equal(
        poisson_image(labels, materials), np.float32([[0, 0], [0.3, 0.4]])
    )


def test_the_text_of_a_stiffness_is_rigid_instead_of_inf():
    assert stiffness_in_words(np.inf, "kPa") == "rigid"
    assert stiffness_in_words(2.5, "kPa") == "2.5 kPa"
    assert stiffness_in_words(2.5) == "2.5"


@pytest.mark.parametrize("labels", [np.full((3, 3), 1.5), np.ones((3, 3, 3, 3), int)])
def test_labels_must_be_an_image_of_whole_numbers(labels):
    with pytest.raises(ProblemError):
        stiffness_image(labels, TISSUES)
    with pytest.raises(ProblemError):
        boundary_images(labels, [BoundaryRule(1, "fixed")], spacing=1)


def test_a_volume_accepts_tissues_and_rules():
    labels = np.ones((3, 3, 3), int)
    assert stiffness_image(labels, TISSUES).shape == (3, 3, 3)
    y, c = boundary_images(labels, [BoundaryRule(1, "fixed")], spacing=1)
    assert y.shape == c.shape == (3, 3, 3, 3)


def test_a_mask_is_a_label_image():
    mask = np.eye(3, dtype=bool)
    np.testing.assert_array_equal(stiffness_image(mask, TISSUES), np.eye(3) * 20)


def test_fixed_and_moving_rules_set_displacement_and_confidence():
    labels = np.array([[0, 1, 2], [0, 1, 2]])
    rules = [
        BoundaryRule(1, "fixed", vector=(9.0, 9.0), confidence=(1.0, 0.5)),
        BoundaryRule(2, "move", vector=(-1.5, 2.0)),
    ]
    y, c = boundary_images(labels, rules, spacing=1)
    np.testing.assert_array_equal(y[0], [[0, 0], [0, 0], [-1.5, 2.0]])
    np.testing.assert_array_equal(c[1], [[0, 0], [1, 0.5], [1, 1]])


@pytest.mark.parametrize(("radius", "width"), [(6, 1), (15, 2), (40, 3)])
def test_a_ring_expands_radially(radius, width):
    disc, radial = _ellipse((101, 103), (radius, radius))
    painted = _rim(disc, width)
    y, c = boundary_images(painted.astype(int), [BoundaryRule(1, "expand", amount=3.0)], spacing=1)
    assert ((c > 0).all(axis=-1) == painted).all()
    np.testing.assert_allclose(np.linalg.norm(y[painted], axis=-1), 3.0, rtol=1e-5)
    angles = _angles(y[painted], radial[painted])
    assert angles.max() < 12
    assert np.sqrt((angles**2).mean()) < 3


@pytest.mark.parametrize(("radius", "hole"), [(40, 0.1), (15, 4.0)])
def test_a_patch_that_expands_prescribes_only_its_rim(radius, hole):
    disc, radial = _ellipse((101, 103), (radius, radius))
    painted = disc & ~_ellipse(disc.shape, (hole, hole))[0]
    y, c = boundary_images(painted.astype(int), [BoundaryRule(1, "expand", amount=3.0)], spacing=1)
    seen = (c > 0).all(axis=-1)
    assert (seen == _rim(disc, 2)).all()
    assert not y[~seen].any()
    assert not c[~seen].any()
    assert _angles(y[seen], radial[seen]).max() < 12


@pytest.mark.parametrize(
    ("radii", "spacing"),
    [
        ((30.0, 18.0), (1.0, 1.0)),
        ((20.0, 20.0), (0.5, 2.0)),
        ((18.0, 40.0), (0.5, 2.0)),
        ((30.0, 18.0), (3.0, 1.0)),
    ],
)
def test_an_outline_expands_along_its_normal_in_physical_lengths(radii, spacing):
    shape = tuple(int(100 / step) | 1 for step in spacing)
    filled, normal = _ellipse(shape, radii, spacing)
    rim = _rim(filled, 2)
    y, c = boundary_images(
        rim.astype(int), [BoundaryRule(1, "expand", amount=2.0)], spacing=spacing
    )
    assert (c[rim] == 1).all()
    angles = _angles(y[rim], normal[rim])
    assert angles.max() < 20
    assert np.sqrt((angles**2).mean()) < 6
    assert np.abs(angles.mean()) < 5


def test_a_negative_amount_shrinks():
    disc, radial = _ellipse((41, 41), (12, 12))
    rim = _rim(disc, 2)
    y, _ = boundary_images(rim.astype(int), [BoundaryRule(1, "expand", amount=-1.0)], spacing=1)
    assert (_angles(y[rim], -radial[rim]) < 12).all()


def test_each_part_expands_from_its_own_centre():
    disc, _radial = _ellipse((41, 41), (12, 12))
    rim = _rim(disc, 2)
    two = np.hstack([rim, rim])
    y, _ = boundary_images(two.astype(int), [BoundaryRule(1, "expand", amount=1.0)], spacing=1)
    np.testing.assert_array_equal(y[:, :41], y[:, 41:])


def test_a_rim_cut_by_the_image_edge_is_an_open_line():
    """Refuse an arc: it has no outside, and a guessed direction would tear it apart."""
    disc, _ = _ellipse((41, 41), (12, 12))
    arc = _rim(disc, 2)
    arc[:20] = False
    with pytest.raises(ProblemError, match="open line"):
        boundary_images(arc.astype(int), [BoundaryRule(1, "expand", amount=1.0)], spacing=1)


@pytest.mark.parametrize(
    ("width", "spacing"),
    [(1, (1.0, 1.0)), (2, (0.5, 2.0)), (3, (1.0, 1.0)), (8, (0.5, 2.0)), (40, (1.0, 1.0))],
)
def test_an_open_line_is_refused_for_every_width_of_the_brush(width, spacing):
    """Refuse an open line, whose two halves would move apart."""
    length = round(10 * width * spacing[1] / spacing[0])
    line = np.zeros((length + 2, width + 4), int)
    line[1:-1, 2:-2] = 1
    with pytest.raises(
        ProblemError, match=r"open line.*Close.*ring.*\(`action='move'`\)"
    ) as caught:
        boundary_images(line, [BoundaryRule(1, "expand", amount=1.0)], spacing=spacing)
    assert caught.value.field == "observed"


@pytest.mark.parametrize("width", [4, 8, 16])
def test_an_arc_of_any_brush_width_is_refused_and_a_closed_ring_is_accepted(width):
    disc, _ = _ellipse((301, 301), (110, 110))
    ring = _rim(disc, width)
    rule = BoundaryRule(1, "expand", amount=1.0)
    assert boundary_images(ring.astype(int), [rule], spacing=1)[1].any()
    ring[: 40 + width, 145:156] = False  # A gap of a few pixels opens the ring.
    with pytest.raises(ProblemError, match="open line"):
        boundary_images(ring.astype(int), [rule], spacing=1)


@pytest.mark.parametrize(
    ("shape", "scale"), [((1, 2), 1), ((2, 2), 2), ((2, 5), 5), ((3, 12), 2), ((6, 30), 1)]
)
def test_a_compact_patch_of_any_size_is_no_open_line(shape, scale):
    labels = np.zeros((40 * scale, 40 * scale), int)
    labels[3 : 3 + shape[0] * scale, 3 : 3 + shape[1] * scale] = 1
    boundary_images(labels, [BoundaryRule(1, "expand", amount=1.0)], spacing=1)


def test_a_disc_at_the_image_edge_expands_beyond_the_edge():
    disc, _radial = _ellipse((41, 41), (12, 12))
    y, _ = boundary_images(
        disc[20:].astype(int), [BoundaryRule(1, "expand", amount=1.0)], spacing=1
    )
    assert y[0, 20, 0] == pytest.approx(-1, abs=1e-3)


def test_a_single_pixel_does_not_expand():
    labels = np.zeros((5, 5), int)
    labels[2, 2] = 1
    _, c = boundary_images(labels, [BoundaryRule(1, "expand", amount=1.0)], spacing=1)
    assert not c.any()


def test_an_error_names_boundary_labels_without_a_rule():
    with pytest.raises(ProblemError, match="labels without a rule: 4"):
        boundary_images(np.array([[4, 0]]), [BoundaryRule(1, "fixed")], spacing=1)


def test_a_rule_with_three_components_is_refused_for_an_image():
    rule = BoundaryRule(1, "move", vector=(1, 2, 3))
    with pytest.raises(ProblemError, match=r"the vector \(1.*\)\. Use \(row, col\)\."):
        boundary_images(np.ones((4, 4), int), [rule], spacing=1)


def test_every_preset_has_a_source_a_unit_and_valid_materials():
    names = [preset.name for preset in PRESETS]
    assert len(set(names)) == len(names)
    for preset in PRESETS:
        about = f"the preset {preset.name!r} in sample_data/materials.json"
        assert preset.source, f"{about} has no source"
        assert "Poisson" in preset.source, f"{about} does not state where Poisson's ratio is from"
        unit = "" if preset is PRESETS[0] else "kPa"  # the paper has only ratios
        assert preset.unit == unit, about
        labels = [material.label for material in preset.materials]
        assert labels == list(range(1, len(labels) + 1)), about
        for material in preset.materials:
            assert material.name, about
            assert 0 < material.stiffness < 1000, f"{about}: is {material} in kPa?"
            assert 0 <= material.poisson <= 0.49, f"{about}: {material}"
    paper = {material.name: material.stiffness for material in PRESETS[0].materials}
    assert paper == {"normal tissue": 20.0, "soft tissue": 10.0, "tumour": 40.0}


#: Label images of each type, with its extreme values.
LABEL_IMAGES = [
    np.array([[0, 3], [3, 250]], np.uint8),
    np.array([[-128, 127], [0, 5]], np.int8),
    np.array([[-7, 2], [2, -7]], np.int64),
    np.array([[2**63 - 1, 2**63 - 3], [2**63 - 1, 2**63 - 1]], np.int64),
    np.array([[2**64 - 1, 2**64 - 2], [2**64 - 1, 2**64 - 1]], np.uint64),
    np.array([[-(2**63), 2**63 - 1], [0, 1]], np.int64),
    np.array([[0, 2**40], [5, 5]], np.int64),
    np.array([[True, False], [False, False]]),
    np.array([[4, 4], [4, 4]], ">i4"),
    np.zeros((0, 3), np.uint8),
]


@pytest.mark.parametrize(
    "image", LABEL_IMAGES, ids=lambda image: f"{image.dtype}-{image.max(initial=0)}"
)
def test_each_pixel_has_the_stiffness_of_its_label(image):
    labels = sorted({int(label) for label in image.flat})
    materials = [Material(label, "", 10 + number) for number, label in enumerate(labels)]
    found = stiffness_image(image, materials)
    assert found.dtype == np.float32
    wanted = [10 + labels.index(int(label)) for label in image.flat]
    np.testing.assert_array_equal(found.ravel(), wanted)


@pytest.mark.parametrize(
    "image", LABEL_IMAGES, ids=lambda image: f"{image.dtype}-{image.max(initial=0)}"
)
def test_labels_without_a_row_are_listed(image):
    labels = sorted({int(label) for label in image.flat})
    assert unlisted(image, [Material(label, "", 1) for label in labels[1:]]) == labels[:1]
