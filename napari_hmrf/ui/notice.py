"""Notice at the top of the dock, which is visible while it has a text."""

from __future__ import annotations

from magicgui.widgets import Container, PushButton
from qtpy.QtWidgets import QSizePolicy

from napari_hmrf.ui.forms import Prose, row


class Notice(Container):
    """Notice at the top of the dock, which is visible while it has a text.

    Parameters
    ----------
    *buttons : PushButton
        Buttons below the text.
    """

    def __init__(self, *buttons: PushButton) -> None:
        self._text = Prose()
        super().__init__(widgets=[self._text], labels=False)
        if buttons:
            line = row(*buttons)
            line.native.layout().addStretch()
            line.margins = (0, 0, 0, 0)
            self.append(line)
        for button in buttons:
            button.native.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.native.layout().setSpacing(2)
        self.margins = (4, 0, 0, 0)
        self.visible = False

    def show_text(self, text: str, tooltip: str = "") -> None:
        """Show a text with a tooltip; "" hides the notice."""
        self._text.show_text(text)
        self._text.tooltip = tooltip
        self.visible = bool(text)
