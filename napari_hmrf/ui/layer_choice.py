"""A menu of the viewer's layers that stays true while layers come and go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import ComboBox
from napari.layers import Image

from napari_hmrf.layers.metadata import TISSUE, known_of, role_of


def is_picture(layer: Any) -> bool:
    """Whether a layer is an image of something, and neither a result nor how stiff tissue is."""
    own = isinstance(layer, Image) and "kind" not in known_of(layer)
    return own and role_of(layer) != TISSUE


class LayerChoice(ComboBox):
    """Choose a layer, or none.

    Parameters
    ----------
    layers : callable
        The layers there are, lowest first.
    accept : callable
        Whether a layer can be chosen.
    title : callable, optional
        How a layer is named in the menu; by default by its name.
    """

    def __init__(
        self,
        layers: Callable[[], list[Any]],
        accept: Callable[[Any], bool],
        title: Callable[[Any], str] = lambda layer: str(layer.name),
        **options: Any,
    ) -> None:
        def choices(_: Any) -> list[tuple[str, Any]]:
            return [(title(layer), layer) for layer in layers() if accept(layer)]

        super().__init__(choices=choices, nullable=True, **options)
        self._layers, self._accept = layers, accept
        # A long name must not widen the dock.
        box = self.native
        box.setSizeAdjustPolicy(box.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        box.setMinimumContentsLength(8)

    @property
    def offered(self) -> list[Any]:
        """The layers that can be chosen, lowest first."""
        return [layer for layer in self._layers() if self._accept(layer)]

    def refresh(self) -> None:
        """Look again at what layers there are; a choice that is gone becomes none."""
        before: Any = self.get_value()
        after = None
        with self.changed.blocked():
            self.reset_choices()
            if before in self.choices:
                after = before
            self.set_value(after)
        if after is not before:
            self.changed.emit(after)

    def choose(self, layer: Any) -> None:
        """Choose a layer; ValueError if it cannot be."""
        self.refresh()
        if layer is not None and layer not in self.choices:
            raise ValueError(f"{layer!r} cannot be chosen as {self.label or self.name}")
        self.value = layer
