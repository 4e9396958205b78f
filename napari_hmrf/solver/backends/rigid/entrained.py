"""Motions that cycles do not see if they hold rigid bodies: bodies that take tissue along."""

from __future__ import annotations

from typing import Any, Protocol


class Entrained(Protocol):
    """Fields of rigid bodies' motions, which conjugate gradients are deflated by.

    Attributes
    ----------
    close : bool
        Whether bodies are so close together that what lies between is not seen well.
    sure : bool
        True if single precision separates the motions.
    """

    close: bool
    sure: bool

    def settle(self, d: Any, rest: Any) -> float:
        """Move bodies to where `rest` does no work on a field, in place; the energy that takes."""
        ...

    def turn(self, steepest: Any, direction: Any, share: float) -> float:
        """Compute direction = steepest + share direction, with bodies moved so that none resists.

        They move so far, which is returned, that the forces of `steepest` do no work on any field.
        """
        ...

    def astray(self, rest: Any) -> float:
        """Return the largest distance of bodies and entrained tissue from their goal in `rest`."""
        ...
