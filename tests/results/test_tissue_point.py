"""Tissue at a point of the deformed image, and cached frames of an animation."""

from functools import partial

import numpy as np
import pytest

from napari_hmrf import Problem, SeilerPrior, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.results.animation import Motion
from napari_hmrf.results.tissue_point import Points
from napari_hmrf.solver.optimizers import ICM


@pytest.fixture(scope="module")
def solution():
    """Return a block in void, fixed at its left side and pushed 3 px right and 1 px down."""
    m = np.zeros((30, 40))
    m[4:26, 5:33] = 1
    y, c = np.zeros((30, 40, 2)), np.zeros((30, 40, 2))
    c[4:26, 5] = c[4:26, 32] = 1
    y[4:26, 32] = (1, 6)
    return solve(
        Problem(observed=y, confidence=c, stiffness=m, spacing=(1.0, 2.0)),
        SeilerPrior(),
        optimizer=ICM(60),
        backend="cpu",
    )


@pytest.mark.parametrize("fraction", [0.0, 0.4, 1.0])
def test_each_pixel_of_the_warped_image_maps_to_its_original_site(solution, fraction):
    points = Points(solution)
    moved = solution.displacement * fraction
    origin, covered = inverse_map(moved, spacing=solution.spacing, tissue=solution.tissue)
    asked = wrong = 0
    for row in range(30):
        for col in range(row % 2, 40, 2):
            found = points.at((row, col), fraction)
            at = tuple(np.floor(origin[row, col] + 0.5).astype(int))
            here = bool(covered[row, col] and solution.tissue[at])
            asked += here
            expected = None if not here else at
            answer = None if found is None else found.site
            if answer != expected:  # either site is correct halfway between two pixels
                apart = (
                    np.inf if None in (answer, expected) else np.abs(np.subtract(answer, at)).max()
                )
                wrong += apart > 1
    assert asked > 250
    assert wrong <= 0.03 * asked, "sites may differ only at the border of the tissue"


def test_the_displacement_of_a_point_is_in_the_unit_of_the_image(solution):
    found = Points(solution).at((10, 32))
    assert found.displacement == pytest.approx((1, 6), abs=0.05)
    assert found.length == pytest.approx(np.hypot(1, 6), abs=0.05)
    assert 1 < Points(solution).at((10, 20)).jacobian < 1.3


def test_a_point_outside_the_tissue_has_no_site(solution):
    points = Points(solution)
    assert points.at((0, 0)) is None
    assert points.at((10, 33.6), 0.0) is None
    assert points.at((10, 34.9), 1.0) is not None
    assert points.at((200, -50), 1.0) is None


def test_the_animation_at_rest_equals_the_image(solution):
    image = np.random.default_rng(0).random((30, 40)).astype(np.float32)
    labels = (image > 0.5).astype(np.uint8)
    colours = np.where(solution.tissue, image, np.float32(np.nan))
    for overlay in (labels, colours):
        motion = Motion(solution, image, overlay, grid=True)
        rest = compute_thread.submit(partial(motion.at, 0)).result()
        np.testing.assert_array_equal(rest.image, image)
        np.testing.assert_array_equal(rest.overlay, overlay)
        assert rest.nbytes > image.nbytes
    only = Motion(solution, grid=True).at(0.5)
    assert only.image is only.overlay is None
    assert len(only.grid)


def test_the_animation_caches_frames_within_a_memory_limit(solution, monkeypatch):
    motion = Motion(solution, np.zeros((30, 40), np.float32))
    assert motion.cached(0.5) is None
    assert motion.finest == 0

    def frame_at(fraction):
        return compute_thread.submit(partial(motion.at, fraction)).result()

    half = frame_at(0.5)
    assert motion.cached(0.5) is half
    monkeypatch.setattr("napari_hmrf.results.animation._KEPT", 2 * half.nbytes)
    assert motion.finest == 0.5, "two frames should fit into the cache"
    frame_at(0.6)
    frame_at(0.7)
    assert [motion.cached(part) is None for part in (0.5, 0.6, 0.7)] == [True, False, False]
