"""What happens in the viewer, and what the dock does about it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from napari.layers import Labels
from psygnal import Signal

from napari_hmrf.field.frame import PLACE
from napari_hmrf.layers.image_choice import in_middle, uncover
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, role_of
from napari_hmrf.layers.pixel_copy import CHANGES
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.usual_lengths import usual_radius, usual_step
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.live_study import LiveStudy
from napari_hmrf.ui.motion.motion_messages import ARROWS_GONE

#: What napari paints with.
_BRUSHES = ("paint", "erase", "fill", "polygon")


class ViewerWatch:
    """Listens for a dock while it is there.

    napari's own brushes paint on the image as it was before it moved, so while one of them is at
    work that is what is seen.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    live : LiveStudy
    guide : Guide
    """

    #: There is a first image, which nobody is at work with: it can be pulled.
    first_came = Signal()

    def __init__(self, native: Any, viewer: Any, live: LiveStudy, guide: Guide) -> None:
        self._viewer, self._live, self._guide = viewer, live, guide
        self._form, self._binding, self._pointer = live.form, live.binding, live.pointer
        self._model = undo_of(viewer).model
        self._results = shared(viewer, ResultLayers)
        self._active = viewer.layers.selection.active
        self._starting = single_shot(native, 0, self._on_first)
        # napari may be in the middle of removing more layers than the one.
        self._leaving = single_shot(native, 0, self._on_left)
        self._begun = self._was_active = False
        # What is to be said of a layer that is gone.
        self._gone = ""
        live.moved_on.connect(self._on_other)
        self._slice = self._slice_shown
        self._form.edited.connect(self._on_choice)
        self._form.image.changed.connect(self._on_image)
        self._answers: dict[str, Any] = {
            "inserted": self._on_inserted,
            "removed": self._on_removed,
            "renamed": self._binding.look,
            "reordered": guide.show,
            "visible": guide.show,
            "mode": self._on_mode,
            **dict.fromkeys((*CHANGES, *PLACE), self._on_pixels),
        }
        self._events = Listening(
            (viewer.layers.events, self._on_layers),
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events, self._on_slice),
        )
        viewer.mouse_drag_callbacks.append(self._on_drag)
        self._on_choice()

    def release(self) -> None:
        """Listen no more."""
        self._events.release()
        if self._on_drag in self._viewer.mouse_drag_callbacks:
            self._viewer.mouse_drag_callbacks.remove(self._on_drag)

    def _on_other(self, study: Study) -> None:
        """Another slice or image is worked on: have lengths that suit the first, and pull it."""
        if not self._begun:
            self._begun = True
            size = study.grid.shape, study.grid.spacing
            self._form.motion.fields.begin_with(usual_radius(*size), usual_step(*size))
            self._starting.start()

    def _on_first(self) -> None:
        """Nothing has to be pressed to pull the first image, unless somebody is at work with it."""
        at_work = any(layer is not None for layer in self._painted)
        looked_at = self._viewer.layers.selection.active in (None, self._form.image.value)
        if looked_at and not at_work:
            self.first_came.emit()

    def hide_paint(self) -> None:
        """Hide what is painted: it says where tissue is before it moves, and would tint it."""
        painted, roles = self._painted, (TISSUE, BOUNDARY)
        seen = [each for each in self._viewer.layers if each.visible]
        seen = [each for each in seen if each in painted or role_of(each) in roles]
        for layer in seen:
            layer.visible = False
        if seen:
            hidden = messages.chosen(self._form.image.value, seen)
            self._guide.say(f"{self._guide.invitation} {hidden}", "step")

    @property
    def _painted(self) -> tuple[Any, Any]:
        """What says what is tissue and what holds it: layers, or the image itself."""
        return self._form.tissue.choice.value, self._form.motion.boundary.choice.value

    # What is chosen, and what it holds

    def _on_choice(self, *_: Any) -> None:
        form, there = self._form, self._form.image.value is not None
        form.make.enabled = there and None in self._painted
        form.intensity.enabled = form.result.keep.enabled = there
        self._live.touch()
        self._guide.show()

    def _on_image(self, image: Any) -> None:
        """Have the image that is chosen be seen, and what came of it; and no other's results."""
        self._results.show_only(image)
        if image is None:
            self._rest()
        if not self._binding.automatic:
            hidden = () if image is None else uncover(self._viewer, image)
            if image is not None and not in_middle(self._viewer, image):
                self._viewer.reset_view()
            self._guide.say(messages.chosen(image, hidden), why="step")
        self._on_choice()

    def _rest(self) -> None:
        """Work on nothing."""
        self._live.cancel()
        self._live.forget()
        self._guide.say("")
        self._leaving.start()

    # What is shown

    def _on_slice(self, *_: Any) -> None:
        # An arrow over the image's edge makes the canvas larger, and napari says as much.
        before, self._slice = self._slice, self._slice_shown
        if self._slice != before:
            self._pointer.turn()
            self.look_at_mouse()
            self._live.touch()

    @property
    def _slice_shown(self) -> tuple[tuple[int, ...], list[float]]:
        """Which axes are drawn, and where on all others."""
        dims = self._viewer.dims
        return dims.displayed, [dims.point[axis] for axis in dims.not_displayed]

    def _on_layers(self, event: Any) -> None:
        """Answer what happens to the list of layers, or to a layer in it."""
        if event.type in self._answers:
            self._answers[event.type](event)

    def _on_pixels(self, event: Any) -> None:
        """The pixels of a layer, or their place, may be others."""
        if self._reads(event.sources[0]):
            self._live.touch()

    def _reads(self, layer: Any) -> bool:
        """Whether a layer is among those that are read."""
        return layer in (self._form.image.value, *self._model.choice.layers)

    def _on_inserted(self, event: Any) -> None:
        self._binding.look()
        self._binding.take(event.value)
        self._on_choice()

    def _on_removed(self, event: Any) -> None:
        layer, live, display = event.value, self._live, self._pointer.display
        was_read = self._reads(layer)
        self._gone = self._gone_with(layer) or self._gone
        self._binding.look()
        if layer is display.arrows.former and not display.quiet:
            self._guide.say(ARROWS_GONE, why="step")
        if layer is live.source:
            self._rest()
        elif was_read and live.settling:
            live.cancel()
        self._leaving.start()
        self._on_choice()

    def _gone_with(self, layer: Any) -> str:
        """Say what goes with a layer, as napari brings none back; "" if nothing does."""
        tissue, boundary = self._painted
        study, is_source = self._live.study, layer is self._live.source
        if is_source and study is not None and study.motion.drawing.marks:
            return messages.DRAWING_GONE.format(name=layer.name)
        words = {id(tissue): messages.TISSUE_GONE, id(boundary): messages.BOUNDARY_GONE}
        return "" if is_source else words.get(id(layer), "").format(name=layer.name)

    def _on_left(self) -> None:
        """Take away the results of images that are gone, and the tools if there is none left."""
        self._results.remove_orphans()
        if self._form.image.value is None and self._live.study is None:
            self._pointer.leave()
            self.look_at_mouse()
        if self._gone:
            self._guide.say(self._gone, why="step")
            self._gone = ""

    # Who feels the mouse

    def look_at_mouse(self) -> None:
        """Another layer feels the mouse, or ours does again."""
        pointer = self._pointer
        if not pointer.display.quiet:
            stopped, self._was_active = self._was_active and not pointer.active, pointer.active
            if stopped:
                pointer.release()
                self._guide.say("")
            self._guide.show()
            pointer.changed.emit()

    def _on_active(self, *_: Any) -> None:
        before, self._active = self._active, self._viewer.layers.selection.active
        self.look_at_mouse()
        if self._active is not before:  # else a layer of ours has come beside it
            self._on_mode()

    @property
    def _is_painted(self) -> bool:
        """Whether napari's brush paints what the study is read from."""
        active = self._viewer.layers.selection.active
        painted = isinstance(active, Labels) and active in self._painted
        return painted and active.mode in _BRUSHES

    def _on_mode(self, *_: Any) -> None:
        """A brush that is taken up is to be put on the image as it was."""
        self._live.show_before(self._is_painted)

    def _on_drag(self, _: Any, event: Any) -> Iterator[None]:
        """While a brush paints the image is seen as it was; after that as it has moved."""
        if not self._is_painted:
            return
        self._live.show_before(True)
        yield
        while event.type == "mouse_move":
            yield
        self._live.show_before(False)
