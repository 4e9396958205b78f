"""Buttons and keys that take back what was done in a viewer, whichever dock it was done in."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import PushButton
from qtpy.QtCore import QEvent, QObject, Qt

from napari_hmrf.layers.edit_history import ViewerSteps

_CTRL, _SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
_REDO = ((_CTRL | _SHIFT, Qt.Key.Key_Z), (_CTRL, Qt.Key.Key_Y))


class StepButtons:
    """Undo and Redo; their tooltips say what they would do.

    Attributes
    ----------
    undo, redo : PushButton
    """

    def __init__(self) -> None:
        self.undo = PushButton(text="Undo", enabled=False)
        self.redo = PushButton(text="Redo", enabled=False)
        self._tips = ("", "")

    def show(self, steps: ViewerSteps) -> None:
        """Show what there is to take back, and to do again."""
        tips = (steps.undo_tooltip, steps.redo_tooltip)
        if tips == self._tips:
            return
        self._tips = tips
        self.undo.tooltip, self.redo.tooltip = tips
        self.undo.enabled = steps.edits.next_undo is not None
        self.redo.enabled = steps.edits.next_redo is not None


class StepKeys(QObject):
    """Has a dock answer the usual keys, wherever in it the keyboard is.

    Fields in which text is being typed keep their own. While there is nothing to do, the keys go on
    to napari, as all others do.

    Parameters
    ----------
    native : QWidget
        The dock.
    steps : ViewerSteps
    """

    def __init__(self, native: Any, steps: ViewerSteps) -> None:
        super().__init__(native)
        self._steps = steps
        native.installEventFilter(self)

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Answer a key that nothing within the dock has taken."""
        if event.type() != QEvent.Type.KeyPress:
            return False
        edits, key = self._steps.edits, (event.modifiers(), event.key())
        if key == (_CTRL, Qt.Key.Key_Z) and edits.next_undo is not None:
            self._steps.undo()
        elif key in _REDO and edits.next_redo is not None:
            self._steps.redo()
        else:
            return False
        return True
