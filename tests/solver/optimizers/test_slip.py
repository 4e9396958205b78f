"""Where observations slip, there is one answer: also where forces tie, or nothing holds a piece."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.rigid_modes import free_motions

PENALTY = 1e-9


def torn(contrast, spacing=(1.0, 1.0), shape=(6, 7), seed=0):
    """A block whose first row is said to move by 1 pixel, and its last by 3, equally surely."""
    rng = np.random.default_rng(seed)
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[[0, -1]] = 1
    y[0, :, 0], y[-1, :, 0] = 1, 3
    m = contrast ** rng.random(shape)
    return Problem(y * np.sqrt(spacing[0] * spacing[1]), c, m, spacing=spacing)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.4, 1.0)])
@pytest.mark.parametrize(
    ("reading", "contrast"),
    [("elastic", 1.0), ("elastic", 1e3), ("elastic", 1e6), ("blanket", 1e3), ("blanket", 1e6)],
)
def test_of_all_places_that_cost_the_same_a_piece_takes_the_nearest(reading, contrast, spacing):
    problem = torn(contrast, spacing)
    prior = (
        ElasticPrior(penalty=PENALTY)
        if reading == "elastic"
        else SeilerPrior(penalty=PENALTY, conditional=reading)
    )
    found = solve(problem, prior, optimizer=Multigrid(1e-4))
    np.testing.assert_allclose(found.displacement[..., 0] / problem.unit, 1, atol=1e-4)
    np.testing.assert_allclose(found.displacement[..., 1], 0, atol=1e-4)
    assert found.convergence.error <= 1e-4


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.3, 1.0), (2.0, 0.7)])
def test_a_free_motion_costs_nothing_whatever_the_shape_of_pixels(spacing):
    shape = (7, 9)
    c = np.zeros((*shape, 2))
    c[2, 3] = 1
    problem = Problem(0 * c, c, np.ones(shape), spacing=spacing)
    (ways,) = free_motions(problem, problem.known)
    assert len(ways) == 1
    model = CpuElasticModel(ElasticPrior().material(problem))
    energy, _ = model.work(host.planes(ways[0]))
    assert abs(energy) < 1e-17, "rounding, of either sign"


@pytest.mark.parametrize("penalty", [None, 0.1])
@pytest.mark.parametrize("shape", [(2, 2), (1, 2)])
def test_what_no_clique_pulls_at_stays_where_it_was_seen(shape, penalty):
    y = np.random.default_rng(1).normal(size=(*shape, 2)) / 4
    problem = Problem(y, np.ones((*shape, 2)), np.ones(shape))
    found = solve(
        problem, SeilerPrior(penalty=penalty, conditional="blanket"), optimizer=Multigrid()
    ).displacement
    np.testing.assert_allclose(found, y, atol=1e-6)


def test_a_stiff_part_that_hangs_on_soft_tissue_is_where_its_weakest_side_allows():
    # A bar whose stiff half is pulled at by one observation that gives way.
    m = np.ones((3, 12))
    m[:, 6:] = 1e5
    y, c = np.zeros((3, 12, 2)), np.zeros((3, 12, 2))
    c[:, 0] = 1
    c[1, -1, 1] = 1
    y[1, -1, 1] = 2
    ends = []
    for penalty in (1e-8, 2e-8):
        found = solve(Problem(y, c, m), ElasticPrior(penalty=penalty), optimizer=Multigrid(1e-5))
        ends.append(found.displacement[1, -1, 1] / penalty)
    # It slips, so it moves in proportion to the force.
    assert ends[1] == pytest.approx(ends[0], rel=1e-2)


@pytest.mark.parametrize("penalty", [None, 0.01])
def test_a_row_that_tilts_at_no_cost_is_refused_whatever_rounding_makes_of_it(penalty):
    # Two sites hang on the middle one alone, and their tilt moves nothing else. Stiff tissue beside
    # soft tissue rounds the factors so coarsely that the tilt seems to cost something.
    stiff, soft = 25123.590, 0.014527673
    m = np.array([[0, 1, 0], [1, 1, 1], [1, 1, 1], [0, 1, 1], [0, 0, 0]]) * stiff
    m[3, 0] = m[4, 1] = soft
    y, c = np.zeros((5, 3, 2)), np.zeros((5, 3, 2))
    c[2, 0] = 1
    y[2, 0] = (0.14, 0.03)
    prior = SeilerPrior(penalty=penalty, conditional="blanket")
    with pytest.raises(
        ProblemError, match=r"8 pixels around \(2, 1\) could still bend along the col"
    ):
        solve(Problem(y, c, m), prior, optimizer=Multigrid(), backend="cpu")
    # A second mark in the row stops it.
    c[2, 2, 1] = 1
    found = solve(Problem(y, c, m), prior, optimizer=Multigrid(), backend="cpu").displacement
    np.testing.assert_allclose(found[1:4, 1, 1], found[2, [0, 2], 1].mean(), atol=1e-3)
