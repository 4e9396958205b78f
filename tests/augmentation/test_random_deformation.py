"""Random deformations of a labelled case: elastic fields that do not fold."""

import json
import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from napari_hmrf import (
    ArgumentError,
    FileFormatError,
    Material,
    ProblemError,
    read_study,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.augmentation.fold_limit import largest_scale
from napari_hmrf.augmentation.ground_truth import landmarks
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.fields import Picture, deformation_gradient, fold_mask
from napari_hmrf.random import RandomDeformation
from napari_hmrf.results.measurement import measure
from napari_hmrf.tissue import RIGID
from napari_hmrf.tissue.normals import outer_rim

AIR, MUSCLE, TUMOUR, BONE = range(4)
MATERIALS = (
    Material(AIR, "air", 0.0),
    Material(MUSCLE, "muscle", 3.0, 0.4),
    Material(TUMOUR, "tumour", 10.0, 0.45, 0.15),
    Material(BONE, "bone", RIGID),
)
SPACING = (0.5, 0.8)


@cache
def labels(size=64, axes=2):
    """Return a round body in air with an air hole, a bone and a tumour."""
    at = np.moveaxis(np.indices((size,) * axes), 0, -1) / (size - 1)
    middle = (0.5,) * (axes - 2)

    def ball(row, col, radius):
        return np.linalg.norm(at - (*middle, row, col), axis=-1) < radius

    image = np.where(ball(0.5, 0.5, 0.49), MUSCLE, AIR)
    image[ball(0.7, 0.4, 0.13)] = TUMOUR
    image[ball(0.3, 0.6, 0.12)] = BONE
    image[ball(0.5, 0.78, 0.06)] = AIR
    return image


@cache
def deformation_2d():
    return RandomDeformation(labels(), MATERIALS, spacing=SPACING, amplitude=(1, 8), weight=0.03)


@cache
def deformation_3d():
    return RandomDeformation(
        labels(20, axes=3), MATERIALS, amplitude=2, patches=3, radius=1.5, spacing=1
    )


def test_a_sample_matches_a_full_solve_of_its_boundary_values():
    sample = deformation_2d().sample(0)
    solved = solve_study(sample.study, backend="cpu")
    far = np.abs(solved.displacement - sample.displacement) / SPACING
    assert far.max() < 0.01
    assert np.abs(sample.displacement).max() > 0.5


def test_a_sample_of_a_volume_matches_a_full_solve():
    sample = deformation_3d().sample(1)
    solved = solve_study(sample.study, backend="cpu")
    assert np.abs(solved.displacement - sample.displacement).max() < 0.01
    assert np.abs(sample.displacement).max() > 0.5


@pytest.mark.parametrize("deformation", [deformation_2d, deformation_3d])
def test_no_field_folds_or_compresses_tissue_below_a_fifth_of_its_size(deformation):
    random, scales = deformation(), []
    for seed in range(12):
        sample = random.sample(seed)
        field, tissue = sample.displacement, sample.tissue
        assert not fold_mask(field, spacing=sample.spacing, tissue=tissue).any()
        assert smallest_determinant(field, sample.spacing, tissue)[tissue].min() > 0.199
        scales.append(sample.scale)
    assert min(scales) < 1, "some samples should have been scaled down"


def test_a_scaled_sample_has_the_least_allowed_jacobian():
    for seed in range(8):
        sample = deformation_2d().sample(seed)
        if sample.scale < 1:
            least = smallest_determinant(sample.displacement, SPACING, sample.tissue)
            assert np.nanmin(least) == pytest.approx(0.2, abs=0.01)


def test_a_half_turn_does_not_count_as_unfolded():
    """At full scale every determinant is positive, but tissue collapses at scale 0.4."""
    at = np.moveaxis(np.indices((8, 8)), 0, -1)
    turned = -2.5 * (at - 3.5)
    everywhere = np.ones((8, 8), bool)
    assert not fold_mask(turned, spacing=1).any()
    assert largest_scale(turned, (1, 1), everywhere, 0.2) == pytest.approx(0.2211, abs=5e-4)


def test_the_fold_limit_ignores_differences_across_air():
    moved = np.zeros((6, 9, 2))
    moved[:, 5:, 1] = -4
    tissue = np.ones((6, 9), bool)
    assert largest_scale(moved, (1, 1), tissue, 0.2) < 0.25
    tissue[:, 4] = False
    assert largest_scale(moved, (1, 1), tissue, 0.2) == 1


@pytest.mark.parametrize("deformation", [deformation_2d, deformation_3d])
def test_bone_does_not_bend(deformation):
    random = deformation()
    grid = labels() if random.tissue.ndim == 2 else labels(20, axes=3)
    bone = grid == BONE
    # The rotation is undefined at a site without a neighbour along an axis.
    inside = binary_erosion(bone)[bone]
    assert inside.any()
    for seed in range(3):
        sample = random.sample(seed)
        gradient = deformation_gradient(sample.displacement, spacing=sample.spacing, tissue=bone)[
            bone
        ]
        turn = (gradient - np.eye(grid.ndim))[inside]
        assert np.abs(turn + turn.swapaxes(-1, -2)).max() < 2e-3, (
            "bone should only translate and rotate"
        )
        assert np.abs(sample.displacement[bone]).max() > 0.05


def test_air_stays_empty_and_the_outer_edge_does_not_move():
    sample, image = deformation_2d().sample(3), labels()
    air = image == AIR
    assert not sample.displacement[air].any()
    assert not sample.tissue[air].any()
    edge = outer_rim(~air)
    assert np.abs(sample.displacement[edge]).max() < 1e-3
    hole = air & (np.hypot(*np.indices(image.shape) - np.array([32, 49])[:, None, None]) < 6)
    beside = np.abs(np.stack(np.nonzero(edge)) - np.array([[32], [49]])).max(axis=0).min() > 10
    assert hole.any()
    assert beside, "the rim of the hole should not be part of the outer edge"
    moved = sample.labels(image)
    assert (moved == AIR).sum() == pytest.approx(air.sum(), rel=0.05)


def test_a_free_edge_moves():
    free = RandomDeformation(
        labels(), MATERIALS, amplitude=3, patches=4, hold_edge=False, spacing=1
    )
    sample = free.sample(0)
    assert np.abs(sample.displacement[outer_rim(sample.tissue)]).max() > 0.2


def test_growing_tissue_grows_by_a_random_share_of_its_table_value():
    random = RandomDeformation(labels(), MATERIALS, amplitude=1e-3, patches=1, spacing=1)
    grown = []
    for seed in range(4):
        sample = random.sample(seed)
        (share,) = sample.causes.growth
        rows = {row.label: row for row in measure(sample.solution, labels())}
        assert 0 <= share <= 1
        grown.append((share, rows[TUMOUR].size_change))
    shares, areas = np.array(grown).T
    assert np.ptp(shares) > 0.1
    np.testing.assert_allclose(areas / shares, (areas / shares)[0], rtol=0.2)
    assert (areas > 0).all()


def test_a_seed_reproduces_a_field_bit_for_bit_and_other_seeds_differ():
    once, again = deformation_2d().sample(7), deformation_2d().sample(7)
    assert once.displacement.tobytes() == again.displacement.tobytes()
    assert once.displacement.dtype == np.float32
    assert np.abs(once.displacement - deformation_2d().sample(8).displacement).max() > 0.1
    ours, theirs = np.random.default_rng(5), np.random.default_rng(5)
    for _ in range(2):
        first, second = deformation_2d().sample(ours), deformation_2d().sample(theirs)
        assert first.displacement.tobytes() == second.displacement.tobytes()
    assert (
        deformation_2d().sample().displacement.tobytes()
        != deformation_2d().sample().displacement.tobytes()
    )


def test_a_pickled_deformation_draws_the_same_bits():
    copy = pickle.loads(pickle.dumps(deformation_2d()))
    assert (
        copy.sample(2).displacement.tobytes() == deformation_2d().sample(2).displacement.tobytes()
    )


def test_image_labels_and_points_move_by_the_field_of_the_sample():
    sample, tissue_labels = deformation_2d().sample(4), labels()
    image = np.random.default_rng(0).random((64, 64), dtype=np.float32) - 3
    d, there = sample.displacement, sample.tissue
    moved = sample.image(image)
    expected = warp(image, d, spacing=SPACING, tissue=there, fill=image.min())
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    expected = warp(tissue_labels, d, spacing=SPACING, tissue=there, order=0)
    np.testing.assert_array_equal(sample.labels(tissue_labels), expected)
    both = sample.pictures(Picture(image, fill=image.min()), Picture(tissue_labels, order=0))
    np.testing.assert_array_equal(both[0], moved)
    np.testing.assert_array_equal(both[1], expected)
    points = np.argwhere(tissue_labels == TUMOUR)
    went = sample.points(points)
    np.testing.assert_allclose(went - points, d[tissue_labels == TUMOUR] / SPACING, atol=1e-5)
    seen = sample.labels(tissue_labels)[tuple(np.rint(went).astype(int).T)]
    assert (seen == TUMOUR).mean() > 0.9


def test_a_sample_below_the_requested_amplitude_is_reported_once(caplog):
    random = RandomDeformation(labels(), MATERIALS, amplitude=(9, 12), patches=4, spacing=1)
    sample = random.sample(1)
    assert sample.scale < 1
    assert 0 < sample.amplitude < 9
    (said,) = [record.getMessage() for record in caplog.records if "amplitude" in record.message]
    assert said.startswith(
        f"the smallest amplitude is 9, but a sample has only {sample.amplitude:.3g}"
    )
    random.sample(2)
    assert sum("amplitude" in record.message for record in caplog.records) == 1
    caplog.clear()
    even = RandomDeformation(labels(), MATERIALS, amplitude=(0.01, 12), patches=4, spacing=1)
    assert even.sample(1).amplitude >= 0.01
    assert not caplog.records


def test_the_amplitude_is_the_largest_pull_of_a_patch():
    small = RandomDeformation(
        labels(), MATERIALS[:2] + MATERIALS[3:] + (Material(2, "", 3.0),), spacing=1
    )
    low, high = small.amplitude
    assert low == 0 < high
    one = RandomDeformation(labels(), MATERIALS, amplitude=0.5, spacing=SPACING, patches=5)
    for seed in range(3):
        sample = one.sample(seed)
        assert sample.scale == 1
        assert np.linalg.norm(sample.causes.pulls, axis=1).max() == pytest.approx(0.5)
    between = [
        np.linalg.norm(s.causes.pulls / s.scale, axis=1).max()
        for s in map(deformation_2d().sample, range(20))
    ]
    assert 1 <= min(between) < 3
    assert 6 < max(between) <= 8


def test_weight_pulls_in_all_directions():
    weights = np.array([deformation_2d().sample(seed).causes.weight for seed in range(20)])
    assert (np.linalg.norm(weights, axis=1) <= 0.03 + 1e-9).all()
    assert (weights.min(axis=0) < 0).all()
    assert (weights.max(axis=0) > 0).all()


def test_a_sample_is_written_and_read_like_any_study(tmp_path):
    sample = deformation_2d().sample(1)
    path = write_study(tmp_path / "sample", sample.study, sample.solution)
    study, solution = read_study(path)
    np.testing.assert_array_equal(solution.displacement, sample.displacement)
    assert solution.provenance.model == "elastic"
    again = solve_study(study, backend="cpu").displacement
    assert np.abs((again - sample.displacement) / SPACING).max() < 0.01


@pytest.mark.parametrize("deformation", [deformation_2d, deformation_3d])
def test_a_deformation_read_from_its_file_draws_the_same_bits(deformation, tmp_path, monkeypatch):
    random = deformation()
    path = random.write(tmp_path / "case")
    assert path.name == "case.npz"
    monkeypatch.setattr("napari_hmrf.augmentation.unit_solutions.solve_study", None)
    loaded = RandomDeformation.read(path)
    assert repr(loaded) == repr(random)
    for seed in range(2):
        before, after = random.sample(seed), loaded.sample(seed)
        assert before.displacement.tobytes() == after.displacement.tobytes()
        assert before.study.tissue.materials == after.study.tissue.materials
        assert before.study.motion.rules == after.study.motion.rules


def test_a_file_of_another_kind_or_with_inconsistent_arrays_is_rejected(tmp_path):
    path = write_study(tmp_path / "case.npz", deformation_2d().sample(0).study)
    with pytest.raises(FileFormatError, match="another kind of file"):
        RandomDeformation.read(path)
    whole = dict(np.load(deformation_2d().write(path)))
    for name, value, said in (
        ("displacements", whole["displacements"][1:], "another grid"),
        ("displacements", whole["displacements"] * np.float32(np.nan), "NaN or infinite"),
        ("case.patches", whole["case.patches"][1:], "another grid"),
        ("case.centres", whole["case.centres"][:, :1], "another grid"),
        ("header", _header(whole, amplitude=[2, -1]), "case.amplitude.1: Input should be greater"),
        ("header", _header(whole, smoothness=0), "case.smoothness: Input should be greater"),
    ):
        np.savez(path, **{**whole, name: value})
        with pytest.raises(FileFormatError, match=said):
            RandomDeformation.read(path)


def _header(whole, **changes):
    header = json.loads(whole["header"].item())
    return np.array(json.dumps({**header, "case": {**header["case"], **changes}}))


def test_later_changes_of_the_label_array_have_no_effect():
    image = labels().copy()
    random = RandomDeformation(image, MATERIALS, amplitude=1, patches=1, spacing=1)
    image[...] = AIR
    assert (random.sample(0).study.tissue.labels == labels()).all()


def test_unit_solutions_use_single_precision_and_respect_the_memory_limit():
    random = deformation_2d()
    causes = 2 * len(random.sample(0).causes.pulls) + 1 + 2
    tissue = random.tissue.sum()
    assert random.nbytes == causes * tissue * 2 * 4
    with pytest.raises(ProblemError, match=r"64 x 64.* GiB are allowed, enough for 3"):
        RandomDeformation(labels(), MATERIALS, memory=3.5 * tissue * 8, spacing=1)


def test_patches_are_distinct_regions_of_soft_tissue():
    study = deformation_2d().sample(0).study
    patches, image = study.motion.labels, labels()
    assert set(image[patches > 0]) <= {MUSCLE, TUMOUR}
    assert 6 <= patches.max() <= 12
    counts = np.bincount(patches[patches > 0])[1:]
    assert counts.min() >= 4


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"amplitude": 0}, "amplitude must be"),
        ({"amplitude": (2, 1)}, "amplitude must be"),
        ({"amplitude": "far"}, "amplitude must be"),
        ({"patches": 0}, "patches must be"),
        ({"least_jacobian": 0}, "least_jacobian must be"),
        ({"smoothness": -1}, "smoothness must be"),
        ({"weight": -1}, "weight must be"),
        ({"radius": 400}, "have no soft tissue with room"),
        ({"labels": labels()[None]}, "without axes for"),
        ({"labels": labels() * 0}, "have no soft tissue. Give"),
        ({"materials": MATERIALS[0]}, "materials must be"),
        ({"spacing": (1, 1, 1)}, "spacing"),
    ],
)
def test_invalid_arguments_are_rejected_before_any_solve(wrong, said):
    with pytest.raises((ArgumentError, ProblemError), match=said):
        RandomDeformation(**{"labels": labels(), "materials": MATERIALS, "spacing": 1, **wrong})


def test_a_label_without_a_material_and_an_invalid_seed_are_rejected():
    with pytest.raises(ProblemError, match="without a material: 3"):
        RandomDeformation(labels(), MATERIALS[:3], spacing=1)
    with pytest.raises(ArgumentError, match="seed must be"):
        deformation_2d().sample("yes")


def test_tissue_that_slides_is_rejected_instead_of_sticking():
    rows = [replace(row, slides=row.label == 2) for row in MATERIALS]
    with pytest.raises(ProblemError, match=r"slides along other tissue.*slides=False"):
        RandomDeformation(labels(), rows, spacing=1)


def test_landmarks_are_spread_over_tissue():
    tissue = deformation_2d().tissue
    found = landmarks(tissue)
    assert 150 < len(found) < 300
    assert tissue[tuple(found.T)].all()


def test_deformed_pictures_match_warp_for_tissue_anywhere_in_the_image():
    image = np.zeros((50, 60), int)
    image[10:30, 25:50] = MUSCLE
    random = RandomDeformation(image, MATERIALS, amplitude=4, patches=3, hold_edge=False, spacing=1)
    noise = np.random.default_rng(2).random(image.shape)
    for seed in range(4):
        sample = random.sample(seed)
        for order in (0, 1, 3):
            expected = warp(
                noise, sample.displacement, spacing=1, tissue=sample.tissue, order=order
            )
            (moved,) = sample.pictures(Picture(noise, order=order))
            np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_the_repr_states_the_size_and_the_scale():
    assert "64 x 64 sites" in repr(deformation_2d())
    assert "scale" in repr(deformation_2d().sample(0))
    assert replace(deformation_2d().sample(0), scale=0.5).scale == 0.5
