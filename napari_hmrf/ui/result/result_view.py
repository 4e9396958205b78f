"""View of the selected result: its overlay, its percentage, and its comparison with a reference."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from psygnal import Signal

from napari_hmrf.errors import naming
from napari_hmrf.layers.compat import camera_of, scale_bar_of
from napari_hmrf.layers.field_layer import can_be_source, field_of, result_of, source_of
from napari_hmrf.layers.image_result import Result, ResultLayers
from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.result_layers import Name, Overlay, PlacedSolution, overlay_of
from napari_hmrf.layers.slice_view import directions_of
from napari_hmrf.layers.viewer_layers import layer_painted, put_brush_away
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.results.comparison import Comparison, compare
from napari_hmrf.study.session import Session
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.forms import attempt, show_choices, show_quietly
from napari_hmrf.ui.jobs import Jobs, reason_of
from napari_hmrf.ui.result import result_messages as words
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.moving_layers import MovingLayers, Player, arrow_scale, how_far
from napari_hmrf.ui.result.result_form import BEFORE_KEY, PAUSE, PLAY, ResultForm
from napari_hmrf.ui.result.result_menu import ResultMenu

#: Time without a change of the zoom after which marks are drawn again, in milliseconds.
_ZOOM_REST = 100
#: Corner of the key; the other corners of the canvas contain legends and the name of the tool.
_CORNER = "bottom_left"
#: Largest relative error of arrows that count as drawn to scale.
_TRUE = 0.01


class ResultView:
    """View of the selected result, controlled by the result form.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    form : ResultForm
    results : ResultLayers
        Results in the viewer.
    session : Session
        Session with the overlay.

    Attributes
    ----------
    arrows : napari.layers.Vectors or None
        Arrow layer that stores the selected result; by default, the newest result.
    """

    #: Emitted with a message for the user.
    message = Signal(str)
    #: Emitted when the selected result or its state has changed.
    view_changed = Signal()
    #: Emitted with the name of a long task, when it begins.
    working = Signal(str)

    def __init__(
        self,
        native: Any,
        viewer: Any,
        form: ResultForm,
        results: ResultLayers,
        session: Session,
        jobs: Jobs,
    ) -> None:
        self._viewer, self._form, self._results = viewer, form, results
        self._session = session
        self._jobs = jobs
        self.shown: MovingLayers | None = None
        #: Difference between the result and its reference, or None.
        self.comparison: Comparison | None = None
        self.cursor = UnderCursor(viewer, lambda: self.shown)
        # Distance of a drag, shown until the next result is drawn; "" shows the result.
        self._pulled = ""
        self.key = ScaleKey(viewer, lambda: self.shown)
        self.key.length_changed.connect(self._show_distance)
        self.player = Player(native, self._jobs, lambda: self.shown)
        self.more = ResultMenu(form, viewer, lambda: self.shown, self.message.emit, jobs)
        form.slider.changed.connect(self._on_slider)
        form.overlay.changed.connect(self._on_chosen)
        form.arrows.changed.connect(lambda value: session.choose_display(arrows=value))
        form.reference.changed.connect(self._on_reference)
        form.play.changed.connect(self._on_play)
        form.before.native.pressed.connect(partial(setattr, self, "before", True))
        form.before.native.released.connect(partial(setattr, self, "before", False))
        self.player.moved.connect(self._on_moved)
        self.player.drawn.connect(self.cursor.refresh)
        self.player.playing_changed.connect(
            lambda playing: setattr(form.play, "text", PAUSE if playing else PLAY)
        )
        self._zoom_timer = single_shot(native, _ZOOM_REST, self._on_zoomed)
        self._events = EventConnections(
            (camera_of(viewer).events.zoom, self._on_zoom),
            (viewer.dims.events.order, self._on_zoom),
            (viewer.dims.events.ndisplay, self._on_zoom),
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_removed),
            (viewer.layers.selection.events.active, self._on_active),
            (results.changed, self._on_changed),
            (results.before_changed, self._show_distance),
            (session.displayed, self._show_arrows),
        )
        with suppress(ValueError):  # another plugin has bound the key
            viewer.bind_key(BEFORE_KEY, self._while_key_is_held)
        arrows = [layer for layer in viewer.layers if result_of(layer) is not None]
        self.arrows = max(reversed(arrows), key=lambda each: results.of(each).visible, default=None)

    # State

    @property
    def _overlay(self) -> Any:
        """Name of the chosen overlay."""
        return self._session.display.overlay

    @property
    def before(self) -> bool:
        """True if the undeformed image is shown; always False without a result."""
        return self.shown is not None and self.shown.layers.is_before

    @before.setter
    def before(self, hold: bool) -> None:
        if self.shown is None:
            return
        source = self.shown.layers.anchor()
        if hold:
            self._results.show_undeformed(source, "comparison")
        else:
            self._results.show_deformed(source)

    @property
    def arrows(self) -> Any:
        """Arrow layer that stores the selected result, or None."""
        return None if self.shown is None else self.shown.arrows

    @arrows.setter
    def arrows(self, arrows: Any) -> None:
        """Select the result that is stored in an arrow layer."""
        before = self.shown
        answer, shown = None if arrows is None else result_of(arrows), None
        self._pulled = ""
        if answer is not None:
            shown = MovingLayers(self._viewer, arrows, answer, self._results.of(arrows))
        other = before is None or shown is None or shown.layers is not before.layers
        chosen = other or self._jobs.busy("overlay")  # the user may have chosen a pending overlay
        # A newer state of the same result must not hide the undeformed image.
        self._put_back(release=other)
        if before is not None and other:
            before.layers.leave()
        self.shown = shown
        self.key.refresh()
        self.cursor.refresh()
        self._form.offer(self.arrows)
        self._show_arrows()
        self.view_changed.emit()
        self._compare()
        if shown is None:
            return
        attempt(shown.copy_image, self.message.emit)
        self._offer(shown)
        if self._overlay != words.NOTHING:
            self._lay_over(chosen)

    # Actions

    def select_image(self, image: Any, _: Any = None) -> None:
        """Select the result of an image; do nothing if its result is already selected."""
        shown, layers = self.shown, self._viewer.layers
        if shown is not None and shown.source in (None, image):
            return
        answers = ((layer, result_of(layer)) for layer in reversed(layers))
        own = (
            layer
            for layer, answer in answers
            if answer is not None and source_of(layers, answer) is image
        )
        self.arrows = None if image is None else next(own, None)

    def play(self) -> None:
        """Play back and forth between 0 and 100 % until `player.stop` is called."""
        if self._can_move():
            self.player.play()

    def show_pulled(self, text: str) -> None:
        """Show the distance of a drag until the next result is drawn; "" shows the result."""
        if text != self._pulled:
            self._pulled = text
            self._show_distance()

    def rest(self) -> None:
        """Restore the layers and remove the key binding, because the dock is closing."""
        if self._while_key_is_held in self._viewer.keymap.values():
            self._viewer.bind_key(BEFORE_KEY, None)
        self.key.hide()
        self._put_back()

    def release(self) -> None:
        """Disconnect from all events."""
        self._events.release()
        self.more.release()
        self.cursor.release()
        self.key.release()

    # Comparison with a reference

    def _compare(self) -> None:
        """Compare the result with the chosen reference, if any, in the background."""
        shown, reference, self.comparison = self.shown, self._form.reference.value, None
        self._show_distance()
        self._jobs.cancel("comparison")
        field = field_of(reference)
        if shown is not None and field is not None:
            answer, name = shown.answer, str(reference.name)

            def work() -> Comparison:
                with naming(observed=name):
                    return compare(answer.solution, answer.frame, field, name)

            self._jobs.submit("comparison", work, self._on_compared)

    def _on_compared(self, comparison: Comparison) -> None:
        self.comparison = comparison
        self._show_distance()
        if self._overlay == "difference":
            self._lay_over(chosen=True)

    def _on_reference(self, *_: Any) -> None:
        self._compare()
        if self.shown is not None:
            self._offer(self.shown)
            if self._overlay == words.NOTHING:
                self._lay_over(chosen=False)  # the difference was removed with its reference

    # Selection of the result

    def _on_changed(self, result: Result) -> None:
        """Respond to a change in a result, such as another slice or a new solution."""
        shown, arrows = self.shown, result.layer("arrows")
        moves = self.player.playing or self._jobs.busy("moment")
        if shown is None or result is not shown.layers:
            # While the user paints, a new result is hidden.
            is_hidden = result.is_before and layer_painted(self._viewer) is not None
            if arrows is not None and (result.visible or is_hidden):
                self.arrows = arrows
        elif result.is_away or not (result.moving or result.holds("arrows")):
            self.arrows = None
        elif not result.moving:
            self.arrows = arrows
        else:
            self._jobs.cancel("uncertainty")
            self.cursor.append_to_status()
            if moves or self._form.slider.value != words.FULL:
                self._draw_whole()  # the layers were redrawn at 100 %

    def _on_active(self, *_: Any) -> None:
        """Select the result of the active arrow layer, even of another image, slice or file."""
        active = self._viewer.layers.selection.active
        answer = None if active in (None, self.arrows) else result_of(active)
        if answer is not None and not self._results.of(active).is_away:
            self.arrows = active

    def _on_chosen(self, *_: Any) -> None:
        self._end_before()
        self._lay_over(chosen=True)

    def _on_inserted(self, event: Any) -> None:
        shown, layer = self.shown, event.value
        if result_of(layer) is not None:
            self.arrows = layer
        elif shown is None or shown.source in self._viewer.layers:
            return
        elif can_be_source(layer, shown.answer):  # the image of a result from a file
            self.arrows = shown.arrows

    def _on_removed(self, event: Any) -> None:
        if self.shown is None:
            return
        # Layers removed by the dock are no longer parts of a result.
        part = self.shown.layers.part_of(event.value)
        if part == "overlay":
            self._session.choose_display(overlay=words.NOTHING)
        elif event.value is self.shown.arrows:
            if part is not None and self.shown.source in self._viewer.layers:
                self.message.emit(messages.LOST.format(layer=event.value.name))
            self.arrows = None

    def _show_arrows(self, *_: Any) -> None:
        """Tick the box of the arrows if those of the result are shown."""
        shown = self.shown
        is_wanted = shown is not None and shown.layers.is_wanted("arrows")
        show_quietly(self._form.arrows, is_wanted)

    # Overlay

    def _offer(self, shown: MovingLayers) -> None:
        """Offer the overlays of a result, and select the visible overlay."""
        choice, layer_shown = self._form.overlay, shown.layers.layer("overlay")
        name = self._overlay
        if name == words.NOTHING and layer_shown is not None and layer_shown.visible:
            name = metadata_of(layer_shown)["kind"]  # left by a dock that was closed
        ways = directions_of(shown.answer.frame, self._viewer)
        compared = self._form.reference.value is not None
        if name == "difference" and not compared:
            name = words.NOTHING
        has_bars = shown.answer.estimate is not None or shown.estimated is not None
        unit = shown.answer.unit
        offered = words.overlay_choices(unit, ways, has_bars=has_bars, compared=compared)
        show_choices(choice, offered, name)
        self._session.choose_display(overlay=name)

    def _lay_over(self, chosen: bool) -> None:
        """Draw the selected overlay in the background; with `chosen`, make it visible."""
        shown, name = self.shown, self._overlay
        if shown is None:
            return
        if name == "uncertainty" and shown.estimated is None:
            self._jobs.cancel("overlay")
            self._on_overlay(shown, name, False, None)  # the overlay of another name disappears
            self._estimate(shown.answer)
            return
        self._jobs.cancel("uncertainty")
        if name == words.NOTHING:
            self._jobs.cancel("overlay")
            self._on_overlay(shown, name, False, None)
        # Without a comparison, the difference is drawn after the comparison is computed.
        elif name != "difference" or self.comparison is not None:
            answer = partial(self._on_overlay, shown, name, chosen)
            work = partial(overlay_of, shown.answer, name, self.comparison, shown.estimated)
            self._jobs.submit("overlay", work, answer)

    def cancel_estimate(self) -> None:
        """Stop an estimate of the uncertainty, and show no overlay."""
        if self._jobs.busy("uncertainty"):
            self._on_not_estimated("")

    def _estimate(self, answer: PlacedSolution) -> None:
        """Estimate the uncertainty of the selected result in the background."""
        if answer.estimate is None:
            self._on_not_estimated(words.NO_UNCERTAINTY)
        elif not self._jobs.busy("uncertainty"):
            self._jobs.submit(
                "uncertainty",
                answer.estimate,
                partial(self._on_estimated, answer),
                lambda error: self._on_not_estimated(reason_of(error)),
                yields=True,
            )
            self.working.emit(words.ESTIMATING)

    def _on_estimated(self, answer: PlacedSolution, estimated: Uncertainty) -> None:
        if self.shown is not None and self.shown.answer is answer:
            self.shown.estimated = estimated
            self._lay_over(chosen=True)
            self.more.refresh_landmarks()
            self.message.emit(words.least_sure(answer, estimated))
            self.cursor.refresh()

    def _on_not_estimated(self, reason: str) -> None:
        self._session.choose_display(overlay=words.NOTHING)  # also cancels the estimate
        self.message.emit(f"{words.NOT_ESTIMATED} {reason}".rstrip())

    def _on_overlay(
        self, shown: MovingLayers, name: Name, chosen: bool, made: Overlay | None
    ) -> None:
        self._jobs.cancel("moment")
        shown.lay_over(made, chosen)
        self._show_distance()
        if made is None and chosen:
            self.message.emit(words.LACKING[name])
        if self._form.slider.value != words.FULL:
            self.player.show(self._form.slider.value)
        self.cursor.refresh()

    def _on_zoom(self, *_: Any) -> None:
        if self.shown is not None and self.shown.has_marks:
            self._zoom_timer.start()

    def _on_zoomed(self) -> None:
        """Draw marks at least a few screen pixels wide at the new zoom."""
        if self.shown is not None:
            self.shown.refresh_marks()

    # Percentage

    def _can_move(self) -> bool:
        """Prepare the layers to move; if no layer can move, report why and return False."""
        self._end_before()
        if self.shown is None:
            self.message.emit(words.NO_RESULT)
        elif not self.shown.ready():
            self.message.emit(words.NO_IMAGE)
        else:
            if self._is_buried:
                self.message.emit(words.BURIED)
            return True
        return False

    def _end_before(self) -> None:
        """Show the deformed image, and end painting, which shows the undeformed image."""
        if self.shown is not None:
            put_brush_away(self._viewer)
        self.before = False

    @property
    def _is_buried(self) -> bool:
        """True if the result is a slice inside a volume that is visible in a 3-D view."""
        shown = self.shown
        if shown is None or shown.source is None or self._viewer.dims.ndisplay == 2:
            return False
        is_slice = len(shown.answer.frame.plane) == 2 and shown.source.ndim > 2
        return is_slice and bool(shown.source.visible)

    def _put_back(self, release: bool = True) -> None:
        """Show the deformation at 100 %, and drop all jobs of the selected result."""
        self._jobs.cancel("overlay", "comparison", "moment", "uncertainty")
        if self.shown is not None:
            if release:
                self.before = False
            self.shown.layers.show_whole()
        self._draw_whole()

    def _draw_whole(self) -> None:
        """Stop playing, and draw the arrows at 100 %."""
        self.player.stop()
        self._jobs.cancel("moment")
        if self.shown is not None:
            self.shown.draw_whole()
        self._set_slider(words.FULL)

    def _set_slider(self, percent: int) -> None:
        show_quietly(self._form.slider, percent)
        self._show_distance()

    def _show_distance(self, *_: Any) -> None:
        """Show the percentage, the largest displacement, the slice and the differences."""
        text = ""
        if (shown := self.shown) is not None:
            percent, is_before = self._form.slider.value, shown.layers.is_before
            text = how_far(
                shown.answer, shown.longest, percent, self.comparison, is_before=is_before
            )
            if not is_before:
                text = ". ".join(filter(None, (text, arrow_scale(shown.times_as_long))))
            if shown.overlay is not None and percent == words.FULL and not is_before:
                text = ". ".join(filter(None, (text.rstrip("."), shown.overlay.beyond)))
        self._form.how_far.show_text(self._pulled or text)

    # Buttons and events

    def _on_slider(self, percent: int) -> None:
        self.player.stop()
        if self._can_move():
            self._on_moved(percent)

    def _on_moved(self, percent: int) -> None:
        self._set_slider(percent)
        self.player.show(percent)

    def _on_play(self, *_: Any) -> None:
        if self.player.playing:
            self.player.stop()
        else:
            self.play()

    def _while_key_is_held(self, _: Any) -> Any:
        self.before = True
        yield
        self.before = False


class ScaleKey:
    """Scale bar of napari as the scale key, visible while the arrows are drawn to scale.

    A scale bar that the user has switched on or off is left unchanged.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    shown : callable
        Returns the displayed result, or None.
    """

    #: Emitted when the displayed length of the arrows has changed.
    length_changed = Signal()

    def __init__(self, viewer: Any, shown: Callable[[], MovingLayers | None]) -> None:
        self._bar, self._shown = scale_bar_of(viewer), shown
        # Visibility that this object has set; None before the first change.
        self._set: bool | None = None
        self._corner = self._bar.position
        self._events = EventConnections((viewer.layers.events, self._on_layers))

    @property
    def is_true(self) -> bool:
        """True if arrows are visible and as long as the displacement in the image."""
        shown = self._shown()
        if shown is None or not shown.has_arrows:
            return False
        return abs(shown.times_as_long - 1) < _TRUE

    def refresh(self) -> None:
        """Show or hide the key."""
        bar, visible = self._bar, self.is_true
        if bar.visible != bool(self._set) or bar.visible == visible:
            return  # the user has switched the bar, or it is correct
        bar.position = _CORNER if visible else self._corner
        bar.visible = self._set = visible

    def release(self) -> None:
        """Disconnect from all events."""
        self._events.release()

    def hide(self) -> None:
        """Hide the key, because the dock is closing."""
        if self._set and self._bar.visible:
            self._bar.visible, self._bar.position = False, self._corner

    def _on_layers(self, event: Any) -> None:
        if event.type in ("visible", "length", "removed"):
            self.refresh()
        if event.type == "length":
            self.length_changed.emit()
