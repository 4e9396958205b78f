"""Edit history: one undo order for all edited values."""

from types import MappingProxyType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napari_hmrf.field.frame import Frame
from napari_hmrf.study.edit_history import EditHistory, Step
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing

#: Possible values of each slot.
VALUES = {
    ("drawing", 0): [
        Drawing(tuple(Arrow((row, 3), (1, 0), 2.0) for row in range(count))) for count in range(5)
    ],
    ("drawing", 1): [Drawing((Arrow((row, 8), (0, 2), 1.0),)) for row in range(5)],
    ("materials", "Tissue"): [(Material(1, "gel", float(e)),) for e in range(5)],
    ("rules", "Boundary"): [(BoundaryRule(1, "move", vector=(0.0, v)),) for v in range(5)],
}
SLOTS = list(VALUES)
FIRST = MappingProxyType({slot: values[0] for slot, values in VALUES.items()})

slots = st.sampled_from(SLOTS)
sequences = st.lists(
    st.tuples(
        st.sampled_from(["do", "do", "do", "drag", "cancel", "undo", "undo", "redo", "redo"]),
        slots,
        st.lists(st.integers(0, 4), min_size=1, max_size=4),
    ),
    max_size=40,
)


def opened():
    edits = EditHistory()
    for slot, value in FIRST.items():
        edits.setdefault(slot, value)
    return edits


def state(edits):
    return {slot: edits.get(slot) for slot in edits.parts}


def play(edits, what, slot, choices):
    """Apply one edit of a sequence and return whether it became a step."""
    before, values = edits.get(slot), [VALUES[slot][choice] for choice in choices]
    if what == "do":
        edits.do(slot, values[-1], f"did {choices[-1]}")
    else:
        edits.begin(slot, "dragged")
        for value in values:
            edits.update(value)
        if what == "cancel":
            edits.cancel()
            return False
        edits.end()
    return values[-1] != before


def test_an_edit_after_an_undo_leaves_nothing_to_redo():
    edits, (pulled, held) = opened(), SLOTS[:2]
    edits.do(pulled, VALUES[pulled][1], "pulled")
    edits.undo()
    edits.do(held, VALUES[held][1], "held")
    assert edits.next_redo is None
    assert edits.redo() is None
    assert edits.get(pulled) == FIRST[pulled]


@settings(max_examples=30)
@given(sequences)
def test_undo_restores_the_exact_earlier_state_and_redo_the_later_state(sequence):
    """Compare the history with plain lists of whole states."""
    edits, past, future = opened(), [], []
    mirror = dict(FIRST)
    edits.changed.connect(lambda slot, value: mirror.update({slot: value}))
    for what, slot, choices in sequence:
        before = state(edits)
        if what == "undo":
            assert (edits.undo() is not None) == bool(past)
            if past:
                future.append(before)
                assert state(edits) == past.pop()
        elif what == "redo":
            assert (edits.redo() is not None) == bool(future)
            if future:
                past.append(before)
                assert state(edits) == future.pop()
        elif play(edits, what, slot, choices):
            past.append(before)
            future.clear()
        else:
            assert state(edits) == before
        assert mirror == state(edits), "listeners should receive every change"
        assert (edits.next_undo is not None, edits.next_redo is not None) == (
            bool(past),
            bool(future),
        )
    while past:
        future.append(state(edits))
        assert edits.undo() is not None
        assert state(edits) == past.pop()
    while future:
        assert edits.redo() is not None
        assert state(edits) == future.pop()


@settings(max_examples=25)
@given(sequences, slots)
def test_dropping_a_slot_preserves_the_undo_steps_of_the_other_slots(sequence, gone):
    """The steps of a removed layer disappear and all other steps remain."""
    with_it, without = opened(), opened()
    for what, slot, choices in sequence:
        if what == "undo":
            step = with_it.undo()
            if step is not None and step.part != gone:
                without.undo()
        elif what == "redo":
            step = with_it.redo()
            if step is not None and step.part != gone:
                without.redo()
        elif slot != gone:
            play(with_it, what, slot, choices)
            play(without, what, slot, choices)
        elif play(with_it, what, slot, choices):
            # An edit of any slot clears the redo steps of all slots.
            without._future.clear()
    for edits in (with_it, without):
        edits.drop(lambda slot: slot == gone)
    assert gone not in with_it.parts
    while (step := without.undo()) is not None:
        assert with_it.undo() == step
        assert state(with_it) == state(without)
    assert with_it.undo() is None


def test_a_step_stores_its_part_and_its_description():
    edits = opened()
    edits.do(SLOTS[2], VALUES[SLOTS[2]][1], "stiffened gel")
    edits.begin(SLOTS[0], "drew an arrow")
    edits.update(VALUES[SLOTS[0]][1])
    assert edits.in_progress == SLOTS[0]
    assert edits.next_undo == Step({SLOTS[0]: VALUES[SLOTS[0]][0]}, "drew an arrow")
    step = edits.undo()
    assert (step.part, step.word) == (SLOTS[0], "drew an arrow")
    assert edits.next_redo == Step({SLOTS[0]: VALUES[SLOTS[0]][1]}, "drew an arrow")
    assert edits.next_undo.word == "stiffened gel"


def test_an_edit_of_one_slot_ends_the_drag_of_another_slot():
    edits = opened()
    edits.begin(SLOTS[0], "dragged")
    edits.update(VALUES[SLOTS[0]][3])
    edits.do(SLOTS[3], VALUES[SLOTS[3]][2], "moved the wall")
    assert [edits.undo().word, edits.undo().word] == ["moved the wall", "dragged"]
    assert state(edits) == FIRST


def reset():
    """Return a history with one edit, and then one of all slots together."""
    edits = opened()
    edits.do(SLOTS[0], VALUES[SLOTS[0]][1], "drew an arrow")
    edits.do_all({slot: VALUES[slot][2] for slot in SLOTS}, "reset")
    return edits


def test_values_that_were_set_together_are_undone_and_redone_together():
    edits = reset()
    after = state(edits)
    step = edits.undo()
    assert (step.part, step.word) == (SLOTS[0], "reset")
    assert state(edits) == FIRST | {SLOTS[0]: VALUES[SLOTS[0]][1]}
    assert edits.redo().part == SLOTS[0]
    assert state(edits) == after
    changed = []
    edits.changed.connect(lambda slot, _value: changed.append(slot))
    edits.undo()
    edits.redo()
    assert changed == [*reversed(SLOTS), *SLOTS]
    assert [edits.undo().word, edits.undo().word, edits.undo()] == ["reset", "drew an arrow", None]


@pytest.mark.parametrize(
    ("gone", "undone"), [(SLOTS[0], False), (SLOTS[0], True), (SLOTS[2], True)]
)
def test_values_of_a_joint_step_remain_together_without_a_dropped_slot(gone, undone):
    edits = reset()
    after = {slot: value for slot, value in state(edits).items() if slot != gone}
    if undone:
        edits.undo()
    edits.drop(lambda slot: slot == gone)
    if undone:
        edits.redo()
    assert state(edits) == after
    edits.undo()
    left = FIRST | {SLOTS[0]: VALUES[SLOTS[0]][1]}
    assert state(edits) == {slot: left[slot] for slot in after}


def test_a_value_that_follows_from_an_edit_is_undone_with_it():
    edits, (drawn, table, *_) = opened(), SLOTS
    drawing, rows = VALUES[drawn], VALUES[table]
    edits.begin(drawn, "pulled tissue")
    edits.update(drawing[1])
    edits.join(table, rows[1])
    edits.update(drawing[0])
    assert edits.end() is None, "the drag returned to its start"
    assert edits.get(table) == rows[0]
    edits.do(drawn, drawing[2], "pulled tissue")
    for value in rows[2:4]:
        edits.join(table, value)
    assert edits.next_undo.part == drawn
    edits.undo()
    assert (edits.get(drawn), edits.get(table)) == (drawing[0], rows[0])
    edits.redo()
    assert (edits.get(drawn), edits.get(table)) == (drawing[2], rows[3])


def test_an_amended_value_is_not_a_step():
    edits = opened()
    slot = SLOTS[2]
    edits.do(slot, VALUES[slot][1], "stiffened gel")
    edits.amend(slot, VALUES[slot][4])
    assert edits.get(slot) == VALUES[slot][4]
    edits.undo()
    assert edits.get(slot) == VALUES[slot][0]
    edits.redo()
    assert edits.get(slot) == VALUES[slot][4]


def test_the_drawings_of_two_slices_share_one_undo_order():
    model, arrow = Session(), Drawing((Arrow((1, 1), (1, 0), 1.0),))
    slices = [Frame.at((1, 1, 1), ("pixel",) * 3, index=(number, 0, 0)) for number in range(2)]
    model.select_slice("image", slices[0])
    model.draw(arrow, "drew an arrow")
    model.select_slice("image", slices[1])
    assert model.drawing == Drawing()
    model.begin_drawing("drew another")
    model.update_drawing(arrow)
    model.select_slice("image", slices[0])
    assert (model.drawing, model.drawing_in_progress) == (arrow, False)
    with pytest.raises(RuntimeError, match="begin"):
        model.update_drawing(Drawing())
    assert [model.undo().word, model.undo().word] == ["drew another", "drew an arrow"]
    assert model.drawing == Drawing()


def test_the_drawing_of_a_removed_image_is_empty_and_can_be_started_again():
    model = Session()
    model.select_slice("gone")
    model.begin_drawing("drew")
    model.update_drawing(Drawing((Arrow((1, 1), (1, 0), 1.0),)))
    model.drop(lambda part: part.layer == "gone")
    assert (model.drawing, model.drawing_in_progress, model.next_undo) == (Drawing(), False, None)
    model.cancel_drawing()
    model.draw(Drawing((Arrow((2, 1), (1, 0), 1.0),)), "drew again")
    assert model.undo().word == "drew again"


def test_an_edit_of_an_unknown_slot_is_an_error():
    with pytest.raises(KeyError):
        EditHistory().do("nothing", 1, "did")
