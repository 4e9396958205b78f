"""Base class of the mouse tools."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, TypedDict, cast

import numpy as np

from napari_hmrf.errors import HmrfError
from napari_hmrf.study.session import Session
from napari_hmrf.tissue.drawing import Drawing, Mark, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, is_empty
from napari_hmrf.tissue.drawing.marks import Components, Point
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion, PresentMotion, present_motion

#: Function that maps a visible point to its undeformed position, or to None outside tissue.
Origin = Callable[[Point], Point | None]


def identity(point: Point) -> Point | None:
    """Return the point itself, as the `Origin` of undeformed tissue."""
    return point


class ToolSettings(TypedDict, total=False):
    """Settings of a mark, by attribute; a tool sets the attributes that it has fields for."""

    radius: float
    by: Point
    amount: float
    confidence: float
    softness: float
    label: int
    components: Components


class LandmarkSettings(ToolSettings, total=False):
    """Settings of a landmark."""

    sd: float


class ToolError(HmrfError):
    """Error raised if a tool action has no effect; the message is shown to the user."""


class Tool(ABC):
    """Tool that edits the drawing of a slice by drags; each drag is one undo step.

    A new tool is a subclass that is listed in `tools.TOOLS`. The `Pointer` calls only methods of
    this class, so it works with any tool.

    Parameters
    ----------
    session : Session
        Session with the drawing of the selected slice.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    shape : tuple of int
        Shape of the image.

    Attributes
    ----------
    name : str
        Name used in Python and for the icon file of the button.
    title : str
        Title of the button, also shown on the canvas.
    key : str
        Key that selects the tool while the layer *Motion* is active. It must differ from napari's
        keys for Vectors layers and for the viewer.
    fields : tuple of str
        Names of the fields in `ToolFields` with the settings of the tool.
    hint : str
        Instructions, shown in the tooltip of the button and in the status.
    flat_hint : str
        More instructions, for the 2-D view only.
    present : callable
        Present motion of the tissue, which a click keeps; see `PresentMotion`.
    takes_wheel : bool
        True if the mouse wheel over tissue changes a mark, instead of the zoom.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    key: ClassVar[str]
    fields: ClassVar[tuple[str, ...]]
    hint: ClassVar[str]
    flat_hint: ClassVar[str] = ""
    #: True if a press near an end of an arrow or landmark grabs this end.
    grabs_ends: ClassVar[bool] = False
    takes_wheel: ClassVar[bool] = False

    def __init__(
        self,
        session: Session,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, ...] = (1, 1),
    ) -> None:
        self._session = session
        self._spacing = tuple(map(float, spacing))
        self._shape = shape
        self._selected: int | None = None
        #: Motion of the tissue at the button press, which a click keeps.
        self.present: PresentMotion = np.zeros_like
        # Drawing that the number of the selected mark refers to.
        self._numbered = Drawing()

    @classmethod
    @abstractmethod
    def makes(cls, mark: Mark) -> bool:
        """Return whether a mark is of the kind that this tool makes."""

    # Drags

    @abstractmethod
    def press(
        self, point: Point, reach: float, settings: ToolSettings, origin: Origin = identity
    ) -> str:
        """Begin a drag, if possible at this point.

        Parameters
        ----------
        point : tuple of float
            Point on the visible image, in pixels.
        reach : float
            Largest distance at which the press grabs a mark, in the unit of the spacing.
        settings : ToolSettings
            Settings of a new mark.
        origin : callable
            Returns the undeformed position of a visible point.

        Returns
        -------
        str
            Message for the user; "" shows the instructions of the tool.
        """

    @abstractmethod
    def move(self, point: Point) -> None:
        """Continue the drag to a point; do nothing if no drag is in progress."""

    def release(self) -> str | None:
        """End the drag as one undo step.

        Returns
        -------
        str or None
            Message for the user; None keeps the current message.

        Raises
        ------
        ToolError
            If the mark is invalid; the drawing is then unchanged.
        """
        self._session.end_drawing()
        return None

    def turn_wheel(
        self, point: Point, notches: float, settings: ToolSettings, origin: Origin = identity
    ) -> bool:
        """Change a mark with the mouse wheel; all turns until `release` are one undo step.

        Parameters
        ----------
        point, settings, origin
            As for `press`.
        notches : float
            Number of notches by which the wheel was turned; positive if it was turned up.

        Returns
        -------
        bool
            True if a mark was changed.
        """
        return False

    def cancel(self) -> bool:
        """Cancel the drag and restore the drawing; return whether there was a drag."""
        was_dragging, number = self.is_dragging, self._selected
        if was_dragging:
            self._session.cancel_drawing()
            self.select(number if number in range(len(self._session.drawing.marks)) else None)
        return was_dragging

    @property
    def is_dragging(self) -> bool:
        """True while a drag is in progress."""
        return self._session.drawing_in_progress

    @property
    def follows_surface(self) -> bool:
        """True if a drag in the 3-D view follows the surface, instead of the screen."""
        return False

    @property
    def stroke(self) -> Stroke | None:
        """Stroke that is being painted, or None; shown before the tissue is updated."""
        return None

    @property
    def error_message(self) -> str:
        """Message that replaces the errors of an unfinished drag; "" shows the errors."""
        return ""

    @property
    def pulled(self) -> Point | None:
        """Displacement of the tissue that is being dragged; None if no tissue is dragged."""
        return None

    def cursor(self, settings: ToolSettings) -> float | None:
        """Return the radius of the circle around the pointer, or None if there is no circle.

        napari repaints the whole canvas whenever the circle moves. During a drag, no circle is
        shown, because the mark itself is visible.
        """
        return None if self.is_dragging else settings["radius"]

    # Selection

    @property
    def selected(self) -> int | None:
        """Index of the mark made or selected last; None after another edit of the drawing."""
        if self._session.drawing is not self._numbered:
            self._selected = None
        return self._selected

    @property
    def mark(self) -> Mark | None:
        """Selected mark, or None."""
        number = self.selected
        return None if number is None else self._session.drawing.marks[number]

    @property
    def mark_settings(self) -> ToolSettings | None:
        """Settings of the selected mark that `change` can set; None if no mark is selected."""
        mark = self.mark
        if mark is None:
            return None
        names = LandmarkSettings.__annotations__
        values = {name: value for name, value in vars(mark).items() if name in names}
        # A landmark has no choice of components: it prescribes both components.
        return cast(ToolSettings, {"components": "both", **values})

    def select(self, number: int | None) -> None:
        """Select a mark to change or remove; None clears the selection."""
        self._numbered, self._selected = self._session.drawing, number

    def pick(self, number: int | None) -> None:
        """Select the mark that the user clicked on the canvas; None clears the selection."""
        self.select(number)

    def remove(self) -> bool:
        """Remove the selected mark, and return whether a mark was selected."""
        mark, number = self.mark, self.selected
        if mark is None or number is None:
            return False
        self.select(None)
        self._session.draw(self._session.drawing.without(number), f"removed {name_of(mark)}")
        return True

    def change(self, settings: ToolSettings) -> None:
        """Apply changed settings to the selected mark, without moving it."""
        mark, number, changed = self.mark, self.selected, self._changed(settings)
        if number is None or changed is None or self.is_dragging:
            return
        if changed != mark:
            drawing = self._session.drawing.replaced(number, changed)
            self._numbered = drawing  # set before callbacks read the selection
            self._session.draw(drawing, f"changed {name_of(changed)}")

    @abstractmethod
    def _changed(self, settings: ToolSettings) -> Mark | None:
        """Return the selected mark with new settings; None if no mark is selected."""

    def _motion_under(self, mark: Mark) -> PatchMotion | None:
        """Return the present motion of the tissue under a mark; None if it moves as a block."""
        box = box_of(mark, self._spacing, tuple(slice(0, size) for size in self._shape))
        return None if is_empty(box) else present_motion(box, self._spacing, self.present)

    # Edits within a drag

    def _show(self, drawing: Drawing, number: int) -> None:
        """Show the drawing with the mark that is being dragged, and select this mark."""
        self._numbered, self._selected = drawing, number
        self._session.update_drawing(drawing)
        # The session keeps its own object if the drawing is equal.
        self._numbered = self._session.drawing

    def _replace(self, mark: Mark) -> None:
        """Replace the mark that is being dragged."""
        if self._selected is not None:
            self._show(self._session.drawing.replaced(self._selected, mark), self._selected)


def name_of(mark: Mark) -> str:
    """Return the kind of a mark with an indefinite article, such as "an arrow"."""
    kind = type(mark).__name__.lower()
    return f"an {kind}" if kind == "arrow" else f"a {kind}"
