"""The table of boundaries: what the tissue under each label does, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.tissue.boundary_rules import Action, BoundaryRule, default_rule
from napari_hmrf.ui.label_table import Column, LabelTable, number

_ACTIONS: dict[Action, str] = {"fixed": "fixed", "move": "moves", "expand": "expands"}
_BY_WORD = {word: action for action, word in _ACTIONS.items()}
_ROWS, _COLS, _OUTWARD = range(3, 6)


class BoundaryTable(LabelTable):
    """Label, name, action, distances and confidence; `rows` are `BoundaryRule`s."""

    def __init__(self) -> None:
        super().__init__(
            "Boundary",
            [
                Column(
                    "Action",
                    "Fixed: stays where it is.\nMoves: so far along the rows and the columns.\n"
                    "Expands: so far outward, along the normal of its outline",
                    lambda row: _ACTIONS[row.action],
                    lambda row, text: replace(row, action=_BY_WORD[text]),
                    lambda row: (
                        "Expanding regions must be closed rings or filled: they move along the "
                        "outward normal of their outline"
                    ),
                    tuple(_BY_WORD),
                ),
                *(
                    Column(
                        "",
                        "",
                        partial(_amount, column),
                        partial(self._typed, column),
                        lambda row: f"in {self._unit}",
                    )
                    for column in (_ROWS, _COLS, _OUTWARD)
                ),
                Column(
                    "confi-\ndence",
                    "How sure this is: from 0, unknown, to 1, certain.\nTwo numbers, such as "
                    "1 / 0.5, for rows and columns apart",
                    lambda row: " / ".join(f"{part:g}" for part in dict.fromkeys(row.confidence)),
                    _sure,
                ),
            ],
        )
        self.show_place("px", Directions())

    def show_place(self, unit: str, ways: Directions) -> None:
        """Say in which unit amounts are, and which way rows and columns run on the screen."""
        self._unit = unit
        for column, title, about in (
            (_ROWS, ways.header(0), ways.about(0)),
            (_COLS, ways.header(1), ways.about(1)),
            (_OUTWARD, "out", "How far outward; negative: inward"),
        ):
            self.set_head(column, f"{title}\n{unit}", f"{about}, in {unit}")

    def _default(self, label: int) -> BoundaryRule:
        return default_rule(label)

    def words(self, label: int) -> str:
        """What a label's row says, in words."""
        return _ACTIONS[self.rows[self.labels.index(label)].action]

    def _typed(self, column: int, rule: BoundaryRule, text: str) -> BoundaryRule:
        amount = number(text)
        if not math.isfinite(amount):
            raise ValueError(f"A distance must be a number, in {self._unit}")
        if column == _OUTWARD:
            return replace(rule, amount=amount)
        rows, cols = rule.vector
        return replace(rule, vector=(amount, cols) if column == _ROWS else (rows, amount))


def _amount(column: int, rule: BoundaryRule) -> str:
    if rule.action != ("expand" if column == _OUTWARD else "move"):
        return ""
    return f"{rule.amount if column == _OUTWARD else rule.vector[column - _ROWS]:g}"


def _sure(rule: BoundaryRule, text: str) -> BoundaryRule:
    parts = [number(part) for part in text.split("/")]
    if len(parts) > 2 or not all(0 <= part <= 1 for part in parts):
        raise ValueError("Confidence must be a number from 0 to 1, or two: 1 / 0.5")
    return replace(rule, confidence=(parts[0], parts[-1]))
