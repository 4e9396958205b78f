"""What is under the cursor, for the status bar and the dock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from napari.layers import Image

from napari_hmrf.layers.metadata import TISSUE, known_of, rows_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_lookup import FoundResult, frame_in, place_at
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.tissue_point import Points, Probe
from napari_hmrf.study.layer_names import full_resolution
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_messages import FULL, NO_TISSUE, at_point, stiffness_of, strain_of


class UnderCursor:
    """Reads a result at the cursor, and says it behind what napari's status bar says.

    Nothing is computed but for the one pixel. Napari asks its layers in a thread of its own, at
    most as fast as that can answer; here one lookup is added to each of its answers.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    shown : LookedAt
    say : callable
        Given each new line; "" when the cursor has left the image.
    percent : callable
        How much of the deformation was chosen to be seen.
    """

    def __init__(
        self,
        viewer: Any,
        shown: LookedAt,
        say: Callable[[str], None],
        percent: Callable[[], int],
    ) -> None:
        self._viewer = viewer
        self._shown = shown
        self._say = say
        self._percent = percent
        self._points: Points | None = None
        self._tissue: Any = None
        self._place: Frame | None = None
        self._ways = Directions()
        self._materials: dict[int, Material] = {}
        self._line = ""
        viewer.events.status.connect(self._on_status)

    def release(self) -> None:
        """Listen no more."""
        self._viewer.events.status.disconnect(self._on_status)

    def watch(self, points: Points | None) -> None:
        """Read the result that is looked at from now on, of which these are the points."""
        self._points, result = points, self._shown.result
        if result is not None:
            self._ways = Directions.of(result.frame, self._viewer)

    def stiffness_from(self, tissue: Any, result: FoundResult) -> None:
        """Take the stiffness from labels and their table, or from an image; None for nowhere."""
        self._tissue = tissue
        self._place = None if tissue is None else frame_in(tissue, result)
        rows = () if tissue is None else rows_of(tissue, TISSUE) or ()
        self._materials = {material.label: material for material in rows}

    def at(self, position: Any) -> tuple[Probe | None, str]:
        """What happens to the tissue that is seen at a point of the world, and the line for it.

        Parameters
        ----------
        position : sequence of float
            As of `viewer.cursor.position`.

        Returns
        -------
        probe : Probe or None
        line : str
            "" beside the image.
        """
        result, layers, points = self._shown.result, self._shown.layers, self._points
        arrows = self._shown.layer("arrows")
        if result is None or layers is None or points is None or arrows is None:
            return None, ""
        place = place_at(arrows, result, position, View.of(self._viewer.dims))
        if place is None:
            return None, ""
        found = points.at(place, layers.percent / FULL)
        if found is None:
            return None, NO_TISSUE
        more = self._strain(found), self._stiffness(found)
        return found, at_point(result.unit, found, self._ways, more, self._percent())

    def _strain(self, found: Probe) -> str:
        overlay = self._shown.overlay
        if overlay is None or overlay.picture is None:
            return ""
        return strain_of(overlay.name, float(overlay.picture[found.row, found.col]))

    def _stiffness(self, found: Probe) -> str:
        tissue, frame = self._tissue, self._place
        if frame is None or tissue not in self._viewer.layers:
            return ""
        index = list(frame.index)
        index[frame.plane[0]], index[frame.plane[1]] = found.row, found.col
        unit, value = str(known_of(tissue).get("unit", "")), full_resolution(tissue)[tuple(index)]
        if isinstance(tissue, Image):
            return stiffness_of("", float(f"{float(value):.3g}"), unit)
        material = self._materials.get(int(value))
        if material is None:
            return ""
        return stiffness_of(material.name, material.stiffness, unit)

    def _on_status(self, event: Any) -> None:
        status = event.value
        said = status.get("coordinates", "") if isinstance(status, dict) else str(status)
        if self._line and said.endswith(self._line):
            return  # our own addition, coming back
        # napari tells of its layers, too, before anybody has pointed at anything.
        pointed = self._viewer.mouse_over_canvas
        line = self.at(self._viewer.cursor.position)[1] if pointed else ""
        if line != self._line:
            self._line = line
            self._say(line)
        if not line or line == NO_TISSUE:
            return
        joined = f"{said}  |  {line}" if said else line
        self._viewer.status = (
            {**status, "coordinates": joined} if isinstance(status, dict) else joined
        )
