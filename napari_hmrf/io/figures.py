"""Figures of a problem and its solution for files and publications, drawn with matplotlib.

The functions require neither a window nor pyplot. matplotlib is imported when the first figure is
drawn.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.colormaps import DIVERGING, FOLDED, OPACITY, RISING, opacity
from napari_hmrf.field.deformation import arrows, deformation_grid, pixels_between
from napari_hmrf.field.frame import Frame
from napari_hmrf.io.energy_figure import draw_energy
from napari_hmrf.results.quantities import Coloured, Quantity, coloured, title_and_unit
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure  # heavy: matplotlib

#: Approximate number of arrows in figures of a displacement field, and of a boundary.
ARROWS = 500
BOUNDARY_ARROWS = 250
#: Number of lines of the deformation grid along the longer side of the image.
GRID_LINES = 50
_ARROW_COLOUR = "#e8590c"
_FIXED_COLOUR = "#4dabf7"
_GRID_COLOUR = "#0b7285"
# Title of figures that show a quantity at the original positions of the tissue.
_BEFORE_TITLE = "{}\n(at the original positions of the tissue)"


def write_pictures(
    folder: Path, image: npt.ArrayLike, problem: Problem, solution: Solution
) -> list[Path]:
    """Draw figures of a problem and its solution, and save them as PNG files.

    Parameters
    ----------
    folder : Path
        Existing folder; files with the same names are replaced.
    image : array_like, shape (H, W)
        Undeformed image.
    problem : Problem
    solution : Solution

    Returns
    -------
    list of Path
        Paths of the files: input, displacement, warped, grid, energy.
    """
    grey = np.asarray(image)
    figures = {
        "input": boundary_picture(grey, problem),
        "displacement": displacement_picture(grey, solution),
        "warped": warped_picture(grey, solution),
        "grid": grid_picture(solution),
        "energy": energy_picture(solution),
    }
    return _save_figures(folder, figures)


def write_result_pictures(
    folder: Path,
    solution: Solution,
    image: npt.ArrayLike | None = None,
    unit: str = "px",
    own_folder: str = "",
) -> list[Path]:
    """Draw figures of a solution, and save them as PNG files.

    Parameters
    ----------
    folder : Path
        Existing folder; files with the same names are replaced.
    solution : Solution
    image : array_like, shape (H, W) or (H, W, 3 or 4), optional
        Undeformed image.
    unit : str
        Unit of the displacement and the spacing.
    own_folder : str, optional
        Name of a new subfolder for the files.

    Returns
    -------
    list of Path
        Paths of the files: displacement and warped (only if there is an image), grid, magnitude,
        jacobian, strain, energy.
    """
    if own_folder:
        folder = _new_folder(folder, own_folder)
    figures: dict[str, Figure] = {}
    if image is not None:
        picture = np.asarray(image)
        figures["displacement"] = displacement_picture(picture, solution)
        figures["warped"] = warped_picture(picture, solution)
    figures["grid"] = grid_picture(solution)
    figures["magnitude"] = magnitude_picture(solution, unit, image)
    figures["jacobian"] = jacobian_picture(solution, image)
    figures["strain"] = strain_picture(solution, image)
    figures["energy"] = energy_picture(solution)
    return _save_figures(folder, figures)


def write_volume_pictures(
    folder: Path, image: npt.ArrayLike, solution: Solution, at: Sequence[int], unit: str = "px"
) -> list[Path]:
    """Draw figures of three orthogonal slices of a volume, and save them as PNG files.

    Parameters
    ----------
    folder : Path
        Existing folder; files with the same names are replaced.
    image : array_like, shape (D, H, W)
        Undeformed image.
    solution : Solution
    at : sequence of int, shape (3,)
        Index of the voxel at the intersection of the slices.
    unit : str
        Unit of the displacement and the spacing.

    Returns
    -------
    list of Path
        Paths of the files: before, after, magnitude.
    """
    grey = np.asarray(image)
    moved = solution.warp(grey)
    magnitude = coloured(solution, "magnitude")
    figures = {
        "before": _slices_picture("before", grey, solution, at),
        "after": _slices_picture("after", moved, solution, at, greys_of=grey),
        "magnitude": _slices_picture(
            _BEFORE_TITLE.format(f"displacement / {unit}"), grey, solution, at, colours=magnitude
        ),
    }
    return _save_figures(folder, figures)


def _new_folder(parent: Path, name: str) -> Path:
    """Create a new folder, with a number in its name if the name is already in use."""
    safe_name = "".join(letter if letter.isalnum() or letter in " -_." else "_" for letter in name)
    folder, number = parent / safe_name, 1
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            folder = parent / f"{safe_name} {number}"
        else:
            return folder


def _save_figures(folder: Path, figures: Mapping[str, Figure]) -> list[Path]:
    """Save figures as PNG files, each atomically, and return the paths of the files."""
    written = []
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=150)
        written.append(folder / f"{name}.png")
        write_whole(written[-1], buffer.getvalue())
    return written


def boundary_picture(image: npt.NDArray[Any], problem: Problem) -> Figure:
    """Draw the image, and arrows of the observed displacement where its confidence is above 0.

    Dots mark sites with an observed displacement of zero.
    """
    figure, (axes,) = _figure(problem.spacing, "input: the image and the motion of the boundary")
    _show(axes, image)
    known = problem.known.any(axis=-1)
    # Draw every nth boundary site: a regular grid of sites would miss most of a thin boundary.
    starts = np.argwhere(known)[:: max(1, int(known.sum()) // BOUNDARY_ARROWS)]
    vectors = problem.observed[tuple(starts.T)] / np.array(problem.spacing)
    rows, cols = starts[~vectors.any(axis=-1)].T
    axes.plot(cols, rows, ".", color=_FIXED_COLOUR, markersize=3)
    _draw_arrows(axes, np.stack([starts, vectors], axis=1))
    return figure


def displacement_picture(image: npt.NDArray[Any], solution: Solution) -> Figure:
    """Draw the displacement field as arrows of true length on the undeformed image."""
    figure, (axes,) = _figure(solution.spacing, "displacement of the tissue")
    _show(axes, image)
    shown = arrows(
        solution.displacement, spacing=solution.spacing, tissue=solution.tissue, about=ARROWS
    )
    _draw_arrows(axes, shown)
    return figure


def warped_picture(image: npt.NDArray[Any], solution: Solution) -> Figure:
    """Draw the undeformed and the deformed image side by side."""
    figure, (before, after) = _figure(solution.spacing, "before", "after")
    moved = solution.warp(image)
    _show(before, image)
    _show(after, moved, greys_of=image)
    return figure


def grid_picture(solution: Solution) -> Figure:
    """Draw a regular grid that is deformed with the tissue, as in figure 4 of the paper."""
    from matplotlib.collections import LineCollection  # heavy: matplotlib

    figure, (axes,) = _figure(solution.spacing, "a regular grid, deformed with the tissue")
    height, width = solution.tissue.shape
    every = pixels_between(GRID_LINES, solution.tissue.shape, solution.spacing)
    segments = deformation_grid(solution.displacement, every=every, **solution.on_grid)
    starts, ends = segments[:, 0], segments.sum(axis=1)
    lines = np.stack([starts, ends], axis=1)[..., ::-1]
    axes.add_collection(LineCollection(list(lines), colors=_GRID_COLOUR, linewidths=0.7))
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return figure


def magnitude_picture(
    solution: Solution, unit: str = "px", image: npt.ArrayLike | None = None
) -> Figure:
    """Draw the displacement magnitude at the original positions of the tissue."""
    return _quantity_picture(solution, "magnitude", f"displacement / {unit}", image)


def jacobian_picture(solution: Solution, image: npt.ArrayLike | None = None) -> Figure:
    """Draw the Jacobian determinant, the area ratio of the tissue; folds (<= 0) are blue."""
    return _quantity_picture(solution, "jacobian", "area ratio (Jacobian)", image)


def strain_picture(solution: Solution, image: npt.ArrayLike | None = None) -> Figure:
    """Draw the equivalent strain; the title states whether it is the elastic or in-plane strain."""
    title, unit = title_and_unit("equivalent", solution)
    return _quantity_picture(solution, "equivalent", f"{title} ({unit})", image)


def energy_picture(solution: Solution) -> Figure:
    """Plot the mean energy after each iteration; see `draw_energy`."""
    from matplotlib.figure import Figure  # heavy: matplotlib

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    draw_energy(figure.subplots(), solution)
    return figure


def _quantity_picture(
    solution: Solution, quantity: Quantity, title: str, image: npt.ArrayLike | None
) -> Figure:
    """Draw a quantity as colours on the image, with a colour bar, as in the viewer."""
    figure, (axes,) = _figure(solution.spacing, _BEFORE_TITLE.format(title))
    if image is not None:
        _show(axes, np.asarray(image))
    coloured_values = coloured(solution, quantity)
    _draw_colours(figure, [(axes, coloured_values.values)], coloured_values)
    return figure


def _draw_colours(
    figure: Figure, parts: Sequence[tuple[Axes, npt.NDArray[Any]]], coloured_values: Coloured
) -> None:
    """Draw slices of a quantity as colours, each on separate axes, with a common colour bar."""
    import matplotlib  # heavy: matplotlib
    from matplotlib.colors import ListedColormap  # heavy: matplotlib
    from matplotlib.patches import Patch  # heavy: matplotlib

    part = np.linspace(0, 1, 256)
    colours = matplotlib.colormaps[DIVERGING if coloured_values.signed else RISING](part)
    colours[:, 3] = opacity(part, coloured_values.signed)
    low, high = coloured_values.limits
    for axes, values in parts:
        folds = coloured_values.is_fold(values)
        shown = axes.imshow(
            np.where(folds, np.nan, values),
            cmap=ListedColormap(colours),
            alpha=OPACITY,
            aspect=axes.get_aspect(),
            vmin=low,
            vmax=high,
        )
        if coloured_values.folded:
            marked = np.where(folds, 1.0, np.nan)
            axes.imshow(marked, cmap=ListedColormap([FOLDED]), aspect=axes.get_aspect())
            axes.legend(handles=[Patch(color=FOLDED, label="folded")], loc="lower right")
    unfolded = coloured_values.values[~coloured_values.is_fold(coloured_values.values)]
    above = (unfolded > high).any()
    below = coloured_values.signed and (unfolded < low).any()
    ends = "both" if above and below else "max" if above else "min" if below else "neither"
    figure.colorbar(shown, ax=[axes for axes, _ in parts], shrink=0.8, extend=ends)


def _slices_picture(
    title: str,
    image: npt.NDArray[Any],
    solution: Solution,
    at: Sequence[int],
    *,
    greys_of: npt.NDArray[Any] | None = None,
    colours: Coloured | None = None,
) -> Figure:
    """Draw a slice perpendicular to each axis; superior is at the top."""
    from matplotlib.figure import Figure  # heavy: matplotlib

    figure = Figure(figsize=(15.0, 6.2), layout="constrained")
    figure.suptitle(title, fontsize=11)
    frame = solution.place
    slices = [_slice_frame(frame, axis, at[axis]) for axis in range(3)]
    # Width ratios for which all three slices have the same scale.
    _, height, width = np.multiply(image.shape, solution.spacing)
    row = figure.subplots(1, 3, width_ratios=[width, width, height])
    for axis, (axes, place) in enumerate(zip(row, slices, strict=True)):
        axes.set_title(place.slice_seen, fontsize=11)
        axes.set_axis_off()
        axes.set_aspect(place.spacing[0] / place.spacing[1])
        _show(axes, image.take(at[axis], axis), greys_of=image if greys_of is None else greys_of)
    if colours is not None:
        parts = [np.take(colours.values, at[axis], axis) for axis in range(3)]
        _draw_colours(figure, list(zip(row, parts, strict=True)), colours)
    for axes, place in zip(row, slices, strict=True):
        down = place.plane[0]
        if place.axis_labels[down] == "superior" and place.matrix[down][down] > 0:
            axes.invert_yaxis()
    return figure


def _slice_frame(frame: Frame, axis: int, number: int) -> Frame:
    """Return the frame of a slice perpendicular to an axis of a volume."""
    plane, index = list(frame.plane), list(frame.index)
    index[plane.pop(axis)] = number
    return replace(frame, plane=tuple(plane), index=tuple(index))


def _figure(spacing: tuple[float, ...], *titles: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with a row of axes for images, with the aspect ratio of the pixels."""
    from matplotlib.figure import Figure  # heavy: matplotlib

    if len(spacing) != 2:
        raise ProblemError("displacement", "belongs to a volume. Draw one of its slices.")

    figure = Figure(figsize=(6.0 * len(titles), 6.2), layout="constrained")
    row = list(figure.subplots(1, len(titles), squeeze=False)[0])
    for axes, title in zip(row, titles, strict=True):
        axes.set_title(title, fontsize=11)
        axes.set_axis_off()
        axes.set_aspect(spacing[0] / spacing[1])
    return figure, row


def _show(axes: Axes, image: npt.NDArray[Any], greys_of: npt.NDArray[Any] | None = None) -> None:
    """Show an image, optionally with the contrast limits of another image."""
    levels = image if greys_of is None else greys_of
    axes.imshow(
        image,
        cmap="gray",
        aspect=axes.get_aspect(),
        vmin=float(np.nanmin(levels)),
        vmax=float(np.nanmax(levels)),
    )


def _draw_arrows(axes: Axes, vectors: npt.NDArray[Any]) -> None:
    """Draw arrows (start, vector), in (row, col) pixels, at true length."""
    (rows, cols), (down, right) = vectors[:, 0].T, vectors[:, 1].T
    axes.quiver(
        cols,
        rows,
        right,
        down,
        angles="xy",
        scale_units="xy",
        scale=1,
        color=_ARROW_COLOUR,
        width=0.003,
        headwidth=4,
        headlength=5,
        headaxislength=4.5,
        minlength=0,
    )
