"""What there is one of in a viewer, whichever docks come and go."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any, TypeVar

_Shared = TypeVar("_Shared")
_shared: weakref.WeakKeyDictionary[Any, dict[Any, Any]] = weakref.WeakKeyDictionary()


def shared(viewer: Any, kind: Callable[[Any], _Shared]) -> _Shared:
    """The one object of a kind in a viewer, for a dock that is closed and for the next that comes.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    kind : type
        Made of the viewer; must not keep it alive.
    """
    known = _shared.setdefault(viewer, {})
    if kind not in known:
        known[kind] = kind(viewer)
    found: _Shared = known[kind]
    return found
