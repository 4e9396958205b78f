"""Rigid tissue: what is infinitely stiff moves as one."""

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.solver.backends.rigid.bodies import rigid_sites
from tests.support.elastic_oracle import stiffness_matrix
from tests.support.opengl import require_opengl

N = 49
PRIOR = ElasticPrior(0.3)


def disc(radius=9, at=(24, 20)):
    """A disc of sites."""
    i, j = np.indices((N, N))
    return (i - at[0]) ** 2 + (j - at[1]) ** 2 < radius**2


def bar():
    """A slanted bar, some pixels thick."""
    i, j = np.indices((N, N)) - N // 2
    return (abs(0.8 * i + 0.6 * j) < 14) & (abs(0.6 * i - 0.8 * j) < 2)


def pushed(rigid, stiffness=np.inf, spacing=(1.0, 1.0)):
    """Soft tissue around a bone: the first row is held, the last is pushed down and aside."""
    m = np.where(rigid, stiffness, 1.0)
    y, c = np.zeros((N, N, 2)), np.zeros((N, N, 2))
    c[0] = c[-1] = 1
    y[-1] = (3, 2)
    return Problem(y, c, m, spacing=spacing)


def reference(problem, sites):
    """The field of least energy among those in which a body moves as one: three unknowns."""
    matrix = stiffness_matrix(problem, PRIOR)
    i, j = np.nonzero(sites)
    rows, cols = problem.spacing
    at = 2 * (i * N + j)
    motions = np.zeros((2 * N * N, 3))
    motions[at, 0] = motions[at + 1, 1] = 1
    motions[at, 2], motions[at + 1, 2] = -cols * (j - j.mean()), rows * (i - i.mean())
    body = np.repeat(sites.ravel(), 2)
    free = ~problem.known.ravel() & ~body
    alone = sp.eye(2 * N * N, format="csc")[:, np.flatnonzero(free)]
    ways = sp.hstack([alone, sp.csc_matrix(motions)]).tocsc()
    given = np.where(problem.known, problem.observed, 0).astype(float).ravel()
    found = spl.spsolve((ways.T @ matrix @ ways).tocsc(), -(ways.T @ (matrix @ given)))
    return (given + ways @ found).reshape(N, N, 2)


def strains(displacement, sites):
    """The strains of the elements of a body, as differences."""
    d = displacement.astype(float)
    inside = sites[:-1, :-1] & sites[1:, :-1] & sites[:-1, 1:] & sites[1:, 1:]
    down, right = np.diff(d, axis=0)[:, :-1], np.diff(d, axis=1)[:-1]
    return np.stack([down[..., 0], right[..., 1], (down[..., 1] + right[..., 0]) / 2])[:, inside]


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (1.0, 2.5)], ids=["square", "oblong"])
@pytest.mark.parametrize("bone", [disc(), bar()], ids=["disc", "bar"])
def test_a_bone_moves_as_one_and_tissue_around_it_as_elastic_tissue_does(bone, spacing):
    problem = pushed(bone, spacing=spacing)
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="cpu")
    exact = reference(problem, rigid_sites(problem.stiffness))
    assert np.abs(solution.displacement - exact).max() < 0.005
    if spacing == (1.0, 1.0):
        assert np.abs(strains(solution.displacement, rigid_sites(problem.stiffness))).max() < 1e-5


def test_it_is_what_ever_stiffer_tissue_comes_to():
    rigid = solve(pushed(disc()), PRIOR, optimizer=Multigrid(1e-5), backend="cpu").displacement
    stiff = solve(pushed(disc(), 1e6), PRIOR, optimizer=Multigrid(1e-5), backend="cpu").displacement
    np.testing.assert_allclose(rigid, stiff, atol=1e-4)


def test_shaders_move_it_too():
    require_opengl()
    problem = pushed(disc())
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="opengl")
    assert (
        np.abs(solution.displacement - reference(problem, rigid_sites(problem.stiffness))).max()
        < 0.005
    )


def test_bones_that_touch_are_one_and_those_apart_are_not():
    touching, apart = disc(6, (14, 24)) | disc(6, (24, 24)), disc(5, (12, 24)) | disc(5, (34, 24))
    together = solve(pushed(touching), PRIOR, optimizer=Multigrid(), backend="cpu")
    assert (
        np.abs(strains(together.displacement, rigid_sites(pushed(touching).stiffness))).max() < 1e-5
    )
    two = solve(pushed(apart), PRIOR, optimizer=Multigrid(), backend="cpu").displacement
    assert two[34, 24, 0] - two[12, 24, 0] > 0.5


def test_a_bone_that_is_held_in_one_place_turns_about_it():
    problem = pushed(bar())
    y, c = problem.observed.copy(), problem.confidence.copy()
    c[24, 24] = 1
    solution = solve(Problem(y, c, problem.stiffness), PRIOR, optimizer=Multigrid(), backend="cpu")
    np.testing.assert_allclose(solution.displacement[24, 24], 0, atol=1e-6)
    assert np.abs(solution.displacement[bar()]).max() > 0.02


def test_a_bone_that_is_held_all_over_stays():
    problem = pushed(disc())
    c = problem.confidence.copy()
    c[disc()] = 1
    held = solve(
        Problem(problem.observed, c, problem.stiffness), PRIOR, optimizer=Multigrid(), backend="cpu"
    )
    assert np.abs(held.displacement[disc()]).max() < 1e-6


def test_a_bone_that_is_told_to_bend_is_refused_by_its_place():
    problem = pushed(disc())
    y, c = problem.observed.copy(), problem.confidence.copy()
    c[disc()] = 1
    y[24, 20] = (2, 0)
    with pytest.raises(ProblemError, match=r"the rigid body around \(24, 20\)"):
        solve(Problem(y, c, problem.stiffness), PRIOR, optimizer=Multigrid(), backend="cpu")


def test_the_papers_prior_refuses_it_and_says_what_to_do():
    with pytest.raises(ProblemError, match=r"ratios of stiffness.*ElasticPrior"):
        solve(pushed(disc()), SeilerPrior())


def test_it_is_refused_where_observations_may_slip():
    with pytest.raises(ProblemError, match="may slip"):
        solve(pushed(disc()), ElasticPrior(0.3, penalty=1.0), optimizer=Multigrid())


def test_tissue_that_is_all_rigid_moves_as_it_is_held():
    problem = pushed(np.ones((N, N), dtype=bool))
    y = np.zeros((N, N, 2))
    c = problem.confidence.copy()
    y[c > 0] = 1.5
    solution = solve(Problem(y, c, problem.stiffness), PRIOR, optimizer=Multigrid(), backend="cpu")
    np.testing.assert_allclose(solution.displacement, 1.5, atol=1e-5)


def two_discs(gap):
    """Two discs beside each other, so many pixels apart."""
    return disc(8, (24, 15)) | disc(8, (24, 30 + gap))


APART = disc(5, (12, 24)) | disc(5, (34, 24))


@pytest.mark.parametrize("bone", [disc(), bar(), APART], ids=["disc", "bar", "two discs"])
def test_a_bone_costs_a_few_cycles_more_than_soft_tissue(bone):
    rigid = solve(pushed(bone), PRIOR, optimizer=Multigrid(), backend="cpu")
    soft = solve(pushed(bone, 1.0), PRIOR, optimizer=Multigrid(), backend="cpu")
    assert rigid.convergence.way == "cycles"
    assert rigid.iterations <= soft.iterations + 3


@pytest.mark.parametrize("gap", [2, 3, 5])
def test_the_error_of_bones_close_together_is_no_more_than_is_said(gap):
    problem = pushed(two_discs(gap))
    solution = solve(problem, PRIOR, optimizer=Multigrid(1e-2), backend="cpu")
    exact = solve(problem, PRIOR, optimizer=Multigrid(1e-6), backend="cpu").displacement
    off = np.abs(solution.displacement - exact).max()
    assert off <= solution.convergence.error + 1e-5


def test_bones_at_the_border_and_more_bones_than_have_fields_of_their_own_move_as_well():
    i, j = np.indices((N, N))
    many = (i % 12 < 3) & (j % 12 < 3)
    for bone in (disc(9, (24, 0)), many):
        problem = pushed(bone & (i > 0) & (i < N - 1))
        solution = solve(problem, PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
        tight = solve(problem, PRIOR, optimizer=Multigrid(1e-7), backend="cpu")
        np.testing.assert_allclose(solution.displacement, tight.displacement, atol=3e-5)
