"""Undo history: values by part, and the steps between their states.

There is one order of steps for all parts, as one user made them. Values are immutable, so undo
restores exactly what was there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from psygnal import Signal

#: Number of steps that are kept.
DEPTH = 500


class Step(NamedTuple):
    """Value of a part before a step (after it, once undone), and the step's name."""

    part: Hashable
    value: Any
    word: str


class EditHistory:
    """Current value of each part, and the steps for undo and redo.

    Parameters
    ----------
    depth : int
        Number of steps that are kept; older ones are dropped.

    Attributes
    ----------
    changed : Signal(object, object, object)
        Emitted with a part, its value and its earlier value, whenever it changes.
    steps_changed : Signal()
        Emitted whenever there are other steps to undo or redo.
    """

    changed = Signal(object, object, object)
    steps_changed = Signal()

    def __init__(self, depth: int = DEPTH) -> None:
        self._now: dict[Hashable, Any] = {}
        self._past: deque[Step] = deque(maxlen=depth)
        self._future: list[Step] = []
        self._begun: Step | None = None

    # State

    def get(self, part: Hashable, default: Any = None) -> Any:
        """Return the value of a part, including an edit in progress."""
        return self._now.get(part, default)

    @property
    def parts(self) -> tuple[Any, ...]:
        """All known parts."""
        return tuple(self._now)

    @property
    def in_progress(self) -> Hashable | None:
        """Part whose edit has begun and not ended, or None."""
        return None if self._begun is None else self._begun.part

    @property
    def next_undo(self) -> Step | None:
        """Step that `undo` would undo, with the value that it would restore, or None."""
        begun = self._begun
        if begun is not None and begun.value != self._now[begun.part]:
            return begun
        return self._past[-1] if self._past else None

    @property
    def next_redo(self) -> Step | None:
        """Step that `redo` would redo, or None."""
        return self._future[-1] if self._future else None

    # Edits

    def setdefault(self, part: Hashable, value: Any) -> Any:
        """Set the first value of a part, unless it has one; return its value."""
        return self._now.setdefault(part, value)

    def amend(self, part: Hashable, value: Any) -> None:
        """Set a value without a step: the user did not edit it, as when a file is opened."""
        if self._begun is not None and self._begun.part == part:
            self.end()
        self._show(part, value)

    def do(self, part: Hashable, value: Any, word: str) -> None:
        """Set a value as one step; an edit in progress ends before it.

        Parameters
        ----------
        part : hashable
            A known part.
        value : object
            Its new value; no step is made if it equals the current one.
        word : str
            Name of the step, in the past tense: "removed an arrow".
        """
        self.end()
        before = self._now[part]
        if value != before:
            self._keep(Step(part, before, word))
            self._show(part, value)

    def begin(self, part: Hashable, word: str) -> None:
        """Begin an edit with several values, such as a drag, that will be one step.

        Raises
        ------
        KeyError
            If the part is not known.
        """
        self.end()
        self._begun = Step(part, self._now[part], word)

    def update(self, value: Any) -> None:
        """Set the value of the edit in progress.

        Raises
        ------
        RuntimeError
            If no edit is in progress.
        """
        if self._begun is None:
            raise RuntimeError("no edit was begun; call begin() first, or do()")
        self._show(self._begun.part, value)

    def end(self) -> Step | None:
        """End the edit in progress, if there is one.

        Returns
        -------
        Step or None
            The step that can be undone now; None if nothing has changed.
        """
        begun, self._begun = self._begun, None
        if begun is None or begun.value == self._now[begun.part]:
            return None
        self._keep(begun)
        return begun

    def cancel(self) -> None:
        """Cancel the edit in progress: restore the value before it, without a step."""
        begun, self._begun = self._begun, None
        if begun is not None:
            self._show(begun.part, begun.value)

    def undo(self) -> Step | None:
        """Undo one step, after ending an edit in progress.

        Returns
        -------
        Step or None
            The undone step, with the value that it had set; None if there was none.
        """
        self.end()
        return self._go(self._past, self._future)

    def redo(self) -> Step | None:
        """Redo one step, after ending an edit in progress.

        Returns
        -------
        Step or None
            The redone step, with the value before it; None if there was none.
        """
        self.end()
        return self._go(self._future, self._past)

    def drop(self, unwanted: Callable[[Any], bool]) -> None:
        """Drop parts with all their steps; the steps of others stay, in their order."""
        if self._begun is not None and unwanted(self._begun.part):
            self._begun = None
        before = len(self._past) + len(self._future)
        for steps in (self._past, self._future):
            kept = [step for step in steps if not unwanted(step.part)]
            steps.clear()
            steps.extend(kept)
        self._now = {part: value for part, value in self._now.items() if not unwanted(part)}
        if len(self._past) + len(self._future) != before:
            self.steps_changed.emit()

    def _keep(self, step: Step) -> None:
        self._past.append(step)
        self._future.clear()
        self.steps_changed.emit()

    def _go(self, source: Any, target: Any) -> Step | None:
        if not source:
            return None
        step: Step = source.pop()
        back = step._replace(value=self._now[step.part])
        target.append(back)
        self._show(step.part, step.value)
        self.steps_changed.emit()
        return back

    def _show(self, part: Hashable, value: Any) -> None:
        before = self._now[part]
        if value != before:
            self._now[part] = value
            self.changed.emit(part, value, before)
