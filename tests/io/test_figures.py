"""Tests of the figures of a result."""

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.io.figures import energy_picture


def axes_of(*model, **how):
    solution = solve(phantom("expansion", size=32).problem, *model, backend="cpu", **how)
    return energy_picture(solution).axes[0], solution


def test_a_figure_shows_the_energy_per_sweep_and_the_start_of_each_level():
    axes, solution = axes_of(SeilerPrior())
    drawn = max((line.get_ydata() for line in axes.lines), key=len)
    np.testing.assert_array_equal(drawn, solution.energy[solution.energy > 0])
    assert len(axes.lines) == 1 + len(solution.levels)
    assert axes.get_xlabel().startswith("sweep")


def test_a_figure_shows_the_energy_per_cycle_and_the_estimated_error():
    axes, solution = axes_of(ElasticPrior())
    (curve,) = axes.lines
    np.testing.assert_array_equal(curve.get_ydata(), solution.energy)
    assert axes.get_xlabel() == "cycle over all levels"
    assert axes.get_title().endswith("px of the converged field")


def test_a_figure_of_the_converged_paper_model_shows_only_the_last_energy():
    axes, solution = axes_of(SeilerPrior(), optimizer=Multigrid())
    (curve,) = axes.lines
    assert list(curve.get_xdata()) == [solution.iterations]
