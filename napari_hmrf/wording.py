"""Names of settings in messages, adapted to Python, the shell and the window.

A message describes the problem in terms that are valid in every interface. The Python name of the
setting to change follows in parentheses and backticks: ``hold its edge (`hold_edge=True`)``. In
Python, the message is shown unchanged. In the shell and in the window, the Python name is replaced
with the name of the setting in that interface.
"""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Interface = Literal["shell", "window"]


class Term(NamedTuple):
    """Names of a setting in the shell and in the window.

    Attributes
    ----------
    shell, window : str
        Name in the interface; "" omits the name from messages.
    """

    shell: str
    window: str


#: Names of the settings in the shell and the window, by Python name.
TERMS: dict[str, Term] = {
    "hold_edge=True": Term("--hold-edge", ""),
    "hold_edge=False": Term("without --hold-edge", "'Fix outer edge' off"),
    "model='elastic'": Term("--model elastic", ""),
    "drift=False": Term("", "'affine drift' off"),
    "measured=None": Term("", "'Unregister'"),
    "weight=...": Term("--weight", "'gravity'"),
    "weight=..., cavity=...": Term("--weight, --cavity", "'gravity', 'cavity'"),
    "slides=False": Term("--materials without slides", "the column 'slides' of the table"),
    "sd=0": Term("a file without this column", ""),
    "penalty=None": Term(
        "without --penalty", "'spring strength' under 'Advanced' at 'by confidence'"
    ),
    "action='move'": Term("the action move in --rules", "'moves by'"),
    "Motion(drawing=..., labels=..., observed=..., weight=...)": Term(
        "--boundary with landmarks, a field, or labels with --rules that move or expand; --weight; "
        "--materials with growth",
        "",
    ),
    "budget": Term("--budget", "press 'Continue'"),
    'backend="cpu"': Term("--backend cpu", "the device 'CPU'"),
    'backend="opengl:compute"': Term("--backend opengl:compute", "the device 'OpenGL, compute'"),
    'backend="opengl:fragment"': Term("--backend opengl:fragment", "the device 'OpenGL, fragment'"),
    "overwrite=True": Term("--force", ""),
    "forward=True": Term("--forward", ""),
    "number": Term("--slice", ""),
    "pictures=Pictures(image)": Term("a study saved with its image", "'image'"),
    "RIGID": Term("the word rigid in --materials", "'rigid'"),
    "least_jacobian": Term("", ""),
    "amplitude, patches": Term("--amplitude, --patches", ""),
    "resume=True": Term("--resume", "resume"),
    "without_border=True": Term(
        "a label of stiffness 0 in --labels and --materials",
        "leave them unpainted and tick 'Ignore dark background'",
    ),
}
_SETTING = re.compile(r" \(`([^`]+)`\)")


def in_words_of(interface: Interface, message: str) -> str:
    """Replace the Python names of settings in a message with the names in another interface.

    Parameters
    ----------
    interface : {"shell", "window"}
    message : str
        Message with the Python names of settings.

    Returns
    -------
    str
        Message with the names of settings in the interface.
    """

    def words(match: re.Match[str]) -> str:
        term = TERMS.get(match[1])
        if term is None:
            return match[0]
        name: str = getattr(term, interface)
        return name and f" ({name})"

    return _SETTING.sub(words, message)
