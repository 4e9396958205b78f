"""Take the README's pictures, from a real napari window: ``make screenshots``."""

from __future__ import annotations

from window import ROOT, Person, save, wait_until

FOLDER = ROOT / "docs" / "images"
SAMPLE = "mass-effect"
SIZE = (1400, 900)


def main() -> None:
    """Open the sample, dock the widget, press Deform; a picture of each."""
    person = Person(SIZE)
    viewer = person.viewer
    viewer.open_sample("napari-hmrf", SAMPLE)
    wait_until(lambda: True)
    save(person.sight(), FOLDER / "sample.png")
    _, widget = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    viewer.reset_view()
    wait_until(lambda: widget.solution is not None and not widget.busy)
    save(person.sight(), FOLDER / "widget.png")
    widget.deform()
    wait_until(lambda: widget.idle)
    if widget.solution is None:
        raise RuntimeError(f"there is no result: {widget.status}")
    save(person.sight(), FOLDER / "result.png")
    viewer.close()


if __name__ == "__main__":
    main()
