"""Rigid tissue: infinitely stiff parts move as rigid bodies."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.loads import reactions
from napari_hmrf.solver.backends.rigid.bodies import Bodies, bodies_of, rigid_sites
from tests.support.opengl import require_opengl
from validation.oracles.elasticity import direct_solution
from validation.oracles.slipping import slipped

N = 49
PRIOR = ElasticPrior(0.3)


def disc(radius=9, at=(24, 20)):
    """Return a disc of sites."""
    i, j = np.indices((N, N))
    return (i - at[0]) ** 2 + (j - at[1]) ** 2 < radius**2


def bar():
    """Return a slanted bar, a few pixels thick."""
    i, j = np.indices((N, N)) - N // 2
    return (abs(0.8 * i + 0.6 * j) < 14) & (abs(0.6 * i - 0.8 * j) < 2)


def tissue_with_bone(rigid, stiffness=np.inf, spacing=(1.0, 1.0)):
    """Return a bone in soft tissue with a fixed first row and a last row pushed down and aside."""
    m = np.where(rigid, stiffness, 1.0)
    y, c = np.zeros((N, N, 2)), np.zeros((N, N, 2))
    c[0] = c[-1] = 1
    y[-1] = (3, 2)
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


def element_strains(displacement, sites):
    """Return the strains of the elements of a body, from differences."""
    d = displacement.astype(float)
    inside = sites[:-1, :-1] & sites[1:, :-1] & sites[:-1, 1:] & sites[1:, 1:]
    down, right = np.diff(d, axis=0)[:, :-1], np.diff(d, axis=1)[:-1]
    return np.stack([down[..., 0], right[..., 1], (down[..., 1] + right[..., 0]) / 2])[:, inside]


@pytest.mark.parametrize(
    ("bone", "spacing"),
    [
        (disc(), (1.0, 1.0)),
        (bar(), (1.0, 2.5)),
        pytest.param(bar(), (1.0, 1.0), marks=pytest.mark.campaign),
        pytest.param(disc(), (1.0, 2.5), marks=pytest.mark.campaign),
    ],
    ids=["disc, square", "bar, oblong", "bar, square", "disc, oblong"],
)
def test_a_bone_moves_rigidly_in_elastic_tissue(bone, spacing):
    problem = tissue_with_bone(bone, spacing=spacing)
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="cpu")
    exact = direct_solution(problem, PRIOR)
    assert np.abs(solution.displacement - exact).max() < 0.005
    if spacing == (1.0, 1.0):
        assert (
            np.abs(element_strains(solution.displacement, rigid_sites(problem.stiffness))).max()
            < 1e-5
        )


def test_rigid_tissue_is_the_limit_of_stiff_tissue():
    rigid = solve(
        tissue_with_bone(disc()), PRIOR, optimizer=Multigrid(1e-5), backend="cpu"
    ).displacement
    stiff = solve(
        tissue_with_bone(disc(), 1e6), PRIOR, optimizer=Multigrid(1e-5), backend="cpu"
    ).displacement
    np.testing.assert_allclose(rigid, stiff, atol=1e-4)


def test_shaders_move_a_bone_rigidly():
    require_opengl()
    problem = tissue_with_bone(disc())
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="opengl")
    assert np.abs(solution.displacement - direct_solution(problem, PRIOR)).max() < 0.005


def test_touching_bones_form_one_body_and_separate_bones_do_not():
    touching, apart = disc(6, (14, 24)) | disc(6, (24, 24)), disc(5, (12, 24)) | disc(5, (34, 24))
    together = solve(tissue_with_bone(touching), PRIOR, optimizer=Multigrid(), backend="cpu")
    assert (
        np.abs(
            element_strains(
                together.displacement, rigid_sites(tissue_with_bone(touching).stiffness)
            )
        ).max()
        < 1e-5
    )
    two = solve(tissue_with_bone(apart), PRIOR, optimizer=Multigrid(), backend="cpu").displacement
    assert two[34, 24, 0] - two[12, 24, 0] > 0.5


def test_a_bone_fixed_at_one_pixel_rotates_about_it():
    problem = tissue_with_bone(bar())
    y, c = problem.observed.copy(), problem.confidence.copy()
    c[24, 24] = 1
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=problem.stiffness),
        PRIOR,
        optimizer=Multigrid(),
        backend="cpu",
    )
    np.testing.assert_allclose(solution.displacement[24, 24], 0, atol=1e-6)
    assert np.abs(solution.displacement[bar()]).max() > 0.02


def test_a_bone_fixed_everywhere_does_not_move():
    problem = tissue_with_bone(disc())
    c = problem.confidence.copy()
    c[disc()] = 1
    held = solve(
        Problem(observed=problem.observed, confidence=c, stiffness=problem.stiffness),
        PRIOR,
        optimizer=Multigrid(),
        backend="cpu",
    )
    assert np.abs(held.displacement[disc()]).max() < 1e-6


def test_prescribed_bending_of_a_bone_is_rejected_with_its_position():
    problem = tissue_with_bone(disc())
    y, c = problem.observed.copy(), problem.confidence.copy()
    c[disc()] = 1
    y[24, 20] = (2, 0)
    with pytest.raises(ProblemError, match=r"the rigid body around \(24, 20\)"):
        solve(
            Problem(observed=y, confidence=c, stiffness=problem.stiffness),
            PRIOR,
            optimizer=Multigrid(),
            backend="cpu",
        )


def test_the_paper_prior_rejects_rigid_tissue_with_a_suggestion():
    with pytest.raises(ProblemError, match=r"ratios of stiffness.*ElasticPrior"):
        solve(tissue_with_bone(disc()), SeilerPrior())


def test_entirely_rigid_tissue_follows_its_prescribed_motion():
    problem = tissue_with_bone(np.ones((N, N), dtype=bool))
    y = np.zeros((N, N, 2))
    c = problem.confidence.copy()
    y[c > 0] = 1.5
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=problem.stiffness),
        PRIOR,
        optimizer=Multigrid(),
        backend="cpu",
    )
    np.testing.assert_allclose(solution.displacement, 1.5, atol=1e-5)


def two_discs(gap):
    """Return two discs next to each other with a gap in pixels."""
    return disc(8, (24, 15)) | disc(8, (24, 30 + gap))


APART = disc(5, (12, 24)) | disc(5, (34, 24))


@pytest.mark.parametrize(
    "bone",
    [
        pytest.param(disc(), id="disc", marks=pytest.mark.campaign),
        pytest.param(bar(), id="bar"),
        pytest.param(APART, id="two discs"),
    ],
)
def test_a_bone_needs_only_a_few_more_cycles_than_soft_tissue(bone):
    rigid = solve(tissue_with_bone(bone), PRIOR, optimizer=Multigrid(), backend="cpu")
    soft = solve(tissue_with_bone(bone, 1.0), PRIOR, optimizer=Multigrid(), backend="cpu")
    assert rigid.convergence.way == "cycles"
    assert rigid.iterations <= soft.iterations + 3


@pytest.mark.parametrize(
    "gap", [2, *(pytest.param(gap, marks=pytest.mark.campaign) for gap in (3, 5))]
)
def test_the_reported_error_is_a_bound_for_bones_close_together(gap):
    problem = tissue_with_bone(two_discs(gap))
    solution = solve(problem, PRIOR, optimizer=Multigrid(1e-2), backend="cpu")
    exact = solve(problem, PRIOR, optimizer=Multigrid(1e-6), backend="cpu").displacement
    off = np.abs(solution.displacement - exact).max()
    assert off <= solution.convergence.error + 1e-5


def test_bones_at_the_border_and_many_bones_are_solved():
    i, j = np.indices((N, N))
    many = (i % 12 < 3) & (j % 12 < 3)
    for bone in (disc(9, (24, 0)), many):
        problem = tissue_with_bone(bone & (i > 0) & (i < N - 1))
        solution = solve(problem, PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
        tight = solve(problem, PRIOR, optimizer=Multigrid(1e-7), backend="cpu")
        np.testing.assert_allclose(solution.displacement, tight.displacement, atol=3e-5)


@pytest.mark.parametrize("shape", [(20, 20), (6, 6, 6)], ids=["image", "volume"])
def test_uncertain_observations_of_a_bone_pull_with_their_total_force(shape):
    # Each observation pulls with 0.01 at most, and together they move the bone in proportion.
    axes, middle = len(shape), tuple(side // 2 for side in shape)
    m, (y, c) = np.ones(shape), np.zeros((2, *shape, axes))
    m[tuple(slice(at - 1, at + 1) for at in middle)] = np.inf
    for axis in range(axes):
        c.swapaxes(0, axis)[[0, -1]] = 1
    there = [middle, tuple(at - 1 for at in middle), (*middle[:-1], middle[-1] - 1)]
    moved = []
    for count in (1, 2, 3):
        for at in there[:count]:
            y[at], c[at] = np.eye(axes)[0], 0.01
        problem = Problem(observed=y, confidence=c, stiffness=m)
        found = solve(problem, PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
        bone = found.displacement[rigid_sites(m)]
        force = reactions(problem, found)[rigid_sites(m)].sum(axis=0) / PRIOR.force_unit(problem)
        assert force[0] == pytest.approx(0.01 * count, abs=1e-4)
        moved.append(bone[:, 0].mean())
    assert moved[0] > 1e-4
    np.testing.assert_allclose(np.divide(moved, moved[0]), (1, 2, 3), rtol=0.2)


@pytest.mark.parametrize(("data", "seed"), [("precision", 52), ("landmarks", 49)])
def test_observations_slip_beside_data_and_a_bone(data, seed):
    dice = np.random.default_rng(seed)
    m = 10 ** dice.uniform(0, 1.5, (7, 8))
    m[4:6, 1:4] = np.inf
    observed = dice.normal(size=(7, 8, 2))
    points = dice.random((6, 2)) * (5.9, 6.9)
    given = {
        "precision": dice.random((7, 8)),
        "landmarks": Landmarks(points, points + dice.normal(size=points.shape), sd=0.1),
    }
    problem = Problem(
        observed=observed,
        confidence=np.where(dice.random((7, 8, 2)) < 0.3, 0.1, 0.0),
        stiffness=m,
        **{data: given[data]},
    )
    solution, exact = solve(problem, backend="cpu"), slipped(problem, ElasticPrior())
    assert exact.is_proven
    off = np.abs(solution.displacement - exact.field).max()
    assert off <= solution.convergence.error + 1e-6


def test_a_bone_shares_a_force_among_its_observations_within_their_limits():
    m = np.full((2, 4), np.inf, np.float32)
    held, still = np.zeros((2, 6, 8), np.bool_), np.zeros((2, 4, 2))
    held[0, 2, 2:5] = True
    material = PRIOR.material(Problem(observed=still, confidence=1 + still, stiffness=m))
    bodies = Bodies(bodies_of(m), material, held)
    forces, limits = np.zeros(held.shape), np.zeros(held.shape)
    forces[0, 2, 3] = 0.9
    limits[0, 2, 2:5] = 0.2, 1.0, 0.2
    without_limit = forces.copy()
    bodies.carry(without_limit)
    assert without_limit[0, 2, 2:5] == pytest.approx((0.3, 0.3, 0.3))
    bodies.carry(forces, limits)
    assert (np.abs(forces[0, 2, 2:5]) <= limits[0, 2, 2:5] + 1e-9).all()
    assert forces[0, 2, 2:5].sum() == pytest.approx(0.9)
    assert forces[0, 2, 2] == pytest.approx(forces[0, 2, 4]), "a bone that must not turn"
