"""How a result's arrows are drawn: whether, and how much of their length."""

from __future__ import annotations

from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_form import ResultForm
from napari_hmrf.ui.result.result_messages import FULL


class ArrowChoices:
    """Has arrows drawn, or not; how long they are at 100 % is said by napari's own controls.

    Parameters
    ----------
    form : ResultForm
    shown : LookedAt
    """

    def __init__(self, form: ResultForm, shown: LookedAt) -> None:
        self._shown = shown
        self._whole = self._drawn = 1.0
        self._percent = FULL
        form.arrows.changed.connect(self._on_ticked)

    def show(self, percent: int) -> None:
        """Let them end where the tissue is at so much of the deformation; their data stay."""
        arrows = self._shown.layer("arrows")
        if arrows is not None:
            if self._percent and arrows.length != self._drawn:  # somebody has chosen another
                self._whole = arrows.length * FULL / self._percent
            self._drawn = arrows.length = self._whole * percent / FULL
        self._percent = percent

    def _on_ticked(self, drawn: bool) -> None:
        arrows, layers = self._shown.layer("arrows"), self._shown.layers
        if arrows is None or layers is None:
            return
        if drawn:
            arrows.visible = True
        else:
            layers.hide("arrows")
