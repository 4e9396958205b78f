"""Grid and tolerance of the preview during a drag."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import Grid, Study, Tissue
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.study.drag_preview import PREVIEW_SITES, as_dragged, drag_preview


def a_study(shape, model="elastic"):
    return Study(Grid(shape, (1.0,) * len(shape)), Tissue(stiffness=np.ones(shape)), model=model)


def test_a_volume_is_solved_on_a_grid_of_limited_size_for_the_visible_slice():
    preview = drag_preview(a_study((60, 60, 60)), (0, 7))
    assert preview.grid.step == 2
    assert 60**3 / preview.grid.step**3 <= PREVIEW_SITES
    assert (preview.axis, preview.number) == (0, 7)
    assert drag_preview(a_study((40, 40, 40)), (0, 7)).grid.step == 1


@pytest.mark.parametrize(
    ("size", "model", "step"),
    [
        (1200, "elastic", None),
        (2000, "elastic", 4),
        (2000, "paper", None),
        (600, "large motion", None),
        (700, "large motion", 3),
    ],
)
def test_only_large_images_are_solved_on_a_coarse_grid(size, model, step):
    preview = drag_preview(a_study((size, size), model))
    assert (None if preview is None else preview.grid.step) == step


def test_the_picture_of_a_large_image_has_pixels_between_those_of_the_image_and_of_the_grid():
    preview = drag_preview(a_study((4000, 4000)))
    assert preview.pixel == 4
    assert preview.grid.step == 8
    assert drag_preview(a_study((700, 700), "large motion")).pixel == 1


def test_a_drag_loosens_the_tolerance_and_keeps_other_settings():
    study = replace(a_study((20, 20)), optimizer=Multigrid(1e-4, max_iterations=77))
    assert as_dragged(study).optimizer == Multigrid(0.01, max_iterations=77)
    large = replace(a_study((20, 20), "large motion"), optimizer=Multigrid(1e-4))
    assert as_dragged(large).optimizer == large.optimizer
    coarse = replace(study, optimizer=Multigrid(0.5))
    assert as_dragged(coarse).optimizer == Multigrid(0.5)
    paper = a_study((20, 20), "paper")
    assert isinstance(as_dragged(paper).optimizer, ICM)
