"""Elastic strain of each model, without growth and with the out-of-plane component."""

import numpy as np
import pytest

from napari_hmrf import (
    ElasticPrior,
    Material,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    SeilerPrior,
    Solution,
    solve,
    solve_study,
)
from napari_hmrf.fields import equivalent_strain, measure
from napari_hmrf.io.tables import measurement_table, write_measurements
from napari_hmrf.loads import Loads, growth
from napari_hmrf.random import RandomDeformation
from napari_hmrf.results.animation import Motion
from napari_hmrf.results.quantities import title_and_unit, values_of
from napari_hmrf.results.tissue_point import Points
from napari_hmrf.solver.elastic_strain import strain_note
from napari_hmrf.ui.result.result_tables import measurements_in_words

NU = 0.45
TIGHT = Multigrid(1e-4)


def bar(prior, far=0.1, *, shape=(10, 40), loads=None, optimizer=TIGHT):
    """Return a solved bar that is stretched along its columns and free to contract."""
    y, c = np.zeros((2, *shape, len(shape)))
    y[..., -1, -1] = far * (shape[-1] - 1)
    c[..., [0, -1], -1] = 1
    corner = (0,) * len(shape)
    c[corner] = 1
    c[(*corner[:-1], -1, slice(-1))] = 1
    if len(shape) == 3:
        c[-1, 0, 0, 1] = 1
    problem = Problem(observed=y, confidence=c, stiffness=np.ones(shape), loads=loads)
    return solve(problem, prior, optimizer=optimizer, backend="cpu")


def free_disc(prior, amount=0.15, shape=(24, 24), tensor=None):
    """Return a solved disc or ball that grows without resistance."""
    sites = np.stack(np.indices(shape), axis=-1) - (np.array(shape) - 1) / 2
    disc = (sites**2).sum(axis=-1) < (shape[0] / 2 - 2) ** 2
    c = np.zeros((*shape, len(shape)))
    at = [size // 2 for size in shape]
    c[tuple(at)] = 1
    for axis in range(len(shape) - 1):  # free along its own axis, but unable to rotate
        there = [*at]
        there[axis] += 2
        c[(*there, slice(axis + 1, None))] = 1
    grown = (
        growth(amount * disc) if tensor is None else Loads(growth=disc[..., None, None] * tensor)
    )
    problem = Problem(
        observed=np.zeros_like(c), confidence=c, stiffness=disc.astype(float), loads=grown
    )
    return solve(problem, prior, optimizer=TIGHT, backend="cpu")


def measured_row(solution):
    (row,) = measure(solution, np.ones(solution.tissue.shape, int))
    return row


def test_a_stretched_bar_has_the_strain_of_linear_plane_stress():
    row = measured_row(bar(ElasticPrior(NU)))
    # The von Mises equivalent of the small strain 0.1 (1, -nu, -nu) is 2/3 (1 + nu) 0.1.
    assert row.mean_strain == pytest.approx(9.667, abs=0.01)
    assert row.largest_strain == pytest.approx(9.667, abs=0.03)
    assert row.strain == "elastic"


def test_a_stretched_bar_has_the_strain_of_plane_strain():
    row = measured_row(bar(ElasticPrior(NU, plane="strain")))
    other = -NU / (1 - NU) * 0.1
    expected = equivalent_strain(np.diag([other, 0.1]), 0.0)
    assert row.mean_strain == pytest.approx(100 * float(expected), abs=0.02)


def test_strain_uses_the_poisson_ratio_of_each_site():
    nu = np.full((10, 40), 0.2, np.float32)
    nu[:, 20:] = 0.45
    solution = bar(ElasticPrior(nu))
    strain = solution.strain()
    for column, ratio in ((8, 0.2), (32, 0.45)):
        inside = strain[5, column]
        within = inside[1, 1] + inside[2, 2]
        assert inside[0, 0] == pytest.approx(-ratio / (1 - ratio) * within, rel=1e-4)


def test_a_stretched_bar_in_a_volume_is_strained_in_all_three_directions():
    row = measured_row(bar(ElasticPrior(NU), shape=(5, 5, 12)))
    assert row.mean_strain == pytest.approx(9.667, abs=0.02)
    assert row.strain == "elastic"


def test_a_bar_in_large_motion_has_no_stress_through_its_thickness():
    solution = bar(NeoHookeanPrior(NU), 0.5)
    strain = solution.strain()[5, 20].astype(float)
    stretches = np.sqrt(1 + 2 * np.diag(strain))
    mu, lame = 1.0, 2 * NU / (1 - 2 * NU)
    volume = stretches.prod()
    # Stress of the energy mu/2 (I - 3) - mu ln J + lambda/4 (J^2 - 1 - 2 ln J).
    pressure = lame / 2 * (volume**2 - 1)
    stress = mu * (stretches**2 - 1) + pressure
    assert stress[0] == pytest.approx(0, abs=1e-3)
    assert stress[1] == pytest.approx(0, abs=1e-3), "the free side of the bar should have no stress"
    assert stress[2] > 0.5
    assert stretches[2] == pytest.approx(1.5, abs=1e-3)
    flat = bar(NeoHookeanPrior(NU, plane="strain"), 0.3).strain()[5, 20]
    assert flat[0, 0] == 0


@pytest.mark.parametrize(
    ("prior", "shape"),
    [
        (ElasticPrior(NU), (24, 24)),
        (ElasticPrior(NU), (10, 10, 10)),
        (NeoHookeanPrior(NU), (24, 24)),
    ],
)
def test_freely_growing_tissue_has_no_elastic_strain(prior, shape):
    solution = free_disc(prior, shape=shape)
    row = measured_row(solution)
    assert row.largest_strain == pytest.approx(0, abs=0.05)
    assert row.size_change == pytest.approx(100 * (1.15 ** len(shape) - 1), rel=0.1)
    assert np.nanmax(np.abs(solution.strain("total"))) > 0.1


@pytest.mark.parametrize("prior", [ElasticPrior(NU), NeoHookeanPrior(NU)])
@pytest.mark.parametrize("through", [(), (0.3,)])
def test_growth_along_each_direction_is_removed_from_the_strain(prior, through):
    along = np.diag([*through, 0.0, 0.2])
    assert measured_row(free_disc(prior, tensor=along)).largest_strain == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("prior", [ElasticPrior, NeoHookeanPrior])
def test_growth_in_plane_strain_compresses_tissue_through_the_thickness(prior):
    solution = free_disc(prior(NU, plane="strain"), 0.1)
    strain = solution.strain()[12, 12].astype(float)
    if prior is ElasticPrior:
        assert strain[0, 0] == pytest.approx(-0.1, abs=1e-6)
        # The in-plane stress lambda tr(e) + 2 mu e is 0.
        inside = NU / (1 - 2 * NU) * np.trace(strain) + strain[1, 1]
    else:
        stretches = np.sqrt(1 + 2 * np.diag(strain))
        assert stretches[0] == pytest.approx(1 / 1.1, abs=1e-5)
        lame = 2 * NU / (1 - 2 * NU)
        inside = stretches[1] ** 2 - 1 + lame / 2 * (stretches.prod() ** 2 - 1)
    assert inside == pytest.approx(0, abs=2e-3)
    assert measured_row(solution).mean_strain > 5


def test_growth_that_varies_within_tissue_is_removed_element_by_element():
    shape = (12, 30)
    amount = np.broadcast_to(0.2 * (np.arange(30) >= 15), shape)
    along = np.zeros((*shape, 2, 2))
    along[..., 1, 1] = amount
    row = measured_row(bar_that_grows(along))
    assert row.largest_strain == pytest.approx(0, abs=0.05), (
        "a bar that is free to grow should have no strain"
    )


def bar_that_grows(tensor):
    shape = tensor.shape[:2]
    c = np.zeros((*shape, 2))
    c[:, 0, 1], c[0, 0, 0] = 1, 1
    problem = Problem(
        observed=np.zeros_like(c),
        confidence=c,
        stiffness=np.ones(shape),
        loads=Loads(growth=tensor),
    )
    return solve(problem, ElasticPrior(NU), optimizer=TIGHT, backend="cpu")


def test_the_strain_of_the_paper_model_is_reported_as_in_plane(tmp_path):
    solution = bar(SeilerPrior(), optimizer=Multigrid())
    row = measured_row(solution)
    assert row.strain == "in-plane"
    assert "no third direction" in strain_note(solution)
    with pytest.raises(ProblemError, match="no elastic strain: the paper's model has no Poisson"):
        solution.strain()
    expected = equivalent_strain(solution.strain("total"))
    assert row.mean_strain == pytest.approx(100 * float(expected.mean()), rel=1e-5)
    titles, _ = measurement_table([row])
    assert "mean_in_plane_strain_percent" in titles
    words, _ = measurements_in_words([row], "px")
    assert "in-plane strain, mean (%)" in words
    assert title_and_unit("stretch", solution) == ("maximum in-plane stretch", "%")
    path = write_measurements(tmp_path / "a.csv", [row], "px")
    assert "largest_in_plane_strain_percent,folds,unit" in path.read_text().splitlines()[0]


@pytest.mark.parametrize(
    "prior",
    [ElasticPrior(NU), ElasticPrior(np.full((24, 24), 0.3, np.float32)), NeoHookeanPrior(0.3)],
)
def test_a_solution_file_stores_the_data_for_elastic_strain(prior, tmp_path):
    solution = free_disc(prior)
    again = Solution.read(solution.write(tmp_path / "grown"))
    assert np.array_equal(again.strain(), solution.strain(), equal_nan=True)
    assert strain_note(again) == ""


def test_rigid_tissue_has_no_strain(tmp_path):
    y, c = np.zeros((2, 24, 24, 2))
    y[:, -1, 1], c[:, [0, -1]] = 2, 1
    stiffness = np.ones((24, 24))
    stiffness[8:16, 8:16] = np.inf
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=stiffness), optimizer=TIGHT, backend="cpu"
    )
    soft, bone = measure(solution, np.isinf(stiffness))
    assert (bone.mean_strain, bone.largest_strain) == (0, 0)
    assert soft.mean_strain > 5
    again = Solution.read(solution.write(tmp_path / "bone"))
    assert measure(again, np.isinf(stiffness)) == (soft, bone)


def test_colours_points_and_a_movie_show_the_same_strain():
    solution = free_disc(ElasticPrior(NU))
    strained = bar(ElasticPrior(NU))
    shown = values_of(strained, "equivalent")
    assert float(shown.mean()) == pytest.approx(measured_row(strained).mean_strain, rel=1e-5)
    assert np.allclose(shown / 100, equivalent_strain(strained.strain()), atol=1e-6)
    assert Points(strained).at((5, 20), 1.0).strain == pytest.approx(float(shown[5, 20]), rel=1e-3)
    assert np.nanmax(values_of(solution, "equivalent", 0.5)) == pytest.approx(0, abs=0.05)
    assert np.nanmax(np.abs(values_of(solution, "rows"))) == pytest.approx(0, abs=0.05)
    whole = values_of(strained, "equivalent")
    film = Motion(strained, overlay=whole, quantity="equivalent")
    assert film.quantity == "equivalent"
    assert title_and_unit("equivalent", strained) == ("equivalent elastic strain", "%")


def test_a_random_sample_has_the_same_strain_as_a_full_solve():
    labels = np.ones((24, 24), int)
    labels[8:16, 8:16] = 2
    rows = [Material(1, "soft", 1.0, 0.4), Material(2, "tumour", 2.0, 0.45, growth=0.1)]
    sample = RandomDeformation(
        labels, rows, amplitude=0.5, patches=2, backend="cpu", spacing=1
    ).sample(3)
    solved = solve_study(sample.study, backend="cpu")
    assert np.allclose(sample.solution.strain(), solved.strain(), atol=2e-3)
