"""User actions on a `Session`, with and without a window."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from napari.layers import Image, Labels
from napari.viewer import ViewerModel
from psygnal import EmitLoopError

from napari_hmrf import Arrow, BoundaryRule, Drawing, Material, solve_study
from napari_hmrf.field.frame import Frame
from napari_hmrf.io.study_file import read_study, write_study
from napari_hmrf.layers.metadata import table_of
from napari_hmrf.layers.read import Request, study_from_layers, study_layers
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.models import SolverDetails
from napari_hmrf.study.session import DisplayChoice, ImageChoice, ModelChoice, Part, Session
from napari_hmrf.tissue.material_presets import PLAIN
from napari_hmrf.tissue.row_table import RowTable
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve

SHAPE = (24, 30)
PULL = Arrow((12, 15), (0, 2), 3.0)
SOFT, STIFF = Material(1, "soft", 10.0), Material(2, "stiff", 40.0)


@pytest.fixture
def layers():
    brightness = np.linspace(0, 1, SHAPE[0] * SHAPE[1]).reshape(SHAPE) + 0.5
    tissue, wall = np.ones(SHAPE, int), np.zeros(SHAPE, int)
    tissue[8:16, 10:20] = 2
    wall[0] = wall[-1] = 1
    return {
        "image": Image(brightness, name="brain"),
        "tissue": Labels(tissue, name="Tissue"),
        "boundary": Labels(wall, name="Boundary"),
    }


def study_of(model):
    """Return the study that the window would read and solve."""
    view = View.of(ViewerModel(ndisplay=2).dims)
    study = study_from_layers(Request.of(model, view))
    return replace(study, prior=model.model.prior, optimizer=model.model.optimizer)


def edited_model(layers):
    """Return a model after seven edits: choices, tables, a drawing and model settings."""
    model = Session()
    model.select(layers["image"])
    model.choose(step=False, hold_edge=False)
    model.choose(tissue=layers["tissue"])
    model.set_table("tissue", layers["tissue"], RowTable((SOFT,)))
    model.set_table("tissue", layers["tissue"], RowTable((SOFT, STIFF)), "added a tissue")
    model.choose(boundary=layers["boundary"])
    model.set_table("boundary", layers["boundary"], RowTable(()))
    rules = RowTable((BoundaryRule(1, "fixed"),))
    model.set_table("boundary", layers["boundary"], rules, "added a rule")
    model.select_slice(layers["image"])
    model.begin_drawing("drew an arrow")
    for by in (0.5, 1.0, 2.0):
        model.update_drawing(Drawing((replace(PULL, by=(0, by)),)))
    assert model.end_drawing() == "drew an arrow"
    model.choose_model(ModelChoice(plane="strain"))
    model.choose(without_border=False)
    return model


def test_every_user_action_works_on_the_model_without_a_window(layers, tmp_path):
    model = edited_model(layers)
    study = study_of(model)
    solution = solve_study(study, backend="cpu")
    np.testing.assert_allclose(solution.displacement[12, 15], (0, 2), atol=1e-3)
    assert np.abs(solution.displacement[0]).max() == 0
    assert (study.tissue.materials, study.prior.plane) == ((SOFT, STIFF), "strain")
    again = Session()
    saved = read_study(write_study(tmp_path / "brain.study", study)).study
    made = study_layers(saved)
    again.restore(saved, made)
    again.select_slice(made["image"])
    again.draw(saved.motion.drawing, "")
    assert again.next_undo is None
    same = solve_study(study_of(again), backend="cpu")
    np.testing.assert_array_equal(same.displacement, solution.displacement)


def test_undo_reverts_choices_tables_drawings_and_the_model_in_one_order(layers):
    model = edited_model(layers)
    words, states = [], []
    while model.next_undo is not None:
        states.append((model.choice, model.model, model.drawing))
        words.append(model.undo().word)
    assert words == [
        "changed whether the dark border is tissue",
        "chose another plane",
        "drew an arrow",
        "added a rule",
        "chose another boundary",
        "added a tissue",
        "chose another source of stiffness",
    ]
    assert model.choice == ImageChoice(hold_edge=False)
    assert (model.model, model.drawing) == (ModelChoice(), Drawing())
    for state in reversed(states):
        model.redo()
        assert (model.choice, model.model, model.drawing) == state


def test_reset_restores_drawing_and_settings_and_keeps_layers_as_one_step(layers):
    model = edited_model(layers)
    model.choose(weight=(1.0, 0.0))
    model.choose_model(ModelChoice("paper", details=SolverDetails(sweeps=3)))
    before = model.choice, model.model, model.drawing
    model.reset()
    assert model.drawing == Drawing()
    assert model.model == ModelChoice()
    kept = {name: layers[name] for name in ("tissue", "boundary")}
    assert model.choice == ImageChoice(**kept, hold_edge=False)
    assert model.undo().word == "reset the study"
    assert (model.choice, model.model, model.drawing) == before


def test_the_edge_is_held_again_once_no_slice_of_the_image_is_registered():
    session = Session()
    session.select(image := object())
    still = np.zeros((4, 4, 2), np.float32), np.zeros((4, 4, 2, 2), np.float32)
    slices = [Part("measured", image, index=(number,)) for number in range(2)]
    session.register(slices[0], MeasuredMotion(*still, frees_edge=session.choice.hold_edge))
    assert not session.choice.hold_edge
    session.register(slices[1], MeasuredMotion(*still, frees_edge=session.choice.hold_edge))
    session.unregister(slices[0], "removed the registration")
    assert not session.choice.hold_edge, "the other slice is registered"
    session.unregister(slices[1], "removed the registration")
    assert session.choice.hold_edge
    session.undo()
    assert not session.choice.hold_edge


def test_the_tissues_to_paint_with_are_undone_reset_and_saved(layers, tmp_path):
    model = Session()
    model.select(layers["image"])
    model.choose(step=False, hold_edge=True)
    model.choose(preset=PLAIN)
    assert model.undo().word == "chose other tissues to paint with"
    assert model.choice.preset is None
    model.redo()
    saved = read_study(write_study(tmp_path / "painted", study_of(model))).study
    model.reset()
    assert model.choice.preset is None
    model.restore(saved, layers)
    assert model.choice.preset == PLAIN


def test_a_solver_setting_is_not_an_undo_step(layers):
    model = Session()
    model.choose_model(ModelChoice())
    model.choose_model(ModelChoice(details=SolverDetails(accuracy=1e-2)))
    assert model.next_undo is None
    assert model.model.optimizer.tolerance == 1e-2


def test_undo_keeps_later_choices_that_are_not_steps(layers):
    model = Session()
    model.select(layers["image"])
    model.choose(hold_edge=False)
    model.choose(step=False, tissue=layers["tissue"])
    model.choose_model(ModelChoice(plane="strain"))
    fine = SolverDetails(accuracy=1e-4)
    model.choose_model(ModelChoice(plane="strain", details=fine))
    assert [model.undo().word, model.undo().word] == [
        "chose another plane",
        "changed whether the edge is held",
    ]
    assert model.choice == ImageChoice(tissue=layers["tissue"])
    assert model.model == ModelChoice(details=fine)


def test_choices_apply_to_one_image_only(layers):
    model, other = Session(), Image(np.zeros(SHAPE), name="other")
    model.select(layers["image"])
    model.choose(tissue=layers["tissue"], weight=(1.0, 0.0))
    model.select(other)
    assert model.choice == ImageChoice()
    model.choose(hold_edge=False)
    model.select(layers["image"])
    assert model.choice == ImageChoice(tissue=layers["tissue"], weight=(1.0, 0.0))


def test_how_studies_are_displayed_is_common_to_all_images_and_not_a_step(dock):
    session, seen = dock.session, []
    session.displayed.connect(seen.append)
    session.choose_display(live=False, device="cpu")
    assert (dock.live, dock.device) == (False, "cpu")
    dock.live = True
    assert session.display == DisplayChoice(live=True, device="cpu")
    session.select(None)
    assert session.display.device == "cpu"
    assert session.next_undo is None
    session.choose_display(live=True)
    assert len(seen) == 2


def test_the_window_and_the_model_update_each_other(dock, layers, at_rest):
    model = dock.session
    model.choose(tissue=layers["tissue"], boundary=layers["boundary"], hold_edge=False)
    model.set_table("tissue", layers["tissue"], RowTable((SOFT, STIFF)), "stiffened")
    model.choose_model(ModelChoice(plane="strain"))
    assert (dock.tissue, dock.boundary) == (layers["tissue"], layers["boundary"])
    assert (dock.hold_edge, dock.plane, dock.materials) == (False, "strain", (SOFT, STIFF))
    dock.hold_edge, dock.model = True, "paper"
    assert (model.choice.hold_edge, model.model.name) == (True, "paper")
    dock.undo()
    assert (dock.model, model.model.name) == ("elastic", "elastic")
    at_rest.until(lambda: not dock.busy)
    model.draw(Drawing((PULL,)), "drew an arrow")
    at_rest.until(lambda: dock.solution is not None and not dock.busy)
    assert model.slice == Part.of_slice("drawing", dock.image, dock.study.grid.place)
    np.testing.assert_allclose(dock.solution.displacement[12, 15], (0, 2), atol=1e-2)


@pytest.fixture
def dock(frame, layers, at_rest):
    made = frame.open()
    for layer in layers.values():
        frame.viewer.add_layer(layer)
    at_rest.until(lambda: not made.busy)
    return made


def test_the_comparison_image_is_restored_with_its_image(dock, layers):
    other = dock._viewer.add_image(np.zeros(SHAPE), name="other")
    dock.image, dock.compare_with = layers["image"], other
    dock.image = other
    dock.image = layers["image"]
    assert dock.compare_with is other


def test_a_removed_layer_is_deselected_for_every_image(dock, layers):
    other = dock._viewer.add_image(np.zeros(SHAPE), name="other")
    model = dock.session
    dock.image = layers["image"]
    model.choose(tissue=layers["tissue"])
    dock.image = other
    dock._viewer.layers.remove(layers["tissue"])
    dock.image = layers["image"]
    assert (dock.tissue, model.choice.tissue) == (None, None)


def test_the_form_preserves_values_that_it_rounds_or_does_not_offer(dock):
    details = SolverDetails(accuracy=0.003)
    dock.session.choose_model(ModelChoice(poisson=0.4567, details=details))
    assert dock.session.model == ModelChoice(poisson=0.4567, details=details)
    assert dock.settings.accuracy == 0.003


def test_a_curve_is_not_in_use_before_it_is_chosen(dock, layers):
    model = dock.session
    model.choose(tissue=layers["tissue"])
    for end in (1.0, 2.0):
        model.set_curve(StiffnessCurve(((0, 1), (end, 5))), "changed the curve")
    assert (dock.tissue, model.choice.tissue) == (layers["tissue"], layers["tissue"])


def test_an_image_of_another_viewer_cannot_be_selected(dock, layers):
    with pytest.raises(EmitLoopError, match="is not an image in this viewer"):
        dock.session.select(Image(np.zeros(SHAPE), name="elsewhere"))
    assert dock.session.image is dock.image


def test_a_drawing_without_an_image_is_not_a_step(frame):
    dock = frame.open()
    dock.drawing = Drawing((PULL,))
    assert dock.session.next_undo is None


def test_another_stroke_after_undo_counts_as_unsaved_work(layers):
    viewer = ViewerModel()
    viewer.add_layer(layers["tissue"])
    viewer.layers.selection.active = layers["tissue"]
    undo = undo_of(viewer)
    owner = Drawing()
    undo.bind_keys(owner)
    model, states = undo.session, set()
    for _ in range(2):
        layers["tissue"].events.paint(value=[])
        states.add(model.get(Part("paint", layers["tissue"])))
        model.undo()
    assert len(states) == 2


def test_a_drag_ends_as_a_step_when_another_slice_is_selected(layers):
    model = Session()
    first, second = (
        Frame.at((1, 1, 1), ("pixel",) * 3, index=(number, 0, 0)) for number in range(2)
    )
    model.select(layers["image"])
    model.select_slice(layers["image"], first)
    model.begin_drawing("drew an arrow")
    model.update_drawing(Drawing((PULL,)))
    model.select_slice(layers["image"], second)
    assert not model.drawing_in_progress
    assert not model.drawing.marks
    assert model.in_progress is None
    assert model.next_undo.word == "drew an arrow"
    model.undo()
    model.select_slice(layers["image"], first)
    assert not model.drawing.marks


def test_a_result_is_fresh_until_its_study_changes(layers):
    session, image = Session(), layers["image"]
    session.select(image)
    session.select_slice(image)
    assert (session.study, session.result, session.is_fresh) == (None, None, False)
    session.study = study = study_of(session)
    result = session.results[image] = SimpleNamespace(moved=Deformation(study))
    assert session.is_fresh
    assert session.result_here is result
    faster = replace(study, optimizer=Multigrid(budget=1))
    session.study = faster
    assert not session.is_fresh
    assert session.shows(faster)
    session.study = study
    session.draw(Drawing((PULL,)), "drew an arrow")
    assert session.study.motion.drawing.marks == (PULL,)
    assert not session.is_fresh
    assert not session.shows(session.study)
    session.undo()
    assert session.is_fresh
    session.study = replace(study, grid=replace(study.grid, place=None))
    assert session.result is result
    assert session.result_here is None
    session.remove(image)
    assert session.result is None


def test_a_table_of_the_model_is_stored_with_its_layer(layers):
    viewer = ViewerModel()
    tissue = viewer.add_layer(layers["tissue"])
    model = undo_of(viewer).session
    model.set_table("tissue", tissue, RowTable((SOFT,)))
    table = RowTable((STIFF,), "kPa", "Brain", "a paper")
    model.set_table("tissue", tissue, table, "changed a table")
    assert table_of(tissue, "tissue") == table


def test_edits_are_unsaved_work_and_automatic_changes_are_not(layers):
    session = Session()
    session.select(layers["image"])
    session.select_slice(layers["image"])
    session.draw(Drawing((PULL,)), "drew an arrow")
    assert session.unsaved.slices == (session.slice,)
    session.unsaved.save(session.slice)
    session.draw(Drawing((PULL, PULL)), "")
    session.choose(hold_edge=False)
    assert not session.unsaved.slices
    session.set_table("tissue", layers["tissue"], RowTable((SOFT,)))
    session.set_table("tissue", layers["tissue"], RowTable((STIFF,)), "changed a table")
    assert session.unsaved.slices == (session.slice,)
    session.undo()
    assert not session.unsaved.slices
