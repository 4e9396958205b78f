"""Tests of recorded studies: layers give the recorded problem and the recorded field.

The files in `recorded/` were read from the layers of `studies.py` and solved with a cold start by
compiled loops. To record again, which is correct only if a reading was changed on purpose::

    python -m tests.layers.test_recorded --record [name of a study ...]
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from napari_hmrf import solve
from napari_hmrf.solver.priors import Elastic
from tests.support.studies import (
    STUDIES,
    growing_tumour_in_oblong_pixels_turned,
    tissue_by_brightness,
)
from tests.support.study_reader import read

RECORDED = Path(__file__).resolve().parent / "recorded"
#: Resolution of stored fields, in pixels.
STEP = 1e-4
#: Tolerance of the paper's schedule, which has no error estimate: root mean square, in pixels.
#: Rounding decides between equally good candidates.
OF_A_SCHEDULE = 0.01
#: Largest size of all files together, in bytes.
LARGEST = 300_000


def problem_arrays(problem, prior):
    """Return the arrays that define a problem, by name."""
    return {
        "y": problem.observed,
        "c": problem.confidence,
        "m": problem.stiffness,
        "spacing": np.array(problem.spacing),
        "poisson": np.asarray(getattr(prior, "poisson", np.nan)),
    }


def model(problem, prior, optimizer):
    """Return the parameters of the model as JSON; Poisson's ratios are an array."""
    if isinstance(prior, Elastic):
        prior = prior.in_force(problem)
    parts = [{**each.parameters} for each in (prior, optimizer)]
    parts[0].pop("poisson", None)
    return json.dumps(parts, sort_keys=True)


def error_of(solution):
    return np.nan if solution.convergence is None else solution.convergence.error


def pixels(solution):
    return solution.displacement / np.array(solution.spacing)


def record(make):
    asked = read(make())
    solution = solve(asked.problem, asked.prior, optimizer=asked.optimizer, backend="cpu")
    RECORDED.mkdir(exist_ok=True)
    np.savez_compressed(
        RECORDED / f"{make.__name__}.npz",
        model=model(asked.problem, asked.prior, asked.optimizer),
        field=np.rint(pixels(solution) / STEP).astype(np.int32),
        error=error_of(solution),
        **problem_arrays(asked.problem, asked.prior),
    )


@pytest.mark.parametrize("make", STUDIES, ids=lambda make: make.__name__)
def test_layers_give_the_recorded_problem_and_the_recorded_field(make):
    with np.load(RECORDED / f"{make.__name__}.npz", allow_pickle=False) as file:
        known = dict(file)
    asked = read(make())
    assert model(asked.problem, asked.prior, asked.optimizer) == str(known["model"])
    for name, found in problem_arrays(asked.problem, asked.prior).items():
        np.testing.assert_allclose(found, known[name], rtol=1e-6, atol=1e-7, err_msg=name)
    solution = solve(asked.problem, asked.prior, optimizer=asked.optimizer, backend="cpu")
    apart = np.abs(pixels(solution) - STEP * known["field"])
    if solution.convergence is None:
        assert np.sqrt((apart**2).mean()) < OF_A_SCHEDULE
    else:
        assert apart.max() <= solution.convergence.error + known["error"] + STEP


@pytest.mark.parametrize(
    "make",
    [growing_tumour_in_oblong_pixels_turned, tissue_by_brightness],
    ids=lambda make: make.__name__,
)
def test_a_study_without_a_drawing_gives_the_painted_problem(make):
    layers = make()
    drawn_on = replace(layers, drawing=[], hold_edge=False)
    painted, pulled = (read(study) for study in (layers, drawn_on))
    for name, found in problem_arrays(pulled.problem, pulled.prior).items():
        known = problem_arrays(painted.problem, painted.prior)[name]
        np.testing.assert_array_equal(found, known, err_msg=name)
    assert pulled.prior == painted.prior


def test_every_recorded_study_has_motion_and_the_files_are_small():
    files = sorted(RECORDED.glob("*.npz"))
    assert {file.stem for file in files} == {make.__name__ for make in STUDIES}
    assert sum(file.stat().st_size for file in files) < LARGEST
    for file in files:
        with np.load(file, allow_pickle=False) as known:
            moved = STEP * np.abs(known["field"])
            assert moved.max() > 1, f"{file.stem}: tissue moves by less than a pixel"
            assert (moved[known["m"] > 0] > 0.1).any(axis=-1).mean() > 0.1, file.stem


if __name__ == "__main__":
    wanted = [each for each in sys.argv[1:] if each != "--record"]
    if "--record" not in sys.argv:
        sys.exit(__doc__)
    for each in STUDIES:
        if not wanted or each.__name__ in wanted:
            record(each)
            print("recorded", each.__name__)
