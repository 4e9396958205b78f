"""Protocol of deflation by the motions of rigid bodies and of the tissue that they drag along."""

from __future__ import annotations

from typing import Any, Protocol


class Deflation(Protocol):
    """Deflation of conjugate gradients by fields of rigid bodies' motions.

    Attributes
    ----------
    close : bool
        True if bodies are so close together that cycles reduce errors between them slowly.
    is_independent : bool
        True if the motions can be separated in single precision.
    """

    close: bool
    is_independent: bool

    def deflate(self, d: Any, rest: Any) -> float:
        """Change `d` and `rest` in place so that `rest` does no work on any field.

        Returns the energy that is released.
        """
        ...

    def turn(self, steepest: Any, direction: Any, share: float) -> float:
        """Compute ``direction = steepest + share * direction``, made conjugate to all fields.

        Multiples of the fields are subtracted from `steepest`. Returns the largest displacement of
        a body in these multiples.
        """
        ...

    def remaining_distance(self, rest: Any) -> float:
        """Return the largest displacement by which the fields would still reduce `rest`."""
        ...
