"""Methods of Solution, compared with the functions that take a spacing and tissue."""

import re
from dataclasses import replace

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf import (
    ArgumentError,
    Arrow,
    BoundaryRule,
    Drawing,
    Grid,
    Material,
    Motion,
    ProblemError,
    Solution,
    Study,
    Tissue,
    read_study,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.strain import count_folds
from napari_hmrf.fields import (
    deformation_gradient,
    equivalent_strain,
    green_lagrange_strain,
    jacobian_determinant,
    small_strain,
)
from napari_hmrf.io.fields import export_field
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.solution import Provenance

SIZE = (2.0, 0.5)
D = np.zeros((4, 5, 2))
LABELS = np.ones((40, 50), int)


@pytest.fixture
def solution():
    random = np.random.default_rng(5)
    rows, cols = np.indices((20, 24))
    d = np.stack([np.sin(cols / 5), 0.6 * np.cos(rows / 4)], axis=-1).astype(np.float32)
    d += 0.1 * random.standard_normal(d.shape).astype(np.float32)
    tissue = np.hypot(rows - 10, cols - 12) < 9
    d[~tissue] = 0
    run = Provenance("cpu", "here")
    elasticity = Elasticity(tissue.astype(np.float32), 0.4)
    return Solution(d, np.zeros(1), (), tissue, SIZE, run, elasticity=elasticity)


def test_the_displacement_cannot_be_changed_by_accident(solution):
    with pytest.raises(ValueError, match="read-only"):
        solution.displacement[0, 0] = 1
    assert replace(solution, unit="mm").displacement is solution.displacement


def test_methods_equal_the_functions_with_spacing_and_tissue(solution, tmp_path):
    d, on = solution.displacement, {"spacing": SIZE, "tissue": solution.tissue}
    photo = np.random.default_rng(6).random((20, 24))
    labels = (photo > 0.5).astype(np.uint8)
    points = np.array([(4.0, 6.5), (10, 12)])
    for method, function in (
        (solution.warp(photo), warp(photo, d, **on)),
        (solution.warp(labels, order=0), warp(labels, d, order=0, **on)),
        (solution.jacobian(), jacobian_determinant(d, **on)),
        (solution.count_folds(), count_folds(d, **on)),
        (solution.strain("total"), green_lagrange_strain(d, **on)),
        (solution.strain("small"), small_strain(d, **on)),
        (solution.move(points), moved_points(points, d, spacing=SIZE)),
    ):
        assert np.array_equal(method, function, equal_nan=True)
    for extend in (False, True):
        assert np.allclose(solution.at(points, extend=extend)[1], d[10, 12])
    assert np.allclose(solution.move(points), points + solution.at(points) / SIZE)
    other = np.abs(warp(photo, d, spacing=1, tissue=solution.tissue) - solution.warp(photo))
    assert other.max() > 0.1, "the test should detect a wrong spacing"
    pytest.importorskip("SimpleITK")
    exported = export_field(tmp_path / "a.mha", solution, placed=False)
    assert exported == export_field(tmp_path / "b.mha", solution, placed=False)
    assert (tmp_path / "a.mha").exists()


def test_elastic_strain_adds_the_thickness_strain_to_small_strain(solution):
    strain = solution.strain()[solution.tissue]
    within = solution.strain("small")[solution.tissue]
    assert np.allclose(strain[:, 1:, 1:], within, atol=1e-6)
    across = -0.4 / 0.6 * np.trace(within, axis1=1, axis2=2)
    assert np.allclose(strain[:, 0, 0], across, atol=1e-6)
    assert not strain[:, 0, 1:].any()
    with pytest.raises(ArgumentError, match='kind must be "elastic", "total" or "small"'):
        solution.strain("von Mises")


@pytest.mark.parametrize(
    "call",
    [
        lambda **more: warp(np.zeros((4, 5)), D, **more),
        *[
            lambda name=name, **more: getattr(napari_hmrf.fields, name)(D, **more)
            for name in (
                "jacobian_determinant",
                "count_folds",
                "fold_mask",
                "inverse_map",
                "small_strain",
                "green_lagrange_strain",
                "deformation_gradient",
                "arrows",
                "deformation_grid",
            )
        ],
        lambda **more: napari_hmrf.fields.Warper(np.zeros((4, 5)), **more),
        lambda **more: napari_hmrf.tissue.boundary_images(
            LABELS, [BoundaryRule(1, "fixed")], **more
        ),
        lambda **more: napari_hmrf.random.RandomDeformation(
            LABELS, [Material(1, "gel", 2.0)], **more
        ),
    ],
)
def test_functions_of_lengths_require_a_spacing(call):
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'spacing'"):
        call()
    with pytest.raises(ProblemError, match=r"spacing: is None\. \w+ 2 positive, finite pixel"):
        call(spacing=None)
    call(spacing=(2, 2))


def test_a_single_spacing_applies_to_all_axes():
    rows, cols, planes = np.indices((4, 5, 6))
    d = 0.2 * np.stack([rows, cols, planes], axis=-1)
    for spacing in (2, 2.0, np.float32(2)):
        assert np.allclose(jacobian_determinant(d, spacing=spacing), 1.1**3)
        assert np.allclose(deformation_gradient(d, spacing=spacing), 1.1 * np.eye(3))
    with pytest.raises(ProblemError, match=r"spacing: is 0\. \w+ 3"):
        jacobian_determinant(d, spacing=0)
    total = equivalent_strain(green_lagrange_strain(d, spacing=2))
    assert np.allclose(total, 0, atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "spacing", "sizes", "far"),
    [
        ("millimeter", SIZE, "sites of 2 x 0.5 mm,", r"moved up to [\d.]+ mm,"),
        ("pixel", SIZE, "sites of 2 x 0.5 pixels,", r"moved up to [\d.]+ pixels,"),
        ("", SIZE, r"sites of 2 x 0.5 \(unit unknown\),", r"moved up to [\d.]+,"),
        ("", (1.0, 1.0), "sites of 1 x 1 pixels,", r"moved up to [\d.]+ pixels,"),
    ],
)
def test_the_repr_of_a_solution_states_lengths_with_their_unit(
    solution, tmp_path, unit, spacing, sizes, far
):
    told = replace(solution, unit=unit, spacing=spacing)
    assert re.search(f"{sizes} .*{far}", repr(told))
    assert Solution.read(told.write(tmp_path / "a.npz")).unit == unit


def test_the_solution_of_a_study_has_the_unit_of_its_grid(tmp_path):
    pull = Motion(hold_edge=True, drawing=Drawing((Arrow((5, 6), (0, 1), 1),)))
    study = Study(Grid((10, 12), 2, "mm"), Tissue(stiffness=np.ones((10, 12))), pull)
    solution = solve_study(study, backend="cpu")
    path = write_study(tmp_path / "a.study", study, replace(solution, unit=""))
    assert solution.unit == read_study(path).solution.unit == "mm"


@pytest.mark.parametrize("method", [Solution.at, Solution.move])
def test_points_that_are_all_outside_the_grid_are_rejected(solution, method):
    points = np.array([(4.0, 60.0), (20.0, 12.0), (-0.6, 1)])
    with pytest.raises(ProblemError, match=r"outside the grid of 20 x 24 pixels.*Grid\.to_pixels"):
        method(solution, points)
    some = method(solution, [*points, (19.4, -0.4)])
    assert some.shape == (4, 2)
    assert np.isfinite(some).all()
    assert method(solution, np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    "change",
    [
        {"displacement": np.zeros((19, 24, 2), np.float32)},
        {"displacement": np.zeros((20, 24, 3), np.float32)},
        {"tissue": np.ones((20, 25), bool)},
        {"spacing": (1.0, 1.0, 1.0)},
    ],
)
def test_the_arrays_of_a_solution_must_share_one_grid(solution, change):
    with pytest.raises(ProblemError, match="Use the same grid for all three"):
        replace(solution, **change)


def test_masked_images_are_rejected(solution):
    masked = np.ma.masked_less(np.random.default_rng(1).random((20, 24)), 0.5)
    with pytest.raises(ProblemError, match="image: is a masked array, whose mask would be lost"):
        solution.warp(masked)
