"""Studies in which labelled tissue slides along all other tissue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    ProblemError,
    Stroke,
    Study,
    Tissue,
    read_study,
    solve_study,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.errors import LayerError
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.io.tables import read_materials
from napari_hmrf.posterior.study_uncertainty import study_uncertainty
from napari_hmrf.study.engine import Engine
from napari_hmrf.study.ground import build_problem

SIZE, RADIUS, SLIP = 64, 20, 4.0
PLACE = np.moveaxis(np.indices((SIZE, SIZE)), 0, -1) - (SIZE - 1) / 2 - 0.15
AWAY = np.linalg.norm(PLACE, axis=-1)
TURN = np.stack([-PLACE[..., 1], PLACE[..., 0]], axis=-1) * SLIP / RADIUS
INSIDE, CORE = AWAY < RADIUS, AWAY < RADIUS / 3
MUSCLE, LUNG = Material(1, "muscle", 1.0), Material(2, "lung", 1.0, slides=True)
OUTER = Stroke("pin", (((0, 0), (0, 63), (63, 63), (63, 0), (0, 0)),), 1.0)


def chest(lung=LUNG, muscle=MUSCLE, labels=1 + INSIDE, core=CORE, **more):
    """Return a lung whose core turns in a muscle that is held at the edge of the image."""
    tissue = Tissue(labels=labels, materials=(muscle, lung))
    edge = np.ones_like(core)
    edge[1:-1, 1:-1] = False
    motion = Motion(
        observed=np.where(core[..., None], TURN, 0.0), confidence=(core | edge).astype(float)
    )
    return Study(Grid((SIZE, SIZE), 1.0), tissue, motion, **more)


def slip(field):
    """Return the smallest share of the exact slip and the largest gap around the lung."""
    shell = abs(AWAY - RADIUS) < 3
    fast = INSIDE & shell & (np.linalg.norm(TURN, axis=-1) > SLIP / 2)
    share = (field * TURN).sum(axis=-1)[fast] / (TURN**2).sum(axis=-1)[fast]
    exact = np.where(INSIDE[..., None], TURN, 0.0)
    normal = PLACE / AWAY[..., None]
    return share.min(), abs(((field - exact) * normal).sum(axis=-1)[shell]).max()


def test_a_lung_slides_along_the_chest_wall_and_leaves_no_gap():
    share, gap = slip(solve_study(chest(), backend="cpu").displacement)
    assert share >= 0.95
    assert gap <= 0.05
    share, _ = slip(solve_study(chest(replace(LUNG, slides=False)), backend="cpu").displacement)
    assert share < 0.5


def test_brush_strokes_change_the_parts_that_slide():
    study = chest(labels=np.ones((SIZE, SIZE), int))
    assert build_problem(study).problem.sliding is None
    dot = Stroke("tissue", (((31.65, 31.65),),), float(RADIUS), label=2)
    painted = replace(study, motion=replace(study.motion, drawing=Drawing((dot,))))
    share, _ = slip(solve_study(painted, backend="cpu").displacement)
    assert share >= 0.9


def test_a_study_file_restores_tissue_that_slides(tmp_path):
    study = chest()
    again = read_study(write_study(tmp_path / "lung", study)).study
    assert again.tissue.materials == (MUSCLE, LUNG)
    one, other = (solve_study(each, backend="cpu").displacement for each in (study, again))
    np.testing.assert_array_equal(one, other)


def test_a_drag_of_a_lung_is_solved_live_as_from_a_cold_start():
    def pulled(far):
        motion = Motion(drawing=Drawing((OUTER, Arrow((31, 31), (far, 0), 5))))
        return replace(chest(), motion=motion)

    answers = []
    engine = Engine(answers.append, "a drag")
    try:
        for far in (1.0, 2.0, 3.0):
            engine.submit(pulled(far), backend="cpu")
            assert engine.live.wait(60)
    finally:
        engine.close()
    assert [answer.error for answer in answers] == [None] * len(answers)
    cold = solve_study(pulled(3.0), backend="cpu").displacement
    assert abs(answers[-1].solution.displacement - cold).max() < 0.02


def test_uncertain_landmarks_turn_a_lung_in_a_rigid_chest_wall():
    places = [(31, 43), (43, 31), (31, 20), (20, 31)]
    marks = tuple(Landmark(at, tuple(at + TURN[at]), 1.0, sd=0.01) for at in places)
    motion = Motion(hold_edge=True, drawing=Drawing(marks))
    study = replace(chest(muscle=Material(1, "bone", np.inf)), motion=motion)
    field = solve_study(study, backend="cpu").displacement
    assert not field[~INSIDE].any()
    share, gap = slip(field)
    assert share >= 0.9
    assert gap <= 0.1


def test_an_uncertainty_of_sliding_tissue_is_refused_in_the_words_of_the_study():
    given = replace(chest(), names={"tissue": "Organs"})
    said = "'Organs' has tissue that slides.*an uncertainty is not available.*slides=False"
    with pytest.raises(LayerError, match=said):
        study_uncertainty(given, 2)


def test_a_lung_that_only_its_round_outline_holds_is_named():
    free = chest(core=np.zeros_like(CORE))
    motion = replace(free.motion, drawing=Drawing((Arrow((5, 31), (1, 0), 2),)))
    with pytest.raises(ProblemError, match=r"Organs.*held by the direction of the interface"):
        solve_study(replace(free, motion=motion, names={"tissue": "Organs"}), backend="cpu")


def test_the_shell_reads_tissue_that_slides_from_a_table(tmp_path, capsys):
    study, csv = chest(), tmp_path / "organs.csv"
    write_image(tmp_path / "labels.tif", ImageFile(study.tissue.labels.astype(np.uint8)))
    write_image(tmp_path / "core.tif", ImageFile(CORE.astype(np.uint8)))
    (tmp_path / "rules.csv").write_text("label,action,row,col\n1,move,0,2\n")
    csv.write_text("label,name,stiffness,slides\n1,muscle,1,no\n2,lung,1,yes\n")
    assert read_materials(csv) == (MUSCLE, LUNG)
    parts = {"labels": "labels.tif", "materials": csv.name, "boundary": "core.tif"}
    files = {**parts, "rules": "rules.csv", "out": "out"}
    options = [each for name, file in files.items() for each in (f"--{name}", str(tmp_path / file))]
    solve = ["solve", str(tmp_path / "labels.tif"), *options, "--hold-edge"]
    assert main(solve) == 0
    assert read_study(tmp_path / "out" / "labels.study").study.tissue.materials == (MUSCLE, LUNG)
    assert main([*solve, "--model", "paper", "--force"]) == 1
    assert "slides along other tissue ('lung')" in (message := capsys.readouterr().err)
    assert "(--model elastic)" in message
    csv.write_text("label,name,stiffness,slides\n1,muscle,1,maybe\n")
    assert main([*solve, "--force"]) == 1
    assert "slides must be True or False (in a table: yes or no)" in capsys.readouterr().err
