"""Status text of the dock: results, errors, and hints about the next step."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.line_of_sight import shows_volume
from napari_hmrf.layers.viewer_layers import still_there
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.study.edit_history import Step
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.ui import messages
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.footer import DEFORM
from napari_hmrf.ui.motion import motion_messages

#: Kind of the current message. Messages of kind "step" and "refused" remain until a new action
#: begins; "refused" also hides the progress.
Why = Literal["news", "step", "refused"]


class Guide:
    """Status text of the dock, selected from the messages of all its parts.

    Progress is shown while a job runs, and a hint about the next step if there is no message. A
    message about a step, an undo or a refusal remains until a new action begins.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    undo : ViewerUndo
    """

    def __init__(self, viewer: Any, controller: Controller, undo: ViewerUndo) -> None:
        self._viewer, self._controller = viewer, controller
        form, pointer = self._form, self._pointer = controller.form, controller.pointer
        self._message = self._doing = self._read = ""
        # Sentence that is appended to the next message about the study.
        self._aside = ""
        self._why: Why = "news"
        self._introduction = ""
        self._is_painting = False
        for table in form.tables:
            table.message.connect(partial(self.show_message, why="step"))
            table.refusal.connect(self.refuse)
        for source in (form.tissue.menu, controller.binding):
            source.message.connect(partial(self.show_message, why="step"))
        form.tissue.editor.refusal.connect(self.refuse)
        pointer.message.connect(self._on_pointer)
        pointer.refusal.connect(self.refuse)
        pressed = (form.footer.deform.changed, form.motion.picked, form.image.changed)
        for begun in (form.edited, pointer.drawn, pointer.action_started, *pressed):
            begun.connect(self._on_begun)
        controller.refusal.connect(self.refuse)
        controller.message.connect(self._on_study)
        controller.progress.doing.connect(self._on_doing)
        controller.slice_changed.connect(self.show)
        controller.result_drawn.connect(self._on_followed)
        self._connections = EventConnections((undo.message, self._on_step))

    def release(self) -> None:
        """Disconnect from the undo messages of the viewer."""
        self._connections.release()

    @property
    def shown(self) -> str:
        """Displayed status text; it names the button "Deform" as the button is labelled now."""
        doing = "" if self._why == "refused" else self._doing
        if doing and self._why == "step" and self._message.startswith(messages.SAVED):
            doing = f"{self._message} {doing}"
        text, button = doing or self._message, self._form.footer.deform.text
        if not text:
            text = messages.MEANWHILE if self._is_painting else self.invitation
        if self._is_painting and messages.MEANWHILE not in text and not doing:
            text = f"{text} {messages.MEANWHILE}"
        return text if button == DEFORM else text.replace(f"ress {DEFORM}", f"ress '{button}'")

    @property
    def is_painting(self) -> bool:
        """True while the deformed image is hidden because the user paints."""
        return self._is_painting

    @is_painting.setter
    def is_painting(self, is_painting: bool) -> None:
        if is_painting != self._is_painting:
            self._is_painting = is_painting
            self.show()

    @property
    def introduction(self) -> str:
        """Hint for a new sample; "" after the first action."""
        return self._introduction

    @introduction.setter
    def introduction(self, sentence: str) -> None:
        self._introduction = sentence
        self.show()

    @property
    def invitation(self) -> str:
        """Hint about the next step."""
        form, boundary = self._form, self._form.motion.boundary
        if form.image.value is None:
            return messages.CHOOSE if self._viewer.layers else messages.WELCOME
        if self._covered or self.obstacle:
            return self._covered or self.obstacle
        begun = boundary.choice.value is not None
        hint = motion_messages.START if form.footer.live.value or not begun else messages.READY
        if self._pointer.active:
            tool = self._pointer.tool
            hint = (self._introduction if tool.name == "pull" else "") or tool.hint
            if self._viewer.dims.ndisplay == 2:
                hint = f"{hint} {tool.flat_hint}".rstrip()
            else:
                depth = "" if tool.follows_surface else motion_messages.IN_DEPTH
                hint = f"{hint} {motion_messages.TURN} {depth}".rstrip()
        sentences = self._controller.unheld_warning, self._paused or hint, form.footer.live.reason
        return " ".join(filter(None, sentences))

    @property
    def obstacle(self) -> str:
        """Reason why the tools cannot be used in this view, or ""."""
        extent, moved = self._form.extent, self._pointer.display.moved
        if self._viewer.dims.ndisplay == 2:
            return ""
        if not extent.is_volume:
            return motion_messages.ONE_SLICE if extent.has_slices else motion_messages.FLAT
        place = None if moved is None else moved.study.grid.known_place
        seen = place is None or shows_volume(place, self._form.view()) or len(place.plane) == 2
        return "" if seen else motion_messages.FLAT

    def show_message(self, sentence: str, why: Why = "news") -> None:
        """Show a message in place of the previous message."""
        self._message, self._why, self._read = sentence, why, ""
        self.show()

    def add_aside(self, sentence: str) -> None:
        """Show a sentence, and append it to the message about the study that may follow."""
        self._aside = sentence
        if self._why == "news":
            self.show_message(sentence)

    def invite(self) -> None:
        """Show the hint about the next step, unless a step or a refusal is being reported."""
        if self._why == "news":
            self.show_message("")

    def refuse(self, sentence: str) -> None:
        """Show why an action was refused, until a new action begins."""
        self.show_message(sentence, "refused")

    def show(self, *_: object) -> None:
        """Write the status text to the footer."""
        self._form.footer.show_status(self.shown)

    @property
    def _covered(self) -> str:
        """Message if another image covers the chosen image, else ""."""
        image = still_there(self._viewer, self._form.image.value)
        other = None if image is None else image_covering(self._viewer, image)
        return "" if other is None else motion_messages.covered(other.name)

    @property
    def _paused(self) -> str:
        """Message about how to resume drawing if drawing has stopped, else ""."""
        arrows = self._pointer.display.arrows
        if arrows.former is None or self._controller.study is None or self._pointer.active:
            return ""
        return motion_messages.ARROWS_GONE if arrows.layer is None else motion_messages.OFF

    def _on_begun(self, *_: object) -> None:
        """Allow other messages to replace the current message, because a new action has begun."""
        self._why, self._read = "news", self._message
        if not self._controller.busy:  # else the sentence belongs to the result to come
            self._aside = ""

    def _on_followed(self, *_: object) -> None:
        """Clear a message from before the last action, because the result is newer."""
        self.show_message("" if self._read else self._message, self._why)

    def _on_step(self, sentence: str, step: Step | None) -> None:
        """Report an undo or redo; for a drawing, also how to resume drawing if it has stopped."""
        drawn = step is not None and isinstance(step.value, Drawing)
        self.show_message(f"{sentence} {self._paused if drawn else ''}".rstrip(), "step")

    def _on_doing(self, sentence: str) -> None:
        if sentence != self._doing:
            self._doing = sentence
            self.show()

    def _on_pointer(self, sentence: str) -> None:
        if sentence:
            self.show_message(sentence)
        else:
            self.invite()

    def _on_study(self, sentence: str) -> None:
        """Show a message about the study, appended to a step message; "" shows the hint instead."""
        aside, self._aside = self._aside, ""
        sentence = f"{sentence} {aside}".strip()
        if not sentence or (sentence == messages.STILL and self.obstacle):
            self.invite()
        elif self._why != "refused" and not self._message.endswith(sentence):
            self.show_message(
                f"{self._message} {sentence}".lstrip() if self._why == "step" else sentence
            )
