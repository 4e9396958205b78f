"""Random cavities and interfaces against dense solutions; ``make cavities`` runs thousands."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import cavities_and_interfaces as campaign


def test_a_dozen_random_problems_have_the_field_of_a_dense_solution():
    verdicts = [campaign.judge(0, number) for number in range(12)]
    assert not [verdict for verdict in verdicts if verdict.failed]
    assert {verdict.kind for verdict in verdicts} == {"cavity", "sliding", "both"}
    assert sum(verdict.outcome == "right" for verdict in verdicts) >= 8


@pytest.mark.parametrize("number", [94, 103, 122])
def test_pieces_of_a_part_that_touch_at_a_corner_hold_each_other(number):
    assert campaign.judge(0, number).outcome == "right"


@pytest.mark.parametrize("number", [0, 3, 8])
def test_loads_of_a_cavity_are_integrals_over_its_faces(number):
    case = campaign.random_case(0, number)
    force = campaign.forces_of(case)
    given = case.problem().loads
    np.testing.assert_allclose(given.force, force, atol=1e-6 * np.abs(force).max())


def test_a_solution_that_is_off_by_a_fiftieth_of_a_pixel_is_wrong(monkeypatch):
    def off(*args, **kwargs):
        solution = solve(*args, **kwargs)
        return replace(solution, displacement=solution.displacement + np.float32(0.02))

    solve = campaign.solve
    monkeypatch.setattr(campaign, "solve", off)
    case = campaign.random_case(0, 8)
    monkeypatch.setattr(campaign, "random_case", lambda *_: replace(case, spacing=(1.0, 1.0)))
    verdict = campaign.judge(0, 8)
    assert verdict.outcome == "wrong"
    assert verdict.failed


def test_a_refusal_of_a_well_posed_cavity_counts_as_a_failure(monkeypatch):
    def refuse(*args, **kwargs):
        raise campaign.ConvergenceError("no")

    monkeypatch.setattr(campaign, "solve", refuse)
    verdict = campaign.judge(0, 3)
    assert verdict.failed
    assert verdict.remark == "no"
    assert "--only 3: refused, well-posed, cavity" in campaign.report([verdict])
