"""Registration: two images show how far their tissue has moved."""

import threading

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import (
    ArgumentError,
    Cancelled,
    Grid,
    ProblemError,
    Study,
    Tissue,
    read_study,
    replay,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.fields import count_folds, green_lagrange_strain
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.registration import register
from napari_hmrf.registration.image_data import ImageLevel, Images, reduced_pair
from napari_hmrf.solver.precision import checked_precision

SIZE = 96


def texture(seed=0, shape=(SIZE, SIZE), width=2.0):
    noise = np.random.default_rng(seed).normal(size=shape)
    image = ndimage.gaussian_filter(noise, width)
    return (image - image.min()) / np.ptp(image)


def bend(shape=(SIZE, SIZE), size=3.0):
    """Return a smooth displacement that vanishes at the edges."""
    place = np.indices(shape) / np.reshape(np.array(shape) - 1, (-1, *(1,) * len(shape)))
    wave = np.prod(np.sin(np.pi * place), axis=0)
    return size * np.stack([wave * (-1) ** axis for axis in range(len(shape))], axis=-1)


def error(found, truth, margin=8):
    inside = (slice(margin, -margin),) * (truth.ndim - 1)
    return float(np.linalg.norm(found.displacement - truth, axis=-1)[inside].mean())


def assert_sd_is_about_the_error(found, truth):
    inside = (slice(8, -8),) * (truth.ndim - 1)
    actual = np.sqrt(((found.displacement - truth)[inside] ** 2).mean())
    assert actual / 2.5 < found.sd < actual * 2.5


@pytest.fixture(scope="module")
def pair():
    truth = bend()
    return texture(), warp(texture(), truth, spacing=1), truth


@pytest.fixture(scope="module")
def found(pair):
    return register(*pair[:2], spacing=1)


def test_a_bent_image_gives_the_bend(pair, found):
    assert error(found, pair[2]) < 0.1
    assert found.folds == 0
    assert found.similarity > 0.95


def test_a_bent_volume_gives_the_bend():
    shape = (40, 44, 48)
    before, truth = texture(1, shape), bend(shape, 2.0)
    found = register(before, warp(before, truth, spacing=1), spacing=0.5)
    assert 2 * error(found, truth / 2) < 0.15
    assert_sd_is_about_the_error(found, truth / 2)


def test_brightness_contrast_and_bias_do_not_matter(pair):
    before, after, truth = pair
    bias = 1 + 0.3 * np.sin(np.arange(SIZE) / 20)
    assert error(register(before, 40 + 900 * bias * after**1.5, spacing=1), truth) < 0.2


@pytest.mark.parametrize(
    ("contrast", "relation"),
    [
        (lambda bright: 1 - bright, "inverse"),
        (lambda bright: np.abs(2 * bright - 1), "from fixed"),
    ],
)
def test_an_image_of_another_contrast_moves_as_one_of_the_same_contrast(pair, contrast, relation):
    before, after, truth = pair
    noise = np.random.default_rng(0).normal(scale=0.02, size=after.shape)
    found = register(before, contrast(after) + noise, spacing=1)
    assert found.relation == relation
    assert error(found, truth) < 1.5 * error(register(before, after + noise, spacing=1), truth)
    assert register(contrast(after) + noise, before, spacing=1).relation == relation.replace(
        "from fixed", "from moving"
    )


def test_unrelated_or_distant_images_count_as_images_of_the_same_contrast():
    assert register(texture(), texture(1), spacing=1).relation == "same"
    assert register(texture(), np.roll(texture(), 8, axis=1), spacing=1).relation == "same"


def test_a_cavity_is_found_and_does_not_distort_the_tissue_around_it():
    shape = (160, 160)
    before, truth = texture(3, shape, 3.0), bend(shape, 4.0)
    far = np.hypot(*(np.indices(shape) - 80))
    gone = far < 16
    hole = ndimage.gaussian_filter(gone.astype(float), 1)
    after = warp((1 - hole) * before, truth, spacing=1)
    after += np.random.default_rng(0).normal(scale=0.01, size=shape)
    found, all_compared = (
        register(before, after, spacing=1, compare_all=each) for each in (False, True)
    )
    assert found.missing is not None
    assert all_compared.missing is None
    assert 2 * (found.missing & gone).sum() > 0.7 * (found.missing.sum() + gone.sum())
    ring = (far > 17) & (far < 28)
    errors = [
        np.linalg.norm(each.displacement - truth, axis=-1)[ring].mean()
        for each in (found, all_compared)
    ]
    assert errors[0] < 0.7 * errors[1]


def test_tissue_that_only_moves_is_not_missing(pair, found):
    assert found.missing is None
    noise = np.random.default_rng(0).normal(scale=0.05, size=pair[0].shape)
    assert register(pair[0], 1 - pair[1] ** 2 + noise, spacing=1).missing is None
    assert register(texture(), texture(1), spacing=1).missing is None


def test_long_pixels_give_the_same_motion_in_millimetres(pair):
    before, after, truth = pair
    longer = np.array([2.0, 1.0])
    found = register(before, after, spacing=longer)
    assert np.linalg.norm(found.displacement / longer - truth, axis=-1)[8:-8, 8:-8].mean() < 0.15
    apart = np.abs(found.resample(after) - before), np.abs(after - before)
    assert apart[0][8:-8, 8:-8].mean() < 0.2 * apart[1][8:-8, 8:-8].mean()


def test_the_moving_image_is_resampled_to_the_fixed_one(pair, found):
    before, after, _ = pair
    aligned = found.resample(after)
    inside = slice(8, -8), slice(8, -8)
    assert np.abs(aligned - before)[inside].mean() < 0.2 * np.abs(after - before)[inside].mean()
    points = np.array([(30.0, 40.0), (60.0, 20.0)])
    there = found.solution.move(points)
    assert np.allclose(found.move(points), there)
    origin = there + found.inverse.displacement[tuple(np.rint(there).astype(int).T)]
    assert np.allclose(origin, points, atol=0.7)


def test_the_suggested_standard_deviation_is_about_the_error():
    before, truth = texture(2), bend(size=4.0)
    after = warp(before, truth, spacing=1)
    noisy = after + np.random.default_rng(0).normal(scale=0.05, size=after.shape)
    assert_sd_is_about_the_error(register(before, noisy, spacing=4), 4 * truth)


def test_a_shifted_and_turned_image_is_aligned_before_it_is_deformed():
    before, truth = texture(3, width=4), bend(size=2.0)
    angle = np.radians(8)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = turn, (5.0, -4.0)
    bent = warp(before, truth, spacing=1)
    after = ndimage.affine_transform(bent, turn.T, -turn.T @ matrix[:2, 2], order=3)
    given = register(before, after, spacing=1, initial=matrix)
    assert error(given, truth, 20) < 0.25
    points = np.array([(40.0, 50.0)])
    moved = (points + truth[40, 50]) @ turn.T + matrix[:2, 2]
    assert np.allclose(given.move(points), moved, atol=0.5)


@pytest.mark.parametrize("kind", ["rigid", "affine"])
def test_simpleitk_finds_the_alignment(kind):
    pytest.importorskip("SimpleITK")
    before = texture(4, width=4)
    after = ndimage.shift(before, (4, -3), order=1)
    found = register(before, after, spacing=1, initial=kind)
    at = np.array([(48.0, 48.0)])
    assert np.allclose(found.move(at), at + np.array([4, -3]), atol=0.5)
    assert np.abs(found.displacement[30:-30, 30:-30]).max() < 1
    again = register(before, after, spacing=1, initial=kind)
    np.testing.assert_array_equal(again.matrix, found.matrix, "an alignment is not reproducible")


def test_rigid_bone_turns_without_strain_while_soft_tissue_follows():
    place = np.moveaxis(np.indices((SIZE, SIZE)), 0, -1) - 48.0
    away = np.linalg.norm(place, axis=-1)
    angle = np.radians(10) * np.clip((36 - away) / 16, 0, 1)
    cosine, sine = np.cos(angle), np.sin(angle)
    moved = np.stack(
        [
            cosine * place[..., 0] - sine * place[..., 1],
            sine * place[..., 0] + cosine * place[..., 1],
        ],
        axis=-1,
    )
    truth, bone = moved - place, away < 18
    before = texture(5)
    found = register(
        before,
        warp(before, truth, spacing=1),
        spacing=1,
        stiffness=np.where(bone, np.inf, 1.0),
    )
    inner = away < 17
    strain = green_lagrange_strain(found.displacement, spacing=1)[inner]
    assert np.abs(strain).max() < 1e-5
    assert error(found, truth) < 0.3


def test_tissue_around_a_hole_in_one_image_moves_as_without_the_hole(pair):
    before, after, truth = pair
    hole = np.linalg.norm(np.indices((SIZE, SIZE)) - np.reshape((40, 50), (2, 1, 1)), axis=0) < 10
    damaged = np.where(hole, 0, before)
    around = ndimage.binary_dilation(hole, iterations=6) & ~hole

    def error_around(**options):
        moved = register(damaged, after, spacing=1, **options).displacement
        return np.linalg.norm(moved - truth, axis=-1)[around].mean()

    masked = error_around(masks=~hole)
    assert masked < 0.25
    assert masked < error_around() / 2


def test_the_second_image_may_show_a_part_of_the_first():
    before = texture(0, (64, 72), 4.0)
    moved = np.linalg.norm(register(before, before[:, :40], spacing=1).displacement, axis=-1)
    assert moved[8:-8, 8:32].mean() < 0.3


def test_landmarks_move_tissue_that_the_images_do_not_show():
    before = np.where(np.indices((SIZE, SIZE))[1] < 48, texture(6), 0.5)
    points = np.array([(30.0, 75.0), (60.0, 75.0), (45.0, 85.0)])
    marks = Landmarks(points, points + np.array([0, 3]), sd=0.2)
    found = register(before, before, spacing=1, landmarks=marks)
    assert np.allclose(found.solution.at(points)[:, 1], 3, atol=0.5)
    assert np.abs(found.displacement[20:-20, 10:35]).max() < 0.5
    grid = Grid((SIZE, SIZE), 1)
    study = Study(grid, Tissue(stiffness=np.ones(grid.shape)), found.motion(), prior=found.prior)
    assert np.allclose(solve_study(study).at(points), found.solution.at(points), atol=0.05)


def test_violent_motion_does_not_fold():
    before = texture(7, width=3)
    push = np.zeros((SIZE, SIZE, 2))
    push[..., 1] = 14 * np.exp(-((np.indices((SIZE, SIZE))[1] - 48.0) ** 2) / 60)
    after = ndimage.map_coordinates(
        before, np.moveaxis(np.moveaxis(np.indices(before.shape), 0, -1) + push, -1, 0), order=1
    )
    found = register(before, after, spacing=1)
    assert count_folds(found.displacement, spacing=1) == 0
    assert min(step.least_jacobian for step in found.history) > 0


@pytest.mark.parametrize("margin", [0, 12])
def test_images_of_different_tissue_do_not_fold_the_tissue(margin):
    void = np.zeros((SIZE, SIZE))
    void[margin : SIZE - margin, margin : SIZE - margin] = 1
    before, other = texture(8, width=3), texture(9, width=3)
    assert register(before, other, spacing=1, stiffness=void).folds == 0


def test_a_registration_is_a_study_that_is_saved_and_replayed(pair, found, tmp_path):
    before, *_ = pair
    study = Study(Grid(before.shape, (1, 1)), motion=found.motion(), prior=found.prior)
    solution = solve_study(study)
    assert np.abs(solution.displacement - found.displacement).max() < 5e-3
    path = write_study(tmp_path / "registered", study, solution)
    measured = read_study(path).study.motion.measured
    assert np.array_equal(measured.precision, study.motion.measured.precision)
    assert np.array_equal(replay(path).displacement, solution.displacement)


def test_a_registration_continues_from_another_one(pair, found):
    again = register(*pair[:2], spacing=1, initial=found)
    assert len(again.history) < len(found.history)
    assert error(again, pair[2]) < 0.1


def test_progress_never_decreases_and_cancel_stops(pair):
    done = []
    flag = threading.Event()

    def progress(monitor):
        done.append(monitor.fraction)
        if len(done) > 3:
            flag.set()

    with pytest.raises(Cancelled):
        register(*pair[:2], spacing=1, progress=progress, cancel=flag)
    assert done == sorted(done)


ONE = np.ones((16, 16))


def test_a_black_background_is_no_observation():
    """The tails of a window underflow in black, where they observe nothing."""
    shape = (64, 64)
    inside = np.hypot(*(np.indices(shape) - 31.5)) < 12
    tails = ndimage.gaussian_filter(inside.astype(np.float32), 1.5, truncate=12)
    image = np.where(inside, texture(shape=shape) + 1, tails).astype(np.float32)
    known = np.ones(shape, bool)
    reduced = reduced_pair(Images(image, image, (known, known)), 1, lambda: None)
    level = ImageLevel(reduced, (1.0, 1.0), lambda: None)
    moved = np.zeros((*shape, 2), np.float32)
    moved[..., 0] = 5
    precision = level.linear(moved, 1.0).precision
    assert checked_precision(precision, known) is not None
    assert (precision == 0).all(axis=(-2, -1)).any()


def test_a_speck_in_one_image_hardly_moves_the_tissue():
    image, known = texture(1, (40, 40)).astype(np.float32), np.ones((40, 40), bool)
    speck = image.copy()
    speck[17, 17] = 1
    reduced = reduced_pair(Images(image, speck, (known, known)), 1, lambda: None)
    level = ImageLevel(reduced, (1.0, 1.0), lambda: None)
    observed = level.linear(np.zeros((40, 40, 2), np.float32), 1.0).observed
    assert np.linalg.norm(observed, axis=-1).max() < 0.15


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_the_unit_of_brightness_does_not_matter(pair, found, unit):
    first, second = (np.float32(unit) * image.astype(np.float32) for image in pair[:2])
    again = register(first, second, spacing=1)
    np.testing.assert_allclose(again.displacement, found.displacement, atol=0.01)


def test_a_smoothness_near_zero_and_images_apart_are_named(pair):
    with pytest.raises(ProblemError) as refused:
        register(*pair[:2], spacing=1, smoothness=1e-12)
    assert refused.value.field == "smoothness"
    corner = np.eye(3)
    corner[:2, 2] = SIZE - 1.5
    with pytest.raises(ProblemError) as refused:
        register(*pair[:2], spacing=1, initial=corner)
    assert refused.value.field in ("fixed", "moving")


INVALID = {
    "has 3 axes": ((ONE, np.ones((16, 16, 16))), {}),
    "same brightness everywhere": ((ONE, ONE), {}),
    "stiffness: has shape": ((texture(), texture()), {"stiffness": ONE}),
    "masks: has shape": ((texture(), texture()), {"masks": ONE}),
    "exclude all pixels": ((texture(), texture()), {"masks": np.zeros((SIZE, SIZE))}),
    "initial: has shape": ((texture(), texture()), {"initial": np.eye(2)}),
    "at least two pixels": ((np.ones(4), np.ones(4)), {}),
}


@pytest.mark.parametrize("message", INVALID)
def test_invalid_input_is_named(message):
    images, options = INVALID[message]
    with pytest.raises(ProblemError, match=message):
        register(*images, spacing=1, **options)


def test_unknown_alignment_and_weight_are_refused():
    for options in ({"initial": "elastic"}, {"smoothness": 0}):
        with pytest.raises(ArgumentError):
            register(texture(), texture(), spacing=1, **options)
