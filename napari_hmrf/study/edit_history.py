"""Undo history: current values of the parts of a study, and the steps between values.

All parts share one sequence of steps, in the order of the user's edits. Values are immutable, so
undo restores them exactly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

from psygnal import Signal

#: Largest number of steps in the history.
DEPTH = 500


class Step(NamedTuple):
    """Step of the history.

    Attributes
    ----------
    values : dict of hashable to object
        Value of each changed part that undo, in reverse order, or redo would set.
    word : str
        Name of the step.
    """

    values: dict[Hashable, Any]
    word: str

    @property
    def part(self) -> Any:
        """First changed part."""
        return next(iter(self.values))

    @property
    def value(self) -> Any:
        """Value of the first changed part."""
        return self.values[self.part]


class EditHistory:
    """Current value of each part, and the steps for undo and redo.

    Parameters
    ----------
    depth : int
        Largest number of steps; when it is exceeded, the oldest steps are dropped.

    Attributes
    ----------
    changed : Signal(object, object, object)
        Emitted with the part, the new value and the old value when a value changes.
    edited : Signal(object, object)
        Emitted after `changed` with the part and the old value, except for `amend`.
    steps_changed : Signal()
        Emitted when the steps available for undo or redo change.
    """

    changed = Signal(object, object, object)
    edited = Signal(object, object)
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
        """Parts that have a value."""
        return tuple(self._now)

    @property
    def in_progress(self) -> Hashable | None:
        """Part with an edit in progress, or None."""
        return None if self._begun is None else self._begun.part

    @property
    def next_undo(self) -> Step | None:
        """Step that `undo` would undo, with the value that `undo` would restore, or None."""
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
        """Set the value of a part if it has none, and return the value of the part."""
        return self._now.setdefault(part, value)

    def amend(self, part: Hashable, value: Any) -> None:
        """Set a value without a step, for a change that is not an edit, such as opening a file.

        If the value differs, this ends an edit of the part that is in progress.
        """
        is_begun = self._begun is not None and self._begun.part == part
        if is_begun and value != self._now[part]:
            self.end()
        self._show(part, value, is_edit=False)

    def do(self, part: Hashable, value: Any, word: str) -> None:
        """End any edit in progress, then set a value as one step.

        Parameters
        ----------
        part : hashable
            Part, which must have a value.
        value : object
            New value. If it equals the current value, no step is added.
        word : str
            Name of the step, in the past tense: "removed an arrow".
        """
        self.do_all({part: value}, word)

    def do_all(self, values: Mapping[Any, Any], word: str) -> None:
        """End any edit in progress, then set the values of several parts as one step.

        Parameters
        ----------
        values : mapping of hashable to object
            New value of each part; each part must have a value.
        word : str
            Name of the step, in the past tense.
        """
        self.end()
        before = {part: self._now[part] for part in values if values[part] != self._now[part]}
        if before:
            self._keep(Step(before, word))
            for part in before:
                self._show(part, values[part])

    def join(self, part: Hashable, value: Any) -> None:
        """Set a value as part of the edit in progress, or of the last step.

        Parameters
        ----------
        part : hashable
            Part, which must have a value.
        value : object
            New value, which follows from the edit: undo restores the previous value with it.
        """
        step = self._begun or (self._past[-1] if self._past else None)
        if step is not None:
            step.values.setdefault(part, self._now[part])
        self._show(part, value)

    def begin(self, part: Hashable, word: str) -> None:
        """Begin an edit with several updates, such as a drag, that is undone as one step.

        Raises
        ------
        KeyError
            If the part has no value.
        """
        self.end()
        self._begun = Step({part: self._now[part]}, word)

    def update(self, value: Any) -> None:
        """Set the value of the edit in progress.

        Raises
        ------
        RuntimeError
            If no edit is in progress.
        """
        if self._begun is None:
            raise RuntimeError("no edit is in progress; call begin() first, or use do()")
        self._show(self._begun.part, value)

    def end(self, word: str = "") -> Step | None:
        """End the edit in progress, if any.

        Parameters
        ----------
        word : str
            Name of the step; by default, the name that the edit began with.

        Returns
        -------
        Step or None
            The new step; None if there is no edit or its value has not changed.
        """
        begun = self._begun
        if begun is None or begun.value == self._now[begun.part]:
            self.cancel()
            return None
        self._begun = None
        step = begun._replace(word=word or begun.word)
        self._keep(step)
        return step

    def cancel(self) -> None:
        """Cancel the edit in progress and restore the previous value, without adding a step."""
        begun, self._begun = self._begun, None
        for part, value in {} if begun is None else begun.values.items():
            self._show(part, value)

    def undo(self) -> Step | None:
        """End any edit in progress, then undo one step.

        Returns
        -------
        Step or None
            The undone step, with the value that `redo` would set; None if there is no step.
        """
        self.end()
        return self._go(self._past, self._future, reversed)

    def redo(self) -> Step | None:
        """End any edit in progress, then redo one step.

        Returns
        -------
        Step or None
            The redone step, with the value that `undo` would set; None if there is no step.
        """
        self.end()
        return self._go(self._future, self._past, iter)

    def drop(self, unwanted: Callable[[Any], bool]) -> None:
        """Drop all parts for which `unwanted` returns True, and all steps of these parts."""
        if self._begun is not None and unwanted(self._begun.part):
            self._begun = None
        before = len(self._past) + len(self._future)
        for steps in (self._past, self._future):
            kept = [_without(step, unwanted) for step in steps]
            steps.clear()
            steps.extend(step for step in kept if step.values)
        self._now = {part: value for part, value in self._now.items() if not unwanted(part)}
        if len(self._past) + len(self._future) != before:
            self.steps_changed.emit()

    def _keep(self, step: Step) -> None:
        self._past.append(step)
        self._future.clear()
        self.steps_changed.emit()

    def _go(self, source: Any, target: Any, order: Callable[[Any], Any]) -> Step | None:
        """Move the last step of the source, and set its parts in the given order."""
        if not source:
            return None
        step: Step = source.pop()
        back = step._replace(values={part: self._now[part] for part in step.values})
        target.append(back)
        for part in order(step.values):
            self._show(part, step.values[part])
        self.steps_changed.emit()
        return back

    def _show(self, part: Hashable, value: Any, is_edit: bool = True) -> None:
        before = self._now[part]
        if value != before:
            self._now[part] = value
            self.changed.emit(part, value, before)
            if is_edit:
                self.edited.emit(part, before)


def _without(step: Step, unwanted: Callable[[Any], bool]) -> Step:
    left = {part: value for part, value in step.values.items() if not unwanted(part)}
    return step._replace(values=left)
