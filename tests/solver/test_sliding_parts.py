"""Parts of the tissue that slide along each other."""

from __future__ import annotations

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem, ProblemError, SeilerPrior, solve
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.loads import Loads, weight
from napari_hmrf.solver.coupling import Coupling
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
    "number", [0, 1, 2, *(pytest.param(number, marks=pytest.mark.campaign) for number in (3, 5))]
)
def test_sliding_parts_give_the_field_of_least_energy(number):
    problem, prior = tissue_with_parts(number, is_loaded=True, has_hole=True)
    solution = solve(problem, prior, backend="cpu")
    off = abs(solution.displacement - sliding_field(problem, prior)) / problem.unit
    assert off[sites_of_elements(problem.tissue)].max() <= 1e-3
    assert solution.convergence.error <= 1e-3
    again = solve(problem, prior, backend="cpu", initial=solution)
    assert len(again.energy) <= 2  # at most one cycle is left to do


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
    with pytest.raises(ProblemError, match="rigid"):
        problem(m=np.where(labels, 1.0, np.inf))
    with pytest.raises(ProblemError, match=r"Pass SlidingParts\(labels\)"):
        problem(sliding=labels)
    for prior in (SeilerPrior(), NeoHookeanPrior()):
        with pytest.raises(ProblemError, match="is for ElasticPrior"):
            solve(problem(), prior, backend="cpu")
    with pytest.raises(ProblemError, match="confidence between 0 and 1"):
        solve(problem(0.5 * held), backend="cpu")
    marks = Landmarks([[5.0, 5.0]], [[6.0, 5.0]], sd=1.0)
    with pytest.raises(ProblemError, match="landmarks that have a standard deviation"):
        solve(problem(landmarks=marks), backend="cpu")
    with pytest.raises(ProblemError, match="energy of one displacement is not available"):
        ElasticPrior().energy(problem(), rest)
