"""Values of the result under the cursor, for the status bar."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from napari_hmrf.layers.compat import sight_of
from napari_hmrf.layers.field_layer import place_at
from napari_hmrf.layers.line_of_sight import LineOfSight, cut_of
from napari_hmrf.layers.metadata import tissue_recorded
from napari_hmrf.layers.slice_view import View, directions_of
from napari_hmrf.results.quantities import QUANTITIES, title_and_unit
from napari_hmrf.results.tissue_point import Probe, at_point, rounded
from napari_hmrf.tissue.boundary_rules import RIGID, stiffness_in_words
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.result_messages import FULL


class UnderCursor:
    """Values of a result at the cursor, appended to napari's status text.

    Values are computed for a single pixel. napari queries its layers in a separate thread, only as
    often as that thread can respond; this class adds one lookup to each response.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    shown : callable
        Returns the displayed result, or None.
    """

    def __init__(self, viewer: Any, shown: Callable[[], MovingLayers | None]) -> None:
        self._viewer, self._shown = viewer, shown
        # Text that was appended to napari's status.
        self._line = ""
        viewer.events.status.connect(self.append_to_status)

    def release(self) -> None:
        """Disconnect from the status bar."""
        self._viewer.events.status.disconnect(self.append_to_status)

    def refresh(self) -> None:
        """Refresh the values under the cursor after the displayed tissue has changed."""
        cursor = self._viewer.cursor
        cursor.events.position(value=cursor.position)  # napari reads its layers again
        self.append_to_status()

    def at(self, position: Any) -> Probe | None:
        """Return the deformation of the visible tissue at a point in world coordinates.

        In a 3-D view, this is the tissue on the visible surface or cut plane at the cursor.

        Returns None outside tissue, and while the tissue moves, because the result is then out of
        date.

        Parameters
        ----------
        position : sequence of float
            World coordinates, as in `viewer.cursor.position`.
        """
        shown, place = self._shown(), self._place_of(position)
        if shown is None or place is None:
            return None
        return shown.points.at(place, shown.layers.percent / FULL)

    def _place_of(self, position: Any) -> tuple[float, ...] | None:
        """Return the visible point at the cursor, in pixels of the result, or None."""
        shown = self._shown()
        arrows = None if shown is None else shown.layers.layer("arrows")
        if shown is None or arrows is None or shown.layers.moving:
            return None
        view = View.of(self._viewer.dims)
        if self._viewer.dims.ndisplay == 2:
            return place_at(arrows, shown.answer, position, view)
        return self._place_in_sight(shown, arrows, position, view)

    def _place_in_sight(
        self, shown: MovingLayers, arrows: Any, position: Any, view: View
    ) -> tuple[float, ...] | None:
        """Return the visible point of a volume on the line of sight, in voxels, or None."""
        answer, layer = shown.answer, shown.visible_image
        if layer is None or len(position) < arrows.ndim:
            return None
        line = LineOfSight.through(position, sight_of(self._viewer), arrows, answer.frame, view)
        if line is None:
            return None
        cut = cut_of(layer, answer.frame, view)
        points = line.visible_points(layer, cut, answer.shape)
        point = shown.points.first(points, shown.layers.percent / FULL)
        if point is None:
            return None
        at = view.pixel(arrows, position)
        at[list(answer.frame.plane)] = point
        return answer.frame.place_of(at, answer.shape)  # None at another time of a time series

    def line_at(self, position: Any) -> str:
        """Describe the deformation at a point in world coordinates; "" outside tissue."""
        probe, shown = self.at(position), self._shown()
        if probe is None or shown is None:
            return ""
        answer, overlay = shown.answer, shown.overlay
        ways = directions_of(answer.frame, self._viewer)
        more = [_stiffness(shown, probe)]
        if overlay is not None and overlay.picture is not None and overlay.name in QUANTITIES:
            title, unit = title_and_unit(overlay.name, answer.solution)
            if unit == "%":  # every line includes the other quantities anyway
                strain = float(overlay.picture[probe.site])
                is_fold = bool(np.isinf(strain))
                more.insert(0, f"{title}: folded" if is_fold else f"{title} {rounded(strain):g} %")
            elif overlay.name in ("von_mises", "pressure"):
                stress = float(overlay.picture[probe.site])
                if np.isfinite(stress):
                    more.insert(
                        0, f"{title} {stress:.3g}{'' if unit == 'relative' else f' {unit}'}"
                    )
        percent = 0 if shown.layers.is_before else shown.percent
        problem = answer.problem
        # Tissue is free if any of its components is free.
        held, missing = 0.0, 0.0
        if problem is not None:
            held = float(problem.confidence[probe.site].min())
            missing = float(np.linalg.norm(problem.observed[probe.site] - probe.displacement))
        bars = None if shown.estimated is None else shown.estimated.along
        spread = None if bars is None else float(bars[probe.site])
        line = at_point(answer.unit, probe, ways, more, percent, held, missing, spread)
        return f"{self._depth_of(position)}{line}"

    def _depth_of(self, position: Any) -> str:
        """Return the place of the tissue in a 3-D view, where napari shows that of the slice."""
        shown, place = self._shown(), self._place_of(position)
        if self._viewer.dims.ndisplay == 2 or shown is None or place is None:
            return ""
        arrows = shown.layers.layer("arrows")
        if arrows is None or arrows.ndim != len(place):
            return ""
        at = arrows.data_to_world(place)
        return f"at [{', '.join(f'{along:.2f}' for along in at)}]: "

    def append_to_status(self, *_: Any) -> None:
        """Append the values under the cursor to napari's latest status text."""
        status = self._viewer.status
        known = status if isinstance(status, dict) else {"coordinates": status}
        text = str(known.get("coordinates", "")).removesuffix(self._line)
        # napari also emits a status before the mouse first enters the canvas. When the mouse
        # leaves, napari emits an empty string before it updates `mouse_over_canvas`.
        is_over_canvas = bool(text) and self._viewer.mouse_over_canvas
        line = self.line_at(self._viewer.cursor.position) if is_over_canvas else ""
        self._line = f"  |  {line}" if line else ""
        joined = text + self._line
        new_status = {**known, "coordinates": joined} if known is status else joined
        with self._viewer.events.status.blocker(self.append_to_status):
            self._viewer.status = new_status


def _stiffness(shown: MovingLayers, probe: Probe) -> str:
    """Describe the tissue and its stiffness in the solve; "" if they are not in the result."""
    answer = shown.answer
    if answer.problem is None:
        return ""
    value, unit = answer.problem.stiffness[probe.site], answer.solution.stress_unit
    labels, rows = answer.pictures.labels, tissue_recorded(shown.arrows)[0] or ()
    # A brush may have painted a tissue that differs from the label.
    same = [row for row in rows if np.float32(row.stiffness) == value]
    same.sort(key=lambda row: labels is None or row.label != labels[probe.site])
    if not same:
        return stiffness_of("", float(f"{value:.3g}"), unit)
    return stiffness_of(same[0].name, same[0].stiffness, unit)


def stiffness_of(name: str, stiffness: float, unit: str) -> str:
    """Describe a tissue and its stiffness."""
    amount = stiffness_in_words(stiffness, unit)
    if stiffness != RIGID:
        amount = f"stiffness {amount}" if unit else f"relative stiffness {amount}"
    return f"{amount} ({name})" if name else amount
