"""Growth, weight, pressure and traction, compared with closed-form solutions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    BackendError,
    ElasticPrior,
    LiveSolver,
    Multigrid,
    Problem,
    ProblemError,
    SeilerPrior,
    Solution,
    solve,
)
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import Loads, cavity, growth, pressure, reactions, traction, weight
from napari_hmrf.tissue import sliding_precision
from tests.support.opengl import require_opengl
from validation.oracles import calculix
from validation.oracles.elasticity import direct_solution
from validation.studies import loads as studies

EXACT = Multigrid(1e-6)
OBLONG = {2: (0.5, 0.8), 3: (0.5, 0.8, 1.3)}


def places(shape, spacing):
    return np.moveaxis(np.indices(shape), 0, -1) * np.array(spacing)


def minimally_constrained(shape):
    """Return the confidence that prevents rigid motion but allows any strain."""
    axes = len(shape)
    c = np.zeros((*shape, axes))
    c[(0,) * axes] = 1
    for first, second in itertools.combinations(range(axes), 2):
        end = [0] * axes
        end[second] = -1
        c[(*end, first)] = 1
    return c


def fixed_problem(m, where, loads, spacing):
    """Return tissue with some fixed sites."""
    c = np.zeros((*np.shape(m), np.ndim(m)))
    c[where] = 1
    return Problem(observed=0 * c, confidence=c, stiffness=m, spacing=spacing, loads=loads)


def found(problem, prior, optimizer=EXACT, **more):
    return solve(problem, prior, optimizer=optimizer, backend="cpu", **more)


def random_problem(axes, seed=0, penalty=np.inf):
    """Return random tissue with a hole, a Poisson map and all kinds of loads."""
    rng, shape, spacing = np.random.default_rng(seed), (24, 20, 8)[-axes:], OBLONG[axes]
    m = 10 ** rng.random(shape) * 50
    m[(5, 4, 3)[-axes:]] = 0
    side = np.zeros(shape, bool)
    side[..., :2] = True
    strain = 0.1 * rng.normal(size=shape)
    loads = growth(strain, along=np.arange(axes) + 1) + growth(strain / 3)
    loads += weight(m, np.arange(axes) + 0.5, density=rng.random(shape), spacing=spacing)
    loads += pressure(m, side, 3.0, spacing=spacing)
    loads += traction(m, side, np.arange(axes) - 1.0, spacing=spacing)
    y, c = np.zeros((*shape, axes)), np.zeros((*shape, axes))
    c[-1], c[0, 0], y[0, 0] = 1, 1, 0.2
    nu = rng.uniform(0.1, 0.45, shape)
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=spacing, loads=loads)
    return problem, ElasticPrior(nu, plane="strain", penalty=penalty)


@pytest.mark.parametrize(
    ("axes", "along"), [(2, "all"), (2, "one"), (2, "all and one"), (3, "one")]
)
def test_free_tissue_grows_by_its_growth_strain_without_stress(axes, along):
    shape, spacing = (8, 9, 7)[:axes], OBLONG[axes]
    way = np.array([2.0, 1.0, -1.0])[:axes]
    strain, loads = np.zeros((axes, axes)), Loads()
    if "all" in along:
        strain, loads = 0.1 * np.eye(axes), growth(np.full(shape, 0.1))
    if "one" in along:
        strain = strain + 0.1 * np.outer(way, way) / (way @ way)
        loads += growth(np.full(shape, 0.1), along=way)
    m = 5 ** np.random.default_rng(0).random(shape)
    problem = Problem(
        observed=places(shape, spacing) @ strain,
        confidence=minimally_constrained(shape),
        stiffness=m,
        spacing=spacing,
        loads=loads,
    )
    prior = ElasticPrior(0.3)
    moved = found(problem, prior).displacement
    np.testing.assert_allclose(moved, places(shape, spacing) @ strain, atol=1e-5)
    assert abs(prior.energy(problem, moved)) < 1e-9
    assert np.abs(prior.forces(problem, moved)).max() < 1e-5


@pytest.mark.parametrize(
    ("direction", "longer"),
    [("isotropic", 0.1 * 1.3), ("in-plane", 0.1), ("through-thickness", 0.03)],
)
def test_growth_through_the_thickness_acts_in_plane_under_plane_strain(direction, longer):
    shape = (9, 12)
    strain = np.zeros((*shape, 3, 3))
    strain[..., 0, 0] = 0.1 * (direction != "in-plane")
    strain[..., 1, 1] = strain[..., 2, 2] = 0.1 * (direction != "through-thickness")
    problem = Problem(
        observed=places(shape, (1, 1)) * longer,
        confidence=minimally_constrained(shape),
        stiffness=np.ones(shape),
        loads=Loads(growth=strain),
    )
    moved = found(problem, ElasticPrior(0.3, plane="strain")).displacement
    np.testing.assert_allclose(moved, places(shape, (1, 1)) * longer, atol=1e-5)


@pytest.mark.parametrize("axes", [2, 3])
def test_a_hanging_bar_stretches_under_its_weight(axes):
    shape, spacing = (25, 4, 4)[:axes], OBLONG[axes]
    young, heavy, long = 30.0, 0.04, 24 * spacing[0]
    m = np.full(shape, young)
    loads = weight(m, (heavy / 2, 0, 0)[:axes], density=2.0, spacing=spacing)
    moved = found(fixed_problem(m, 0, loads, spacing), ElasticPrior(0.0)).displacement
    at = places(shape, spacing)[..., 0]
    np.testing.assert_allclose(moved[..., 0], heavy / young * (long * at - at**2 / 2), atol=1e-5)
    assert np.abs(moved[..., 1:]).max() < 1e-6


@pytest.mark.parametrize(("axes", "by"), [(2, "traction"), (3, "pressure")])
def test_a_bar_pulled_at_its_end_has_a_uniform_strain(axes, by, tmp_path):
    shape, spacing, young, nu = (5, 6, 9)[-axes:], OBLONG[axes], 30.0, 0.3
    m, end = np.full(shape, young), np.zeros(shape, bool)
    end[..., -1] = True
    if by == "pressure":
        loads = pressure(m, end, -1.5, spacing=spacing)
    else:
        loads = traction(m, end, np.eye(axes)[-1] * 1.5, spacing=spacing)
    strain = 1.5 / young * np.diag([*[-nu] * (axes - 1), 1.0])
    exact = places(shape, spacing) @ strain
    c = minimally_constrained(shape)
    c[..., 0, -1] = 1
    problem = Problem(observed=exact, confidence=c, stiffness=m, spacing=spacing, loads=loads)
    moved = found(problem, ElasticPrior(nu))
    np.testing.assert_allclose(moved.displacement, exact, atol=1e-5)
    pulls = reactions(problem, moved)
    area = np.prod((np.array(shape) - 1) * spacing) / ((shape[-1] - 1) * spacing[-1])
    again = Solution.read(moved.write(tmp_path / "field.npz"))
    np.testing.assert_array_equal(reactions(problem, again), pulls)
    np.testing.assert_allclose(pulls[..., 0, :].sum(axis=tuple(range(axes - 1)))[-1], -1.5 * area)


@pytest.mark.parametrize("plane", ["stress", pytest.param("strain", marks=pytest.mark.campaign)])
def test_the_field_of_an_annulus_under_pressure_converges_with_second_order(plane):
    coarse, fine = (studies.annulus(size, plane) for size in (16, 64))
    assert fine < 2e-3
    assert np.log(coarse / fine) / np.log(4) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize(
    ("plane", "sizes"),
    [("strain", (24, 96)), pytest.param("stress", (24, 96), marks=pytest.mark.campaign)],
)
def test_a_growing_disc_and_its_surroundings_match_eshelby(plane, sizes):
    coarse, fine = (studies.disc(size, plane) for size in sizes)
    assert fine < 2e-3
    assert np.log(coarse / fine) / np.log(sizes[1] / sizes[0]) > 1.7


def test_a_growing_ball_and_its_surroundings_match_eshelby():
    coarse, fine = (studies.disc(size, axes=3) for size in (12, 24))
    assert fine < 0.02
    assert coarse / fine > 3


@pytest.mark.parametrize(
    ("axes", "penalty"),
    [(2, np.inf), (2, 0.06), (3, 0.2), pytest.param(3, np.inf, marks=pytest.mark.campaign)],
)
def test_reactions_balance_all_loads_within_their_force_limit(axes, penalty):
    problem, prior = random_problem(axes, penalty=penalty)
    solution = found(problem, prior)
    holds = reactions(problem, solution)
    assert not holds[~problem.known].any()
    total = holds.reshape(-1, axes).sum(axis=0)
    given = problem.loads.force.reshape(-1, axes).sum(axis=0, dtype=float)
    np.testing.assert_allclose(total, -given, rtol=1e-4)
    most = penalty * prior.force_unit(problem)
    assert (np.abs(holds) <= most * (1 + 1e-6)).all()
    missing = problem.observed - solution.displacement
    slips = problem.known & (np.abs(missing) > 1e-5)
    assert slips.any() == (penalty < np.inf)
    np.testing.assert_allclose(holds[slips], most * np.sign(missing[slips]), rtol=1e-6)
    assert np.abs(prior.forces(problem, solution.displacement)[~problem.known]).max() < 1e-5
    energy = solution.mean_energy * problem.tissue.sum()
    missed = np.abs(missing)[problem.known].sum() / problem.unit
    lost = 0 if penalty == np.inf else penalty * missed
    assert energy == pytest.approx(prior.energy(problem, solution.displacement) + lost, rel=1e-4)


def large_problem():
    """Return soft and stiff tissue that is large enough to need cycles."""
    rng = np.random.default_rng(3)
    m = 20 ** np.kron(rng.random((8, 8)), np.ones((12, 12)))
    loads = growth(0.2 * (m > 5)) + weight(m, (0.001, -0.0005), spacing=1)
    return fixed_problem(m, 0, loads, (1.0, 1.0))


@pytest.mark.parametrize("tolerance", [1e-4, pytest.param(1e-2, marks=pytest.mark.campaign)])
def test_the_reported_error_is_a_bound_with_loads(tolerance):
    problem, prior = large_problem(), ElasticPrior(0.4)
    solution = found(problem, prior, Multigrid(tolerance))
    off = np.abs(solution.displacement - direct_solution(problem, prior)).max()
    assert off <= solution.convergence.error <= tolerance
    assert solution.iterations > 2


def test_random_tissue_with_loads_matches_a_direct_solve():
    problem, prior = random_problem(2)
    moved = found(problem, prior).displacement
    np.testing.assert_allclose(moved, direct_solution(problem, prior), atol=1e-5)


def test_equal_loads_need_no_cycle_and_similar_loads_start_warm():
    problem, prior = large_problem(), ElasticPrior(0.4)
    first = found(problem, prior, Multigrid())
    again = Loads(growth=problem.loads.growth, force=problem.loads.force)
    same = fixed_problem(problem.stiffness, 0, again, (1.0, 1.0))
    assert found(same, prior, Multigrid(), initial=first).iterations == 0
    slightly = Loads(growth=problem.loads.growth, force=problem.loads.force * 1.001)
    heavier = fixed_problem(problem.stiffness, 0, slightly, (1.0, 1.0))
    warm, cold = (found(heavier, prior, Multigrid(), initial=each) for each in (first, None))
    assert 0 < warm.iterations < cold.iterations
    assert np.abs(warm.displacement - cold.displacement).max() < 2e-3


def test_interpolated_loads_need_no_cycle():
    problem, prior = large_problem(), ElasticPrior(0.4)
    grows, pulls = problem.loads.growth, problem.loads.force

    def at(one, two):
        loads = Loads(growth=one * grows, force=two * pulls)
        return fixed_problem(problem.stiffness, 0, loads, (1.0, 1.0))

    known = [found(at(*shares), prior, Multigrid()) for shares in ((1, 1), (0.5, 1), (1, 0.6))]
    between = found(at(0.8, 0.9), prior, Multigrid(), initial=known)
    assert between.iterations == 0
    exact = direct_solution(at(0.8, 0.9), prior)
    assert np.abs(between.displacement - exact).max() <= between.convergence.error <= 1e-3
    of_other_kind = fixed_problem(
        problem.stiffness, 0, growth(0.1 * grows, along=(1, 0)), (1.0, 1.0)
    )
    assert found(of_other_kind, prior, Multigrid(), initial=known).iterations > 0


def test_a_drag_under_weight_needs_no_cycle_once_its_direction_is_known():
    m, c, y = np.ones((48, 48)), np.zeros((48, 48, 2)), np.zeros((48, 48, 2))
    c[:2], c[30:33, 20:23] = 1, 1
    loads = weight(m, (0.003, 0), spacing=1)
    earlier = []
    for step in range(4):
        y[30:33, 20:23] = (step, 0)
        problem = Problem(observed=y, confidence=c, stiffness=m, loads=loads)
        last = found(problem, ElasticPrior(), Multigrid(), initial=earlier or None)
        earlier = [last, *earlier]
    assert last.iterations == 0
    exact = direct_solution(problem, ElasticPrior())
    assert np.abs(last.displacement - exact).max() < 5e-3


def test_live_results_follow_the_loads():
    said = []
    with LiveSolver(said.append, ElasticPrior(0.4), backend="cpu") as live:
        for share in (0.0, 0.1, 0.2):
            live.submit(
                fixed_problem(np.ones((40, 40)), 0, growth(np.full((40, 40), share)), (1, 1))
            )
            assert live.wait()
    moved = [float(np.abs(each.solution.displacement).max()) for each in said]
    assert moved[0] == 0
    assert moved[2] == pytest.approx(2 * moved[1], abs=0.05)


@pytest.mark.parametrize("axes", [2, 3])
def test_a_rigid_body_has_the_weight_of_a_nearly_rigid_body(axes):
    shape = (14, 12, 10)[:axes]
    block = np.zeros(shape, bool)
    block[(slice(5, 9),) * axes] = True
    moved = []
    for stiff in (np.inf, 1e6):
        m = np.where(block, stiff, 1.0)
        loads = weight(m, (0, 0.01, 0)[:axes], density=1 + 9.0 * block, spacing=1)
        problem = fixed_problem(m, 0, loads, (1,) * axes)
        solution = found(problem, ElasticPrior(0.3))
        moved.append(solution.displacement)
        total = reactions(problem, solution).reshape(-1, axes).sum(axis=0)
        given = problem.loads.force.reshape(-1, axes).sum(axis=0)
        np.testing.assert_allclose(total, -given, atol=1e-3 * np.abs(given).max())
    np.testing.assert_allclose(*moved, atol=1e-4 * np.abs(moved).max())


def test_the_support_of_a_rigid_body_bears_its_weight():
    m, c, y = np.ones((12, 12)), np.zeros((12, 12, 2)), np.zeros((12, 12, 2))
    m[4:8, 4:8] = np.inf
    c[0] = c[5, 4:6] = 1
    y[5, 4:6, 0] = 1
    problem = Problem(observed=y, confidence=c, stiffness=m, loads=weight(m, (0, 0.1), spacing=1))
    solution = found(problem, ElasticPrior(0.3))
    holds = reactions(problem, solution)
    np.testing.assert_allclose(
        holds.sum(axis=(0, 1)), -problem.loads.force.sum(axis=(0, 1)), atol=1e-4
    )
    assert holds[5, 4:6, 0].sum() > 0.2, "the support should pull the body down"


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("bone", [1.0, np.inf])
@pytest.mark.parametrize("support", ["wall", "landmark"])
def test_walls_of_a_precision_and_landmarks_bear_the_load(axes, bone, support):
    shape = (12, 9, 8)[:axes]
    m, c = np.ones(shape), np.zeros((*shape, axes))
    m[(slice(4, 7),) * axes] = bone
    c[:, 0, ..., 1:] = 1
    floor = np.arange(12).reshape(12, *(1,) * (axes - 1)) == 11
    middle = [(5.0, 4.0, 4.0)[:axes]]
    observed = (
        {"precision": sliding_precision(m, np.broadcast_to(floor, shape), spacing=1)}
        if support == "wall"
        else {"landmarks": Landmarks(middle, middle, sd=0.2, scale=StrainScale(0.1, extent=5))}
    )
    loads = weight(np.ones(shape), (0.01, 0, 0)[:axes], spacing=1)
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, loads=loads, **observed)
    holds = reactions(problem, found(problem, ElasticPrior(0.3)))
    sites = tuple(range(axes))
    down = -loads.force.sum(axis=sites)
    np.testing.assert_allclose(holds.sum(axis=sites), down, atol=1e-4)
    bears = holds[-1] if support == "wall" else holds[4:7, 3:7]
    np.testing.assert_allclose(bears.reshape(-1, axes).sum(axis=0)[0], down[0], atol=1e-4)


def test_supports_too_weak_for_a_load_are_rejected_and_slip_is_in_equilibrium():
    shape = (10, 8)
    m, loads = np.ones(shape), weight(np.ones(shape), (0.01, 0), spacing=1)
    problem = fixed_problem(m, 0, loads, (1, 1))
    heavy = 0.01 * 9 * 7
    exactly = found(problem, ElasticPrior(0.3)).displacement
    firmly = found(problem, ElasticPrior(0.3, penalty=heavy)).displacement
    np.testing.assert_allclose(firmly, exactly, atol=1e-5)
    barely = ElasticPrior(0.3, penalty=1.02 * heavy / 8)
    solution = found(problem, barely)
    holds = reactions(problem, solution)[0, :, 0]
    assert holds.sum() == pytest.approx(-heavy, rel=1e-5)
    assert np.abs(solution.displacement[0]).max() > 1e-3
    with pytest.raises(ProblemError, match="exceed the forces of the observations"):
        solve(problem, ElasticPrior(0.3, penalty=0.98 * heavy / 8), backend="cpu")


def disc(radius):
    """Return the sites of the elements of a disc."""
    at = np.indices((2 * radius + 10,) * 2) - (radius + 4.5)
    inside = np.hypot(*at) < radius
    sites = np.zeros((2 * radius + 11,) * 2, bool)
    for i, j in itertools.product((0, 1), repeat=2):
        sites[i : i + len(inside), j : j + len(inside)] |= inside
    return sites


def test_pressure_on_a_closed_surface_acts_inwards_without_net_force():
    tissue = disc(12)
    loads = pressure(tissue, np.ones_like(tissue), 2.0, spacing=1)
    assert np.abs(loads.force.sum(axis=(0, 1))).max() < 1e-5
    at = np.indices(tissue.shape) - 17.0
    outwards = (np.moveaxis(at, 0, -1) * loads.force).sum()
    assert outwards == pytest.approx(-2 * 2 * np.pi * 12**2, rel=0.02)


@pytest.mark.parametrize("radius", [10, pytest.param(20, marks=pytest.mark.campaign)])
def test_traction_acts_on_the_smooth_area_of_a_surface(radius):
    tissue = disc(radius)
    force = traction(tissue, np.ones_like(tissue), (1.0, -2.0), spacing=1).force.sum(axis=(0, 1))
    np.testing.assert_allclose(force, np.array([1, -2]) * 2 * np.pi * radius, rtol=0.01)


@pytest.mark.parametrize("radius", [8, 20, 50])
def test_traction_on_painted_pixels_acts_half_a_pixel_inside_their_outline(radius):
    rows, cols = np.indices((2 * radius + 11,) * 2) - (radius + 5)
    painted = np.hypot(rows, cols) <= radius
    force = traction(painted, np.ones_like(painted), (0, 1.0), spacing=1).force.sum()
    assert 0.4 < radius - force / (2 * np.pi) < 0.8


def test_forces_use_the_units_of_stiffness_and_length():
    """Solve the same tissue in kPa and mm, and in Pa and m."""
    shape = (16, 12)
    m, side = np.full(shape, 2.0), np.zeros(shape, bool)
    m[4:9, 3:7] = 6.0
    side[:, -1] = True

    def at(stiffness, step):
        loads = pressure(stiffness, side, 0.05 * stiffness[0, 0], spacing=(step, step))
        loads += weight(stiffness, (0.01 * stiffness[0, 0] / step, 0), spacing=(step, step))
        return fixed_problem(stiffness, 0, loads, (step, step))

    one, other = at(m, 0.5), at(1000 * m, 0.0005)
    first, second = (found(each, ElasticPrior()) for each in (one, other))
    np.testing.assert_allclose(first.displacement, 1000 * second.displacement, atol=1e-5)
    np.testing.assert_allclose(
        reactions(one, first), reactions(other, second), atol=1e-4 * np.abs(one.loads.force).max()
    )


@pytest.mark.skipif(not calculix.is_there(), reason=calculix.MISSING)
@pytest.mark.parametrize(("axes", "plane", "nu"), [(2, "stress", 0.3), (3, "strain", 0.0)])
def test_growth_weight_and_pressure_agree_with_calculix(axes, plane, nu):
    case = studies.loaded_tissue((16, 8)[axes - 2], axes)
    off, most, unbalanced = studies.loaded(case, plane, nu)
    assert off < 1e-5 * most
    assert unbalanced < 1e-6


@pytest.mark.skipif(not calculix.is_there(), reason=calculix.MISSING)
@pytest.mark.parametrize(("axes", "plane", "nu"), [(2, "stress", 0.3), (3, "strain", 0.0)])
@pytest.mark.parametrize("contents", ["nothing", "fluid, 60 %"])
def test_tissue_without_a_removed_part_agrees_with_calculix(axes, plane, nu, contents):
    # In a smaller volume, sites beside the part are in no element, and move without CalculiX.
    off, most = studies.resected((16, 10)[axes - 2], axes, plane, nu, contents)
    assert most > 0.1
    assert off < (1e-5 * most if contents == "nothing" else 0.01)


def test_shaders_solve_images_with_loads():
    require_opengl()
    problem, prior = large_problem(), ElasticPrior(0.4)
    shaded = solve(problem, prior, optimizer=Multigrid(1e-3), backend="opengl")
    assert shaded.convergence.error <= 1e-3
    assert np.abs(shaded.displacement - direct_solution(problem, prior)).max() <= 1e-3


def test_loads_are_rejected_where_they_are_not_supported():
    problem, _ = random_problem(3)
    with pytest.raises(BackendError, match="volumes with loads"):
        solve(problem, backend="opengl")
    with pytest.raises(ProblemError, match="no forces"):
        solve(problem, SeilerPrior())
    loose = fixed_problem(
        np.ones((6, 6)), (0, 0), weight(np.ones((6, 6)), (1, 0), spacing=1), (1, 1)
    )
    with pytest.raises(ProblemError, match="could still move by turning"):
        solve(loose)


def test_loads_in_inconsistent_units_are_rejected():
    m = np.ones((40, 40))
    with pytest.raises(ProblemError, match="consistent units"):
        solve(fixed_problem(m, 0, weight(m, (1e4, 0), spacing=1), (1, 1)), backend="cpu")


MASK = np.ones((6, 6), bool)


@pytest.mark.parametrize(
    ("what", "make"),
    [
        ("not a direction", lambda m: growth(np.ones((6, 6)), along=(0, 0))),
        ("one number is needed", lambda m: growth(0.1)),
        ("not symmetric", lambda m: Loads(growth=np.arange(144).reshape(6, 6, 2, 2))),
        ("above -1", lambda m: growth(-np.ones((6, 6)))),
        ("NaN or infinite", lambda m: growth(np.full((6, 6), np.nan))),
        ("0.2 means a fifth longer", lambda m: growth(np.full((6, 6), 20))),
        ("surface: .*nan", lambda m: pressure(m, np.where(MASK, np.nan, 0), 1.0, spacing=1)),
        (r"surface: .*0\.2", lambda m: traction(m, 0.2 * MASK, (1.0, 0), spacing=1)),
        ("all of the tissue", lambda m: cavity(m, MASK, spacing=1, pressure=1.0)),
        ("no removed tissue", lambda m: cavity(m, MASK & False, spacing=1, pressure=1.0)),
        ("36 negative values", lambda m: weight(-np.ones((6, 6)), (1.0, 0), spacing=1)),
        ("has shape", lambda m: growth(np.ones((5, 6)))),
        ("rigid tissue", lambda m: growth(np.ones((6, 6)))),
        ("has shape", lambda m: Loads(force=np.ones((6, 6)))),
        ("without tissue that is two pixels wide", lambda m: Loads(force=np.ones((6, 6, 2)))),
        ("type float", lambda m: 0.1),
        ("same grid", lambda m: growth(np.ones((6, 6))) + growth(np.ones((6, 5)), along=(1, 0))),
        ("no face of", lambda m: pressure(m, MASK & False, 1.0, spacing=1)),
        ("same pixel grid", lambda m: pressure(m, MASK[1:], 1.0, spacing=1)),
        ("Pass one number", lambda m: pressure(m, MASK, (1.0, 2.0), spacing=1)),
        ("Pass 2 components", lambda m: traction(m, MASK, 1.0, spacing=1)),
        ("Pass 2 components", lambda m: weight(m, (1.0, 0, 0), spacing=1)),
        ("NaN or infinite", lambda m: weight(m, (np.nan, 0), spacing=1)),
        ("no tissue that is two pixels wide", lambda m: weight(np.eye(6), (1.0, 0), spacing=1)),
    ],
)
def test_invalid_loads_are_rejected_with_an_explanation(what, make):
    m = np.ones((6, 6))
    m[0, 0], m[2:4, 2:4] = 0, np.inf
    with pytest.raises(ProblemError, match=what):
        fixed_problem(m, -1, make(m), (1, 1))


@pytest.mark.parametrize(
    "make",
    [
        lambda m, sizes: weight(m, (0, 0.1), spacing=sizes),
        lambda m, sizes: pressure(m, MASK, 0.1, spacing=sizes),
        lambda m, sizes: traction(m, MASK, (0, 0.1), spacing=sizes),
    ],
)
def test_forces_for_another_spacing_are_rejected_naming_both_spacings(make):
    m = np.ones((6, 6))
    loads = make(m, (2.0, 0.5))
    fixed_problem(m, -1, loads + growth(0.1 * m), (2.00001, 0.5))
    with pytest.raises(ProblemError, match=r"for pixels of 2 x 0\.5, but .* has pixels of 1 x 1\."):
        fixed_problem(m, -1, growth(0.1 * m) + loads, (1, 1))
    with pytest.raises(ProblemError, match=r"for pixels of 2 x 0\.5 and of 1 x 1\. Compute both"):
        loads + make(m, 1)
    fixed_problem(m, -1, Loads(force=loads.force), (1, 1))  # these loads have no spacing
    with pytest.raises(ProblemError, match=r"spacing: is \(2, 0\)"):
        Loads(force=loads.force, spacing=(2, 0))


def test_loads_are_immutable_and_recorded_as_inputs_of_a_result():
    m = np.ones((6, 6))
    loads = growth(0.1 * m, along=(1, 0)) + weight(m, (0, 0.1), spacing=1)
    with pytest.raises(AttributeError):
        loads.force = None
    problem, other = (fixed_problem(m, 0, each, (1, 1)) for each in (loads, None))
    assert "growth from 0 to 0.1, force of (0, 2.5) altogether" in repr(problem)
    made = found(problem, ElasticPrior())
    assert set(made.provenance.inputs) == {
        "observed",
        "confidence",
        "stiffness",
        "growth",
        "force",
    }
    assert set(other.digests) == {"observed", "confidence", "stiffness"}
    with pytest.raises(ArgumentError, match="another problem"):
        reactions(other, made)
    with pytest.raises(ArgumentError, match="no forces"):
        reactions(problem, replace(made, elasticity=None))


@pytest.mark.parametrize("make", [pressure, traction, weight])
def test_forces_require_a_spacing(make):
    m, arguments = np.ones((6, 6)), {"acceleration": (1.0, 0.0)}
    if make is not weight:
        arguments = {"surface": MASK, "vector" if make is traction else "amount": 1.0}
    arguments |= {"vector": (1.0, 0.0)} if make is traction else {}
    with pytest.raises(TypeError, match="spacing"):
        make(m, **arguments)
    even, both = make(m, **arguments, spacing=0.5), make(m, **arguments, spacing=(0.5, 0.5))
    assert even.same_as(both)
    assert not even.same_as(make(m, **arguments, spacing=1))


def test_reactions_of_a_field_with_another_spacing_are_rejected():
    oblong = fixed_problem(np.ones((6, 6)), -1, growth(0.1 * np.ones((6, 6))), (0.5, 0.8))
    square = fixed_problem(np.ones((6, 6)), -1, growth(0.1 * np.ones((6, 6))), (1.0, 1.0))
    with pytest.raises(ArgumentError, match=r"has pixels of 1 x 1, but .* pixels of 0\.5 x 0\.8"):
        reactions(square, solve(oblong, backend="cpu"))
