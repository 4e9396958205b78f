"""Input without effect is reported, and a study without motion is rejected."""

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    BoundaryRule,
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
    replay,
    solve_study,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.io.images import ImageFile, write_image

SHAPE = 20, 24
PULL = Arrow(at=(10, 12), by=(0, 2), radius=2)


def a_study(*marks, labels=None, rules=(), materials=None, hold_edge=True):
    m = np.ones(SHAPE)
    m[:, :4] = 0
    if materials is None:
        tissue = Tissue(stiffness=m)
    else:
        tissue = Tissue(labels=(m > 0).astype(int), materials=materials)
    motion = Motion(hold_edge=hold_edge, labels=labels, rules=rules, drawing=Drawing(marks))
    return Study(Grid(SHAPE, (1.0, 1.0)), tissue, motion)


def notes(study):
    return solve_study(study, backend="cpu").notes


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        (Arrow((50, 5), (0, 2), 2.0), "the arrow at (50, 5) is outside the image and has no"),
        (Arrow((10, 0), (0, 2), 1.0), "the arrow at (10, 0) is outside tissue and has no effect"),
        (Landmark((10, 1), (10, 3), 1.0), "the landmark at (10, 1) is outside tissue"),
        (Landmark((-9, 3), (10, 9), 1.0), "the landmark at (-9, 3) is outside the image"),
        (Stroke("pin", (((40.0, 9.0), (44.0, 9.0)),), 1.0), "the stroke at (40, 9) is outside"),
        (Stroke("pin", (((5.0, 1.0), (9.0, 1.0)),), 1.0), "the stroke at (5, 1) is outside tissue"),
        (Stroke("free", (((99.0, 1.0),),), 1.0), "the stroke at (99, 1) is outside the image"),
        (
            Stroke("confidence", (((9.0, 8.0),),), 1.0),
            "the stroke at (9, 8) is over tissue that is neither held nor moved and has no effect",
        ),
    ],
)
def test_a_mark_without_effect_is_named(mark, said):
    assert any(note.startswith(said) for note in notes(a_study(mark, PULL))), said
    with pytest.raises(ProblemError, match="nothing moves") as caught:
        solve_study(a_study(mark))
    assert said in str(caught.value)


def test_marks_with_an_effect_are_not_named():
    free = Stroke("free", (((5.0, 1.0), (9.0, 1.0)),), 1.0)  # frees the paint beneath it
    across = Stroke("pin", (((5.0, -9.0), (5.0, 9.0)),), 1.0)
    over_pull, over_edge = (
        Stroke("confidence", ((at,),), 1.0, confidence=0.5) for at in ((10.0, 12.0), (0.0, 12.0))
    )
    marks = PULL, free, across, over_pull, over_edge
    assert not [note for note in notes(a_study(*marks)) if "no effect" in note]


def test_marks_of_one_kind_share_a_note():
    away = [Landmark((40.0 + n, 5.0), (41.0 + n, 5.0), 1.0) for n in range(3)]
    said = "3 landmarks are outside the image and have no effect, at (40, 5), (41, 5) and (42, 5)"
    assert said in notes(a_study(*away, PULL))


def test_rules_and_growth_of_missing_labels_are_named():
    labels = np.zeros(SHAPE, int)
    labels[9:12, 12:15] = 2
    rules = BoundaryRule(2, "move", vector=(0, 1)), BoundaryRule(7, "move", vector=(0, 1))
    said = notes(a_study(labels=labels, rules=rules))
    assert "the rule of label 7 has no effect: 'boundary' has no such label" in said
    materials = (
        Material(0, "air", 0.0),
        Material(1, "brain", 3.0),
        Material(9, "tumour", 8.0, growth=0.2),
    )
    said = notes(a_study(PULL, materials=materials))
    assert "the growth of label 9 ('tumour') has no effect: 'tissue' has no such label" in said
    with pytest.raises(ProblemError, match=r"nothing moves; the growth of label 9 \('tumour'\)"):
        solve_study(a_study(materials=materials))


def test_sliding_of_a_label_that_touches_no_other_tissue_is_named():
    lung, liver = Material(1, "lung", 1.0, slides=True), Material(9, "liver", 1.0, slides=True)
    said = notes(a_study(PULL, materials=(Material(0, "air", 0.0), lung, liver)))
    assert "the sliding of label 1 ('lung') has no effect: no other tissue is next to it" in said
    assert "the sliding of label 9 ('liver') has no effect: no tissue has such a label" in said


def test_the_confidence_of_a_rule_that_has_none_is_named():
    rules = BoundaryRule(1, "slide", confidence=(0.5, 0.5)), BoundaryRule(2, "fixed")
    labels = np.zeros(SHAPE, int)
    labels[0], labels[-1] = 1, 2
    said = notes(a_study(PULL, labels=labels, rules=rules))
    assert "the confidence of label 1 has no effect: its action is 'slide'" in said


def test_a_fixed_edge_or_rules_of_missing_labels_alone_are_rejected():
    with pytest.raises(ProblemError, match=r"motion: nothing moves\. Prescribe a displ"):
        solve_study(a_study())
    rules = (BoundaryRule(7, "move", vector=(0, 1)),)
    with pytest.raises(ProblemError, match="nothing moves; the rule of label 7 has no"):
        solve_study(a_study(rules=rules))


def test_a_saved_study_without_motion_is_replayed_as_it_was(tmp_path):
    path = write_study(tmp_path / "still.study", a_study())
    assert read_study(path).study.motion.hold_edge
    assert not replay(path).displacement.any()


def test_the_command_line_rejects_a_study_without_motion(tmp_path, capsys):
    write_image(tmp_path / "a.tif", ImageFile(np.full(SHAPE, 90, np.uint8)))
    told = ["solve", str(tmp_path / "a.tif"), "--out", str(tmp_path / "out")]
    assert main([*told, "--hold-edge"]) == 1
    said = capsys.readouterr().err
    assert "napari-hmrf: nothing moves. Prescribe a displacement, force or growth. Use --b" in said

    labels = np.zeros(SHAPE, np.uint8)
    labels[8:12, 8:12] = 2
    write_image(tmp_path / "b.tif", ImageFile(labels))
    rules = tmp_path / "rules.csv"
    for action, code in (("fixed,,", 1), ("move,0,1", 0)):
        rules.write_text(f"label,action,row,col\n2,{action}\n7,move,0,1\n")
        more = ["--boundary", str(tmp_path / "b.tif"), "--rules", str(rules), "--hold-edge"]
        assert main([*told, *more]) == code
        out, err = capsys.readouterr()
        idle = "the rule of label 7 has no effect: 'b.tif' has no such label"
        assert idle in (err if code else out)
