"""Study: the immutable input of a solve."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from napari_hmrf import (
    ICM,
    ArgumentError,
    Arrow,
    BoundaryRule,
    Drawing,
    ElasticPrior,
    Grid,
    Material,
    Motion,
    Multigrid,
    Pictures,
    Problem,
    ProblemError,
    SeilerPrior,
    Stroke,
    Study,
    Tissue,
    build_problem,
    solve,
    solve_study,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue import StiffnessCurve
from napari_hmrf.tissue.material_presets import PLAIN, PRESETS

SHAPE = (20, 26)
GRID = Grid(SHAPE, (0.5, 0.8), "mm")
PULL = Drawing((Arrow((10, 12), (0, 2), 2.0),))


def pulled(**more):
    """Return a study of tissue with a fixed edge and a middle pulled to the right."""
    study = Study(GRID, Tissue(stiffness=np.ones(SHAPE)), Motion(hold_edge=True, drawing=PULL))
    return replace(study, **more)


def test_a_study_is_immutable():
    study = pulled()
    with pytest.raises(FrozenInstanceError):
        study.motion = Motion()


def test_pulled_tissue_moves_and_the_fixed_edge_does_not():
    found = solve_study(pulled(), backend="cpu").displacement
    assert found[10, 12] == pytest.approx((0, 2), abs=1e-3)
    assert np.abs(found[[0, -1]]).max() < 1e-3
    assert np.abs(found[:, [0, -1]]).max() < 1e-3
    assert 0.1 < found[10, 18, 1] < 1.9, "tissue in between should move part of the way"


@pytest.mark.parametrize(
    ("name", "prior", "optimizer"),
    [
        ("elastic", ElasticPrior(), Multigrid()),
        ("paper", SeilerPrior(), ICM()),
        ("paper, converged", SeilerPrior(), Multigrid()),
    ],
)
def test_a_model_is_chosen_by_its_name_and_named_in_the_result(name, prior, optimizer):
    study = pulled(model=name)
    assert (study.prior, study.optimizer, study.model_name) == (prior, optimizer, name)
    found = solve_study(study, backend="cpu")
    assert found.provenance.model == name
    assert found.provenance.parameters["optimizer"] == optimizer.parameters


def test_tissue_is_elastic_by_default_and_a_prior_can_be_given():
    assert pulled().model_name == "elastic"
    in_detail = pulled(prior=ElasticPrior(0.3, plane="strain"))
    assert in_detail.prior.poisson == 0.3
    assert replace(in_detail, motion=Motion(hold_edge=True)).prior.poisson == 0.3
    with pytest.raises(ArgumentError, match="unknown model 'rubber'"):
        pulled(model="rubber")


def test_a_prior_or_optimizer_must_match_the_named_model():
    prior, optimizer = ElasticPrior(0.3), ICM(5)
    assert Study(GRID, model="elastic", prior=prior).prior is prior
    assert Study(GRID, model="paper", optimizer=optimizer).optimizer is optimizer
    with pytest.raises(ArgumentError, match="'paper' requires the prior SeilerPrior, not Elastic"):
        Study(GRID, model="paper", prior=prior)
    with pytest.raises(ArgumentError, match=r"Pass optimizer=Multigrid\(\), or omit"):
        Study(GRID, model="elastic", optimizer=optimizer)
    by_name = replace(Study(GRID, model="paper"), model="elastic")
    assert (by_name.model_name, replace(by_name, model="paper").model_name) == ("elastic", "paper")


def test_a_study_of_arrays_equals_the_problem_of_the_same_arrays():
    observed, counts = np.zeros((*SHAPE, 2)), np.zeros((*SHAPE, 2))
    observed[5:9, 3:6] = (1, -1)
    counts[5:9, 3:6], counts[:, -1] = 1, 1
    stiffness = np.full(SHAPE, 4.0)
    study = Study(GRID, Tissue(stiffness=stiffness), Motion(observed=observed, confidence=counts))
    problem = Problem(
        observed=observed, confidence=counts, stiffness=stiffness, spacing=GRID.spacing
    )
    own = build_problem(study).problem
    for name in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(own, name), getattr(problem, name))
    same = solve(problem, backend="cpu").displacement
    np.testing.assert_array_equal(solve_study(study, backend="cpu").displacement, same)


def test_stiffness_comes_from_labels_a_curve_or_the_image():
    rows, cols = np.indices(SHAPE)
    inside = np.hypot(rows - 10, cols - 13) < 8
    image = np.where(inside, 150, 3).astype(np.uint8)
    by_labels = Tissue(
        labels=inside.astype(int), materials=(Material(0, "air", 0.0), Material(1, "gel", 5.0, 0.3))
    )
    curve = StiffnessCurve(((100.0, 2.0), (200.0, 4.0)), void_below=50.0)

    def stiffness(tissue):
        study = pulled(tissue=tissue, pictures=Pictures(image))
        return build_problem(study).problem.stiffness

    np.testing.assert_array_equal(stiffness(by_labels), np.where(inside, 5.0, 0.0))
    found = stiffness(Tissue(curve=curve))
    assert (found[inside] == found[10, 13]).all()
    assert 2 < found[10, 13] < 4
    assert not found[~inside].any()
    np.testing.assert_allclose(stiffness(Tissue()), np.where(inside, 1.0, 0.01))


def test_later_parts_of_a_motion_override_earlier_parts():
    labels = np.zeros(SHAPE, int)
    labels[4:17, 10:15] = labels[0, 5] = 1
    rules = (BoundaryRule(1, "move", vector=(3.0, 0.0)),)
    stated = build_problem(pulled(motion=Motion(True, labels, rules, drawing=PULL))).problem
    assert stated.observed[10, 12].tolist() == [0, 2], (
        "the drawing should override the painted rule"
    )
    assert stated.observed[5, 12].tolist() == [3, 0]
    assert stated.observed[0, 5].tolist() == [3, 0], (
        "the painted rule should override the fixed edge"
    )
    assert stated.confidence[0].all()
    assert not np.delete(stated.observed[0], 5, axis=0).any()


GEL = (Material(1, "gel", 6.0),)
RAMP = np.linspace(100, 300, 20 * 26).reshape(SHAPE)


@pytest.mark.parametrize(
    ("tissue", "typical"),
    [
        (Tissue(), 1),
        (Tissue(curve=StiffnessCurve(((100, 1), (200, 2), (300, 4)))), 2),
        (Tissue(stiffness=np.where(RAMP < 180, 0, np.where(RAMP < 200, 3e3, 5e3))), 5000),
        (Tissue(stiffness=np.full(SHAPE, np.inf)), 1),
    ],
    ids=["image", "curve", "stiffness", "rigid"],
)
def test_a_tissue_stroke_scales_typical_stiffness_by_the_ratio_of_its_preset(tissue, typical):
    tissues = PRESETS[0].materials
    usual = next(row for row in tissues if row.is_deformable)
    other = next(row for row in tissues if row.is_deformable and row.stiffness != usual.stiffness)
    stroke = Stroke("tissue", (((10.0, 12.0),),), 2.0, label=other.label)
    motion = Motion(hold_edge=True, drawing=Drawing((*PULL.marks, stroke)))
    ground = Ground.of(pulled(tissue=tissue, motion=motion, pictures=Pictures(RAMP)))
    found = ground.statement().problem.stiffness
    assert found[10, 12] == pytest.approx(typical * other.stiffness / usual.stiffness)
    assert found[1, 1] == ground.stiffness[1, 1]


def test_a_palette_lists_the_stiffness_that_it_paints_on_measured_tissue():
    measured = Tissue(stiffness=np.full(SHAPE, 1200.0), preset=PLAIN, unit="Pa")
    palette = Ground.of(Study(GRID, measured)).palette
    assert palette.unit == "Pa"
    assert [row.stiffness for row in palette.materials] == [0, 1200, 240, 6000, np.inf]


@pytest.mark.parametrize(
    ("tissue", "label", "stiffness", "said"),
    [
        (
            Tissue(labels=np.ones(SHAPE, int), materials=GEL, preset=PLAIN),
            3,
            30,
            "'stiff' (30 kPa)",
        ),
        (Tissue(labels=np.ones(SHAPE, int), materials=GEL), 3, 6, "'tissue 3' (6 kPa)"),
        (Tissue(stiffness=np.full(SHAPE, 6.0)), 9, 6, "'tissue 9' (6 kPa)"),
    ],
    ids=["preset", "table", "stiffness"],
)
def test_a_stroke_of_an_unlisted_tissue_has_an_assumed_stiffness(tissue, label, stiffness, said):
    stroke = Stroke("tissue", (((10.0, 12.0),),), 2.0, label=label)
    motion = Motion(hold_edge=True, drawing=Drawing((*PULL.marks, stroke)))
    ground = Ground.of(pulled(tissue=replace(tissue, unit="kPa"), motion=motion))
    stated = ground.statement()
    assert stated.problem.stiffness[10, 12] == stiffness
    assert f"{said} is assumed" in ground.notes_on(stated)[0]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: pulled(tissue=Tissue(stiffness=np.ones((4, 4)))), r"tissue.*\(4, 4\).*\(20, 26\)"),
        (lambda: pulled(pictures=Pictures(np.ones((20, 25)))), r"image.*\(20, 25\)"),
        (
            lambda: pulled(tissue=Tissue(stiffness=np.ones((*SHAPE, 3)))),
            r"tissue: has shape \(20, 26, 3\), but .* Use the shape \(20, 26\)\.",
        ),
        (
            lambda: pulled(motion=Motion(observed=np.zeros(SHAPE), confidence=np.ones(SHAPE))),
            r"observed: has shape \(20, 26\), but .* Use the shape \(20, 26, 2\)\.",
        ),
        (
            lambda: Tissue(labels=np.full(SHAPE, 1.5)),
            r"labels: have the value 1\.5 at \(0, 0\)\. Pass whole",
        ),
        (lambda: Tissue(labels=np.full(SHAPE, "brain")), "labels: has values of type <U5"),
        (lambda: Motion(labels=np.full(SHAPE, np.nan)), "labels: have the value nan"),
        (lambda: Motion(observed=np.zeros((*SHAPE, 2))), "its confidence"),
        (
            lambda: Tissue(labels=np.ones(SHAPE), stiffness=np.ones(SHAPE)),
            "labels and by its stiff",
        ),
    ],
)
def test_inconsistent_parts_are_rejected(wrong, said):
    with pytest.raises(ProblemError, match=said):
        wrong()


def test_an_error_names_the_faulty_part():
    with pytest.raises(ProblemError, match="is 0 everywhere: there is no tissue"):
        build_problem(pulled(tissue=Tissue(stiffness=np.zeros(SHAPE))))
    with pytest.raises(ProblemError, match=r"observed|confidence"):
        build_problem(pulled(motion=Motion()))
    curve = StiffnessCurve(((50.0, 1.0), (150.0, 2.0)))
    with pytest.raises(ProblemError, match=r"tissue: is defined by a curve .* no image\. Add an"):
        build_problem(pulled(tissue=Tissue(curve=curve)))


def test_nan_values_of_the_image_are_reported():
    image = np.full(SHAPE, 100.0)
    image[3, 4:7] = np.nan
    by_brightness = Tissue(curve=StiffnessCurve(((50.0, 1.0), (150.0, 2.0))))
    pictures = Pictures(image=image, name="MR")
    study = Study(GRID, by_brightness, pictures=pictures, names={"image": "MR"})
    with pytest.raises(
        ProblemError, match=r"'MR' has values at 3 pixels that are NaN .* \(3, 4\), but its"
    ):
        Ground.of(study)
    even = replace(study, tissue=Tissue())
    (note,) = [each for each in Ground.of(even).notes if "NaN" in each]
    assert note == "'MR' is NaN or infinite at 3 pixels, and remains so where they move"
    whole = replace(study, pictures=Pictures(image=np.nan_to_num(image)))
    assert not [each for each in Ground.of(whole).notes if "NaN" in each]


def test_the_repr_of_each_part_is_one_short_line():
    labels, photo = np.ones((40, 50), np.uint8), np.zeros((40, 50, 3), np.uint8)
    marks = tuple(Arrow((8, 8), (0, 2), 3) for _ in range(40))
    study = Study(
        Grid((40, 50), (0.5, 0.5), "mm"),
        Tissue(labels=labels, materials=(Material(1, "liver", 5.0),), unit="kPa"),
        Motion(hold_edge=True, labels=labels, drawing=Drawing(marks)),
        pictures=Pictures(photo, labels, "CT", "organs"),
    )
    for part in (study, study.grid, study.tissue, study.motion, study.motion.drawing):
        said = repr(part)
        assert said.startswith(f"{type(part).__name__}(")
        assert "\n" not in said
        assert "array" not in said
        assert len(said) < 300
    assert repr(study.pictures) == "Pictures(image 'CT' uint8, labels 'organs')"
    assert repr(study.grid) == "Grid(40 x 50 sites of 0.5 x 0.5 mm)"
    assert repr(Motion()) == "Motion(none)"


PLACE = Frame.at((0.5, 0.8), ("millimeter",) * 2)


@pytest.mark.parametrize(
    ("spacing", "unit", "place"),
    [
        ((5.0, 8.0), "mm", PLACE),
        ((1.0, 1.0), "mm", PLACE),
        ((0.8, 0.5), "mm", PLACE),
        ((0.5, 0.8), "um", PLACE),
        ((0.5, 0.8), "pixel", PLACE),
        ((0.5, 0.8), "mm", Frame.at((0.5, 0.8), ("pixel",) * 2)),
        ((0.5, 0.8), "mm", Frame.at((2.0, 0.5, 0.8), ("mm",) * 3, volume=True).plane_at(1, 3)),
    ],
)
def test_a_place_of_another_spacing_or_unit_is_rejected(spacing, unit, place):
    with pytest.raises(ProblemError, match=rf"has pixels of .* {unit}, but its place has pixels"):
        Grid(SHAPE, spacing, unit, place)


@pytest.mark.parametrize(
    ("spacing", "unit"),
    [
        ((0.5, 0.8), "mm"),
        ((0.5, 0.8), "millimeter"),
        ((500, 800), "um"),
        ((0.05, 0.08), "cm"),
        ((0.50000003, 0.79999998), "mm"),
    ],
)
def test_a_place_of_the_same_spacing_is_accepted(spacing, unit):
    assert Grid(SHAPE, spacing, unit, PLACE).place == PLACE


@pytest.mark.parametrize(
    "grid",
    [
        Grid(SHAPE, (1, 1), "mm"),
        Grid(SHAPE, GRID.spacing, "um"),
        Grid(SHAPE, GRID.spacing, "mm", PLACE),
        Grid((21, 26), GRID.spacing, "mm"),
    ],
)
def test_the_problem_of_another_study_is_rejected(grid):
    other = Study(grid, Tissue(stiffness=np.ones(grid.shape)), pulled().motion)
    with pytest.raises(ArgumentError, match=r"another study. Pass build_problem\(study\)"):
        solve_study(other, stated=build_problem(pulled()))


def test_labels_can_be_integers_stored_as_floats():
    labels = np.ones(SHAPE, int)
    labels[5:9] = 2
    rows = Material(1, "brain", 1.0), Material(2, "tumour", 4.0)
    found, expected = (
        build_problem(pulled(tissue=Tissue(labels=each, materials=rows))).problem.stiffness
        for each in (labels.astype(float), labels)
    )
    np.testing.assert_array_equal(found, expected)


def test_the_unit_of_a_tissue_is_a_string():
    with pytest.raises(ArgumentError, match="unit must be a str, such as"):
        Tissue(unit=3)


def test_a_preset_is_not_a_name():
    with pytest.raises(ArgumentError, match="preset must be a Preset"):
        Tissue(preset="brain")


def test_a_patch_that_grows_at_the_surface_moves_the_surface_outward():
    rows, cols = np.indices((60, 60)) - 29.5
    image = np.where(np.hypot(rows, cols) < 20, 100.0, 0.0)
    mark = Stroke("expand", (((30.0, 48.0),),), radius=6, amount=2)
    motion = Motion(hold_edge=True, drawing=Drawing((mark,)))
    study = Study(Grid((60, 60), (1, 1)), motion=motion, pictures=Pictures(image))
    outward = solve_study(study).displacement[..., 1]
    surface = outward[28:32, 48]
    assert surface.min() > 1, "the surface under the patch retreats"
    assert outward[30, 42] < -1, "the inner edge of the patch moves into the tissue"
