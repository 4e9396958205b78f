"""Argument types of the command line: functions that convert and validate text."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

from napari_hmrf.checks import POISSON_RANGE
from napari_hmrf.io.case_tables import read_energy


def energy_option(name: str) -> Callable[[str], Any]:
    """Return a function that converts the text of an energy option.

    Parameters
    ----------
    name : {"plane", "tolerance", "budget", "penalty", "weight", "cavity", "spacing"}
    """

    def read(text: str) -> Any:
        try:
            return read_energy(name, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is not {error}") from None

    return read


def positive_option(text: str) -> float:
    """Convert text to a positive number."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return number


def count_option(text: str) -> int:
    """Convert text to a whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def lengths_option(text: str) -> float | tuple[float, float]:
    """Convert text to a length, or to a range of two lengths separated by a hyphen."""
    try:
        return float(text)
    except ValueError:
        pass
    low, _, high = text.partition("-")
    try:
        return float(low), float(high)
    except ValueError:
        message = f"{text!r} is not a length such as 3, or a range such as 1-4"
        raise argparse.ArgumentTypeError(message) from None


def size_option(smallest: int) -> Callable[[str], int]:
    """Return a function that converts text to the size of a sample, in pixels."""

    def read(text: str) -> int:
        try:
            size = int(text)
        except ValueError:
            size = 0
        if size < smallest:
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a whole number of at least {smallest}"
            )
        return size

    return read


def poisson_option(text: str) -> float:
    """Convert text to a Poisson's ratio."""
    low, high = POISSON_RANGE
    try:
        poisson = float(text)
    except ValueError:
        poisson = -1.0
    if not low <= poisson <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
    return poisson
