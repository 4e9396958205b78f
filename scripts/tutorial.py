"""Pictures of a napari window for the tutorials, operated with mouse and keyboard.

``make screenshots`` takes all pictures. ``python scripts/tutorial.py landmarks`` takes the pictures
of one page.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import own_images
from PIL import Image
from qtpy.QtCore import QPoint, Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QAbstractSpinBox, QApplication
from window import LEFT, NO_BUTTON, ROOT, Person, save, save_animation, wait, wait_until

from napari_hmrf.ui.fit_window import FitWindow

FOLDER = ROOT / "docs" / "tutorials" / "images"
#: Size of the windows, in pixels, which fit on a small screen.
SIZE = (1280, 690)
#: Animation: visible part of the window, size of a frame, and duration of a frame.
CROP, FRAME, MILLISECONDS = (470, 560), (376, 448), 60
PLUGIN, TITLE = "napari-hmrf", "Soft tissue"
GROWING, PUSHED = "Brain with a growing tumour", "Brain with a tumour whose rim is pushed"
SLIDING = "Chest with lungs that slide along the wall"
#: Table columns: growth in per cent, sliding, and outward displacement of a boundary.
GROWS, SLIDES, OUT = 4, 5, 5
#: Label of the tumour of the samples.
TUMOUR = 3
CTRL = Qt.KeyboardModifier.ControlModifier


def keep(
    person: Person, name: str, *around: Any, pointer: bool = True, screen: bool = False
) -> None:
    """Save a picture of the window, or of the region around widgets."""
    picture = person.screen(pointer) if screen else person.sight(pointer)
    if around:
        picture = picture.crop(person.region(*around))
    save(picture, FOLDER / f"{name}.png")


def open_dock(person: Person) -> Any:
    """Return the dock, opened from the menu if no sample has opened it, after its solve."""
    if not any(title.startswith(TITLE) for title in person.viewer.window.dock_widgets):
        person.menu("Plugins", f"{TITLE} ({PLUGIN})")
    wait(0.5)
    dock = person.dock(TITLE)
    wait_until(lambda: not dock.busy)
    return dock


def show_painted(person: Person, dock: Any) -> None:
    """Show the paint and the deformed image of a sample."""
    wait_until(lambda: dock.solution is not None and not dock.busy)
    dock.stop()
    for name in ("Tissue", "Boundary"):
        person.viewer.layers[name].visible = True
    person.click(dock._form.result.before)
    wait_until(lambda: not dock.busy)


def open_sample(person: Person, name: str) -> None:
    """Open a sample from the menu."""
    person.menu("File", "Open Sample", PLUGIN, name)
    wait(0.8)


def take(person: Person, dock: Any, tool: str) -> None:
    """Press the button of a tool, unless the tool is already active."""
    button = dock._form.motion.tools[tool]
    person.show(button)
    if not (dock.active and dock.tool == tool):
        person.click(button)
    wait_until(lambda: not dock.busy)


def home(person: Person) -> None:
    """Show the whole image."""
    person.click(person.viewer.window._qt_viewer.viewerButtons.resetViewButton)
    wait(0.2)


def pulled(person: Person, dock: Any, *places: tuple[float, float], steps: int = 12) -> None:
    """Press the mouse button on tissue, and drag it through places, without releasing it."""
    person.press(*places[0])
    for begin, end in itertools.pairwise(places):
        for step in range(1, steps + 1):
            along = step / steps
            person.move(*(a + (b - a) * along for a, b in zip(begin, end, strict=True)))
            wait_until(lambda: not dock._controller.engine.busy, rest=0.0)


# The pages


def first(_: dict[str, Path]) -> None:
    """Take the pictures of the first deformation: a sample, the dock, a drag, a click."""
    person = Person(SIZE)
    menu = person.menu("Plugins")
    chosen = next(each for each in menu.actions() if each.text().startswith(TITLE))
    person.point_at(menu, menu.actionGeometry(chosen).center())
    menu.setActiveAction(chosen)
    save(person.screen().crop((0, 0, 860, 330)), FOLDER / "first-menu.png")
    person.click(menu, menu.actionGeometry(chosen).center())
    wait(0.5)
    menu = person.menu("File", "Open Sample", PLUGIN)
    chosen = next(each for each in menu.actions() if each.text() == GROWING)
    person.point_at(menu, menu.actionGeometry(chosen).center())
    menu.setActiveAction(chosen)
    save(person.screen().crop((0, 0, 920, 330)), FOLDER / "first-sample.png")
    person.click(menu, menu.actionGeometry(chosen).center())
    wait(1)
    dock = person.dock(TITLE)
    wait_until(lambda: not dock.busy)
    take(person, dock, "pull")
    keep(person, "first-on")
    pulled(person, dock, (140, 92), (124, 106))
    wait(0.5)
    keep(person, "first-drag")
    person.release(124, 106)
    wait_until(lambda: not dock.busy)
    person.drag((78, 112))
    wait_until(lambda: not dock.busy)
    keep(person, "first-hold")
    person.key(Qt.Key.Key_Z, CTRL)
    wait_until(lambda: not dock.busy)
    print(dock.status)
    person.viewer.close()


def animation(_: dict[str, Path]) -> None:
    """Record the animation of tissue that is pulled."""
    person = Person(SIZE)
    open_sample(person, GROWING)
    dock = open_dock(person)
    take(person, dock, "pull")
    person.viewer.canvas.overlays.text.visible = False
    frames: list[Image.Image] = []

    def look() -> None:
        sight = person.sight(pointer=True)
        canvas = person.canvas
        corner = canvas.mapTo(person.window, QPoint(0, 0))
        left = corner.x() + (canvas.width() - CROP[0]) // 2
        top = corner.y() + (canvas.height() - CROP[1]) // 2
        crop = sight.crop((left, top, left + CROP[0], top + CROP[1]))
        frames.append(crop.resize(FRAME, Image.Resampling.LANCZOS))

    def go(*places: tuple[float, float], steps: int, held: bool) -> None:
        """Move from place to place, and slow down near each place."""
        for begin, end in itertools.pairwise(places):
            for step in range(1, steps + 1):
                along = 0.5 - 0.5 * math.cos(math.pi * step / steps)
                place = [a + (b - a) * along for a, b in zip(begin, end, strict=True)]
                person.move(*place, button=LEFT if held else NO_BUTTON)
                wait_until(lambda: not dock._controller.engine.busy, rest=0.0)
                look()

    go((70, 40), (148, 112), steps=6, held=False)
    person.press(148, 112)
    go((148, 112), (128, 88), (136, 132), steps=14, held=True)
    person.release(136, 132)
    wait_until(lambda: not dock.busy)
    go((136, 132), (160, 170), steps=7, held=False)
    person.press(160, 170)
    go((160, 170), (136, 184), steps=14, held=True)
    person.release(136, 184)
    wait_until(lambda: not dock.busy)
    look()
    save_animation(frames, FOLDER / "grab-and-pull.gif", MILLISECONDS)
    person.viewer.close()


def tumour(_: dict[str, Path]) -> None:
    """Take the pictures of a growing tumour: linear, in large motion, and with a pushed rim."""
    person = Person(SIZE)
    open_sample(person, GROWING)
    dock = open_dock(person)
    form = dock._form
    show_painted(person, dock)
    keep(person, "tumour-painted", pointer=False)
    person.show(form.result.overlay.native)
    person.choose(form.result.overlay, "strain: equivalent")
    wait_until(lambda: not dock.busy)
    dock.result.visible = False
    wait_until(lambda: not dock.busy)
    keep(person, "tumour-strain")
    person.choose(form.result.overlay, "none")
    dock.result.visible = True
    table = form.tissue.table
    (row,) = [number for number, each in enumerate(table.rows) if each.name == "tumour"]
    person.write(table, row, GROWS, "60")
    wait_until(lambda: not dock.busy)
    person.show(table)
    keep(person, "tumour-table", table, form.tissue.choice)
    person.write(table, row, GROWS, "120")
    wait_until(lambda: not dock.busy)
    person.click(form.footer.chip)
    wait_until(lambda: not dock.busy)
    print(dock.status, dock.warning)
    keep(person, "tumour-folds")
    person.click(form.footer.other)
    wait_until(lambda: not dock.busy)
    print(dock.model, dock.status, dock.warning)
    keep(person, "tumour-large")
    person.viewer.close()
    person = Person(SIZE)
    open_sample(person, PUSHED)
    dock = open_dock(person)
    show_painted(person, dock)
    person.show(dock._form.motion.boundary.table)
    keep(person, "tumour-pushed", pointer=False)
    person.viewer.close()


def landmarks(_: dict[str, Path]) -> None:
    """Take the pictures of landmarks: drawn with the mouse, and from two points layers."""
    person = Person(SIZE)
    open_sample(person, "Brain that expands outward")
    dock = open_dock(person)
    take(person, dock, "landmark")
    keep(person, "landmarks-tool")
    for where, should in (((96, 106), (88, 98)), ((150, 112), (156, 104)), ((96, 150), (91, 156))):
        person.drag(where, should)
        wait_until(lambda: not dock.busy)
        print(dock.status, len(dock.drawing.marks))
    keep(person, "landmarks-pairs")
    person.show(dock._form.motion.clear.native)
    person.click(dock._form.motion.clear)
    wait_until(lambda: not dock.busy)
    layers = []
    for places in (((96, 106), (150, 112), (96, 150)), ((88, 98), (156, 104), (91, 156))):
        person.menu("File", "New Layer", "Points")
        layers.append(person.viewer.layers.selection.active)
        person.key(Qt.Key.Key_2)
        for place in places:
            person.drag(place)
            wait(0.5)
    choice = dock._form.motion.boundary.landmarks
    person.show(choice.sources.native)
    person.choose(choice.sources, layers[0].name)
    person.click(choice.take_button)
    wait_until(lambda: not dock.busy)
    print(dock.status, len(dock.drawing.marks))
    keep(person, "landmarks-points")
    person.viewer.close()


def painting(person: Person, table: Any, row: int) -> None:
    """Activate the brush of a table row."""
    person.show(table)
    person.click(table.viewport(), table.visualRect(table.model().index(row, 0)).center())


def ring(person: Person, centre: tuple[float, float], radii: tuple[float, float]) -> None:
    """Paint a ring with the active brush."""
    turns = [2 * math.pi * step / 40 for step in range(41)]
    (row, col), (down, along) = centre, radii
    person.drag(*((row + down * math.sin(t), col + along * math.cos(t)) for t in turns))


def typed(person: Person, field: Any, number: str) -> None:
    """Type a number into a field, or into the field next to a slider."""
    person.show(field)
    box = field.native
    box = box if isinstance(box, QAbstractSpinBox) else box.findChild(QAbstractSpinBox)
    person.click(box)
    QTest.keyClick(box, Qt.Key.Key_A, CTRL)
    QTest.keyClicks(box, number)
    QTest.keyClick(box, Qt.Key.Key_Return)
    wait(0.2)


def brushes(_: dict[str, Path]) -> None:
    """Take the picture of a confidence stroke with a soft edge."""
    person = Person(SIZE)
    open_sample(person, GROWING)
    dock = open_dock(person)
    take(person, dock, "pull")
    person.choose(dock.fields.components, "left and right only (columns)")
    pulled(person, dock, (140, 92), (140, 104))
    person.release(140, 104)
    wait_until(lambda: not dock.busy)
    take(person, dock, "confidence")
    typed(person, dock.fields.radius, "16")
    typed(person, dock.fields.stroke_confidence, "0.2")
    typed(person, dock.fields.softness, "1")
    pulled(person, dock, (52, 92), (60, 66), (84, 48), steps=6)
    person.release(84, 48)
    wait_until(lambda: not dock.busy)
    keep(person, "brushes-confidence")
    print(dock.status, dock.drawing.marks[-1].confidence, dock.drawing.marks[-1].softness)
    person.viewer.close()


def resection(_: dict[str, Path]) -> None:
    """Take the pictures of a removed tumour, and of the brain that sinks into its cavity."""
    person = Person(SIZE)
    open_sample(person, GROWING)
    dock = open_dock(person)
    wait_until(lambda: dock.solution is not None and not dock.busy)
    dock.stop()
    take(person, dock, "remove")
    typed(person, dock.fields.radius, "32")
    person.drag((199, 198), (199, 199))
    wait_until(lambda: not dock.busy)
    keep(person, "resection-painted")
    form = dock._form.motion
    person.show(form.weight.way)
    person.choose(form.weight.way, "down")
    typed(person, form.weight.amount, "0.05")
    wait_until(lambda: not dock.busy)
    before = dock.solution.displacement
    person.show(form.cavity.contents)
    keep(person, "resection-empty")
    person.choose(form.cavity.contents, "fluid")
    person.show(form.cavity.level)
    typed(person, form.cavity.fluid, "0.05")
    wait_until(lambda: not dock.busy)
    keep(person, "resection-filled")
    for row in (165, 233):
        print(row, before[row, 198], dock.solution.displacement[row, 198])
    print(dock.status, dock.warning)
    person.viewer.close()


def sliding(_: dict[str, Path]) -> None:
    """Take the pictures of lungs that slide along the chest wall, and that stick to it."""
    person = Person(SIZE)
    open_sample(person, SLIDING)
    dock = open_dock(person)
    form = dock._form
    person.click(form.footer.deform)
    wait_until(lambda: dock.solution is not None and not dock.busy)
    keep(person, "sliding-moved")
    table = form.tissue.table
    person.show(table)
    person.choose(form.result.overlay, "strain: equivalent")
    wait_until(lambda: not dock.busy)
    keep(person, "sliding-strain")
    print(dock.status, dock.warning)
    (row,) = [number for number, each in enumerate(table.rows) if each.name == "lungs"]
    person.choose_in_table(table, row, SLIDES, "no")
    wait_until(lambda: not dock.busy)
    keep(person, "sliding-stuck")
    print(dock.status, dock.warning)
    person.viewer.close()


def own(images: dict[str, Path]) -> None:
    """Take the pictures of a PNG file."""
    person = Person(SIZE)
    person.viewer.open(str(images["png"]), plugin="napari")
    wait(0.5)
    dock = open_dock(person)
    form = dock._form
    home(person)
    person.show(form.make)
    person.click(form.make)
    wait_until(lambda: not dock.busy)
    keep(person, "own-layers")
    painting(person, form.tissue.table, 3)
    person.viewer.layers["Tissue"].brush_size = 24
    person.drag((110, 98), (112, 98), (116, 96), (108, 102))
    wait_until(lambda: not dock.busy)
    keep(person, "own-tissue")
    painting(person, form.motion.boundary.table, 1)
    ring(person, (112, 98), (21, 22))
    painting(person, form.motion.boundary.table, 0)
    person.drag((204, 150), (204, 170), (204, 190))
    wait_until(lambda: not dock.busy)
    person.viewer.layers.selection = {dock.image}
    wait_until(lambda: not dock.busy)
    print(dock.status)
    keep(person, "own-result")
    person.viewer.close()


def photograph(images: dict[str, Path]) -> None:
    """Take the pictures of an RGB photograph, with stiffness from its intensity."""
    person = Person(SIZE)
    person.viewer.open(str(images["photograph"]), plugin="napari")
    wait(0.5)
    dock = open_dock(person)
    home(person)
    person.show(dock._form.intensity)
    person.click(dock._form.intensity)
    wait_until(lambda: not dock.busy)
    print(dock.status)
    keep(person, "photograph-curve")
    take(person, dock, "pull")
    pulled(person, dock, (175, 245), (160, 232))
    person.release(160, 232)
    wait_until(lambda: not dock.busy)
    print(dock.status)
    keep(person, "photograph-pulled")
    person.viewer.close()


def stack(images: dict[str, Path]) -> None:
    """Take the picture of a slice of a stack."""
    person = Person(SIZE)
    person.viewer.open(str(images["stack"]), plugin="napari")
    wait(0.5)
    dock = open_dock(person)
    take(person, dock, "pull")
    home(person)
    print(dock.status)
    pulled(person, dock, (112, 98), (100, 120))
    person.release(100, 120)
    wait_until(lambda: not dock.busy)
    print(dock.status)
    keep(person, "stack-pulled")
    person.viewer.dims.set_current_step(0, 5)
    wait_until(lambda: not dock.busy)
    print(dock.status)
    person.viewer.close()


def volume(_: dict[str, Path]) -> None:
    """Take the pictures of a tumour in a volume: pulled in a slice, then in other slices."""
    person = Person(SIZE)
    open_sample(person, "Head with a growing tumour (volume)")
    dock = open_dock(person)
    form, viewer = dock._form, person.viewer
    show_painted(person, dock)
    viewer.dims.set_point(0, 10.0)
    wait(0.5)
    keep(person, "volume-opened", pointer=False)
    print(dock.status, dock.warning)
    table = form.motion.boundary.table
    person.show(table)
    person.write(table, 1, OUT, "3")
    wait_until(lambda: not dock.busy)
    print(dock.status, dock.warning)
    take(person, dock, "pull")
    pulled(person, dock, (-10, -30), (-18, -40))
    keep(person, "volume-pulled")
    person.release(-18, -40)
    wait_until(lambda: not dock.busy)
    person.click(viewer.window._qt_viewer.viewerButtons.rollDimsButton)
    wait(0.5)
    viewer.dims.set_point(2, 30.0)
    person.show(form.result.overlay.native)
    person.choose(form.result.overlay, "strain: equivalent")
    wait_until(lambda: not dock.busy)
    dock.result.visible = False
    home(person)
    keep(person, "volume-strain")
    print(dock.status, dock.warning)
    viewer.close()


def views(_: dict[str, Path]) -> None:
    """Take the picture of the tumour in three views, if the plugin for them is installed."""
    try:
        from napari_orthogonal_views.ortho_view_manager import show_orthogonal_views
    except ImportError:
        print("napari-orthogonal-views is not installed: no picture of three views")
        return
    person = Person((1480, 860))
    open_sample(person, "Head with a growing tumour (volume)")
    dock = open_dock(person)
    viewer = person.viewer
    show_painted(person, dock)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of that plugin
        show_orthogonal_views(viewer)
    wait(1)
    for name in ("Boundary", "Tissue"):
        viewer.layers[name].visible = False
    for axis, place in enumerate((10.0, 28.0, 30.0)):
        viewer.dims.set_point(axis, place)
    person.choose(dock._form.result.overlay, "displacement (mm)")
    wait_until(lambda: not dock.busy)
    home(person)
    wait(0.5)
    keep(person, "volume-views", pointer=False)
    viewer.close()


def fit(_: dict[str, Path]) -> None:
    """Take the picture of a fit to a second image."""
    person = Person(SIZE)
    open_sample(person, "Brain before and after its tumour grew (two images)")
    dock = open_dock(person)
    result = dock._form.result
    person.show(result.second)
    person.choose(result.second, "After")
    wait_until(lambda: not dock.busy)
    person.show(result.registration.fit)
    person.click(result.registration.fit)
    (window,) = person.window.findChildren(FitWindow)
    window.tick(TUMOUR, "growth")
    window.start()
    wait_until(lambda: not dock.busy and dock.solution is not None)
    place = person.window.rect().center() - window.rect().center()
    window.move(person.window.mapToGlobal(place))
    wait(0.5)
    save(person.screen(False), ROOT / "docs" / "how-to" / "images" / "fit.png")
    person.viewer.close()


PAGES: dict[str, Callable[[dict[str, Path]], None]] = {
    "first": first,
    "animation": animation,
    "tumour": tumour,
    "landmarks": landmarks,
    "brushes": brushes,
    "resection": resection,
    "sliding": sliding,
    "own": own,
    "photograph": photograph,
    "stack": stack,
    "volume": volume,
    "views": views,
    "fit": fit,
}


def main(names: list[str]) -> None:
    """Take the pictures of the named pages, or of all pages."""
    with tempfile.TemporaryDirectory() as folder:
        images = own_images.write(Path(folder))
        for name in names or list(PAGES):
            PAGES[name](images)
            QApplication.processEvents()


if __name__ == "__main__":
    main(sys.argv[1:])
