"""Tests of pairs of landmark positions."""

import numpy as np
import pytest

from napari_hmrf.results.landmark_pairs import LandmarkPairs
from napari_hmrf.solver.solution import Provenance, Solution

SPACING = (0.5, 2.0)


def test_distances_are_lengths_before_and_after_the_motion():
    shape = (12, 10)
    d = np.full((*shape, 2), (1.0, 4.0))  # 2 rows and 2 columns
    solution = Solution(
        d, np.zeros(1), (), np.ones(shape, bool), SPACING, Provenance("cpu", "here")
    )
    at = np.array([[2.0, 3.0], [5.0, 4.0]])
    pairs = LandmarkPairs(np.arange(2), at, np.array([[4.0, 5.0], [7.0, 5.0]]))
    before, after = pairs.distances(solution)
    assert before == pytest.approx([np.hypot(1, 4), np.hypot(1, 2)])
    assert after == pytest.approx([0.0, 2.0])
