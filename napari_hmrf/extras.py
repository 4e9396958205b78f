"""Installation instructions for the optional dependencies."""

from __future__ import annotations

from typing import Literal

Extra = Literal["cluster", "film", "medical", "monai", "peers", "report", "views"]


def how_to_install(extra: Extra) -> str:
    """Return a clause with the command that installs an extra.

    The command installs from a copy of the repository, as described in `README.md`, because the
    package is not on a package index.

    Parameters
    ----------
    extra : str
        Name of an extra in `pyproject.toml`.
    """
    return f'in a copy of the repository, run: pip install ".[{extra}]"'
