"""Random cavities and interfaces against dense solutions; ``make cavities`` compares thousands."""

import numpy as np
import pytest

from benchmarks import cavities_and_interfaces as problems


def test_a_dozen_random_problems_have_the_field_of_a_dense_solution():
    verdicts = [problems.judge(0, number) for number in range(12)]
    assert not [verdict for verdict in verdicts if verdict.failed]
    assert {verdict.kind for verdict in verdicts} == {"cavity", "sliding", "both"}
    assert sum(verdict.outcome == "right" for verdict in verdicts) >= 8


@pytest.mark.parametrize("number", [94, 103, 122])
def test_pieces_of_a_part_that_touch_at_a_corner_hold_each_other(number):
    assert problems.judge(0, number).outcome == "right"


@pytest.mark.parametrize("number", [0, 3, 8])
def test_loads_of_a_cavity_are_integrals_over_its_faces(number):
    case = problems.random_case(0, number)
    force = problems.forces_of(case)
    given = case.problem().loads
    np.testing.assert_allclose(given.force, force, atol=1e-6 * np.abs(force).max())
