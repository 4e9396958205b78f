"""What can be pressed, ticked and typed in a dock, found by the words that a person reads there."""

from __future__ import annotations

from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QAbstractButton, QAbstractSlider, QComboBox, QLabel, QTableWidget


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
        """Choose an entry of the menu that offers it."""
        (menu,) = (
            each for each in self._native.findChildren(QComboBox) if each.findText(entry) > -1
        )
        menu.setCurrentText(entry)

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

    def _table(self, name):
        tables = self._native.findChildren(QTableWidget)
        return next(
            (table, row)
            for table in tables
            for row in range(table.rowCount())
            for column in range(table.columnCount())
            if table.item(row, column) is not None and table.item(row, column).text() == name
        )

    def cell(self, name, title):
        """The cell in the row of that name, below that title."""
        table, row = self._table(name)
        (column,) = (
            each
            for each in range(table.columnCount())
            if table.horizontalHeaderItem(each).text().startswith(title)
        )
        return table.item(row, column)

    def click_row(self, name):
        """Click the name in a row of a table."""
        table, row = self._table(name)
        (column,) = (
            each
            for each in range(table.columnCount())
            if table.item(row, each) is not None and table.item(row, each).text() == name
        )
        place = table.visualItemRect(table.item(row, column)).center()
        QTest.mouseClick(table.viewport(), Qt.MouseButton.LeftButton, pos=place)
