"""Large motion of volumes: displacement, absence of folds, rigid bodies, loads and limits."""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from napari_hmrf import (
    BackendError,
    Cancelled,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    solve,
)
from napari_hmrf.loads import Loads
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.priors.finite_bricks import bernstein_coefficients
from napari_hmrf.solver.priors.hexahedra import brick_shape
from validation.bodies import between_plates, dragged_ball, framed, growing_ball
from validation.oracles.large_motion import (
    displaced_corners,
    large_field,
    smallest_jacobian,
    smallest_jacobians,
)

Field = npt.NDArray[np.float64]
CUBE = brick_shape((1.0, 1.0, 1.0))


def random_volume(
    random: np.random.Generator, grows: bool, shape: tuple[int, ...] = (5, 6, 7)
) -> Problem:
    """Return tissue with a void, oblong voxels and, if `grows`, growth along all directions."""
    m = random.uniform(1, 3, shape)
    m[2, 3, 3] = 0
    strain = random.normal(size=(*shape, 3, 3)) * 0.1
    loads = Loads(growth=strain + strain.swapaxes(-1, -2)) if grows else None
    c = np.ones((*shape, 3))
    return Problem(observed=c, confidence=c, stiffness=m, spacing=(1.0, 1.3, 0.8), loads=loads)


@pytest.mark.parametrize("grows", [False, True])
def test_forces_in_a_volume_are_the_gradient_of_the_energy(grows) -> None:
    random = np.random.default_rng(1)
    problem, prior = random_volume(random, grows), NeoHookeanPrior(0.4)
    d, way = random.normal(size=(2, *problem.shape, 3)) * 0.1 * problem.unit
    assert 0 < prior.corner_jacobians(problem, d).min() < 0.5, "the barrier is not covered"
    short = 1e-5
    energies = [prior.energy(problem, d + side * short * way) for side in (-1, 1)]
    slope = float((prior.forces(problem, d) * way).sum()) / problem.unit
    assert (energies[1] - energies[0]) / (2 * short) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("grows", [False, True])
def test_the_compiled_loops_of_a_volume_match_the_prior(grows) -> None:
    from napari_hmrf.solver.backends.cpu.finite_volume_model import CpuFiniteVolumeModel

    random = np.random.default_rng(2)
    problem, prior = random_volume(random, grows), NeoHookeanPrior(0.4)
    d = random.normal(size=(*problem.shape, 3)) * 0.1
    model = CpuFiniteVolumeModel(problem.shape)
    model.assemble(prior.material(problem))
    planes = host.planes(d)
    energy, least = model.energy(planes)
    in_unit = d * problem.unit
    assert least == pytest.approx(prior.corner_jacobians(problem, in_unit).min(), rel=1e-6)
    assert energy == pytest.approx(prior.energy(problem, in_unit), rel=1e-6)
    forces = host.field(model.forces(planes)).copy()
    scale = np.abs(forces).max()
    np.testing.assert_allclose(forces / scale, prior.forces(problem, in_unit) / scale, atol=1e-6)
    way = host.planes(random.normal(size=d.shape))
    free = np.zeros(planes.shape, dtype=np.bool_)
    model.linearise(planes, free, model.forces(planes))
    short = 1e-6 * problem.unit
    sides = [prior.forces(problem, in_unit + side * short * host.field(way)) for side in (-1, 1)]
    expected = (sides[1] - sides[0]) / 2e-6
    scale = np.abs(expected).max()
    found = host.field(model.image(way)) / scale
    np.testing.assert_allclose(found, expected / scale, atol=1e-6)


@pytest.mark.parametrize("positive", [0.0, 1.0])
def test_the_matrices_for_a_factorization_match_the_products_of_the_iteration(positive) -> None:
    from napari_hmrf.solver.backends.cpu.finite_volume_model import CpuFiniteVolumeModel

    random = np.random.default_rng(7)
    problem, prior = random_volume(random, grows=True), NeoHookeanPrior(0.4)
    model = CpuFiniteVolumeModel(problem.shape)
    model.assemble(prior.material(problem))
    d = host.planes(random.normal(size=(*problem.shape, 3)) * 0.1)
    free = np.zeros(d.shape, dtype=np.bool_)
    model.linearise(d, free, model.forces(d), positive)
    ((_, matrices),) = model.tangents.parts
    every = matrices(*[slice(None)] * 3)
    way = random.normal(size=(*problem.shape, 3))
    values = displaced_corners(way)
    images = np.einsum("...ij,...j->...i", every, values.reshape(*values.shape[:3], 24))
    # The transpose of `displaced_corners`, applied to the images, gives the force of each site.
    sums = displaced_corners(np.arange(way.size, dtype=np.float64).reshape(way.shape)).astype(int)
    total = np.bincount(sums.ravel(), images.ravel(), way.size).reshape(way.shape)
    scale = np.abs(total).max()
    found = host.field(model.image(host.planes(way)))
    np.testing.assert_allclose(found / scale, total / scale, atol=1e-5)


def test_the_step_length_of_a_volume_stops_before_an_element_folds() -> None:
    from napari_hmrf.solver.backends.cpu.finite_volume_model import CpuFiniteVolumeModel

    random = np.random.default_rng(3)
    problem, prior = random_volume(random, grows=False), NeoHookeanPrior(0.4)
    model = CpuFiniteVolumeModel(problem.shape)
    model.assemble(prior.material(problem))
    d, way = (
        random.normal(size=(2, *problem.shape, 3))
        * np.array([0.05, 0.5])[:, None, None, None, None]
    )
    now = prior.corner_jacobians(problem, d * problem.unit)
    length, _ = model.length(host.planes(d), host.planes(way), 0.25, 1e-9)
    assert 0 < length < 1
    at_length = prior.corner_jacobians(problem, (d + length * way) * problem.unit)
    assert (at_length >= 0.25 * now - 1e-9).all()
    beyond = prior.corner_jacobians(problem, (d + 1.001 * length * way) * problem.unit)
    assert (beyond < 0.25 * now).any(), "the step could be longer"


def test_an_element_with_positive_corners_can_be_folded_and_is_detected() -> None:
    random = np.random.default_rng(4)
    elements = random.normal(size=(4000, 2, 2, 2, 3)) * 0.3
    # In a row, every second element of the volume is one of these.
    row = np.moveaxis(elements, 0, 2).reshape(2, 2, -1, 3)
    coefficients = bernstein_coefficients(row, CUBE)[:, 0, 0, ::2].T
    corners = coefficients.reshape(-1, 3, 3, 3)[:, ::2, ::2, ::2].reshape(-1, 8)
    smallest = smallest_jacobians(elements.reshape(-1, 8, 3), 6)
    hidden = (corners > 0).all(axis=1) & (smallest < 0)
    assert hidden.any(), "no such element was drawn"
    assert (coefficients[smallest < 0] <= 0).any(axis=1).all()


@pytest.mark.parametrize("poisson", [0.45, pytest.param(0.3, marks=pytest.mark.campaign)])
def test_large_motion_of_a_volume_matches_an_independent_newton_solve(poisson) -> None:
    size = 8
    places = np.moveaxis(np.indices((size, size, size), dtype=np.float64), 0, -1)
    turn = Rotation.from_rotvec([0, 0, 0.25]).as_matrix() - np.eye(3)
    m = np.ones((size, size, size))
    m[2:5, 2:5, 2:5] = 4
    problem = between_plates(m, places[0] @ turn.T)
    found = solve(problem, NeoHookeanPrior(poisson), backend="cpu").displacement
    assert np.abs(found - large_field(problem, NeoHookeanPrior(poisson))).max() < 0.002


def test_small_motion_of_a_volume_equals_that_of_the_elastic_prior() -> None:
    problem = dragged_ball(12, 1e-4)
    exactly = Multigrid(1e-9)
    large = solve(problem, NeoHookeanPrior(0.45), optimizer=exactly, backend="cpu").displacement
    small = solve(problem, ElasticPrior(0.45), optimizer=exactly, backend="cpu").displacement
    assert np.abs(large - small).max() < 1e-4 * np.abs(small).max()


def test_a_slab_in_plane_strain_moves_like_an_image() -> None:
    size = 24
    c = np.zeros((size, size, 2))
    c[:, 0] = c[:, -1] = 1
    y = np.zeros_like(c)
    y[:, -1] = 4.0, 3.0
    image = Problem(observed=y, confidence=c, stiffness=np.ones((size, size)))
    deep_c, deep_y = np.zeros((2, 3, size, size, 3))
    deep_c[..., 0], deep_c[..., 1:], deep_y[..., 1:] = 1, c, y
    slab = Problem(observed=deep_y, confidence=deep_c, stiffness=np.ones((3, size, size)))
    exactly = Multigrid(1e-5)
    strained = NeoHookeanPrior(0.3, plane="strain")
    flat = solve(image, strained, optimizer=exactly, backend="cpu").displacement
    deep = solve(slab, NeoHookeanPrior(0.3), optimizer=exactly, backend="cpu").displacement
    assert np.abs(deep[1][..., 1:] - flat).max() < 1e-3 * np.abs(y).max()


@pytest.mark.parametrize("strain", [-0.5, 1.0])
def test_the_smallest_jacobian_of_free_tissue_is_that_of_its_growth(strain) -> None:
    c = np.zeros((3, 3, 3, 3))
    c[0, 0, 0], c[0, 0, 2, 0], c[0, 2, 0, 0], c[0, 0, 2, 1] = 1, 1, 1, 1
    loads = Loads(growth=np.full((3, 3, 3), strain))
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones((3, 3, 3)), loads=loads)
    solution = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    assert solution.reach.least_jacobian == pytest.approx((1 + strain) ** 3, rel=1e-3)


def test_a_ball_that_doubles_its_radius_folds_no_tissue() -> None:
    problem = growing_ball(13, 2.5)
    folded = solve(problem, ElasticPrior(), backend="cpu")
    least = smallest_jacobian(problem, folded.displacement)
    assert least < 0, "the small-strain model folds no tissue"
    solution = solve(problem, NeoHookeanPrior(), backend="cpu")
    assert smallest_jacobian(problem, solution.displacement) > 0
    assert solution.reach.grown == 1.0
    mirrored = solution.displacement[::-1] * [-1, 1, 1]
    np.testing.assert_allclose(solution.displacement, mirrored, atol=2e-3)


def test_a_patch_can_be_dragged_far_through_a_volume_without_folds() -> None:
    problem = dragged_ball(14, 3.5)
    solution = solve(problem, NeoHookeanPrior(), backend="cpu")
    assert smallest_jacobian(problem, solution.displacement) > 0
    np.testing.assert_allclose(
        solution.displacement[problem.known], problem.observed[problem.known], atol=1e-3
    )


def test_a_rigid_cube_can_rotate_by_45_degrees() -> None:
    size = 13
    m = np.ones((size, size, size))
    bone = np.s_[5:8, 5:8, 5:8]
    m[bone] = np.inf
    places = np.moveaxis(np.indices(m.shape), 0, -1) - (size - 1) / 2
    turned = Rotation.from_rotvec([0, 0, np.pi / 4]).apply(places.reshape(-1, 3))
    inside = np.zeros(m.shape, dtype=np.bool_)
    inside[bone] = True
    held = framed(inside, turned.reshape(places.shape) - places)
    problem = Problem(observed=held.observed, confidence=held.confidence, stiffness=m)
    solution = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    assert smallest_jacobian(problem, solution.displacement) > 0
    np.testing.assert_allclose(solution.displacement[bone], problem.observed[bone], atol=1e-3)


def test_a_rigid_cube_that_is_held_at_one_site_rotates_with_its_surroundings() -> None:
    size = 11
    m = np.ones((size, size, size))
    m[4:7, 4:7, 4:7] = np.inf
    places = np.moveaxis(np.indices(m.shape), 0, -1) - (size - 1) / 2
    turned = Rotation.from_rotvec([0, 0.7, 0]).apply(places.reshape(-1, 3)).reshape(places.shape)
    c = np.ones((*m.shape, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    c[5, 5, 5] = 1
    problem = Problem(observed=turned - places, confidence=c, stiffness=m)
    solution = solve(problem, NeoHookeanPrior(0.3), backend="cpu")
    np.testing.assert_allclose(solution.displacement, turned - places, atol=2e-3)


def test_forces_and_slipping_observations_are_in_equilibrium() -> None:
    random = np.random.default_rng(6)
    size = 9
    force = np.zeros((size, size, size, 3))
    force[-1, :, :, 1] = 0.05
    c = np.zeros_like(force)
    c[0] = 1
    m = random.uniform(1, 2, (size, size, size))
    problem = Problem(
        observed=np.zeros_like(c), confidence=c, stiffness=m, loads=Loads(force=force)
    )
    prior = NeoHookeanPrior(0.3)
    solution = solve(problem, prior, backend="cpu")
    assert np.abs(solution.displacement[-1, :, :, 1]).min() > 1, "the motion is not large"
    rest = prior.forces(problem, solution.displacement)
    assert np.abs(rest[~problem.known]).max() < 1e-3 * np.abs(rest).max()
    doubted = dragged_ball(10, 2.0)
    c = np.where(doubted.observed != 0, 0.05, doubted.confidence)
    slips = solve(
        Problem(observed=doubted.observed, confidence=c, stiffness=doubted.stiffness),
        NeoHookeanPrior(0.3),
        backend="cpu",
    )
    moved = slips.displacement[..., 2].max()
    assert 0 < moved < 2.0


def test_a_solve_of_a_volume_in_large_motion_can_be_cancelled() -> None:
    stop = threading.Event()

    def cancel(monitor) -> None:
        if "cycle 2" in monitor.message:
            stop.set()

    with pytest.raises(Cancelled):
        solve(dragged_ball(14, 3.5), NeoHookeanPrior(), backend="cpu", progress=cancel, cancel=stop)


def test_shaders_do_not_solve_volumes_in_large_motion() -> None:
    with pytest.raises(BackendError, match="loops solve large motion, not opengl"):
        solve(dragged_ball(8, 1.0), NeoHookeanPrior(), backend="opengl")
