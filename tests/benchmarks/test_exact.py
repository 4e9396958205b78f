"""Tests of the exact solver of the random problems: closed forms, fractions and other solvers."""

from fractions import Fraction

import numpy as np
import pytest
from exact import exact_field
from exact.direct import Factors
from exact.matrices import matrix_of

from napari_hmrf import ElasticPrior, Problem, SeilerPrior
from tests.support import paper_oracle as oracle
from tests.support.elastic_oracle import direct_solution


def patterned(shape, contrast, seed=0, spacing=(1.0, 1.0)):
    """Return a problem with two tissues and a hole, fixed at the top and pushed at the bottom."""
    dice = np.random.default_rng(seed)
    m = np.where(dice.random(shape) < 0.5, 1.0, contrast)
    m[shape[0] // 2, shape[1] // 2] = 0
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[0] = c[-1] = 1
    y[-1] = dice.normal(size=(shape[1], 2))
    return Problem(y, c, m, spacing=spacing)


PRIORS = [
    ElasticPrior(0.3),
    ElasticPrior(0.499, plane="strain"),
    SeilerPrior(),
    SeilerPrior(conditional="blanket"),
]


@pytest.mark.parametrize("prior", PRIORS, ids=repr)
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.3, 2.0)])
def test_the_matrix_gives_the_forces_of_the_definitions(prior, spacing):
    problem = patterned((6, 7), 30.0, spacing=spacing)
    d = np.random.default_rng(1).normal(size=(6, 7, 2)) * problem.unit
    pull = matrix_of(problem, prior).times(d.ravel() / problem.unit)[0]
    if isinstance(prior, ElasticPrior):
        expected = prior.forces(problem, d)
    else:
        curvature, lowest = prior.site_parabola(problem, d)
        expected = 2 * curvature * (d - lowest) / problem.unit
    np.testing.assert_allclose(pull, expected.ravel(), rtol=0, atol=1e-13 * np.abs(pull).max())


@pytest.mark.parametrize("prior", PRIORS, ids=repr)
def test_a_direct_solution_equals_the_solution_in_fractions(prior):
    problem = patterned((4, 4), 1e6)
    matrix = matrix_of(problem, prior)
    unknowns = np.flatnonzero((matrix.diagonal > 0) & ~problem.known.ravel())
    right = np.random.default_rng(2).normal(size=matrix.size)
    found = Factors(matrix, unknowns).solution(right)
    entry = {
        (int(i), int(j)): Fraction(float(high)) + Fraction(float(low))
        for i, j, high, low in zip(
            matrix.rows, matrix.columns, matrix.high, matrix.low, strict=True
        )
    }
    rows = [
        [entry.get((int(i), int(j)), Fraction(0)) for j in unknowns] + [Fraction(right[i])]
        for i in unknowns
    ]
    for k, pivot in enumerate(rows):
        for other in rows:
            if other is not pivot and other[k]:
                factor = other[k] / pivot[k]
                other[:] = [a - factor * b for a, b in zip(other, pivot, strict=True)]
    for k, i in enumerate(unknowns):
        exact = rows[k][-1] / rows[k][k]
        assert abs(Fraction(found[0][i]) + Fraction(found[1][i]) - exact) <= abs(exact) * 10**-14


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_the_exact_elastic_field_equals_that_of_the_other_solver(plane):
    nu = np.random.default_rng(3).uniform(0, 0.49, (9, 8)).astype(np.float32)
    problem = patterned((9, 8), 100.0, spacing=(2.0, 0.7))
    prior = ElasticPrior(nu, plane=plane)
    expected = direct_solution(problem, prior) / problem.unit
    found = exact_field(problem, prior)
    np.testing.assert_allclose(found.displacement, expected, rtol=0, atol=1e-10)
    assert found.sure
    assert not found.free
    assert found.motions == 0


def test_the_exact_centred_field_equals_that_of_the_other_solver():
    problem = patterned((9, 8), 100.0)
    found = exact_field(problem, SeilerPrior())
    np.testing.assert_allclose(
        found.displacement, oracle.centred_fixed_point(problem), rtol=0, atol=1e-10
    )


def slippery(seed, shape=(6, 5)):
    """Return a problem with random observations at many sites."""
    dice = np.random.default_rng(seed)
    observed = dice.random((*shape, 2)) < 0.6
    c = np.where(observed, dice.choice([0.5, 1.0], observed.shape), 0)
    return Problem(dice.normal(size=(*shape, 2)), c, 10 ** dice.uniform(0, 3, shape))


@pytest.mark.parametrize("penalty", [0.03, 1.0, 30.0, 1000.0])
@pytest.mark.parametrize("seed", range(4))
def test_each_site_of_a_centred_field_minimises_its_own_energy(penalty, seed):
    problem = slippery(seed)
    prior = SeilerPrior(penalty=penalty)
    found = exact_field(problem, prior)
    assert found.sure
    curvature, lowest = prior.site_parabola(problem, found.displacement)
    reach = penalty * problem.confidence / (2 * np.where(curvature > 0, curvature, 1))
    off = lowest - problem.observed
    best = problem.observed + np.sign(off) * np.maximum(np.abs(off) - reach, 0)
    np.testing.assert_allclose(
        found.displacement[curvature > 0], best[curvature > 0], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("penalty", [0.003, 0.1, 3.0, 100.0])
@pytest.mark.parametrize("prior", [PRIORS[0], PRIORS[1], PRIORS[3]], ids=repr)
@pytest.mark.parametrize("seed", range(4))
def test_no_perturbed_field_has_less_energy_than_the_exact_field(penalty, prior, seed):
    problem = slippery(seed)
    elastic = isinstance(prior, ElasticPrior)
    prior = (
        ElasticPrior(prior.poisson, plane=prior.plane, penalty=penalty)
        if elastic
        else SeilerPrior(penalty=penalty, conditional="blanket")
    )
    found = exact_field(problem, prior)
    assert found.sure

    def energy(d):
        if not elastic:
            return oracle.total_energy(problem, d, penalty)
        held = penalty * problem.confidence.astype(float) * np.abs(problem.observed - d)
        return prior.energy(problem, d) + held.sum()

    least = energy(found.displacement)
    dice = np.random.default_rng(seed)
    for size in (1e-5, 1e-3, 0.1):
        for way in (*dice.normal(size=(5, 6, 5, 2)), problem.observed - found.displacement):
            assert energy(found.displacement + size * way) >= least - 1e-12 * abs(least)


def test_a_bar_of_two_halves_is_stretched_like_springs_in_series():
    m = np.ones((9, 3))
    m[:4] = 10
    c, y = np.zeros((9, 3, 2)), np.zeros((9, 3, 2))
    c[0] = c[-1] = 1
    y[-1, :, 0] = 2
    # The stiffness of an element is the mean over its sites. With nu = 0 there is no lateral force.
    softness = 1 / ((m[:-1, 0] + m[1:, 0]) / 2)
    expected = 2 * np.concatenate([[0], np.cumsum(softness)]) / softness.sum()
    found = exact_field(Problem(y, c, m), ElasticPrior(0.0)).displacement
    np.testing.assert_allclose(found[..., 0], np.repeat(expected[:, None], 3, axis=1), atol=1e-14)
    np.testing.assert_allclose(found[..., 1], 0, atol=1e-14)


def test_a_slipping_bar_is_stretched_by_the_holding_force():
    c, y = np.zeros((9, 3, 2)), np.zeros((9, 3, 2))
    c[0] = 1
    c[-1, :, 0] = (0.5, 1.0, 0.5)
    y[-1, :, 0] = 7
    found = exact_field(Problem(y, c, np.ones((9, 3))), ElasticPrior(0.0, penalty=0.25))
    # Force 0.25 (0.5 + 1 + 0.5) on a width of 2, a length of 8 and a stiffness of 1.
    np.testing.assert_allclose(found.displacement[-1, :, 0], 0.25 * 8, atol=1e-14)
    assert found.motions == 0


@pytest.mark.parametrize(
    ("marks", "where", "motions"),
    [
        ((1.0, 3.0), 1.0, 1),
        ((-1.0, 2.0), 0.0, 1),
        ((-3.0, -2.0), -2.0, 1),
        ((1.0, 2.0, 9.0), 2.0, 0),
    ],
)
def test_tissue_between_marks_of_equal_force_has_the_smallest_displacement(marks, where, motions):
    y, c = np.zeros((4, 4, 2)), np.zeros((4, 4, 2))
    # Prescribe columns, which prevents rotation, and observe whole rows with weak forces.
    c[:, :2, 1] = 1
    for j, mark in enumerate(marks):
        y[j, :, 0], c[j, :, 0] = mark, 1
    problem = Problem(y, c, np.ones((4, 4)))
    found = exact_field(problem, ElasticPrior(0.0, penalty=1e-9))
    assert found.sure
    np.testing.assert_allclose(found.displacement[..., 0], where, atol=1e-6)
    assert found.motions == motions


@pytest.mark.parametrize("prior", [ElasticPrior(0.3), ElasticPrior(0.3, penalty=5.0)], ids=repr)
def test_tissue_that_may_rotate_is_free_and_has_the_smallest_displacement(prior):
    c, y = np.zeros((5, 5, 2)), np.zeros((5, 5, 2))
    c[2, 2], y[2, 2] = 1, (1, 2)
    found = exact_field(Problem(y, c, np.ones((5, 5))), prior)
    assert found.free
    assert found.motions == 1
    np.testing.assert_allclose(found.displacement, np.broadcast_to([1, 2], (5, 5, 2)), atol=1e-12)


def test_tissue_without_elastic_forces_remains_at_rest_or_at_its_observation():
    m = np.zeros((5, 7))
    m[:, :4] = m[0, 5] = m[4, 6] = 1
    c, y = np.zeros((5, 7, 2)), np.zeros((5, 7, 2))
    c[0, :4] = c[4, 6] = 1
    y[4, 6] = (3, 4)
    found = exact_field(Problem(y, c, m), ElasticPrior(0.3))
    assert not found.moving[:, 4:].any()
    assert not found.free
    np.testing.assert_array_equal(found.displacement[4, 6], [3, 4])
    np.testing.assert_array_equal(found.displacement[0, 5], [0, 0])


@pytest.mark.parametrize("prior", [PRIORS[0], PRIORS[1], PRIORS[3]], ids=repr)
def test_the_smallest_eigenvalue_equals_that_of_a_dense_matrix(prior):
    problem = patterned((7, 6), 300.0)
    matrix = matrix_of(problem, prior)
    unknowns = np.flatnonzero((matrix.diagonal > 0) & ~problem.known.ravel())
    dense = np.zeros((matrix.size, matrix.size))
    dense[matrix.rows, matrix.columns] = matrix.high
    root = np.sqrt(matrix.diagonal[unknowns])
    expected = np.linalg.eigvalsh(dense[np.ix_(unknowns, unknowns)] / np.outer(root, root))[0]
    assert exact_field(problem, prior).least == pytest.approx(expected, rel=0.01)


def test_a_zigzag_of_three_rows_has_zero_clique_energy():
    zigzag = np.zeros((3, 6, 2))
    zigzag[0, :, 0] = [1, -1, 1, -1, 1, -1]
    zigzag[2] = -zigzag[0]
    c = np.zeros((3, 6, 2))
    c[1] = 1
    problem = Problem(np.zeros_like(c), c, np.ones((3, 6)))
    assert oracle.total_energy(problem, zigzag, 0.0) == 0
    found = exact_field(problem, SeilerPrior(conditional="blanket"))
    assert found.free
    c[0] = 1
    firm = Problem(np.zeros_like(c), c, np.ones((3, 6)))
    assert not exact_field(firm, SeilerPrior(conditional="blanket")).free
    np.testing.assert_allclose(found.displacement, 0, atol=1e-15)


def test_a_stiff_inclusion_in_soft_tissue_is_not_free():
    m = np.ones((32, 32))
    m[4:28, 4:28] = 1e6
    c, y = np.zeros((32, 32, 2)), np.zeros((32, 32, 2))
    c[:, 0] = c[:, -1] = 1
    y[:, -1] = (1, 2)
    found = exact_field(Problem(y, c, m), ElasticPrior(0.3))
    assert 1e-12 < found.least < 1e-6
    assert not found.free
    # By symmetry, the inclusion moves by half of the distance for any stiffness.
    middle = found.displacement[15:17, 15:17].mean(axis=(0, 1))
    np.testing.assert_allclose(middle, [0.5, 1.0], rtol=0, atol=1e-12)


def test_the_exact_field_satisfies_the_optimality_conditions_at_any_contrast():
    """Evaluate forces and distances again, independently of the solver."""
    for seed in range(6):
        dice = np.random.default_rng(seed)
        problem = slippery(seed)
        m = np.where(dice.random(problem.shape) < 0.5, 1.0, 9e5)
        problem = Problem(problem.observed, problem.confidence, m)
        for prior in (
            ElasticPrior(0.45, penalty=0.01),
            SeilerPrior(penalty=1.0, conditional="blanket"),
        ):
            found = exact_field(problem, prior)
            assert found.sure
            force = -matrix_of(problem, prior).times(found.displacement.ravel())[0]
            limit = prior.penalty * problem.confidence.ravel().astype(float)
            # Rounding a displacement to float64 changes the forces by this amount.
            rounding = 1e-15 * matrix_of(problem, prior).diagonal.max()
            assert (np.abs(force) <= limit * (1 + 1e-9) + rounding).all()
            off = (found.displacement - problem.observed).ravel()
            slips = (np.abs(off) > 1e-8) & (limit > 0)
            np.testing.assert_allclose(
                force[slips], (np.sign(off) * limit)[slips], rtol=1e-9, atol=rounding
            )
