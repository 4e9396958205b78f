"""Growth, forces and large motion in the dock."""

import numpy as np
import pytest
from napari.components import ViewerModel
from qtpy.QtWidgets import QPushButton, QTableWidget

from napari_hmrf import NeoHookeanPrior
from napari_hmrf.fields import count_folds
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, layer_metadata
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.screen import Screen

SIZE = 40
ROWS, COLS = np.indices((SIZE, SIZE))
DISC = np.hypot(ROWS - 20, COLS - 20) < 8
BRAIN, TUMOUR = Material(1, "brain", 1.0), Material(2, "tumour", 10.0)


@pytest.fixture
def viewer():
    """A brain with a tumour, and its tissues."""
    viewer = ViewerModel()
    viewer.add_image(np.where(DISC, 0.9, 0.5), name="Brain")
    table = layer_metadata(TISSUE, (BRAIN, TUMOUR))
    viewer.add_labels(np.where(DISC, 2, 1), name="Tissue", metadata=table)
    return viewer


@pytest.fixture
def dock(viewer, qtbot, wait_for):
    """A dock over it, the edge held."""
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    dock.image, dock.tissue = viewer.layers["Brain"], viewer.layers["Tissue"]
    wait_for(lambda: not dock.busy)
    return dock


@pytest.fixture
def at_rest(dock, wait_for):
    """Do something, and wait until all of it is seen."""

    def do(action, *given):
        action(*given)
        wait_for(lambda: not dock.busy)
        return dock.solution

    return do


def offers(dock, words):
    buttons = dock.native.findChildren(QPushButton)
    return any(each.text().startswith(words) and not each.isHidden() for each in buttons)


def test_growth_that_is_typed_moves_tissue_at_once_and_can_be_undone(dock, at_rest):
    screen = Screen(dock)
    assert screen.cell("brain", "grows").text() == "0"
    moved = at_rest(screen.cell("tumour", "grows").write, "20")
    assert dock.materials[1].growth == pytest.approx(0.2)
    assert moved.displacement[20, 28, 1] > 0.5
    moved = at_rest(screen.cell("tumour", "grows").write, "20 / 0")
    assert screen.cell("tumour", "grows").text() == "20 / 0"
    assert abs(moved.displacement[20, 28, 1]) < 0.2 < moved.displacement[28, 20, 0]
    at_rest(dock.undo)
    at_rest(dock.undo)
    assert dock.materials[1].growth == 0


def test_growth_by_more_than_all_of_it_is_not_taken(dock):
    Screen(dock).cell("tumour", "grows").write("-100")
    assert "above -100" in dock.status
    assert dock.materials[1].growth == 0


def test_folds_are_mended_by_one_press_and_it_can_be_undone(dock, at_rest):
    screen, offer = Screen(dock), "Use large motion"
    at_rest(screen.cell("tumour", "grows").write, "20")
    assert not offers(dock, offer)
    folded = at_rest(screen.cell("tumour", "grows").write, "150")
    assert count_folds(folded.displacement, spacing=1) > 5
    assert offers(dock, offer)
    at_rest(screen.press, "⚠")
    assert "the tissue folds" in dock.status
    mended = at_rest(screen.press, offer)
    assert "fold" not in dock.status, "what was said of the last result has gone with it"
    assert dock.model == mended.provenance.model == "large motion"
    assert count_folds(mended.displacement, spacing=1) == 0
    assert "folds" not in dock.warning
    assert not offers(dock, offer)
    at_rest(dock.undo)
    assert dock.model == "elastic"
    screen.press(offer)
    dock.cancel()
    assert not offers(dock, offer), "it is taken, and Deform makes it so"


def test_a_volume_is_not_offered_what_it_cannot_have(qtbot, wait_for):
    viewer = ViewerModel()
    ball = np.linalg.norm(np.indices((12, 12, 12)) - 5.5, axis=0) < 3
    viewer.add_image(np.where(ball, 0.9, 0.5), name="Head")
    table = layer_metadata(TISSUE, (BRAIN, Material(2, "tumour", 10.0, growth=3.0)))
    viewer.add_labels(np.where(ball, 2, 1), name="Tissue", metadata=table)
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    dock.image, dock.extent, dock.tissue = viewer.layers[0], "volume", viewer.layers[1]
    wait_for(lambda: not dock.busy)
    assert "folds" in dock.warning
    assert not offers(dock, "Use large motion")
    dock.model = "large motion"
    wait_for(lambda: not dock.busy)
    assert "large motion is for 2-D" in dock.status
    Screen(dock).press("Use the elastic model")
    wait_for(lambda: not dock.busy)
    assert dock.solution.provenance.model == "elastic"
    assert not offers(dock, "Use the elastic")


def test_a_volume_lies_in_no_plane(qtbot):
    viewer = ViewerModel()
    viewer.add_image(np.random.default_rng(0).random((6, 8, 8)), name="Head")
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    plane = Screen(dock).button("free to bulge")
    assert not plane.isHidden()
    dock.extent = "volume"
    assert "Squeezed" not in Screen(dock).words
    dock.extent = "slice"
    assert "Squeezed" in Screen(dock).words


def test_weight_stays_with_tissue_that_is_turned_and_can_be_undone(dock, viewer, at_rest):
    at_rest(Screen(dock).choose, "down")
    before = dock.solution.displacement

    def turn():
        for layer in viewer.layers:
            layer.rotate = 30

    at_rest(turn)
    assert dock.weight == pytest.approx((0.00981, 0))
    np.testing.assert_allclose(dock.solution.displacement, before, atol=0.02)
    at_rest(dock.undo)
    assert dock.weight == ()
    at_rest(dock.redo)
    assert dock.weight == pytest.approx((0.00981, 0))


def test_forces_are_painted_like_all_else_in_columns_of_their_own(dock, viewer, at_rest):
    paint = np.zeros((SIZE, SIZE), int)
    paint[-1], paint[0, 10:30] = 1, 2
    rules = (
        BoundaryRule(1, "fixed", name="table"),
        BoundaryRule(2, "expand", amount=9, name="lid"),
    )
    layer = viewer.add_labels(paint, name="Lid", metadata=layer_metadata(BOUNDARY, rules))
    dock.boundary, dock.hold_edge = layer, False
    screen = Screen(dock)
    at_rest(screen.cell("lid", "Action").choose, "pressed")
    assert dock.rules[1].amount == 0  # a distance is no pressure
    assert "nothing moves" not in dock.warning
    pressed = at_rest(screen.cell("lid", "pressure").write, "0.1")
    assert pressed.displacement[0, 20, 0] > 1
    at_rest(screen.cell("lid", "Action").choose, "pulled")
    pulled = at_rest(screen.cell("lid", "pull right").write, "0.1")
    assert pulled.displacement[0, 20, 1] > 1


def test_tissue_sinks_where_its_weight_pulls(dock, at_rest, tmp_path):
    screen = Screen(dock)
    at_rest(screen.choose, "down")
    down = dock.solution.displacement[20, 20, 0]
    assert down > 0.1
    assert "unit of stiffness" in dock.warning
    at_rest(screen.choose, "to the left")
    assert dock.solution.displacement[20, 20, 1] == pytest.approx(-down, rel=0.05)
    path = dock.save_study(tmp_path / "heavy")
    at_rest(dock.undo)
    at_rest(dock.undo)
    assert dock.weight == ()
    at_rest(dock.open_study, path)
    assert dock.weight == pytest.approx((0, -0.00981))


def test_forces_are_told_in_a_table(dock, at_rest, qtbot):
    at_rest(Screen(dock).cell("tumour", "grows").write, "20")
    at_rest(Screen(dock).entry("More", "Forces").trigger)
    table = dock.native.window().findChild(QTableWidget, "measurements")
    heads = [table.horizontalHeaderItem(n).text() for n in range(table.columnCount())]
    assert heads == ["what", "around pixel", "pixels", "force (relative px)", "which way"]
    assert table.item(0, 0).text() == "held"
    assert table.item(0, 2).text() == str(4 * (SIZE - 1))


def test_what_large_motion_could_not_do_is_said_in_the_dock(dock, viewer, at_rest):
    ring = np.where(DISC, 1, 0)
    rules = (BoundaryRule(1, "expand", amount=14.0, name="rim"),)
    layer = viewer.add_labels(ring, name="Rim", metadata=layer_metadata(BOUNDARY, rules))
    dock.model, dock.boundary, dock.hold_edge = "large motion", layer, True
    solution = at_rest(dock.schedule_refresh)
    assert isinstance(dock.study.prior, NeoHookeanPrior)
    assert solution.reach.missing > 0.1
    assert "stay short" in dock.warning
