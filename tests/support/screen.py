"""Controls of a dock, found by the texts that the user reads."""

from __future__ import annotations

from qtpy.QtCore import QEvent, QSize, Qt
from qtpy.QtGui import QIcon
from qtpy.QtTest import QTest
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractSlider,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLabel,
    QLineEdit,
    QProgressBar,
    QScrollBar,
    QTableView,
)


class Screen:
    """Visible controls of a dock.

    Parameters
    ----------
    dock
        Dock of the package, of which only the native widget is used.
    """

    def __init__(self, dock):
        self._native = dock.native

    def button(self, words):
        """Return the button or box with this text, or with a text that begins with it."""
        found = self._native.findChildren(QAbstractButton)
        exact = [each for each in found if each.text() == words]
        (one,) = exact or [each for each in found if each.text().startswith(words)]
        return one

    def press(self, words):
        """Assert that a button is enabled, and click it."""
        button = self.button(words)
        assert button.isEnabled(), f"{words!r} is disabled"
        button.click()

    def tick(self, words, on=True):
        box = self.button(words)
        if box.isChecked() != on:
            self.press(words)

    def hold(self, words):
        QTest.mousePress(self.button(words), Qt.MouseButton.LeftButton)

    def let_go(self, words):
        QTest.mouseRelease(self.button(words), Qt.MouseButton.LeftButton)

    def choose(self, entry):
        """Choose an entry of the first menu that offers it."""
        menus = self._native.findChildren(QComboBox)
        next(each for each in menus if each.findText(entry) > -1).setCurrentText(entry)

    def pick(self, entry):
        """Choose an entry with the mouse from the first menu that offers it."""
        menus = self._native.findChildren(QComboBox)
        menu = next(each for each in menus if each.findText(entry) > -1)
        QTest.mouseClick(menu, Qt.MouseButton.LeftButton)
        there = menu.view().visualRect(menu.model().index(menu.findText(entry), 0)).center()
        QTest.mouseMove(menu.view().viewport(), there)
        QTest.mouseClick(menu.view().viewport(), Qt.MouseButton.LeftButton, pos=there)

    def entry(self, words, *path):
        """Return an entry of the menu of a button."""
        menu = self.button(words).menu()
        menu.aboutToShow.emit()
        for step in path:
            (action,) = (each for each in menu.actions() if each.text().startswith(step))
            menu = action.menu()
        return action

    @property
    def controls(self):
        """Visible controls: buttons, boxes, fields, sliders and tables."""
        kinds = QAbstractButton, QComboBox, QAbstractSpinBox, QAbstractSlider, QTableView
        found = [each for kind in kinds for each in self._native.findChildren(kind)]
        return [each for each in found if each.isVisible() and not isinstance(each, QScrollBar)]

    @property
    def bar(self):
        """Bar of the preparation of the computer."""
        return self._native.findChild(QProgressBar)

    @property
    def slider(self):
        (one,) = (
            each
            for each in self._native.findChildren(QAbstractSlider)
            if (each.minimum(), each.maximum()) == (0, 100)
            and each.metaObject().className() != "QScrollBar"
        )
        return one

    @property
    def words(self):
        """All visible texts of labels."""
        return "\n".join(each.text() for each in self._native.findChildren(QLabel))

    def cell(self, name, title):
        """Return the cell in the row with a name and the column with a title."""
        for table in self._native.findChildren(QTableView):
            (column,) = [
                each
                for each in range(2, table.model().columnCount())
                if head(table, each).startswith(title)
            ] or [None]
            for row in range(table.model().rowCount()):
                if column and name in (Cell(table, row, each).text() for each in (0, 1)):
                    return Cell(table, row, column)
        raise LookupError(f"no {title!r} of {name!r}")

    def click_row(self, name):
        """Click the name in a row of a table."""
        for table in self._native.findChildren(QTableView):
            for row in range(table.model().rowCount()):
                if Cell(table, row).text() == name:
                    Cell(table, row).click()
                    return
        raise LookupError(name)


def head(table, column):
    """Return the title of a column."""
    return table.model().headerData(column, Qt.Orientation.Horizontal)


class Cell:
    """Cell of a table, which can be read, clicked and edited."""

    def __init__(self, table, row, column=1):
        self._table, self._index = table, table.model().index(row, column)

    def text(self):
        return self._index.data()

    def colour(self, selected):
        """Return the RGB colour (0 to 1) of the square in a cell of a selected or other row."""
        mode = QIcon.Mode.Selected if selected else QIcon.Mode.Normal
        square = self._index.data(Qt.ItemDataRole.DecorationRole).pixmap(QSize(14, 14), mode)
        return square.toImage().pixelColor(5, 5).getRgbF()[:3]

    def can_be_typed(self):
        return bool(self._index.flags() & Qt.ItemFlag.ItemIsEditable)

    def click(self):
        place = self._table.visualRect(self._index).center()
        QTest.mouseClick(self._table.viewport(), Qt.MouseButton.LeftButton, pos=place)

    def write(self, text):
        """Type a text and Return."""
        self._table.edit(self._index)
        *_, editor = self._table.viewport().findChildren(QLineEdit)
        editor.selectAll()
        QTest.keyClicks(editor, text)
        if not text:
            QTest.keyClick(editor, Qt.Key.Key_Delete)
        QTest.keyClick(editor, Qt.Key.Key_Return)
        # Qt posts the key to the editor, so process that event.
        QApplication.sendPostedEvents(self._table.itemDelegate(), int(QEvent.Type.MetaCall))

    @property
    def box(self):
        """Box by which a value is chosen instead of typed."""
        return self._table.indexWidget(self._index)

    def chosen(self):
        """Return the text of the box."""
        return self.box.currentText()

    def choose(self, words):
        """Choose an entry of the box with the keyboard."""
        while self.chosen() != words:
            QTest.keyClick(self.box, Qt.Key.Key_Down)
