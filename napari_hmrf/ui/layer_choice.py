"""A menu of the viewer's layers that stays true while layers come and go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import ComboBox
from napari.layers import Image

from napari_hmrf.layers.metadata import TISSUE, known_of, role_of
from napari_hmrf.ui.forms import narrow


def is_picture(layer: Any) -> bool:
    """Whether a layer is an image of something, and neither a result nor how stiff tissue is."""
    own = isinstance(layer, Image) and "kind" not in known_of(layer)
    return own and role_of(layer) != TISSUE


class LayerChoice(ComboBox):
    """Choose a layer, or none.

    magicgui's own menu of layers asks the window for them, which a script may not have.

    Parameters
    ----------
    layers : callable
        The layers there are, lowest first.
    accept : callable
        Whether a layer can be chosen.
    label, tooltip : str
    title : callable, optional
        How a layer is named in the menu; by default by its name.
    more : callable, optional
        What else can be chosen now: pairs of a title and a value.
    if_any : bool
        Whether it is seen only where there is a layer to choose.
    """

    def __init__(
        self,
        layers: Callable[[], list[Any]],
        accept: Callable[[Any], bool],
        label: str,
        tooltip: str,
        title: Callable[[Any], str] = lambda layer: str(layer.name),
        more: Callable[[], list[tuple[str, Any]]] = list,
        if_any: bool = False,
    ) -> None:
        self._layers, self._accept, self._if_any = layers, accept, if_any
        super().__init__(
            choices=lambda _: [*more(), *((title(layer), layer) for layer in self.offered)],
            nullable=True,
            label=label,
            tooltip=tooltip,
        )
        narrow(self)

    @property
    def offered(self) -> list[Any]:
        """The layers that can be chosen, lowest first."""
        return [layer for layer in self._layers() if self._accept(layer)]

    def reset_choices(self, *_: Any) -> None:
        """Look again at what layers there are; a choice that is gone becomes none."""
        before: Any = self.get_value()
        with self.changed.blocked():
            super().reset_choices()
            after = before if before in self.choices else None
            self.set_value(after)
        if self._if_any:
            self.visible = bool(self.offered)
        if after is not before:
            self.changed.emit(after)

    def _choose(self, layer: Any) -> None:
        self.reset_choices()
        if layer is not None and layer not in self.choices:
            raise ValueError(f"{layer!r} cannot be chosen as {self.label}")
        ComboBox.value.fset(self, layer)

    #: The layer; ValueError if another is set than can be chosen.
    value = property(ComboBox.value.fget, _choose)
