"""A napari window that is operated by simulated mouse and keyboard, and pictures of it."""

from __future__ import annotations

import itertools
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
from qtpy.QtWidgets import QAbstractSpinBox, QApplication, QLineEdit, QWidget
from superqt import QCollapsible

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PLUGIN, TITLE = "napari-hmrf", "Soft tissue"
LEFT, NO_BUTTON = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
PLAIN, CTRL = Qt.KeyboardModifier.NoModifier, Qt.KeyboardModifier.ControlModifier
#: Corners of the mouse pointer (x, y), in pixels relative to its tip.
_POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12)]
#: Number of the most frequent colours of a picture that are preserved exactly.
_FREQUENT = 24

#: Position of an image pixel: (row, col).
Pixel = tuple[float, float]


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


class Window:
    """A napari window with simulated mouse and keyboard.

    The actions `click`, `choose`, `write`, `type`, `take` and `release` end when the dock is idle
    again.

    Parameters
    ----------
    size : (int, int)
        Width and height of the window, in pixels. The default fits on a small screen.
    """

    def __init__(self, size: tuple[int, int] = (1280, 690)) -> None:
        # Use temporary settings, so that the pictures show the window of a new user.
        self._settings = tempfile.TemporaryDirectory()
        QSettings.setPath(
            QSettings.Format.IniFormat, QSettings.Scope.UserScope, self._settings.name
        )
        self.viewer = napari.Viewer(title="napari")
        self.viewer.window.resize(*size)
        self._window: Any = self.viewer.window._qt_window
        self._canvas = self.viewer.window._qt_viewer.canvas
        #: Position of the mouse pointer on the screen.
        self._at = QPoint(0, 0)
        #: Image pixel on which the mouse button was pressed, or to which the mouse was moved last.
        self._pixel: Pixel = (0.0, 0.0)
        wait(0.3)

    def close(self) -> None:
        """Close the window."""
        self.viewer.close()
        QApplication.processEvents()

    # The dock

    @property
    def dock(self) -> Any:
        """Dock widget of the plugin, or None if it is closed."""
        docks = self.viewer.window.dock_widgets
        return next((inner for title, inner in docks.items() if title.startswith(TITLE)), None)

    @property
    def form(self) -> Any:
        """Form of the dock."""
        return self.dock._form

    def settle(self) -> None:
        """Wait until the dock is idle."""
        wait_until(lambda: self.dock is None or not self.dock.busy)

    def wait_for_solution(self) -> None:
        """Wait until the dock has a solution and is idle."""
        wait_until(lambda: self.dock.solution is not None and not self.dock.busy)

    def open_sample(self, name: str) -> None:
        """Open a sample from the menu, which opens the dock, too."""
        self.menu("File", "Open Sample", PLUGIN, name)
        wait(0.8)
        self.open_dock()

    def open_dock(self) -> None:
        """Open the dock from the menu if it is closed."""
        if self.dock is None:
            self.menu("Plugins", f"{TITLE} ({PLUGIN})")
        wait(0.5)
        self.settle()

    def take(self, tool: str) -> None:
        """Press the button of a tool, unless the tool is already active."""
        button = self.form.motion.tools[tool]
        self.show(button)
        if not (self.dock.active and self.dock.tool == tool):
            self._click(button)
        self.settle()

    # Mouse and keyboard on widgets

    def point_at(self, widget: QWidget, place: QPoint | None = None) -> QPoint:
        """Move the pointer onto a widget; return the position in the widget."""
        place = widget.rect().center() if place is None else place
        self._at = widget.mapToGlobal(place)
        return place

    def click(self, widget: Any, place: QPoint | None = None) -> None:
        """Click a Qt or magicgui widget."""
        self._click(widget, place)
        self.settle()

    def _click(self, widget: Any, place: QPoint | None = None) -> None:
        native = getattr(widget, "native", widget)
        QTest.mouseClick(native, LEFT, PLAIN, self.point_at(native, place))
        wait(0.1)

    def menu(self, *titles: str) -> Any:
        """Click through nested menus; return the last menu that was opened."""
        menu: Any = self._window.menuBar()
        for title in titles:
            (action,) = [each for each in menu.actions() if each.text().replace("&", "") == title]
            place = menu.actionGeometry(action).center()
            opened = action.menu()
            self._click(menu, place)
            wait(0.3)
            menu = menu if opened is None else opened
        return menu

    def point_at_entry(self, menu: Any, title: str) -> QPoint:
        """Move the pointer onto the entry of an open menu; return its position in the menu."""
        entry = next(each for each in menu.actions() if each.text().startswith(title))
        place = self.point_at(menu, menu.actionGeometry(entry).center())
        menu.setActiveAction(entry)
        return place

    def choose(self, combo: Any, words: str) -> None:
        """Choose an entry of a drop-down list."""
        native = getattr(combo, "native", combo)
        self._pick(native, words)
        wait_until(lambda: native.currentText() == words, seconds=5, rest=0.2)
        self.settle()

    def choose_in_table(self, table: Any, row: int, column: int, words: str) -> None:
        """Choose an entry of a drop-down list in a table cell."""
        self.show(table)
        index = table.model().index(row, column)
        table.scrollTo(index)
        wait(0.2)
        self._pick(table.indexWidget(index), words)
        # The table replaces the list when its row changes.
        wait_until(lambda: table.indexWidget(index).currentText() == words, seconds=5, rest=0.2)
        self.settle()

    def _pick(self, native: Any, words: str) -> None:
        """Open a drop-down list, and click an entry."""
        row = native.findText(words)
        if row < 0:
            raise LookupError(words)
        self._click(native)
        view = native.view()
        wait_until(view.isVisible)  # a list that has just opened may ignore a click
        view.scrollTo(native.model().index(row, 0))
        # An entry may be wider than the list.
        place = view.visualRect(native.model().index(row, 0)).intersected(view.viewport().rect())
        self._click(view.viewport(), place.center())

    def click_row(self, table: Any, row: int) -> None:
        """Click the first cell of a table row, which activates the brush of its label."""
        self.show(table)
        place = table.visualRect(table.model().index(row, 0)).center()
        self._click(table.viewport(), place)

    def write(self, table: Any, row: int, column: int, text: str) -> None:
        """Type text into a table cell."""
        self.show(table)
        place = table.visualRect(table.model().index(row, column)).center()
        self._click(table.viewport(), place)
        QTest.mouseDClick(table.viewport(), LEFT, PLAIN, place)
        wait(0.1)
        self._replace_text(table.findChild(QLineEdit), text)

    def type(self, field: Any, number: str) -> None:
        """Type a number into a field, or into the field next to a slider."""
        self.show(field)
        box = field.native
        box = box if isinstance(box, QAbstractSpinBox) else box.findChild(QAbstractSpinBox)
        self._click(box)
        self._replace_text(box, number)

    def _replace_text(self, editor: Any, text: str) -> None:
        QTest.keyClick(editor, Qt.Key.Key_A, CTRL)
        QTest.keyClicks(editor, text)
        QTest.keyClick(editor, Qt.Key.Key_Return)
        wait(0.2)
        self.settle()

    def show(self, widget: Any) -> None:
        """Open the section of a widget, and scroll to the widget."""
        native = getattr(widget, "native", widget)
        area, closed = native.parent(), []
        while area is not None and not hasattr(area, "ensureWidgetVisible"):
            if isinstance(area, QCollapsible) and not area.isExpanded():
                closed.append(area)
            area = area.parent()
        for section in reversed(closed):  # a section may be inside another one
            self._click(section.toggleButton())
            wait(1.0)  # the section opens gradually
        if area is not None:
            area.ensureWidgetVisible(native)
            wait(0.1)

    # Mouse and keyboard on the canvas

    @property
    def canvas(self) -> QWidget:
        """Canvas widget of the viewer."""
        native: QWidget = self._canvas.native
        return native

    def home(self) -> None:
        """Show the whole image."""
        self._click(self.viewer.window._qt_viewer.viewerButtons.resetViewButton)
        wait(0.2)

    def _place(self, pixel: Pixel) -> QPoint:
        """Return the position of an image pixel on the canvas, and move the pointer there."""
        self._pixel = pixel
        view = self._canvas.view
        x, y = (view.transform * view.scene.transform).map([*pixel[::-1]])[:2]
        return self.point_at(self.canvas, QPoint(round(x), round(y)))

    def press(self, pixel: Pixel) -> None:
        """Press the left mouse button over an image pixel."""
        QTest.mousePress(self.canvas, LEFT, PLAIN, self._place(pixel))

    def move(self, pixel: Pixel, button: Any = LEFT) -> None:
        """Move the mouse to an image pixel, and wait, because vispy drops rapid moves."""
        place = QPointF(self._place(pixel))
        event = QMouseEvent(
            QEvent.Type.MouseMove, place, QPointF(self._at), NO_BUTTON, button, PLAIN
        )
        QApplication.sendEvent(self.canvas, event)
        wait(0.03)

    def release(self) -> None:
        """Release the left mouse button."""
        QTest.mouseRelease(self.canvas, LEFT, PLAIN, self._place(self._pixel))
        wait(0.05)
        self.settle()

    def drag(self, *pixels: Pixel) -> None:
        """Drag the mouse through image pixels."""
        self.press(pixels[0])
        for pixel in pixels[1:]:
            self.move(pixel)
        self.release()

    def pull(self, *pixels: Pixel, steps: int = 12, rest: float = 0.0) -> None:
        """Drag tissue step by step, and wait for it after each step; do not release it."""
        self.press(pixels[0])
        for begin, end in itertools.pairwise(pixels):
            for step in range(1, steps + 1):
                self.move(between(begin, end, step / steps))
                self.wait_for_preview(rest)

    def wait_for_preview(self, rest: float = 0.0) -> None:
        """Wait until the window shows the tissue at the position of the mouse."""
        wait_until(lambda: not self.dock._controller.engine.busy, rest=rest)

    def key(self, key: Any, modifiers: Any = PLAIN) -> None:
        """Press a key while the canvas has the keyboard focus."""
        self.canvas.setFocus()
        QTest.keyClick(self.canvas, key, modifiers)
        wait(0.1)
        self.settle()

    # Pictures

    def picture(self, pointer: bool = True) -> Image.Image:
        """Return a picture of the window."""
        wait(0.05)
        shown = self.viewer.screenshot(canvas_only=False, flash=False)
        picture = Image.fromarray(np.asarray(shown)[..., :3])
        return self._with_pointer(picture) if pointer else picture

    def screen(self, pointer: bool = True) -> Image.Image:
        """Return a picture of the window, including open menus and windows in front of it."""
        wait(0.2)
        screen = self._window.screen()
        corner = self._window.mapToGlobal(QPoint(0, 0)) - screen.geometry().topLeft()
        size = self._window.size()
        grabbed = screen.grabWindow(0, corner.x(), corner.y(), size.width(), size.height())
        picture = to_pillow(grabbed.toImage())
        return self._with_pointer(picture) if pointer else picture

    def keep(self, name: str, *around: Any, pointer: bool = True) -> None:
        """Save a picture of the window, or of the region around widgets, to a file in `docs`."""
        picture = self.picture(pointer)
        save(picture.crop(self.region(*around)) if around else picture, DOCS / f"{name}.png")
        print(f"    {self.dock.status}")

    def region(self, *widgets: Any, margin: int = 8) -> tuple[int, int, int, int]:
        """Return the rectangle around widgets in the window: left, top, right, bottom."""
        around = QRect()
        for widget in widgets:
            native = getattr(widget, "native", widget)
            around = around.united(QRect(native.mapTo(self._window, QPoint(0, 0)), native.size()))
        around = around.adjusted(-margin, -margin, margin, margin)
        around = around.intersected(QRect(QPoint(0, 0), self._window.size()))
        return around.left(), around.top(), around.right() + 1, around.bottom() + 1

    def child(self, kind: type[Any]) -> Any:
        """Return the only child window of a type, moved to the middle of this window."""
        (child,) = self._window.findChildren(kind)
        middle = self._window.rect().center() - child.rect().center()
        child.move(self._window.mapToGlobal(middle))
        return child

    def _with_pointer(self, picture: Image.Image) -> Image.Image:
        """Return a picture with the mouse pointer, which screenshots do not include."""
        tip = self._at - self._window.mapToGlobal(QPoint(0, 0))
        corners = [(tip.x() + x, tip.y() + y) for x, y in _POINTER]
        ImageDraw.Draw(picture).polygon(corners, fill="white", outline="black", width=1)
        return picture


def between(begin: Pixel, end: Pixel, part: float) -> Pixel:
    """Return the position at a fraction of the way from one pixel to another."""
    return begin[0] + (end[0] - begin[0]) * part, begin[1] + (end[1] - begin[1]) * part


def to_pillow(picture: QImage) -> Image.Image:
    """Convert a Qt image to a Pillow image."""
    rgb = picture.convertToFormat(QImage.Format.Format_RGB888)
    bits = rgb.constBits()
    if hasattr(bits, "setsize"):
        bits.setsize(rgb.sizeInBytes())
    lines = np.frombuffer(bits, np.uint8).reshape(rgb.height(), rgb.bytesPerLine())
    return Image.fromarray(lines[:, : 3 * rgb.width()].reshape(rgb.height(), rgb.width(), 3).copy())


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
    report(path)


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
    report(path)


def report(path: Path) -> None:
    """Print the name and the size of a file that was written."""
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB", flush=True)
