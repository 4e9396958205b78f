"""Tests of studies that are saved and opened in the window."""

import json
from dataclasses import replace

import numpy as np
import pytest
from napari.components import ViewerModel
from qtpy.QtWidgets import QFileDialog

from napari_hmrf import (
    Arrow,
    BoundaryRule,
    Drawing,
    FileFormatError,
    Grid,
    Material,
    Motion,
    Pictures,
    Solution,
    Stroke,
    Study,
    Tissue,
    read_study,
    replay,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.contributions import write_solution
from napari_hmrf.field.frame import Frame
from napari_hmrf.io.fields import geometry_of
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.tissue import StiffnessCurve
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.screen import Screen

SHAPE = (36, 44)
DRAWING = Drawing(
    (
        Arrow(at=(18, 20), by=(0.5, 2.0), radius=2.0),
        Stroke("confidence", (((5, 5), (5, 15)),), 2.0, confidence=0.5),
    )
)


@pytest.fixture
def viewer(frame):
    return frame.viewer


@pytest.fixture
def dock(frame, wait_for):
    """Return an idle dock beside an empty viewer."""
    made = frame.open()
    made.device = "cpu"
    wait_for(lambda: not made.busy)
    return made


@pytest.fixture
def stack(dock, viewer, wait_for):
    """Return the dock beside a painted slice of a rotated stack in millimetres."""
    add_stack(viewer)
    wait_for(lambda: not dock.busy)
    return dock


@pytest.fixture
def open_alone(dock, viewer, wait_for):
    """Return a function that removes all layers and opens a study."""

    def opened(path):
        viewer.layers.clear()
        dock.open_study(path)
        wait_for(lambda: not dock.busy)

    return opened


def add_stack(viewer):
    """Add a painted slice of a rotated stack in millimetres to a viewer."""
    place = {
        "scale": (3.0, 0.5, 0.8),
        "rotate": [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]],
        "translate": (1.0, 20.0, -7.0),
        "units": ("mm", "mm", "mm"),
    }
    pixels = np.random.default_rng(0).integers(50, 200, (3, *SHAPE), dtype=np.uint8)
    viewer.add_image(pixels, name="t1", **place)
    labels = np.ones((3, *SHAPE), np.uint8)
    labels[:, 10:20, 10:20] = 4
    rows = (Material(1, "liver", 5.0, 0.49), Material(4, "lump", 50.0, 0.3))
    viewer.add_labels(labels, name="Organs", metadata=layer_metadata(TISSUE, rows, "kPa"), **place)
    rim = np.zeros((3, *SHAPE), np.uint8)
    rim[:, 0], rim[:, -1] = 1, 2
    rules = (
        BoundaryRule(1, "fixed", name="wall"),
        BoundaryRule(2, "move", vector=(-0.5, 0.25), confidence=(1.0, 0.5), name="probe"),
    )
    viewer.add_labels(rim, name="Probe", metadata=layer_metadata(BOUNDARY, rules), **place)
    viewer.dims.set_current_step(0, 1)


def test_a_study_is_opened_as_it_was_saved(stack, qtbot, wait_for, tmp_path):
    first = stack
    first.drawing, first.model, first.plane = DRAWING, "elastic", "strain"
    wait_for(lambda: not first.busy)
    path = first.save_study(tmp_path / "case")
    assert first.status == "Saved the study of slice 1 as case.study."
    other = ViewerModel()
    second = SoftTissue(other)
    qtbot.addWidget(second.native)
    second.open_study(path)
    wait_for(lambda: not second.busy)
    assert {"t1", "Organs", "Probe"} <= {layer.name for layer in other.layers}
    assert second.materials == first.materials
    assert second.rules == first.rules
    assert second.drawing == DRAWING
    assert second.active, "the drawing is not displayed"
    assert (second.plane, second.hold_edge) == ("strain", first.hold_edge)
    one, again = first.study, second.study
    assert again.grid.spacing == pytest.approx(one.grid.spacing)
    np.testing.assert_array_equal(again.tissue.labels, one.tissue.labels)
    where = first._viewer.layers["t1"].data_to_world((1, 5, 6))
    np.testing.assert_allclose(other.layers["t1"].data_to_world((0, 5, 6)), where)
    np.testing.assert_allclose(second.solution.displacement, first.solution.displacement, atol=2e-3)


def test_the_overlay_and_the_arrows_are_saved_with_a_study_and_shown_again(
    stack, viewer, open_alone, wait_for, tmp_path
):
    stack.drawing, stack.model, stack.overlay = DRAWING, "elastic", "equivalent"
    stack.arrows = True
    wait_for(lambda: not stack.busy)
    path = stack.save_study(tmp_path / "case")
    stack.overlay, stack.arrows = "nothing", False
    open_alone(path)
    assert stack.overlay == "equivalent"
    assert stack.arrows
    (shown,) = (layer for layer in viewer.layers if "equivalent" in layer.name)
    assert shown.visible


def test_the_second_image_is_saved_with_a_study_and_opened_with_it(
    dock, viewer, wait_for, tmp_path, open_alone
):
    pixels = np.random.default_rng(0).integers(0, 200, (2, *SHAPE), dtype=np.uint8)
    place = {"scale": (0.5, 0.8), "units": ("mm", "mm")}
    viewer.add_image(pixels[0], name="before", **place)
    after = viewer.add_image(pixels[1], name="after", **place)
    wait_for(lambda: not dock.busy)
    assert dock.compare_with is after
    path = dock.save_study(tmp_path / "pair")
    assert read_study(path).solution is None
    open_alone(path)
    second = dock.compare_with
    assert (dock.image.name, second.name, second.visible) == ("before", "after", False)
    np.testing.assert_array_equal(second.data, pixels[1])
    assert second.contrast_limits == after.contrast_limits, "equal brightness looks equal"
    np.testing.assert_allclose(second.data_to_world((3, 4)), after.data_to_world((3, 4)))
    second.translate = (1000, 0)
    again = dock.save_study(tmp_path / "again")
    assert "It lacks the second image: 'after' does not cover the image" in dock.status
    open_alone(again)
    assert dock.compare_with is None


def test_a_study_without_a_known_overlay_leaves_the_chosen_overlay(dock, tmp_path):
    study = Study(Grid(SHAPE, (1.0, 1.0)), pictures=Pictures(np.ones(SHAPE), name="t1"))
    dock.overlay = "magnitude"
    dock.open_study(write_study(tmp_path / "case", study, overlay="of a later version"))
    assert dock.overlay == "magnitude"


def test_studies_of_several_slices_are_opened_at_their_places(dock, viewer, wait_for, tmp_path):
    order, paths, drawings = (1, 0, 2), {}, {}
    pixels = np.random.default_rng(0).random((30, 36, 44))
    viewer.add_image(pixels, name="t1", scale=(3.0, 0.5, 0.8), units=("mm",) * 3)
    viewer.dims.order = order
    for at in (0, 2):
        viewer.dims.set_current_step(order[0], at)
        wait_for(lambda: not dock.busy)
        drawings[at] = Drawing((Arrow((15, 20 + at), (0, 1.0 + at), 3.0),))
        dock.drawing = drawings[at]
        wait_for(lambda: not dock.busy)
        paths[at] = dock.save_study(tmp_path / f"slice{at}")
    viewer.layers.clear()
    for at in (0, 2):
        dock.open_study(paths[at])
        wait_for(lambda: not dock.busy)
        assert dock.drawing == drawings[at]
        assert dock.shown.motion.drawing == drawings[at]
    images = [layer for layer in viewer.layers if layer.name in ("t1", "t1 [1]")]
    dock.image = images[0]
    viewer.dims.set_point(order[0], images[0].data_to_world((0, 0, 0))[order[0]])
    wait_for(lambda: not dock.busy)
    assert dock.drawing == drawings[0], "the drawing of the displayed slice was lost"


def test_a_study_without_an_image_is_opened_beside_an_image(dock, viewer, wait_for, tmp_path):
    labels = np.ones(SHAPE, np.uint8)
    tissue = Tissue(labels=labels, materials=(Material(1, "gel", 1.0),))
    study = Study(Grid(SHAPE, (1.0, 1.0)), tissue, Motion(hold_edge=True, drawing=DRAWING))
    path = write_study(tmp_path / "gel", study)
    viewer.add_image(np.random.default_rng(0).random(SHAPE), name="photo")
    dock.open_study(path)
    wait_for(lambda: not dock.busy)
    assert (dock.image, dock.drawing) == (None, DRAWING)
    assert dock.shown.motion.drawing == DRAWING


@pytest.mark.parametrize("moves", [True, False])
def test_opening_a_study_adds_no_undo_step_and_shows_paint_only_without_motion(
    dock, viewer, open_alone, wait_for, tmp_path, moves
):
    viewer.add_image(np.random.default_rng(0).random(SHAPE), name="photo")
    curve = dock.tissue_from_intensity()
    drawing = DRAWING if moves else Drawing()
    if moves:
        dock.drawing = drawing
    wait_for(lambda: not dock.busy)
    path = dock.save_study(tmp_path / "case")
    open_alone(path)
    assert dock.curve == curve
    (map_of_stiffness,) = (each for each in viewer.layers if "stiffness" in each.name)
    assert map_of_stiffness.visible != moves
    dock.undo()
    assert dock.status == "There is nothing to undo."
    assert dock.drawing == drawing
    labels = Tissue(labels=np.ones(SHAPE, np.uint8), materials=(Material(1, "gel", 1.0),))
    motion = Motion(hold_edge=True, drawing=drawing)
    pictures = Pictures(np.ones(SHAPE), name="image")
    study = Study(Grid(SHAPE, (1.0, 1.0)), labels, motion, pictures=pictures)
    dock.open_study(write_study(tmp_path / "painted", study))
    assert viewer.layers["Tissue"].visible != moves


def test_a_slice_opened_and_saved_again_retains_its_place_in_the_volume(
    stack, viewer, open_alone, run, tmp_path
):
    run(stack)
    corner = viewer.layers["t1"].data_to_world((1, 0, 0))
    path = stack.save_study(tmp_path / "case")
    assert read_study(path).study.grid.place.index[0] == 1, (
        "the slice does not store its number in the stack"
    )
    open_alone(path)
    run(stack)
    again = stack.save_study(tmp_path / "again")
    for each in (path, again):
        place = geometry_of(read_study(each).solution)
        np.testing.assert_allclose(place.origin[::-1], corner)
        np.testing.assert_allclose(place.spacing, (3.0, 0.5, 0.8))


def test_a_field_of_a_cold_start_is_replayed_bit_by_bit(stack, run, tmp_path):
    run(stack)
    path = stack.save_study(tmp_path / "case")
    saved = read_study(path).solution
    assert saved.provenance.backend == "cpu"
    assert np.array_equal(replay(path).displacement, saved.displacement)


def test_a_field_of_a_warm_start_is_replayed_within_its_tolerance(
    dock, viewer, wait_for, tmp_path, capsys
):
    viewer.add_image(np.full(SHAPE, 100, np.uint8), name="photo")
    for col in (14, 20, 23):
        dock.drawing = Drawing((Arrow(at=(18, col), by=(0.5, 2.0), radius=2.0),))
        wait_for(lambda: not dock.busy)
    path = dock.save_study(tmp_path / "case")
    study, saved = read_study(path)
    apart = np.abs(replay(path).displacement - saved.displacement).max()
    assert 0 < apart < 0.002, "the field of a warm start is equal or too different"
    assert main(["replay", str(path)]) == 0
    assert "the same field within its tolerance" in capsys.readouterr().out
    other = replace(saved, displacement=saved.displacement + np.float32(0.01))
    assert main(["replay", str(write_study(path, study, other))]) == 1
    assert "fields differ by at most" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("tissue", "model"),
    [
        (Tissue(curve=StiffnessCurve(((0.0, 1.0), (255.0, 9.0)), unit="kPa")), "paper"),
        (
            Tissue(stiffness=np.linspace(1, 2, 36 * 44).reshape(SHAPE).astype(np.float32)),
            "elastic",
        ),
        (Tissue(), "paper, converged"),
    ],
    ids=["curve", "stiffness", "image"],
)
def test_a_study_made_in_python_is_opened_in_the_window(dock, wait_for, tmp_path, tissue, model):
    image = np.random.default_rng(0).integers(50, 200, SHAPE, dtype=np.uint8)
    motion = Motion(hold_edge=True, drawing=Drawing(DRAWING.marks[:1]))
    grid = Grid(SHAPE, (0.5, 0.8), "millimeter")
    study = Study(grid, tissue, motion, model=model, pictures=Pictures(image, name="photo"))
    dock.open_study(write_study(tmp_path / "case", study))
    wait_for(lambda: not dock.busy)
    assert dock.model == model
    read = dock.study
    assert (read.prior, read.optimizer) == (study.prior, study.optimizer)
    assert read.tissue.curve == tissue.curve
    assert read.motion.drawing == motion.drawing
    assert read.grid.spacing == grid.spacing
    np.testing.assert_array_equal(read.pictures.image, image)


def test_an_observed_field_is_opened_as_arrows_with_its_confidence(dock, wait_for, tmp_path):
    y = np.random.default_rng(1).normal(size=(*SHAPE, 2)).astype(np.float32)
    c = np.zeros(SHAPE, np.float32)
    c[::6, ::6] = 0.5
    image = np.full(SHAPE, 100, np.uint8)
    study = Study(
        Grid(SHAPE, (1.0, 1.0)), motion=Motion(observed=y, confidence=c), pictures=Pictures(image)
    )
    dock.open_study(write_study(tmp_path / "case", study))
    wait_for(lambda: not dock.busy)
    read = dock.study.motion
    there = c > 0
    np.testing.assert_allclose(read.observed[there], y[there], atol=1e-5)
    np.testing.assert_allclose(read.confidence[there], 0.5)
    assert not read.confidence[~there].any()


def test_a_study_with_an_invalid_place_adds_no_layer(dock, viewer, tmp_path):
    grid = Grid(SHAPE, (1.0, 1.0), "mm", Frame.at((1.0, 1.0), ("mm", "mm")))
    path = write_study(tmp_path / "case", Study(grid, pictures=Pictures(np.ones(SHAPE))))
    with np.load(path) as parts:
        header = json.loads(str(parts["header"]))
        header["study"]["grid"]["place"]["plane"] = [0, 7]
        with open(tmp_path / "case.study", "wb") as file:
            np.savez(file, **{**parts, "header": np.array(json.dumps(header))})
    with pytest.raises(FileFormatError, match=r"case\.study: .* study\.grid\.place: its plane"):
        dock.open_study(path)
    assert not viewer.layers


def test_a_message_reports_landmarks_that_were_not_imported_before_saving(dock, viewer, tmp_path):
    viewer.add_image(np.full(SHAPE, 100, np.uint8), name="photo")
    dock.live = False
    viewer.add_points([[10, 10], [20, 30]], name="is")
    viewer.add_points([[11, 10], [20, 32]], name="ought")
    path, screen = tmp_path / "case.study", Screen(dock)
    dock._form.motion.landmarks.sources.value = None
    dock.save_study(path)
    assert "andmarks" not in dock.status, "none are chosen"
    screen.choose("is")
    dock.save_study(path)
    assert "andmarks" not in dock.status
    assert len(read_study(path).study.motion.drawing.marks) == 2
    viewer.layers["ought"].data = [[11, 10], [20, 33]]
    dock.save_study(path)
    assert "It lacks the landmarks of 'is': press 'Use as landmarks'" in dock.status
    screen.press("Use as landmarks")
    dock.save_study(path)
    assert "andmarks" not in dock.status


def test_a_study_is_saved_before_it_has_a_result(dock, viewer, wait_for, tmp_path, monkeypatch):
    path = tmp_path / "begun.study"
    screen = Screen(dock)
    assert not screen.button("Save study ...").isEnabled()
    viewer.add_image(np.full(SHAPE, 100, np.uint8), name="photo")
    dock.live = False
    wait_for(lambda: not dock.busy)
    dock.drawing = DRAWING
    assert dock.solution is None
    typed = iter([path, path.with_suffix(""), path.with_suffix(".zip")])
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(next(typed)), ""))
    screen.press("Save study ...")
    assert dock.status.startswith("Saved begun.study without a field")
    screen.press("Save study ...")
    assert "begun.study exists" in dock.status
    screen.press("Save study ...")
    assert "Saved begun.zip.study" in dock.status, "napari opens no study of another ending"
    study, solution = read_study(path)
    assert solution is None
    assert study.motion.drawing == DRAWING


def test_a_result_with_held_patches_is_saved_with_its_drawing(dock, viewer, wait_for, tmp_path):
    viewer.add_image(np.random.default_rng(0).random((48, 56)), name="MR")
    motion = PatchMotion((8, 8), 1, (33, 33), np.linspace(0, 1, 2 * 33**2))
    dock.drawing = Drawing([Arrow((24, 28), (0, 0), 14.0, motion=motion)] * 40)
    wait_for(lambda: dock.solution is not None and not dock.busy)
    (arrows,) = (each for each in viewer.layers if each.name.startswith("MR arrows, elastic"))
    attributes = {"name": arrows.name, "metadata": arrows.metadata}
    (path,) = write_solution(str(tmp_path / "held.npz"), arrows.data, attributes)
    solution = Solution.read(path)
    moved = dock.solution.displacement
    np.testing.assert_array_equal(solution.displacement, moved)
    assert Drawing.from_dict(solution.frame["drawing"]) == dock.drawing
    dock.save_study(tmp_path / "held.study")
    study, solved = read_study(tmp_path / "held.study")
    assert study.motion.drawing == dock.drawing
    np.testing.assert_array_equal(solved.displacement, moved)
