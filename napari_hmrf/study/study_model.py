"""What a person edits of the studies in a viewer, and the way back to earlier states of it.

There is one order of steps for all of it, as there is one person who made them. What is edited, a
table or the drawing of a slice, has a name, its slot; what it holds is a value that does not
change, so that what comes back is exactly what was there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from psygnal import Signal

from napari_hmrf.tissue.drawing import Drawing

#: How many steps are kept.
DEPTH = 500


class Step(NamedTuple):
    """What a slot held before a step, or after it, and what was done, in words."""

    slot: Hashable
    value: Any
    word: str


class StudyModel:
    """What every slot holds now, and the steps that lead back and on again.

    Parameters
    ----------
    depth : int
        How many steps are kept; the oldest are forgotten.

    Attributes
    ----------
    changed : Signal(object, object, object)
        Emitted with a slot, its value, and what it held before, whenever that is another.
    moved : Signal()
        Emitted whenever there are other steps to take back or to do again.
    """

    changed = Signal(object, object, object)
    moved = Signal()

    def __init__(self, depth: int = DEPTH) -> None:
        self._now: dict[Hashable, Any] = {}
        self._past: deque[Step] = deque(maxlen=depth)
        self._future: list[Step] = []
        self._begun: Step | None = None

    # What there is

    def get(self, slot: Hashable, default: Any = None) -> Any:
        """What a slot holds now, an edit in progress included."""
        return self._now.get(slot, default)

    @property
    def slots(self) -> tuple[Any, ...]:
        """Those that are known."""
        return tuple(self._now)

    @property
    def in_progress(self) -> Hashable | None:
        """The slot of the edit that was begun and not ended."""
        return None if self._begun is None else self._begun.slot

    @property
    def next_undo(self) -> Step | None:
        """What `undo` would take back: the slot, what it would hold then, and the word."""
        begun = self._begun
        if begun is not None and begun.value != self._now[begun.slot]:
            return begun
        return self._past[-1] if self._past else None

    @property
    def next_redo(self) -> Step | None:
        """What `redo` would do again."""
        return self._future[-1] if self._future else None

    # What can be done

    def open(self, slot: Hashable, value: Any) -> Any:
        """Have a slot hold a value to begin with, unless it is known already; what it holds."""
        return self._now.setdefault(slot, value)

    def amend(self, slot: Hashable, value: Any) -> None:
        """Have a slot hold another value that nobody made, and that is no step: a file was read."""
        if self._begun is not None and self._begun.slot == slot:
            self.end()
        self._show(slot, value)

    def do(self, slot: Hashable, value: Any, word: str) -> None:
        """Make one step; an edit in progress ends before it.

        Parameters
        ----------
        slot : hashable
            What is edited; opened before.
        value : object
            What it holds from now on. If that is the same as before, there is no step.
        word : str
            What was done, in the past tense: "removed an arrow".
        """
        self.end()
        before = self._now[slot]
        if value != before:
            self._keep(Step(slot, before, word))
            self._show(slot, value)

    def begin(self, slot: Hashable, word: str) -> None:
        """Begin an edit that takes a while, as a drag does: however it goes on, it is one step.

        Raises
        ------
        KeyError
            If the slot was not opened.
        """
        self.end()
        self._begun = Step(slot, self._now[slot], word)

    def update(self, value: Any) -> None:
        """Go on with the edit in progress.

        Parameters
        ----------
        value : object
            What the slot holds from now on.

        Raises
        ------
        RuntimeError
            If none was begun.
        """
        if self._begun is None:
            raise RuntimeError("no edit was begun; call begin() first, or do()")
        self._show(self._begun.slot, value)

    def end(self) -> Step | None:
        """End the edit in progress, if there is one.

        Returns
        -------
        Step or None
            What can be undone from now on; None if nothing has changed.
        """
        begun, self._begun = self._begun, None
        if begun is None or begun.value == self._now[begun.slot]:
            return None
        self._keep(begun)
        return begun

    def cancel(self) -> None:
        """Drop the edit in progress: all is as before it, and nothing is to be undone."""
        begun, self._begun = self._begun, None
        if begun is not None:
            self._show(begun.slot, begun.value)

    def undo(self) -> Step | None:
        """Go one step back, ending an edit in progress first.

        Returns
        -------
        Step or None
            What was taken back, with what the slot held until now; None if there was nothing.
        """
        self.end()
        return self._go(self._past, self._future)

    def redo(self) -> Step | None:
        """Go one step on again, ending an edit in progress first.

        Returns
        -------
        Step or None
            What was done again, with what the slot held until now; None if there was nothing.
        """
        self.end()
        return self._go(self._future, self._past)

    def drop(self, unwanted: Callable[[Any], bool]) -> None:
        """Forget slots with all their steps; those of the others stay, in their order."""
        if self._begun is not None and unwanted(self._begun.slot):
            self._begun = None
        before = len(self._past) + len(self._future)
        for steps in (self._past, self._future):
            kept = [step for step in steps if not unwanted(step.slot)]
            steps.clear()
            steps.extend(kept)
        self._now = {slot: value for slot, value in self._now.items() if not unwanted(slot)}
        if len(self._past) + len(self._future) != before:
            self.moved.emit()

    def _keep(self, step: Step) -> None:
        self._past.append(step)
        self._future.clear()
        self.moved.emit()

    def _go(self, source: Any, target: Any) -> Step | None:
        if not source:
            return None
        step: Step = source.pop()
        back = step._replace(value=self._now[step.slot])
        target.append(back)
        self._show(step.slot, step.value)
        self.moved.emit()
        return back

    def _show(self, slot: Hashable, value: Any) -> None:
        before = self._now[slot]
        if value != before:
            self._now[slot] = value
            self.changed.emit(slot, value, before)


class History:
    """A drawing as it is now, among all that is edited in turn.

    Drawings do not change, so that what comes back is exactly what was there.

    Parameters
    ----------
    edits : StudyModel, optional
        The steps of all that is edited; by default the drawing is all.
    slot : hashable
        The drawing's own, among them.
    """

    def __init__(self, edits: StudyModel | None = None, slot: Hashable = "drawing") -> None:
        self.edits = StudyModel() if edits is None else edits
        self.slot = slot
        self.edits.open(slot, Drawing())

    @property
    def drawing(self) -> Drawing:
        """As it is now, an edit in progress included."""
        drawing: Drawing = self.edits.get(self.slot, Drawing())
        return drawing

    @property
    def in_progress(self) -> bool:
        """Whether an edit of this drawing was begun and not ended."""
        return self.edits.in_progress == self.slot

    def do(self, drawing: Drawing, word: str) -> None:
        """Make one step; an edit in progress ends before it.

        Parameters
        ----------
        drawing : Drawing
            As it is from now on. If it is the same as before, there is no step.
        word : str
            What was done, in the past tense: "removed an arrow".
        """
        self.edits.open(self.slot, Drawing())
        self.edits.do(self.slot, drawing, word)

    def begin(self, word: str) -> None:
        """Begin an edit that takes a while, as a drag does: however it goes on, it is one step."""
        self.edits.open(self.slot, Drawing())
        self.edits.begin(self.slot, word)

    def update(self, drawing: Drawing) -> None:
        """Go on with the edit in progress.

        Raises
        ------
        RuntimeError
            If none was begun.
        """
        if not self.in_progress:
            raise RuntimeError("no edit was begun; call begin() first, or do()")
        self.edits.update(drawing)

    def end(self) -> Step | None:
        """End the edit in progress, if there is one; returns what can be undone from now on."""
        return self.edits.end() if self.in_progress else None

    def cancel(self) -> None:
        """Drop the edit in progress: the drawing is as before it, and nothing is to be undone."""
        if self.in_progress:
            self.edits.cancel()
