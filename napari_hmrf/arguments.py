"""What a caller gave, where one value of some kind is needed."""

from __future__ import annotations

import difflib
import math
import os
import reprlib
from collections.abc import Iterable, Mapping, Sized
from numbers import Real
from typing import Any

from napari_hmrf.errors import ArgumentError

_LONGEST = 80


def shown(value: object) -> str:
    """A value as it stands in a sentence: in one line, and short."""
    line = " ".join(reprlib.repr(value).split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def real(value: Any) -> float:
    """A real number as a float; NaN for anything else, and where no float is so large."""
    if not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def reals(values: Any, count: int) -> tuple[float, ...]:
    """So many real numbers as floats; NaN in the place of all if they are not that."""
    given = tuple(values) if isinstance(values, Iterable) and isinstance(values, Sized) else ()
    return tuple(map(real, given)) if len(given) == count else (math.nan,) * count


def is_whole(value: object) -> bool:
    """Whether it is a whole number, of whatever type of numbers."""
    return real(value).is_integer()


def is_one_of(value: object, choices: Iterable[str]) -> bool:
    """Whether it is one of some words."""
    return isinstance(value, str) and value in choices


def refuse_unless(right: bool, name: str, value: object, what: str) -> None:
    """Refuse an argument that is not what it has to be.

    Raises
    ------
    ArgumentError
        Of one sentence.
    """
    if not right:
        raise ArgumentError(f"{name} must be {what}, not {shown(value)}")


def checked_path(path: Any) -> str:
    """The name of a file, or say that it is none."""
    refuse_unless(isinstance(path, str | os.PathLike), "path", path, "the name of a file")
    return str(os.fsdecode(path))


def nearest_word(
    word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None
) -> str | None:
    """Return the known word that a misspelt or foreign word most likely stands for.

    Parameters
    ----------
    word : str
    known : iterable of str
    synonyms : mapping of str to str, optional
        Known words by other words for the same.

    Returns
    -------
    str or None
        None if no known word is near.
    """
    words = [*known]
    plain = " ".join(word.casefold().replace("_", " ").replace("-", " ").split())
    meant = (synonyms or {}).get(plain)
    if meant in words:
        return meant
    found = difflib.get_close_matches(word.casefold(), words, n=1, cutoff=0.6)
    return found[0] if found else None


def did_you_mean(word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None) -> str:
    """Return a question that offers the nearest known word, with a space in front, or ""."""
    near = nearest_word(word, known, synonyms)
    return f" Did you mean {near!r}?" if near else ""
