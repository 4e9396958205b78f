"""Translation of setting names in messages for Python, the shell and the window.

A message describes the problem in words that suit every interface, followed by the Python name of
the setting to change, in parentheses and backticks: ``hold its edge (`hold_edge=True`)``. Python
shows the message unchanged. The shell and the window replace the name of the setting by their own.
"""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Interface = Literal["shell", "window"]


class Term(NamedTuple):
    """Name of one setting in the shell and the window; "" if the name is to be left out.

    Attributes
    ----------
    shell, window : str
    """

    shell: str
    window: str


#: Names of the settings in the shell and the window, by the name in Python.
TERMS: dict[str, Term] = {
    "hold_edge=True": Term("--hold-edge", ""),
    "model='elastic'": Term("--model elastic", ""),
    "penalty=None": Term(
        "without --penalty", "'holding force' under 'Advanced' at 'by confidence'"
    ),
    "action='move'": Term("the action move in --rules", "'moves by'"),
    "Motion(drawing=..., labels=..., observed=..., weight=...)": Term(
        "--boundary with landmarks, a field, or labels with --rules that move or expand; --weight; "
        "--materials with growth",
        "",
    ),
    "overwrite=True": Term("--force", ""),
    "forward=True": Term("--forward", ""),
    "number": Term("--slice", ""),
    "pictures=Pictures(image)": Term("a study saved with its image", "'image'"),
    "RIGID": Term("the word rigid in --materials", "'rigid'"),
    "least_jacobian": Term("", ""),
    "amplitude, patches; or a larger smoothness": Term("--amplitude, --patches", ""),
    "resume=True": Term("--resume", "resume"),
    "without_border=True": Term(
        "a label of stiffness 0 in --labels and --materials",
        "leave them unpainted and tick 'Ignore dark background'",
    ),
}
_SETTING = re.compile(r" \(`([^`]+)`\)")


def in_words_of(interface: Interface, message: str) -> str:
    """Return a message with the names of settings in an interface.

    Parameters
    ----------
    interface : {"shell", "window"}
    message : str
        Message with the Python names of settings.
    """

    def words(match: re.Match[str]) -> str:
        term = TERMS.get(match[1])
        if term is None:
            return match[0]
        name: str = getattr(term, interface)
        return name and f" ({name})"

    return _SETTING.sub(words, message)
