"""Landmarks with standard deviations in studies: they are data, not paint."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    Drawing,
    Grid,
    Landmark,
    Motion,
    Pictures,
    Problem,
    ProblemError,
    Study,
    Tissue,
    build_problem,
    read_study,
    replay,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.study.engine import Engine
from napari_hmrf.ui.window_words import in_window_words

SHAPE = 30, 36
MARK = Landmark((10.3, 15.2), (12.3, 14.2), 2.0, sd=0.5)


def a_study(*marks, stiffness=None, size=(1.0, 1.0), model="", hold_edge=True, **parts):
    if "tissue" not in parts:
        parts["tissue"] = Tissue(stiffness=np.ones(SHAPE) if stiffness is None else stiffness)
    motion = Motion(hold_edge=hold_edge, drawing=Drawing(marks))
    return Study(Grid(SHAPE, size), motion=motion, model=model, **parts)


def test_a_landmark_with_a_standard_deviation_is_data_of_the_problem():
    size = (0.5, 2.0)
    study = a_study(MARK, size=size)
    stated = build_problem(study)
    edge = build_problem(a_study(size=size)).problem
    np.testing.assert_array_equal(stated.problem.confidence, edge.confidence)
    # In the unit of the grid: 2 rows of 0.5 down, 1 column of 2 to the left.
    assert stated.problem.landmarks.displacement(size).tolist() == [pytest.approx((1, -2))]
    by_hand = Landmarks([MARK.source], [MARK.target], sd=0.5, scale=StrainScale(0.1))
    same = replace_landmarks(edge, by_hand).digests["landmarks"]
    assert stated.problem.digests["landmarks"] == same
    field = solve_study(study, backend="cpu")
    reached = field.at([MARK.source])[0]
    assert 0.1 < reached[0] < 0.99, "the landmark is exact or without effect"


def replace_landmarks(problem, landmarks):
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
        landmarks=landmarks,
    )


def test_a_smaller_standard_deviation_brings_tissue_closer_to_the_target():
    missed = []
    for sd in (1.0, 0.3, 0.01):
        field = solve_study(a_study(replace(MARK, sd=sd)), backend="cpu")
        reached = np.add(MARK.source, field.at([MARK.source])[0])
        missed.append(float(np.linalg.norm(reached - MARK.target)))
    assert missed[0] > 2 * missed[1] > 4 * missed[2]
    assert missed[2] < 0.01


def test_a_standard_deviation_of_zero_or_none_is_an_exact_patch():
    exact = Landmark((10.0, 15.0), (12.0, 15.0), 2.0)
    assert Landmark((10.0, 15.0), (12.0, 15.0), 2.0, sd=None) == exact == replace(exact, sd=0)
    problem = build_problem(a_study(exact)).problem
    assert problem.landmarks is None
    assert problem.observed[10, 15].tolist() == [2, 0]


def test_landmarks_outside_tissue_are_named_in_one_note():
    m = np.ones(SHAPE)
    m[:, :6] = 0
    away = [replace(MARK, source=(at, 2.5)) for at in (10.0, 20.5)]
    beyond = replace(MARK, source=(90.0, 9.0))
    notes = solve_study(a_study(MARK, *away, beyond, stiffness=m), backend="cpu").notes
    of_tissue = "2 landmarks are outside tissue and have no effect, at (10, 2.5) and (20.5, 2.5)"
    of_image = "the landmark at (90, 9) is outside the image and has no effect"
    assert {of_tissue, of_image} <= {*notes}
    with pytest.raises(ProblemError, match=r"nothing moves; the landmark at \(10, 2.5\)"):
        solve_study(a_study(away[0], stiffness=m))


def test_a_landmark_within_a_pixel_of_tissue_moves_the_nearest_tissue():
    m = np.ones(SHAPE)
    m[:, :6] = 0
    for at, place in (((-0.4, 10.0), (0, 10)), ((10.5, 5.2), (10.5, 6))):
        mark = Landmark(at, (at[0] + 1, at[1]), 1.0, sd=0.5)
        (point,) = build_problem(a_study(mark, stiffness=m)).problem.landmarks.points
        assert point.tolist() == pytest.approx(place)


def test_landmarks_alone_hold_a_piece_of_tissue():
    m = np.ones(SHAPE)
    m[:, 10:13] = 0
    marks = [Landmark(at, (at[0] + 1, at[1]), 1.0, sd=0.2) for at in ((5.5, 20.5), (25.5, 30.5))]
    field = solve_study(a_study(*marks, stiffness=m, hold_edge=False), backend="cpu")
    assert field.at([(15, 25)])[0] == pytest.approx((1, 0), abs=1e-2)
    assert any("too few constraints stays at rest" in note for note in field.notes)
    with pytest.raises(ProblemError, match=r"'Landmark' leaves a piece of tissue free: .* turn"):
        solve_study(a_study(marks[0], stiffness=m, hold_edge=False), backend="cpu")


def test_a_dark_border_does_not_weaken_landmarks():
    image = np.zeros(SHAPE, np.uint8)
    image[8:24, 8:28] = 200
    dark = a_study(MARK, tissue=Tissue(), pictures=Pictures(image))
    assert build_problem(dark).problem.landmarks.scale.stiffness == 1.0


def test_an_edited_landmark_is_solved_live_as_from_a_cold_start(qtbot):
    found = []
    engine = Engine(found.append, "a test")
    try:
        at, to = MARK.source, MARK.target
        marks = [MARK, replace(MARK, target=(to[0] + 3, to[1] + 4))]
        marks += [replace(marks[1], source=(at[0] + 4, at[1])), replace(marks[1], sd=3.0)]
        for mark in (*marks, MARK):
            engine.submit(a_study(mark), backend="cpu")
            qtbot.waitUntil(lambda: not engine.busy, timeout=300_000)
            live, study = found[-1].solution, a_study(mark)
            alone = solve_study(study, backend="cpu")
            far = np.abs(live.displacement - alone.displacement).max()
            assert far <= live.convergence.error + alone.convergence.error
    finally:
        engine.close()


def test_a_volume_takes_landmarks_between_its_voxels():
    shape = (9, 10, 11)
    mark = Landmark((4.5, 5.2, 5.7), (5.5, 5.2, 5.7), 1.0, sd=0.005)
    motion = Motion(hold_edge=True, drawing=Drawing((mark,)))
    study = Study(Grid(shape, (1.0, 1.0, 1.0)), Tissue(stiffness=np.ones(shape)), motion)
    field = solve_study(study, backend="cpu")
    assert field.at([mark.source])[0] == pytest.approx((1, 0, 0), abs=0.1)
    stated = build_problem(study)
    assert solve(stated.problem, stated.prior).provenance.backend == "cpu"


def test_a_saved_study_keeps_standard_deviations_and_is_replayed_bit_by_bit(tmp_path):
    study = a_study(MARK, replace(MARK, source=(20.0, 20.0), sd=0))
    solution = solve_study(study, backend="cpu")
    path = write_study(tmp_path / "a.study", study, solution)
    assert read_study(path).study.motion.drawing == study.motion.drawing
    np.testing.assert_array_equal(replay(path).displacement, solution.displacement)


def test_pairs_have_a_common_or_their_own_standard_deviation():
    at, to = [[5.2, 6], [5.4, 6], [9, 9]], [[6, 6], [6, 7], [9, 9]]
    marks = Drawing.from_landmarks(at, to, radius=2.0, sd=[0.5, 1, 0]).marks
    assert [mark.sd for mark in marks] == [0.5, 1, 0]
    assert {mark.sd for mark in Drawing.from_landmarks(at, to, radius=2.0, sd=2).marks} == {2}
    for sd, said in (([1, 2], "shape"), (-1, "negative"), (np.nan, "NaN")):
        with pytest.raises(ProblemError, match=f"sd: has.*{said}"):
            Drawing.from_landmarks(at, to, radius=2.0, sd=sd)
    with pytest.raises(ProblemError, match="two sources in the pixel"):
        Drawing.from_landmarks(at, to, radius=2.0)


def test_a_larger_typical_strain_brings_tissue_closer_and_is_saved(tmp_path):
    study = a_study(MARK)
    stretchy = replace(study, motion=replace(study.motion, typical_strain=0.3))
    moved = [solve_study(each, backend="cpu").at([MARK.source])[0, 0] for each in (study, stretchy)]
    assert moved[0] + 0.2 < moved[1] < 2
    saved = read_study(write_study(tmp_path / "a.study", stretchy)).study
    assert build_problem(saved).problem.digests == build_problem(stretchy).problem.digests
    with pytest.raises(ArgumentError, match="typical_strain must be a number from 1e-09"):
        replace(study.motion, typical_strain=-1)


def test_a_drift_of_a_study_is_estimated_saved_and_replayed_bit_by_bit(tmp_path):
    places = [(6.3, 8.2), (7.1, 27.4), (22.8, 9.9), (23.5, 26.1), (15.2, 18.4)]
    marks = [Landmark(at, (1.05 * at[0], 0.97 * at[1]), 2.0, sd=0.5) for at in places]
    study = a_study(*marks, hold_edge=False)
    drifting = replace(study, motion=replace(study.motion, drift=True))
    assert "drift" in repr(drifting.motion)
    solution = solve_study(drifting, backend="cpu")
    assert np.abs(solution.strain()).max() < 1e-3
    assert np.abs(solve_study(study, backend="cpu").strain()).max() > 0.005
    assert "strains of 5 % and -3 %" in " ".join(solution.notes)
    path = write_study(tmp_path / "a.study", drifting, solution)
    assert read_study(path).study.motion.drift is True
    np.testing.assert_array_equal(replay(path).displacement, solution.displacement)
    held = replace(drifting, motion=replace(drifting.motion, hold_edge=True))
    (note,) = [note for note in solve_study(held, backend="cpu").notes if "outer edge" in note]
    assert in_window_words(note).endswith("release the edge ('Fix outer edge' off)")
    assert not any("outer edge" in note for note in solution.notes)
    with pytest.raises(ArgumentError, match="drift must be True or False"):
        replace(study.motion, drift="yes")


def test_exact_landmarks_hold_tissue_from_two_on():
    marks = [Landmark(at, (1.05 * at[0], at[1]), 1.0) for at in ((6, 8), (22, 9), (15, 18))]
    for count, is_loose in ((1, True), (2, False), (3, False)):
        notes = solve_study(a_study(*marks[:count], hold_edge=False), backend="cpu").notes
        assert any("nothing holds the tissue" in note for note in notes) is is_loose


@pytest.mark.parametrize("sd", [0.0, 0.5])
def test_a_note_names_a_landmark_with_its_target_outside_the_image(sd):
    inside, far = replace(MARK, sd=sd), replace(MARK, source=(20, 9), target=(20, -11), sd=sd)
    (note,) = [
        note for note in solve_study(a_study(inside, far), backend="cpu").notes if "target" in note
    ]
    assert note.startswith("the target of a landmark is outside the image, by up to 11 (")
    assert not any("target" in note for note in solve_study(a_study(inside), backend="cpu").notes)


def test_a_study_with_too_few_landmarks_for_a_drift_names_them():
    study = a_study(MARK, replace(MARK, source=(20.0, 20.0)), hold_edge=False)
    study = replace(study, motion=replace(study.motion, drift=True))
    with pytest.raises(ProblemError, match="cannot determine a drift") as refused:
        solve_study(study, backend="cpu")
    said = in_window_words(str(refused.value))
    assert said.startswith("'Landmark' cannot determine a drift: there are too few")
    assert said.endswith("or estimate no drift ('affine drift' off).")
