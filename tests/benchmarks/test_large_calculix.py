"""Tests of the decks for CalculiX with large motion of volumes."""

import numpy as np
import pytest

from benchmarks import large_calculix
from benchmarks.report import calculix
from tests.support.finite_volume_oracle import solved


def cards(deck, keyword):
    """Return the lines of numbers below all cards of a deck with a keyword."""
    parts = [part.splitlines() for part in f"\n{deck}".split("\n*")[1:]]
    return [line for head, *lines in parts if head.split(",")[0] == keyword for line in lines]


def test_each_grown_brick_is_pressed_into_its_voxel():
    problem = large_calculix.grown(4, 1.0)
    deck = large_calculix.deck(problem, 0.3)
    nodes = np.array([line.split(",") for line in cards(deck, "NODE")], dtype=float)[:, 1:]
    place = dict(enumerate(nodes, start=1))
    squeezed = dict(place)
    for line in cards(deck, "EQUATION")[1::2]:
        own, along, _, site, _, _, _, _, offset = map(float, line.split(","))
        squeezed[own] = squeezed[own] - float(offset) * np.eye(3)[int(along) - 1]
        assert squeezed[own][int(along) - 1] == pytest.approx(place[site][int(along) - 1])
    elements = np.array([line.split(",") for line in cards(deck, "ELEMENT")], dtype=int)
    sizes = [np.ptp([place[node] for node in corners], axis=0) for _, *corners in elements]
    growth = problem.loads.growth
    assert np.max(sizes) == pytest.approx(1 + growth[1:3, 1:3, 1:3].mean())
    for _, *corners in elements:
        np.testing.assert_allclose(np.ptp([squeezed[node] for node in corners], axis=0), 1)


@pytest.mark.skipif(not calculix.is_there(), reason="CalculiX is not installed")
def test_calculix_has_the_same_law_in_large_motion():
    problem = large_calculix.twisted(4, 1.0)
    found = large_calculix.by_calculix(problem, 0.45)
    np.testing.assert_allclose(found, solved(problem, 0.45, 4, locking=True), atol=1e-5)
    assert np.abs(found - large_calculix.by_package(problem, 0.45)).max() < 0.05
