"""What a window's thread does while it answers the mouse: layers it reads, large arrays it makes.

NumPy is given memory by a handler of ours, of the thread that asks for it only, and every array
that is as large as the image is counted, be it kept or not; so is every look of this package's code
at a layer's data or metadata. All of it takes time: what is counted is not timed.
"""

from __future__ import annotations

import ctypes
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from napari.layers import Image, Labels, Layer, Points, Shapes, Vectors

#: Where `PyDataMem_SetHandler` and `PyDataMem_GetHandler` are in NumPy's table for C, since 1.22.
_SET, _GET = 304, 305
_PACKAGE = "napari_hmrf"
_KINDS = (Image, Labels, Points, Shapes, Vectors)


class _Allocator(ctypes.Structure):
    _fields_ = [
        ("ctx", ctypes.c_void_p),
        ("malloc", ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)),
        (
            "calloc",
            ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t),
        ),
        ("realloc", ctypes.c_void_p),
        ("free", ctypes.c_void_p),
    ]


class _Handler(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_char * 127),
        ("version", ctypes.c_uint8),
        ("allocator", _Allocator),
    ]


@dataclass
class Counts:
    """What was counted.

    Attributes
    ----------
    data, metadata : Counter of str
        Looks at them, by the name of the layer.
    arrays : Counter of str
        Arrays of the size of the image or more, by the function of this package that they were made
        in or for; "napari" where none was at work.
    megabytes : float
        Of all those arrays.
    """

    data: Counter[str] = field(default_factory=Counter)
    metadata: Counter[str] = field(default_factory=Counter)
    arrays: Counter[str] = field(default_factory=Counter)
    megabytes: float = 0.0


@contextmanager
def counted(pixels: int, counts: Counts) -> Iterator[None]:
    """Count what this thread does; arrays of so many bytes or more."""
    with _looks(counts), _allocations(counts, pixels):
        yield


@contextmanager
def _looks(counts: Counts) -> Iterator[None]:
    thread = threading.get_ident()
    patched: list[tuple[type, str, property]] = []

    def watch(kind: type, name: str, into: Counter[str]) -> None:
        before: property = kind.__dict__[name]

        def get(layer: Any) -> Any:
            module = sys._getframe(1).f_globals.get("__name__", "")
            if threading.get_ident() == thread and module.startswith(_PACKAGE):
                into[str(layer.name)] += 1
            assert before.fget is not None
            return before.fget(layer)

        patched.append((kind, name, before))
        setattr(kind, name, property(get, before.fset, before.fdel, before.__doc__))

    for kind in _KINDS:
        owner = next(each for each in kind.__mro__ if "data" in each.__dict__)
        if (owner, "data") not in [(each, name) for each, name, _ in patched]:
            watch(owner, "data", counts.data)
    watch(Layer, "metadata", counts.metadata)
    try:
        yield
    finally:
        for kind, name, before in patched:
            setattr(kind, name, before)


@contextmanager
def _allocations(counts: Counts, pixels: int) -> Iterator[None]:
    set_handler, usual = _numpys()

    def note(size: int) -> None:
        if size >= pixels:
            counts.arrays[_made_in()] += 1
            counts.megabytes += size / 1e6

    def malloc(ctx: Any, size: int) -> Any:
        note(size)
        return usual.allocator.malloc(ctx, size)

    def calloc(ctx: Any, count: int, size: int) -> Any:
        note(count * size)
        return usual.allocator.calloc(ctx, count, size)

    own = _Handler.from_buffer_copy(usual)
    own.allocator.malloc = type(usual.allocator.malloc)(malloc)
    own.allocator.calloc = type(usual.allocator.calloc)(calloc)
    new = ctypes.pythonapi.PyCapsule_New
    new.restype = ctypes.py_object
    new.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    capsule = new(ctypes.addressof(own), _CAPSULE, None)
    _KEPT.append((own, capsule, malloc, calloc))
    before = set_handler(capsule)
    try:
        yield
    finally:
        set_handler(before)


_CAPSULE = b"mem_handler"
#: Arrays made meanwhile are freed by their handler whenever they go.
_KEPT: list[Any] = []


def _numpys() -> tuple[Callable[[Any], Any], Any]:
    """What sets NumPy's handler of memory, and the handler there is."""
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype = ctypes.c_void_p
    get_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    table = ctypes.cast(
        get_pointer(np._core._multiarray_umath._ARRAY_API, None), ctypes.POINTER(ctypes.c_void_p)
    )
    set_handler = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(table[_SET])
    get_handler = ctypes.PYFUNCTYPE(ctypes.py_object)(table[_GET])
    usual = _Handler.from_address(get_pointer(get_handler(), _CAPSULE))
    return set_handler, usual


def _made_in() -> str:
    """The innermost function of this package that is at work."""
    frame = sys._getframe(3)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith(_PACKAGE):
            return f"{module.removeprefix(_PACKAGE + '.')}.{frame.f_code.co_qualname}"
        frame = frame.f_back  # type: ignore[assignment]
    return "napari"
