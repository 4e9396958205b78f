"""Tissue sites in no element or clique follow the tissue beside them."""

import numpy as np
import pytest
import scipy
from scipy import ndimage

from napari_hmrf import (
    ICM,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)
from napari_hmrf.field.followers import find_followers, followers_of
from napari_hmrf.field.neighbours import around_sites, in_elements, sites_of_elements
from napari_hmrf.landmarks import StrainScale
from napari_hmrf.loads import Loads, reactions
from napari_hmrf.posterior import sample_posterior
from napari_hmrf.tissue import SlidingParts
from tests.support.opengl import require_opengl

TIGHT = Multigrid(1e-5)


def ball(radius, axes):
    from_middle = np.indices((2 * radius + 5,) * axes) - radius - 2
    return np.hypot.reduce(from_middle) <= radius


def ragged(axes):
    """Return a block with pixels at random around it, and lines one pixel wide."""
    size = {2: 18, 3: 10}[axes]
    rng = np.random.default_rng(3)
    mask = rng.random((size,) * axes) < 0.4
    mask[(slice(3, -3),) * axes] = True
    middle = (size // 2,) * axes
    pieces, _ = scipy.ndimage.label(in_elements(mask))
    apart = around_sites((pieces > 0) & (pieces != pieces[middle]), np.logical_or)
    mask &= ~apart | around_sites(pieces == pieces[middle], np.logical_or)
    joined, _ = scipy.ndimage.label(mask, np.ones((3,) * axes))
    return joined == joined[middle]


def spurred(axes):
    """Return a disc or ball with spurs along an axis and along a diagonal."""
    mask = np.pad(ball({2: 6, 3: 4}[axes], axes), 5)
    middle = len(mask) // 2
    mask[(*(middle,) * (axes - 1), slice(middle, None))] = True
    for step in range(middle):
        mask[(middle + step,) * axes] = True
    return mask


SHAPES = {"ball": lambda axes: ball({2: 8, 3: 4}[axes], axes), "ragged": ragged, "spur": spurred}


def moved_as_one(mask, turn, shift, *, linear):
    """Return a rigid motion about the middle: small, or finite."""
    axes = mask.ndim
    away = np.moveaxis(np.indices(mask.shape), 0, -1) - (np.array(mask.shape) - 1) / 2
    spin = np.zeros((axes, axes))
    spin[0, 1], spin[1, 0] = -turn, turn
    if not linear:
        spin[:2, :2] = [[np.cos(turn) - 1, -np.sin(turn)], [np.sin(turn), np.cos(turn) - 1]]
    return away @ spin.T + shift


def in_motion(mask, motion, marked):
    """Return a problem in which marked tissue has a motion, and the other tissue is free."""
    confidence = np.repeat((mask & marked)[..., None], mask.ndim, axis=-1) * 1.0
    return Problem(observed=motion, confidence=confidence, stiffness=mask * 1.0)


def middle_of(mask):
    marked = np.zeros_like(mask)
    marked[tuple(slice(size // 2 - 1, size // 2 + 2) for size in mask.shape)] = True
    return marked


def rim_of(mask):
    """Return the sites of elements that are not the middle of all lines of three sites."""
    whole = sites_of_elements(mask)
    inner = whole.copy()
    for axis in range(mask.ndim):
        for step in (-1, 1):
            inner &= np.roll(whole, step, axis)
    edge = np.pad(np.zeros(tuple(size - 2 for size in mask.shape), bool), 1, constant_values=True)
    return whole & (~inner | edge)


MODELS = {
    "elastic": (ElasticPrior(), TIGHT, "cpu", middle_of),
    "shaders": (ElasticPrior(), TIGHT, "opengl", middle_of),
    "large": (NeoHookeanPrior(), TIGHT, "cpu", middle_of),
    "paper": (SeilerPrior(), ICM(200, steps=None), "cpu", rim_of),
    "paper, converged": (SeilerPrior(), TIGHT, "cpu", rim_of),
    "paper, blanket": (SeilerPrior(conditional="blanket"), TIGHT, "cpu", middle_of),
}


def solved(mask, name, motion):
    prior, optimizer, backend, marked = MODELS[name]
    if backend == "opengl":
        require_opengl("compute" if mask.ndim == 3 else None)
    problem = in_motion(mask, motion, marked(mask))
    return solve(problem, prior, optimizer=optimizer, backend=backend)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("axes", [2, 3])
def test_tissue_in_no_element_moves_rigidly_with_its_tissue(axes, shape, name):
    if axes == 3 and name == "paper, blanket":
        pytest.skip("for images")
    if (shape, name) == ("ragged", "paper, blanket"):
        pytest.skip("lines that touch the tissue at a corner only are free to bend")
    mask = SHAPES[shape](axes)
    motion = moved_as_one(mask, 0.2, np.array([0.5, 3, -2])[:axes], linear=name != "large")
    solution = solved(mask, name, motion)
    assert followers_of(mask) is not None
    off = np.linalg.norm(solution.displacement - motion, axis=-1)
    assert off[mask].max() < 1e-3
    assert np.nanmin(solution.jacobian()) > 0.999
    assert solution.count_folds() == 0
    if name == "large":
        assert np.nanmax(np.abs(solution.strain())) < 1e-3


@pytest.mark.parametrize("axes", [2, 3])
def test_an_image_of_shifted_tissue_has_no_ghost_pixel(axes):
    mask = np.pad(spurred(axes), 3)
    shift = np.array([0, 2, -1])[:axes]
    motion = np.broadcast_to(shift * 1.0, (*mask.shape, axes))
    solution = solved(mask, "elastic", motion)
    image = np.where(mask, np.random.default_rng(0).uniform(1, 2, mask.shape), 0)
    expected = np.roll(image, shift, np.arange(axes))
    np.testing.assert_allclose(solution.warp(image), expected, atol=1e-3)


@pytest.mark.parametrize("axes", [2, 3])
def test_uniform_strain_is_uniform_at_ragged_edges(axes):
    mask = ragged(axes)
    away = np.moveaxis(np.indices(mask.shape), 0, -1)
    motion = away @ (np.diag([0.1, -0.02, 0.05][:axes]) + 0.03)
    whole = sites_of_elements(mask)
    solution = solve(in_motion(mask, motion, whole), optimizer=TIGHT, backend="cpu")
    np.testing.assert_allclose(solution.displacement[mask], motion[mask], atol=1e-3)
    strain = np.diag([0.1, -0.02, 0.05][:axes]) + 0.03
    assert np.abs(solution.strain("small")[mask] - strain).max() < 1e-3


def block_with_spur(length=4):
    """Return a block with a spur in row 4, from column 9, and the index of its tip."""
    mask = np.zeros((9, 16), bool)
    mask[1:8, 1:9] = True
    mask[4, 9 : 9 + length] = True
    return mask, (4, 8 + length)


def held_at_left(mask, **more):
    confidence = np.zeros((*mask.shape, mask.ndim))
    confidence[:, 1] = 1
    return Problem(
        observed=np.zeros_like(confidence), confidence=confidence, stiffness=mask * 1.0, **more
    )


def test_the_component_across_a_thin_arm_of_the_paper_stays_within_the_range_of_its_tissue():
    slab, arm = np.zeros((2, 14, 24), bool)
    slab[1:13, 1:11] = arm[6:8, 11:21] = True
    problem = Problem(
        stiffness=slab | arm,
        observed=np.where(slab[..., None], [1.0, 0.0], 0),
        confidence=np.repeat(slab[..., None], 2, axis=-1).astype(float),
    )
    across = solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement[arm, 0]
    assert across.min() > -1e-3
    assert across.max() < 1 + 1e-3
    assert across.reshape(2, -1)[:, 2:].min() > 0.5  # not the mean with the sites at rest


def disc_with_spikes():
    rows, cols = np.indices((23, 23)) - 11
    disc = rows**2 + cols**2 <= 64
    spikes = (np.minimum(abs(rows), abs(cols)) == 0) & (abs(rows) + abs(cols) <= 11)
    return disc, disc | spikes


def test_tips_of_the_centred_reading_stay_within_the_range_of_the_observations():
    disc, tissue = disc_with_spikes()
    inside = ndimage.binary_erosion(disc)
    confidence = np.repeat(inside[..., None], 2, axis=-1).astype(float)
    problem = Problem(observed=4 * confidence, confidence=confidence, stiffness=tissue * 1.0)
    found = solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement[tissue]
    assert found.min() > -1e-3
    assert found.max() < 4 + 1e-3


@pytest.mark.parametrize("optimizer", [TIGHT, ICM(500, steps=None)])
def test_pixels_of_a_line_follow_the_nearest_observed_pixel(optimizer):
    tissue = np.zeros((6, 14))
    tissue[:, :4] = tissue[2, 4:] = 1
    observed, confidence = np.zeros((2, 6, 14, 2))
    confidence[:, 0] = confidence[:, 3] = confidence[2, 4:12] = 1
    observed[2, 4:12] = np.arange(1, 9)[:, None] * (0.5, -1)
    confidence[2, [6, 7, 9]] = 0
    problem = Problem(observed=observed * confidence, confidence=confidence, stiffness=tissue)
    found = solve(problem, SeilerPrior(), optimizer=optimizer, backend="cpu").displacement
    near = [4, 5, 5, 8, 8, 10, 11, 11, 11]
    for at, source in zip([4, 5, 6, 7, 8, 10, 11, 12, 13], near, strict=True):
        np.testing.assert_allclose(found[2, at], observed[2, source], atol=1e-3)
    np.testing.assert_allclose(found[2, 9], observed[2, [8, 10]].mean(axis=0), atol=1e-3)


def test_a_line_pixel_observed_in_one_component_follows_in_the_other():
    letters = [".HrrH", ".cooc", "oHooc", "..ooc", ".c.HH"]
    seen = {"H": (1, 1), "r": (1, 0), "c": (0, 1)}
    tissue = np.array([[letter != "." for letter in row] for row in letters])
    confidence = np.array([[seen.get(letter, (0, 0)) for letter in row] for row in letters]) * 1.0
    observed = confidence * (3, 2)
    problem = Problem(observed=observed, confidence=confidence, stiffness=tissue * 1.0)
    found = solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement
    np.testing.assert_allclose(found[tissue], np.tile([3.0, 2.0], (tissue.sum(), 1)), atol=2e-2)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_volume_of_one_slice_moves_as_an_image(axis):
    tissue = np.ones((12, 12))
    tissue[0, :4] = tissue[6, 6] = tissue[8:, :4] = 0
    tissue[10, 1:4] = 1  # a spur
    confidence, observed = np.zeros((2, 12, 12, 2))
    confidence[-1] = confidence[:, -1] = confidence[4:6, 3:5] = confidence[10, 2] = 1
    observed[4:6, 3:5] = observed[10, 2] = 1, -0.5

    def moved(m, **given):
        return solve(Problem(stiffness=m, **given), SeilerPrior(), optimizer=TIGHT, backend="cpu")

    image = moved(tissue, observed=observed, confidence=confidence).displacement
    deep = {
        name: np.expand_dims(np.insert(values, axis, 0, axis=-1), axis)
        for name, values in {"observed": observed, "confidence": confidence}.items()
    }
    volume = moved(np.expand_dims(tissue, axis), **deep).displacement
    flat = np.delete(volume.squeeze(axis), axis, axis=-1)
    np.testing.assert_allclose(flat, image, atol=2e-5)


@pytest.mark.parametrize("void", [((0, 1), (0, 0)), ((1, 0), (0, 2)), ((2, 2), (1, 1))])
@pytest.mark.parametrize("shape", [(1, 8), (8, 1), (2, 4)])
def test_void_around_tissue_does_not_change_its_motion(shape, void):
    rng = np.random.default_rng(0)
    observed, confidence = rng.normal(size=(*shape, 2)), np.zeros((*shape, 2))
    confidence.reshape(8, 2)[[0, 2, 7]] = 1

    def moved(*border):
        y, c = (np.pad(each, (*border, (0, 0))) for each in (observed, confidence))
        problem = Problem(stiffness=np.pad(np.ones(shape), border), observed=y, confidence=c)
        return solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement

    inside = tuple(
        slice(before, before + size) for (before, _), size in zip(void, shape, strict=True)
    )
    np.testing.assert_allclose(moved(*void)[inside], moved((0, 0), (0, 0)), atol=2e-5)


def test_the_strains_of_a_row_are_those_of_a_bar():
    stiffness = np.ones((1, 16))
    stiffness[:, 8:] = 5
    confidence, observed = np.zeros((2, 1, 16, 2))
    confidence[:, [0, -1]] = 1
    observed[:, -1, 1] = 1
    problem = Problem(observed=observed, confidence=confidence, stiffness=stiffness)
    found = solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement[0, :, 1]
    soft, stiff = np.diff(found)[[3, -4]]
    assert soft / stiff == pytest.approx(40 / 7, rel=1e-3)  # 5.71: see docs/method.md


def test_a_pixel_between_doubtful_observations_in_no_clique_follows_them():
    tissue = np.zeros((6, 4))
    tissue[:2, 1:3] = tissue[2:4, 2] = 1
    confidence = np.repeat(tissue[..., None], 2, axis=-1) * 0.3
    confidence[2, 2] = 0
    problem = Problem(observed=(confidence > 0) * 2.0, confidence=confidence, stiffness=tissue)
    found = solve(problem, SeilerPrior(), optimizer=TIGHT, backend="cpu").displacement
    np.testing.assert_allclose(found[2, 2], 2, atol=1e-4)


@pytest.mark.parametrize("conditional", ["centred", "blanket"])
def test_a_spur_follows_observed_tissue_two_pixels_wide(conditional):
    tissue = np.zeros((5, 6))
    tissue[1:4, 3:5] = tissue[2, 2] = 1
    confidence = np.zeros((5, 6, 2))
    confidence[1:4, 3:5] = 1
    problem = Problem(observed=confidence, confidence=confidence, stiffness=tissue)
    prior = SeilerPrior(conditional=conditional)
    found = solve(problem, prior, optimizer=TIGHT, backend="cpu").displacement
    np.testing.assert_allclose(found[2, 2], 1, atol=1e-4)


@pytest.mark.parametrize("optimizer", [TIGHT, ICM(500, steps=None)])
@pytest.mark.parametrize("conditional", ["centred", "blanket"])
@pytest.mark.parametrize("tip", [slice(5, 7), slice(5, 6)])
def test_the_energy_of_a_solution_is_that_of_its_field(tip, conditional, optimizer):
    tissue = np.zeros((12, 16))
    tissue[:, :9] = tissue[tip, 9:] = 1
    observed, confidence = np.zeros((2, 12, 16, 2))
    confidence[:, 0] = 1
    observed[tip, -1], confidence[tip, -1] = 3, 0.5
    problem = Problem(observed=observed, confidence=confidence, stiffness=tissue)
    prior = SeilerPrior(penalty=20, conditional=conditional)
    solution = solve(problem, prior, optimizer=optimizer, backend="cpu")
    expected = prior.mean_energy(problem, solution.displacement)
    assert solution.mean_energy == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_the_tip_of_a_spur_carries_its_force_and_moment_to_the_tissue():
    mask, tip = block_with_spur()
    force = np.zeros((*mask.shape, 2))
    force[tip] = 0.1, 0
    problem = held_at_left(mask, loads=Loads(force=force))
    solution = solve(problem, optimizer=TIGHT, backend="cpu")
    reaction = reactions(problem, solution)
    np.testing.assert_allclose(reaction.sum(axis=(0, 1)), (-0.1, 0), atol=1e-4)
    rows, cols = np.indices(mask.shape)
    torque = (cols * reaction[..., 0] - rows * reaction[..., 1]).sum()
    assert torque == pytest.approx(-0.1 * tip[1], rel=1e-3)
    shorter = solution.displacement[4, 8, 0]
    assert solution.displacement[tip][0] > 1.5 * shorter > 0


@pytest.mark.parametrize("prior", [ElasticPrior(), NeoHookeanPrior(), ElasticPrior(penalty=1e6)])
def test_a_spur_that_is_pulled_pulls_the_tissue_at_its_root(prior):
    mask, tip = block_with_spur()
    observed, confidence = np.zeros((2, *mask.shape, 2))
    confidence[:, 1] = confidence[tip] = 1
    observed[tip] = 0, 0.5
    problem = Problem(observed=observed, confidence=confidence, stiffness=mask * 1.0)
    solution = solve(problem, prior, optimizer=TIGHT, backend="cpu")
    np.testing.assert_allclose(solution.displacement[4, 8], (0, 0.5), atol=1e-5)
    np.testing.assert_allclose(solution.displacement[tip], (0, 0.5), atol=1e-5)
    assert any("1 observed pixel is in no 2 x 2 block" in note for note in solution.notes)
    if prior != NeoHookeanPrior():
        reaction = reactions(problem, solution)
        np.testing.assert_allclose(reaction.sum(axis=(0, 1)), 0, atol=1e-4)
        assert reaction[tip][1] > 0.01


def test_a_mark_that_ends_on_a_tip_is_the_mark_of_the_tissue_beside_it():
    mask = ball(8, 2)
    rim = mask & ~np.all([np.roll(mask, step, axis) for step in (1, -1) for axis in (0, 1)], axis=0)
    confidence = np.repeat(rim[..., None], 2, axis=-1) * 1.0
    observed = np.broadcast_to(np.linspace(0, 1, len(mask))[:, None, None], confidence.shape)
    solution = solve(
        Problem(observed=observed, confidence=confidence, stiffness=mask * 1.0), backend="cpu"
    )
    np.testing.assert_allclose(solution.displacement[rim], observed[rim], atol=1e-6)
    assert solution.notes == ()
    slips = Problem(observed=observed, confidence=0.7 * confidence, stiffness=mask * 1.0)
    large = solve(slips, NeoHookeanPrior(penalty=100.0), backend="cpu")
    assert large.reach.where is None, "the target of a tip counts as missed"


def test_a_precision_at_a_spur_acts_on_the_tissue_at_its_root():
    mask, tip = block_with_spur()
    precision = np.zeros(mask.shape)
    precision[tip] = 0.5
    observed = np.broadcast_to((0.0, 0.5), (*mask.shape, 2)) * mask[..., None]
    confidence = np.zeros_like(observed)
    confidence[:, 1] = 1
    observed[:, 1] = 0
    problem = Problem(
        observed=observed, confidence=confidence, stiffness=mask * 1.0, precision=precision
    )
    at_root = np.zeros(mask.shape)
    at_root[4, 8] = 0.5
    same = Problem(
        observed=observed, confidence=confidence, stiffness=mask * 1.0, precision=at_root
    )
    solution, other = (solve(each, optimizer=TIGHT, backend="cpu") for each in (problem, same))
    np.testing.assert_allclose(solution.displacement, other.displacement, atol=1e-5)
    assert 0.05 < solution.displacement[tip][1] < 0.5
    assert solution.notes
    assert not other.notes


def test_a_bridge_one_pixel_wide_is_named_with_its_length():
    mask = np.zeros((8, 18), bool)
    mask[1:7, 1:6] = mask[1:7, 11:16] = True
    mask[3, 6:11] = True
    confidence = np.repeat(mask[..., None], 2, axis=-1) * 1.0
    confidence[3] = 0
    observed = np.zeros_like(confidence)
    observed[:, 11:, 1] = 4
    solution = solve(
        Problem(observed=observed, confidence=confidence, stiffness=mask * 1.0), backend="cpu"
    )
    assert any("joins pieces" in note and "5 pixels" in note for note in solution.notes)
    np.testing.assert_allclose(solution.displacement[3, 6:11, 1], [0, 0, 2, 4, 4], atol=1e-3)


def test_a_line_beside_tissue_that_it_does_not_touch_stays_at_rest():
    mask, _ = block_with_spur(0)
    mask[1:8, 12] = True
    solution = solve(in_motion(mask, np.ones((*mask.shape, 2)), mask & (np.arange(16) < 9)))
    assert not solution.displacement[1:8, 12].any()
    force = np.zeros((*mask.shape, 2))
    force[4, 12] = 1
    with pytest.raises(ProblemError) as refusal:
        held_at_left(mask, loads=Loads(force=force))
    assert refusal.value.field == "force"


def test_a_rigid_spur_moves_as_one_with_its_bone():
    mask, tip = block_with_spur()
    stiffness = mask * 1.0
    stiffness[3:6, 6:9] = stiffness[4, 9:] = np.inf
    stiffness[~mask] = 0
    force = np.zeros((*mask.shape, 2))
    force[2, 7] = 0.3, 0.1
    confidence = np.zeros_like(force)
    confidence[:, 1] = 1
    problem = Problem(
        observed=np.zeros_like(force),
        confidence=confidence,
        stiffness=stiffness,
        loads=Loads(force=force),
    )
    moved = solve(problem, optimizer=TIGHT, backend="cpu").displacement
    turn = moved[4, 8] - moved[4, 7]
    np.testing.assert_allclose(moved[tip], moved[4, 8] + 4 * turn, atol=1e-4)


def test_spurs_follow_their_own_sliding_part():
    mask = np.zeros((12, 12), bool)
    mask[1:11, 1:11] = True
    labels = np.where(np.arange(12)[:, None] < 6, 1, 2) * np.ones((12, 12), int)
    mask[5:7, 11] = True  # one pixel of each part
    confidence = np.zeros((12, 12, 2))
    confidence[1] = confidence[10] = 1
    observed = np.zeros_like(confidence)
    observed[10, :, 1] = 1.5
    problem = Problem(
        observed=observed, confidence=confidence, stiffness=mask * 1.0, sliding=SlidingParts(labels)
    )
    solution = solve(problem, optimizer=TIGHT, backend="cpu")
    np.testing.assert_allclose(solution.displacement[5, 11], (0, 0), atol=1e-3)
    np.testing.assert_allclose(solution.displacement[6, 11], (0, 1.5), atol=1e-3)
    assert np.nanmin(solution.jacobian()) > 0.999


def test_samples_of_the_posterior_move_spurs_with_their_tissue():
    mask, tip = block_with_spur()
    precision = np.zeros(mask.shape)
    precision[tip] = precision[4, 4] = 1.0
    problem = held_at_left(mask, precision=precision)
    found = followers_of(mask)
    for sample in sample_posterior(problem, n=3, scale=StrainScale(0.1)):
        own = found.displacement(sample)
        np.testing.assert_allclose(sample.reshape(-1, 2)[found.sites], own, atol=1e-4)


def test_tissue_that_does_not_change_is_searched_once(monkeypatch):
    searches = []

    def find(*given, **more):
        searches.append(given)
        return find_followers(*given, **more)

    monkeypatch.setattr("napari_hmrf.field.followers.find_followers", find)
    mask = ball(7, 2)
    for shift in (1.0, 2.0):
        motion = np.full((*mask.shape, 2), shift)
        solution = solve(in_motion(mask, motion, middle_of(mask)), backend="cpu")
        assert np.nanmin(solution.jacobian()) > 0.999
    assert len(searches) == 1


def test_a_mask_that_changes_in_place_is_searched_again():
    mask = ball(7, 2)
    assert len(followers_of(mask).sites) == 4
    mask[2:4, 7:12] = True
    assert len(followers_of(mask).sites) == 3
