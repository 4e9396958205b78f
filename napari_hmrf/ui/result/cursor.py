"""What is under the cursor, for the status bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from napari.layers import Image

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.quantities import QUANTITIES
from napari_hmrf.field.tissue_point import Points, Probe
from napari_hmrf.layers.field_layer import frame_in, place_at, tissue_of
from napari_hmrf.layers.metadata import TISSUE, known_of, rows_of
from napari_hmrf.layers.result_layers import Name
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.solver.problem import Problem
from napari_hmrf.study.layer_names import full_resolution
from napari_hmrf.tissue.boundary_rules import RIGID, Material, stiffness_in_words
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.result_messages import FULL


class UnderCursor:
    """Reads a result at the cursor, and says it behind what napari's status bar says.

    Nothing is computed but for the one pixel. Napari asks its layers in a thread of its own, at
    most as fast as that can answer; here one lookup is added to each of its answers.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._shown: MovingLayers | None = None
        self._points: Points | None = None
        self._tissue: Any = None
        self._place: Frame | None = None
        self._materials: dict[int, Material] = {}
        # What napari has said last, and what was said behind it.
        self._said, self._line = viewer.status, ""
        viewer.events.status.connect(self._on_status)

    def release(self) -> None:
        """Listen no more."""
        self._viewer.events.status.disconnect(self._on_status)

    def watch(self, shown: MovingLayers | None, points: Points | None = None) -> None:
        """Read a result that is looked at from now on, of which these are the points.

        Stiffness is that of labels and their table, or of an image; of neither there is none.
        """
        self._shown, self._points, self._tissue, self._place = shown, points, None, None
        if shown is not None:
            self._tissue = tissue = tissue_of(self._viewer.layers, shown.answer)
            if tissue is not None:
                self._place = frame_in(tissue, shown.answer)
                self._materials = {row.label: row for row in rows_of(tissue, TISSUE)}
        self.look()

    def look(self) -> None:
        """What is seen is another, so that something else may be below a mouse that rests."""
        cursor = self._viewer.cursor
        cursor.events.position(value=cursor.position)  # napari reads its layers again
        self._say()

    def at(self, position: Any) -> Probe | None:
        """What happens to the tissue that is seen at a point of the world; None beside it.

        Parameters
        ----------
        position : sequence of float
            As of `viewer.cursor.position`.
        """
        shown, points = self._shown, self._points
        arrows = None if shown is None else shown.layer("arrows")
        if shown is None or points is None or arrows is None:
            return None
        place = place_at(arrows, shown.answer, position, View.of(self._viewer.dims))
        return None if place is None else points.at(place, shown.layers.percent / FULL)

    def line_at(self, position: Any) -> str:
        """The same in words; "" beside tissue."""
        found, shown = self.at(position), self._shown
        if found is None or shown is None:
            return ""
        answer, overlay = shown.answer, shown.overlay
        ways = Directions.of(answer.frame, self._viewer)
        more = [self._stiffness(answer.problem, found)]
        if overlay is not None and overlay.picture is not None:
            strain = float(overlay.picture[found.site])
            more.insert(0, strain_of(overlay.name, strain))
        return at_point(answer.unit, found, ways, more, shown.percent)

    def _stiffness(self, problem: Problem | None, found: Probe) -> str:
        tissue, frame = self._tissue, self._place
        if frame is None or tissue not in self._viewer.layers:
            return ""
        index = list(frame.index)
        for axis, at in zip(frame.plane, found.site, strict=True):
            index[axis] = at
        unit, value = str(known_of(tissue).get("unit", "")), full_resolution(tissue)[tuple(index)]
        if isinstance(tissue, Image):
            return stiffness_of("", float(f"{float(value):.3g}"), unit)
        material = self._materials.get(int(value))
        if problem is not None:  # a brush may have made it other tissue
            solved = problem.stiffness[found.site]
            same = [row for row in self._materials.values() if np.float32(row.stiffness) == solved]
            material = material if material in same else next(iter(same), None)
        if material is None:
            return ""
        return stiffness_of(material.name, material.stiffness, unit)

    def _on_status(self, event: Any) -> None:
        if self._line and _words(event.value).endswith(self._line):
            return  # our own addition, coming back
        self._said = event.value
        self._say()

    def _say(self) -> None:
        """Say what is under the cursor behind what napari has said last."""
        status, said = self._said, _words(self._said)
        # napari tells of its layers, too, before anybody has pointed at anything; and says nothing
        # when the mouse leaves, before it knows that it has left.
        pointed = bool(said) and self._viewer.mouse_over_canvas
        self._line = line = self.line_at(self._viewer.cursor.position) if pointed else ""
        joined = f"{said}  |  {line}" if line else said
        self._viewer.status = (
            {**status, "coordinates": joined} if isinstance(status, dict) else joined
        )


def _words(status: Any) -> str:
    return str(status.get("coordinates", "") if isinstance(status, dict) else status)


def at_point(
    unit: str,
    found: Probe,
    ways: Directions,
    more: Sequence[str] = (),
    percent: int = FULL,
) -> str:
    """What is under the cursor, in a line short enough for the status bar.

    It is of the whole deformation, however much (`percent`) of it is seen.
    """
    row, col = found.displacement
    down, along = (_rounded(part) for part in ways.seen((row, col)))
    length = _rounded(found.length)
    parts = [
        f"moves {length:g} {unit}" + (f" ({ways.step((down, along))})" if length else ""),
        f"Jacobian {found.jacobian:.3f}" + (" (folds)" if found.jacobian <= 0 else ""),
    ]
    line = ", ".join([*parts, *filter(None, more)])
    return line if percent == FULL else f"at {FULL} %: {line}"


def strain_of(name: Name, value: float) -> str:
    """The strain that colours show; of what is in each line anyway, nothing."""
    if name not in QUANTITIES:
        return ""
    title, unit = QUANTITIES[name]
    return f"{title} {_rounded(value):g} {unit}" if unit == "%" else ""


def _rounded(length: float) -> float:
    """To what matters: three digits, and no more than two decimals."""
    return round(float(f"{length:.3g}"), 2) + 0.0  # and no -0


def stiffness_of(name: str, stiffness: float, unit: str) -> str:
    """The tissue and how stiff it is."""
    amount = stiffness_in_words(stiffness, unit)
    if stiffness != RIGID:
        amount = f"stiffness {amount}" if unit else f"relative stiffness {amount}"
    return f"{amount} ({name})" if name else amount
