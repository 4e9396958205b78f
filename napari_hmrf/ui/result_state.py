"""The latest result, and whether it still is that of the layers."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.result_layers import Kind
from napari_hmrf.study.study import Study
from napari_hmrf.ui.job import Done
from napari_hmrf.ui.messages import CHANGED, OTHER_SLICE, details, report


class Latest:
    """What came out last in a viewer, and what it was made with; have it `shared`.

    Attributes
    ----------
    done : Done or None
        The result.
    source : callable
        Returns what was deformed, as long as that is there.
    fresh : bool
        Whether layers, tables and settings were still the same when last looked at.
    here : bool
        Whether the slice was.
    note : str
        What was found in the paint since.
    """

    def __init__(self, _: Any = None) -> None:
        self.done: Done | None = None
        self.source: Callable[[], Any] = lambda: None
        self.fresh = self.here = True
        self.note = ""

    def forget(self) -> None:
        """The layers it came from are gone."""
        self.done = None

    def compare(self, request: Callable[[], Request], read: Callable[[Request], Study]) -> bool:
        """Look whether a solve would give the same now; whether the answer is another than before.

        Layers that cannot be read, for whatever reason, would not give the same.
        """
        assert self.done is not None
        before = (self.fresh, self.here)
        self.fresh, self.here = False, True
        try:
            now = request()
            index = Frame.of(now.layers[0], now.view).index
            self.here = index == self.done.study.grid.place.index
            self.fresh = self.here and self.done.study.same_as(read(now))
        except Exception:  # noqa: BLE001 - a layer may raise anything; the result is there
            self.fresh = False
        return (self.fresh, self.here) != before

    def outdate(self) -> None:
        """There is nothing to compare with any more."""
        self.fresh, self.here = False, True

    def lacks(self, kinds: Collection[Kind]) -> bool:
        """Whether it could show more than it does."""
        if self.done is None:
            return False
        outputs, pictures = self.done.outputs, self.done.study.pictures
        possible = set(kinds) - set(outputs.layers)
        without = {
            "image": pictures.image is None,
            "labels": pictures.labels is None,
            "folds": not outputs.folds,
        }
        return any(not without.get(kind, False) for kind in possible)

    @property
    def words(self) -> tuple[str, str]:
        """What to say of it, and in small."""
        if self.done is None:
            return "", ""
        if self.fresh:
            return report(self.done), details(self.done)
        return f"{CHANGED if self.here else OTHER_SLICE} {self.note}".rstrip(), ""
