"""Parts of the tissue that slide along each other."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.loads import Loads, weight
from napari_hmrf.solver.coupling import Coupling
from napari_hmrf.solver.problem import variant_of
from napari_hmrf.solver.unfolded import unfolded
from napari_hmrf.tissue import SlidingParts
from validation.oracles.parts import sliding_field
from validation.problems import tissue_with_parts
from validation.studies.sliding import disc, measure, plane, tilted, wedge

SLIP = 4.0


def both(mask, axes=2):
    """Return a confidence of 1 in all components at the sites of a mask."""
    return np.repeat(mask[..., None], axes, axis=-1).astype(float)


def turning(size, radius, axes):
    """Return the distance from the middle, the mask of a ball and its rotation."""
    place = np.moveaxis(np.indices((size,) * axes), 0, -1) - (size - 1) / 2 - 0.15
    away = np.linalg.norm(place, axis=-1)
    turn = np.zeros(place.shape)
    turn[..., -2], turn[..., -1] = -place[..., -1], place[..., -2]
    return away, away < radius, turn * SLIP / radius


@pytest.mark.parametrize(
    "case",
    [
        plane(17),
        wedge(),
        disc(20.3),
        *(pytest.param(plane(degrees), marks=pytest.mark.campaign) for degrees in (0, 45)),
    ],
    ids=lambda case: case.name,
)
def test_a_block_and_a_disc_slide_without_a_gap_or_a_kink(case):
    field = solve(case.problem(), backend="cpu").displacement.astype(float)
    error = np.linalg.norm(field - case.exact, axis=-1)[case.stiffness > 0]
    assert error.max() <= 0.05 * SLIP
    slip, gap, kink = measure(case, field)
    assert abs(slip - 1) <= 0.05
    assert gap <= 0.05
    assert kink <= 0.05


@pytest.mark.campaign
def test_a_ball_turns_in_a_shell():
    away, inside, turn = turning(24, 8, 3)
    held = away < 8 / 3
    for axis in range(3):
        held.swapaxes(0, axis)[[0, -1]] = True
    y = np.where(inside[..., None], turn, 0.0)
    parts = SlidingParts(inside.astype(int))
    problem = Problem(
        observed=y, confidence=both(held, 3), stiffness=np.ones(away.shape), sliding=parts
    )
    moved = solve(problem, backend="cpu").displacement
    shell = abs(away - 8) < 3
    fast = inside & shell & (np.linalg.norm(turn, axis=-1) > SLIP / 2)
    share = (moved * turn).sum(axis=-1)[fast] / (turn**2).sum(axis=-1)[fast]
    assert share.min() >= 0.95
    assert abs(moved - y)[shell].max() <= 0.15


@pytest.mark.parametrize(
    "degrees", [17, *(pytest.param(degrees, marks=pytest.mark.campaign) for degrees in (0, 45))]
)
def test_pressure_passes_through_an_interface_of_any_direction(degrees):
    """A block of two parts is compressed along the normal, and slips at the same time."""
    normal, along, place = tilted(degrees, 64)
    depth = place @ normal - 0.2
    above = depth < 0
    y = 0.05 * depth[..., None] * normal + np.where(above[..., None], SLIP * along, 0.0)
    edge = np.ones(depth.shape, np.bool_)
    edge[1:-1, 1:-1] = False
    parts = SlidingParts(above.astype(int))
    problem = Problem(
        observed=y, confidence=both(edge), stiffness=np.ones(depth.shape), sliding=parts
    )
    error = solve(problem, ElasticPrior(0.0), backend="cpu").displacement - y
    assert abs(error).max() <= 0.06


def test_weight_along_an_interface_stretches_both_parts_as_it_stretches_one_body():
    upper, m = np.indices((8, 12))[0] < 4, np.ones((8, 12))
    held = both(np.indices(m.shape)[1] == 0)
    rest, loads = 0 * held, weight(m, (0, 0.01), spacing=1)
    fields = [
        solve(
            Problem(observed=rest, confidence=held, stiffness=m, loads=loads, sliding=parts),
            ElasticPrior(0.0),
            backend="cpu",
        ).displacement
        for parts in (SlidingParts(upper.astype(int)), None)
    ]
    assert fields[0] == pytest.approx(fields[1], abs=0.05 * float(fields[1].max()))


@pytest.mark.parametrize(
    "number", [0, 1, 3, *(pytest.param(number, marks=pytest.mark.campaign) for number in (2, 5))]
)
def test_sliding_parts_give_the_field_of_least_energy(number):
    problem, prior = tissue_with_parts(number, is_loaded=True, has_hole=True)
    solution = solve(problem, prior, backend="cpu")
    off = abs(solution.displacement - sliding_field(problem, prior)) / problem.unit
    assert off[sites_of_elements(problem.tissue)].max() <= 1e-3
    assert solution.convergence.error <= 1e-3
    again = solve(problem, prior, backend="cpu", initial=solution)
    assert len(again.energy) <= 2  # at most one cycle is left to do


@pytest.mark.parametrize(
    ("beside", "number"),
    [
        ("landmarks", 1),
        ("bodies", 3),
        pytest.param("landmarks", 3, marks=pytest.mark.campaign),
        pytest.param("bodies", 1, marks=pytest.mark.campaign),
    ],
)
def test_parts_with_landmarks_or_rigid_bodies_have_the_field_of_least_energy(beside, number):
    problem, prior = tissue_with_parts(number, is_loaded=True, **{f"has_{beside}": True})
    solution = solve(problem, prior, backend="cpu")
    off = abs(solution.displacement - sliding_field(problem, prior)) / problem.unit
    assert off[sites_of_elements(problem.tissue)].max() <= solution.convergence.error


@pytest.mark.filterwarnings("ignore:a drift was estimated")
def test_a_drift_strains_all_parts_that_are_not_rigid():
    problem, prior = tissue_with_parts(1, has_bodies=True, has_drift=True)
    solution = solve(problem, prior, backend="cpu")
    off = abs(solution.displacement - sliding_field(problem, prior)) / problem.unit
    assert off[sites_of_elements(problem.tissue)].max() <= solution.convergence.error
    drift = np.array(solution.provenance.parameters["drift"])
    assert abs(drift).max() >= 1e-3
    soft = problem.tissue & ~problem.rigid
    grown = np.where(soft[..., None, None], drift, 0.0)
    assert solution.elasticity.growth == pytest.approx(grown, abs=1e-6)
    assert solution.loads.growth == pytest.approx(grown, abs=1e-6)


@pytest.mark.parametrize("axes", [2, pytest.param(3, marks=pytest.mark.campaign)])
def test_a_rigid_ball_turns_in_its_socket_which_stays_at_rest(axes):
    away, inside, turn = turning(32 if axes == 2 else 24, 8, axes)
    held = both(away > (12 if axes == 2 else 10), axes) + both(away < 2, axes)
    y = np.where(inside[..., None], turn, 0.0)
    m = np.where(inside, np.inf, 1.0)
    parts = SlidingParts(inside.astype(int))
    moved = solve(
        Problem(observed=y, confidence=held, stiffness=m, sliding=parts), backend="cpu"
    ).displacement
    assert moved[inside] == pytest.approx(y[inside], abs=1e-3)
    assert abs(moved[~inside]).max() <= 0.05 * SLIP


def test_rigid_tissue_in_a_part_takes_at_most_twice_the_cycles():
    away, inside, turn = turning(96, 30, 2)
    bone = np.hypot(*(np.indices(away.shape) - np.array([59, 47])[:, None, None])) < 8
    y, held = np.where(inside[..., None], turn, 0.0), both((away < 4) | (away > 45))
    solutions = [
        solve(
            Problem(
                observed=y,
                confidence=held,
                stiffness=np.where(bone, stiffness, 1.0),
                sliding=SlidingParts(inside.astype(int)),
            ),
            backend="cpu",
        )
        for stiffness in (np.inf, 1.0)
    ]
    assert {each.convergence.way for each in solutions} == {"cycles"}
    assert len(solutions[0].energy) <= 2 * len(solutions[1].energy)


def test_landmarks_move_the_part_of_the_nearest_site():
    depth = np.indices((30, 30))[0] - 14.5
    points = np.array([[14.3, 12.2], [14.7, 20.1], [29.0, 29.0], [14.5, 8.0]])
    push = np.array([[0.0, 2.0], [0.0, -2.0], [0.0, -2.0], [0.0, 2.0]])
    problem = Problem(
        observed=np.zeros((30, 30, 2)),
        confidence=both(np.indices((30, 30))[1] == 0) * [1, 0],
        stiffness=np.ones((30, 30)),
        sliding=SlidingParts((depth < 0).astype(int)),
        landmarks=Landmarks(points, points + push, sd=0.01),
    )
    moved = solve(problem, backend="cpu").displacement[..., 1]
    assert moved[:15] == pytest.approx(np.full((15, 30), 2.0), abs=0.02)
    assert moved[15:] == pytest.approx(np.full((15, 30), -2.0), abs=0.02)


def test_the_coupling_is_the_gradient_of_its_energy_and_resists_gaps_only():
    away, inside, _ = turning(16, 5, 2)
    rest = np.zeros((16, 16, 2))
    labels = SlidingParts(inside.astype(int))
    problem = Problem(
        observed=rest, confidence=both(away > 7), stiffness=np.ones(away.shape), sliding=labels
    )
    parts, _ = unfolded(problem, ElasticPrior(0.3))
    between: Coupling = parts.coupling
    rng = np.random.default_rng(0)
    d, way = rng.normal(size=(2, *parts.observed.shape))
    slope = (between.energy(d + 1e-4 * way) - between.energy(d - 1e-4 * way)) / 2e-4
    assert slope == pytest.approx((between.forces(d) * way).sum(), rel=1e-6)
    slip = np.zeros(parts.observed.shape).reshape(-1, 2)
    slip[between.second] = between.normals[:, ::-1] * (1, -1)
    assert between.energy(slip.reshape(d.shape)) <= 1e-9 * between.energy(d)


@pytest.mark.parametrize(
    "contrast",
    [10.0, *(pytest.param(contrast, marks=pytest.mark.campaign) for contrast in (1.0, 1000.0))],
)
def test_sliding_takes_at_most_twice_the_cycles_of_connected_tissue(contrast):
    away, inside, turn = turning(64, 20, 2)
    held = both((away < 6) | (away > 31))
    m, y = np.where(inside, 1.0, contrast), np.where(inside[..., None], turn, 0.0)
    counts = [
        len(
            solve(
                Problem(observed=y, confidence=held, stiffness=m, sliding=parts), backend="cpu"
            ).energy
        )
        - 1
        for parts in (SlidingParts(inside.astype(int)), None)
    ]
    assert counts[0] <= 2 * counts[1]


def test_a_part_that_nothing_holds_is_named():
    depth = np.indices((40, 40))[0] - 19.7
    rest, parts = np.zeros((40, 40, 2)), SlidingParts((depth < 0).astype(int))
    with pytest.raises(ProblemError, match=r"around \(9, 19\).*slide or turn"):
        solve(
            Problem(
                observed=rest,
                confidence=both(depth > 15),
                stiffness=np.ones(depth.shape),
                sliding=parts,
            ),
            backend="cpu",
        )


def test_a_motion_that_depends_on_exact_normals_is_refused_unless_nothing_drives_it():
    away, inside, turn = turning(40, 12, 2)
    m, held = np.ones(away.shape), both(away > 19)
    parts = SlidingParts(inside.astype(int))
    pushed = np.where(away[..., None] > 19, [1.0, 0.0], 0.0)
    moved = solve(
        Problem(observed=pushed, confidence=held, stiffness=m, sliding=parts), backend="cpu"
    ).displacement
    assert moved == pytest.approx(np.broadcast_to([1.0, 0.0], moved.shape), abs=1e-3)
    twist = Loads(force=1e-5 * turn * inside[..., None])
    with pytest.raises(ProblemError, match=r"around \(19, 19\).*direction of the interface"):
        solve(
            Problem(observed=pushed, confidence=held, stiffness=m, sliding=parts, loads=twist),
            backend="cpu",
        )


def test_parts_that_cannot_slide_are_refused_with_the_reason():
    rest, one = np.zeros((20, 20, 2)), np.ones((20, 20))
    labels = (np.arange(20) < 10) * np.ones((20, 1), int)
    parts = SlidingParts(labels)
    held = both(labels < 2)

    def problem(c=held, m=one, sliding=parts, **more):
        return Problem(observed=rest, confidence=c, stiffness=m, sliding=sliding, **more)

    with pytest.raises(ProblemError, match=r"shape \(10, 20\)"):
        problem(sliding=SlidingParts(labels[:10]))
    with pytest.raises(ProblemError, match="label 1, so that nothing slides"):
        problem(sliding=SlidingParts(np.ones((20, 20), int)))
    with pytest.raises(ProblemError, match="32 bits"):
        SlidingParts(labels.astype(np.int64) << 40)
    with pytest.raises(ProblemError, match="rows of different lengths"):
        SlidingParts([[1, 2], [3]])
    with pytest.raises(ProblemError, match=r"Pass SlidingParts\(labels\)"):
        problem(sliding=labels)
    with pytest.raises(ProblemError, match="is for ElasticPrior or NeoHookeanPrior"):
        solve(problem(), SeilerPrior(), backend="cpu")
    bone = np.where(labels == 1, np.inf, one)
    for given, prior, why in (
        (problem(m=bone), NeoHookeanPrior(), "rigid tissue in large motion"),
        (problem(), NeoHookeanPrior(penalty=1.0), "observations that may slip in large motion"),
        (problem(c=held / 2), NeoHookeanPrior(), "observations that may slip in large motion"),
    ):
        with pytest.raises(ProblemError, match=why):
            solve(given, prior, backend="cpu")
    with pytest.raises(ProblemError, match="energy of one displacement is not available"):
        ElasticPrior().energy(problem(), rest)


def test_observations_slip_beside_sliding_surfaces_as_if_they_were_forces():
    problem, prior = tissue_with_parts(1)
    dice = np.random.default_rng(0)
    limit = np.where(problem.known, dice.choice([0.02, 0.2, 1.0], problem.known.shape), 0)
    problem = variant_of(problem, confidence=limit.astype(np.float32))
    found = solve(problem, prior, backend="cpu")
    off = problem.observed - found.displacement
    slips = problem.known & (limit < 1) & (np.abs(off) > 1e-3 * problem.unit)
    assert 0.1 < slips[problem.known].mean() < 0.9
    # Each observation that slips pulls with its limit; the others are prescribed.
    pulls = prior.force_unit(problem) * np.where(slips, limit * np.sign(off), 0)
    held = problem.known & ~slips
    same = variant_of(
        problem,
        known=held,
        confidence=held.astype(np.float32),
        loads=Loads(force=pulls, spacing=problem.spacing),
    )
    exact = sliding_field(same, prior)
    np.testing.assert_allclose(found.displacement, exact, atol=2e-3 * problem.unit)
