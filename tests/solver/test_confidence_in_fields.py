"""Accuracy of the reported error for difficult tissue."""

from itertools import product

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import Cancelled, ElasticPrior, Multigrid, solve
from napari_hmrf.data import phantom
from tests.support.cancel_flags import During
from tests.support.opengl import require_opengl
from validation.bodies import between_plates
from validation.oracles.elasticity import direct_solution
from validation.problems import tissue_with_gaps

PRIOR = ElasticPrior(0.3)


def compressed_tissue(m):
    """Return tissue with a fixed first row and a last row pushed by 4 pixels."""
    return between_plates(m, (4, 0))


def two_phases(n, sigma, contrast, seed=0):
    """Return the stiffness of two phases: smoothed noise, thresholded at its mean."""
    noise = ndimage.gaussian_filter(
        np.random.default_rng(seed).normal(size=(n, n)), sigma, mode="wrap"
    )
    return np.where(noise > 0, contrast, 1.0)


def fibres(n, contrast):
    """Return the stiffness of fibres one pixel wide."""
    i, j = np.indices((n, n))
    return np.where((i + 2 * j) % 9 == 0, contrast, 1.0)


TISSUES = {
    "lumps": lambda contrast: two_phases(65, 5, contrast),
    "large lumps": lambda contrast: two_phases(97, 10, contrast, seed=4),
    "fibres": lambda contrast: fibres(65, contrast),
}


DIFFICULT = [("lumps", 1e2), ("lumps", 1e5), ("fibres", 1e4), ("fibres", 1e7)]


@pytest.mark.parametrize(
    ("tissue", "contrast"),
    [
        *DIFFICULT,
        *(
            pytest.param(*each, marks=pytest.mark.campaign)
            for each in product(TISSUES, (1e2, 1e4, 1e5, 1e7))
            if each not in DIFFICULT
        ),
    ],
)
def test_the_reported_error_of_irregular_tissue_is_a_bound(tissue, contrast):
    problem = compressed_tissue(TISSUES[tissue](contrast))
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="cpu")
    off = np.abs(solution.displacement - direct_solution(problem, PRIOR)).max()
    assert off <= 3 * solution.convergence.error + 1e-4
    assert off <= 3e-3


def error_and_report(problem, prior, tolerance):
    solution = solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu")
    off = solution.displacement - direct_solution(problem, prior)
    return np.linalg.norm(off, axis=-1).max(), solution.convergence


@pytest.mark.parametrize("seed", [2, 201, 610, 744, 873])
def test_a_flap_beside_a_gap_turns_within_the_tolerance(seed):
    off, convergence = error_and_report(tissue_with_gaps(seed), ElasticPrior(0.45), 0.01)
    assert off <= 1.05 * max(convergence.error, 0.01)


def test_the_reported_error_is_a_bound_with_shaders():
    require_opengl()
    problem = compressed_tissue(two_phases(65, 5, 1e5))
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="opengl")
    assert np.abs(solution.displacement - direct_solution(problem, PRIOR)).max() <= 1e-3


def test_a_factorization_of_the_whole_system_is_reported():
    said = []
    problem = compressed_tissue(fibres(65, 1e6))
    solution = solve(
        problem,
        PRIOR,
        optimizer=Multigrid(),
        backend="cpu",
        progress=lambda m: said.append(m.message),
    )
    assert solution.convergence.way == "factors"
    assert any("factorizing" in message for message in said)


@pytest.mark.parametrize(
    "kind", ["mass-effect", pytest.param("expansion", marks=pytest.mark.campaign)]
)
def test_phantoms_converge_with_cycles_alone(kind):
    solution = solve(phantom(kind, 128).problem, PRIOR, optimizer=Multigrid(), backend="cpu")
    assert solution.convergence.way == "cycles"
    assert solution.iterations <= 7


def test_stiff_tissue_rotates_freely_on_oblong_pixels():
    m = np.ones((40, 40))
    m[15:25, 10:30] = 1e6
    problem = between_plates(m, (0, 3), (0.28, 1.0))
    solution = solve(problem, PRIOR, optimizer=Multigrid(), backend="cpu")
    assert np.abs(solution.displacement - direct_solution(problem, PRIOR)).max() < 1e-3


@pytest.mark.parametrize(
    "contrast",
    [1e2, *(pytest.param(contrast, marks=pytest.mark.campaign) for contrast in (1.0, 1e4))],
)
def test_nearly_incompressible_tissue_needs_at_most_forty_cycles(contrast):
    i, j = np.indices((97, 97))
    m = np.where((i - 48) ** 2 + (j - 48) ** 2 < 400, contrast, 1.0)
    solution = solve(
        compressed_tissue(m),
        ElasticPrior(0.499, plane="strain"),
        optimizer=Multigrid(),
        backend="cpu",
    )
    assert solution.iterations <= 40


def test_a_solve_can_be_cancelled_during_the_factorization():
    flag = During("factorizing")
    with pytest.raises(Cancelled):
        solve(
            compressed_tissue(fibres(65, 1e6)),
            PRIOR,
            optimizer=Multigrid(),
            backend="cpu",
            cancel=flag,
        )
