"""Tests of the display of a result: slider, overlays, status bar and pictures."""

from dataclasses import replace
from functools import partial
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from napari.layers import Image, Labels, Vectors
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QApplication
from vispy.visuals import AxisVisual

from napari_hmrf import Problem, SeilerPrior, solve
from napari_hmrf.contributions import open_solution
from napari_hmrf.field.colormaps import reach_of
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.strain import fold_mask, green_lagrange_strain
from napari_hmrf.field.warp import warp
from napari_hmrf.io.figures import jacobian_picture, magnitude_picture, strain_picture
from napari_hmrf.layers.compat import camera_of, scale_bar_of
from napari_hmrf.layers.metadata import METADATA, metadata_of
from napari_hmrf.results.quantities import coloured
from napari_hmrf.results.tissue_point import Probe, at_point
from napari_hmrf.solver.optimizers import ICM
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.ui.result.cursor import stiffness_of
from napari_hmrf.ui.result.moving_layers import how_far
from tests.support.docks import quick, viewer_of
from tests.support.person import SHIFT
from tests.support.screen import Screen
from tests.support.windowless import Touch


def names(viewer):
    return [layer.name for layer in viewer.layers]


@pytest.fixture
def deformed(widget, small_sample, run):
    """Return the dock with a result: gel fixed at the left and pushed right by 3 px."""
    small_sample(viewer_of(widget))
    widget.settings = replace(widget.settings, sweeps=60)
    run(widget)
    return widget


@pytest.fixture
def look(deformed, wait_for):
    """Return the dock with a result after all of its layers are drawn."""
    wait_for(lambda: not deformed.busy)
    return deformed


@pytest.fixture
def set_to(wait_for):
    """Return a function that sets attributes of the dock and waits for the update."""

    def set_and_wait(look, **choices):
        for name, choice in choices.items():
            setattr(look, name, choice)
        wait_for(lambda: not look.busy)

    return set_and_wait


def column_of_edge(layer, row=10):
    """Return the last column with tissue, in moved labels."""
    return int(np.flatnonzero(layer.data[row]).max())


# Selection of a result


def test_the_newest_result_and_its_image_are_selected(look):
    viewer = viewer_of(look)
    assert look.result is viewer.layers["MR arrows, paper"]
    assert look.image is viewer.layers["MR"]
    assert look.percent == 100
    assert "100 %: tissue moved up to 3 px" in look._form.result.how_far.value


def test_a_missing_result_causes_a_hint_and_a_new_result_is_selected(
    widget, small_sample, run, wait_for
):
    small_sample(viewer_of(widget))
    look = widget
    assert look.result is None
    assert not look._form.result.slider.enabled
    look.play()
    assert look.status.startswith("There is no result yet: pull tissue")
    look.percent = 30
    look.overlay = "jacobian"
    assert not look.playing
    run(widget)
    wait_for(lambda: not look.busy)
    assert look.result is viewer_of(widget).layers["MR arrows, paper"]
    assert look._form.result.slider.enabled
    assert look.status.startswith("Tissue moved up to 3")
    assert look.overlay == "jacobian", "the overlay chosen before the result was lost"
    assert "MR area change (ratio), paper" in names(viewer_of(widget))


def test_the_slider_moves_a_renamed_image(look, set_to):
    viewer = viewer_of(look)
    viewer.layers["MR"].name = "T1"
    viewer.add_image(np.zeros((7, 7)), name="small")
    set_to(look, percent=0)
    np.testing.assert_array_equal(
        viewer.layers["MR deformed, paper"].data, viewer.layers["T1"].data
    )


# The slider


def test_half_of_the_deformation_warps_the_image_by_half_the_displacement(look, set_to):
    viewer = viewer_of(look)
    solution = metadata_of(look.result)["solution"]
    image, moved = viewer.layers["MR"], viewer.layers["MR deformed, paper"]
    whole, layers = moved.data.copy(), names(viewer)
    set_to(look, percent=50)
    expected = warp(image.data, solution.displacement / 2, spacing=1, tissue=solution.tissue)
    np.testing.assert_array_equal(moved.data, expected)
    assert metadata_of(moved)["percent"] == 50
    assert "50 %: tissue moved up to 1.5 px" in look._form.result.how_far.value
    set_to(look, percent=0)
    np.testing.assert_array_equal(moved.data, image.data)
    set_to(look, percent=100)
    np.testing.assert_array_equal(moved.data, whole)
    assert names(viewer) == layers


def end_of(grid):
    """Return the last column of a grid."""
    return grid.data.sum(axis=1)[:, 1].max()


def test_labels_and_grid_move_with_the_slider(look, set_to):
    viewer = viewer_of(look)
    set_to(look, overlay="labels")
    labels = viewer.layers["Tissue deformed, paper"]
    assert column_of_edge(labels) == 24 - 1  # Pushed by 3 px to the edge of the image.
    set_to(look, percent=0)
    assert column_of_edge(labels) == 21
    set_to(look, overlay="grid")
    assert labels not in viewer.layers, "two overlays are displayed"
    grid = viewer.layers["MR grid, paper"]
    assert end_of(grid) == 21, "the grid is not at the position of the slider"
    set_to(look, percent=100)
    assert end_of(grid) == pytest.approx(21 + 3, abs=0.1)
    set_to(look, overlay="nothing", percent=0)
    assert grid not in viewer.layers
    set_to(look, overlay="grid")
    set_to(look, percent=100)
    assert end_of(viewer.layers["MR grid, paper"]) == pytest.approx(21 + 3, abs=0.1)


def test_playing_moves_back_and_forth_until_it_is_paused(look, wait_for, monkeypatch):
    # This clock advances by a tenth of the period at each reading, on any machine.
    clock = SimpleNamespace(monotonic=partial(next, count(0.0, 0.1)))
    monkeypatch.setattr("napari_hmrf.ui.result.moving_layers.time", clock)
    monkeypatch.setattr("napari_hmrf.ui.result.moving_layers.SECONDS", 1.0)
    seen = []
    look._view.player.moved.connect(seen.append)
    look._form.result.play.native.click()
    assert look.playing
    assert look._form.result.play.text == "Pause"
    wait_for(lambda: len(seen) > 8 and min(seen) < 30 and max(seen[seen.index(min(seen)) :]) > 60)
    assert np.abs(np.diff([100, *seen])).max() <= 12, "the percentage jumps"
    look._form.result.play.native.click()
    assert not look.playing
    assert look._form.result.play.text == "Play"
    wait_for(lambda: not look.busy)
    assert (
        metadata_of(viewer_of(look).layers["MR deformed, paper"])["percent"]
        == look.percent
        == seen[-1]
    )


def test_the_picture_is_never_behind_the_slider_while_playing(look, wait_for):
    view, seen = look._view, []
    view.player.moved.connect(lambda percent: seen.append((percent, view.shown.percent)))
    look.play()
    wait_for(lambda: len(seen) > 5)
    look.pause()
    assert [slider for slider, _ in seen] == [picture for _, picture in seen]


def test_dragging_the_slider_pauses_the_player(look, wait_for):
    look.play()
    wait_for(lambda: look.percent < 100)
    look.percent = 70
    wait_for(lambda: not look.busy)
    assert not look.playing
    assert look.percent == 70


def test_a_slow_computation_does_not_block_the_window(look, busy_thread, wait_for):
    before = viewer_of(look).layers["MR deformed, paper"].data
    for percent in (10, 20, 30, 40):
        look.percent = percent  # This assignment would block if it waited for the compute thread.
        QApplication.processEvents()
    assert viewer_of(look).layers["MR deformed, paper"].data is before
    assert look.busy
    busy_thread.set()
    wait_for(lambda: not look.busy)
    assert metadata_of(viewer_of(look).layers["MR deformed, paper"])["percent"] == 40


def test_a_new_result_is_shown_at_full_motion_and_replaces_the_old_one(look, run, set_to, wait_for):
    set_to(look, percent=50, overlay="magnitude")
    look.rules = (look.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    outputs = run(look)
    wait_for(lambda: not look.busy and look.percent == 100)
    moved = viewer_of(look).layers["MR deformed, paper"]
    np.testing.assert_array_equal(moved.data, outputs.layers["image"].data)
    assert "up to 1 px" in look._form.result.how_far.value
    assert viewer_of(look).layers["MR displacement (px), paper"].contrast_limits == [0, 1]
    set_to(look, percent=99)
    set_to(look, percent=100)
    np.testing.assert_array_equal(moved.data, outputs.layers["image"].data)


# Before and after


def test_the_undeformed_image_is_shown_while_the_button_is_pressed(look, set_to, qtbot):
    viewer = viewer_of(look)
    image, moved, arrows = (
        viewer.layers[name] for name in ("MR", "MR deformed, paper", "MR arrows, paper")
    )
    set_to(look, overlay="labels")
    look.arrows = True
    labels = viewer.layers["Tissue deformed, paper"]
    labels.visible = False
    button = look._form.result.before.native
    qtbot.mousePress(button, Qt.MouseButton.LeftButton)
    assert look.before
    assert image.visible
    assert not moved.visible
    assert not arrows.visible
    qtbot.mouseRelease(button, Qt.MouseButton.LeftButton)
    assert not look.before
    assert moved.visible
    assert arrows.visible
    assert not labels.visible


def test_a_pending_frame_is_not_drawn_over_a_newer_overlay(look, set_to):
    viewer = viewer_of(look)
    set_to(look, overlay="grid", percent=50)
    look.percent = 20
    set_to(look, overlay="labels")
    labels = viewer.layers["Tissue deformed, paper"]
    assert metadata_of(labels)["percent"] == look.percent == 20
    assert "MR grid, paper" not in names(viewer)


def test_an_overlay_removed_by_the_user_is_deselected(look, run, set_to):
    viewer = viewer_of(look)
    set_to(look, overlay="grid")
    viewer.layers.remove("MR grid, paper")
    assert look.overlay == "nothing"
    run(look)
    set_to(look)
    assert "MR grid, paper" not in names(viewer)


def test_an_overlay_hidden_by_the_user_is_updated_and_remains_hidden(look, run, set_to):
    viewer = viewer_of(look)
    set_to(look, overlay="magnitude")
    layer = viewer.layers["MR displacement (px), paper"]
    layer.visible = False
    look.rules = (look.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    run(look)
    set_to(look)
    assert (look.overlay, layer.visible) == ("magnitude", False)
    assert np.nanmax(layer.data) == pytest.approx(1, abs=0.01), (
        "the hidden overlay shows an earlier result"
    )
    set_to(look, overlay="jacobian")
    assert layer.visible, "the chosen overlay is hidden"


def test_a_key_shows_the_undeformed_image(look):
    viewer = viewer_of(look)
    (action,) = [held for key, held in viewer.keymap.items() if str(key) == "Shift+B"]
    holding = action(viewer)
    next(holding)
    assert look.before
    next(holding, None)
    assert not look.before


# Arrows and colours


def test_the_length_of_arrows_set_in_napari_is_preserved(look, run, wait_for):
    arrows = look.result
    arrows.length = 4
    look.rules = (look.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    run(look)
    wait_for(lambda: not look.busy)
    assert look.result is arrows
    assert arrows.length == 4, "the length was reset by the next result"


def test_colours_show_displacement_area_change_and_strain(look, set_to):
    viewer = viewer_of(look)
    solution = metadata_of(look.result)["solution"]
    set_to(look, overlay="magnitude")
    layer = viewer.layers["MR displacement (px), paper"]
    assert layer.data.dtype == np.float32
    np.testing.assert_allclose(layer.data, lengths_of(solution, 1.0))
    assert layer.contrast_limits == [0, 3]
    set_to(look, overlay="jacobian")
    assert layer.name == "MR area change (ratio), paper"
    inside = layer.data[10, 5:19]
    assert ((inside > 1.02) & (inside < 1.4)).all(), "the area of the pulled block does not grow"
    low, high = layer.contrast_limits
    assert low + high == pytest.approx(2), "an unchanged area is not at the middle of the scale"
    set_to(look, overlay="columns")
    assert layer.name == "MR in-plane strain from column to column (%), paper"
    np.testing.assert_allclose(layer.data[10, 5:19], 50 * (inside**2 - 1), atol=2)
    layer.name = "mine"
    set_to(look, overlay="equivalent")
    assert layer.name == "mine"
    assert layer.contrast_limits[0] == 0
    set_to(look, overlay="nothing")
    assert layer in viewer.layers, "a layer renamed by the user was removed"
    assert not layer.visible
    with pytest.raises(ValueError, match=r"'heat' is not a valid choice.*'nothing', 'magnitude'"):
        look.overlay = "heat"


def test_paint_is_hidden_below_the_colours_of_a_result(look, run, set_to):
    viewer = viewer_of(look)
    for paint in ("Tissue", "Boundary"):
        viewer.layers[paint].visible = True
    set_to(look, overlay="labels")
    for paint in ("Tissue", "Boundary"):
        assert not viewer.layers[paint].visible, "paint tints transparent colours"
    name = "Tissue deformed, paper"
    assert names(viewer)[-2:] == [name, "MR arrows, paper"], "colours cover the arrows"
    for layer in (viewer.layers["Tissue"], viewer.layers["Boundary"]):
        viewer.layers.move(viewer.layers.index(layer), len(viewer.layers))
    look.rules = (look.rules[0], BoundaryRule(2, "move", vector=(0.0, 1.0)))
    run(look)
    set_to(look)
    assert names(viewer)[-1] == name


def test_one_overlay_is_shown_at_a_time(look, set_to):
    viewer = viewer_of(look)
    before = names(viewer)
    for name, shown in (
        ("grid", "MR grid, paper"),
        ("stiffness", "MR stiffness (kPa), paper"),
        ("jacobian", "MR area change (ratio), paper"),
        ("labels", "Tissue deformed, paper"),
        ("observed", "MR given motion, paper"),
        ("confidence", "MR confidence (0 to 1), paper"),
    ):
        set_to(look, overlay=name)
        assert set(names(viewer)) - set(before) == {shown}
        assert viewer.layers[shown].visible
        assert look.overlay == name
    limits = viewer.layers["MR confidence (0 to 1), paper"].contrast_limits
    assert limits == [0, 1], "the scale of the earlier overlay was not replaced"
    set_to(look, overlay="nothing")
    assert names(viewer) == before


def test_a_missing_quantity_is_reported_and_adds_no_layer(look, set_to):
    viewer = viewer_of(look)
    before = names(viewer)
    set_to(look, overlay="jacobian")
    set_to(look, overlay="folds")
    assert look.status == "The tissue does not fold, and no part of it has moved onto another part."
    assert names(viewer) == before


def test_arrows_end_at_the_displayed_position_of_the_tissue(look, set_to):
    arrows = look.result
    stored = arrows.data.copy()
    set_to(look, percent=28)
    assert arrows.length == pytest.approx(0.28)
    arrows.length = 0.56  # As set with napari's control.
    set_to(look, percent=50)
    assert arrows.length == pytest.approx(1)
    set_to(look, percent=0)
    assert arrows.length == 0
    set_to(look, percent=100)
    assert arrows.length == pytest.approx(2)
    np.testing.assert_array_equal(arrows.data, stored)
    set_to(look, percent=50)
    look._view.rest()
    assert arrows.length == pytest.approx(2)


def test_a_scale_key_is_shown_while_arrows_are_to_scale(look, set_to):
    bar, arrows, text = scale_bar_of(viewer_of(look)), look.result, look._form.result.how_far
    assert not bar.visible
    look.arrows = True
    assert bar.visible
    assert bar.position == "bottom_left"
    set_to(look, percent=50)
    assert bar.visible, "shorter arrows show the displacement at 50 %"
    set_to(look, percent=100)
    arrows.length = 4
    assert not bar.visible
    assert "Arrows are drawn 4 times as long as the motion" in text.value
    arrows.length = 1
    assert bar.visible
    assert "Arrows are drawn" not in text.value
    arrows.visible = False
    assert not bar.visible
    assert not look.arrows, "the check box does not follow the eye of the layer"
    arrows.visible = True
    assert look.arrows
    bar.visible = False
    arrows.visible = False
    arrows.visible = True
    assert not bar.visible, "the user's choice was changed"


def test_arrows_follow_the_slider_before_the_pictures_are_computed(look, set_to, monkeypatch):
    arrows, jobs = look.result, []
    monkeypatch.setattr(look._view.player._jobs, "submit", lambda *job: jobs.append(job))
    look.percent = 30
    assert arrows.length == pytest.approx(0.3)
    assert jobs


@pytest.mark.parametrize("largest", [0.00042, 0.43, 0.97, 8.3, 96, 450])
def test_a_colour_bar_has_numbers_on_both_sides_of_zero(largest):
    """Check vispy's ticks, which might show only the 0 between the ends of the scale."""
    reach = reach_of(np.array([largest]), signed=True, least=1e-6)
    assert largest <= reach <= 1.5 * largest
    bar = AxisVisual(pos=np.array([[1, 1], [1, 0]]), domain=(-reach, reach))
    bar.transforms.dpi = 96.0
    assert len(bar.ticker._get_tick_frac_labels()[2]) >= 3


def test_colours_move_with_the_tissue(look, set_to):
    set_to(look, overlay="magnitude")
    layer = viewer_of(look).layers["MR displacement (px), paper"]
    assert column_of_edge_of_colours(layer) == 23
    set_to(look, percent=0)
    assert column_of_edge_of_colours(layer) == 21


def column_of_edge_of_colours(layer):
    return int(np.flatnonzero(np.isfinite(layer.data[10])).max())


def test_colours_show_the_displayed_part_of_the_motion_on_a_fixed_scale(look, set_to):
    set_to(look, overlay="magnitude")
    layer = viewer_of(look).layers["MR displacement (px), paper"]
    solution = metadata_of(look.result)["solution"]
    for percent in (50, 0, 100):
        set_to(look, percent=percent)
        np.testing.assert_allclose(layer.data, lengths_of(solution, percent / 100), rtol=1e-5)
        assert layer.contrast_limits == [0, 3], "the scale changes with the part of the motion"
    set_to(look, overlay="columns", percent=50)
    values = viewer_of(look).layers["MR in-plane strain from column to column (%), paper"].data
    half = replace(solution, displacement=solution.displacement / 2)
    assert np.nanmax(values) == np.nanmax(coloured(half, "columns").values)


def lengths_of(solution, part):
    """Return the displacement after a part of the motion, at the displayed position of tissue."""
    lengths = part * np.linalg.norm(solution.displacement, axis=-1)
    lengths[~solution.tissue] = np.nan
    d = part * solution.displacement
    return warp(lengths, d, spacing=1, tissue=solution.tissue, order=0, fill=np.nan)


def test_inputs_are_shown_at_the_displayed_position_of_the_tissue(look, set_to):
    for overlay, name in (
        ("stiffness", "MR stiffness (kPa), paper"),
        ("confidence", "MR confidence"),
    ):
        set_to(look, overlay=overlay, percent=100)
        (layer,) = (each for each in viewer_of(look).layers if each.name.startswith(name))
        moved = layer.data
        set_to(look, percent=0)
        problem = metadata_of(look.result)["answer"].problem
        given = problem.stiffness if overlay == "stiffness" else problem.confidence.max(axis=-1)
        tissue = problem.stiffness > 0
        np.testing.assert_array_equal(layer.data[tissue], given[tissue])
        assert not np.array_equal(moved, layer.data)


def test_the_canvas_names_the_quantity_and_unit_of_an_overlay(look, set_to):
    set_to(look, overlay="equivalent")
    layer = viewer_of(look).layers["MR equivalent in-plane strain (%), paper"]
    if not hasattr(layer, "name_overlay"):
        pytest.skip("napari before 0.9 draws no layer names on the canvas")
    assert layer.name_overlay.visible
    assert layer.name_overlay.position == layer.colorbar.position
    assert layer.name_overlay.position == "top_left", "a narrow canvas cuts the beginning"
    set_to(look, overlay="observed")
    assert viewer_of(look).layers["MR given motion, paper"].name_overlay.visible


def test_folds_are_reported_and_marked(widget, small_sample, run, set_to):
    small_sample(viewer_of(widget))
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -40.0)))
    widget.settings = replace(widget.settings, sweeps=60)
    outputs = run(widget)
    set_to(widget, overlay="jacobian")
    assert f"at {outputs.folds} pixels" in widget.warning
    assert "the tissue folds" in widget.warning
    layer = viewer_of(widget).layers["MR area change (ratio; blue: folded), paper"]
    solution = outputs.solution
    folded = coloured(solution, "jacobian").values <= 0
    assert folded.sum() == outputs.folds
    moved = warp(folded, solution.displacement, spacing=1, tissue=solution.tissue, order=0)
    np.testing.assert_array_equal(layer.data <= 0, moved)
    assert layer.contrast_limits == [0, 2], (
        "sites without a fold are at the lower limit, or folds are not"
    )
    values = coloured(solution, "jacobian").values
    said = f". Colours end at 0 (values to {np.nanmin(values):.3g})"
    assert said in widget._form.result.how_far.value
    set_to(widget, overlay="nothing")
    assert "Colours end" not in widget._form.result.how_far.value
    np.testing.assert_allclose(layer.colormap.low_color, (0, 0.314, 1, 1), atol=0.01)
    assert layer.colormap.map(np.array([1.0]))[0, :3] == pytest.approx((0.5, 0.23, 0.03), abs=0.05)


def test_folds_are_visible_at_a_low_zoom(widget, small_sample, run, set_to, wait_for):
    viewer = viewer_of(widget)
    small_sample(viewer)
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -40.0)))
    widget.settings = replace(widget.settings, sweeps=60)
    run(widget)
    set_to(widget, overlay="folds")
    (layer,) = (each for each in viewer.layers if "folds" in each.name)
    exact = layer.data.copy()
    camera_of(viewer).zoom = 0.5
    wait_for(lambda: layer.data.sum() > exact.sum())
    assert layer.data[exact > 0].all()
    set_to(widget, percent=60)
    set_to(widget, percent=100)
    assert layer.data.sum() > exact.sum()
    camera_of(viewer).zoom = 10
    wait_for(lambda: np.array_equal(layer.data, exact))


def test_folds_are_drawn_and_named_as_folds_instead_of_strain(widget, small_sample, run, set_to):
    small_sample(viewer_of(widget))
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, -40.0)))
    widget.settings = replace(widget.settings, sweeps=60)
    solution = run(widget).solution
    for overlay, fold in (("squeeze", -np.inf), ("equivalent", np.inf)):
        set_to(widget, overlay=overlay)
        (layer,) = [each for each in viewer_of(widget).layers if "; blue: folded" in each.name]
        folds = layer.data == fold
        field = solution.displacement, solution.spacing, solution.tissue
        folded = fold_mask(field[0], spacing=field[1], tissue=field[2])
        moved = warp(folded, field[0], spacing=field[1], tissue=field[2], order=0)
        np.testing.assert_array_equal(folds, moved)
        end = np.clip(fold, *layer.contrast_limits)
        assert not (np.sign(fold) * (layer.data[~folds] - end) >= 0).any(), (
            "strain is drawn in the colour of folds"
        )
    site = tuple(np.argwhere(folded)[0])
    widget._view.cursor.at = lambda _: Probe(site, (0.0, 1.0), 1.0, -1.0, 2.0)
    assert "equivalent in-plane strain: folded" in widget._view.cursor.line_at(())
    set_to(widget, percent=1)
    assert not np.isinf(layer.data).any(), "nothing folds at 1 %"


# The status bar


def test_the_status_bar_describes_the_point_under_the_cursor(look):
    viewer = viewer_of(look)
    viewer.layers.selection.active = viewer.layers["MR"]
    viewer.mouse_over_canvas = True
    viewer.cursor.position = (10, 5.2)
    status = viewer.status["coordinates"]
    assert status.startswith("[10"), "the text of napari was removed"
    assert status.count("area change") == 1
    assert " right)" in status, "the direction is a sign instead of a word"
    assert "stiffness 20 kPa (gel)" in status
    viewer.cursor.position = (0, 0)
    assert "area change" not in str(viewer.status)
    viewer.layers.selection.clear()
    viewer.cursor.position = (10, 6)
    assert "stiffness 20 kPa (gel)" in viewer.status


@pytest.mark.parametrize("jacobian", [-0.25, 0.25])
def test_the_jacobian_of_a_fold_is_described_as_that_of_the_worst_corner(jacobian):
    probe = Probe((1, 2), (0.0, 3.0), 3.0, jacobian, 5.0)
    said = at_point("px", probe, Directions())
    assert f"area change x {jacobian:.3f}" in said
    assert said.endswith("(folds: value at the worst corner)") == (jacobian < 0)


def test_the_stiffness_of_rigid_tissue_is_described_by_a_word():
    assert stiffness_of("skull", np.inf, "kPa") == "rigid (skull)"
    assert stiffness_of("", np.inf, "kPa") == "rigid", (
        "an image of stiffness has no name of a material"
    )


def test_lengths_in_the_status_bar_are_rounded_to_significant_digits():
    def said(down, right):
        found = Probe((3, 4), (down, right), float(np.hypot(down, right)), 1.0, 0.0)
        return at_point("px", found, Directions())

    assert said(6.37e-05, -2.3e-04) == "moves 0 px, area change x 1.000"
    assert said(-3e-5, 1.2345) == "moves 1.23 px (1.23 right), area change x 1.000"
    assert said(-12.345, 0.0067) == "moves 12.3 px (12.3 up, 0.01 right), area change x 1.000"


@pytest.mark.parametrize(
    ("held", "moved", "said"),
    [
        (0.0, 2.32, "moves 2.32 px (2.32 right)"),
        (1.0, 2.32, "held at its target, moved 2.32 px (2.32 right)"),
        (1.0, 0.0, "held in place"),
        (0.5, 2.32, "held with confidence 0.5, moves 2.32 px (2.32 right)"),
    ],
)
def test_the_status_bar_says_how_tissue_is_held(held, moved, said):
    probe = Probe((3, 4), (0.0, moved), moved, 1.0, 0.0)
    line = at_point("px", probe, Directions(), held=held)
    assert line == f"{said}, area change x 1.000"


def test_the_status_bar_says_how_far_held_tissue_stays_short_of_its_target():
    probe = Probe((3, 4), (0.0, 0.42), 0.42, 1.0, 0.0)
    line = at_point("px", probe, Directions(), held=1.0, missing=31.2)
    assert line.startswith("moved 0.42 px (0.42 right), 31.2 px short of its target, ")
    close = at_point("px", probe, Directions(), held=1.0, missing=0.01)
    assert close.startswith("held at its target, moved 0.42 px")


def test_the_status_bar_says_that_the_tissue_under_the_cursor_is_held(look):
    line_at = look._view.cursor.line_at
    assert line_at((10, 2)).startswith("held in place")
    assert line_at((10, 23.49)).startswith("held at its target, moved 3 px (3 right)")
    assert line_at((10, 12)).startswith("moves ")


def test_the_status_bar_reads_the_origin_of_the_displayed_tissue(look, set_to):
    # The right border of the tissue was displaced by 3 px to the right.
    found = look.at((10, 23.49))
    assert found.site[1] == 21
    assert found.displacement[1] == pytest.approx(3, abs=0.05)
    set_to(look, percent=50)
    assert look.at((10, 22.5)).site[1] == 21
    set_to(look, percent=0)
    assert look.at((10, 22.5)) is None
    assert look.at((10, 21)).length == pytest.approx(3, abs=0.05)
    viewer_of(look).layers["MR deformed, paper"].visible = False
    assert look.at((-5, 3)) is None


def test_the_status_bar_shows_the_displayed_strain(look, set_to):
    def said():
        return look._view.cursor.line_at((10, 12))

    assert said().startswith("moves")
    look.before = True
    assert said().startswith("at 100 %: moves")
    look.before = False
    set_to(look, overlay="columns")
    solution = metadata_of(look.result)["solution"]
    along = green_lagrange_strain(
        solution.displacement, spacing=solution.spacing, tissue=solution.tissue
    )
    col = look.at((10, 12)).site[1]
    assert f"in-plane strain from column to column {100 * along[10, col, 1, 1]:.3g} %" in said()
    assert along[10, col, 1, 1] > 0.05, "the tissue is not stretched"
    for other in ("magnitude", "labels", "grid", "nothing"):
        set_to(look, overlay=other)
        assert "strain" not in said()


def test_the_status_bar_does_not_wait_for_the_compute_thread(look, busy_thread):
    look.percent = 50
    line = look._view.cursor.line_at((10.0, 12.0))
    assert line.startswith("moves"), "the line does not describe the last drawn frame"
    assert look.busy


# Stacks, files and photographs


def test_the_result_of_a_slice_moves_at_its_place_in_the_stack(make_stack, set_to):
    look, outputs = make_stack
    viewer = viewer_of(look)
    set_to(look, percent=50, overlay="jacobian")
    assert "MR area change (ratio), paper (z = 2)" in names(viewer)
    moved = viewer.layers["MR deformed, paper (z = 2)"]
    assert moved.data.shape == (1, 20, 24)
    solution = outputs.solution
    expected = warp(
        viewer.layers["MR"].data[2],
        solution.displacement / 2,
        spacing=solution.spacing,
        tissue=solution.tissue,
    )
    np.testing.assert_array_equal(moved.data[0], expected)
    assert look._form.result.how_far.value.endswith("mm in z = 2")
    assert look.at((6, 20, 2.5)) is not None
    assert look.at((3, 20, 2.5)) is None, "a point on another slice has a value"
    viewer.dims.set_current_step(0, 1)
    assert look._form.result.how_far.value.endswith("mm in z = 2")


def test_the_result_of_a_slice_can_be_removed_at_any_time(make_stack, wait_for):
    look, _ = make_stack
    viewer = viewer_of(look)
    wait_for(lambda: not look.busy)
    viewer.layers.remove("MR arrows, paper (z = 2)")
    wait_for(lambda: not look.busy)
    assert look.result is None
    assert look._form.result.how_far.value == ""


@pytest.fixture
def make_stack(widget, small_sample, run):
    viewer = viewer_of(widget)
    place = {"scale": (3.0, 2.0, 0.5), "units": ("mm",) * 3, "axis_labels": ("z", "y", "x")}
    small_sample(viewer, (4, 20, 24), **place)
    viewer.dims.set_current_step(0, 2)
    return widget, run(widget)


def test_a_saved_result_is_displayed_with_and_without_an_image(widget, tmp_path, set_to, wait_for):
    y, c = np.zeros((8, 9, 2)), np.zeros((8, 9, 2))
    c[:, 0] = c[:, -1] = 1
    y[:, -1] = (0, 2)
    path = str(
        solve(
            Problem(observed=y, confidence=c, stiffness=np.ones((8, 9))),
            SeilerPrior(),
            optimizer=ICM(20),
            backend="cpu",
        ).write(tmp_path / "kept.npz")
    )
    ((data, attributes, _),) = open_solution(path)(path)
    viewer = viewer_of(widget)
    viewer.add_vectors(data, **attributes)
    look = widget
    wait_for(lambda: not look.busy)
    look.percent = 50
    assert look.status.startswith("Open the image of this result")
    set_to(look, overlay="stiffness")
    assert look.status.startswith("A result file does not contain the input stiffness")
    set_to(look, overlay="magnitude")
    assert "displacement (px), paper" in names(viewer)
    set_to(look, percent=40)
    viewer.add_image(np.arange(72.0).reshape(8, 9), name="late")
    set_to(look, percent=50)
    assert metadata_of(viewer.layers["late deformed, paper"])["percent"] == 50


# Pictures


def test_a_picture_has_the_colour_scale_of_the_viewer(look):
    result = look._view.shown.answer
    for quantity, drawn in (
        ("jacobian", jacobian_picture),
        ("equivalent", strain_picture),
        ("magnitude", magnitude_picture),
    ):
        (map_, *_) = drawn(result.solution).axes[0].images
        seen = coloured(result.solution, quantity).limits
        assert map_.get_clim() == pytest.approx(seen)


def test_saving_pictures_does_not_block_the_window(look, busy_thread, tmp_path, wait_for):
    got = []
    look.saved.connect(got.append)
    look.save_pictures(tmp_path)
    assert not got
    busy_thread.set()
    wait_for(lambda: bool(got))
    assert sorted(path.stem for path in got[0]) == sorted(
        ["displacement", "warped", "grid", "magnitude", "jacobian", "strain", "energy"]
    )
    assert all(path.stat().st_size > 5000 for path in got[0])
    assert look.status.startswith(f"Saved in {tmp_path}")


def test_a_missing_folder_is_named_in_the_status(look, tmp_path, wait_for):
    look.save_pictures(tmp_path / "nowhere")
    wait_for(lambda: not look.busy)
    assert "nowhere" in look.status


# Removed layers and closed windows


def test_the_undeformed_view_has_no_effect_without_a_result(widget):
    viewer, look = viewer_of(widget), widget
    image = viewer.add_image(np.zeros((8, 9)), visible=False)
    Touch(viewer).key(Qt.Key.Key_B, SHIFT)
    look.before = True
    assert not look.before
    assert not image.visible


def test_a_deselected_result_is_not_hidden(look):
    viewer = viewer_of(look)
    look.result = None
    seen = [layer.visible for layer in viewer.layers]
    look.before = True
    assert [layer.visible for layer in viewer.layers] == seen


def test_layers_of_a_result_can_be_removed_at_any_time(look, set_to, wait_for):
    viewer = viewer_of(look)
    look.play()
    wait_for(lambda: look.percent < 98)
    viewer.layers.remove("MR deformed, paper")
    QApplication.processEvents()
    viewer.layers.remove("MR")
    look.overlay = "jacobian"
    viewer.layers.remove("MR arrows, paper")
    wait_for(lambda: not look.busy)
    assert look.result is None
    assert not look.playing
    assert look.at((10, 10)) is None


def test_removing_the_arrows_shows_that_they_contain_the_result(look, run, wait_for):
    viewer_of(look).layers.remove("MR arrows, paper")
    wait_for(lambda: not look.busy)
    told = look.status
    assert "its layer 'MR arrows, paper' was deleted" in told
    assert "press Deform" in told
    assert "untick 'arrows'" in told
    run(look)
    wait_for(lambda: not look.busy)
    assert look.status.startswith("Tissue moved up to")
    assert look.result is viewer_of(look).layers["MR arrows, paper"]


def test_a_closed_dock_restores_the_full_motion_and_adds_no_status_until_it_is_opened_again(
    frame, small_sample, run, set_to, wait_for, at_rest
):
    viewer, look = frame.viewer, quick(frame.open())
    small_sample(viewer)
    run(look)
    wait_for(lambda: not look.busy)
    bar, look.arrows = scale_bar_of(viewer), True
    assert bar.visible
    moved = viewer.layers["MR deformed, paper"]
    whole = moved.data.copy()
    set_to(look, percent=20)
    assert not np.array_equal(moved.data, whole)
    look.play()
    frame.close(look)
    at_rest()
    np.testing.assert_array_equal(moved.data, whole)
    assert metadata_of(moved)["percent"] == 100
    assert not bar.visible, "a closed dock leaves its scale key on the canvas"
    assert "Shift+B" not in [str(key) for key in viewer.keymap]
    viewer.status = "Ready"
    viewer.mouse_over_canvas = True
    viewer.cursor.position = (10, 12)
    assert "area change" not in str(viewer.status)
    again = quick(frame.open())
    wait_for(lambda: not again.busy)
    assert again.result is viewer.layers["MR arrows, paper"]
    assert "Shift+B" in [str(key) for key in viewer.keymap]
    viewer.status = "Ready"
    viewer.status = "looked again"
    assert "area change" in viewer.status


def test_data_set_by_other_code_are_not_overwritten_by_the_full_motion(look, set_to):
    moved = viewer_of(look).layers["MR deformed, paper"]
    set_to(look, percent=20)
    newer = np.zeros_like(moved.data)
    moved.data = newer
    look._view._put_back()
    assert moved.data is newer


def test_pictures_are_saved_in_a_new_folder_in_the_chosen_place(
    look, tmp_path, wait_for, monkeypatch
):
    monkeypatch.setattr("qtpy.QtWidgets.QFileDialog.getExistingDirectory", lambda *_: str(tmp_path))
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    got = []
    look.saved.connect(got.append)
    for _ in range(2):
        got.clear()
        Screen(look).entry("More", "Save pictures").trigger()
        wait_for(lambda: bool(got))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["MR pictures", "MR pictures 2"]


def test_an_added_layer_has_metadata_of_its_kind_and_source(look, set_to):
    viewer = viewer_of(look)
    for name, kind in (("grid", Vectors), ("labels", Labels), ("stretch", Image)):
        set_to(look, overlay=name)
        (layer,) = (each for each in viewer.layers if metadata_of(each).get("kind") == name)
        assert type(layer) is kind
    facts = viewer.layers["MR maximum in-plane stretch (%), paper"].metadata[METADATA]
    assert facts["source"] == "MR"
    assert "percent" not in facts, "a layer of the full motion has a percentage"
    set_to(look, percent=30)
    facts = viewer.layers["MR maximum in-plane stretch (%), paper"].metadata[METADATA]
    assert facts["percent"] == 30


def test_a_deformed_image_is_not_offered_as_stiffness(deformed):
    offered = deformed._form.tissue.choice.offered
    image = viewer_of(deformed).layers["MR deformed, paper"]
    assert image not in offered
    assert viewer_of(deformed).layers["MR"] in offered


def test_a_slice_without_an_axis_label_is_described_by_its_number():
    frame = SimpleNamespace(slice_seen="slice 7")
    result = SimpleNamespace(unit="mm", frame=frame, solution=SimpleNamespace(spacing=(1.0, 1.0)))
    assert how_far(result, 3.0, 100) == "100 %: tissue moved up to 3 mm in slice 7"
    frame.slice_seen = ""
    assert how_far(result, 3.4e-7, 100) == "100 %: tissue moved up to 0 mm"
