"""Pictures of a result, for a talk or a paper."""

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.io.figures import energy_picture


def axes_of(*model, **how):
    solution = solve(phantom("expansion", size=32).problem, *model, backend="cpu", **how)
    return energy_picture(solution).axes[0], solution


def test_the_energy_of_each_sweep_is_drawn_and_where_each_level_begins():
    axes, solution = axes_of(SeilerPrior())
    drawn = max((line.get_ydata() for line in axes.lines), key=len)
    np.testing.assert_array_equal(drawn, solution.energy[solution.energy > 0])
    assert len(axes.lines) == 1 + len(solution.levels)
    assert axes.get_xlabel().startswith("sweep")


def test_of_cycles_the_energy_of_each_is_drawn_and_how_near_they_led():
    axes, solution = axes_of(ElasticPrior())
    (curve,) = axes.lines
    np.testing.assert_array_equal(curve.get_ydata(), solution.energy)
    assert axes.get_xlabel() == "cycle over all levels"
    assert axes.get_title().endswith("px of the converged field")


def test_of_the_papers_model_computed_to_the_end_only_the_last_energy_is_known():
    axes, solution = axes_of(SeilerPrior(), optimizer=Multigrid())
    (curve,) = axes.lines
    assert list(curve.get_xdata()) == [solution.iterations]
