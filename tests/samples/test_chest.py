"""Tests of the phantom of a chest whose lungs slide along its wall."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from napari_hmrf import ArgumentError, solve
from napari_hmrf.data import chest_phantom
from napari_hmrf.fields import measure
from napari_hmrf.samples.chest import ABDOMEN, HEART, LUNGS, RIBS, WALL


@pytest.fixture(scope="module")
def chest():
    return chest_phantom(128)


@pytest.mark.parametrize("size", [96, 131])
def test_a_chest_of_any_size_has_two_lungs_that_touch_neither_each_other_nor_the_air(size):
    drawn = chest_phantom(size)
    assert set(np.unique(drawn.tissue_labels)) == set(range(6))
    lungs = drawn.tissue_labels == LUNGS.label
    assert scipy.ndimage.label(lungs)[1] == 2
    around = scipy.ndimage.binary_dilation(lungs, np.ones((3, 3))) & ~lungs
    beside = set(np.unique(drawn.tissue_labels[around]))
    assert {WALL.label, HEART.label, ABDOMEN.label} <= beside
    assert not {0, RIBS.label} & beside


def test_vessels_make_the_motion_of_a_lung_visible(chest):
    lungs = chest.tissue_labels == LUNGS.label
    assert 0.1 < (chest.image[lungs] > 100).mean() < 0.4
    assert (chest.image[chest.tissue_labels == 0] == 0).all()


def test_a_breath_slides_the_lungs_along_the_ribs_without_folds(chest):
    solution = solve(chest.problem, backend="cpu")
    down, lungs = solution.displacement[..., 0], chest.tissue_labels == LUNGS.label
    for row in range(55, 80, 5):
        at = np.flatnonzero(lungs[row])
        assert min(down[row, at[1]], down[row, at[-2]]) > 3
        assert abs(down[row, [at[0] - 2, at[-1] + 2]]).max() < 1
    assert solution.count_folds() == 0
    by_name = {row.label: row for row in measure(solution, chest.tissue_labels)}
    assert by_name[LUNGS.label].size_change > 8
    rows = tuple(replace(row, slides=False) for row in chest.materials)
    stuck = solve(replace(chest, materials=rows).problem, backend="cpu")
    assert stuck.displacement[65, np.flatnonzero(lungs[65])[1], 0] < 1


def test_the_breath_of_a_chest_scales_with_its_size():
    assert chest_phantom(128).problem.observed.max() == pytest.approx(7)
    assert chest_phantom(128, breath=-4).problem.observed.min() == pytest.approx(-2)


def test_a_chest_that_cannot_be_drawn_is_refused():
    for given in ({"size": 95}, {"size": 100.5}, {"size": 100.0}, {"breath": float("nan")}):
        with pytest.raises(ArgumentError, match=f"^{next(iter(given))} "):
            chest_phantom(**given)
