"""Caches for work that each napari window, dock or layer would repeat with the same result."""

import gc
import inspect
import sys
from functools import cache
from types import FunctionType, MethodType, SimpleNamespace
from weakref import WeakKeyDictionary

import numpy as np
from napari import layers


@cache
def freeze_once():
    """Exclude existing objects, such as modules and compiled loops, from garbage collection.

    napari collects garbage after each closed window.
    """
    gc.collect()
    gc.freeze()


@cache
def read_manifests_once():
    """Make each window use the plugins that the first window discovered."""
    from npe2 import PluginManifest

    found = list(PluginManifest.discover())
    PluginManifest.discover = lambda paths=(): iter(found)


@cache
def check_widgets_once():
    """Make magicgui check each kind of widget for its protocol only once."""
    from magicgui.widgets import protocols

    protocols.assert_protocol = cache(protocols.assert_protocol)


@cache
def draw_letters_once():
    """Make each window use the letters that an earlier window has rendered."""
    from vispy.visuals.text.text import SDFRendererCPU

    draw = SDFRendererCPU.render_to_texture
    known = {}

    def render_to_texture(renderer, data, texture, offset, size):
        letter = data.shape, data.tobytes(), size
        cols, rows = size
        if letter not in known:
            known[letter] = np.zeros((rows, cols, 3), np.uint8)
            draw(renderer, data, known[letter], (0, 0), size)
        texture[offset[1] : offset[1] + rows, offset[0] : offset[0] + cols, :] = known[letter]

    SDFRendererCPU.render_to_texture = render_to_texture


@cache
def check_callbacks_once():
    """Make napari check the parameters of a function only once."""
    from napari.utils.events import EventEmitter

    check = EventEmitter._check_signature
    known = {}

    def check_signature(callback):
        if isinstance(callback, EventEmitter):
            # An emitter has no code of its own: Python calls the method of its class.
            callback = type(callback).__call__.__get__(callback)
        function = getattr(callback, "__func__", callback)
        if type(function) is not FunctionType or hasattr(function, "__wrapped__"):
            return check(callback)
        # Use only the code as a key, because a function may keep a window alive.
        defaults = len(function.__defaults__ or ())
        key = function.__code__, function is callback, defaults
        if key not in known:
            known[key] = check(callback)
        return known[key]

    EventEmitter._check_signature = staticmethod(check_signature)


@cache
def enable_menus_of_windows_only():
    """Make napari update what enables its menus only while a window is open."""
    from napari._app_model.context._context_keys import ContextNamespace

    update = ContextNamespace.update

    def update_of_window(namespace, event):
        qt_window = sys.modules.get("napari._qt.qt_main_window")
        if qt_window is not None and qt_window._QtMainWindow._instances:
            update(namespace, event)

    ContextNamespace.update = update_of_window


@cache
def set_sliders_once():
    """Make napari check its sliders only if they change, and not for each new layer."""
    from napari.components import Dims

    change = Dims.__setattr__

    def set_attribute(dims, name, value):
        if not (type(value) in (int, tuple) and value == vars(dims).get(name)):
            change(dims, name, value)

    Dims.__setattr__ = set_attribute


@cache
def inspect_functions_once():
    """Make psygnal inspect the parameters of a function only once."""
    inspect_it = inspect.signature
    by_code, by_function = {}, WeakKeyDictionary()

    def signature(obj, **how):
        function = obj.__func__ if type(obj) is MethodType else obj
        if how or type(function) is not FunctionType:
            return inspect_it(obj, **how)
        if _has_plain_parameters(function):  # a function of each dock has the same code
            known, key = by_code, (function.__code__, function is obj)
        else:
            known, key = by_function.setdefault(function, {}), function is obj
        if key not in known:
            known[key] = inspect_it(obj)
        return known[key]

    inspect.signature = signature


def _has_plain_parameters(function):
    """Return whether the parameters of a function follow from its code alone."""
    return not (
        function.__dict__
        or function.__defaults__
        or function.__kwdefaults__
        or function.__annotations__
    )


@cache
def collect_little_once():
    """Make napari collect only the youngest generation of garbage when a layer is removed.

    It collects all generations, because of drivers on Windows.
    """
    from napari._vispy import canvas

    if sys.platform != "win32" and hasattr(canvas, "gc"):
        canvas.gc = SimpleNamespace(collect=lambda: gc.collect(0))


def skip_thumbnails(monkeypatch):
    """Do not draw the thumbnails of layers, which are not visible without a window."""
    for kind in (layers.Image, layers.Labels, layers.Points, layers.Shapes, layers.Vectors):
        monkeypatch.setattr(kind, "_update_thumbnail", lambda _: None)
