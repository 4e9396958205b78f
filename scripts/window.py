"""Simulated user of a real napari window, and pictures of the window."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import napari
import numpy as np
from PIL import Image, ImageDraw
from qtpy.QtCore import QEvent, QPoint, QPointF, QRect, QSettings, Qt
from qtpy.QtGui import QImage, QMouseEvent
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QApplication, QLineEdit, QWidget
from superqt import QCollapsible

ROOT = Path(__file__).resolve().parent.parent
LEFT, NO_BUTTON = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
PLAIN = Qt.KeyboardModifier.NoModifier
#: Corners of the mouse pointer (x, y), in pixels relative to its tip.
_POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12)]

#: Number of the most frequent colours of a picture that are preserved exactly.
_FREQUENT = 24


def wait(seconds: float) -> None:
    """Process Qt events for a number of seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.005)


def wait_until(done: Callable[[], bool], seconds: float = 120.0, rest: float = 1.0) -> None:
    """Process Qt events until a condition is true, and then for `rest` seconds."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"the condition was not true within {seconds:g} s")
        wait(0.01)
    wait(rest)


class Person:
    """Simulated user that operates a window with the mouse and the keyboard.

    Parameters
    ----------
    size : (int, int)
        Width and height of the window, in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        # Use temporary settings, so that the pictures show the window of a new user.
        self._settings = tempfile.TemporaryDirectory()
        QSettings.setPath(
            QSettings.Format.IniFormat, QSettings.Scope.UserScope, self._settings.name
        )
        self.viewer = napari.Viewer(title="napari")
        self.viewer.window.resize(*size)
        self.window: Any = self.viewer.window._qt_window
        self._canvas = self.viewer.window._qt_viewer.canvas
        #: Position of the mouse pointer on the screen.
        self.at = QPoint(0, 0)
        wait(0.3)

    # Positions

    def place(self, row: float, col: float) -> QPoint:
        """Return the position of an image pixel on the canvas."""
        view = self._canvas.view
        x, y = (view.transform * view.scene.transform).map([col, row])[:2]
        return QPoint(round(x), round(y))

    def dock(self, name: str) -> Any:
        """Return the dock widget with a name that starts with `name`."""
        docks = self.viewer.window.dock_widgets
        return next(inner for title, inner in docks.items() if title.startswith(name))

    # The mouse

    def point_at(self, widget: QWidget, place: QPoint | None = None) -> QPoint:
        """Move the pointer onto a widget; return the position in the widget."""
        place = widget.rect().center() if place is None else place
        self.at = widget.mapToGlobal(place)
        return place

    def click(self, widget: Any, place: QPoint | None = None) -> None:
        """Click a Qt or magicgui widget."""
        native = getattr(widget, "native", widget)
        place = self.point_at(native, place)
        QTest.mouseClick(native, LEFT, PLAIN, place)
        wait(0.1)

    def tick(self, box: Any) -> None:
        """Click the square of a check box."""
        self.click(box, QPoint(10, box.native.height() // 2))

    def menu(self, *titles: str) -> Any:
        """Click through nested menus; return the last menu that was opened."""
        menu: Any = self.window.menuBar()
        for title in titles:
            (action,) = [each for each in menu.actions() if each.text().replace("&", "") == title]
            place = menu.actionGeometry(action).center()
            opened = action.menu()
            self.click(menu, place)
            wait(0.3)
            if opened is not None:
                menu = opened
        return menu

    def choose(self, combo: Any, words: str) -> None:
        """Choose an entry of a drop-down list."""
        native = getattr(combo, "native", combo)
        self._pick(native, words)
        wait_until(lambda: native.currentText() == words, seconds=5, rest=0.2)

    def choose_in_table(self, table: Any, row: int, column: int, words: str) -> None:
        """Choose an entry of a drop-down list in a table cell."""
        self.show(table)
        index = table.model().index(row, column)
        table.scrollTo(index)
        wait(0.2)
        self._pick(table.indexWidget(index), words)
        # The table replaces the list when its row changes.
        wait_until(lambda: table.indexWidget(index).currentText() == words, seconds=5, rest=0.2)

    def _pick(self, native: Any, words: str) -> None:
        """Open a drop-down list, and click an entry."""
        row = native.findText(words)
        if row < 0:
            raise LookupError(words)
        self.click(native)
        view = native.view()
        wait_until(view.isVisible, rest=0.5)  # a list that has just opened may ignore a click
        view.scrollTo(native.model().index(row, 0))
        # An entry may be wider than the list.
        place = view.visualRect(native.model().index(row, 0)).intersected(view.viewport().rect())
        self.click(view.viewport(), place.center())

    def write(self, table: Any, row: int, column: int, text: str) -> None:
        """Type text into a table cell."""
        self.show(table)
        place = table.visualRect(table.model().index(row, column)).center()
        self.click(table.viewport(), place)
        QTest.mouseDClick(table.viewport(), LEFT, PLAIN, place)
        wait(0.1)
        editor = table.findChild(QLineEdit)
        QTest.keyClick(editor, Qt.Key.Key_A, Qt.KeyboardModifier.ControlModifier)
        QTest.keyClicks(editor, text)
        QTest.keyClick(editor, Qt.Key.Key_Return)
        wait(0.2)

    def show(self, widget: Any) -> None:
        """Open the section of a widget, and scroll to the widget."""
        native = getattr(widget, "native", widget)
        area = native.parent()
        while area is not None and not hasattr(area, "ensureWidgetVisible"):
            if isinstance(area, QCollapsible) and not area.isExpanded():
                self.click(area.toggleButton())
                wait(1.0)  # the section opens gradually
            area = area.parent()
        if area is not None:
            area.ensureWidgetVisible(native)
            wait(0.1)

    def press(self, row: float, col: float) -> None:
        """Press the left mouse button over an image pixel."""
        place = self.point_at(self._canvas.native, self.place(row, col))
        QTest.mousePress(self._canvas.native, LEFT, PLAIN, place)

    def move(self, row: float, col: float, button: Any = LEFT) -> None:
        """Move the mouse to an image pixel, and wait, because vispy drops rapid moves."""
        native = self._canvas.native
        place = QPointF(self.point_at(native, self.place(row, col)))
        event = QMouseEvent(
            QEvent.Type.MouseMove, place, QPointF(self.at), NO_BUTTON, button, PLAIN
        )
        QApplication.sendEvent(native, event)
        wait(0.03)

    def release(self, row: float, col: float) -> None:
        """Release the left mouse button over an image pixel."""
        place = self.point_at(self._canvas.native, self.place(row, col))
        QTest.mouseRelease(self._canvas.native, LEFT, PLAIN, place)
        wait(0.05)

    def drag(self, *places: Sequence[float]) -> None:
        """Drag the mouse through image pixels."""
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
        self.release(*places[-1])

    def key(self, key: Any, modifiers: Any = PLAIN) -> None:
        """Press a key while the canvas has the keyboard focus."""
        self._canvas.native.setFocus()
        QTest.keyClick(self._canvas.native, key, modifiers)
        wait(0.1)

    # Pictures

    def sight(self, pointer: bool = False) -> Image.Image:
        """Return a picture of the window."""
        wait(0.05)
        shown = self.viewer.screenshot(canvas_only=False, flash=False)
        picture = Image.fromarray(np.asarray(shown)[..., :3])
        if pointer:
            tip = self.at - self.window.mapToGlobal(QPoint(0, 0))
            draw_pointer(picture, (tip.x(), tip.y()))
        return picture

    def screen(self, pointer: bool = True) -> Image.Image:
        """Return a picture of the window, including open menus in front of it."""
        wait(0.2)
        screen = self.window.screen()
        corner = self.window.mapToGlobal(QPoint(0, 0)) - screen.geometry().topLeft()
        size = self.window.size()
        grabbed = screen.grabWindow(0, corner.x(), corner.y(), size.width(), size.height())
        picture = to_pillow(grabbed.toImage())
        if pointer:
            tip = self.at - self.window.mapToGlobal(QPoint(0, 0))
            draw_pointer(picture, (tip.x(), tip.y()))
        return picture

    def region(self, *widgets: Any, margin: int = 8) -> tuple[int, int, int, int]:
        """Return the rectangle around widgets in the window: left, top, right, bottom."""
        around = QRect()
        for widget in widgets:
            native = getattr(widget, "native", widget)
            corner = native.mapTo(self.window, QPoint(0, 0))
            around = around.united(QRect(corner, native.size()))
        around = around.adjusted(-margin, -margin, margin, margin)
        around = around.intersected(QRect(QPoint(0, 0), self.window.size()))
        return around.left(), around.top(), around.right() + 1, around.bottom() + 1

    @property
    def canvas(self) -> QWidget:
        """Canvas widget of the viewer."""
        native: QWidget = self._canvas.native
        return native


def to_pillow(picture: QImage) -> Image.Image:
    """Convert a Qt image to a Pillow image."""
    rgb = picture.convertToFormat(QImage.Format.Format_RGB888)
    bits = rgb.constBits()
    if hasattr(bits, "setsize"):
        bits.setsize(rgb.sizeInBytes())
    lines = np.frombuffer(bits, np.uint8).reshape(rgb.height(), rgb.bytesPerLine())
    return Image.fromarray(lines[:, : 3 * rgb.width()].reshape(rgb.height(), rgb.width(), 3).copy())


def draw_pointer(picture: Image.Image, tip: tuple[int, int]) -> None:
    """Draw the mouse pointer, which screenshots do not include."""
    corners = [(tip[0] + x, tip[1] + y) for x, y in _POINTER]
    ImageDraw.Draw(picture).polygon(corners, fill="white", outline="black", width=1)


def palette_of(pictures: Sequence[Image.Image], greys: int, colours: int) -> Image.Image:
    """Return an image with a small palette that represents the given pictures.

    Tissue has many greys. The window has colours, and some of them cover only a few pixels, such as
    the colour of a label in a table. The usual methods lose greys or such colours.
    """
    pixels = np.concatenate([np.asarray(each.convert("RGB")).reshape(-1, 3) for each in pictures])
    coloured = pixels[np.ptp(pixels.astype(int), axis=1) >= 6]
    row = Image.fromarray(coloured[None] if len(coloured) else pixels[None, :1])
    found = row.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    values = found.getpalette() or []
    # Preserve the most frequent colours, which are those of the window.
    packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    different, counts = np.unique(packed, return_counts=True)
    for colour in different[np.argsort(counts)[-_FREQUENT:]].tolist():
        values += [colour >> 16, (colour >> 8) & 255, colour & 255]
    for grey in np.linspace(0, 255, greys).round().astype(int).tolist():
        values += [grey] * 3
    palette = Image.new("P", (1, 1))
    palette.putpalette(values)
    return palette


def save(picture: Image.Image, path: Path) -> None:
    """Write a PNG file with few colours, which reduces its size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = palette_of([picture], greys=64, colours=160)
    few = picture.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.relative_to(ROOT)}: {picture.width} x {picture.height}, {kilobytes(path)}")


def save_animation(frames: Iterable[Image.Image], path: Path, milliseconds: int) -> None:
    """Write a GIF file with the same palette for all frames, and a pause at the end."""
    frames = [frame.convert("RGB") for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = palette_of(frames[::8], greys=64, colours=32)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [milliseconds] * (len(few) - 1) + [15 * milliseconds]
    few[0].save(
        path, save_all=True, append_images=few[1:], duration=durations, loop=0, optimize=True
    )
    print(f"{path.relative_to(ROOT)}: {len(few)} frames, {kilobytes(path)}")


def kilobytes(path: Path) -> str:
    """Return the size of a file as a text, in kilobytes."""
    return f"{path.stat().st_size / 1000:.0f} kB"
