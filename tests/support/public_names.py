"""Names of the public interface, for tests of every name."""

from importlib import import_module
from typing import Any

#: Public packages.
PACKAGES = {
    name: import_module(name)
    for name in (
        "napari_hmrf",
        "napari_hmrf.cases",
        "napari_hmrf.data",
        "napari_hmrf.fields",
        "napari_hmrf.landmarks",
        "napari_hmrf.loads",
        "napari_hmrf.posterior",
        "napari_hmrf.random",
        "napari_hmrf.registration",
        "napari_hmrf.tissue",
    )
}


def public_names() -> dict[str, Any]:
    """Return the public objects by name, such as "solve" and "fields.read_field"."""
    found = {}
    for package, module in PACKAGES.items():
        within = package.removeprefix("napari_hmrf").lstrip(".")
        for name in module.__all__:
            found[f"{within}.{name}" if within else name] = getattr(module, name)
    return found
