"""Names of settings in messages, adapted to the shell and the window.

A message describes the problem in terms that are valid in every interface. The Python name of the
setting to change follows in parentheses and backticks: ``hold its edge (`hold_edge=True`)``. In
Python, the message is shown unchanged. In the shell and in the window, the Python name is replaced
with the name of the setting in that interface, or left out if the interface lacks the setting.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection

_SETTING = re.compile(r" \(`([^`]+)`\)")
#: Options of the shell with another name than in Python.
_OTHER_NAMES = {"overwrite": "force", "number": "slice"}


def reworded(message: str, name_of: Callable[[str], str]) -> str:
    """Replace each Python setting of a message with its name, or leave it out if that is ""."""

    def replaced(match: re.Match[str]) -> str:
        name = name_of(match[1])
        return f" ({name})" if name else ""

    return _SETTING.sub(replaced, message)


def in_shell_words(message: str, options: Collection[str]) -> str:
    """Replace the Python settings of a message with options of the shell.

    Parameters
    ----------
    message : str
    options : collection of str
        Options that the message may name, by the Python name of their field.
    """

    def name_of(settings: str) -> str:
        names = [_option(each, options) for each in settings.split(", ")]
        return ", ".join(names) if all(names) else ""

    return reworded(message, name_of)


def _option(setting: str, options: Collection[str]) -> str:
    """Return the option for a setting such as "hold_edge=False", or "" if there is none."""
    name, _, value = setting.partition("=")
    name, value = _OTHER_NAMES.get(name, name), value.strip("'\"")
    if name not in options:
        return ""
    option = f"--{name.replace('_', '-')}"
    if value in ("None", "False"):
        return f"without {option}"
    return option if value in ("", "True", "...") else f"{option} {value}"
