"""Texts of the tables of measurements and of forces in the window."""

from __future__ import annotations

import math
from collections.abc import Sequence

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.units import as_seen
from napari_hmrf.io.tables import has_stress, strain_of
from napari_hmrf.results.held_forces import HeldForce
from napari_hmrf.results.measurement import Measurement

#: Share of the magnitude of a force below which a component is shown as 0.
_NOISE = 1e-3
#: Measurements of stress.
_OF_STRESS = "mean_von_mises", "largest_von_mises", "mean_pressure"


def measurements_in_words(
    rows: Sequence[Measurement], unit: str, *, volume: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Format measurements as text for display.

    Parameters
    ----------
    rows : sequence of Measurement
    unit : str
        Unit of length.
    volume : bool
        True for measurements of a volume, which have different column titles.

    Returns
    -------
    titles : list of str
        Titles of the columns.
    cells : list of list of str
        Cells of each row.
    """
    size, content, site = ("volume", "³", "voxels") if volume else ("area", "²", "px")
    kind = strain_of(rows)
    columns = {
        "tissue": "name",
        "label": "label",
        f"{size} ({unit}{content})": "size",
        f"{size} change (%)": "size_change",
        f"moved, mean ({unit})": "mean_displacement",
        f"moved, most ({unit})": "largest_displacement",
        f"{kind} strain, mean (%)": "mean_strain",
        f"{kind} strain, most (%)": "largest_strain",
        f"folds ({site})": "folds",
    }
    if has_stress(rows):
        unit_of_stress = rows[0].stress_unit or "relative"
        columns |= {
            f"von Mises, mean ({unit_of_stress})": "mean_von_mises",
            f"von Mises, most ({unit_of_stress})": "largest_von_mises",
            f"pressure, mean ({unit_of_stress})": "mean_pressure",
        }
    axes = 3 if volume else 2
    return [*columns], [[_in_words(row, name, axes) for name in columns.values()] for row in rows]


def forces_in_words(
    rows: Sequence[HeldForce], ways: Directions, stiffness: str, unit: str
) -> tuple[list[str], list[list[str]]]:
    """Format the forces on constrained tissue as text for display.

    Parameters
    ----------
    rows : sequence of HeldForce
    ways : Directions
        Directions of the force components on the screen.
    stiffness : str
        Unit of stiffness; "" if unknown.
    unit : str
        Unit of length.

    Returns
    -------
    titles : list of str
        Titles of the columns.
    cells : list of list of str
        Cells of each row.
    """
    volume = len(ways.order) == 3
    content, site = ("²", "voxel") if volume else ("", "pixel")
    of = f"{stiffness or 'relative'} {unit}{content}"
    titles = ["what", f"around {site}", f"{site}s", f"force ({of})", "which way"]
    cells = []
    for row in rows:
        size = math.hypot(*row.force)
        parts = (part if abs(part) > _NOISE * size else 0.0 for part in ways.to_display(row.force))
        seen = tuple(float(f"{part:.3g}") for part in parts)
        where = ", ".join(f"{round(along)}" for along in row.centre)
        what = "moved" if row.moves else "held"
        cells.append([what, where, f"{row.sites}", f"{size:.3g}", ways.step(seen)])
    return titles, cells


def _in_words(row: Measurement, name: str, axes: int) -> str:
    """Format a measurement with four digits; show large numbers in full and tiny values as 0."""
    value = getattr(row, name)
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    if name in _OF_STRESS:
        return f"{value:.4g}"
    if name != "size":
        pixel = (row.size / row.pixels) ** (1 / axes)
        value = as_seen(value, [pixel if name.endswith("displacement") else 1.0])
    if name == "mean_displacement" and row.mean_displacement_sd:
        return _with_error_bar(value, row.mean_displacement_sd)
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _with_error_bar(value: float, sd: float) -> str:
    """Format a value with its standard deviation, with two significant digits of the latter."""
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f}"
