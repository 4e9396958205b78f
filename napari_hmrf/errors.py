"""Errors that this package raises on purpose.

Each message states the problem, its place and a remedy. Errors are raised before any work begins
that would have to be undone.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: Reason and remedy by error number, for a file that cannot be opened.
_OPENING = {
    errno.ENOENT: "there is no such file or folder. Check its name.",
    errno.EISDIR: "it is a folder. Name a file in it.",
    errno.ENOTDIR: "a part of its path is a file, not a folder. Check its name.",
    errno.EEXIST: "it is a file, not a folder. Name a folder.",
    errno.EACCES: "you have no permission for it. Change its permissions, or use another file.",
    errno.EPERM: "you have no permission for it. Change its permissions, or use another file.",
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
    errno.EISDIR: "it is a folder. Give the name of a file.",
    errno.EACCES: "you have no permission to write there. Choose another folder or name.",
}
#: Prefix of messages of `atomic_write` about the file being written.
CANNOT_SAVE = "cannot save the file: "


class HmrfError(Exception):
    """Base of all errors raised on purpose by napari-hmrf."""


class ProblemError(HmrfError, ValueError):
    """Input images that do not make a solvable problem.

    Parameters
    ----------
    field : str
        The input at fault, such as ``"observed"``, ``"confidence"``, ``"stiffness"``,
        ``"spacing"``, ``"poisson"``, ``"loads"``, ``"growth"``, ``"force"`` or ``"drawing"``; the
        widget replaces it by the name of the layer that the input came from.
    message : str
        The problem and its remedy, without the field's name.
    """

    def __init__(self, field: str, message: str) -> None:
        self.field = field
        self.message = message
        super().__init__(f"{field}: {message}")


class LayerError(ProblemError):
    """An invalid layer; the message is a sentence for the user.

    Parameters
    ----------
    layer : napari.layers.Layer or str
        The layer, or its name.
    message : str
        The problem and its remedy, as the sentence continues after the layer's name.
    """

    def __init__(self, layer: Any, message: str) -> None:
        name = layer if isinstance(layer, str) else str(layer.name)
        super().__init__(name, message)
        self.args = (f"'{name}' {message}",)


class ArgumentError(HmrfError, ValueError, TypeError):
    """An argument of an invalid type or value."""


class BackendError(HmrfError, RuntimeError):
    """A backend that is missing, cannot start, or returned an invalid result."""


class ConvergenceError(HmrfError, ArithmeticError):
    """An iteration that ended without reliable convergence; there is no result."""


class FileFormatError(HmrfError, ValueError):
    """A file, such as a saved solution or a table of materials, that violates its format."""


class Cancelled(HmrfError):
    """Cancellation of a solve; there is no result and nothing was changed."""

    def __init__(self) -> None:
        super().__init__("the solve was cancelled")


@contextmanager
def naming(**layers: Any) -> Iterator[None]:
    """Make errors about an input of the problem name the layer that the input came from.

    Parameters
    ----------
    **layers : napari.layers.Layer or str
        Layer, or its name, by the `field` of `ProblemError`.

    Raises
    ------
    LayerError
        In place of a `ProblemError` whose `field` has a layer.
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


def in_words(error: Exception) -> str:
    """Return the message of an error, with reason and remedy if it is a system error of a file."""
    if not isinstance(error, OSError) or error.filename is None:
        return str(error) or type(error).__name__
    whole = error.strerror or ""
    saving, reason = whole.startswith(CANNOT_SAVE), whole.removeprefix(CANNOT_SAVE)
    sentences = (_SAVING if saving else _OPENING).get(error.errno or 0, f"{reason}.")
    return f"{error.filename}: {CANNOT_SAVE if saving else ''}{sentences}"
