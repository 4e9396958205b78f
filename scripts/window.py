"""A real napari window, somebody before it, and pictures of what they see."""

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

ROOT = Path(__file__).resolve().parent.parent
LEFT, NO_BUTTON = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
PLAIN = Qt.KeyboardModifier.NoModifier
#: The pointer, in pixels from its tip.
_POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12)]

#: How many of the most frequent colours of a picture are kept exactly.
_FREQUENT = 24


def wait(seconds: float) -> None:
    """Let Qt work for a while."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.005)


def wait_until(done: Callable[[], bool], seconds: float = 120.0, rest: float = 1.0) -> None:
    """Let Qt work until something is the case, and what follows from it is drawn."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing happened within {seconds:g} s")
        wait(0.01)
    wait(rest)


class Person:
    """Uses a window as people do, with the mouse and the keyboard.

    Parameters
    ----------
    size : (int, int)
        Of the window, in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        # Pictures show what somebody finds who has never been here, and leave nothing behind.
        self._settings = tempfile.TemporaryDirectory()
        QSettings.setPath(
            QSettings.Format.IniFormat, QSettings.Scope.UserScope, self._settings.name
        )
        self.viewer = napari.Viewer(title="napari")
        self.viewer.window.resize(*size)
        self.window: Any = self.viewer.window._qt_window
        self._canvas = self.viewer.window._qt_viewer.canvas
        #: The pointer, on the screen.
        self.at = QPoint(0, 0)
        wait(0.3)

    # What is where

    def place(self, row: float, col: float) -> QPoint:
        """Return the place of a pixel of the image on the canvas."""
        view = self._canvas.view
        x, y = (view.transform * view.scene.transform).map([col, row])[:2]
        return QPoint(round(x), round(y))

    def dock(self, name: str) -> Any:
        """Return a dock widget by the beginning of its name."""
        docks = self.viewer.window.dock_widgets
        return next(inner for title, inner in docks.items() if title.startswith(name))

    # The mouse

    def point_at(self, widget: QWidget, place: QPoint | None = None) -> QPoint:
        """Move the pointer onto a widget; where that is in it."""
        place = widget.rect().center() if place is None else place
        self.at = widget.mapToGlobal(place)
        return place

    def click(self, widget: Any, place: QPoint | None = None) -> None:
        """Click a widget of Qt's or of magicgui's."""
        native = getattr(widget, "native", widget)
        place = self.point_at(native, place)
        QTest.mouseClick(native, LEFT, PLAIN, place)
        wait(0.1)

    def tick(self, box: Any) -> None:
        """Click the square of a box that can be ticked."""
        self.click(box, QPoint(10, box.native.height() // 2))

    def menu(self, *titles: str) -> Any:
        """Go through menus by clicking; the last one opened."""
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
        """Choose from a list that opens."""
        native = getattr(combo, "native", combo)
        row = native.findText(words)
        if row < 0:
            raise LookupError(words)
        self.click(native)
        view = native.view()
        wait_until(
            view.isVisible, rest=0.5
        )  # a list that has just opened takes a click for its own
        view.scrollTo(native.model().index(row, 0))
        self.click(view.viewport(), view.visualRect(native.model().index(row, 0)).center())
        wait_until(lambda: native.currentText() == words, seconds=5, rest=0.2)

    def write(self, table: Any, row: int, column: int, text: str) -> None:
        """Write into the cell of a table."""
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
        """Scroll to a widget."""
        native = getattr(widget, "native", widget)
        area = native.parent()
        while area is not None and not hasattr(area, "ensureWidgetVisible"):
            area = area.parent()
        if area is not None:
            area.ensureWidgetVisible(native)
            wait(0.1)

    def press(self, row: float, col: float) -> None:
        """Press the button over a pixel of the image."""
        place = self.point_at(self._canvas.native, self.place(row, col))
        QTest.mousePress(self._canvas.native, LEFT, PLAIN, place)

    def move(self, row: float, col: float, button: Any = LEFT) -> None:
        """Move the mouse to a pixel of the image; vispy drops moves that follow closely."""
        native = self._canvas.native
        place = QPointF(self.point_at(native, self.place(row, col)))
        event = QMouseEvent(
            QEvent.Type.MouseMove, place, QPointF(self.at), NO_BUTTON, button, PLAIN
        )
        QApplication.sendEvent(native, event)
        wait(0.03)

    def release(self, row: float, col: float) -> None:
        """Let the button go over a pixel of the image."""
        place = self.point_at(self._canvas.native, self.place(row, col))
        QTest.mouseRelease(self._canvas.native, LEFT, PLAIN, place)
        wait(0.05)

    def drag(self, *places: Sequence[float]) -> None:
        """Drag through pixels of the image."""
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
        self.release(*places[-1])

    def key(self, key: Any, modifiers: Any = PLAIN) -> None:
        """Press a key while the canvas listens."""
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
        """Return a picture of the window with the open menus in front of it."""
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
        """Return the rectangle of the window around widgets: left, top, right, bottom."""
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
        """The canvas."""
        native: QWidget = self._canvas.native
        return native


def to_pillow(picture: QImage) -> Image.Image:
    """Convert a picture of Qt to one of Pillow."""
    rgb = picture.convertToFormat(QImage.Format.Format_RGB888)
    bits = rgb.constBits()
    if hasattr(bits, "setsize"):
        bits.setsize(rgb.sizeInBytes())
    lines = np.frombuffer(bits, np.uint8).reshape(rgb.height(), rgb.bytesPerLine())
    return Image.fromarray(lines[:, : 3 * rgb.width()].reshape(rgb.height(), rgb.width(), 3).copy())


def draw_pointer(picture: Image.Image, tip: tuple[int, int]) -> None:
    """Draw the pointer: no screenshot has it."""
    corners = [(tip[0] + x, tip[1] + y) for x, y in _POINTER]
    ImageDraw.Draw(picture).polygon(corners, fill="white", outline="black", width=1)


def palette_of(pictures: Sequence[Image.Image], greys: int, colours: int) -> Image.Image:
    """Find the few colours that show pictures best, as an image that has them.

    Greys are of tissue, and many; colours are of the window, and some are those of few pixels, such
    as a label's in a table. The usual methods lose one or the other.
    """
    pixels = np.concatenate([np.asarray(each.convert("RGB")).reshape(-1, 3) for each in pictures])
    coloured = pixels[np.ptp(pixels.astype(int), axis=1) >= 6]
    row = Image.fromarray(coloured[None] if len(coloured) else pixels[None, :1])
    found = row.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    values = found.getpalette() or []
    # What the window is mostly made of, as it is.
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
    """Write a PNG of few colours, which makes it small."""
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = palette_of([picture], greys=64, colours=160)
    few = picture.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path.relative_to(ROOT)}: {picture.width} x {picture.height}, {kilobytes(path)}")


def save_animation(frames: Iterable[Image.Image], path: Path, milliseconds: int) -> None:
    """Write a GIF whose frames share their colours; it rests at its end."""
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
    """How large a file is."""
    return f"{path.stat().st_size / 1000:.0f} kB"
