"""Slip: balanced forces, unconstrained pieces, and the reported error."""

import itertools

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.rigid_modes import free_motions
from validation.bodies import dice_of
from validation.oracles.exact import exact_field
from validation.problems import edits_of, mild_tissue, random_problem

PENALTY = 1e-9


def contradictory_problem(contrast, spacing=(1.0, 1.0), shape=(6, 7), seed=0):
    """Return a block observed to move by 1 px in its first row and 3 px in its last row."""
    rng = np.random.default_rng(seed)
    y, c = np.zeros((*shape, 2)), np.zeros((*shape, 2))
    c[[0, -1]] = 1
    y[0, :, 0], y[-1, :, 0] = 1, 3
    m = contrast ** rng.random(shape)
    return Problem(
        observed=y * np.sqrt(spacing[0] * spacing[1]), confidence=c, stiffness=m, spacing=spacing
    )


def check_reported_error(problem, prior, tolerance, start=None):
    """Compare a solution with the exact one."""
    found = solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu", initial=start)
    exact = exact_field(problem, prior).displacement
    error = np.linalg.norm(found.displacement / problem.unit - exact, axis=-1)
    assert error[problem.tissue].max() <= found.convergence.error <= tolerance


def test_the_reported_error_includes_observations_that_have_yet_to_slip():
    drawn = random_problem(dice_of(2, 39))
    check_reported_error(drawn.problem, drawn.prior, 0.1)


@pytest.mark.parametrize(
    ("number", "edit"),
    [
        pytest.param(1, 2, id="a motion of a part beside a gap"),
        pytest.param(39, 1, id="motions that are left after many exchanges"),
    ],
)
def test_the_reported_error_includes_slow_motions_after_an_edit(number, edit):
    edits = edits_of(mild_tissue(dice_of(0, number, 2)), dice_of(0, number, 1))
    (_, before), (_, edited) = itertools.islice(edits, edit - 1, edit + 1)
    start = solve(*before, optimizer=Multigrid(0.01), backend="cpu")
    check_reported_error(*edited, 0.01, start)


@pytest.mark.parametrize(
    ("reading", "contrast", "spacing"),
    [
        ("elastic", 1.0, (1.0, 1.0)),
        ("elastic", 1e6, (0.4, 1.0)),
        ("blanket", 1e3, (0.4, 1.0)),
        ("blanket", 1e6, (1.0, 1.0)),
    ],
)
def test_a_piece_moves_to_the_nearest_of_equally_good_positions(reading, contrast, spacing):
    problem = contradictory_problem(contrast, spacing)
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
def test_a_free_rigid_motion_has_no_energy_for_any_pixel_shape(spacing):
    shape = (7, 9)
    c = np.zeros((*shape, 2))
    c[2, 3] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones(shape), spacing=spacing)
    (ways,) = free_motions(problem, problem.known)
    assert len(ways) == 1
    model = CpuElasticModel(ElasticPrior().material(problem))
    energy, _ = model.work(host.planes(ways[0]))
    assert abs(energy) < 1e-17, "the energy exceeds rounding errors"


@pytest.mark.parametrize(("shape", "penalty"), [((2, 2), 0.1), ((1, 2), None)])
def test_sites_outside_all_cliques_match_their_observation(shape, penalty):
    y = np.random.default_rng(1).normal(size=(*shape, 2)) / 4
    problem = Problem(observed=y, confidence=np.ones((*shape, 2)), stiffness=np.ones(shape))
    found = solve(
        problem, SeilerPrior(penalty=penalty, conditional="blanket"), optimizer=Multigrid()
    ).displacement
    np.testing.assert_allclose(found, y, atol=1e-6)


def test_a_stiff_part_on_soft_tissue_moves_in_proportion_to_the_slip_force():
    # One slipping observation pulls the stiff half of a bar, by its penalty times its confidence.
    m = np.ones((3, 12))
    m[:, 6:] = 1e5
    y, c = np.zeros((3, 12, 2)), np.zeros((3, 12, 2))
    c[:, 0] = 1
    y[1, -1, 1] = 2
    ends = []
    for penalty, confidence in ((1e-8, 1.0), (4e-8, 0.5)):
        c[1, -1, 1] = confidence
        found = solve(
            Problem(observed=y, confidence=c, stiffness=m),
            ElasticPrior(penalty=penalty),
            optimizer=Multigrid(1e-5),
        )
        ends.append(found.displacement[1, -1, 1] / (penalty * confidence))
    # The displacement is proportional to the force at which the observation slips.
    assert ends[1] == pytest.approx(ends[0], rel=1e-2)


@pytest.mark.parametrize("penalty", [None, 0.01])
def test_a_row_that_tilts_without_energy_is_rejected_despite_rounding(penalty):
    # Two sites are connected only to the middle site, so they can tilt freely. Because of the
    # stiffness contrast, rounding errors of the factorization hide this zero-energy mode.
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
        solve(
            Problem(observed=y, confidence=c, stiffness=m),
            prior,
            optimizer=Multigrid(),
            backend="cpu",
        )
    # A second observation in the row prevents the tilt.
    c[2, 2, 1] = 1
    found = solve(
        Problem(observed=y, confidence=c, stiffness=m), prior, optimizer=Multigrid(), backend="cpu"
    ).displacement
    np.testing.assert_allclose(found[1:4, 1, 1], found[2, [0, 2], 1].mean(), atol=1e-3)
