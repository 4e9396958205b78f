"""What a result is compared with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from napari_hmrf.field.comparison import Comparison
from napari_hmrf.layers.field_layer import holds_field
from napari_hmrf.ui.layer_choice import LayerChoice


class ReferenceChoice(LayerChoice):
    """Choose a field or another result; it is there as soon as there is one to choose.

    Parameters
    ----------
    layers : callable
        The layers there are.

    Attributes
    ----------
    shown : napari.layers.Vectors or None
        The result that is looked at, which is not compared with itself.
    """

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.shown: Any = None
        super().__init__(
            layers,
            lambda layer: layer is not self.shown and holds_field(layer),
            "reference",
            "A displacement field, by File > Open, or another result: how far this one is from it "
            "is said here, and 'show' has a map of it",
        )

    def reset_choices(self, *_: Any) -> None:
        """Look again at what layers there are, and be seen if there is one to choose."""
        super().reset_choices()
        self.visible = bool(self.offered)


def in_words(found: Comparison, unit: str) -> str:
    """How far a result is from its reference; a sentence."""
    if not found.part:
        return f"'{found.reference}' reaches none of this tissue."
    where = "" if found.part > 0.995 else f" over {found.part:.0%} of the tissue"
    return f"RMSD from '{found.reference}'{where}: {found.rmsd:.3g} {unit}."
