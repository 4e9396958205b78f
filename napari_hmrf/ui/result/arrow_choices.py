"""How a result's arrows are drawn: whether, how many, how long."""

from __future__ import annotations

from functools import partial
from typing import Any

from napari_hmrf.layers.result_layers import ARROWS, arrows_apart
from napari_hmrf.layers.result_lookup import FoundResult
from napari_hmrf.ui.result.errands import Errands
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_form import ResultForm
from napari_hmrf.ui.result.result_messages import FULL


class ArrowChoices:
    """Has the arrows drawn as the widget says.

    Parameters
    ----------
    form : ResultForm
    shown : LookedAt
    errands : Errands
    """

    def __init__(self, form: ResultForm, shown: LookedAt, errands: Errands) -> None:
        self._form, self._shown, self._errands = form, shown, errands
        # How long they are at 100 %, while they are drawn for less.
        self._whole: float | None = None
        self._percent = FULL
        form.arrows.changed.connect(self._on_drawn)
        form.count.changed.connect(self._on_count)
        form.length.changed.connect(self._on_length)

    def apply(self) -> None:
        """Draw a new result's arrows as those before it were; as they are, if nobody has chosen."""
        if self._form.count.value != ARROWS:
            self._on_count(self._form.count.value)
        if self._form.length.value != 1:
            self._on_length(self._form.length.value)

    def show(self, percent: int) -> None:
        """Let them end where the tissue is at so much of the deformation; their data stay."""
        arrows = self._shown.layer("arrows")
        if arrows is None:
            return
        if self._whole is None:
            self._whole = float(arrows.length)
        self._percent = percent
        arrows.length = self._whole * percent / FULL

    def show_whole(self) -> None:
        """Let them be as they were before `show`."""
        arrows = self._shown.layer("arrows")
        if self._whole is not None and arrows is not None:
            arrows.length = self._whole
        self._whole, self._percent = None, FULL

    def _on_drawn(self, drawn: bool) -> None:
        arrows, layers = self._shown.layer("arrows"), self._shown.layers
        if arrows is None or layers is None:
            return
        if drawn:
            arrows.visible = True
        else:
            layers.hide("arrows")

    def _on_count(self, about: int) -> None:
        result, arrows = self._shown.result, self._shown.layer("arrows")
        if result is not None:
            work = partial(arrows_apart, result.solution, about)
            self._errands.send("arrows", work, partial(self._draw, result, arrows))

    def _draw(self, result: FoundResult, arrows: Any, found: tuple[Any, float]) -> None:
        if result is self._shown.result:
            segments, arrows.edge_width = found
            arrows.data = result.frame.put_vectors(segments)

    def _on_length(self, times: float) -> None:
        if self._shown.layer("arrows") is not None:
            self._whole = times
            self.show(self._percent)
