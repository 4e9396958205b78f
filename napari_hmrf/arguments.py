"""Checks of single argument values."""

from __future__ import annotations

import difflib
import math
import os
import reprlib
from collections.abc import Iterable, Mapping, Sequence, Set, Sized
from numbers import Real
from types import UnionType
from typing import Any, get_args

from napari_hmrf.errors import ArgumentError

_LONGEST = 80


def shown(value: object) -> str:
    """Format a value for use in a sentence: short, on one line."""
    line = " ".join(reprlib.repr(value).split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def real(value: Any) -> float:
    """Convert a real number to float; return NaN for any other value or a too large number."""
    if not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def reals(values: Any, count: int) -> tuple[float, ...]:
    """Convert `count` real numbers to floats; return `count` NaNs for another number of values.

    Sets and mappings also give NaNs, because they do not keep the order of the axes.
    """
    is_sized = isinstance(values, Iterable) and isinstance(values, Sized)
    given = tuple(values) if is_sized and not isinstance(values, Set | Mapping) else ()
    return tuple(map(real, given)) if len(given) == count else (math.nan,) * count


def is_whole(value: object) -> bool:
    """Return whether a value of any type is a whole number."""
    return real(value).is_integer()


def is_one_of(value: object, choices: Iterable[str]) -> bool:
    """Return whether a value is one of the given words."""
    return isinstance(value, str) and value in choices


def refuse_unless(right: bool, name: str, value: object, requirement: str) -> None:
    """Refuse an argument that does not meet its requirement.

    Parameters
    ----------
    right : bool
        True if the argument meets the requirement.
    name : str
        Name of the argument.
    value : object
        Value of the argument, which the message quotes.
    requirement : str
        Requirement, as the sentence continues after "must be".

    Raises
    ------
    ArgumentError
        If `right` is False; the message is one sentence.
    """
    if not right:
        raise ArgumentError(f"{name} must be {requirement}, not {shown(value)}")


def require_flag(name: str, value: object) -> None:
    """Refuse an argument that is not True or False.

    Raises
    ------
    ArgumentError
        If the value is of another type; the message is one sentence.
    """
    # NumPy's booleans are recognised by name, so that this module does not import NumPy.
    is_flag = isinstance(value, bool) or type(value).__name__ in ("bool_", "bool")
    refuse_unless(is_flag, name, value, "True or False")


def require_kind(kind: type | UnionType, name: str, value: object, example: str) -> None:
    """Refuse an argument of another type.

    Parameters
    ----------
    kind : type or union of types
    name : str
        Name of the argument.
    value : object
    example : str
        A valid argument in Python syntax, or a remedy.

    Raises
    ------
    ArgumentError
        If the value is of another type; the message is one sentence.
    """
    words = _kinds(kind)
    article = "an" if words[0] in "AEIOU" else "a"
    refuse_unless(isinstance(value, kind), name, value, f"{article} {words}, such as {example}")


def tuple_of(kind: type | UnionType, name: str, values: Any, example: str) -> tuple[Any, ...]:
    """Return a tuple or list as a tuple, or refuse one with an item of another type.

    Parameters
    ----------
    kind, name, example
        As for `require_kind`.
    values : object
        Value of the argument.

    Raises
    ------
    ArgumentError
        If the value is not such a tuple or list; the message is one sentence.
    """
    right = isinstance(values, Sequence) and all(isinstance(value, kind) for value in values)
    refuse_unless(right, name, values, f"a tuple of {_kinds(kind)}, such as {example}")
    return tuple(values)


def _kinds(kind: type | UnionType) -> str:
    """List types in words: "Arrow, Landmark or Stroke"."""
    *others, last = (each.__name__ for each in get_args(kind) or (kind,))
    return f"{', '.join(others)} or {last}" if others else last


def checked_path(path: Any) -> str:
    """Return a file name as str, or refuse anything that is not a path."""
    refuse_unless(isinstance(path, str | os.PathLike), "path", path, "the name of a file")
    return str(os.fsdecode(path))


def nearest_word(
    word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None
) -> str | None:
    """Return the known word that a misspelt word or a synonym most likely stands for.

    Parameters
    ----------
    word : str
    known : iterable of str
    synonyms : mapping of str to str, optional
        Maps each synonym to the known word.

    Returns
    -------
    str or None
        None if no known word is close enough.
    """
    words = [*known]
    plain = " ".join(word.casefold().replace("_", " ").replace("-", " ").split())
    synonym = (synonyms or {}).get(plain)
    if synonym in words:
        return synonym
    matches = difflib.get_close_matches(word.casefold(), words, n=1, cutoff=0.6)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None) -> str:
    """Return a question that offers the nearest known word, with a space in front, or ""."""
    near = nearest_word(word, known, synonyms)
    return f" Did you mean {near!r}?" if near else ""
