"""Exceptions of this package.

Each message states the problem, its location and a remedy. Input is checked before any work that
would have to be undone.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: Reason and remedy by error number, for a file that cannot be opened.
_OPENING = {
    errno.ENOENT: "there is no such file or folder. Check its name.",
    errno.EISDIR: "it is a folder. Choose a file in it.",
    errno.ENOTDIR: "a part of its path is a file, not a folder. Check its name.",
    errno.EEXIST: "it is a file, not a folder. Choose a folder.",
    errno.EACCES: "permission is denied. Change its permissions, or use another file.",
    errno.EPERM: "permission is denied. Change its permissions, or use another file.",
    errno.EROFS: "its disk is read-only. Use a folder on another disk.",
    errno.ENOSPC: "the disk is full. Free some space, or use another disk.",
    errno.EDQUOT: "your quota on the disk is full. Free some space, or use another disk.",
    errno.EFBIG: "the file is larger than the system allows. Use another disk, or raise the limit.",
    errno.ENAMETOOLONG: "its name is too long. Use a shorter name.",
}
#: Reason and remedy by error number, for a file that cannot be saved.
_SAVING = {
    **_OPENING,
    errno.ENOENT: "its folder does not exist. Create the folder first, or choose another.",
    errno.EISDIR: "it is a folder. Choose a file name.",
    errno.EACCES: "you do not have permission to write there. Choose another folder or name.",
}
#: Prefix that `atomic_write` adds to messages about the file to be written.
CANNOT_SAVE = "cannot save the file: "


class HmrfError(Exception):
    """Base class of the exceptions of this package."""


class ProblemError(HmrfError, ValueError):
    """Input that does not define a solvable problem.

    Parameters
    ----------
    field : str
        Name of the invalid input, such as ``"observed"``, ``"confidence"``, ``"stiffness"``,
        ``"spacing"``, ``"poisson"``, ``"loads"``, ``"growth"``, ``"force"`` or ``"drawing"``. The
        widget replaces it with the name of the layer that provides the input.
    message : str
        Description of the problem and its remedy, without the name of the input.
    """

    def __init__(self, field: str, message: str) -> None:
        self.field = field
        self.message = message
        super().__init__(f"{field}: {message}")


class LayerError(ProblemError):
    """Invalid layer, or invalid part of a study, with a message for the user.

    `ProblemError.field` is the name of the layer; for a study, the name of the part in
    `Study.names`, such as a file, or the part itself, such as "tissue".

    Parameters
    ----------
    layer : napari.layers.Layer or str
        Layer, or the name of the layer or part.
    message : str
        Description of the problem and its remedy; the name is the subject of the sentence.
    """

    def __init__(self, layer: Any, message: str) -> None:
        name = layer if isinstance(layer, str) else str(layer.name)
        super().__init__(name, message)
        self.args = (f"'{name}' {message}",)


class ArgumentError(HmrfError, ValueError, TypeError):
    """Argument with an invalid type or value."""


class BackendError(HmrfError, RuntimeError):
    """Backend that is not available, fails to start, or returns an invalid result."""


class ConvergenceError(HmrfError, ArithmeticError):
    """Error for an iteration that ended without reliable convergence, so without a result."""


class FileFormatError(HmrfError, ValueError):
    """Error for a file that violates its format, such as a saved solution or a material table."""


class NoteWarning(UserWarning):
    """Note on a solution: an assumption, an input without effect, or a shortcoming.

    `Solution.notes` contains the same notes. Python shows each warning once for each line of a
    script; ``warnings.simplefilter("ignore", NoteWarning)`` hides them.
    """


class Cancelled(HmrfError):
    """Cancellation of a solve; a cancelled solve has no result and no side effects."""

    def __init__(self) -> None:
        super().__init__("the solve was cancelled")


@contextmanager
def naming(**layers: Any) -> Iterator[None]:
    """Return a context manager that converts a `ProblemError` to a `LayerError`.

    Parameters
    ----------
    **layers : napari.layers.Layer or str
        Layer, or its name, for each `ProblemError.field` to convert.

    Raises
    ------
    LayerError
        If a `ProblemError` is raised in the context, and `layers` has a layer for its `field`.
    """
    try:
        yield
    except LayerError:
        raise
    except ProblemError as error:
        layer = layers.get(error.field)
        if layer is None:
            raise
        raise LayerError(layer, error.message) from error


def is_expected(error: Exception) -> bool:
    """Return whether an error is due to the input, rather than to a fault of the program."""
    return isinstance(error, HmrfError | ValueError)


def in_words(error: Exception) -> str:
    """Return the message of an error, with a remedy if it is a system error about a file."""
    if not isinstance(error, OSError) or error.filename is None:
        return str(error) or type(error).__name__
    whole = error.strerror or ""
    saving, reason = whole.startswith(CANNOT_SAVE), whole.removeprefix(CANNOT_SAVE)
    sentences = (_SAVING if saving else _OPENING).get(error.errno or 0, f"{reason}.")
    return f"{error.filename}: {CANNOT_SAVE if saving else ''}{sentences}"
