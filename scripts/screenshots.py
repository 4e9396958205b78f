"""Pictures of a napari window for the README: ``make screenshots``."""

from __future__ import annotations

from typing import Any

from qtpy.QtWidgets import QTableView
from window import ROOT, Person, save, wait_until

FOLDER = ROOT / "docs" / "images"
SAMPLE = "growth"
SIZE = (1400, 900)
#: Number of steps of a drag; the script waits for the tissue after each step.
_STEPS = 10


def main() -> None:
    """Open the sample, and take pictures of the tissue, a drag, its result and a warning."""
    person = Person(SIZE)
    viewer = person.viewer
    viewer.open_sample("napari-hmrf", SAMPLE)
    _, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    viewer.reset_view()
    wait_until(lambda: dock.solution is not None and not dock.busy)
    dock.hand_brush(viewer.layers["Tissue"])
    wait_until(lambda: not dock.busy)
    table = dock.native.findChild(QTableView)
    person.show(table)
    save(person.sight(), FOLDER / "tissue.png")
    dock.native.setFocus()
    person.click(dock._form.sections["tissue"].toggleButton())
    dock.start()
    wait_until(lambda: not dock.busy)
    begin, end = (140, 92), (122, 108)
    drag(person, dock, begin, end)
    save(person.sight(pointer=True), FOLDER / "motion.png")
    person.release(*end)
    dock.overlay = "equivalent"
    wait_until(lambda: not dock.busy)
    save(person.sight(), FOLDER / "result.png")
    drag(person, dock, end, (76, 132))
    person.release(76, 132)
    wait_until(lambda: not dock.busy)
    person.click(dock._form.footer.chip)
    wait_until(lambda: not dock.busy)
    if "folds" not in dock.warning:
        raise RuntimeError(f"the tissue does not fold: {dock.warning}")
    save(person.sight(), FOLDER / "warning.png")
    viewer.close()


def drag(person: Person, dock: Any, begin: tuple[int, int], end: tuple[int, int]) -> None:
    """Press the mouse button on tissue, and drag it step by step, without releasing the button."""
    person.press(*begin)
    for step in range(1, _STEPS + 1):
        part = step / _STEPS
        person.move(*(a + (b - a) * part for a, b in zip(begin, end, strict=True)))
        wait_until(lambda: not dock._controller.engine.busy, rest=0.05)


if __name__ == "__main__":
    main()
