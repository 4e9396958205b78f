"""Studies in which tissue slides along painted labels or strokes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    BoundaryRule,
    Drawing,
    Grid,
    Motion,
    ProblemError,
    Stroke,
    Study,
    Tissue,
    read_study,
    solve_study,
    write_study,
)
from napari_hmrf.study.ground import build_problem

PLACE = np.moveaxis(np.indices((60, 60)), 0, -1) - 29.6
AWAY = np.linalg.norm(PLACE, axis=-1)
NORMAL = PLACE / AWAY[..., None]
ALONG = np.stack([NORMAL[..., 1], -NORMAL[..., 0]], axis=-1)
DISC = (AWAY <= 24.5).astype(float)
RING = (np.abs(AWAY - 24) <= 2).astype(int)
EDGE = (DISC > 0) & (AWAY > 23)
ANGLES = np.linspace(0, 2 * np.pi, 60)
CIRCLE = tuple((29.6 + 24 * np.cos(a), 29.6 + 24 * np.sin(a)) for a in ANGLES)
SLIDE = Stroke("slide", (CIRCLE,), 2.0)
TURN = (Arrow((29, 45), (4, 0), 3), Arrow((29, 14), (-4, 0), 3))


def disc(*marks, rule=None, model="", stiffness=1.0):
    """Return a disc in void, whose rim has a rule, with a drawing."""
    motion = Motion(drawing=Drawing(marks))
    if rule is not None:
        motion = replace(motion, labels=RING, rules=(rule,))
    return Study(Grid(DISC.shape, 1.0), Tissue(stiffness=stiffness * DISC), motion, model)


def on_edge(study):
    """Return the displacement along the normal and along the surface at the edge of the disc."""
    field = solve_study(study, backend="cpu").displacement
    return (field * NORMAL).sum(axis=-1)[EDGE], (field * ALONG).sum(axis=-1)[EDGE]


def test_a_disc_turns_along_its_painted_wall_by_a_label_or_a_stroke():
    for study in (disc(*TURN, rule=BoundaryRule(1, "slide")), disc(SLIDE, *TURN)):
        normal, along = on_edge(study)
        assert along.min() > 5
        assert np.abs(normal).max() < 0.2


def test_a_surface_that_slides_is_shifted_outward_by_the_amount():
    middle = Stroke("pin", (((30, 30),),), 1.5)  # keeps the disc from turning
    for amount in (2.0, -2.0):
        for study in (
            disc(middle, rule=BoundaryRule(1, "slide", amount=amount)),
            disc(replace(SLIDE, amount=amount), middle),
        ):
            normal, _ = on_edge(study)
            assert np.abs(normal - amount).max() < 0.3  # less inside the edge, which is strained


def test_a_held_edge_may_slide_where_it_is_painted():
    study = disc(*TURN, rule=BoundaryRule(1, "slide"))
    held = replace(study, motion=replace(study.motion, hold_edge=True))
    assert on_edge(held)[1].min() > 5


def test_later_strokes_hold_or_release_a_surface_that_slides():
    for action in ("pin", "free"):
        later = replace(SLIDE, action=action)
        problem = build_problem(disc(SLIDE, *TURN, later)).problem
        assert problem.precision is None
    assert build_problem(disc(replace(SLIDE, action="pin"), SLIDE, *TURN)).problem.known.sum() < 200


def test_a_line_inside_tissue_slides_but_has_no_outside_to_be_shifted_to():
    line = Stroke("slide", (((30, 20), (30, 40)),), 1.0)
    hold = Stroke("pin", (((10, 30),),), 3)
    field = solve_study(disc(line, hold, Arrow((38, 30), (0, 3), 4))).displacement
    assert np.abs(field[30, 22:38, 0]).max() < 0.02
    assert field[30, 30, 1] > 1
    with pytest.raises(ProblemError, match="has no outside"):
        build_problem(disc(replace(line, amount=1.0), hold))


def test_a_note_says_that_a_surface_inside_tissue_keeps_its_place():
    ring = tuple((29.6 + 10 * np.cos(a), 29.6 + 10 * np.sin(a)) for a in ANGLES)
    pull, hold = Arrow((29.6, 29.6), (0, 3), 4), Stroke("pin", (CIRCLE,), 2.0)
    inside = solve_study(disc(Stroke("slide", (ring,), 1.0), hold, pull))
    (note,) = [note for note in inside.notes if "both sides of a sliding surface" in note]
    assert "keeps its place" in note
    assert "stiffness 0" in note
    assert np.linalg.norm(inside.displacement[29, 40]) < 0.1 < 2 < inside.displacement[29, 30, 1]
    assert not any("sliding" in note for note in solve_study(disc(SLIDE, *TURN)).notes)


def test_a_study_that_slides_is_saved_and_solved_again(tmp_path):
    study = disc(SLIDE, *TURN, rule=BoundaryRule(1, "slide", amount=0.5))
    write_study(tmp_path / "study.npz", study, solution := solve_study(study, backend="cpu"))
    again = read_study(tmp_path / "study.npz").study
    assert again.motion.rules == study.motion.rules
    assert again.motion.drawing == study.motion.drawing
    difference = solve_study(again, backend="cpu").displacement - solution.displacement
    assert np.abs(difference).max() < 1e-6


def test_nothing_moves_if_tissue_only_slides():
    with pytest.raises(ProblemError, match="nothing moves"):
        solve_study(disc(SLIDE))
