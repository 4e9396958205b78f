"""Tests of parts of a study that mean nothing: units, actions, and labels without a row."""

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    BoundaryRule,
    Grid,
    Material,
    Motion,
    ProblemError,
    Study,
    Tissue,
    solve_study,
)
from napari_hmrf.study.ground import Ground

SHAPE = (8, 9)


def study(tissue=None, motion=None):
    return Study(Grid(SHAPE, 1.0, "mm"), tissue or Tissue(), motion or Motion(hold_edge=True))


@pytest.mark.parametrize(
    "call",
    [
        lambda: Grid(SHAPE, (1, 1), "kPa"),
        lambda: Grid(SHAPE, (1, 1), "second"),
        lambda: Tissue(unit="mm"),
        lambda: BoundaryRule(1, "fix"),
    ],
)
def test_units_and_actions_of_another_kind_are_refused(call):
    with pytest.raises(ArgumentError):
        call()


@pytest.mark.parametrize("unit", ["", "Pa", "kPa", "N/mm^2", "relative", "times normal"])
def test_units_of_stiffness_are_accepted(unit):
    assert Tissue(unit=unit).unit == unit


def labels():
    image = np.ones(SHAPE, np.uint8)
    image[2:4, 2:4] = 3
    return image


@pytest.mark.parametrize("label", [1, 3])
def test_tissue_without_a_material_is_refused(label):
    """The stiffness of a label never depends on the row of another label."""
    tissue = Tissue(labels=labels(), materials=(Material(label, "brain", 3.0),))
    with pytest.raises(ProblemError, match=f"{4 - label}"):
        solve_study(study(tissue))


def test_a_painted_boundary_without_a_rule_is_refused():
    motion = Motion(labels=labels(), rules=(BoundaryRule(1, "fixed"),))
    with pytest.raises(ProblemError, match="3"):
        solve_study(study(motion=motion))


def test_numbers_that_an_action_does_not_use_cause_a_note():
    rules = (BoundaryRule(1, "fixed"), BoundaryRule(3, "expand", amount=1.0, vector=(0, 2)))
    ground = Ground.of(study(motion=Motion(labels=labels(), rules=rules)))
    assert any("vector of label 3" in note for note in ground.unused(ground.statement()))


def test_an_elastic_volume_of_one_slice_is_refused():
    with pytest.raises(ProblemError):
        Ground.of(Study(Grid((1, 8, 9), 1.0, "mm"), Tissue(), Motion(hold_edge=True)))
