"""What the dock says at its bottom: what was done, what is wrong, and what can be done next."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.viewer_layers import still_there
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.study.edit_history import Step
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.live_study import LiveStudy
from napari_hmrf.ui.motion import motion_messages

#: Why something is read, which says what may take its place: a step is read until something new is
#: begun; so is what was refused, and before all that goes on meanwhile.
Why = Literal["news", "step", "refused"]


class Guide:
    """Knows which sentence may take the place of which.

    Where there is nothing to say, what can be done next is read. What was taken back stays to be
    read until something new is begun, and so does what was refused; what goes on is said while it
    does.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    live : LiveStudy
    undo : ViewerUndo
    """

    def __init__(self, viewer: Any, live: LiveStudy, undo: ViewerUndo) -> None:
        self._viewer, self._live = viewer, live
        form, pointer = self._form, self._pointer = live.form, live.pointer
        self._said = self._doing = self._read = ""
        self._why: Why = "news"
        for table in form.tables:
            table.found.connect(partial(self.say, why="step"))
            table.refused.connect(self.refuse)
        for told in (form.tissue.menu, live.binding):
            told.said.connect(partial(self.say, why="step"))
        form.tissue.editor.refused.connect(self.refuse)
        pointer.said.connect(self._on_pointer)
        pointer.refused.connect(self.refuse)
        pressed = (form.footer.deform.changed, form.motion.picked, form.image.changed)
        for begun in (form.edited, pointer.drawn, pointer.begun, *pressed):
            begun.connect(self._on_begun)
        live.refused.connect(self.refuse)
        live.said.connect(self._on_study)
        live.doing.connect(self._on_doing)
        live.moved_on.connect(self.show)
        live.followed.connect(self._on_followed)
        self._heard = Listening((undo.said, self._on_step))

    def release(self) -> None:
        """Say nothing of the viewer any more."""
        self._heard.release()

    @property
    def shown(self) -> str:
        """What is read."""
        doing = "" if self._why == "refused" else self._doing
        return doing or self._said or self.invitation

    @property
    def invitation(self) -> str:
        """What can be done next."""
        form, boundary = self._form, self._form.motion.boundary
        if form.image.value is None:
            return messages.CHOOSE if self._viewer.layers else messages.WELCOME
        if self._covered or self._viewer.dims.ndisplay != 2:
            return self._covered or motion_messages.FLAT
        begun = boundary.choice.value is not None
        how = motion_messages.START if form.footer.live.value or not begun else messages.READY
        if self._pointer.active:
            how = self._pointer.tool.how
        return f"{self._live.loose} {self._paused or how}".lstrip()

    def say(self, sentence: str, why: Why = "news") -> None:
        """Say something in place of all that was said."""
        self._said, self._why, self._read = sentence, why, ""
        self.show()

    def invite(self) -> None:
        """Say what can be done next, unless what was taken back or refused is to be read still."""
        if self._why == "news":
            self.say("")

    def refuse(self, sentence: str) -> None:
        """Say why what somebody did is not done, until they do something else."""
        self.say(sentence, "refused")

    def show(self, *_: object) -> None:
        """Show what is to be read now."""
        self._form.footer.say(self.shown)

    @property
    def _covered(self) -> str:
        """That the image is hidden beneath another, if it is."""
        image = still_there(self._viewer, self._form.image.value)
        other = None if image is None else image_covering(self._viewer, image)
        return "" if other is None else motion_messages.covered(other.name)

    @property
    def _paused(self) -> str:
        """That a tool was taken up and put down, and how to go on; "" if it was not."""
        arrows = self._pointer.display.arrows
        if arrows.former is None or self._live.study is None or self._pointer.active:
            return ""
        return motion_messages.ARROWS_GONE if arrows.layer is None else motion_messages.OFF

    def _on_begun(self, *_: object) -> None:
        """Something new is begun: what was taken back before has been read."""
        self._why, self._read = "news", self._said

    def _on_followed(self, *_: object) -> None:
        """What was said before something new was begun is true no more."""
        self.say("" if self._read else self._said, self._why)

    def _on_step(self, sentence: str, step: Step | None) -> None:
        """Say what was taken back, on another slice, too; and that the mouse draws no more."""
        drawn = step is not None and isinstance(step.value, Drawing)
        self.say(f"{sentence} {self._paused if drawn else ''}".rstrip(), "step")

    def _on_doing(self, sentence: str) -> None:
        if sentence != self._doing:
            self._doing = sentence
            self.show()

    def _on_pointer(self, sentence: str) -> None:
        if sentence:
            self.say(sentence)
        else:
            self.invite()

    def _on_study(self, sentence: str) -> None:
        """Say something of the study beside what was taken back; "": nothing is wrong any more."""
        if not sentence:
            self.invite()
        elif self._why != "refused":
            self.say(f"{self._said} {sentence}".lstrip() if self._why == "step" else sentence)
