"""The sentence at the bottom of the dock, and which may take the place of which."""

from __future__ import annotations

from collections.abc import Callable


class StatusLine:
    """Says what was done last, or can be done next; while work goes on, what goes on.

    Parameters
    ----------
    show : callable
        Shows a sentence.
    invitation : callable
        What can be done next.
    away : callable
        Whether the dock is closed, or gone: then nothing is said.
    """

    def __init__(
        self,
        show: Callable[[str], None],
        invitation: Callable[[], str],
        away: Callable[[], bool],
    ) -> None:
        self._show, self._invitation, self._away = show, invitation, away
        self._said = self._doing = self._step = ""

    @property
    def shown(self) -> str:
        """What is read there."""
        return self._doing or self._said

    @property
    def said(self) -> str:
        """What was said last, and will be read when nothing goes on."""
        return self._said

    def say(self, sentence: str) -> None:
        """Say something in place of all that was said."""
        if not self._away():
            self._said = sentence
            self._show(self.shown)

    def say_doing(self, sentence: str) -> None:
        """Say what goes on, until it is over; then ""."""
        self._doing = sentence
        if not self._away():
            self._show(self.shown)

    def say_step(self, sentence: str) -> None:
        """Say what was taken back; it stays to be read until something new is begun."""
        self._step = sentence
        self.say(sentence)

    def begin(self, *_: object) -> None:
        """Something new is begun: what was taken back before has been read."""
        self._step = ""

    def say_beside(self, sentence: str) -> None:
        """Say something beside what was taken back, or in place of all else."""
        self.say(f"{self._step} {sentence}" if self._reads_step else sentence)

    def invite(self) -> None:
        """Say what can be done next, unless it is still to be read what was taken back."""
        if not self._reads_step:
            self.say(self._invitation())

    @property
    def _reads_step(self) -> bool:
        return bool(self._step) and self._said == self._step
