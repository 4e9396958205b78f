"""Studies with growth, pressure, traction and weight: tables, fields and files."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    BoundaryRule,
    Drawing,
    ElasticPrior,
    FileFormatError,
    Grid,
    Material,
    Motion,
    NeoHookeanPrior,
    Pictures,
    Problem,
    ProblemError,
    Stroke,
    Study,
    Tissue,
    read_study,
    replay,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.data import phantom
from napari_hmrf.io.tables import read_materials, read_preset, read_rules, write_preset
from napari_hmrf.loads import Loads, growth, pressure, traction, weight
from napari_hmrf.results.held_forces import held_forces
from napari_hmrf.solver.caveats import shortfall
from napari_hmrf.study.ground import Ground, build_problem
from napari_hmrf.tissue.material_presets import Preset

SHAPE, SPACING = (24, 30), (0.5, 0.8)
BRAIN = Material(1, "brain", 2.0)
TUMOUR = Material(2, "tumour", 6.0, growth=0.2)
ROWS, COLS = np.indices(SHAPE)
DISC = np.hypot(ROWS - 12, COLS - 15) < 5
LABELS = np.where(DISC, 2, 1)
PULL = BoundaryRule(2, "pull", vector=(0.0, 0.1))


def study(*materials, labels=LABELS, model="elastic", **motion):
    tissue = Tissue(labels=labels, materials=materials or (BRAIN, TUMOUR), unit="kPa")
    motion = {"hold_edge": True, **motion}
    return Study(Grid(SHAPE, SPACING, "mm"), tissue, Motion(**motion), model=model)


def with_loads(problem, loads):
    """Return the problem with its loads replaced."""
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
        loads=loads,
    )


@pytest.mark.parametrize("model", ["elastic", "large motion"])
def test_a_tumour_grows_by_the_amount_in_its_table_row(model):
    grown = study(model=model)
    prior = (ElasticPrior if model == "elastic" else NeoHookeanPrior)(0.45)
    known = solve(with_loads(build_problem(grown).problem, growth(0.2 * DISC)), prior)
    solution = solve_study(grown)
    np.testing.assert_array_equal(solution.displacement, known.displacement)
    assert solution.provenance.model == model
    out = solution.displacement[12, 20, 1]
    assert 0.3 < out < 0.2 * 5 * 0.8  # less than without surrounding tissue


def test_muscle_shortens_along_its_fibres_only():
    muscle = replace(TUMOUR, growth=(0.0, -0.2))
    moved = solve_study(study(BRAIN, muscle)).displacement
    assert moved[12, 19, 1] < -0.2
    assert abs(moved[16, 15, 0]) < 0.1 * abs(moved[12, 19, 1])


def test_tissue_painted_with_a_brush_grows():
    from napari_hmrf import Drawing, Stroke

    patch = Stroke("tissue", (((12.0, 15.0),),), radius=2.0, label=2)
    nothing_there = study(labels=np.ones(SHAPE, int), drawing=Drawing((patch,)))
    moved = solve_study(nothing_there).displacement
    assert moved[12, 18, 1] > 0.05
    assert moved[12, 12, 1] < -0.05


def test_the_loads_of_a_study_match_pressure_traction_and_weight():
    paint = np.zeros(SHAPE, int)
    paint[-1], paint[0, 5:12], paint[0, 18:25] = 1, 2, 3
    rules = (
        BoundaryRule(1, "fixed"),
        BoundaryRule(2, "press", amount=0.3),
        BoundaryRule(3, "pull", vector=(0.0, 0.2)),
    )
    motion = Motion(labels=paint, rules=rules, weight=(0.01, 0.0))
    tissue = Tissue(labels=np.ones(SHAPE, int), materials=(BRAIN,), unit="kPa")
    stated = build_problem(Study(Grid(SHAPE, SPACING, "mm"), tissue, motion))
    m, loads = np.full(SHAPE, 2.0), stated.problem.loads
    known = (
        pressure(m, paint == 2, 0.3, spacing=SPACING)
        + traction(m, paint == 3, (0.0, 0.2), spacing=SPACING)
        + weight(m, (0.01, 0.0), spacing=SPACING)
    )
    np.testing.assert_allclose(loads.force, known.force, atol=1e-7)
    # Tissue is free where a force acts.
    assert stated.problem.known[-1].all()
    assert not stated.problem.known[0].any()


@pytest.mark.parametrize("unit", ["kPa", ""])
def test_a_note_warns_of_forces_without_a_unit_of_stiffness(unit):
    tissue = Tissue(labels=np.ones(SHAPE, int), materials=(BRAIN,), unit=unit)
    motion = Motion(hold_edge=True, weight=(0.01, 0.0))
    ground = Ground.of(Study(Grid(SHAPE, SPACING, "mm"), tissue, motion))
    said = " ".join(ground.notes_on(ground.statement()))
    assert ("unit of stiffness" in said) == (not unit)


@pytest.mark.parametrize("model", ["paper", "paper, converged"])
@pytest.mark.parametrize(
    ("growth", "motion", "said"),
    [
        (0.2, Motion(True, weight=(0.01, 0.0)), "'brain.tif' has growth,"),
        (0.0, Motion(True, LABELS, (BoundaryRule(1, "fixed"), PULL)), "'paint' has forces,"),
        (0.0, Motion(True, weight=(0.01, 0.0)), "'weight' is a force,"),
    ],
)
def test_the_paper_model_refuses_loads_and_names_the_part_that_has_them(
    model, growth, motion, said
):
    given = study(BRAIN, replace(TUMOUR, growth=growth), model=model)
    names = {"image": "brain.tif", "boundary": "paint"}
    with pytest.raises(ProblemError, match=rf"{said}.*elastic model"):
        solve_study(replace(given, motion=motion, names=names))


def test_a_volume_sinks_under_its_weight_in_large_motion():
    block = Study(
        Grid((4, 5, 6), (1.0, 1.0, 1.0)), motion=Motion(hold_edge=True, weight=(0.1, 0, 0))
    )
    large = solve_study(replace(block, prior=NeoHookeanPrior())).displacement
    small = solve_study(block).displacement
    np.testing.assert_allclose(large, small, atol=0.05 * np.abs(small).max())


def test_the_dark_surroundings_of_an_image_have_no_weight_unless_tissue_is_painted_there():
    away = np.hypot(*(np.indices((60, 60)) - 29.5))
    head, core = away < 20, away < 4
    held = {"observed": np.zeros((60, 60, 2)), "confidence": core.astype(float)}
    grid, image = Grid((60, 60), 1.0), Pictures(np.where(head, 200, 0).astype(np.uint8))
    motion = Motion(**held, weight=(0.002, 0.0))
    scanned = Study(grid, motion=motion, pictures=image)
    force = build_problem(scanned).problem.loads.force[..., 0]
    assert force.sum() == pytest.approx(0.002 * head.sum(), rel=0.05)
    assert (force[away > 22] == 0).all()
    bare = Study(grid, Tissue(stiffness=head.astype(float)), motion)
    alone, moved = (solve_study(each).displacement for each in (bare, scanned))
    assert abs(moved - alone)[head].max() < 0.2 * alone[..., 0].max()
    dot = Stroke("tissue", (((5.0, 5.0),),), 3.0, label=1)
    painted = replace(scanned, motion=replace(motion, drawing=Drawing((dot,))))
    assert build_problem(painted).problem.loads.force[5, 5, 0] > 0


def test_a_growth_with_another_number_of_axes_is_rejected_and_its_row_named():
    with pytest.raises(ProblemError, match=r"label 2 \(tumour\).*growth.* Use 2 numbers"):
        solve_study(study(BRAIN, replace(TUMOUR, growth=(0.1, 0.1, 0.1))))


def test_a_force_away_from_a_surface_is_rejected_and_its_boundary_named():
    paint = np.zeros(SHAPE, int)
    paint[10:12, 10:12] = 1
    inside = study(labels=np.ones(SHAPE, int), hold_edge=True)
    motion = Motion(True, paint, (BoundaryRule(1, "press", amount=0.1),))
    with pytest.raises(ProblemError, match=r"'Skin'.*surface"):
        solve_study(replace(inside, motion=motion, names={"boundary": "Skin"}))


def test_a_weight_with_the_wrong_number_of_components_is_rejected():
    with pytest.raises(ProblemError, match="weight with 3"):
        study(weight=(0.0, 0.0, 1.0))


def test_a_study_with_loads_survives_a_file_round_trip(tmp_path):
    given = study(BRAIN, replace(TUMOUR, growth=(0.2, 0.0)), weight=(0.01, 0.0))
    solution = solve_study(given)
    path = write_study(tmp_path / "grown", given, solution)
    back = read_study(path).study
    assert back.tissue.materials == given.tissue.materials
    assert back.motion.weight == given.motion.weight
    np.testing.assert_array_equal(replay(path).displacement, solution.displacement)


def test_large_motion_survives_a_file_round_trip(tmp_path):
    given = replace(study(), prior=NeoHookeanPrior(0.3, plane="strain"))
    path = write_study(tmp_path / "far", given)
    assert read_study(path).study.prior == given.prior
    assert read_study(path).study.model_name == "large motion"


@pytest.mark.parametrize("amount", [0.2, (0.2, 0.0)])
def test_growth_is_stored_in_a_material_table(tmp_path, amount):
    rows = (BRAIN, replace(TUMOUR, growth=amount))
    path = write_preset(tmp_path / "table", Preset("Mine", "kPa", "me", rows))
    assert read_preset(path).materials == rows


def test_csv_tables_specify_growth_and_forces(tmp_path):
    materials, rules = tmp_path / "materials.csv", tmp_path / "rules.csv"
    materials.write_text("label,stiffness,growth\n1,2\n2,6,0.2\n3,6,20%/0\n")
    rules.write_text("label,action,row,col,amount\n1,press,,,0.3\n2,pull,0,0.2,\n")
    assert [row.growth for row in read_materials(materials)] == [0.0, 0.2, (0.2, 0.0)]
    press, pull = read_rules(rules)
    assert (press.action, press.amount) == ("press", 0.3)
    assert (pull.action, pull.vector) == ("pull", (0.0, 0.2))


def test_the_support_of_a_block_bears_its_weight():
    block, table = np.full((10, 16), 1.0), np.zeros((10, 16, 2))
    table[-1] = 1
    heavy = weight(block, (0.02, 0.0), spacing=1)
    problem = Problem(observed=0 * table, confidence=table, stiffness=block, loads=heavy)
    (part,) = held_forces(problem, solve(problem))
    assert not part.moves
    assert part.sites == 16
    assert part.centre == (9.0, 7.5)
    np.testing.assert_allclose(part.force, (-heavy.force[..., 0].sum(), 0), atol=1e-4)


def test_pulled_and_fixed_regions_have_opposite_forces():
    y, c = np.zeros((2, 12, 20, 2))
    c[:, 0] = c[4:8, -1] = 1
    y[4:8, -1, 1] = 1.0
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((12, 20)))
    pulled, held = held_forces(problem, solve(problem))
    assert (pulled.moves, held.moves) == (True, False)
    assert pulled.force[1] > 0.1
    np.testing.assert_allclose(np.add(pulled.force, held.force), 0, atol=2e-3)


def test_the_shortfall_of_large_motion_is_reported_with_its_length_and_position():
    crowded = study(model="large motion", labels=LABELS)
    ring = np.zeros(SHAPE, int)
    ring[DISC] = 1
    motion = Motion(True, ring, (BoundaryRule(1, "expand", amount=9.0),))
    solution = solve_study(replace(crowded, motion=motion))
    assert solution.reach.least_jacobian > 0
    said = shortfall(solution.reach, "mm")
    assert "short" in said
    assert f"{solution.reach.missing:.3g} mm" in said
    assert str(solution.reach.where) in said
    assert shortfall(solve_study(study(model="large motion")).reach, "mm") == ""


def test_growth_moves_the_rim_of_the_sample_tumour_about_as_far_as_pushing_it():
    pushed = phantom("mass-effect", 60)
    grown = pushed.growing()
    rim = pushed.boundary_labels == 2
    far = [np.hypot(*solve(each.problem).displacement[rim].T).mean() for each in (pushed, grown)]
    assert far[1] == pytest.approx(far[0], rel=0.25)
    assert isinstance(grown.problem.loads, Loads)
    assert not grown.boundary_labels[rim].any()


@pytest.mark.parametrize("text", ["150", "-1", "-100%", "0.2/-1", "much", "/"])
def test_a_mistyped_growth_is_rejected_and_its_line_named(tmp_path, text):
    path = tmp_path / "materials.csv"
    path.write_text(f"label,stiffness,growth\n1,2,{text}\n")
    with pytest.raises(FileFormatError, match=r"line 2: growth must be .*a fifth longer"):
        read_materials(path)
