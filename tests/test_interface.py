"""The public face: what a script imports, how it is called, and what it says of a mistake."""

import inspect

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf import (
    BoundaryRule,
    Material,
    Problem,
    StiffnessCurve,
    boundary_images,
    equivalent_strain,
    folds,
    green_lagrange_strain,
    solve,
    stiffness_image,
)

#: How many arguments may go without their name.
WHAT_A_CALL_IS_ABOUT = {
    "BoundaryRule": 2,
    "ElasticPrior": 1,
    "ICM": 1,
    "LiveSolver": 2,
    "Multigrid": 1,
    "Picture": 1,
    "Problem": 3,
    "SeilerPrior": 0,
    "StiffnessCurve": 1,
    "Warper": 1,
    "arrows": 1,
    "boundary_images": 2,
    "count_folds": 1,
    "deformation_gradient": 1,
    "deformation_grid": 1,
    "folds": 1,
    "green_lagrange_strain": 1,
    "inverse_map": 1,
    "jacobian_determinant": 1,
    "resample": 3,
    "small_strain": 1,
    "solve": 2,
    "warp": 2,
}


def test_a_script_makes_tissue_solves_and_measures_it_with_what_the_package_exports():
    tissue, boundary = np.ones((20, 30), int), np.zeros((20, 30), int)
    tissue[8:12] = 2
    boundary[:, :2], boundary[:, -2:] = 1, 2
    stiffness = stiffness_image(tissue, [Material(1, "soft", 1.0), Material(2, "stiff", 50.0)])
    rules = [BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0, 3))]
    solution = solve(Problem(*boundary_images(boundary, rules), stiffness))
    field = solution.displacement
    strain = equivalent_strain(green_lagrange_strain(field, tissue=solution.tissue))
    assert np.ptp(field[10, :, 1]) == pytest.approx(3, abs=0.01)
    assert 0.03 < strain.mean() < 0.3
    assert not folds(field).any()
    bright = StiffnessCurve(((0, 1), (255, 100)))
    assert bright(np.uint8([[0, 255]])).tolist() == [[1, 100]]


def test_every_name_that_is_exported_is_there_once_and_says_what_it_is():
    names = napari_hmrf.__all__
    assert len(names) == len(set(names))
    for name in names:
        found = getattr(napari_hmrf, name)
        assert not inspect.ismodule(found)
        assert not callable(found) or inspect.getdoc(found)


@pytest.mark.parametrize(("name", "count"), WHAT_A_CALL_IS_ABOUT.items())
def test_all_but_what_a_call_is_about_has_to_be_named(name, count):
    parameters = inspect.signature(getattr(napari_hmrf, name)).parameters.values()
    unnamed = [each for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
    assert len(unnamed) == count


def test_whatever_has_a_choice_is_in_that_list():
    """But for `phantom(name, size)`, `Material`, which is a row of a table, and results."""
    records = {"Material", "Monitor", "Phantom", "Provenance", "Solution", "phantom"}
    choices = set()
    for name in napari_hmrf.__all__:
        found = getattr(napari_hmrf, name)
        if callable(found) and not (isinstance(found, type) and issubclass(found, Exception)):
            given = inspect.signature(found).parameters.values()
            if any(each.default is not each.empty for each in given):
                choices.add(name)
    assert choices - records - {"equivalent_strain"} <= set(WHAT_A_CALL_IS_ABOUT)
