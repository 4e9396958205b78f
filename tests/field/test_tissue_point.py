"""The tissue at a point: found where it is seen, told where it came from."""

from functools import partial

import numpy as np
import pytest

from napari_hmrf import Problem, SeilerPrior, solve
from napari_hmrf.field.animation import Motion
from napari_hmrf.field.tissue_point import Points
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.optimizers import ICM


@pytest.fixture(scope="module")
def solution():
    """A block of tissue in void, held at the left, pushed 6 mm right (3 px) and 1 px down."""
    m = np.zeros((30, 40))
    m[4:26, 5:33] = 1
    y, c = np.zeros((30, 40, 2)), np.zeros((30, 40, 2))
    c[4:26, 5] = c[4:26, 32] = 1
    y[4:26, 32] = (1, 6)
    return solve(
        Problem(y, c, m, spacing=(1.0, 2.0)), SeilerPrior(), optimizer=ICM(60), backend="cpu"
    )


@pytest.mark.parametrize("fraction", [0.0, 0.4, 1.0])
def test_every_pixel_of_the_moved_image_finds_its_tissue(solution, fraction):
    points = Points(solution)
    moved = solution.displacement * fraction
    origin, covered = inverse_map(moved, spacing=solution.spacing, tissue=solution.tissue)
    asked = wrong = 0
    for row in range(30):
        for col in range(40):
            found = points.at((row, col), fraction)
            at = tuple(np.floor(origin[row, col] + 0.5).astype(int))
            here = bool(covered[row, col] and solution.tissue[at])
            asked += here
            expected = None if not here else at
            answer = None if found is None else found.site
            if answer != expected:  # halfway between two pixels either is right
                apart = (
                    np.inf if None in (answer, expected) else np.abs(np.subtract(answer, at)).max()
                )
                wrong += apart > 1
    assert asked > 500
    assert wrong <= 0.03 * asked, "but for the border of the tissue"


def test_a_point_tells_lengths_in_the_unit_of_the_image(solution):
    found = Points(solution).at((10, 32))
    assert found.displacement == pytest.approx((1, 6), abs=0.05)
    assert found.length == pytest.approx(np.hypot(1, 6), abs=0.05)
    assert 1 < Points(solution).at((10, 20)).jacobian < 1.3


def test_beside_the_tissue_there_is_nothing(solution):
    points = Points(solution)
    assert points.at((0, 0)) is None
    assert points.at((10, 33.6), 0.0) is None
    assert points.at((10, 34.9), 1.0) is not None
    assert points.at((200, -50), 1.0) is None


def test_at_rest_a_motion_is_the_image_itself(solution):
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


def test_moments_are_kept_as_far_as_there_is_room_for_them(solution, monkeypatch):
    motion = Motion(solution, np.zeros((30, 40), np.float32))
    assert motion.cached(0.5) is None
    assert motion.finest == 0

    def moment(fraction):
        return compute_thread.submit(partial(motion.at, fraction)).result()

    half = moment(0.5)
    assert motion.cached(0.5) is half
    monkeypatch.setattr("napari_hmrf.field.animation._KEPT", 2 * half.nbytes)
    assert motion.finest == 0.5, "there is room for two"
    moment(0.6)
    moment(0.7)
    assert [motion.cached(part) is None for part in (0.5, 0.6, 0.7)] == [True, False, False]
