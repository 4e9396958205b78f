"""Colours and grid: made when they are asked for, hidden when they are not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from napari_hmrf.layers.image_result import Part
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.layers.result_lookup import FoundResult
from napari_hmrf.layers.strain_layers import FloatArray, Quantity
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.errands import Errands
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_form import ResultForm
from napari_hmrf.ui.result.result_messages import NOTHING
from napari_hmrf.ui.result.result_work import coloured, grid_of


class LayerChoices:
    """Has colours and grid drawn as the widget says.

    Parameters
    ----------
    form : ResultForm
    shown : LookedAt
    errands : Errands
    cursor : UnderCursor
        Told what colours show.
    moves_anew : callable
        Called when other layers move than before; given whether they are to be drawn at once.
    """

    def __init__(
        self,
        form: ResultForm,
        shown: LookedAt,
        errands: Errands,
        cursor: UnderCursor,
        moves_anew: Callable[[bool], None],
    ) -> None:
        self._shown, self._errands, self._cursor = shown, errands, cursor
        self._moves_anew = moves_anew
        form.colours.changed.connect(self._on_colours)
        form.grid.changed.connect(self._on_grid)

    def make_colours(self, result: FoundResult, quantity: Quantity) -> None:
        """Colour the tissue of a result."""
        work = partial(coloured, result, quantity)
        self._errands.send("colours", work, partial(self._show_colours, result))

    def make_grid(self, result: FoundResult) -> None:
        """Draw the deformation grid of a result."""
        self._errands.send("grid", partial(grid_of, result), partial(self._put, "grid"))

    def _on_colours(self, quantity: Any) -> None:
        result, layers = self._shown.result, self._shown.layers
        if result is None or layers is None:
            return
        if quantity == NOTHING:
            self._cursor.coloured = None
            layers.hide("colours")
            self._moves_anew(False)
            return
        self.make_colours(result, quantity)

    def _show_colours(self, result: FoundResult, found: tuple[LayerData, FloatArray]) -> None:
        if result is not self._shown.result:
            return
        made, values = found
        known = made.attributes["metadata"][METADATA]
        self._cursor.coloured = known["kind"], values
        known["percent"] = 0
        self._put("colours", made)
        self._moves_anew(True)

    def _on_grid(self, drawn: bool) -> None:
        result, layers = self._shown.result, self._shown.layers
        if result is None or layers is None:
            return
        layer = layers.layer("grid")
        if not drawn:
            layers.hide("grid")
        elif layer is None:
            self.make_grid(result)
        else:
            layer.visible = True
        self._moves_anew(drawn)

    def _put(self, part: Part, made: LayerData) -> None:
        """Show what was made for this result, now or once it is seen."""
        if self._shown.layers is not None:
            self._shown.layers.put(part, made, self._shown.source)
