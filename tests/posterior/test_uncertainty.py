"""Tests of standard deviations of patches and labels."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Drawing,
    ElasticPrior,
    Grid,
    Landmark,
    Material,
    Motion,
    Problem,
    ProblemError,
    Study,
    Tissue,
    solve,
    solve_study,
)
from napari_hmrf.fields import measure
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import growth
from napari_hmrf.posterior import study_uncertainty, uncertainty
from napari_hmrf.registration import MeasuredMotion
from validation.oracles.posterior import posterior_covariance

SCALE = StrainScale(0.1)


def held_left(size=20, marks=None, m=1.0):
    c = np.zeros((size, size, 2))
    c[:, 0] = 1
    return Problem(
        observed=0 * c, confidence=c, stiffness=np.full((size, size), m), landmarks=marks
    )


def test_the_covariance_of_the_mean_of_a_label_is_that_of_the_posterior():
    problem = held_left(10)
    labels = np.zeros((10, 10), int)
    labels[2:5, 6:9], labels[7:, 1:3] = 3, 7
    found = uncertainty(problem, n=2, labels=labels, backend="cpu").labels
    covariance, free = posterior_covariance(problem, ElasticPrior(), StrainScale())
    assert list(found) == [3, 7]
    for number, label in found.items():
        weights = np.zeros((10, 10, 2, 2))
        for axis in range(2):
            weights[labels == number, axis, axis] = 1 / (labels == number).sum()
        weights = weights.reshape(-1, 2)[free]
        expected = weights.T @ covariance @ weights
        np.testing.assert_allclose(
            label.covariance, expected, rtol=0.01, atol=0.01 * expected.max()
        )
        np.testing.assert_allclose(label.sd, np.sqrt(np.diag(expected)), rtol=0.01)


def test_the_error_bar_of_a_growing_tumour_is_that_of_its_outward_motion():
    """The mean vector of the tumour is about 0, but its tissue moves outwards."""
    labels = np.ones((12, 12), int)
    labels[4:8, 4:8] = 2
    c = np.zeros((12, 12, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    problem = Problem(
        observed=0 * c, confidence=c, stiffness=np.ones((12, 12)), loads=growth(0.3 * (labels == 2))
    )
    result = uncertainty(problem, n=0, labels=labels, backend="cpu")
    d, tumour = result.solution.displacement, labels == 2
    (row,) = measure(result.solution, 2 * tumour, uncertainty=result)[1:]
    covariance, free = posterior_covariance(problem, ElasticPrior(), SCALE)
    outward = d / np.maximum(np.linalg.norm(d, axis=-1, keepdims=True), 1e-9)
    weights = (outward * tumour[..., None] / tumour.sum()).ravel()[free]
    assert row.mean_displacement_sd == pytest.approx(
        np.sqrt(weights @ covariance @ weights), rel=0.01
    )
    assert row.mean_displacement == pytest.approx(result.labels[2].length)
    assert np.abs(row.mean_vector).max() < 0.01 * row.mean_displacement
    assert row.mean_vector_sd == pytest.approx(result.labels[2].sd)


def test_error_bars_of_other_labels_or_of_another_solution_are_refused():
    labels = np.ones((10, 10), int)
    labels[:, 5:] = 2
    problem = held_left(10)
    c, move = problem.confidence, np.zeros((10, 10, 2))
    move[..., 1] = 3.0
    result = uncertainty(problem, n=0, labels=labels, backend="cpu")
    other = solve(Problem(observed=move, confidence=c, stiffness=np.ones((10, 10))), backend="cpu")
    with pytest.raises(ProblemError, match="another mean displacement of the label 1"):
        measure(other, labels, uncertainty=result)
    with pytest.raises(ProblemError, match="has none of these labels"):
        measure(result.solution, labels + 5, uncertainty=result)
    with pytest.raises(ProblemError, match="n: is 0, so the standard deviations of patches"):
        result.least_sure()
    with pytest.raises(TypeError, match="uncertainty must be the result of"):
        measure(other, labels, uncertainty=0.5)


def test_one_more_landmark_helps_most_at_the_least_sure_patch():
    marks = Landmarks([(4, 15)], [(4, 16)], sd=0.3, scale=SCALE)
    result = uncertainty(held_left(20, marks), n=30, backend="cpu")
    place, surface = result.least_sure(), np.zeros((20, 20), bool)
    surface[-1] = True
    assert result.along[place] == result.along.max()
    assert result.least_sure(where=surface)[0] == 19
    bars = result.at([place, (10, 1.2)])
    np.testing.assert_array_equal(bars[0], result.sd[place])
    assert bars[1].max() < 0.4 * bars[0].min()

    def gain(at):
        """Return the variance that a landmark at a point removes."""
        points = [(4, 15), at]
        both = Landmarks(points, points, sd=0.3, scale=SCALE)
        known = uncertainty(held_left(20, both), n=30, backend="cpu")
        return float((result.sd**2).sum() - (known.sd**2).sum())

    assert gain(place) > 3 * gain((10, 4))
    with pytest.raises(ProblemError, match="where: contains no tissue"):
        result.least_sure(where=np.zeros((20, 20)))
    with pytest.raises(ProblemError, match=r"points: has shape \(2,\)"):
        result.at((3, 4))


def test_standard_deviations_of_patches_agree_with_the_posterior():
    problem = held_left(10)
    result = uncertainty(problem, n=100, patch=3, backend="cpu")
    covariance, free = posterior_covariance(problem, ElasticPrior(), StrainScale())
    for row, col in ((4, 4), (5, 8), (0, 9)):
        weights = np.zeros((10, 10, 2))
        patch = np.zeros((10, 10), bool)
        patch[max(row - 1, 0) : row + 2, col - 1 : col + 2] = True
        weights[patch, 0] = 1 / patch.sum()
        weights = weights.ravel()[free]
        expected = np.sqrt(weights @ covariance @ weights)
        assert result.sd[row, col, 0] == pytest.approx(expected, rel=4 / np.sqrt(2 * 100))


def test_tissue_is_surer_near_held_tissue_and_near_landmarks():
    free = uncertainty(held_left(), n=40, scale=SCALE, backend="cpu")
    assert free.sd[10, 1].max() < free.sd[10, 10].max() < free.sd[10, 19].max()
    marks = Landmarks([(10, 17.5)], [(10, 17.5)], sd=0.05, scale=SCALE)
    known = uncertainty(held_left(marks=marks), n=40, backend="cpu")
    assert known.sd[10, 17].max() < 0.3 * free.sd[10, 17].max()
    assert known.sd[2, 17].max() > 2 * known.sd[10, 17].max()


def test_the_error_bar_of_a_length_is_along_the_motion():
    shape, move = (16, 16), np.zeros((16, 16, 2))
    c = np.zeros((*shape, 2))
    c[:, 0] = c[:, -1] = 1
    move[:, -1, 1] = 2
    result = uncertainty(
        Problem(observed=move, confidence=c, stiffness=np.ones(shape)), n=20, patch=1, backend="cpu"
    )
    assert result.along[8, 8] == pytest.approx(result.sd[8, 8, 1], rel=0.02)


def test_void_has_no_uncertainty_and_does_not_count_in_patches():
    c = np.zeros((12, 12, 2))
    c[:, 0] = 1
    m = np.ones((12, 12))
    m[:, 8:] = 0
    result = uncertainty(
        Problem(observed=0 * c, confidence=c, stiffness=m), n=10, patch=5, backend="cpu"
    )
    assert not result.sd[:, 8:].any()
    assert result.sd[5, 7].min() > 0.5 * result.sd[5, 6].min()


def test_a_voxel_is_less_sure_on_a_finer_grid_and_a_patch_is_not():
    sizes = {}
    for voxels, step in ((6, 3.0), (16, 1.0)):
        c = np.zeros((voxels,) * 3 + (3,))
        c[0] = 1
        problem = Problem(
            observed=0 * c, confidence=c, stiffness=np.ones((voxels,) * 3), spacing=(step,) * 3
        )
        scale = StrainScale(0.1, extent=3)
        for patch in ("voxel", 9.0):
            side = step if patch == "voxel" else patch
            result = uncertainty(problem, n=8, patch=side, scale=scale, backend="cpu")
            middle = tuple(slice(voxels // 3, -voxels // 3) for _ in range(3))
            sizes[voxels, patch] = float(result.sd[middle].mean())
    assert sizes[16, "voxel"] > 1.3 * sizes[6, "voxel"]
    assert sizes[16, 9.0] < 1.1 * sizes[6, 9.0]


@pytest.mark.parametrize(
    ("given", "named"),
    [({"patch": 0}, "patch"), ({"n": 1}, "n"), ({"labels": np.zeros((3, 3), int)}, "labels")],
)
def test_wrong_arguments_are_refused(given, named):
    with pytest.raises((ProblemError, ValueError), match=named):
        uncertainty(held_left(), **given)


def grown_study(**motion):
    labels = np.ones((24, 24), int)
    labels[9:15, 9:15] = 2
    materials = (Material(1, "brain", 1.0), Material(2, "tumour", 5.0, growth=0.2))
    tissue = Tissue(labels=labels, materials=materials)
    return Study(Grid(labels.shape, (1, 1), "mm"), tissue, Motion(hold_edge=True, **motion))


def test_a_study_gives_the_uncertainty_of_each_of_its_labels():
    study = grown_study(typical_strain=0.05)
    result = study_uncertainty(study, n=20, backend="cpu")
    np.testing.assert_array_equal(
        result.solution.displacement, solve_study(study, backend="cpu").displacement
    )
    assert set(result.labels) == {1, 2}
    rows = measure(result.solution, study.tissue.labels, uncertainty=result)
    assert [row.mean_displacement_sd for row in rows] == [
        result.labels[1].along,
        result.labels[2].along,
    ]
    middle = result.labels[2].sd
    assert (middle > 0).all()
    assert (middle < result.sd[11, 11] * 1.5).all()
    wider = study_uncertainty(grown_study(typical_strain=0.1), n=2, backend="cpu")
    assert wider.labels[2].sd == pytest.approx(2 * middle, rel=0.02)


def test_unpainted_tissue_has_an_error_bar_and_a_study_without_labels_has_one():
    study = grown_study()
    zero = replace(study, tissue=replace(study.tissue, labels=study.tissue.labels - 1))
    rows = (Material(0, "brain", 1.0), Material(1, "tumour", 5.0, growth=0.2))
    zero = replace(zero, tissue=replace(zero.tissue, materials=rows))
    by_label = study_uncertainty(study, n=0, backend="cpu").labels
    from_zero = study_uncertainty(zero, n=0, backend="cpu").labels
    assert list(from_zero) == [0, 1]
    np.testing.assert_array_equal(from_zero[0].covariance, by_label[1].covariance)
    whole = study_uncertainty(replace(study, tissue=Tissue()), n=0, backend="cpu").labels
    assert list(whole) == [1]


def test_landmarks_of_a_drawing_make_a_study_surer():
    mark = Landmark((11, 4), (11, 5), radius=3.0, sd=0.1)
    free = study_uncertainty(grown_study(), n=30, backend="cpu")
    known = study_uncertainty(grown_study(drawing=Drawing((mark,))), n=30, backend="cpu")
    assert (known.sd[11, 4] < 0.5 * free.sd[11, 4]).all()


def test_measured_motion_and_large_motion_of_a_study_are_refused():
    shape = (24, 24)
    precision = np.broadcast_to(np.eye(2), (*shape, 2, 2))
    measured = MeasuredMotion(np.zeros((*shape, 2)), precision)
    with pytest.raises(ProblemError, match="no known precision"):
        study_uncertainty(grown_study(measured=measured))
    with pytest.raises(ProblemError, match="large motion"):
        study_uncertainty(replace(grown_study(), model="large motion"))


def test_the_solution_of_a_volume_is_that_of_a_solve_on_its_whole_grid():
    shape = (9, 12, 8)
    tissue, c = np.zeros(shape), np.zeros((*shape, 3))
    tissue[2:8, 1:7, 3:8] = 1
    c[2, 1:7, 3:8] = 1
    strain = np.zeros(shape)
    strain[5:7, 3:5, 5:7] = 0.2
    problem = Problem(observed=0 * c, confidence=c, stiffness=tissue, loads=growth(strain))
    found, whole = uncertainty(problem, n=2, backend="cpu"), solve(problem, backend="cpu")
    solution = found.solution
    np.testing.assert_allclose(solution.displacement, whole.displacement, atol=2e-3)
    assert np.abs(whole.displacement).max() > 0.1
    assert solution.mean_energy == pytest.approx(whole.mean_energy, rel=1e-3)
    assert dict(solution.provenance.inputs) == dict(whole.provenance.inputs)
    stretched = [each.strain() for each in (solution, whole)]
    np.testing.assert_allclose(*stretched, atol=2e-3)
    assert found.sd[tissue > 0].max() > 0
    assert not found.sd[tissue == 0].any()


def test_a_patch_may_be_larger_than_the_image():
    whole, larger = (uncertainty(held_left(), n=2, patch=each) for each in (200.0, 1e9))
    np.testing.assert_array_equal(larger.sd, whole.sd)
