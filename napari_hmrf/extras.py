"""Packages that only some commands need, and how to install them."""

from __future__ import annotations

from typing import Literal

Extra = Literal["cluster", "film", "medical", "monai", "report", "rivals", "views"]


def how_to_install(extra: Extra) -> str:
    """Return a clause that says how to install an extra.

    The package is installed from a copy of its repository, as `README.md` says, so that its name
    alone would not find it.

    Parameters
    ----------
    extra : str
        An extra of `pyproject.toml`.
    """
    return f'in a copy of the repository, run: pip install ".[{extra}]"'
