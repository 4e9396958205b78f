"""What cycles that hold rigid bodies do not see: how bodies move, and take tissue along."""

from __future__ import annotations

from typing import Any, Protocol


class Entrained(Protocol):
    """Fields of rigid bodies' motions, which conjugate gradients are deflated by.

    Attributes
    ----------
    close : bool
        Whether bodies are so close together that what lies between is not seen well.
    sure : bool
        Whether single precision tells the motions apart.
    """

    close: bool
    sure: bool

    def settle(self, d: Any, rest: Any) -> float:
        """Move bodies to where `rest` does no work on a field, in place; the energy that takes."""
        ...

    def turn(self, steepest: Any, direction: Any, share: float) -> float:
        """Direction = steepest + share direction, with bodies moved so that none resists.

        They move so far, which is returned, that the forces of `steepest` do no work on any field.
        """
        ...

    def astray(self, rest: Any) -> float:
        """How far, at most, bodies and what they entrain are from where `rest` moves them."""
        ...
