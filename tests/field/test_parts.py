"""Folds, strain and grids of tissue whose parts slide along each other."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from napari_hmrf import Pictures, Problem, ProblemError, Solution, solve
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.warp import inverse_map_and_overlaps, warp
from napari_hmrf.fields import (
    count_folds,
    deformation_gradient,
    deformation_grid,
    fold_mask,
    jacobian_determinant,
    measure,
    small_strain,
)
from napari_hmrf.io.apply import FieldFile
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.results.animation import marked_sites
from napari_hmrf.results.quantities import area_change, values_of
from napari_hmrf.results.tissue_point import Points
from napari_hmrf.tissue import SlidingParts

SLIP = 15.0


def halves(shape):
    """Return two blocks that slide along an oblique plane, and their motion along it."""
    place = np.moveaxis(np.indices(shape), 0, -1) - np.array(shape) / 2
    normal = np.array([0.3, 1.0, 0.2])[-len(shape) :]
    along = np.array([0.0, -0.2, 1.0])[-len(shape) :]
    upper = place @ normal < 0
    return upper.astype(int), np.where(upper[..., None], SLIP, 0) * along


@pytest.mark.parametrize("shape", [(30, 40), (8, 12, 20)])
def test_a_slip_is_neither_a_fold_nor_a_strain(shape):
    parts, slipped = halves(shape)
    assert count_folds(slipped, spacing=1) > 10
    assert abs(small_strain(slipped, spacing=1)).max() > 1
    assert count_folds(slipped, spacing=1, parts=parts) == 0
    assert not fold_mask(slipped, spacing=1, parts=parts).any()
    assert abs(small_strain(slipped, spacing=1, parts=parts)).max() < 1e-12
    assert (jacobian_determinant(slipped, spacing=1, parts=parts) == 1).all()


@pytest.mark.parametrize("shape", [(30, 40), (8, 12, 20)])
def test_a_fold_inside_a_part_is_counted_beside_a_slip(shape):
    parts, d = halves(shape)
    deep = (2,) * len(shape)
    assert parts[deep] == 1
    d[deep] += 1.7  # the site passes its neighbours
    alone = fold_mask(d, spacing=1, tissue=parts == 1)
    assert alone[deep]
    np.testing.assert_array_equal(fold_mask(d, spacing=1, parts=parts), alone)
    assert count_folds(d, spacing=1, parts=parts) == alone.sum() > 1


def test_strain_at_the_interface_is_that_of_its_own_side():
    parts, slipped = halves((20, 20))
    stretch = np.where(parts[..., None], 0.1, -0.05) * np.moveaxis(np.indices((20, 20)), 0, -1)
    found = deformation_gradient(slipped + stretch, spacing=1, parts=parts)
    expected = np.where(parts[..., None, None], 1.1, 0.95) * np.eye(2)
    both = [np.diff(parts, axis=axis) == 0 for axis in (0, 1)]
    inner = np.ones((20, 20), bool)  # with a neighbour of its part along both axes
    for axis, same in enumerate(both):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        joined = np.pad(same, pad)
        inner &= joined.take(range(20), axis) | joined.take(range(1, 21), axis)
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-5)


def test_no_line_of_a_grid_crosses_the_slip():
    parts, slipped = halves((40, 40))
    whole = deformation_grid(slipped, spacing=1, every=8)
    cut = deformation_grid(slipped, spacing=1, every=8, parts=parts)
    longest = [np.linalg.norm(lines[:, 1], axis=1).max() for lines in (whole, cut)]
    assert longest[0] > SLIP / 2
    assert longest[1] <= 2
    assert len(cut) > 0.8 * len(whole)


@pytest.mark.parametrize("shape", [(30, 40), (8, 12, 20)])
def test_each_part_of_a_slipped_image_shows_its_own_tissue(shape):
    parts, d = halves(shape)
    bands = np.indices(shape)[-1] // 4 % 2
    image = (np.where(parts == 1, 100, 200) + 20 * bands).astype(np.uint8)
    moved = warp(image, d, spacing=1, order=0, parts=parts)
    source, _, overlaps = inverse_map_and_overlaps(d, 1, None, parts)
    assert not overlaps.any()
    assert inverse_map_and_overlaps(d, 1)[2].any(), "stretched cells would overlap"
    # A rigid part is its own image, moved by whole or half pixels.
    step = d[parts == 1][0]
    for number, shift in ((0, np.zeros_like(step)), (1, step)):
        origin = np.moveaxis(np.indices(shape), 0, -1) - shift
        near = np.rint(origin).astype(int)
        inside = ((near >= 0) & (near < shape)).all(axis=-1)
        at = tuple(np.where(inside[..., None], near, 0).reshape(-1, len(shape)).T)
        own = inside & (parts[at].reshape(shape) == number)
        deep = scipy.ndimage.binary_erosion(own, np.ones((3,) * len(shape)))
        assert deep.sum() > 20
        np.testing.assert_allclose(source[deep], origin[deep], atol=1e-9)
        np.testing.assert_array_equal(moved[deep] > 150, number == 0)
    (again,) = Warper(Picture(image, order=0), spacing=(1,) * len(shape))(d, parts=parts)
    np.testing.assert_array_equal(again, moved)


def test_parts_that_move_onto_each_other_overlap():
    parts = np.zeros((20, 30), int)
    parts[:, 15:] = 1
    d = np.zeros((20, 30, 2))
    d[:, 15:, 1] = -5
    overlaps = inverse_map_and_overlaps(d, 1, None, parts)[2]
    assert overlaps[:, 12].all()
    assert not overlaps[:, :8].any()
    d[:, 15:, 1] = -1
    assert not inverse_map_and_overlaps(d, 1, None, parts)[2].any()
    d[:, 15:, 1] = -2
    origin, _, overlaps = inverse_map_and_overlaps(d, 1, None, parts)
    assert not overlaps.any()
    again = inverse_map_and_overlaps(d, 1, None, 1 - parts)
    np.testing.assert_array_equal(again[0], origin, "the order of the labels matters")


@pytest.fixture(scope="module")
def slipped():
    """Return the solution of two blocks, held and pushed along an oblique interface."""
    parts, moved = halves((48, 64))
    rows = np.indices(parts.shape)[0]
    sure = np.repeat(((rows < 6) | (rows > 41))[..., None], 2, axis=-1).astype(float)
    problem = Problem(
        observed=moved, confidence=sure, stiffness=np.ones(parts.shape), sliding=SlidingParts(parts)
    )
    return solve(problem, backend="cpu")


def test_a_solution_reports_no_folds_and_little_strain_at_a_long_slip(slipped, tmp_path):
    assert count_folds(slipped.displacement, spacing=1, tissue=slipped.tissue) > 20
    again = Solution.read(slipped.write(tmp_path / "slipped"))
    np.testing.assert_array_equal(again.parts, slipped.parts)
    for found in (slipped, again):
        assert found.count_folds() == 0
        assert abs(found.strain()).max() < 0.05
        assert abs(found.strain("total")).max() < 0.05
        (row,) = measure(found, np.ones(found.tissue.shape, int))
        assert row.folds == 0
        assert abs(row.size_change) < 0.5
    outputs = result_layers(slipped, pictures=Pictures(np.ones(slipped.tissue.shape)))
    assert (outputs.folds, outputs.overlaps) == (0, 0)
    assert not marked_sites(slipped).any()
    assert abs(area_change(slipped) - 1).max() < 0.05
    assert abs(values_of(slipped, "equivalent", 0.5)).max() < 5  # per cent
    assert count_folds(FieldFile.of(slipped).displacement, spacing=1, parts=slipped.parts) == 0
    edge = np.argwhere(np.diff(slipped.parts[:, 32]))[0, 0]
    probe = Points(slipped).at((int(edge), 32))
    assert probe is not None
    assert probe.strain < 5


def test_a_solution_reports_folds_inside_a_sliding_part(slipped):
    moved = slipped.displacement.copy()
    moved[20, 30, 1] += 3
    folded = replace(slipped, displacement=moved)
    assert 0 < folded.count_folds() < 10
    assert result_layers(folded).folds == folded.count_folds()


def test_parts_of_another_size_are_refused_by_name():
    parts, slipped = halves((8, 8))
    with pytest.raises(ProblemError, match="parts: have shape"):
        count_folds(slipped, spacing=1, parts=parts[1:])
    with pytest.raises(ProblemError, match=r"parts: have the value 0\.5"):
        count_folds(slipped, spacing=1, parts=parts / 2)
