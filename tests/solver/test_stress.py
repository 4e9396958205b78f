"""Cauchy stress of each model, against exact solutions of mechanics."""

import numpy as np
import pytest

from napari_hmrf import (
    ElasticPrior,
    Multigrid,
    Problem,
    ProblemError,
    Provenance,
    Solution,
    solve,
)
from napari_hmrf.fields import hydrostatic_pressure, measure, von_mises_stress
from napari_hmrf.io.tables import measurement_table
from napari_hmrf.results.quantities import coloured, title_and_unit, values_of
from napari_hmrf.solver.elasticity import Elasticity

YOUNG, NU = 20.0, 0.3
SPACING = (0.5, 2.0, 1.0)


def moved(gradient, stiffness=None, *, nu=NU, run=None, **of_model):
    """Return the solution in which tissue has the same displacement gradient everywhere."""
    gradient = np.asarray(gradient, float)
    n = len(gradient)
    shape, spacing = (6, 7, 5)[:n], SPACING[-n:]
    sites = np.stack(np.indices(shape), axis=-1) * spacing
    m = np.full(shape, YOUNG, np.float32) if stiffness is None else stiffness
    return Solution(
        np.where(m[..., None] > 0, sites @ gradient.T, 0),
        np.zeros(1),
        (),
        m > 0,
        spacing,
        run or Provenance("cpu", "here"),
        elasticity=Elasticity(m, nu, **of_model),
    )


def expect(solution, stress):
    """Check that the tissue of a solution has this stress at all sites and elements."""
    for at in ("sites", "elements"):
        found = solution.stress(at=at)
        expected = np.broadcast_to(np.asarray(stress, float), found.shape)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * YOUNG)


def test_a_pulled_slice_bears_young_s_modulus_times_its_strain():
    bar = moved(np.diag([-NU * 0.01, 0.01]))
    expect(bar, np.diag([0, 0, YOUNG * 0.01]))
    np.testing.assert_allclose(bar.von_mises(), YOUNG * 0.01, rtol=1e-4)
    np.testing.assert_allclose(bar.pressure(at="elements"), -YOUNG * 0.01 / 3, rtol=1e-4)


def test_plane_strain_presses_on_the_neighbouring_slices():
    bar = moved(np.diag([-NU / (1 - NU) * 0.01, 0.01]), plane="strain")
    along = YOUNG * 0.01 / (1 - NU**2)
    expect(bar, np.diag([NU * along, 0, along]))


def test_squeezed_volumes_have_the_pressure_of_their_bulk_modulus():
    ball = moved(-0.01 * np.eye(3))
    bulk = YOUNG / (3 * (1 - 2 * NU))
    np.testing.assert_allclose(ball.pressure(), 0.03 * bulk, rtol=1e-4)
    assert ball.von_mises().max() < 1e-5 * YOUNG


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("finite", [False, True])
def test_tissue_that_grows_freely_has_no_stress(n, finite):
    growth = np.full((6, 7, 5)[:n], 0.2, np.float32)
    expect(moved(0.2 * np.eye(n), growth=growth, finite=finite), np.zeros((3, 3)))


def test_stress_of_large_motion_turns_with_the_tissue():
    along, mu = 1.5, YOUNG / (2 * (1 + NU))
    first = 2 * mu * NU / (1 - 2 * NU)
    # The sides are free: mu (t^2 - 1) + first / 2 (J^2 - 1) = 0, J = t^2 along.
    side = np.roots([first / 2 * along**2, mu, -mu - first / 2])
    thinner = np.sqrt(side.max())
    volume = thinner**2 * along
    tension = mu / volume * (along**2 - thinner**2)
    turn = np.deg2rad(70)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    stretch = np.diag([thinner, along])
    direction = rotation @ [0, 1]
    expected = np.zeros((3, 3))
    expected[1:, 1:] = tension * np.outer(direction, direction)
    expect(moved(rotation @ stretch - np.eye(2), finite=True), expected)
    expect(
        moved(np.diag([thinner, thinner, along]) - np.eye(3), finite=True), np.diag([0, 0, tension])
    )


def test_soft_and_stiff_tissue_in_a_row_bear_the_same_stress():
    stiffness = np.repeat([[1.0, 1, 1, 2, 4, 4, 4]], 6, axis=0).astype(np.float32)
    of_elements = (stiffness[:, 1:] + stiffness[:, :-1]) / 2
    strain = 0.1 / of_elements[0]
    d = np.zeros((6, 7, 2))
    d[:, 1:, 1] = np.cumsum(strain)
    made = moved(np.zeros((2, 2)), stiffness, nu=0.0)
    made = Solution(
        d, made.energy, (), made.tissue, (1.0, 1.0), made.provenance, elasticity=made.elasticity
    )
    expect(made, np.diag([0, 0, 0.1]))


def test_stress_is_unknown_where_the_model_has_none():
    stiffness = np.full((6, 7), YOUNG, np.float32)
    stiffness[:3, :3] = np.inf
    stiffness[5] = 0
    stiffness[5, 6] = YOUNG  # a lone site, in no element
    stress = moved(np.zeros((2, 2)), stiffness).von_mises()
    known = np.isfinite(stress)
    assert not known[:2, :2].any()
    assert not known[5].any()
    assert known[3:5].all()
    assert known[:5, 3:].all()


def test_the_paper_s_model_has_no_stress():
    made = moved(np.zeros((2, 2)))
    paper = Solution(made.displacement, made.energy, (), made.tissue, made.spacing, made.provenance)
    with pytest.raises(ProblemError) as refusal:
        paper.stress()
    assert refusal.value.field == "solution"
    (row,) = measure(paper, np.ones(paper.tissue.shape, int))
    assert row.mean_von_mises is None
    assert not any("von_mises" in title for title in measurement_table([row])[0])


def test_overlays_and_measurements_show_stress_in_the_unit_of_stiffness():
    run = Provenance("cpu", "here", parameters={"tissue": {"unit": "kPa"}})
    bar = moved(np.diag([-NU * 0.01, 0.01]), run=run)
    assert title_and_unit("von_mises", bar) == ("von Mises stress", "kPa")
    assert title_and_unit("pressure", moved(np.zeros((2, 2))))[1] == "relative"
    np.testing.assert_allclose(values_of(bar, "von_mises", 0.5), YOUNG * 0.005, rtol=1e-4)
    assert coloured(bar, "pressure").signed
    (row,) = measure(bar, np.ones(bar.tissue.shape, int))
    assert row.mean_von_mises == pytest.approx(YOUNG * 0.01, rel=1e-4)
    assert row.mean_pressure == pytest.approx(-YOUNG * 0.01 / 3, rel=1e-4)
    titles, (cells,) = measurement_table([row])
    assert cells[titles.index("largest_von_mises_stress_kPa")] == row.largest_von_mises


def test_stress_is_that_of_the_files(tmp_path):
    bar = moved(np.diag([-NU * 0.01, 0.01]))
    again = Solution.read(bar.write(tmp_path / "bar.npz"))
    np.testing.assert_array_equal(again.stress(), bar.stress())


def test_stress_measures_take_tensors():
    assert von_mises_stress(np.diag([3.0, 3, 3])) == 0
    assert hydrostatic_pressure(np.diag([3.0, 0, 0])) == -1
    with pytest.raises(ProblemError) as refusal:
        von_mises_stress(np.zeros((2, 2)))
    assert refusal.value.field == "stress"


def kirsch_displacement(rows, cols, radius, tension, young, nu):
    """Return the displacement of a plate with a hole that is pulled along its columns."""
    r, angle = np.maximum(np.hypot(rows, cols), 1.0), np.arctan2(rows, cols)
    mu, kappa = young / (2 * (1 + nu)), (3 - nu) / (1 + nu)
    a, size = radius, tension * radius / (8 * mu)
    cubic = a**3 / r**3
    along = r / a * (kappa + 1) * np.cos(angle)
    along += 2 * a / r * ((1 + kappa) * np.cos(angle) + np.cos(3 * angle)) - 2 * cubic * np.cos(
        3 * angle
    )
    across = r / a * (kappa - 3) * np.sin(angle)
    across += 2 * a / r * ((1 - kappa) * np.sin(angle) + np.sin(3 * angle)) - 2 * cubic * np.sin(
        3 * angle
    )
    return np.stack([size * across, size * along], axis=-1)


def peak_beside_hole(radius):
    """Return the largest tension three pixels or more from a hole, for a tension of 1 far away."""
    half = 3 * radius
    rows, cols = np.indices((2 * half + 1, 2 * half + 1)) - float(half)
    away = np.hypot(rows, cols)
    tissue = away >= radius
    exact = kirsch_displacement(rows, cols, radius, 0.01, 1.0, NU) * tissue[..., None]
    confidence = np.zeros_like(exact)
    confidence[[0, -1]] = confidence[:, [0, -1]] = 1
    problem = Problem(observed=exact, confidence=confidence, stiffness=tissue.astype(float))
    made = solve(problem, ElasticPrior(NU), optimizer=Multigrid(1e-4), backend="cpu")
    return float(made.stress()[away >= radius + 3, 2, 2].max()) / 0.01


def test_the_peak_beside_a_hole_tends_to_three_away_from_the_staircase():
    coarse, fine = peak_beside_hole(10), peak_beside_hole(40)
    exact = [1 + 0.5 * ratio**2 + 1.5 * ratio**4 for ratio in (10 / 13, 40 / 43)]
    assert [coarse, fine] == pytest.approx(exact, rel=0.05)
    assert 3 > fine > 1.3 * coarse
