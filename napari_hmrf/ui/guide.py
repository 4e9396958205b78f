"""Status text of the dock and its buttons: the scene of the dock, drawn after each event."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.line_of_sight import shows_volume
from napari_hmrf.layers.viewer_layers import layer_painted, still_there
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.notes import kind_of
from napari_hmrf.study.edit_history import Step
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.ui import messages
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.motion import motion_messages
from napari_hmrf.ui.scene import Scene, Situation, Status, Why, resolve
from napari_hmrf.ui.warning_chip import WarningChip


class Guide:
    """Status text of the dock and its buttons.

    Each event changes the `Status` or the parts of the dock; then the `Scene` is resolved again and
    drawn.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    undo : ViewerUndo
    """

    def __init__(self, viewer: Any, controller: Controller, undo: ViewerUndo) -> None:
        self._viewer, self._controller = viewer, controller
        form, pointer = self._form, self._pointer = controller.form, controller.pointer
        self._status = Status()
        self._drawn: Scene | None = None
        self._introduction = ""
        self._chip = WarningChip(viewer, form, undo.session)
        self._chip.message.connect(self._on_study)
        for table in form.tables:
            table.message.connect(self._on_table)
            table.refusal.connect(self.refuse)
        for source in (form.tissue.menu, controller.binding):
            source.message.connect(self._on_table)
        form.tissue.editor.refusal.connect(self.refuse)
        pointer.message.connect(self._on_pointer)
        pointer.refusal.connect(self.refuse)
        pressed = (form.footer.deform.changed, form.motion.picked)
        for begun in (form.edited, pointer.drawn, pointer.action_started, *pressed):
            begun.connect(self._on_begun)
        controller.refusal.connect(self.refuse)
        controller.message.connect(self._on_study)
        controller.progress.doing.connect(self._on_doing)
        pointer.changed.connect(self._on_tool)
        changes = (controller.slice_changed, controller.latest_changed)
        details = form.model.in_detail
        chosen = form.result.overlay, form.result.second, form.model.model, details.live
        for signal in (*changes, *(each.changed for each in chosen)):
            signal.connect(self.show)
        controller.result_drawn.connect(self._on_followed)
        self._session = undo.session
        self._connections = EventConnections(
            (undo.message, self._on_step), (undo.session.selected, self._on_begun)
        )

    def release(self) -> None:
        """Disconnect from the undo messages of the viewer."""
        self._connections.release()

    @property
    def scene(self) -> Scene:
        """What the dock shows now."""
        return resolve(self._situation(with_hint=not self._status.told), self._status)

    @property
    def situation(self) -> Situation:
        """What the parts of the dock know now."""
        return self._situation(with_hint=True)

    def _situation(self, with_hint: bool) -> Situation:
        """Return the situation; which image covers the chosen one takes time, and is for hints."""
        form, pointer, viewer = self._form, self._pointer, self._viewer
        tool, is_active, moved = pointer.tool, pointer.active, pointer.display.moved
        result = pointer.display.result
        image = still_there(viewer, self._session.image) if with_hint else None
        other = None if image is None else image_covering(viewer, image)
        place = None if moved is None else moved.study.grid.known_place
        tissue, boundary = form.tissue.choice.value, form.motion.boundary.choice.value
        return Situation(
            has_image=self._session.image is not None,
            is_painted=self._session.image is None and self._session.study is not None,
            has_layers=bool(viewer.layers),
            lacks_tissue=tissue is None,
            lacks_boundary=boundary is None,
            covering="" if other is None else other.name,
            is_3d=viewer.dims.ndisplay == 3,
            is_volume=form.extent.is_volume,
            has_slices=form.extent.has_slices,
            sees_volume=place is None
            or len(place.plane) == 2
            or shows_volume(place, self._controller.view),
            is_live=self._session.display.live,
            tool=tool.hint if is_active else "",
            tool_in_plane=tool.flat_hint,
            follows_surface=tool.follows_surface,
            introduction=self._pair_hint or self._introduction if tool.name == "pull" else "",
            paused=self._paused,
            is_painting=result is not None
            and result.is_before
            and layer_painted(viewer) is not None,
            latest=self._session.result_here,
            overlay=self._chip.overlay,
            model=self._session.model,
            has_selection=tool.selected is not None,
            has_marks=bool(pointer.drawing.marks),
        )

    @property
    def _pair_hint(self) -> str:
        """Hint about the second image until tissue moves, or ""."""
        image: Any = self._session.image
        second = self._form.result.second.value
        study = self._session.study
        if image is None or second is None or (study is not None and study.moves):
            return ""
        return messages.SECOND.format(image.name, second.name)

    @property
    def introduction(self) -> str:
        """Hint for a new sample; "" after the first action."""
        return self._introduction

    @introduction.setter
    def introduction(self, sentence: str) -> None:
        self._introduction = sentence
        self.show()

    def show_message(self, sentence: str, why: Why = "news") -> None:
        """Show a message in place of the previous message."""
        self._become(self._status.with_message(sentence, why))

    def add_aside(self, sentence: str) -> None:
        """Show a sentence, and append it to the message about the study that may follow."""
        self._become(self._status.with_aside(sentence))

    def invite(self) -> None:
        """Show the hint about the next step, unless a step or a refusal is being reported."""
        self._become(self._status.invited())

    def refuse(self, sentence: str) -> None:
        """Show why an action was refused, until a new action begins."""
        self.show_message(sentence, "refused")

    def show(self, *_: object) -> None:
        """Draw what differs from the scene that is drawn."""
        scene, before, form = self.scene, self._drawn, self._form
        self._drawn = scene
        shown = {} if before is None else vars(before)
        changed = {name for name, value in vars(scene).items() if value != shown.get(name)}
        if "status" in changed:
            form.footer.show_status(scene.status)
        if changed & {"new_layer", "can_add"}:
            form.make.text, form.make.enabled = scene.new_layer, scene.can_add
        if "has_study" in changed:
            for button in (form.intensity, form.result.keep):
                button.enabled = scene.has_study
            form.footer.reset.setEnabled(scene.has_study)
        if "is_live" in changed:
            form.footer.show_deform(not scene.is_live)
        if "obstacle" in changed:
            form.motion.show_obstacle(scene.obstacle)
        if changed & {"can_remove", "can_clear"}:
            form.footer.remove.setEnabled(scene.can_remove)
            form.footer.remove_all.setEnabled(scene.can_clear)
        if changed & {"warning", "short_warning"}:
            form.footer.warn(scene.warning, scene.short_warning)
        if "offer" in changed:
            form.footer.offer(scene.offer, messages.ABOUT_OFFERS[scene.offer])

    @property
    def _paused(self) -> str:
        """Message about how to resume drawing if drawing has stopped, else ""."""
        arrows = self._pointer.display.arrows
        if arrows.former is None or self._session.study is None or self._pointer.active:
            return ""
        return motion_messages.ARROWS_GONE if arrows.layer is None else motion_messages.OFF

    def _become(self, status: Status) -> None:
        self._status = status
        self.show()

    def _on_begun(self, *_: object) -> None:
        """Allow other messages to replace the current message, because a new action has begun."""
        self._status = self._status.after_action(self._controller.busy)

    def _on_followed(self, *_: object) -> None:
        """Clear a message from before the last action, because the result is newer."""
        self._become(self._status.after_picture())

    def _on_tool(self) -> None:
        if not self._pointer.tool.is_dragging:  # a drag does not change what is drawn
            self.show()

    def _on_table(self, sentence: str) -> None:
        self.show_message(sentence, "saved" if kind_of(sentence) == messages.SAVED else "step")

    def _on_step(self, sentence: str, step: Step | None) -> None:
        """Report an undo or redo; for a drawing, also how to resume drawing if it has stopped."""
        drawn = step is not None and isinstance(step.value, Drawing)
        self.show_message(f"{sentence} {self._paused if drawn else ''}".rstrip(), "step")

    def _on_doing(self, sentence: str) -> None:
        self._become(replace(self._status, doing=sentence))

    def _on_pointer(self, sentence: str) -> None:
        if sentence:
            self.show_message(sentence)
        else:
            self.invite()

    def _on_study(self, sentence: str) -> None:
        """Show a message about the study, appended to a step message; "" shows the hint instead."""
        self._become(self._status.about_study(sentence, self.situation.obstacle))
