"""Words of the interface that a message appears in.

A message states what is wrong in words that every interface shares, and names the setting to
change as Python has it, in parentheses and backticks: ``hold its edge (`hold_edge=True`)``. Python
shows it so. The shell and the window replace the setting by their own words for it as they show the
message.
"""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Interface = Literal["shell", "window"]


class Term(NamedTuple):
    """Words for one setting; "" where the message needs none.

    Attributes
    ----------
    shell, window : str
    """

    shell: str
    window: str


#: By the setting in Python.
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
        "leave them unpainted and tick 'the dark border is no tissue'",
    ),
}
_SETTING = re.compile(r" \(`([^`]+)`\)")


def in_words_of(interface: Interface, message: str) -> str:
    """Return a message in the words of an interface.

    Parameters
    ----------
    interface : {"shell", "window"}
    message : str
        With settings as Python has them.
    """

    def words(found: re.Match[str]) -> str:
        term = TERMS.get(found[1])
        if term is None:
            return found[0]
        said: str = getattr(term, interface)
        return said and f" ({said})"

    return _SETTING.sub(words, message)
