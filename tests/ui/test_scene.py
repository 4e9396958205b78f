"""Tests of what the dock shows: pure functions, without a window."""

from dataclasses import replace
from types import SimpleNamespace

from napari_hmrf.layers.result_layers import CompleteResult, Outputs
from napari_hmrf.notes import Note
from napari_hmrf.solver.caveats import LOOSE
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.study.study import Grid, Study
from napari_hmrf.ui import messages
from napari_hmrf.ui.motion import motion_messages as words
from napari_hmrf.ui.scene import NEW_BOUNDARY, NEW_TISSUE, Situation, Status, resolve

IMAGE = Situation(has_image=True, has_layers=True)


def told(status, situation=IMAGE):
    return resolve(situation, status).status


def test_progress_replaces_news_stands_beside_a_saved_file_and_gives_way_to_a_refusal():
    def during_work(why):
        return told(replace(Status().with_message("Said.", why), doing="Deforming ..."))

    assert during_work("news") == during_work("step") == "Deforming ..."
    assert during_work("saved") == "Said. Deforming ..."
    assert during_work("refused") == "Said."


def test_a_message_about_the_study_follows_a_step_and_waits_for_the_end_of_a_refusal():
    step, refused = (Status().with_message("Said.", why) for why in ("step", "refused"))
    assert told(step.about_study("Moved.", "")) == "Said. Moved."
    assert told(refused.about_study("Moved.", "")) == "Said."
    assert told(refused.after_action(False).about_study("Moved.", "")) == "Moved."
    twice = step.about_study("Moved.", "").about_study("Moved.", "")
    assert told(twice) == "Said. Moved."


def test_a_result_clears_messages_from_before_the_last_action_only():
    status = Status().with_message("Said.")
    assert told(status.after_picture()) == "Said."
    assert told(status.after_action(True).after_picture()) == IMAGE.hint


def test_an_aside_is_told_at_once_and_with_the_next_message_about_the_study():
    status = Status().with_aside("Hidden.")
    assert told(status) == "Hidden."
    assert told(status.about_study("Moved.", "")) == "Moved. Hidden."
    assert told(status.after_action(is_busy=True).about_study("Moved.", "")) == "Moved. Hidden."
    assert told(status.after_action(is_busy=False).about_study("Moved.", "")) == "Moved."
    step = Status().with_message("Said.", "step").with_aside("Hidden.")
    assert told(step) == "Said."


def test_nobody_is_advised_to_move_tissue_that_cannot_be_moved_in_this_view():
    flat = replace(IMAGE, is_3d=True)
    assert flat.obstacle == words.FLAT
    assert told(Status().about_study(messages.STILL, flat.obstacle), flat) == words.FLAT
    assert told(Status().about_study(messages.STILL, ""), IMAGE) == messages.STILL


def test_the_tools_work_in_3d_on_a_visible_volume_only():
    view = replace(IMAGE, is_3d=True)
    assert replace(view, has_slices=True).obstacle == words.ONE_SLICE
    assert replace(view, is_volume=True, sees_volume=False).obstacle == words.FLAT
    assert replace(view, is_volume=True).obstacle == ""
    pulling = replace(view, is_volume=True, tool="Pull.", tool_in_plane="In a slice.")
    assert pulling.hint == f"Pull. {words.TURN} {words.IN_DEPTH}"
    assert replace(pulling, follows_surface=True).hint == f"Pull. {words.TURN}"
    assert replace(pulling, is_3d=False).hint == "Pull. In a slice."


def test_the_hint_names_the_next_step():
    assert Situation().hint == messages.WELCOME
    assert Situation(has_layers=True).hint == messages.CHOOSE
    assert Situation(has_layers=True, is_painted=True).hint == words.START
    assert IMAGE.hint == words.START
    assert replace(IMAGE, is_live=False).hint == words.START
    painted = replace(IMAGE, is_live=False, lacks_boundary=False)
    assert told(Status(), painted) == painted.hint == "Press Deform."
    drawing = replace(IMAGE, tool="Pull.")
    assert drawing.hint == "Pull."
    assert replace(drawing, introduction="Drag here.").hint == "Drag here."
    assert replace(drawing, paused="Press a tool.").hint == "Press a tool."
    assert "'other' covers the image" in replace(drawing, covering="other").hint


def test_the_status_says_that_the_deformed_image_is_hidden_while_the_user_paints():
    painting = replace(IMAGE, is_painting=True)
    assert told(Status(), painting) == messages.MEANWHILE
    assert told(Status().with_message("Said."), painting) == f"Said. {messages.MEANWHILE}"
    assert told(Status(doing="Deforming ..."), painting) == "Deforming ..."


def test_messages_name_the_button_or_the_entry_that_solves():
    changed = Status().with_message(messages.CHANGED)
    assert told(changed, replace(IMAGE, is_live=False)).endswith("Press Deform.")
    assert told(changed).endswith("Press 'Solve precisely' under 'More'.")


def test_a_layer_can_be_added_while_one_is_missing():
    for tissue, boundary, label, can_add in (
        (True, True, NEW_TISSUE, True),
        (True, False, NEW_TISSUE, True),
        (False, True, NEW_BOUNDARY, True),
        (False, False, NEW_BOUNDARY, False),
    ):
        scene = resolve(replace(IMAGE, lacks_tissue=tissue, lacks_boundary=boundary), Status())
        assert (scene.new_layer, scene.can_add) == (label, can_add)
        assert scene.has_study
    empty = resolve(Situation(), Status())
    assert not empty.can_add
    assert not empty.has_study


def test_the_scene_names_what_is_wrong_with_the_result_and_offers_a_remedy():
    grid = Grid((4, 4), (1, 1))
    moved = SimpleNamespace(study=Study(grid), solution=None)
    folded = Outputs(SimpleNamespace(parts=None), {}, 99)
    loose = Note("nothing holds the tissue: hold its edge", kind=LOOSE)
    situation = replace(IMAGE, latest=CompleteResult(moved, folded, (loose,)), overlay="nothing")
    scene = resolve(situation, Status())
    assert scene.short_warning == "99 folds: show"
    assert "Nothing holds the tissue" in scene.warning
    assert situation.hint.startswith("Nothing holds the tissue")
    assert scene.offer == messages.OFFER
    chosen = ModelChoice("large motion", unfolds=False)
    assert resolve(replace(situation, model=chosen), Status()).offer == ""
    bare = resolve(IMAGE, Status())
    assert (bare.warning, bare.short_warning, bare.offer) == ("", "", "")


def test_marks_can_be_removed_only_if_there_are_any():
    scene = resolve(replace(IMAGE, has_marks=True, has_selection=False), Status())
    assert scene.can_clear
    assert not scene.can_remove
