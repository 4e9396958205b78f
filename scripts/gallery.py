"""Pictures of the examples and of the notebooks, drawn from their variables."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from napari_hmrf import Solution, read_study
from napari_hmrf.data import head_phantom
from napari_hmrf.fields import deformation_grid, magnitude, measure

mpl.use("Agg")

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
#: Resolution in dots per inch, at which a picture of three panels is about 640 pixels wide.
RESOLUTION = 72
#: Number of colours of a saved picture, which reduces the file to a third of its full-colour size.
COLOURS = 256
#: Names of the notebooks.
NOTEBOOKS = sorted(path.stem for path in DOCS.glob("notebooks/*.ipynb"))

#: Variables of an example.
Names = dict[str, Any]
#: Title, image, colour map, and value of the last colour (None without a colour scale).
Panel = tuple[str, Any, str, float | None]


def panels(*shown: Panel, unit: str = "", height: float = 3.0) -> Figure:
    """Draw images side by side, with a colour scale for images that have a largest value."""
    figure = Figure(figsize=(3.0 * len(shown), height), layout="constrained")
    for axis, (title, image, colours, largest) in zip(
        figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True
    ):
        picture = axis.imshow(
            image, cmap=colours, vmax=largest, vmin=None if largest is None else 0
        )
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
        if largest is not None:
            figure.colorbar(picture, ax=axis, label=unit, shrink=0.8)
    return figure


def add_grid(axis: Any, solution: Solution, count: int = 18) -> None:
    """Draw a grid that moves with the tissue."""
    between = max(solution.tissue.shape) // count
    segments = deformation_grid(solution.displacement, every=between, **solution.on_grid)
    starts, directions = segments[:, 0], segments[:, 1]
    lines = np.stack([starts, starts + directions], axis=1)[..., ::-1]  # (x, y)
    axis.add_collection(LineCollection(lines, colors="white", linewidths=0.6))


def drag(names: Names) -> Figure:
    """Draw the first and the last step of the drag."""
    first, last = names["found"][0], names["found"][-1]
    lengths = [magnitude(solution.displacement) for solution in (first, last)]
    figure = panels(
        ("dragged 1 px", lengths[0], "viridis", 8.0),
        ("dragged 8 px", lengths[1], "viridis", 8.0),
        unit="px",
    )
    for axis, solution in zip(figure.axes, (first, last), strict=False):
        add_grid(axis, solution)
    return figure


def growing_sphere(names: Names) -> Figure:
    """Draw a slice before and after the deformation, and its displacement."""
    volume = names["solution"]
    middle = volume.tissue.shape[0] // 2
    scan = names["sitk"].GetArrayFromImage(names["scan"])
    moved = names["sitk"].GetArrayFromImage(names["deformed"])
    length = magnitude(volume.displacement)[middle]
    return panels(
        ("scan", scan[middle], "gray", None),
        ("deformed", moved[middle], "gray", None),
        ("displacement", length, "viridis", float(length.max())),
        unit="mm",
    )


def growing_tumour(names: Names) -> Figure:
    """Draw the brain before and after the growth, and the change of area."""
    jacobian = names["jacobian"]
    return panels(
        ("before", names["brain"].image, "gray", None),
        ("after", names["image"], "gray", None),
        ("area, relative to before", jacobian, "RdBu_r", 2.0),
    )


def paper_beside_elastic(names: Names) -> Figure:
    """Draw the difference between each field and finite elements."""
    tissue = names["problem"].tissue
    shown = []
    for solution in names["solutions"]:
        apart = np.linalg.norm(solution.displacement - names["reference"], axis=-1)
        shown.append((solution.provenance.model, np.where(tissue, apart, np.nan), "viridis", 2.0))
    return panels(*shown, unit="px from finite elements")


def random_deformations(names: Names) -> Figure:
    """Draw the image and some of its deformations."""
    images = [("original", names["brain"].image, "gray", None)]
    images += [(f"seed {seed}", names["images"][seed], "gray", None) for seed in (0, 3, 5)]
    return panels(*images, height=2.6)


def registration(names: Names) -> Figure:
    """Draw the difference between each field and the true displacement."""
    truth, tissue = names["truth"].displacement, names["tissue"]
    shown = []
    for title, field in (("demons alone", "registered"), ("with tissue", "elastic")):
        apart = np.linalg.norm(names[field] - truth, axis=-1)
        shown.append((title, np.where(tissue, apart, np.nan), "viridis", 4.0))
    return panels(("image", names["brain"].image, "gray", None), *shown, unit="px from the truth")


def removed_tumour(names: Names) -> Figure:
    """Draw the images before and after the operation, and the errors with and without masks."""
    shown = []
    for title, field in names["fields"].items():
        error = np.linalg.norm(field - names["truth"], axis=-1)
        shown.append((f"error, {title}", np.where(names["tissue"], error, np.nan), "viridis", 4.0))
    images = (
        ("before", names["brain"].image, "gray", None),
        ("after", names["after"], "gray", None),
    )
    return panels(*images, *shown, unit="px")


def resected_tumour(names: Names) -> Figure:
    """Draw the brain before the operation, and with an empty and a full cavity."""
    images = names["images"]
    titles = {"intact": "before", "empty": "empty cavity", "full": "cavity full of water"}
    return panels(*((title, images[name], "gray", None) for name, title in titles.items()))


def sections(names: Names) -> Figure:
    """Draw a cut across all sections: of the block, as cut, and registered."""
    shown = []
    for title, stack in (("block", "block"), ("sections as cut", "cut"), ("registered", "stack")):
        images = np.array(names[stack])
        across = images[:, 48] / images.mean(axis=(1, 2))[:, None]  # the same brightness
        shown.append((title, np.repeat(across, 8, axis=0), "gray", None))
    return panels(*shown, height=2.4)


def sliding_lungs(names: Names) -> Figure:
    """Draw a half of the chest at rest, and its grid with a sliding and with a sticking lung."""
    figure = panels(
        ("before the breath", names["chest"].image, "gray", None),
        ("lungs slide", names["images"]["sliding"], "gray", None),
        ("lungs stick to the wall", names["images"]["sticking"], "gray", None),
    )
    for axis, name in zip(figure.axes[1:], names["solutions"], strict=True):
        add_grid(axis, names["solutions"][name], count=28)
    for axis in figure.axes:
        axis.set(xlim=(8, 138), ylim=(214, 84))
    return figure


def uncertainty(names: Names) -> Figure:
    """Draw the error bars with each number of landmarks, and the landmarks."""
    results, tissue = names["results"], names["tissue"]
    largest = float(results[0][1].max())
    shown = [
        (f"landmarks: {len(points)}", np.where(tissue, bars, np.nan), "viridis", largest)
        for points, bars in results
    ]
    figure = panels(*shown, unit="error bar, px", height=2.6)
    for axis, (points, _) in zip(figure.axes[: len(results)], results, strict=True):
        rows, cols = np.transpose(points)
        axis.plot(cols, rows, "o", color="white", markeredgecolor="black", markersize=5)
    return figure


def slice_in_millimetres(names: Names) -> Figure:
    """Draw the displacement and the landmarks."""
    solution = names["solution"]
    figure = panels(
        ("displacement", magnitude(solution.displacement), "viridis", 3.0), unit="mm", height=2.6
    )
    figure.set_size_inches(5.0, 3.0)
    axis = figure.axes[0]
    axis.set_aspect(2.0)  # a row is twice as high as a column is wide
    for mark in names["landmarks"].marks:
        (row, col), (to_row, to_col) = mark.source, mark.target
        axis.plot((col, to_col), (row, to_row), color="white")
        axis.plot(to_col, to_row, "o", color="white", markersize=4)
    return figure


def stiff_disc(names: Names) -> Figure:
    """Draw the stiffness, and the largest strain with a deformed grid."""
    figure = panels(
        ("stiffness", names["stiffness"], "viridis", 20.0),
        ("largest strain, %", 100 * names["stretch"], "magma", 16.0),
    )
    add_grid(figure.axes[1], names["solution"])
    return figure


def sweep(_: Names) -> Figure:
    """Plot the shrinkage of the ventricles, for each stiffness of the tumour."""
    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    axis = figure.subplots()
    areas: dict[str, list[tuple[float, float]]] = {}
    for folder in sorted(Path("sweep/out").glob("brain_*")):
        study, solution = read_study(folder / "brain.study")
        growth, stiffness = folder.name.split("growth-tumour-")[1].split("_stiffness-tumour-")
        rows = measure(solution, study.tissue.labels)
        change = next(row.size_change for row in rows if row.label == 2)
        areas.setdefault(stiffness, []).append((100 * float(growth), change))
    for stiffness, points in areas.items():
        axis.plot(*np.transpose(points), "o-", label=f"tumour of {stiffness} kPa")
    axis.set(xlabel="growth of the tumour, %", ylabel="change of the ventricles' area, %")
    axis.legend()
    return figure


def volume(names: Names) -> Figure:
    """Draw a slice before and after the deformation, and its displacement."""
    head, length = names["head"], names["length"]
    plane = int(np.argwhere(head.tissue_labels == 3)[:, 0].mean())
    return panels(
        ("before", head.image[plane], "gray", None),
        ("after", names["image"][plane], "gray", None),
        ("displacement", length[plane], "viridis", float(length[plane].max())),
        unit="mm",
    )


#: Function that draws the picture of each example.
EXAMPLES: dict[str, Callable[[Names], Figure]] = {
    draw.__name__: draw
    for draw in (
        growing_sphere,
        stiff_disc,
        growing_tumour,
        slice_in_millimetres,
        paper_beside_elastic,
        registration,
        removed_tumour,
        resected_tumour,
        sliding_lungs,
        sections,
        uncertainty,
        volume,
        sweep,
        random_deformations,
        drag,
    )
}


def write_scan() -> None:
    """Write the scan that the example of the growing sphere reads."""
    import SimpleITK as sitk

    head = head_phantom(size=96)
    scan = sitk.GetImageFromArray(head.image.astype(np.float32))
    scan.SetSpacing(tuple(map(float, head.spacing[::-1])))
    sitk.WriteImage(scan, "scan.nii.gz")


def draw_example(name: str) -> None:
    """Run an example in a temporary folder, and draw its picture."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        if name == "growing_sphere":
            write_scan()
        with contextlib.redirect_stdout(io.StringIO()):
            names = runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
        figure = EXAMPLES[name](names)
    save(figure, DOCS / "examples" / "images" / f"{name}.png")


def draw_notebook(name: str) -> None:
    """Run the cells of a notebook, and draw its last figure."""
    import matplotlib.pyplot as plt

    path = DOCS / "notebooks" / f"{name}.ipynb"
    names: Names = {}
    with contextlib.redirect_stdout(io.StringIO()):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), path.name, "exec"), names)
    save(plt.gcf(), path.parent / "images" / f"{name}.png")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a small PNG file."""
    path.parent.mkdir(exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=RESOLUTION)
    image = Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(path, optimize=True)
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB", flush=True)
