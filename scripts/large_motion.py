"""Pictures of a napari window that compare large motion with linear elasticity."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from tutorial import open_dock
from window import ROOT, Person, save, wait_until

from napari_hmrf import Arrow, Drawing, Grid, Material, Motion, Pictures, Study, Tissue, write_study
from napari_hmrf.data import phantom, sample

FOLDER = ROOT / "docs" / "validation" / "images"
SIZE = (1400, 900)
#: Height of the free region above the bar, into which the bar is bent, in pixels.
_ABOVE = 150


def tumour() -> Study:
    """Return a study of the sample's tumour, which grows to more than twice its area."""
    brain = sample("mass-effect").growing(0.6)
    return Study(
        Grid(brain.image.shape, (1.0, 1.0)),
        Tissue(labels=brain.tissue_labels.astype(np.uint8), materials=brain.materials),
        Motion(labels=brain.boundary_labels, rules=brain.boundary),
        pictures=Pictures(brain.image, name="Tumour"),
    )


def bar() -> Study:
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


def patch() -> Study:
    """Return a study in which a patch of the brain is dragged a long way."""
    brain = sample("mass-effect")
    arrow = Arrow(at=(150.0, 110.0), by=(-20.0, 60.0), radius=15.0)
    return Study(
        Grid(brain.image.shape, (1.0, 1.0)),
        Tissue(labels=brain.tissue_labels, materials=brain.materials),
        Motion(hold_edge=True, drawing=Drawing((arrow,))),
        pictures=Pictures(brain.image, name="Patch"),
    )


def main() -> None:
    """Take a picture of each study: linear elasticity on the left, large motion on the right."""
    for study in (tumour(), bar(), patch()):
        pair(study)


def pair(study: Study) -> None:
    """Open a study, and take a picture of its solutions with both models."""
    name = study.pictures.name.lower()
    person = Person(SIZE)
    dock = open_dock(person)
    with tempfile.TemporaryDirectory() as folder:
        dock.open_study(write_study(Path(folder) / f"{name}.study", study))
    person.viewer.reset_view()
    seen = []
    for model in ("elastic", "large motion"):
        dock.model = model
        wait_until(lambda: not dock.busy)
        dock.overlay = "folds" if "folds" in dock.warning else "grid"
        wait_until(lambda: not dock.busy)
        changes = {row.name: f"{row.size_change:+.0f} %" for row in dock.more.measure()}
        print(f"{name}, {model}: areas {changes}. {dock.warning}")
        seen.append(person.sight().crop(person.region(person.canvas, margin=0)))
    both = Image.new("RGB", (2 * seen[0].width, seen[0].height))
    for number, each in enumerate(seen):
        both.paste(each, (number * each.width, 0))
    save(both, FOLDER / f"{name}.png")
    person.viewer.close()


if __name__ == "__main__":
    main()
