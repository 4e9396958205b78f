"""Comparison of the deformed image with a second image, and residuals of landmarks."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from napari.layers import Image, Labels
from napari.layers.base import ActionType

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.units import as_seen
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.landmarks import landmark_pairs
from napari_hmrf.layers.result_layers import PlacedSolution
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_layers import layers_of, shared
from napari_hmrf.notes import kind_of
from napari_hmrf.results.landmark_pairs import LandmarkPairs
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.study.landmark_data import HELD_EDGE
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.tissue.usual_lengths import largest_spread
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.motion.tool import name_of
from napari_hmrf.ui.result.landmark_table import LandmarkRow, LandmarkRows
from napari_hmrf.ui.result.result_view import ResultView

#: Layer settings of the deformed and the second image; two equal images add up to grey.
_MOVED = {"colormap": "magenta"}
_OTHER = {"colormap": "green", "blending": "additive", "opacity": 1.0}
# Beginning of the summary of the landmarks, and another one if the chosen layers are not pairs.
_LANDMARKS, _DRAWN = "Landmarks", "Landmarks of the drawing"
# Clause about a drift of tissue whose edge is held.
_HINDERED = "the held outer edge hinders the drift (see 'Fix outer edge')"
# Number of decimals, in pixels, in which equal positions agree.
_DECIMALS = 6


class SecondImage:
    """View of a second image alone or over the deformed image, and residuals of landmarks.

    Residuals are measured when a result is selected, and when landmarks or chosen layers change.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    view : ResultView
        View of the selected result.
    controller : Controller
        Source of the landmarks: the chosen layers, or the drawing if no layers are chosen.
    session : Session
        Session with the drawing, in which the table edits standard deviations.
    """

    def __init__(
        self, viewer: Any, view: ResultView, controller: Controller, session: Session
    ) -> None:
        self._viewer, self._view, self._controller = viewer, view, controller
        self._session = session
        self._results = shared(viewer, ResultLayers)
        self._form = controller.form.result
        self._pair = controller.form.motion.landmarks
        # Settings of the compared layers, and visibility of the second image and the layer below
        # it, before the comparison.
        self._before: dict[Any, dict[str, Any]] = {}
        self._was_wanted, self._below = True, None
        choices = (self._form.second, self._pair.sources, self._pair.targets)
        # True if the result belongs to earlier inputs, because the current inputs were refused.
        self._is_outdated = False
        changes = (view.view_changed, *(choice.changed for choice in choices))
        self._connections = EventConnections(
            (viewer.layers.events.inserted, self.refresh),
            (session.selected, self.refresh),
            (session.displayed, self.refresh),
            (controller.outdated, self._on_outdated),
            (controller.deformation_changed, self._on_deformation),
            *((change, self.refresh) for change in changes),
        )
        self._points = EventConnections()
        # Layer with the residuals, and the name of their feature column.
        self._residuals: tuple[Any, str] | None = None
        view.more.landmarks, view.more.set_sd = self.list_distances, self._set_sd
        # Visibility of the second image before it is shown alone; None while it is not.
        self._was_visible: bool | None = None
        button = self._form.show_second.native
        button.pressed.connect(self.show_alone)
        button.released.connect(self.show_all)

    def release(self) -> None:
        """Restore all layers, and disconnect from all events."""
        self._connections.release()
        self._points.release()
        self.show_all()
        self._draw(None, [])

    def show_alone(self) -> None:
        """Show the second image, and hide the other images, until `show_all`."""
        second, written = self._form.second.value, layers_of(self._viewer)
        if second is None or self._was_visible is not None:
            return
        self._was_visible = written.is_wanted(second)
        others = [each for each in self._viewer.layers if each is not second]
        written.hide_while(self, [each for each in others if isinstance(each, Image | Labels)])
        written.want(second)

    def show_all(self) -> None:
        """Show the images again that `show_alone` has hidden."""
        if self._was_visible is None:
            return
        second, written = self._form.second.value, layers_of(self._viewer)
        if second is not None:
            written.want(second, wanted=self._was_visible)
        written.hide_while(self, ())
        self._was_visible = None

    def refresh(self, *_: Any) -> None:
        """Show the second image over the deformed image, and measure the landmarks."""
        image = self._session.image
        moved = [] if image is None else [image, *self._results.pictures_of(image)]
        second = self._form.second.value
        self._form.show_second.enabled = self._form.in_colours.enabled = second is not None
        self._draw(second if self._session.display.in_colours else None, moved)
        self._points.release()
        pair = {*self._pair.pair} - {None}
        self._points = EventConnections(*((layer.events.data, self._on_points) for layer in pair))
        self._measure()

    def list_distances(self) -> LandmarkRows | None:
        """List the distance of each landmark from its target, before and after the motion.

        Returns
        -------
        LandmarkRows or None
            None if there are no landmarks or no result. The rows have error bars once the
            uncertainty of the result is estimated.
        """
        shown, (_, pairs) = self._view.shown, self._pairs()
        if shown is None or pairs is None:
            return None
        answer, bars = shown.answer, [None] * len(pairs.at)
        if shown.estimated is not None:
            along = shown.estimated.along
            sites = np.rint(np.clip(pairs.at, 0, np.array(along.shape) - 1)).astype(np.intp)
            bars = along[tuple(sites.T)].tolist()
        numbers, lengths = pairs.numbers.tolist(), pairs.distances(answer.solution).tolist()
        columns = zip(numbers, *lengths, self._marks_of(pairs), bars, strict=True)
        largest = largest_spread(answer.shape, answer.solution.spacing)
        rows = [LandmarkRow(*row) for row in columns]
        return LandmarkRows(rows, answer.unit, largest, self._is_outdated)

    def _set_sd(self, mark: Landmark, sd: float) -> None:
        """Set the standard deviation of a landmark of the drawing, as one undo step."""
        drawing = self._session.drawing
        if mark in drawing.marks and mark.sd != sd:
            changed = replace(mark, sd=sd)
            drawing = drawing.replaced(drawing.marks.index(mark), changed)
            self._session.draw(drawing, f"changed {name_of(changed)}")
        self._measure()

    def _draw(self, other: Any, moved: list[Any]) -> None:
        """Restore the layers of the last comparison, and draw an image over the moved images."""
        compared, layers = [] if other is None else [other, *moved], self._viewer.layers
        written = layers_of(self._viewer)
        if compared == list(self._before):
            return
        for layer, look in self._before.items():
            _set(layer, look)
        second = next(iter(self._before), None)
        if second in layers and second is not other:  # on top, it would cover the image
            written.want(second, wanted=self._was_wanted)
            written.move(second, written.above(self._below))
        self._before = {}
        for layer in compared:
            look = dict(_OTHER if layer is other else _MOVED)
            if layer.rgb:
                del look["colormap"]
            self._before[layer] = {name: getattr(layer, name) for name in look}
            _set(layer, look)
        if other is not None and other is not second:
            at, self._was_wanted = layers.index(other), written.is_wanted(other)
            self._below = layers[at - 1] if at else None
            written.want(other)
        if other is not None:
            written.move(other, max(layers.index(other), written.above(*moved)))

    def _on_outdated(self) -> None:
        self._is_outdated = True
        self._measure()

    def _on_deformation(self, _: Any) -> None:
        """Expect a result of the current inputs, which `refresh` measures."""
        self._is_outdated = False

    def _on_points(self, event: Any) -> None:
        if event.action in (ActionType.ADDED, ActionType.REMOVED, ActionType.CHANGED):
            self._measure()

    def _measure(self) -> None:
        """Show the residuals of the landmarks, and remove the previous residuals."""
        earlier, self._residuals = self._residuals, None
        if earlier is not None and earlier[1] in earlier[0].features:
            earlier[0].features = earlier[0].features.drop(columns=earlier[1])
        self._form.show_landmarks(self._describe_residuals())
        self._view.more.refresh_landmarks()

    def _describe_residuals(self) -> str:
        """Describe the residuals and the drift, and store each residual with its landmark."""
        shown, (where, pairs) = self._view.shown, self._pairs()
        if shown is None or pairs is None:
            return ""
        solution, unit = shown.answer.solution, shown.answer.unit
        lengths = pairs.distances(solution)
        if where is not None:
            column = np.full(len(where.data), np.nan)
            column[pairs.numbers] = lengths[1]
            self._residuals = where, f"residual ({unit})"
            where.features = where.features.assign(**{self._residuals[1]: column})
        both = np.sqrt((lengths**2).mean(axis=1)).tolist()
        before, after = (as_seen(length, solution.spacing) for length in both)
        apart = f"{before:.3g} {unit} apart before, {after:.3g} now (RMS of {len(pairs.at)})"
        is_drawn = where is None and self._pair.sources.value is not None
        subject = _DRAWN if is_drawn else _LANDMARKS
        if self._is_outdated:
            subject = f"{subject} in the last result, before the refused edit"
        clauses = [f"{subject}: {apart}", *drift_clauses(solution)]
        latest = self._session.result
        if latest is not None and any(kind_of(note) == HELD_EDGE for note in latest.notes):
            clauses.append(_HINDERED)
        return "; ".join(clauses)

    def _marks_of(self, pairs: LandmarkPairs) -> list[Landmark | None]:
        """Return the landmark of the drawing with the positions of each pair, or None."""
        marks = {
            _key((*mark.source, *mark.target)): mark
            for mark in self._session.drawing.marks
            if isinstance(mark, Landmark)
        }
        places = np.concatenate([pairs.at, pairs.to], axis=1).tolist()
        return [marks.get(_key(place)) for place in places]

    def _pairs(self) -> tuple[Any, LandmarkPairs | None]:
        """Return the landmarks of the chosen layers, or of the drawing, and their layer.

        The landmarks of the drawing, without a layer, are returned if no layer is chosen, or if
        the chosen layers do not contain valid pairs; None is returned without a result.
        """
        if self._view.shown is None:
            return None, None
        answer, (where, should) = self._view.shown.answer, self._pair.pair
        if where is not None:
            view = View.of(self._viewer.dims)
            with suppress(HmrfError):  # reported when the landmarks are added
                return where, landmark_pairs(where, should, answer.frame, answer.shape, view)
        return None, self._drawn_pairs(answer)

    def _drawn_pairs(self, answer: PlacedSolution) -> LandmarkPairs | None:
        """Return the landmarks of the drawing, or None."""
        study = self._session.study
        if study is None or study.grid.place != answer.frame:  # another image
            return None
        marks = (mark for mark in study.motion.drawing.marks if isinstance(mark, Landmark))
        both = [(mark.source, mark.target) for mark in marks]
        if not both:
            return None
        at, to = np.array(both, dtype=float).swapaxes(0, 1)
        return LandmarkPairs(np.arange(len(at)), at, to)


def _key(places: Iterable[float]) -> tuple[float, ...]:
    """Return positions without rounding errors, to compare them."""
    return tuple(round(place, _DECIMALS) + 0.0 for place in places)


def _set(layer: Any, look: dict[str, Any]) -> None:
    for name, value in look.items():
        setattr(layer, name, value)
