"""Question about the drawing after a change between a slice and the whole volume."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from magicgui.widgets import Container, PushButton

from napari_hmrf.study.session import Part, Session
from napari_hmrf.tissue.drawing import Drawing, Mark
from napari_hmrf.tissue.drawing.extents import SliceInVolume
from napari_hmrf.ui.forms import Prose, row


class CarryOverForm(Container):
    """Question with two buttons; visible only while the question is open.

    Attributes
    ----------
    carry, keep : PushButton
    """

    def __init__(self) -> None:
        self._text = Prose()
        self.carry = PushButton(
            text="Carry over",
            tooltip="Copy these marks to what is deformed now, as one step that Undo removes",
        )
        self.keep = PushButton(
            text="Keep there", tooltip="Leave these marks where they were drawn; nothing changes"
        )
        super().__init__(widgets=[self._text, row(self.carry, self.keep)], labels=False)
        self.margins = (0, 0, 0, 0)
        self.show_question("")

    def show_question(self, question: str) -> None:
        """Show a question; "" hides the form."""
        self.visible = bool(question)
        self._text.show_text(question)


class CarryOver:
    """Offer to copy the marks of a slice to the volume, or of the volume to a slice.

    A slice and its volume have separate drawings, so a change between them never removes a mark.

    Parameters
    ----------
    form : CarryOverForm
    session : Session
    draw : callable
        Replaces the drawing, given a `Drawing` and the name of the undo step.
    show_message : callable
        Called with each message.
    """

    def __init__(
        self,
        form: CarryOverForm,
        session: Session,
        draw: Callable[[Drawing, str], None],
        show_message: Callable[[str], None],
    ) -> None:
        self._form, self._session = form, session
        self._draw, self._show_message = draw, show_message
        self._slice = session.slice
        self._marks: tuple[Mark, ...] = ()
        form.carry.changed.connect(lambda _: self._on_carry())
        form.keep.changed.connect(lambda _: self._on_keep())

    def refresh(self, *_: object) -> None:
        """Ask about the marks of the previous slice or volume, if the extent has changed."""
        before, self._slice = self._slice, self._session.slice
        if self._slice == before:
            return
        self._close()
        marks = self._session.get(before, Drawing()).marks
        if not (marks and _is_other_extent(before, self._slice)):
            return
        present = self._session.drawing.marks
        copies = _copies(marks, before, self._slice)
        self._marks = tuple(mark for mark in copies if mark is not None and mark not in present)
        if self._marks:
            self._form.show_question(_question(self._marks, copies, before, self._slice))
        elif None in copies:
            others = copies.count(None)
            self._show_message(
                f"{_count(others)} of the volume {_are(others)} on other slices, and "
                f"{_stay(others)} with the volume."
            )

    def _on_carry(self) -> None:
        marks, to = self._marks, self._slice
        self._close()
        if marks and to == self._session.slice:
            words = f"carried over {_count(len(marks)).lower()}"
            self._draw(Drawing((*marks, *self._session.drawing.marks)), words)
            self._show_message(f"C{words[1:]}. Press Undo to remove the copies.")

    def _on_keep(self) -> None:
        count = len(self._marks)
        self._close()
        where = "volume" if len(self._slice.plane) == 2 else "slice"
        self._show_message(f"{_count(count)} {_stay(count)} with the {where}.")

    def _close(self) -> None:
        self._marks = ()
        self._form.show_question("")


def _is_other_extent(one: Part, other: Part) -> bool:
    """Return whether one part is a slice and the other part is a volume of the same image."""
    if one.layer is not other.layer:
        return False
    return {len(one.plane), len(other.plane)} == {2, 3}


def _copies(marks: Sequence[Mark], source: Part, target: Part) -> list[Mark | None]:
    """Return the marks as marks of the other extent; None for marks on other slices."""
    to_volume = len(target.plane) == 3
    flat, volume = (source, target) if to_volume else (target, source)
    place = SliceInVolume.of(flat.plane, flat.index, volume.plane)
    return [place.to_volume(mark) if to_volume else place.to_slice(mark) for mark in marks]


def _question(
    marks: Sequence[Mark], copies: Sequence[Mark | None], source: Part, target: Part
) -> str:
    count, others = len(marks), copies.count(None)
    them, name = "it" if count == 1 else "them", source.slice_name or "the slice"
    if len(target.plane) == 3:
        return (
            f"{_count(count)} {_are(count)} drawn on {name} alone. Carry {them} over to the "
            f"volume, or keep {them} with the slice?"
        )
    rest = f" {_count(others)} on other slices {_stay(others)} with the volume." if others else ""
    return (
        f"{_count(count)} of the volume {_are(count)} drawn on this slice. Carry {them} over to "
        f"the slice, without motion across the slice, or keep {them} with the volume?{rest}"
    )


def _count(number: int) -> str:
    return f"{number} mark" if number == 1 else f"{number} marks"


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def _stay(number: int) -> str:
    return "stays" if number == 1 else "stay"
