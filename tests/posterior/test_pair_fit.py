"""Tests of properties of tissue that are fitted to two images."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import (
    BoundaryRule,
    Cancelled,
    Cavity,
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    NeoHookeanPrior,
    Pictures,
    Problem,
    ProblemError,
    Study,
    Tissue,
    solve,
    solve_study,
)
from napari_hmrf.loads import growth
from napari_hmrf.posterior import fit, fit_study
from napari_hmrf.registration.study_registration import SecondPicture

SIZE = 72
LABELS = np.ones((SIZE, SIZE), int)
LABELS[20:38, 24:46], LABELS[46:62, 8:30] = 2, 3
GROWTH, STIFFNESS = 0.3, 4.0
NOISE = 2.0
IMAGE = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=LABELS.shape), 1.5)
IMAGE = 255 * (IMAGE - IMAGE.min()) / np.ptp(IMAGE)


def tissue(prior=None, stiffness=STIFFNESS):
    """Return tissue that is held at its edge and grows, its image, and its image after growth."""
    held = np.zeros((*LABELS.shape, 2))
    held[[0, -1]] = held[:, [0, -1]] = 1
    m = np.where(LABELS == 3, stiffness, 1.0)
    true = Problem(
        observed=0 * held, confidence=held, stiffness=m, loads=growth(GROWTH * (LABELS == 2))
    )
    after = solve(true, prior).warp(IMAGE).astype(float)
    # Another contrast and a bias.
    after = 255 * (np.clip(after, 0, None) / 255) ** 1.3 * np.linspace(0.8, 1.2, SIZE)
    rng = np.random.default_rng(1)
    pair = [each + rng.normal(0, NOISE, each.shape) for each in (IMAGE, after)]
    return Problem(observed=0 * held, confidence=held, stiffness=np.ones_like(m)), m, pair


def test_growth_and_stiffness_follow_from_two_images_of_another_brightness():
    guess, _, pair = tissue()
    found = fit(guess, LABELS, images=pair, growth=[2], stiffness=[3])
    assert found.growth[2].value == pytest.approx(GROWTH, rel=0.03)
    assert found.growth[2].sd < 0.01
    assert found.stiffness[3].value == pytest.approx(STIFFNESS, rel=0.3)
    assert found.similarity > 0.8
    still = fit(guess, LABELS, images=[pair[0], pair[0]], growth=[2])
    assert abs(still.growth[2].value) < 0.002


def test_growth_in_large_motion_follows_from_two_images():
    prior = NeoHookeanPrior()
    guess, m, pair = tissue(prior)
    known = replace(guess, stiffness=m)
    found = fit(known, LABELS, images=pair, growth=[2], prior=prior)
    assert found.growth[2].value == pytest.approx(GROWTH, rel=0.03)
    linear = fit(known, LABELS, images=pair, growth=[2])
    assert found.similarity > linear.similarity, "the model of the truth explains the images better"


def test_growth_of_a_ball_follows_from_two_volumes():
    shape = (20, 22, 24)
    image = ndimage.gaussian_filter(np.random.default_rng(2).normal(size=shape), 2)
    held = np.zeros((*shape, 3))
    held[[0, -1]] = held[:, [0, -1]] = held[:, :, [0, -1]] = 1
    distance = np.linalg.norm(np.indices(shape).T - np.array(shape) / 2, axis=-1).T
    labels = 1 + (distance < 6)
    guess = Problem(observed=0 * held, confidence=held, stiffness=np.ones(shape))
    true = replace(guess, loads=growth(0.4 * (labels == 2)))
    after = solve(true).warp(image)
    found = fit(guess, labels, images=(image, after), growth=[2])
    assert found.growth[2].value == pytest.approx(0.4, rel=0.1)


def test_pixels_that_are_unknown_do_not_count():
    guess, m, pair = tissue()
    known = replace(guess, stiffness=m)
    pair[1][44:64, 6:32] = np.nan
    pair[0][:5] = np.nan
    found = fit(known, LABELS, images=pair, growth=[2])
    assert found.growth[2].value == pytest.approx(GROWTH, rel=0.03)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"images": (IMAGE,)}, "are not two"),
        ({"images": (IMAGE, IMAGE[:40])}, r"shape \(40, 72\) \(after\)"),
        ({"images": (IMAGE, np.full(IMAGE.shape, np.nan))}, "no structure after the motion"),
        ({"measured": np.zeros((SIZE, SIZE, 2)), "sd": 1}, "Pass one of them only"),
        ({"growth": (), "stiffness": [2]}, "hardly depends on the stiffness of label 2"),
    ],
)
def test_what_cannot_be_compared_is_refused_with_the_reason(given, reason):
    guess, _, _ = tissue()
    with pytest.raises(ProblemError, match=reason):
        fit(guess, LABELS, **{"images": (IMAGE, IMAGE), "growth": [2], **given})


def test_a_fit_to_images_can_be_cancelled():
    guess, _, pair = tissue()
    cancel = threading.Event()
    with pytest.raises(Cancelled):
        fit(guess, LABELS, images=pair, growth=[2], progress=lambda _: cancel.set(), cancel=cancel)


def study_of(**motion):
    rows = (Material(1, "healthy", 3.0), Material(2, "tumour", 3.0), Material(3, "cyst", 3.0))
    return Study(
        Grid(LABELS.shape, (1, 1)),
        Tissue(labels=LABELS, materials=rows, unit="kPa"),
        Motion(**motion),
        pictures=Pictures(IMAGE),
    )


def test_a_study_gets_the_growth_and_the_stiffness_of_its_tissues():
    _, m, _ = tissue()
    study = study_of(hold_edge=True)
    rows = study.tissue.materials
    grown = (rows[0], replace(rows[1], growth=GROWTH), replace(rows[2], stiffness=3 * STIFFNESS))
    true = replace(study, tissue=replace(study.tissue, materials=grown))
    after = solve_study(true).warp(IMAGE)
    found = fit_study(
        study, SecondPicture(after, np.ones(m.shape, bool)), growth=[2], stiffness=[3]
    )
    healthy, tumour, cyst = found.study.tissue.materials
    assert healthy == rows[0]
    assert tumour.growth == pytest.approx(GROWTH, rel=0.03)
    assert cyst.stiffness == pytest.approx(3 * STIFFNESS, rel=0.3)
    growing, stiff = found.described()
    assert growing.startswith("growth of 'tumour': ")
    assert growing.endswith(" %")
    assert stiff.startswith("stiffness of 'cyst': ")
    assert stiff.endswith(" kPa")


def test_a_factor_on_the_forces_of_a_study_is_found_from_its_landmarks():
    rules = (BoundaryRule(1, "press", amount=0.1), BoundaryRule(2, "fixed"))
    edges = np.zeros(LABELS.shape, int)
    edges[0], edges[-1] = 1, 2
    study = study_of(labels=edges, rules=rules, cavity=Cavity(pressure=0.2))
    pressed = (replace(rules[0], amount=0.3), rules[1])
    moved = solve_study(replace(study, motion=replace(study.motion, rules=pressed)))
    places = [(10, 20), (20, 50), (30, 35), (5, 60)]
    marks = [Landmark(p, tuple(p + moved.displacement[p]), radius=1, sd=0.05) for p in places]
    drawn = replace(study, motion=replace(study.motion, drawing=Drawing(tuple(marks))))
    found = fit_study(drawn, load=True)
    assert found.study.motion.rules[0].amount == pytest.approx(0.3, rel=0.05)
    assert found.study.motion.cavity.pressure == pytest.approx(0.6, rel=0.05), "all forces scale"
    assert found.described()[0].startswith("factor on the forces: ")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tissue": Tissue()}, "has no labels"),
        ({"motion": Motion(hold_edge=True)}, "second image: is missing"),
        ({"model": "paper, converged"}, "model: is 'paper, converged'"),
    ],
)
def test_a_study_that_cannot_be_fitted_is_refused(change, reason):
    study = study_of(hold_edge=True)
    model = change.pop("model", None)
    study = replace(study, **change) if model is None else replace(study, model=model)
    with pytest.raises(ProblemError, match=reason):
        fit_study(study, growth=[2])
