"""One dock for all tests of a process that need a dock beside a viewer without a window.

Building a dock takes longer than most tests of docks. A shared dock is therefore cleaned after each
test: its work is cancelled, layers are removed, and controls and attributes get their first values
again. A guard then compares the values of all controls, and whether they are enabled and shown,
with those of the new dock, and discards the dock if anything differs.
"""

from __future__ import annotations

import dataclasses
import sys
import types
from collections import deque
from weakref import WeakKeyDictionary, WeakSet, WeakValueDictionary

from psygnal import SignalInstance
from qtpy.QtCore import QCoreApplication, QEvent, Qt
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QAbstractSlider,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLineEdit,
    QScrollBar,
    QWidget,
)

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.layers.viewer_layers import _shared
from tests.support.opened import DISCARDED, opened
from tests.support.timeouts import LONG
from tests.support.windowless import Frame

_OURS = "napari_hmrf."
_MAPPINGS = dict, WeakKeyDictionary, WeakValueDictionary
_CONTAINERS = (list, set, deque, WeakSet, *_MAPPINGS)


class SharedDock:
    """Dock that is lent to one test after another.

    Parameters
    ----------
    is_framed : bool
        True if the dock is in a frame, as in a window; otherwise, the dock has no parent.
    """

    def __init__(self, is_framed):
        self._is_framed = is_framed
        self._frame = self._dock = self._new = None
        self._is_lent = False

    def lend(self):
        """Return the frame, of which `open` returns the clean dock, until `take_back`."""
        if self._is_lent:
            raise RuntimeError("a test opens a second shared dock; build a `Frame` for it")
        if self._frame is None:
            self._frame = Frame()
            self._dock = self._frame.open() if self._is_framed else self._frame.open_loose()
            _settle()
            self._new = _State(self._frame.viewer, self._dock)
        self._is_lent, self._frame.ready = True, self._dock
        return self._frame

    def take_back(self):
        """Clean the dock after a test, or discard the dock if it cannot be cleaned."""
        if not self._is_lent:
            return
        self._is_lent = False
        difference = "closed" if self._dock.away else self._clean()
        if difference:
            opened[f"{DISCARDED}{difference}"] += 1
            self.discard()

    def discard(self):
        """Delete the dock; the next test gets a new dock."""
        if self._frame is not None:
            self._frame.delete()
            self._frame = self._dock = self._new = None
            _settle()

    def _clean(self):
        """Restore the state of a new dock; return the first difference that is left, or ""."""
        dock, new, errors = self._dock, self._new, []
        # PyQt aborts the process at an error in a callback, unless there is a hook for errors.
        hook, sys.excepthook = sys.excepthook, lambda *error: errors.append(repr(error[1]))
        try:
            dock.cancel()
            dock.pause()
            _settle()
            new.restore_controls()
            self._frame.reset(dock)
            dock.fields.material.choices = []
            for _ in range(2):  # an event may follow from the first restored value
                _settle()
                new.restore_controls()
                new.restore_attributes()
                dock.fields.show_for(dock.fields._tool)
                new.restore_parts()
            dock.show_message("")
            return errors[0] if errors else new.difference()
        except Exception as error:  # noqa: BLE001 - a test may leave the dock in any state
            return repr(error)
        finally:
            sys.excepthook = hook


def _settle():
    """End all work of the compute thread, and process all events and deletions."""
    compute_thread.submit(lambda: None).result(LONG)
    QApplication.processEvents()
    QCoreApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete)


class _State:
    """Values of all controls and attributes of a dock."""

    def __init__(self, viewer, dock):
        self._dock = dock
        self._attributes, self._contents, self._slots = [], [], []
        self._seen = {}
        self._record(dock)
        for shared in _shared[viewer].values():
            self._record(shared)
        self._controls = [(each, _state(each, dock.native)) for each in _controls(dock)]
        self._parts = [(each, each.isHidden(), _is_disabled(each)) for each in _parts(dock)]

    def _record(self, root):
        """Record the attributes of an object and of all objects of the package it refers to."""
        waiting = [root]
        while waiting:
            item = waiting.pop()
            if id(item) in self._seen:
                continue
            self._seen[id(item)] = item
            if isinstance(item, SignalInstance):
                self._slots.append((item, list(item._slots)))
            elif isinstance(item, _MAPPINGS):
                self._contents.append((item, dict(item)))
                waiting += item.values()
            elif isinstance(item, _CONTAINERS):
                self._contents.append((item, list(item)))
                waiting += item
            elif isinstance(item, tuple):
                waiting += item
            elif _is_stateful(item):
                self._attributes.append((item, dict(vars(item))))
                waiting += vars(item).values()

    def restore_controls(self):
        """Give each control its first value, in the way a user would."""
        for control, (value, *_) in self._controls:
            if _read(control) != value:
                _write(control, value)
        QApplication.processEvents()

    def restore_parts(self):
        """Show and enable the same parts of the dock as when it was new."""
        for part, is_hidden, is_disabled in self._parts:
            if part.isHidden() != is_hidden:
                part.setHidden(is_hidden)
            if _is_disabled(part) != is_disabled:
                part.setDisabled(is_disabled)

    def restore_attributes(self):
        """Give each attribute its first value, and each signal its first callbacks."""
        for item, attributes in self._attributes:
            own = vars(item)
            for name in own.keys() - attributes.keys():
                if isinstance(own[name], SignalInstance):
                    own[name]._slots.clear()
                else:
                    del own[name]
            own.update(attributes)
        for container, contents in self._contents:
            container.clear()
            add = container.extend if isinstance(container, list | deque) else container.update
            add(contents)
        for signal, slots in self._slots:
            signal._slots[:] = slots

    def difference(self):
        """Return the first control that differs from the control of the new dock, or ""."""
        native = self._dock.native
        for control, before in self._controls:
            if (now := _state(control, native)) != before:
                text = control.text() if isinstance(control, QAbstractButton) else ""
                name = text or control.accessibleName() or control.objectName()
                return f"{type(control).__name__} {name}: {now} is not {before}"
        return ""


def _is_stateful(item):
    """Return whether an object of the package may change its attributes."""
    kind = type(item)
    if not kind.__module__.startswith(_OURS) or not hasattr(item, "__dict__"):
        return False
    if isinstance(item, type | types.FunctionType | Exception):
        return False
    parameters = getattr(kind, "__dataclass_params__", None)
    return not (dataclasses.is_dataclass(item) and parameters and parameters.frozen)


def _parts(dock):
    """Return all widgets of a dock, without its windows and the parts that Qt adds."""
    inner = QAbstractItemView, QAbstractSpinBox, QComboBox
    return [
        each
        for each in dock.native.findChildren(QWidget)
        if not each.isWindow()
        and not isinstance(each, QScrollBar)
        and not isinstance(each.parent(), inner)
        and not isinstance(each.parent().parent(), inner)  # such as a cell of a table
    ]


def _controls(dock):
    """Return all Qt controls of a dock that hold a value."""
    kinds = QAbstractButton, QAbstractSlider, QAbstractSpinBox, QComboBox, QLineEdit
    return [each for each in _parts(dock) if isinstance(each, kinds)]


def _is_disabled(part):
    """Return whether a part is disabled by itself, and not by a part that contains it."""
    return part.testAttribute(Qt.WidgetAttribute.WA_ForceDisabled)


def _state(control, native):
    """Return the value of a control, and whether the control is enabled and shown in its dock."""
    return _read(control), control.isEnabledTo(native), control.isVisibleTo(native)


def _read(control):
    """Return the value of a control."""
    if isinstance(control, QComboBox):
        return control.currentText()
    if isinstance(control, QAbstractButton):
        return control.isCheckable() and control.isChecked()
    return control.text() if isinstance(control, QLineEdit) else control.value()


def _write(control, value):
    """Set the value of a control as a user would."""
    if isinstance(control, QComboBox):
        control.setCurrentText(value)
    elif isinstance(control, QAbstractButton):
        control.setChecked(value)
    elif isinstance(control, QLineEdit):
        control.setText(value)
    else:
        control.setValue(value)
