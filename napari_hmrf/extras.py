"""Packages that only some commands need, and how to install them."""

from __future__ import annotations

from typing import Literal

Extra = Literal["cluster", "film", "medical", "monai", "report", "rivals", "views"]


def how_to_install(extra: Extra) -> str:
    """Return a clause with the command that installs an extra.

    The package is installed from a copy of its repository, as described in `README.md`, because
    pip does not find it by its name.

    Parameters
    ----------
    extra : str
        Name of an extra in `pyproject.toml`.
    """
    return f'in a copy of the repository, run: pip install ".[{extra}]"'
