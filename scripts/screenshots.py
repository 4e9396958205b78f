"""Pictures of the documentation: of a napari window, of the examples and of the notebooks.

    python scripts/screenshots.py [scene ...]

Each scene takes the pictures of one page. Without arguments, all scenes run; the beginning of a
name, such as ``tutorials`` or ``examples/sweep``, selects scenes. Most scenes operate a napari
window with simulated mouse and keyboard, and therefore require a display.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gallery
import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
from PIL import Image
from qtpy.QtCore import QPoint, Qt
from scipy.ndimage import gaussian_filter
from window import (
    CTRL,
    DOCS,
    LEFT,
    NO_BUTTON,
    PLUGIN,
    TITLE,
    Pixel,
    Window,
    between,
    save,
    save_animation,
    wait,
)

from napari_hmrf import Arrow, Drawing, Grid, Material, Motion, Pictures, Study, Tissue, write_study
from napari_hmrf.data import phantom, sample
from napari_hmrf.ui.fit_window import FitWindow

#: Size of the windows of the README and of large motion, in pixels.
LARGE = (1400, 900)
#: Animation: visible part of the window, size of a frame, and duration of a frame.
CROP, FRAME, MILLISECONDS = (470, 560), (376, 448), 60
GROWING, PUSHED = "Brain with a growing tumour", "Brain with a tumour whose rim is pushed"
SLIDING = "Chest with lungs that slide along the wall"
HEAD = "Head with a growing tumour (volume)"
#: Table columns: growth in per cent, sliding, and outward displacement of a boundary.
GROWS, SLIDES, OUT = 4, 5, 5
#: Label of the tumour of the samples.
TUMOUR = 3
#: Height of the free region above the bar, into which the bar is bent, in pixels.
_ABOVE = 150
STRAIN = "strain: equivalent"

Floats = npt.NDArray[np.float64]


# Synthetic images, in place of a user's own images


def ellipse(
    shape: tuple[int, int], centre: tuple[float, float], radii: tuple[float, float]
) -> Floats:
    """Return the approximate fraction of each pixel inside an ellipse, from 0 to 1."""
    rows, cols = np.indices(shape)
    away = np.hypot((rows - centre[0]) / radii[0], (cols - centre[1]) / radii[1])
    return np.clip((1 - away) * min(radii) + 0.5, 0, 1)


def abdomen(size: float = 1.0, seed: int = 5) -> Floats:
    """Draw a synthetic slice through an abdomen, 0 to 255; `size` scales its lesion."""
    shape = (260, 340)
    picture = np.full(shape, 4.0)
    for centre, radii, value in (
        ((132, 170), (116, 156), 150),  # fat
        ((132, 170), (103, 143), 100),  # muscle
        ((134, 170), (92, 130), 84),  # tissue between the organs
        ((118, 112), (68, 70), 165),  # liver
        ((100, 232), (34, 44), 48),  # stomach
        ((160, 262), (38, 24), 150),  # spleen
        ((186, 110), (20, 26), 140),  # kidneys
        ((192, 232), (20, 26), 140),
        ((204, 170), (24, 26), 230),  # spine
        ((166, 170), (9, 9), 190),  # aorta
        ((112, 98), (17 * size, 18 * size), 106),  # lesion
    ):
        part = ellipse(shape, centre, radii)
        picture = picture * (1 - part) + value * part
    noise = np.random.default_rng(seed).normal(size=shape)
    grain = 22 * gaussian_filter(noise, 1.6) * (picture > 10)
    return np.clip(gaussian_filter(picture, 0.7) + grain, 0, 255)


def gel() -> Floats:
    """Draw a synthetic photograph of a block of gel with inclusions, shape (H, W, 3)."""
    shape = (280, 360)
    rows, cols = np.indices(shape)
    block = ellipse(shape, (140, 180), (125, 165)) ** 0.2
    block *= ((np.abs(rows - 140) < 108) & (np.abs(cols - 180) < 148)).astype(float)
    block = gaussian_filter(block, 1.2)
    picture = np.empty((*shape, 3))
    picture[:] = (24, 30, 44)
    picture += gaussian_filter(np.random.default_rng(2).normal(size=shape), 3)[..., None] * 30
    light = 1.1 - 0.0012 * (rows + cols / 2)
    picture = picture * (1 - block[..., None])
    picture += (block * light)[..., None] * np.array((226, 150, 132))
    for centre, radii, colour in (
        ((120, 130), (34, 40), (172, 62, 70)),
        ((175, 245), (24, 22), (240, 214, 170)),
    ):
        part = ellipse(shape, centre, radii)[..., None]
        picture = picture * (1 - part) + part * np.array(colour) * light[..., None]
    lines = (np.minimum(rows % 27, cols % 27) < 1) & (block > 0.9)
    picture[lines] *= 0.8
    return np.clip(picture + np.random.default_rng(3).normal(size=shape)[..., None] * 3, 0, 255)


# Studies of large motion


def grown_tumour() -> Study:
    """Return a study of the sample's tumour, which grows to more than twice its area."""
    brain = sample("mass-effect").growing(0.6)
    return Study(
        Grid(brain.image.shape, (1.0, 1.0)),
        Tissue(labels=brain.tissue_labels.astype(np.uint8), materials=brain.materials),
        Motion(labels=brain.boundary_labels, rules=brain.boundary),
        pictures=Pictures(brain.image, name="Tumour"),
    )


def bent_bar() -> Study:
    """Return a study of the sample's bar, with its right end bent up by 90 degrees."""
    straight = phantom("bar", 240)
    around = (_ABOVE, 10), (30, 30)  # so that the whole bent bar is visible
    image, labels = np.pad(straight.image, around), np.pad(straight.tissue_labels, around)
    there = labels > 0
    rows, cols = np.indices(image.shape).astype(float)
    left, right = np.flatnonzero(there.any(axis=0))[[0, -1]]
    middle = np.flatnonzero(there.any(axis=1)).mean()
    # The neutral line becomes a quarter of a circle with the same length.
    radius = (right - left) / (np.pi / 2)
    c = np.zeros((*image.shape, 2), np.float32)
    y = np.zeros_like(c)
    ends = there & (cols < left + 6), there & (cols > right - 6)
    c[ends[0]] = c[ends[1]] = 1
    angle = (cols - left) / radius
    height = middle - rows  # above the neutral line, towards the centre of the circle
    y[..., 0] = np.where(ends[1], middle - (radius - (radius - height) * np.cos(angle)) - rows, 0)
    y[..., 1] = np.where(ends[1], left + (radius - height) * np.sin(angle) - cols, 0)
    return Study(
        Grid(image.shape, (1.0, 1.0)),
        Tissue(labels=labels, materials=(Material(0, "air", 0.0), *straight.materials)),
        Motion(observed=y, confidence=c),
        pictures=Pictures(image, name="Bar"),
    )


def dragged_patch() -> Study:
    """Return a study in which a patch of the brain is dragged a long way."""
    brain = sample("mass-effect")
    arrow = Arrow(at=(150.0, 110.0), by=(-20.0, 60.0), radius=15.0)
    return Study(
        Grid(brain.image.shape, (1.0, 1.0)),
        Tissue(labels=brain.tissue_labels, materials=brain.materials),
        Motion(hold_edge=True, drawing=Drawing((arrow,))),
        pictures=Pictures(brain.image, name="Patch"),
    )


# Scenes


def readme() -> None:
    """Take pictures of the tissue, a drag, its result and a long pull."""
    window = Window(LARGE)
    window.open_sample(GROWING)
    window.wait_for_solution()
    dock, form = window.dock, window.form
    dock.hand_brush(window.viewer.layers["Tissue"])
    window.settle()
    window.show(form.tissue.table)
    window.keep("images/tissue", pointer=False)
    dock.native.setFocus()
    window.click(form.sections["tissue"].toggleButton())
    dock.start()
    window.settle()
    window.pull((140, 92), (122, 108), steps=10, rest=0.05)
    window.keep("images/motion")
    window.release()
    dock.overlay, dock.arrows = "equivalent", True
    window.settle()
    window.keep("images/result", pointer=False)
    dock.arrows = False
    window.pull((122, 108), (76, 132), steps=10, rest=0.05)
    window.release()
    if dock.model != "large motion":
        raise RuntimeError(f"the elastic model was not replaced: {dock.status}")
    dock.overlay = "grid"
    window.settle()
    window.keep("images/large-motion", pointer=False)
    window.close()


def first() -> None:
    """Take the pictures of the first deformation: a sample, the dock, a drag, a click."""
    window = Window()
    menu = window.menu("Plugins")
    entry = window.point_at_entry(menu, TITLE)
    save(window.screen().crop((0, 0, 860, 330)), DOCS / "tutorials/images/first-menu.png")
    window.click(menu, entry)
    wait(0.5)
    menu = window.menu("File", "Open Sample", PLUGIN)
    entry = window.point_at_entry(menu, GROWING)
    save(window.screen().crop((0, 0, 920, 330)), DOCS / "tutorials/images/first-sample.png")
    window.click(menu, entry)
    window.settle()
    window.take("pull")
    window.keep("tutorials/images/first-on")
    window.pull((140, 92), (124, 106))
    wait(0.5)
    window.keep("tutorials/images/first-drag")
    window.release()
    window.drag((78, 112))
    window.keep("tutorials/images/first-hold")
    window.key(Qt.Key.Key_Z, CTRL)
    window.close()


def animation() -> None:
    """Record the animation of tissue that is pulled."""
    window = Window()
    window.open_sample(GROWING)
    window.take("pull")
    window.viewer.canvas.overlays.text.visible = False
    corner = window.canvas.mapTo(window.canvas.window(), QPoint(0, 0))
    left = corner.x() + (window.canvas.width() - CROP[0]) // 2
    top = corner.y() + (window.canvas.height() - CROP[1]) // 2
    frames: list[Image.Image] = []

    def look() -> None:
        crop = window.picture().crop((left, top, left + CROP[0], top + CROP[1]))
        frames.append(crop.resize(FRAME, Image.Resampling.LANCZOS))

    def go(*pixels: Pixel, steps: int, is_pressed: bool) -> None:
        """Move from pixel to pixel, and slow down near each pixel."""
        for begin, end in itertools.pairwise(pixels):
            for step in range(1, steps + 1):
                part = 0.5 - 0.5 * math.cos(math.pi * step / steps)
                window.move(between(begin, end, part), button=LEFT if is_pressed else NO_BUTTON)
                window.wait_for_preview()
                look()

    go((70, 40), (148, 112), steps=6, is_pressed=False)
    window.press((148, 112))
    go((148, 112), (128, 88), (136, 132), steps=14, is_pressed=True)
    window.release()
    go((136, 132), (160, 170), steps=7, is_pressed=False)
    window.press((160, 170))
    go((160, 170), (136, 184), steps=14, is_pressed=True)
    window.release()
    look()
    save_animation(frames, DOCS / "tutorials/images/grab-and-pull.gif", MILLISECONDS)
    window.close()


def growing_tumour() -> None:
    """Take the pictures of a growing tumour: in both models, and with a pushed rim."""
    window = Window()
    window.open_sample(GROWING)
    dock, form = window.dock, window.form
    show_painted(window)
    window.click(form.result.arrows)
    window.keep("tutorials/images/tumour-painted", pointer=False)
    window.show(form.result.overlay)
    window.choose(form.result.overlay, STRAIN)
    dock.result.visible = False
    window.settle()
    window.keep("tutorials/images/tumour-strain")
    window.choose(form.result.overlay, "none")
    dock.result.visible = True
    table = form.tissue.table
    row = row_of(table, "tumour")
    window.write(table, row, GROWS, "60")
    window.show(table)
    window.keep("tutorials/images/tumour-table", table, form.tissue.choice)
    window.write(table, row, GROWS, "120")
    window.keep("tutorials/images/tumour-large")
    window.click(form.footer.other)
    window.click(form.footer.chip)
    window.keep("tutorials/images/tumour-folds")
    window.close()
    window = Window()
    window.open_sample(PUSHED)
    show_painted(window)
    window.show(window.form.motion.boundary.table)
    window.keep("tutorials/images/tumour-pushed", pointer=False)
    window.close()


def landmarks() -> None:
    """Take the pictures of landmarks: drawn with the mouse, and from two points layers."""
    sources, targets = ((96, 106), (150, 112), (96, 150)), ((88, 98), (156, 104), (91, 156))
    window = Window()
    window.open_sample("Brain that expands outward")
    form = window.form.motion
    window.take("landmark")
    window.keep("tutorials/images/landmarks-tool")
    for source, target in zip(sources, targets, strict=True):
        window.drag(source, target)
    window.keep("tutorials/images/landmarks-pairs")
    window.dock.clear()
    window.settle()
    layers = []
    for pixels in (sources, targets):
        window.menu("File", "New Layer", "Points")
        layers.append(window.viewer.layers.selection.active)
        window.key(Qt.Key.Key_2)
        for pixel in pixels:
            window.drag(pixel)
    choice = form.landmarks
    window.take("landmark")
    window.click(choice.take_button)  # both layers are chosen already
    window.keep("tutorials/images/landmarks-points")
    window.close()


def brushes() -> None:
    """Take the picture of a confidence stroke with a soft edge."""
    window = Window()
    window.open_sample(GROWING)
    fields = window.dock.fields
    window.take("pull")
    window.choose(fields.components, "left and right only (columns)")
    window.pull((140, 92), (140, 104))
    window.release()
    window.take("confidence")
    window.type(fields.radius, "16")
    window.type(fields.stroke_confidence, "0.2")
    window.type(fields.softness, "1")
    window.pull((52, 92), (60, 66), (84, 48), steps=6)
    window.release()
    window.keep("tutorials/images/brushes-confidence")
    window.close()


def resection() -> None:
    """Take the pictures of a removed tumour, and of the brain that sinks into its cavity."""
    window = Window()
    window.open_sample(GROWING)
    window.wait_for_solution()
    window.dock.stop()
    window.take("remove")
    window.type(window.dock.fields.radius, "32")
    window.drag((199, 198), (199, 199))
    window.keep("tutorials/images/resection-painted")
    form = window.form.motion
    window.show(form.weight.way)
    window.choose(form.weight.way, "down")
    window.type(form.weight.amount, "0.05")
    window.show(form.cavity.contents)
    window.keep("tutorials/images/resection-empty")
    window.choose(form.cavity.contents, "fluid")
    window.show(form.cavity.level)
    window.type(form.cavity.fluid, "0.05")
    window.keep("tutorials/images/resection-filled")
    window.close()


def sliding() -> None:
    """Take the pictures of lungs that slide along the chest wall, and that stick to it."""
    window = Window()
    window.open_sample(SLIDING)
    form = window.form
    window.dock.deform()
    window.wait_for_solution()
    window.click(form.result.arrows)
    window.keep("tutorials/images/sliding-moved")
    table = form.tissue.table
    window.show(table)
    window.choose(form.result.overlay, STRAIN)
    window.keep("tutorials/images/sliding-strain")
    window.choose_in_table(table, row_of(table, "lungs"), SLIDES, "no")
    window.keep("tutorials/images/sliding-stuck")
    window.close()


def own_image() -> None:
    """Take the pictures of a PNG file, of an RGB photograph, and of a slice of a stack."""
    sizes = enumerate((0.2, 0.5, 0.8, 1.0, 0.9, 0.6, 0.3))
    images = {
        "abdomen.png": abdomen(),
        "gel.png": gel(),
        "abdomen-stack.tif": np.stack([abdomen(size, seed) for seed, size in sizes]),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, image in images.items():
            iio.imwrite(Path(folder, name), image.astype(np.uint8))
        paint_tissue(Path(folder, "abdomen.png"))
        pull_photograph(Path(folder, "gel.png"))
        pull_stack(Path(folder, "abdomen-stack.tif"))


def open_file(path: Path) -> Window:
    """Open an image file in a new window, with the dock."""
    window = Window()
    window.viewer.open(str(path), plugin="napari")
    wait(0.5)
    window.open_dock()
    return window


def paint_tissue(path: Path) -> None:
    """Take the pictures of a PNG file, with painted tissue and boundaries."""
    window = open_file(path)
    form = window.form
    window.home()
    window.show(form.make)
    window.click(form.make)
    window.keep("tutorials/images/own-layers")
    window.click_row(form.tissue.table, 3)
    window.viewer.layers["Tissue"].brush_size = 24
    window.drag((110, 98), (112, 98), (116, 96), (108, 102))
    window.keep("tutorials/images/own-tissue")
    window.click_row(form.motion.boundary.table, 1)
    turns = [2 * math.pi * step / 40 for step in range(41)]
    window.drag(*((112 + 21 * math.sin(t), 98 + 22 * math.cos(t)) for t in turns))
    window.click_row(form.motion.boundary.table, 0)
    window.drag((204, 150), (204, 170), (204, 190))
    window.viewer.layers.selection = {window.dock.image}
    window.settle()
    window.keep("tutorials/images/own-result")
    window.close()


def pull_photograph(path: Path) -> None:
    """Take the pictures of an RGB photograph, with stiffness from its intensity."""
    window = open_file(path)
    window.home()
    window.show(window.form.intensity)
    window.click(window.form.intensity)
    window.keep("tutorials/images/photograph-curve")
    window.take("pull")
    window.pull((175, 245), (160, 232))
    window.release()
    window.keep("tutorials/images/photograph-pulled")
    window.close()


def pull_stack(path: Path) -> None:
    """Take the picture of a slice of a stack."""
    window = open_file(path)
    window.take("pull")
    window.home()
    window.pull((112, 98), (100, 120))
    window.release()
    window.keep("tutorials/images/stack-pulled")
    window.close()


def volume() -> None:
    """Take the pictures of a tumour in a volume: pulled in a slice, then in other slices."""
    window = Window()
    window.open_sample(HEAD)
    form, viewer = window.form, window.viewer
    show_painted(window)
    viewer.dims.set_point(0, 10.0)
    window.click(form.result.arrows)
    wait(0.5)
    window.keep("tutorials/images/volume-opened", pointer=False)
    table = form.motion.boundary.table
    window.show(table)
    window.write(table, 1, OUT, "3")
    window.take("pull")
    window.pull((-10, -30), (-18, -40))
    window.keep("tutorials/images/volume-pulled")
    window.release()
    window.click(viewer.window._qt_viewer.viewerButtons.rollDimsButton)
    viewer.dims.set_point(2, 30.0)
    window.show(form.result.overlay)
    window.choose(form.result.overlay, STRAIN)
    window.dock.result.visible = False
    window.home()
    window.keep("tutorials/images/volume-strain")
    window.close()


def views() -> None:
    """Take the picture of the tumour in three views, if the plugin for them is installed."""
    try:
        from napari_orthogonal_views.ortho_view_manager import show_orthogonal_views
    except ImportError:
        print("napari-orthogonal-views is not installed: no picture of three views")
        return
    window = Window((1480, 860))
    window.open_sample(HEAD)
    viewer = window.viewer
    show_painted(window)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of that plugin
        show_orthogonal_views(viewer)
    wait(1)
    for name in ("Boundary", "Tissue"):
        viewer.layers[name].visible = False
    for axis, place in enumerate((10.0, 28.0, 30.0)):
        viewer.dims.set_point(axis, place)
    window.choose(window.form.result.overlay, "displacement (mm)")
    window.home()
    wait(0.5)
    window.keep("tutorials/images/volume-views", pointer=False)
    window.close()


def fit() -> None:
    """Take the picture of a fit to a second image."""
    window = Window()
    window.open_sample("Brain before and after its tumour grew (two images)")
    result = window.form.result
    window.show(result.second)
    window.choose(result.second, "After")
    window.show(result.registration.fit)
    window.click(result.registration.fit)
    form = window.child(FitWindow)
    form.tick(TUMOUR, "growth")
    form.start()
    window.wait_for_solution()
    save(window.screen(pointer=False), DOCS / "how-to/images/fit.png")
    window.close()


def large_motion(study: Study) -> None:
    """Take a picture of linear elasticity on the left, and large motion on the right."""
    name = study.pictures.name.lower()
    window = Window(LARGE)
    window.open_dock()
    dock = window.dock
    with tempfile.TemporaryDirectory() as folder:
        dock.open_study(write_study(Path(folder) / f"{name}.study", study))
    window.viewer.reset_view()
    parts = []
    for model in ("elastic", "large motion"):
        dock.model = model
        window.settle()
        dock.overlay = "folds" if "folds" in dock.warning else "grid"
        window.settle()
        changes = {row.name: f"{row.size_change:+.0f} %" for row in dock.more.measure()}
        print(f"{name}, {model}: areas {changes}. {dock.warning}")
        parts.append(window.picture(pointer=False).crop(window.region(window.canvas, margin=0)))
    both = np.concatenate([np.asarray(part) for part in parts], axis=1)
    save(Image.fromarray(both), DOCS / f"validation/images/{name}.png")
    window.close()


def show_painted(window: Window) -> None:
    """Show the paint and the deformed image of a sample."""
    window.wait_for_solution()
    window.dock.stop()
    for name in ("Tissue", "Boundary"):
        window.viewer.layers[name].visible = True
    window.click(window.form.result.before)


def row_of(table: Any, name: str) -> int:
    """Return the row of a tissue in a table."""
    return [each.name for each in table.rows].index(name)


#: Function that takes the pictures of each page.
SCENES: dict[str, Callable[[], None]] = {
    "readme": readme,
    "tutorials/first": first,
    "tutorials/animation": animation,
    "tutorials/growing-tumour": growing_tumour,
    "tutorials/landmarks": landmarks,
    "tutorials/brushes": brushes,
    "tutorials/resection": resection,
    "tutorials/sliding": sliding,
    "tutorials/own-image": own_image,
    "tutorials/tumour-volume": volume,
    "tutorials/three-views": views,
    "how-to/fit": fit,
    "validation/tumour": lambda: large_motion(grown_tumour()),
    "validation/bar": lambda: large_motion(bent_bar()),
    "validation/patch": lambda: large_motion(dragged_patch()),
    **{f"examples/{name}": partial(gallery.draw_example, name) for name in gallery.EXAMPLES},
    **{f"notebooks/{name}": partial(gallery.draw_notebook, name) for name in gallery.NOTEBOOKS},
}


def main(wanted: list[str]) -> None:
    """Run the scenes whose names begin with one of the given texts, or all scenes."""
    chosen = [name for name in SCENES if not wanted or name.startswith(tuple(wanted))]
    if not chosen:
        sys.exit("There is no such scene. The scenes are " + ", ".join(SCENES) + ".")
    for name in chosen:
        print(name, flush=True)
        SCENES[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
