"""What can be pressed, ticked and typed in a dock, found by the words that a person reads there."""

from __future__ import annotations

from qtpy.QtCore import QEvent, QSize, Qt
from qtpy.QtGui import QIcon
from qtpy.QtTest import QTest
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractSlider,
    QApplication,
    QComboBox,
    QLabel,
    QLineEdit,
    QTableView,
)


class Screen:
    """A dock as it is seen.

    Parameters
    ----------
    dock
        Of ours; only its native widget is looked at.
    """

    def __init__(self, dock):
        self._native = dock.native

    def button(self, words):
        """The button or box that says so, or begins so."""
        found = self._native.findChildren(QAbstractButton)
        exact = [each for each in found if each.text() == words]
        (one,) = exact or [each for each in found if each.text().startswith(words)]
        return one

    def press(self, words):
        """Click a button; as a person can, only one that is not greyed out."""
        button = self.button(words)
        assert button.isEnabled(), f"{words!r} is greyed out"
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
        """Choose an entry with the mouse from the first menu that offers it, as it is seen."""
        menus = self._native.findChildren(QComboBox)
        menu = next(each for each in menus if each.findText(entry) > -1)
        QTest.mouseClick(menu, Qt.MouseButton.LeftButton)
        there = menu.view().visualRect(menu.model().index(menu.findText(entry), 0)).center()
        QTest.mouseMove(menu.view().viewport(), there)
        QTest.mouseClick(menu.view().viewport(), Qt.MouseButton.LeftButton, pos=there)

    def entry(self, words, *path):
        """An entry of the menu below a button."""
        menu = self.button(words).menu()
        menu.aboutToShow.emit()
        for step in path:
            (action,) = (each for each in menu.actions() if each.text().startswith(step))
            menu = action.menu()
        return action

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
        """All that is said in it."""
        return "\n".join(each.text() for each in self._native.findChildren(QLabel))

    def cell(self, name, title):
        """The cell in the row of that name, below that title."""
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
    """What the head of a column says."""
    return table.model().headerData(column, Qt.Orientation.Horizontal)


class Cell:
    """A cell of a table, as somebody reads it, clicks it and writes into it."""

    def __init__(self, table, row, column=1):
        self._table, self._index = table, table.model().index(row, column)

    def text(self):
        return self._index.data()

    def colour(self, selected):
        """Of the square in it, RGB from 0 to 1, where its row is selected and where it is not."""
        mode = QIcon.Mode.Selected if selected else QIcon.Mode.Normal
        square = self._index.data(Qt.ItemDataRole.DecorationRole).pixmap(QSize(14, 14), mode)
        return square.toImage().pixelColor(5, 5).getRgbF()[:3]

    def can_be_typed(self):
        return bool(self._index.flags() & Qt.ItemFlag.ItemIsEditable)

    def click(self):
        place = self._table.visualRect(self._index).center()
        QTest.mouseClick(self._table.viewport(), Qt.MouseButton.LeftButton, pos=place)

    def write(self, text):
        """Type something, and Return."""
        self._table.edit(self._index)
        *_, editor = self._table.viewport().findChildren(QLineEdit)
        editor.selectAll()
        QTest.keyClicks(editor, text)
        if not text:
            QTest.keyClick(editor, Qt.Key.Key_Delete)
        QTest.keyClick(editor, Qt.Key.Key_Return)
        # Qt has the editor answer the key first.
        QApplication.sendPostedEvents(self._table.itemDelegate(), int(QEvent.Type.MetaCall))

    @property
    def box(self):
        """What it is chosen by, rather than typed."""
        return self._table.indexWidget(self._index)

    def chosen(self):
        """What the box in it shows."""
        return self.box.currentText()

    def choose(self, words):
        """Choose from the box in it, by the keys."""
        while self.chosen() != words:
            QTest.keyClick(self.box, Qt.Key.Key_Down)
