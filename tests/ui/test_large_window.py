"""Tests of growth, forces and large motion in the dock."""

from dataclasses import replace

import numpy as np
import pytest
from qtpy.QtWidgets import QPushButton, QTableWidget

from napari_hmrf import Arrow, Cavity, Drawing, Landmark, NeoHookeanPrior, Stroke
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.solver.optimizers import work
from napari_hmrf.study import support
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from tests.support.long_work import long_work
from tests.support.screen import Screen

SIZE = 40
ROWS, COLS = np.indices((SIZE, SIZE))
DISC = np.hypot(ROWS - 20, COLS - 20) < 8
BRAIN, TUMOUR = Material(1, "brain", 1.0), Material(2, "tumour", 10.0)


@pytest.fixture
def viewer(frame):
    """Return a viewer with a brain, a tumour and their labels."""
    viewer = frame.viewer
    viewer.add_image(np.where(DISC, 0.9, 0.5), name="Brain")
    table = layer_metadata(TISSUE, (BRAIN, TUMOUR))
    viewer.add_labels(np.where(DISC, 2, 1), name="Tissue", metadata=table)
    return viewer


@pytest.fixture
def dock(viewer, frame, wait_for):
    """Return a dock beside the brain, with a fixed edge."""
    dock = frame.open()
    dock.image, dock.tissue = viewer.layers["Brain"], viewer.layers["Tissue"]
    wait_for(lambda: not dock.busy)
    return dock


@pytest.fixture
def do_and_wait(dock, wait_for):
    """Return a function that calls a function, waits and returns the new solution."""

    def do(action, *given):
        action(*given)
        wait_for(lambda: not dock.busy)
        return dock.solution

    return do


def offers(dock, words):
    buttons = dock.native.findChildren(QPushButton)
    return any(each.text().startswith(words) and not each.isHidden() for each in buttons)


def test_typed_growth_moves_tissue(dock, do_and_wait):
    screen = Screen(dock)
    assert screen.cell("brain", "grows").text() == "0"
    moved = do_and_wait(screen.cell("tumour", "grows").write, "20")
    assert dock.materials[1].growth == pytest.approx(0.2)
    assert moved.displacement[20, 28, 1] > 0.5
    moved = do_and_wait(screen.cell("tumour", "grows").write, "20 / 0")
    assert screen.cell("tumour", "grows").text() == "20 / 0"
    assert abs(moved.displacement[20, 28, 1]) < 0.2 < moved.displacement[28, 20, 0]


def test_strain_excludes_typed_growth_but_includes_growth_with_the_wheel(dock, do_and_wait):
    def growth_excluded(solution):
        within = solution.strain()[20, 20, -2:, -2:]
        return np.trace(solution.strain("small")[20, 20] - within)

    typed = do_and_wait(Screen(dock).cell("tumour", "grows").write, "20")
    assert growth_excluded(typed) > 0.1
    dock.undo()
    wheel = Stroke("expand", (((20, 20),),), 4.0, amount=1.0)
    turned = do_and_wait(setattr, dock, "drawing", Drawing((wheel,)))
    assert growth_excluded(turned) == pytest.approx(0, abs=1e-4)
    assert np.trace(turned.strain()[20, 20, -2:, -2:]) > 0.1


def test_large_motion_takes_over_by_itself_where_elastic_tissue_folds(dock, do_and_wait):
    screen, back, again = Screen(dock), "Use elastic", "Use large motion"
    do_and_wait(screen.cell("tumour", "grows").write, "20")
    assert dock.model == "elastic"
    shown = []
    dock.deformation_changed.connect(shown.append)
    mended = do_and_wait(screen.cell("tumour", "grows").write, "150")
    assert all(moved.solution.count_folds() == 0 for moved in shown), "folds were shown"
    assert dock.model == mended.provenance.model == dock.study.model_name == "large motion"
    assert "in large motion, because it would fold" in dock.status
    assert "folds" not in dock.warning
    folded = do_and_wait(screen.press, back)
    assert dock.model == "elastic"
    assert folded.count_folds() > 5
    assert not offers(dock, back)
    assert offers(dock, again)
    do_and_wait(screen.press, "⚠")
    assert "the tissue folds" in dock.status
    chosen = do_and_wait(screen.press, again)
    assert "fold" not in dock.status, "what was said of the last result has gone with it"
    assert chosen.count_folds() == 0
    assert not offers(dock, back), "the user has chosen large motion"
    do_and_wait(dock.undo)
    assert dock.model == "elastic"
    screen.press(again)
    dock.cancel()
    assert not offers(dock, again), "large motion is offered although it is chosen"
    for model in ("elastic", "large motion", "elastic"):
        do_and_wait(dock.undo)
        assert dock.model == model
    assert dock.materials[1].growth == pytest.approx(0.2), "growth and model are one step"


def test_elastic_folds_are_shown_until_large_motion_is_prepared(dock, do_and_wait, monkeypatch):
    prepared = set()
    monkeypatch.setattr(support, "are_compiled", lambda job: job in prepared)
    grows = Screen(dock).cell("tumour", "grows")
    folded = do_and_wait(grows.write, "150")
    assert dock.model == "elastic"
    assert folded.count_folds() > 5
    do_and_wait(Screen(dock).press, "Use large motion")
    assert dock.model == "large motion"
    do_and_wait(dock.undo)
    assert (dock.model, dock.unfolds) == ("elastic", True)
    prepared.add("large-motion")
    mended = do_and_wait(dock._preparation.update)
    assert dock.model == "large motion"
    assert mended.count_folds() == 0


def test_the_elastic_model_returns_when_nothing_moves_any_more(dock, do_and_wait):
    far, near = (Drawing((Arrow((20, 10), (0.0, by), 4.0),)) for by in (16.0, 0.5))
    do_and_wait(setattr, dock, "drawing", far)
    assert dock.model == "large motion"
    do_and_wait(dock.clear)
    assert dock.model == "elastic"
    do_and_wait(setattr, dock, "drawing", near)
    assert dock.solution.provenance.model == "elastic"
    do_and_wait(setattr, dock, "drawing", far)
    assert dock.solution.provenance.model == "large motion"


def test_large_motion_takes_over_in_a_volume_but_not_in_a_study_from_a_file(
    frame, wait_for, tmp_path
):
    viewer = frame.viewer
    ball = np.linalg.norm(np.indices((7, 7, 7)) - 3, axis=0) < 2.1
    viewer.add_image(np.where(ball, 0.9, 0.5), name="Head")
    table = layer_metadata(TISSUE, (BRAIN, Material(2, "tumour", 10.0, growth=1.2)))
    viewer.add_labels(np.where(ball, 2, 1), name="Tissue", metadata=table)
    dock = frame.open()
    dock.settings = replace(dock.settings, budget=20.0)
    dock.image, dock.extent, dock.tissue = viewer.layers[0], "volume", viewer.layers[1]
    wait_for(lambda: not dock.busy)
    assert dock.solution.provenance.model == "large motion"
    assert dock.solution.count_folds() == 0
    dock.unfolds, dock.model = False, "elastic"
    wait_for(lambda: not dock.busy)
    path = dock.save_study(tmp_path / "folded")
    dock.reset()
    dock.open_study(path)
    wait_for(lambda: not dock.busy)
    assert "folds" in dock.warning
    assert not dock.unfolds


def test_a_button_continues_large_motion_that_used_up_its_budget(
    dock, do_and_wait, monkeypatch, wait_for
):
    monkeypatch.setattr(work, "_LEAST_CYCLE_SITES", {2: 0.0, 3: 0.0})
    screen, offer = Screen(dock), "Continue"
    do_and_wait(screen.cell("tumour", "grows").write, "60")
    dock.settings = replace(dock.settings, budget=2.0)
    dock.model = "large motion"
    short = do_and_wait(lambda: None)
    assert short.reach.stopped
    assert "had no time to settle" in dock.warning
    with long_work():
        screen.press(offer)
        wait_for(lambda: not screen.button(offer).isEnabled())
    done = do_and_wait(lambda: None)
    assert dock.settings.budget == 60
    assert not done.reach.stopped
    assert "settle" not in dock.warning
    assert not offers(dock, offer)


def test_a_dock_of_usual_width_shows_a_warning_beside_an_offer_in_full(
    dock, frame, do_and_wait, monkeypatch, qtbot
):
    monkeypatch.setattr(work, "_LEAST_CYCLE_SITES", {2: 0.0, 3: 0.0})
    frame.show()
    window = dock.native.window()
    margin = window.width() - dock.native.width()
    window.resize(345 + margin, 745)  # as in a window of 1366 x 768 pixels
    do_and_wait(Screen(dock).cell("tumour", "grows").write, "60")
    dock.settings = replace(dock.settings, budget=2.0)
    dock.model = "large motion"
    do_and_wait(lambda: None)
    chip = Screen(dock).button("⚠")
    assert offers(dock, "Continue")
    qtbot.waitUntil(lambda: chip.width() < 300)  # the layout has made room for the offer
    assert chip.painted_text == "⚠  Tissue had no time to settle"


def test_a_volume_has_no_plane_condition(frame):
    dock = frame.open()
    frame.viewer.add_image(np.random.default_rng(0).random((6, 8, 8)), name="Head")
    plane = Screen(dock).button("free to bulge")
    assert not plane.isHidden()
    dock.extent = "volume"
    assert "Squeezed" not in Screen(dock).words
    dock.extent = "slice"
    assert "Squeezed" in Screen(dock).words


def test_weight_rotates_with_the_layers(dock, viewer, do_and_wait):
    do_and_wait(Screen(dock).choose, "down")
    before = dock.solution.displacement

    def turn():
        for layer in viewer.layers:
            layer.rotate = 30

    do_and_wait(turn)
    assert dock.weight == pytest.approx((0.00981, 0))
    np.testing.assert_allclose(dock.solution.displacement, before, atol=0.02)


def test_forces_are_painted_as_boundaries_and_have_their_own_columns(dock, viewer, do_and_wait):
    paint = np.zeros((SIZE, SIZE), int)
    paint[-1], paint[0, 10:30] = 1, 2
    rules = (
        BoundaryRule(1, "fixed", name="table"),
        BoundaryRule(2, "expand", amount=9, name="lid"),
    )
    layer = viewer.add_labels(paint, name="Lid", metadata=layer_metadata(BOUNDARY, rules))
    dock.boundary, dock.hold_edge = layer, False
    screen = Screen(dock)
    do_and_wait(screen.cell("lid", "Action").choose, "pressed")
    assert dock.rules[1].amount == 0  # A distance is not converted to a pressure.
    assert "nothing moves" not in dock.warning
    pressed = do_and_wait(screen.cell("lid", "pressure").write, "0.1")
    assert pressed.displacement[0, 20, 0] > 1
    do_and_wait(screen.cell("lid", "Action").choose, "pulled")
    pulled = do_and_wait(screen.cell("lid", "pull right").write, "0.1")
    assert pulled.displacement[0, 20, 1] > 1


def test_a_painted_boundary_slides_and_large_motion_says_that_it_cannot(
    dock, viewer, do_and_wait, wait_for
):
    paint = np.zeros((SIZE, SIZE), int)
    paint[-1], paint[0, 10:30] = 1, 2
    rules = (
        BoundaryRule(1, "expand", amount=9, name="table"),
        BoundaryRule(2, "move", vector=(0, 3), name="lid"),
    )
    layer = viewer.add_labels(paint, name="Lid", metadata=layer_metadata(BOUNDARY, rules))
    dock.boundary, dock.hold_edge = layer, False
    screen = Screen(dock)
    slid = do_and_wait(screen.cell("table", "Action").choose, "slides").displacement
    assert screen.cell("table", "confi-").text() == ""
    assert slid[-1, :, 1] == pytest.approx(3, abs=0.05)
    assert np.abs(slid[-1, :, 0]).max() < 0.01
    raised = do_and_wait(screen.cell("table", "out").write, "-2").displacement
    assert raised[-1, 20, 0] == pytest.approx(-2, abs=0.05)
    dock.model = "large motion"
    wait_for(lambda: not dock.busy)
    assert "'Lid' has tissue that slides" in dock.status


def test_large_motion_gives_the_elastic_model_back_to_tissue_that_slides(dock, viewer, do_and_wait):
    paint = np.zeros((SIZE, SIZE), int)
    paint[-1] = 1
    rules = (BoundaryRule(1, "fixed", name="table"),)
    dock.boundary = viewer.add_labels(paint, name="Lid", metadata=layer_metadata(BOUNDARY, rules))
    dock.hold_edge = True
    screen = Screen(dock)
    do_and_wait(screen.cell("tumour", "grows").write, "150")
    assert dock.model == "large motion"
    slid = do_and_wait(screen.cell("table", "Action").choose, "slides")
    assert slid.displacement[-1, 20, 0] == pytest.approx(0, abs=0.01)
    assert slid.count_folds() > 0
    assert "elastic model is used again" in dock.status
    assert not offers(dock, "Use large motion")


def test_tissue_moves_in_the_direction_of_its_weight(dock, do_and_wait, tmp_path):
    screen = Screen(dock)
    do_and_wait(screen.choose, "down")
    down = dock.solution.displacement[20, 20, 0]
    assert down > 0.1
    assert "unit of stiffness" in dock.warning
    do_and_wait(screen.choose, "to the left")
    assert dock.solution.displacement[20, 20, 1] == pytest.approx(-down, rel=0.05)
    path = dock.save_study(tmp_path / "heavy")
    do_and_wait(dock.undo)
    do_and_wait(dock.open_study, path)
    assert dock.weight == pytest.approx((0, -0.00981))


def test_forces_are_listed_in_a_table(dock, do_and_wait, qtbot):
    do_and_wait(Screen(dock).cell("tumour", "grows").write, "20")
    do_and_wait(Screen(dock).entry("More", "Forces").trigger)
    table = dock.native.window().findChild(QTableWidget, "measurements")
    heads = [table.horizontalHeaderItem(n).text() for n in range(table.columnCount())]
    assert heads == ["what", "around pixel", "pixels", "force (relative px)", "which way"]
    assert table.item(0, 0).text() == "held"
    assert table.item(0, 2).text() == str(4 * (SIZE - 1))


def test_a_warning_reports_motion_that_the_large_motion_model_could_not_apply(
    dock, viewer, do_and_wait
):
    ring = np.where(DISC, 1, 0)
    rules = (BoundaryRule(1, "expand", amount=20.0, name="rim"),)
    layer = viewer.add_labels(ring, name="Rim", metadata=layer_metadata(BOUNDARY, rules))
    dock.model, dock.boundary, dock.hold_edge = "large motion", layer, True
    solution = do_and_wait(dock.schedule_refresh)
    assert isinstance(dock.study.prior, NeoHookeanPrior)
    assert solution.reach.missing > 0.1
    assert "stay short" in dock.warning
    assert "of its way: see the warning" in dock.status


def test_large_motion_is_solved_once_the_sliding_surface_is_removed(dock, do_and_wait):
    pull = (Arrow((10, 20), (2, 0), 3.0), Stroke("expand", (((28, 28),),), 4.0, amount=1.0))
    slide = Stroke("slide", (((5, 1), (30, 1)),), 1.5)
    do_and_wait(setattr, dock, "drawing", Drawing((*pull, slide)))
    dock.live = False
    do_and_wait(setattr, dock, "model", "large motion")
    assert dock.solution.provenance.model == "elastic"
    solution = do_and_wait(setattr, dock, "drawing", Drawing(pull))
    assert solution.provenance.model == "large motion"
    assert "not updated" not in dock.status


def test_large_motion_is_offered_beside_all_inputs_that_it_supports(dock, do_and_wait):
    dock.unfolds = False
    do_and_wait(Screen(dock).cell("tumour", "grows").write, "150")
    mark = Landmark((34, 8), (0, 0), 3.0, sd=2.0)
    do_and_wait(setattr, dock, "drawing", Drawing((mark,)))
    assert dock.solution.count_folds() > 0
    assert offers(dock, "Use large motion")
    slide = Stroke("slide", (((5, 1), (30, 1)),), 1.5)
    do_and_wait(setattr, dock, "drawing", Drawing((slide,)))
    assert dock.solution.count_folds() > 0
    assert not offers(dock, "Use large motion")


def test_tissue_sinks_into_the_cavity_of_a_painted_resection(dock, viewer, do_and_wait, tmp_path):
    paint = np.where(DISC, 1, 0)
    rules = (BoundaryRule(1, "fixed", name="tumour bed"),)
    layer = viewer.add_labels(paint, name="Bed", metadata=layer_metadata(BOUNDARY, rules))
    dock.boundary, dock.hold_edge = layer, True
    screen = Screen(dock)
    still = do_and_wait(screen.cell("tumour bed", "Action").choose, "removed")
    assert screen.cell("tumour bed", "confi-").text() == ""
    assert not still.displacement.any()
    assert "Nothing acts on the tissue" in dock.warning
    assert "'gravity'" in dock.warning
    sunk = do_and_wait(screen.choose, "down")
    roof, floor = (20 - np.argmax(DISC[20::-1, 20] == 0), 20 + np.argmax(DISC[20:, 20] == 0))
    assert sunk.displacement[roof, 20, 0] > 0.1
    filled = do_and_wait(screen.choose, "fluid")
    assert dock.cavity == Cavity(fluid=0.00981)
    assert filled.displacement[floor, 20, 0] > sunk.displacement[floor, 20, 0] + 0.1
    half = do_and_wait(setattr, dock, "cavity", Cavity(fluid=0.00981, level=0.5))
    assert sunk.displacement[floor, 20, 0] < half.displacement[floor, 20, 0]
    assert half.displacement[floor, 20, 0] < filled.displacement[floor, 20, 0]
    path = dock.save_study(tmp_path / "removed")
    do_and_wait(dock.undo)
    do_and_wait(dock.open_study, path)
    assert dock.cavity == Cavity(fluid=0.00981, level=0.5)
    assert dock.rules[0].action == "remove"
