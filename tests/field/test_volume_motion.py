"""Motion of volumes applied to pictures, slices, points, other grids and measurements."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from napari_hmrf import ProblemError, warp
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field import tetrahedron_raster
from napari_hmrf.field.deformation import jacobian_determinant, spread
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.inverse_point import inverse_point
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.resample import emptiness
from napari_hmrf.field.strain import (
    equivalent_strain,
    green_lagrange_strain,
    principal_strains,
)
from napari_hmrf.fields import inverse_map
from napari_hmrf.geometry import Geometry
from napari_hmrf.results.animation import Motion
from napari_hmrf.results.comparison import compare
from napari_hmrf.results.measurement import measure
from napari_hmrf.results.observation import PixelField, arrow_observation
from napari_hmrf.results.other_grid import OtherGrid
from napari_hmrf.results.quantities import area_change, coloured, title_and_unit, values_of
from napari_hmrf.results.tissue_point import Points
from napari_hmrf.solver.solution import Provenance, Solution

SHAPE = (14, 15, 16)
SIZE = (1.5, 1.0, 0.7)


def places(shape=SHAPE):
    return np.moveaxis(np.indices(shape, dtype=float), 0, -1)


def rough_field(seed, amplitude=1.5, shape=SHAPE):
    """Return waves, a shift and noise that folds some tissue."""
    random = np.random.default_rng(seed)
    deep, row, col = np.moveaxis(places(shape) / 3, -1, 0)
    waves = np.stack([np.sin(row + col), np.cos(deep - row), np.sin(deep + 1.3 * col)], axis=-1)
    noise = random.uniform(-1, 1, (*shape, 3)) * random.choice([0, 0.3, 1])
    return (amplitude * (waves + noise + random.uniform(-1, 1, 3))).astype(np.float32)


def some_tissue(seed, shape=SHAPE):
    """Return a ball with a ragged border, and sheets and lines one voxel thin."""
    random = np.random.default_rng(seed)
    away = (places(shape) - np.array(shape) / 2) / np.array(shape) * 2
    tissue = (away**2).sum(axis=-1) < 0.7
    tissue[:, 2, 3] = tissue[-2] = tissue[:, -1, 4:9] = True
    return tissue ^ (random.random(shape) < 0.03)


def hill(amount=0.8, shape=SHAPE):
    """Return a smooth motion without folds that stays within the volume."""
    part = np.pi * places(shape) / (np.array(shape) - 1)
    height = np.sin(part).prod(axis=-1)
    return amount * np.stack([height, -height, 0.5 * height], axis=-1).astype(np.float32)


def solution(displacement, tissue=None, spacing=SIZE, frame=None):
    tissue = np.ones(displacement.shape[:-1], bool) if tissue is None else tissue
    d = np.where(tissue[..., None], displacement, 0).astype(np.float32)
    return Solution(d, np.zeros(1), (), tissue, spacing, Provenance("cpu", "here"), frame=frame)


def on_thread(job, *arguments, **keywords):
    return compute_thread.submit(partial(job, *arguments, **keywords)).result()


def image_of(kind):
    random = np.random.default_rng(3)
    if kind == "colours":
        return random.integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
    if kind == "labels":
        return random.choice([0, 3, 9], SHAPE).astype(np.int64)
    image = random.normal(size=SHAPE).astype(np.float32)
    if kind == "gaps":
        image[4:6, 7], image[9, 10, 11] = np.nan, np.inf
    return (100 * image).astype(np.int16) if kind == "int16" else image


KINDS = {"float32": 1, "int16": 1, "gaps": 1, "colours": 1, "labels": 0, "smooth": 3}


@pytest.mark.parametrize(("kind", "seed"), [(kind, k % 2) for k, kind in enumerate(KINDS)])
def test_a_warped_slice_matches_the_slice_of_the_warped_volume(kind, seed):
    image, order = image_of(kind), KINDS[kind]
    d, tissue = rough_field(seed), some_tissue(seed)
    warper = Warper(Picture(image, order=order, fill=7), spacing=SIZE)
    part = 0.8 * d.astype(float)
    whole = warp(image, part, spacing=SIZE, tissue=tissue, order=order, fill=7)
    (moved,) = on_thread(warper, d, tissue, 0.8)
    np.testing.assert_array_equal(moved, whole)
    for number in (0, 6, 9, SHAPE[0] - 1):
        (slice_,) = on_thread(warper.slice, number, d, tissue, 0.8)
        assert slice_.dtype == image.dtype
        np.testing.assert_allclose(slice_, whole[number], atol=1e-4, err_msg=str(number))


@pytest.mark.parametrize("shift", [(9.1, 0.4, -3.3), (-40.0, 0.0, 0.0), (0.3, 11.3, 0.0)])
def test_a_slice_shows_tissue_that_moved_in_from_distant_slices(shift):
    image, tissue = image_of("float32"), some_tissue(2)
    d = np.zeros((*SHAPE, 3), np.float32)
    d[:7] = shift
    whole = warp(image, d, spacing=SIZE, tissue=tissue)
    warper = Warper(image, spacing=SIZE)
    for number in range(SHAPE[0]):  # tissue is torn between the resting and the moving planes
        (slice_,) = on_thread(warper.slice, number, d, tissue)
        np.testing.assert_allclose(slice_, whole[number], atol=1e-5, err_msg=str(number))


def test_several_pictures_share_one_motion_and_one_can_be_replaced():
    image, labels = image_of("float32"), image_of("labels")
    warper = Warper([Picture(image), Picture(labels, order=0)], spacing=SIZE)
    d = hill()
    warper.replace(0, Picture(-image))
    one, two = on_thread(warper.slice, 5, d)
    np.testing.assert_allclose(one, warp(-image, d, spacing=SIZE)[5], atol=1e-6)
    np.testing.assert_array_equal(two, warp(labels, d, spacing=SIZE, order=0)[5])


@pytest.mark.parametrize("every", [2, (3, 2, 1)])
def test_a_coarse_motion_is_interpolated_linearly(every):
    matrix = np.array([[0.05, 0.02, 0], [0, -0.04, 0.03], [0.02, 0, 0.05]])
    d = (places() @ matrix.T + (0.7, -0.3, 0.2)).astype(np.float32) * SIZE
    image, tissue = image_of("float32"), np.ones(SHAPE, bool)
    tissue[:, :4] = tissue[:3, 4:9, 5:8] = False
    steps = tuple(np.broadcast_to(every, 3))
    sites = tuple(slice(None, None, step) for step in steps)
    coarse = np.where(tissue[..., None], d, 0)[sites]
    expected = warp(image, d, spacing=SIZE, tissue=tissue)
    (slice_,) = on_thread(Warper(image, spacing=SIZE).slice, 7, coarse, tissue, every=every)
    # Values beyond the last site or next to void are those of the nearest site.
    inner = (slice(8, 11), slice(5, 13))
    np.testing.assert_allclose(slice_[inner], expected[7][inner], atol=1e-3)
    assert np.isclose(slice_, expected[7], atol=0.3).mean() > 0.8


def test_an_animation_moves_a_volume_by_part_of_its_motion():
    image, labels = image_of("float32"), image_of("labels")
    found = solution(hill(), some_tissue(0))
    motion = Motion(found, image, labels)
    rest, half, end = (on_thread(motion.at, part) for part in (0, 0.5, 1))
    np.testing.assert_array_equal(rest.image, image)
    np.testing.assert_array_equal(rest.overlay, labels)
    assert not np.array_equal(half.image, end.image)
    whole = warp(image, found.displacement, spacing=SIZE, tissue=found.tissue, fill=image.min())
    np.testing.assert_allclose(end.image, whole, atol=1e-6)
    strained = Motion(found, overlay=values_of(found, "equivalent"), quantity="equivalent")
    assert on_thread(strained.at, 0.5).overlay.shape == SHAPE


def test_vacated_voxels_get_the_darkest_value_of_a_grey_volume():
    assert emptiness(np.full(SHAPE, -1000), 3) == -1000
    assert emptiness(np.full((*SHAPE, 3), 5), 3) == 0


def test_vacated_pixels_of_a_padded_scan_are_air_rather_than_padding():
    scan = np.full((40, 40), -1000, np.int16)
    scan[10:30, 10:30], scan[:4] = 40, -3024
    assert emptiness(scan) == -1000
    assert emptiness(np.where(scan == -1000, 0, scan)) == -3024, "no air: not a CT image"


@pytest.mark.parametrize("seed", [0, 1])
def test_the_inverse_of_a_point_matches_the_inverse_map(seed):
    d, tissue = rough_field(seed), np.ones(SHAPE, bool)
    tissue[:5] = tissue[:, 8:, :4] = False
    origin, covered = inverse_map(d, spacing=SIZE, tissue=tissue)
    outline = (np.abs(origin - np.rint(origin)) < 1e-9).any(axis=-1)  # also excludes resting tissue
    asked = np.argwhere(covered & ~outline)[::11]
    assert len(asked) > 30
    for at in map(tuple, asked.tolist()):
        found = inverse_point(tuple(map(float, at)), d, SIZE, tissue)
        np.testing.assert_allclose(found, origin[at], atol=1e-6, err_msg=str(at))


def test_masks_in_another_order_of_memory_do_not_compile_the_loops_again():
    displacement, tissue = np.zeros((4, 5, 6, 3)), np.ones((4, 5, 6), bool)
    expected = inverse_map(displacement, spacing=1, tissue=tissue)
    versions = list(tetrahedron_raster.rasterise.compiled.signatures)
    for other in (np.asfortranarray(tissue), np.ones((4, 5, 12), bool)[..., ::2]):
        found = inverse_map(displacement, spacing=1, tissue=other)
        np.testing.assert_array_equal(found[0], expected[0])
    assert tetrahedron_raster.rasterise.compiled.signatures == versions


def test_a_point_just_beyond_the_outermost_sites_belongs_to_their_voxels():
    tissue, shift = np.zeros(SHAPE, bool), np.array([2.3, -1.4, 0.6])
    tissue[4, 5, 2:10] = tissue[8:11, 5:9, 4:9] = True
    d = np.zeros((*SHAPE, 3))
    d[tissue] = shift * SIZE
    for place in ((4.4, 5.3, 6.2), (4, 5, 9.4), (10.4, 8.3, 3.6), (9.5, 6.5, 7.5)):
        found = inverse_point(tuple(place + shift), d, SIZE, tissue)
        assert found == pytest.approx(place)


def test_points_between_voxels_are_inverted_exactly():
    d = hill(2.0)
    points = np.random.default_rng(0).uniform(3, 11, (40, 3))
    for point in moved_points(points, d, spacing=SIZE):
        origin = inverse_point(tuple(point), d, SIZE, np.ones(SHAPE, bool))
        back = moved_points([origin], d, spacing=SIZE)[0]
        np.testing.assert_allclose(back, point, atol=1e-6)
    assert inverse_point((500.0, 3.0, 3.0), d, SIZE, np.ones(SHAPE, bool)) is None
    assert inverse_point((5.0, 5.0, 5.0), d, SIZE, np.zeros(SHAPE, bool)) is None


def test_a_point_reports_the_values_of_its_voxel():
    found = solution(rough_field(1), some_tissue(1))
    points = Points(found)
    jacobian, strain = area_change(found), values_of(found, "equivalent")
    for site in np.argwhere(found.tissue)[::97]:
        at = tuple(site.tolist())
        probe = points.at(tuple(map(float, at)))
        assert probe.site == at
        assert probe.displacement == pytest.approx(found.displacement[at])
        assert probe.length == pytest.approx(np.linalg.norm(found.displacement[at]))
        assert probe.jacobian == pytest.approx(jacobian[at])
        assert probe.strain == pytest.approx(strain[at])
    assert points.at((-5.0, 0.0, 0.0)) is None
    moved = Points(solution(np.full((*SHAPE, 3), (3.0, 0, 0)))).at((8.0, 4.0, 5.0), 1.0)
    assert moved.site == (6, 4, 5)


def test_quantities_of_a_volume_match_the_strain_of_its_sites():
    shape = (19, 5, 6)
    d = 0.1 * np.random.default_rng(0).normal(size=(*shape, 3))
    tissue = np.random.default_rng(1).random(shape) < 0.9
    found = solution(d, tissue)
    strain = green_lagrange_strain(found.displacement, spacing=SIZE, tissue=tissue)
    principal = principal_strains(strain)
    for quantity, expected in {
        "equivalent": equivalent_strain(strain),
        "stretch": principal[..., 0],
        "squeeze": principal[..., 2],
        "rows": strain[..., 1, 1],
        "columns": strain[..., 2, 2],
        "shear": strain[..., 1, 2],
    }.items():
        np.testing.assert_allclose(
            values_of(found, quantity), 100 * expected, rtol=1e-5, err_msg=quantity
        )
        assert coloured(found, quantity).values.shape == shape
    assert title_and_unit("jacobian", found) == ("volume change", "ratio")
    assert title_and_unit("shear", found) == ("total shear strain", "%")
    ratio = jacobian_determinant(found.displacement, spacing=SIZE, tissue=tissue)
    inner = tissue & (ratio > 0.8)
    assert np.isclose(values_of(found, "jacobian"), ratio)[inner].mean() > 0.9


def test_tissue_stretched_by_a_tenth_along_each_axis_is_measured():
    labels = np.ones(SHAPE, int)
    labels[9:] = 4
    one, other = measure(solution(0.1 * places() * SIZE), labels, names={4: "liver"})
    assert (one.pixels, other.name) == (9 * 15 * 16, "liver")
    assert one.size == pytest.approx(one.pixels * np.prod(SIZE))
    assert one.size_change == pytest.approx(100 * (1.1**3 - 1), abs=1e-3)
    assert one.largest_strain == pytest.approx(0, abs=1e-4)
    assert one.folds == 0


def test_marks_of_a_volume_are_spread_one_per_cell():
    where = some_tissue(0)
    found = spread(where, 4)
    assert where[tuple(found.T)].all()
    assert len({tuple(cell) for cell in (found // 4).tolist()}) == len(found)
    assert len(found) == len({tuple(cell) for cell in (np.argwhere(where) // 4).tolist()})


def rotation(degrees=20.0, offset=(3.0, -2.0, 1.0)):
    angle = np.deg2rad(degrees)
    affine = np.eye(4)
    affine[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    affine[:3, 3] = offset
    return affine


def test_a_field_on_another_grid_is_resampled_with_all_components():
    matrix, shift = np.array([[0.02, 0.01, 0], [0, -0.03, 0.02], [0.01, 0, 0.04]]), (1, -2, 0.5)
    # The field is linear in world coordinates, and therefore on every grid.
    own = Frame.at((2.0, 2.5, 3.0), ("mm",) * 3, affine=rotation(-10.0, (-20, -20, -20)))
    shape, here = (24, 22, 20), Frame.at(SIZE, ("mm",) * 3, affine=rotation(), volume=True)

    def world(frame, sites):
        return sites @ np.array(frame.matrix)[:3, :3].T + np.array(frame.matrix)[:3, 3]

    steps = world(own, places(shape)) @ matrix.T + shift
    pixels = steps @ np.linalg.inv(np.array(own.matrix)[:3, :3]).T
    known = PixelField(Field.in_pixels(pixels), own)
    found = known.on(here, SHAPE)
    assert found.known.all()
    assert found.out == 0
    expected = (world(here, places()) @ matrix.T + shift) @ np.array(rotation())[:3, :3]
    np.testing.assert_allclose(found.displacement, expected, atol=1e-4)
    # The result does not depend on the order of the axes.
    order = (2, 0, 1)
    other = known.on(replace(here, plane=order), tuple(SHAPE[axis] for axis in order))
    np.testing.assert_allclose(
        other.displacement, expected.transpose(*order, 3)[..., list(order)], atol=1e-4
    )
    compared = compare(solution(expected), here, known, "truth")
    assert compared.rmsd == pytest.approx(0, abs=1e-4)
    assert compared.difference.shape == SHAPE
    far = replace(here, matrix=tuple(map(tuple, rotation(0.0, (500, 0, 0)))))
    with pytest.raises(ProblemError, match="does not overlap"):
        known.on(far, SHAPE)


def test_a_field_without_a_unit_is_matched_voxel_by_voxel():
    steps = np.random.default_rng(0).normal(size=(*SHAPE, 3))
    known = PixelField(Field.in_pixels(steps), Frame.at((1.0,) * 3, ("pixel",) * 3))
    order = (1, 2, 0)
    here = replace(Frame.at(SIZE, ("mm",) * 3, volume=True), plane=order)
    sizes = [SIZE[axis] for axis in order]
    found = known.on(here, tuple(SHAPE[axis] for axis in order))
    expected = steps.transpose(*order, 3)[..., list(order)] * sizes
    np.testing.assert_allclose(found.displacement, expected, rtol=1e-5)
    with pytest.raises(ProblemError, match="but the image is 14 x 15 x 16 in mm"):
        known.on(here, SHAPE)
    slice_ = Field.in_pixels(steps[0, ..., 1:])
    with pytest.raises(ProblemError, match="not a slice of this grid"):
        PixelField(slice_, Frame.at((1.0,) * 2, ("mm",) * 2)).on(here, SHAPE)


def test_arrows_in_a_volume_prescribe_all_components_of_their_first_voxel():
    here = replace(Frame.at(SIZE, ("mm",) * 3, volume=True), plane=(0, 2, 1))
    shape, size = (14, 16, 15), (1.5, 0.7, 1.0)
    vectors = np.array([[[1.2, 2, 3], [1, 0.5, -1]], [[4, 4.4, 4], [3, 0, 0]]])
    beyond = vectors.copy()
    beyond[1, 0] = 24, 4, 4
    y, known, out, _ = arrow_observation(vectors, here, size, shape)
    assert np.argwhere(known).tolist() == [[1, 3, 2], [4, 4, 4]]
    np.testing.assert_allclose(y[1, 3, 2], np.multiply((1, -1, 0.5), size))
    assert out == 0, "no arrow should leave the volume"
    with pytest.raises(ProblemError, match="outside the image of 14 x 16 x 15 pixels, the first"):
        arrow_observation(beyond, here, size, shape)
    film = Frame.at((1.0, *SIZE), ("s", "mm", "mm", "mm"), index=(2, 0, 0, 0), volume=True)
    moments = np.array([[[moment, 1, 2, 3], [0, 1, 1, 1]] for moment in (1, 2)])
    _, known, *_ = arrow_observation(moments, film, SIZE, SHAPE)
    assert known.sum() == 1


def test_points_and_images_on_other_grids_move_with_a_volume():
    here = Frame.at(SIZE, ("mm",) * 3, volume=True)
    found = solution(np.full((*SHAPE, 3), (3.0, -2.0, 0.7)))
    # Pixels twice as large, and an additional time axis.
    own = Frame.at((1.0, 3.0, 2.0, 1.4), ("s", "mm", "mm", "mm"))
    grid = OtherGrid.of(found, here, own)
    moved = grid.moved_points(np.array([[5.0, 2, 3, 4], [5, 90, 3, 4]]))
    np.testing.assert_allclose(moved, [[5, 3, 2, 4.5], [5, 90, 3, 4]])
    images = np.zeros((2, 7, 8, 8), np.float32)
    images[:, 2, 4, 3], images[1, 4, 4, 4] = 1, 2
    film = grid.moved_pixels(images, order=0)
    assert [tuple(at) for at in np.argwhere(film == 1)[:, :3]] == [(0, 3, 3), (1, 3, 3)]
    assert np.argwhere(film == 2)[0, :3].tolist() == [1, 5, 3]
    same = OtherGrid.of(found, here, replace(here, plane=(0, 1, 2)))
    image = image_of("float32")
    seen = same.moved_pixels(image, order=1)
    expected = warp(image, found.displacement, spacing=SIZE, fill=image.min())
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    with pytest.raises(ProblemError, match="has 2 axes and lacks an axis"):
        OtherGrid.of(found, here, Frame.at((1.0, 1.0), ("mm", "mm")))


def test_only_the_slice_of_a_solution_moves_in_a_volume():
    here = Frame.at((2.0, 1.0, 0.5), ("mm",) * 3, index=(3, 0, 0))
    found = solution(np.full((6, 8, 2), (1.0, -0.5)), spacing=(1.0, 0.5))
    moved = OtherGrid.of(found, here, here).moved_points(np.array([[3.0, 2, 4], [2, 2, 4]]))
    np.testing.assert_allclose(moved, [[3, 3, 3], [2, 2, 4]])


def test_a_point_beside_tissue_follows_the_tissue_that_is_nearest_in_millimetres():
    tissue = np.zeros((5, 7), bool)
    tissue[0, 3] = tissue[2, 2] = True  # two rows and one column away
    d = np.where(np.arange(7)[:, None] < 3, (0.0, 3.0), (2.0, 0.0)) * tissue[..., None]
    for sizes, expected in (((1.0, 1.0), (0, 3)), ((1.0, 3.0), (2, 0))):
        found = solution(d, tissue, sizes).at([(2.0, 3.0)], extend=True)
        np.testing.assert_allclose(found, [expected])


def test_inverting_the_inverse_of_a_volume_restores_the_displacement():
    d = hill(2.0)
    back, residual = inverse_displacement(d, spacing=SIZE)
    assert residual < 1e-3
    forth = Field(back, Geometry.at_origin(back.shape[:-1], SIZE), back=True)
    np.testing.assert_allclose(forth.displacement, d, atol=0.06)
