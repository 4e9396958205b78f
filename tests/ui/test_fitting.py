"""Fit of the tissues of an image to a second image in the window, by its buttons."""

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QApplication, QDialog, QLabel, QPushButton, QTableWidget
from scipy import ndimage

from napari_hmrf import Arrow, Drawing, Grid, Material, Motion, Pictures, Study, Tissue, solve_study
from napari_hmrf.layers.metadata import TISSUE, layer_metadata
from tests.support.screen import Screen

LABELS = np.ones((60, 64), np.uint8)
LABELS[18:36, 20:42] = 2
GROWTH = 0.3
IMAGE = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=LABELS.shape), 1.5)
IMAGE = (255 * (IMAGE - IMAGE.min()) / np.ptp(IMAGE)).astype(np.float32)


def materials(growth=0.0):
    return Material(1, "healthy", 3.0), Material(2, "tumour", 3.0, growth=growth)


def image_after():
    """Return the image after the tumour has grown, with another brightness."""
    study = Study(
        Grid(LABELS.shape, (1, 1)),
        Tissue(labels=LABELS, materials=materials(GROWTH)),
        Motion(hold_edge=True),
        pictures=Pictures(IMAGE),
    )
    return 20 + 0.5 * solve_study(study).warp(IMAGE)


@pytest.fixture
def window(frame, wait_for):
    """Return a function that opens both images in a dock, and the window for a fit."""

    def make(is_painted=True):
        viewer, dock = frame.viewer, frame.open()
        first = viewer.add_image(IMAGE, name="before")
        table = layer_metadata(TISSUE, materials())
        if is_painted:
            viewer.add_labels(LABELS, name="tissue", metadata=table)
        second = viewer.add_image(image_after(), name="after", visible=False)
        dock.image = first
        dock.compare_with = second
        wait_for(lambda: not dock.busy)
        return dock

    return make


class FitScreen:
    """Controls of the window for a fit, as the user sees them."""

    def __init__(self, dock):
        Screen(dock).press("Fit to second image ...")
        shown = (each for each in QApplication.topLevelWidgets() if isinstance(each, QDialog))
        (self._dialog,) = [each for each in shown if each.isVisible()]
        self.table = self._dialog.findChild(QTableWidget)

    @property
    def is_open(self):
        return self._dialog.isVisible()

    def close(self):
        self._dialog.close()

    def _item(self, tissue, title):
        table = self.table
        titles = [table.horizontalHeaderItem(each).text() for each in range(table.columnCount())]
        (row,) = table.findItems(tissue, Qt.MatchFlag.MatchExactly)
        return table.item(row.row(), titles.index(title))

    def tick(self, tissue, title):
        self._item(tissue, title).setCheckState(Qt.CheckState.Checked)

    def value(self, tissue, title):
        return self._item(tissue, title).text()

    def press(self, words):
        (button,) = [
            each for each in self._dialog.findChildren(QPushButton) if each.text() == words
        ]
        assert button.isEnabled(), f"{words!r} is disabled"
        button.click()

    @property
    def words(self):
        return "\n".join(each.text() for each in self._dialog.findChildren(QLabel))


def growth_of(dock):
    return [row.growth for row in dock.study.tissue.materials]


def test_the_growth_of_a_tumour_is_found_from_two_images_and_undone_in_one_step(window, wait_for):
    dock = window()
    screen = FitScreen(dock)
    assert screen.value("tumour", "grows (%)") == "0"
    screen.tick("tumour", "grows (%)")
    screen.press("Fit")
    wait_for(lambda: not dock.busy and dock.solution is not None)
    healthy, tumour = growth_of(dock)
    assert healthy == 0
    assert tumour == pytest.approx(GROWTH, rel=0.03)
    assert "growth of 'tumour': " in screen.words
    assert "Agreement of the images: " in screen.words
    assert " to " in screen.value("tumour", "grows (%)"), "the interval is shown"
    rim = dock.solution.displacement[36, 31]
    assert rim[0] > 1, "the result shows the fitted growth"
    assert "Fitted, with intervals" in dock.status, "the message of the fit is kept"
    dock.undo()
    wait_for(lambda: not dock.busy)
    assert growth_of(dock) == [0, 0]
    assert screen.value("tumour", "grows (%)") == "0", "the window shows the table"
    dock.redo()
    wait_for(lambda: not dock.busy)
    assert " to " in screen.value("tumour", "grows (%)")


def test_a_fit_replaces_a_registration_in_the_same_step(window, wait_for):
    """So it holds the edge again that the registration has freed."""
    dock = window()
    Screen(dock).press("Register")
    wait_for(lambda: not dock.busy and dock.study.motion.measured is not None)
    assert not dock.study.motion.hold_edge
    screen = FitScreen(dock)
    screen.tick("tumour", "grows (%)")
    screen.press("Fit")
    wait_for(lambda: not dock.busy and growth_of(dock)[1] > 0)
    assert dock.study.motion.measured is None
    assert dock.study.motion.hold_edge
    assert "The registration was removed" in screen.words
    dock.undo()
    wait_for(lambda: not dock.busy)
    assert dock.study.motion.measured is not None
    assert growth_of(dock) == [0, 0]


def test_the_tables_of_a_fit_are_not_rebuilt_by_a_drag_nor_while_the_window_is_closed(window):
    dock = window()
    screen = FitScreen(dock)
    built = []
    screen.table.model().dataChanged.connect(lambda *_: built.append(1))
    model = dock.session
    model.draw(Drawing((Arrow((30, 30), (0, 1), 3.0),)), "pulled tissue")
    assert not built
    dock.materials = materials(0.1)
    assert built
    assert screen.value("tumour", "grows (%)") == "10"
    screen.close()
    built.clear()
    dock.materials = materials(0.2)
    assert not built
    assert FitScreen(dock).value("tumour", "grows (%)") == "20"


def test_what_cannot_be_fitted_changes_nothing(window, wait_for):
    dock = window()
    screen = FitScreen(dock)
    screen.press("Fit")
    assert "Tick at least one property." in screen.words
    for tissue in ("healthy", "tumour"):
        screen.tick(tissue, "stiffness")
    screen.press("Fit")
    wait_for(lambda: not dock.busy)
    assert "Nothing was fitted. " in screen.words
    assert "only ratios of stiffness affect the motion" in screen.words
    assert dock.study.tissue.materials == materials()


def test_cancel_stops_a_fit_and_changes_nothing(window, wait_for):
    dock = window()
    screen = FitScreen(dock)
    screen.tick("tumour", "grows (%)")
    screen.press("Fit")
    screen.press("Cancel")
    assert "cancelled" in screen.words
    wait_for(lambda: not dock.busy)
    assert "cancelled" in dock.status
    assert growth_of(dock) == [0, 0]
    assert screen.is_open
    screen.press("Close")
    assert not screen.is_open


def test_the_button_for_a_fit_says_what_it_needs(window, wait_for):
    dock = window(is_painted=False)
    button = Screen(dock).button("Fit to second image ...")
    assert not button.isEnabled()
    assert "Paint tissues first" in button.toolTip()
    dock.compare_with = None
    wait_for(lambda: not dock.busy)
    assert not button.isEnabled()
