"""Tests of the dock with a large font: no text is cut, and all texts grow."""

import pytest
from napari._qt.qt_resources import get_stylesheet
from napari.components import ViewerModel
from qtpy.QtCore import QPoint
from qtpy.QtWidgets import (
    QAbstractButton,
    QApplication,
    QComboBox,
    QLabel,
    QScrollArea,
    QTableView,
    QToolButton,
)

from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import quick
from tests.support.screen import Screen

#: Height of a window on a small screen, in pixels.
_HEIGHT = 700


@pytest.fixture
def dock(qtbot, small_sample, at_rest):
    """Return a new dock with all sections open, as narrow as possible, on a small screen."""
    viewer = ViewerModel()
    small_sample(viewer)
    made = quick(SoftTissue(viewer))
    qtbot.addWidget(made.native)
    with qtbot.waitExposed(made.native):
        made.native.show()
    for section in made._form.sections.values():
        section.expand(animate=False)
    at_rest.until(lambda: not made.busy)
    return made


def enlarge(dock, at_rest, by):
    """Make the font 1.5 times as large, as the application or the settings of napari do."""
    window = dock.native.window()
    if by == "application":
        font = window.font()
        font.setPointSizeF(1.5 * font.pointSizeF())
        window.setFont(font)
    else:
        window.setFont(QApplication.font())
        size = {"font_size": "14pt"}
        window.setStyleSheet(get_stylesheet("dark", extra_variables=size))
    at_rest()
    window.resize(window.minimumSizeHint().width(), _HEIGHT)
    at_rest()


def is_cut(part):
    needed = part.minimumSizeHint() if isinstance(part, QComboBox) else part.sizeHint()
    wraps = isinstance(part, QLabel) and (part.wordWrap() or part.toolTip() == part.text())
    too_narrow = part.width() < needed.width() and not wraps
    return too_narrow or (part.height() < needed.height() and not wraps)


def test_texts_grow_and_none_is_cut_with_a_large_font(dock, at_rest):
    tables = dock.native.findChildren(QTableView)
    rows = [table.rowHeight(0) for table in tables]
    dock._form.footer.warn("Tissue folds.", "folds")
    dock._form.footer.offer("Take large motion", "Solve without folds")
    for by in ("application", "napari"):
        enlarge(dock, at_rest, by)
        assert_all_texts_are_large(dock, tables, rows)


def assert_all_texts_are_large(dock, tables, rows):
    """Assert that texts are not cut, and that rows are higher than the given heights."""
    kinds = (QAbstractButton, QComboBox, QLabel)
    parts = [each for kind in kinds for each in dock.native.findChildren(kind)]
    parts.remove(Screen(dock).button("?"))  # narrow on purpose
    assert len(parts) > 50
    assert not [each.toolTip() for each in parts if each.isVisible() and is_cut(each)]
    for form in (dock.fields, dock._form.model.in_detail, dock._form.motion.cavity):
        labels = [each for each in form.native.findChildren(QLabel) if each.isVisible()]
        assert len({each.width() for each in labels}) == 1, "the labels are not aligned"
    area = dock.native.findChild(QScrollArea)
    assert area.widget().width() <= area.viewport().width(), "the form is wider than the dock"
    save = Screen(dock).button("Save study")
    window = dock.native.window()
    assert window.rect().contains(save.mapTo(window, QPoint(0, save.height() - 1)))
    size = dock.fields.radius.native.font().pointSizeF()
    for each in (*dock.native.findChildren(QToolButton), *tables):
        if each.isVisible():
            assert each.font().pointSizeF() == size, each
    for table, before in zip(tables, rows, strict=True):
        assert table.rowHeight(0) > before
