"""Notes: clauses for the user about a study or a result."""

from __future__ import annotations

import re


class Note(str):
    """Clause for the user, with its kind and a short form of it.

    A note is used as text. Code that looks for certain notes compares kinds, never sentences.

    Parameters
    ----------
    text : str
        Clause without a capital letter and without a full stop.
    short : str
        The same in a few words, for a small label; by default, the clause up to its first comma,
        colon or semicolon.
    kind : str
        What the note is about; "" if no code looks for it.
    """

    short: str
    kind: str

    def __new__(cls, text: str, short: str = "", kind: str = "") -> Note:
        """Return the note."""
        made = super().__new__(cls, text)
        # A comma in a position, such as (3, 4), ends nothing.
        made.short = short or re.split(r"[:;,](?![^(]*\))", text)[0]
        made.kind = kind
        return made


def kind_of(note: str) -> str:
    """Return the kind of a note; "" for plain text, such as a note that was read from a file."""
    return note.kind if isinstance(note, Note) else ""


def short_of(note: str) -> str:
    """Return the short form of a note."""
    return (note if isinstance(note, Note) else Note(note)).short
