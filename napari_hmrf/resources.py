"""Location of the shaders and the sample data, in an installed wheel or in a checkout."""

from __future__ import annotations

from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


@cache
def resource_folder(name: str) -> Path:
    """Return the path of a folder with resources.

    The folder is inside the package in an installed wheel, and at the top level of a checkout.

    Parameters
    ----------
    name : {"shaders", "sample_data"}

    Returns
    -------
    Path

    Raises
    ------
    FileNotFoundError
        If the installation is incomplete.
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"the folder {name!r} of napari-hmrf is missing from {_PACKAGE}; install the package again"
    )
