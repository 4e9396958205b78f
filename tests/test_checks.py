"""Tests of the types of values, and of the message about an invalid value."""

from dataclasses import asdict, replace
from fractions import Fraction

import numpy as np
import pytest

from napari_hmrf.checks import LARGEST_STIFFNESS
from napari_hmrf.errors import ArgumentError
from napari_hmrf.tissue.boundary_rules import MATERIALS, RIGID, RULES, BoundaryRule, Material

GEL = Material(1, "gel", 3.0)
RULE = BoundaryRule(1, "move")


@pytest.mark.parametrize(
    ("row", "name", "given", "value"),
    [
        (GEL, "label", np.uint8(3), 3),
        (GEL, "label", "1.0", 1),  # some spreadsheets write labels in this form
        (GEL, "stiffness", np.float32(2), 2.0),
        (GEL, "stiffness", Fraction(1, 2), 0.5),
        (GEL, "stiffness", "5.4", 5.4),
        (GEL, "stiffness", " Rigid", RIGID),
        (GEL, "stiffness", np.inf, RIGID),
        (GEL, "growth", "20%", 0.2),
        (GEL, "growth", "20% / 0", (0.2, 0.0)),
        (GEL, "growth", np.array([0.1, 0.2]), (0.1, 0.2)),
        (GEL, "slides", np.True_, True),
        (GEL, "slides", "yes", True),
        (RULE, "action", "Expand", "expand"),
        (RULE, "vector", np.arange(3), (0.0, 1.0, 2.0)),
        (RULE, "confidence", [1, 0.5], (1.0, 0.5)),
    ],
)
def test_values_of_other_types_are_converted(row, name, given, value):
    converted = getattr(replace(row, **{name: given}), name)
    assert converted == value
    assert type(converted) is type(value)
    assert replace(row, **{name: given}) == replace(row, **{name: value})


@pytest.mark.parametrize(
    ("row", "name", "wrong", "said"),
    [
        (GEL, "label", 1.5, "label must be a whole number, such as 1, not 1.5"),
        (GEL, "name", None, "name must be text"),
        (GEL, "stiffness", -1.0, 'stiffness must be .* "rigid", not -1'),
        (GEL, "stiffness", np.nan, "stiffness must be"),
        (GEL, "stiffness", 2 * LARGEST_STIFFNESS, "stiffness must be"),
        (GEL, "stiffness", "soft", "stiffness must be .* not 'soft'"),
        (GEL, "stiffness", np.ones(2), "stiffness must be"),
        (GEL, "poisson", 0.5, r"poisson must be a number from 0 to 0\.499, not 0\.5"),
        (GEL, "poisson", "0,4", "poisson must be"),
        (GEL, "growth", -1.0, "growth must be above -1 "),
        (GEL, "growth", "1001%", r"growth must be .* up to 10 \(1000%\)"),
        (GEL, "growth", 20, "growth must be"),
        (GEL, "growth", "much", "growth must be"),
        (GEL, "growth", (0.1, np.nan), "growth must be"),
        (GEL, "growth", {0.1, 0.2}, "growth must be .* or one for each axis"),
        (GEL, "slides", 2, "slides must be True or False"),
        (RULE, "label", 0, "label must be a whole number above 0"),
        (RULE, "action", "melt", "action must be fixed, .* or remove, not 'melt'"),
        (RULE, "vector", (np.nan, 0), r"vector must be finite numbers: \(row, col\)"),
        (RULE, "vector", "12", "vector must be"),
        (RULE, "vector", (1,), "vector must be"),
        (RULE, "amount", np.inf, "amount must be a number"),
        (RULE, "confidence", (1.0, 1.5), "confidence must be numbers from 0 to 1"),
        (RULE, "weight", 1, "weight: unexpected"),
    ],
)
def test_an_invalid_value_is_refused_with_its_name_and_valid_values(row, name, wrong, said):
    with pytest.raises(ArgumentError, match=said):
        replace(row, **{name: wrong})


def test_a_missing_value_is_named():
    with pytest.raises(ArgumentError, match="stiffness is missing"):
        Material(1, "gel")


def test_rows_are_converted_to_json_types_and_back():
    rows = (GEL, Material(2, "bone", RIGID), replace(GEL, label=3, growth=(0.1, 0.0)))
    stored = MATERIALS.dump_python(rows, mode="json")
    assert stored[0] == asdict(GEL)
    assert [row["stiffness"] for row in stored] == [3.0, "rigid", 3.0]
    assert MATERIALS.validate_python(stored) == rows
    assert RULES.validate_python(RULES.dump_python((RULE,), mode="json")) == (RULE,)
