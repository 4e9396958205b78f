"""Counters of the GUI thread's work: accesses to layers and allocations of large arrays.

A custom NumPy memory handler counts each allocation of this thread that is at least as large as the
image, even if the array is freed soon. Each access of this package's code to the data or metadata
of a layer is also counted. Counting takes time, so counted runs are not timed.
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

#: Indices of `PyDataMem_SetHandler` and `PyDataMem_GetHandler` in NumPy's C API table since 1.22.
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
    """Results of counting.

    Attributes
    ----------
    data, metadata : Counter of str
        Number of accesses to the data and the metadata, by layer name.
    arrays : Counter of str
        Number of arrays at least as large as the image, by the function of this package that
        allocated them directly or indirectly; "napari" if no such function was running.
    megabytes : float
        Total size of these arrays.
    """

    data: Counter[str] = field(default_factory=Counter)
    metadata: Counter[str] = field(default_factory=Counter)
    arrays: Counter[str] = field(default_factory=Counter)
    megabytes: float = 0.0


@contextmanager
def counted(pixels: int, counts: Counts) -> Iterator[None]:
    """Count the work of this thread, including arrays of at least `pixels` bytes."""
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
#: Handlers must outlive the arrays that they have allocated, so they are never freed.
_KEPT: list[Any] = []


def _numpys() -> tuple[Callable[[Any], Any], Any]:
    """Return the function that sets NumPy's memory handler, and the current handler."""
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
    """Return the name of the innermost function of this package that is running."""
    frame = sys._getframe(3)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith(_PACKAGE):
            return f"{module.removeprefix(_PACKAGE + '.')}.{frame.f_code.co_qualname}"
        frame = frame.f_back  # type: ignore[assignment]
    return "napari"
