"""Every error this package raises on purpose.

Each says what is wrong, where, and what to do about it; none is raised after work has begun that
would have to be undone.
"""

from __future__ import annotations


class HmrfError(Exception):
    """Base of all errors raised on purpose by napari-hmrf."""


class ProblemError(HmrfError, ValueError):
    """The input images do not make a solvable problem.

    Parameters
    ----------
    field : str
        The input at fault: ``"observed"``, ``"confidence"``, ``"stiffness"``, ``"spacing"``,
        ``"poisson"``, ``"loads"``, ``"growth"`` or ``"force"``; the widget replaces it by the name
        of the layer the input came from.
    message : str
        What is wrong and what to do, without the field's name.
    """

    def __init__(self, field: str, message: str) -> None:
        self.field = field
        self.message = message
        super().__init__(f"{field}: {message}")


class ArgumentError(HmrfError, ValueError, TypeError):
    """An argument is of a kind, or has a value, that it cannot have."""


class BackendError(HmrfError, RuntimeError):
    """A backend is missing, cannot start, or gave a result that must not be trusted."""


class ConvergenceError(HmrfError, ArithmeticError):
    """An iteration ended without a field that could be trusted; no result exists."""


class FileFormatError(HmrfError, ValueError):
    """A file is not what it should be: a saved solution, or a table of materials."""


class Cancelled(HmrfError):
    """The solve was cancelled; no result exists and nothing was changed."""

    def __init__(self) -> None:
        super().__init__("the solve was cancelled")
