"""Random cavities, interfaces and pairs of inputs; campaigns compare thousands of each."""

import numpy as np
import pytest

from benchmarks import campaign
from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.tissue import SlidingParts
from validation.bodies import dice_of
from validation.oracles.parts import dense_solution, forces_of
from validation.problems import random_parts

#: Parts "a" and "b" with pieces that touch at a corner only. "." is void; capitals are held.
TOUCHING = {
    "a corner beside three holes": """
        aAaaabbB
        aaaAabBb
        aaaabBbb
        aaaaBbBb
        a.aaBb.b
        aaAb.bbB
        AAabbBBB""",
    "a strip around a cavity": """
        AABBB
        AbbBb
        a..bB
        b...b
        b...b
        b...b
        bb.bb
        bbbbb
        bBbbb
        bbbbB
        bbbbB
        bBbBb""",
}


def test_a_dozen_random_problems_have_the_field_of_a_dense_solution():
    run = campaign.run("parts", range(12))
    assert run.is_right, campaign.report(run)
    verdicts = [verdict for _, verdict in run.verdicts]
    kinds = {verdict.kinds["problem"].partition(",")[0] for verdict in verdicts}
    assert kinds == {"cavity", "sliding", "both"}
    assert sum(verdict.outcome == "right" for verdict in verdicts) >= 8


def test_pairs_of_inputs_have_the_field_of_a_dense_solution():
    # A rigid body whose first estimate is too small, and observed sites that follow.
    run = campaign.run("combinations", [901, 1351, 2723, *range(12)])
    assert run.is_right, campaign.report(run)
    assert sum(verdict.outcome == "right" for _, verdict in run.verdicts) >= 10


@pytest.mark.parametrize("picture", TOUCHING.values(), ids=TOUCHING)
def test_pieces_of_a_part_that_touch_at_a_corner_hold_each_other(picture):
    sites = np.array([list(line) for line in picture.split()])
    labels = (np.char.lower(sites) == "b").astype(np.int32)
    whole = sites_of_elements(sites != ".")
    problem = Problem(
        observed=np.random.default_rng(0).normal(size=(*sites.shape, 2)) / 5,
        confidence=np.repeat((np.char.isupper(sites) & whole)[..., None], 2, axis=-1),
        stiffness=np.where(sites == ".", 0.0, 1.0),
        sliding=SlidingParts(labels),
    )
    prior = ElasticPrior(0.3)
    found = solve(problem, prior, backend="cpu")
    exact, _ = dense_solution(problem, prior, None)
    assert np.abs(found.displacement - exact)[whole].max() <= 3 * found.convergence.error + 1e-4


@pytest.mark.parametrize(("number", "axes"), [(0, 3), (1, 2), (2, 2)])
def test_loads_of_a_cavity_are_integrals_over_its_faces(number, axes):
    drawn = random_parts(dice_of(0, number), axes, has_cavity=True, has_parts=False)
    problem = drawn.problem
    force = forces_of(drawn.contents, problem.stiffness, problem.spacing)
    assert np.abs(force).max() > 0
    np.testing.assert_allclose(problem.loads.force, force, atol=1e-6 * np.abs(force).max())
