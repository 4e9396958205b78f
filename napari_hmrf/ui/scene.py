"""What the dock shows, as a function of what its parts know; nothing here is changed or drawn.

`Status` holds the messages of events. `resolve` combines it with the `Situation`, which is read
from the parts of the dock each time, into the `Scene`: texts, and which buttons can be pressed.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from napari_hmrf.layers.result_layers import CompleteResult
from napari_hmrf.notes import kind_of
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.ui import messages
from napari_hmrf.ui.motion import motion_messages

#: Labels of the button that adds the missing layers for painting.
NEW_TISSUE, NEW_BOUNDARY = "New tissue layer", "New boundary layer"
#: Why a message is shown. A step, a saved file and a refusal are told until a new action begins. A
#: saved file is told beside the progress of later work, and a refusal instead of it.
Why = Literal["news", "step", "saved", "refused"]


@dataclass(frozen=True)
class Status:
    """Messages of the dock's parts; each method returns the status after an event.

    Attributes
    ----------
    message : str
        Latest message, or "" for the hint.
    why : Why
    is_old : bool
        True if an action has begun since the message.
    doing : str
        Progress of a job, or "".
    aside : str
        Sentence that is appended to the next message about the study.
    """

    message: str = ""
    why: Why = "news"
    is_old: bool = False
    doing: str = ""
    aside: str = ""

    @property
    def told(self) -> str:
        """Message or progress; "" if the hint is shown instead."""
        if self.doing and self.why == "saved":
            return f"{self.message} {self.doing}"
        return self.doing if self.doing and self.why != "refused" else self.message

    def with_message(self, sentence: str, why: Why = "news") -> Status:
        """Return the status with another message; "" shows the hint about the next step."""
        return replace(self, message=sentence, why=why, is_old=False)

    def with_aside(self, sentence: str) -> Status:
        """Return the status with a sentence that the next message about the study includes."""
        told = self.with_message(sentence) if self.why == "news" else self
        return replace(told, aside=sentence)

    def invited(self) -> Status:
        """Return the status without news, so that the hint is shown."""
        return self.with_message("") if self.why == "news" else self

    def after_action(self, is_busy: bool) -> Status:
        """Return the status after the start of an action.

        Any message may then replace the present one. If no work is in progress, no message about
        the study follows that an aside belongs to.
        """
        return replace(self, why="news", is_old=True, aside=self.aside if is_busy else "")

    def after_picture(self) -> Status:
        """Return the status after a new result, without a message from before the last action."""
        return self.with_message("" if self.is_old else self.message, self.why)

    def about_study(self, sentence: str, obstacle: str) -> Status:
        """Return the status with a message about the study, which a message about a step precedes.

        If `obstacle` is not "", tissue cannot be moved in this view, so that an advice to move it
        is left out.
        """
        told = f"{sentence} {self.aside}".strip()
        status = replace(self, aside="")
        if not told or (obstacle and not self.aside and kind_of(sentence) == messages.NO_MOTION):
            return status.invited()
        if self.why == "refused" or self.message.endswith(told):
            return status
        if self.why in ("step", "saved"):
            return status.with_message(f"{self.message} {told}".lstrip())
        return status.with_message(told)


@dataclass(frozen=True)
class Situation:
    """What the parts of the dock know.

    Attributes
    ----------
    has_image, has_layers : bool
        True if an image is chosen, and if the viewer has layers.
    is_painted : bool
        True if painted tissue is deformed without an image.
    lacks_tissue, lacks_boundary : bool
        True if no tissue and no boundary layer is chosen.
    covering : str
        Name of another image that covers the chosen one, or "".
    is_3d, is_volume, has_slices, sees_volume : bool
        True if the view is in 3-D, the extent is the whole volume, the image has slices, and the
        view shows the volume of the latest result.
    is_live : bool
    tool : str
        Hint of the tool that draws now; "" if the mouse does not draw.
    tool_in_plane : str
        Further hint of the tool in the 2-D view.
    follows_surface : bool
        True if the tool paints on the surface of a volume.
    introduction : str
        Hint for a new sample that replaces the hint of *Pull*, or "".
    paused : str
        How to continue drawing, if it has stopped, or "".
    is_painting : bool
        True while the deformed image is hidden because the user paints.
    latest : CompleteResult, optional
        Latest result of the current slice or volume.
    overlay : str
        Visible overlay of the result.
    model : ModelChoice
    has_selection, has_marks : bool
        True if a mark is selected, and if the drawing has marks.
    """

    has_image: bool = False
    has_layers: bool = False
    is_painted: bool = False
    lacks_tissue: bool = True
    lacks_boundary: bool = True
    covering: str = ""
    is_3d: bool = False
    is_volume: bool = False
    has_slices: bool = False
    sees_volume: bool = True
    is_live: bool = True
    tool: str = ""
    tool_in_plane: str = ""
    follows_surface: bool = False
    introduction: str = ""
    paused: str = ""
    is_painting: bool = False
    latest: CompleteResult | None = None
    overlay: str = ""
    model: ModelChoice = field(default_factory=ModelChoice)
    has_selection: bool = False
    has_marks: bool = False

    @property
    def obstacle(self) -> str:
        """Reason why the tools cannot be used in this view, or ""."""
        if not self.is_3d:
            return ""
        if not self.is_volume:
            return motion_messages.ONE_SLICE if self.has_slices else motion_messages.FLAT
        return "" if self.sees_volume else motion_messages.FLAT

    @property
    def hint(self) -> str:
        """Hint about the next step."""
        if not (self.has_image or self.is_painted):
            return messages.no_image(has_layers=self.has_layers)
        if self.covering:
            return motion_messages.covered(self.covering)
        if self.obstacle:
            return self.obstacle
        unheld = "" if self.latest is None else messages.unheld_warning(self.latest.notes)
        step = self.paused or self._step
        return messages.with_button(" ".join(filter(None, (unheld, step))), self.is_live)

    @property
    def _step(self) -> str:
        if not self.tool:
            can_drag = self.is_live or self.lacks_boundary
            return motion_messages.START if can_drag else messages.READY
        hint = self.introduction or self.tool
        if not self.is_3d:
            return f"{hint} {self.tool_in_plane}".rstrip()
        depth = "" if self.follows_surface else motion_messages.IN_DEPTH
        return f"{hint} {motion_messages.TURN} {depth}".rstrip()


@dataclass(frozen=True)
class Scene:
    """Texts of the dock, and which of its buttons can be pressed.

    Attributes
    ----------
    status : str
    is_live : bool
        True if every edit is solved at once.
    new_layer : str
        Label of the button that adds layers for painting.
    can_add : bool
        True if a layer can be added.
    has_study : bool
        True if there is a study to save or reset, and brightness to derive tissue from.
    obstacle : str
        Reason why the tools cannot be used, or "".
    can_remove, can_clear : bool
        True if there is a mark to remove, and if there are marks at all.
    warning, short_warning : str
        Warnings about the result, and the label of the chip that shows them; or "".
    offer : str
        Label of the button that offers a remedy, or "".
    """

    status: str
    is_live: bool
    new_layer: str
    can_add: bool
    has_study: bool
    obstacle: str
    can_remove: bool
    can_clear: bool
    warning: str
    short_warning: str
    offer: str


def resolve(situation: Situation, status: Status) -> Scene:
    """Return what the dock shows."""
    latest, warnings = situation.latest, ("", "")
    if latest is not None:
        warnings = messages.warnings_of(latest, situation.overlay)
    return Scene(
        status=messages.with_button(_text(situation, status), situation.is_live),
        is_live=situation.is_live,
        new_layer=NEW_TISSUE if situation.lacks_tissue else NEW_BOUNDARY,
        can_add=situation.has_image and (situation.lacks_tissue or situation.lacks_boundary),
        has_study=situation.has_image or situation.is_painted,
        obstacle=situation.obstacle,
        can_remove=situation.has_selection,
        can_clear=situation.has_marks,
        warning=warnings[0],
        short_warning=warnings[1],
        offer=messages.offer_of(latest, situation.model),
    )


def _text(situation: Situation, status: Status) -> str:
    if not situation.is_painting or status.told != status.message:
        return status.told or situation.hint
    return f"{status.message} {messages.MEANWHILE}".lstrip()
