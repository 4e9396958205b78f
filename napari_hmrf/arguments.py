"""Validation of argument values."""

from __future__ import annotations

import difflib
import math
import os
import reprlib
from collections.abc import Iterable, Mapping, Sequence, Set, Sized
from numbers import Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args

from napari_hmrf.errors import ArgumentError

#: Largest number of characters of a value quoted in an error message.
_LONGEST = 80


def shown(value: object) -> str:
    """Format a value for an error message, on one line of limited length."""
    line = " ".join(reprlib.repr(value).split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 3]}..."


def real(value: Any) -> float:
    """Convert a real number to float.

    The result is NaN if the value is not a real number, or is too large for a float.
    """
    if not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def reals(values: Any, count: int) -> tuple[float, ...]:
    """Convert a sequence of `count` real numbers to a tuple of floats.

    The result contains only NaN if `values` has a different length. Sets and mappings also give
    NaN, because the order of their items does not match the order of the axes.
    """
    is_sized = isinstance(values, Iterable) and isinstance(values, Sized)
    given = tuple(values) if is_sized and not isinstance(values, Set | Mapping) else ()
    return tuple(map(real, given)) if len(given) == count else (math.nan,) * count


def is_whole(value: object) -> bool:
    """Return whether a value of any type is a whole number."""
    return real(value).is_integer()


def is_one_of(value: object, choices: Iterable[str]) -> bool:
    """Return whether a value is one of the given strings."""
    return isinstance(value, str) and value in choices


def refuse_unless(right: bool, name: str, value: object, requirement: str) -> None:
    """Raise an error if an argument is invalid.

    Parameters
    ----------
    right : bool
        True if the argument is valid.
    name : str
        Name of the argument.
    value : object
        Value of the argument, quoted in the error message.
    requirement : str
        Text that follows "must be" in the error message.

    Raises
    ------
    ArgumentError
        If `right` is False. The message is a single sentence.
    """
    if not right:
        raise ArgumentError(f"{name} must be {requirement}, not {shown(value)}")


def require_flag(name: str, value: object) -> None:
    """Raise an error if an argument is not a boolean.

    Raises
    ------
    ArgumentError
        If the value is not a boolean. The message is a single sentence.
    """
    # Recognize NumPy's booleans by name, so that this module does not need to import NumPy.
    is_flag = isinstance(value, bool) or type(value).__name__ in ("bool_", "bool")
    refuse_unless(is_flag, name, value, "True or False")


def require_kind(kind: type | UnionType, name: str, value: object, example: str) -> None:
    """Raise an error if an argument is not of the required type.

    Parameters
    ----------
    kind : type or union of types
        Required type; a union with None for an optional argument.
    name : str
        Name of the argument.
    value : object
        Value of the argument.
    example : str
        Example of a valid argument, as a Python expression, for the error message.

    Raises
    ------
    ArgumentError
        If the value is not of the required type. The message is a single sentence.
    """
    words = _kinds(kind)
    article = "an" if words[0] in "AEIOU" else "a"
    refuse_unless(isinstance(value, kind), name, value, f"{article} {words}, such as {example}")


def tuple_of(kind: type | UnionType, name: str, values: Any, example: str) -> tuple[Any, ...]:
    """Convert a sequence to a tuple, and check the type of its items.

    Parameters
    ----------
    kind : type or union of types
        Required type of each item.
    name, example
        As for `require_kind`.
    values : object
        Value of the argument.

    Raises
    ------
    ArgumentError
        If the value is not a sequence of items of this type. The message is a single sentence.
    """
    right = isinstance(values, Sequence) and all(isinstance(value, kind) for value in values)
    refuse_unless(right, name, values, f"a tuple of {_kinds(kind)}, such as {example}")
    return tuple(values)


def _kinds(kind: type | UnionType) -> str:
    """List the names of types for a message, such as "Arrow, Landmark or Stroke"; not None."""
    kinds = (each for each in get_args(kind) or (kind,) if each is not NoneType)
    *others, last = (each.__name__ for each in kinds)
    return f"{', '.join(others)} or {last}" if others else last


def checked_path(path: Any, name: str = "path", of: str = "file") -> str:
    """Convert a path to str; raise `ArgumentError` if the argument `name` is not a path."""
    text = os.fsdecode(path) if isinstance(path, str | os.PathLike) else ""
    refuse_unless(bool(text) and "\0" not in text, name, path, f"the name of a {of}")
    return text


def checked_target(path: Any) -> str:
    """Convert the path of a file to write to str; raise `ArgumentError` if it is a folder's."""
    text = checked_path(path)
    refuse_unless(Path(text).name not in ("", ".."), "path", path, "the name of a file")
    return text


def nearest_word(
    word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None
) -> str | None:
    """Return the known word that a misspelt word or a synonym most likely refers to.

    Parameters
    ----------
    word : str
        Unknown word.
    known : iterable of str
        Known words.
    synonyms : mapping of str to str, optional
        Known word for each synonym.

    Returns
    -------
    str or None
        Known word, or None if no known word is similar enough.
    """
    words = [*known]
    plain = " ".join(word.casefold().replace("_", " ").replace("-", " ").split())
    synonym = (synonyms or {}).get(plain)
    if synonym in words:
        return synonym
    matches = difflib.get_close_matches(word.casefold(), words, n=1, cutoff=0.6)
    return matches[0] if matches else None


def did_you_mean(word: str, known: Iterable[str], synonyms: Mapping[str, str] | None = None) -> str:
    """Return a question that suggests the most similar known word, or "" if there is none.

    The question begins with a space.
    """
    near = nearest_word(word, known, synonyms)
    return f" Did you mean {near!r}?" if near else ""
