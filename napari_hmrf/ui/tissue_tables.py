"""The tables of tissues and of boundaries: what each label means."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, Table
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import (
    LARGEST_STIFFNESS,
    RIGID,
    Action,
    BoundaryRule,
    Material,
    default_material,
    default_rule,
    read_stiffness,
    stiffness_in_words,
)
from napari_hmrf.ui.label_table import Column, LabelTable
from napari_hmrf.ui.messages import ABOUT_POISSON

_STIFFNESS, _POISSON = range(2, 4)


class MaterialTable(LabelTable):
    """Label, name, stiffness and Poisson's ratio; `rows` are `Material`s."""

    def __init__(self, view: Callable[[], View | None]) -> None:
        super().__init__(
            TISSUE,
            view,
            "Tissue",
            [
                Column(
                    "",
                    "Young's modulus, in any unit as long as it is the same for all tissues: only "
                    "ratios matter.\n0 is no tissue, such as air. 'rigid' moves as one, such as "
                    "bone or an implant; the elastic model has that, the paper's has not.",
                    lambda row: stiffness_in_words(row.stiffness),
                    _stiffness,
                    _about,
                ),
                Column(
                    "Poisson's\nratio",
                    ABOUT_POISSON,
                    lambda row: f"{row.poisson:g}" if row.is_deformable else "",
                    _poisson,
                    _about,
                ),
            ],
            default=lambda label: default_material(label, self.rows),
            words=_in_words,
            about=_of_unpainted,
        )
        self._show(self.contents)

    def _show(self, contents: Table) -> None:
        unit = contents.unit  # shown only, for ratios are what matters
        title = f"Stiffness ({unit})" if unit else "Relative\nstiffness"
        self.set_column(_STIFFNESS, title=title)
        super()._show(contents)

    def show_poisson(self, elastic: bool) -> None:
        """Show Poisson's ratios, or not: only elastic tissue has them."""
        self.set_column(_POISSON, applies=elastic)


def _in_words(material: Material) -> str:
    amount = stiffness_in_words(material.stiffness)
    return amount if material.is_rigid else f"stiffness {amount}"


def _stiffness(material: Material, text: str) -> Material:
    if text.casefold() == "inf" or read_stiffness(text) == RIGID:
        return replace(material, stiffness=RIGID)
    stiffness = _number(text)
    if not 0 <= stiffness <= LARGEST_STIFFNESS:
        raise ValueError("Stiffness must be a number, 0 or more, or 'rigid'")
    return replace(material, stiffness=stiffness)


def _poisson(material: Material, text: str) -> Material:
    poisson, (low, high) = _number(text), POISSON_RANGE
    if not low <= poisson <= high:
        raise ValueError(f"Poisson's ratio must be a number from {low:g} to {high:g}")
    return replace(material, poisson=poisson)


def _of_unpainted(material: Material) -> str:
    unpainted = "Every pixel you do not paint has this stiffness; with 0 it is no tissue"
    return unpainted if material.label == 0 else ""


def _about(material: Material) -> str:
    if material.is_rigid:
        return "Moves and turns as one, such as bone or an implant, without changing its shape"
    return _of_unpainted(material) if material.is_deformable else "No tissue, such as air"


#: How the table calls what a boundary does.
_ACTIONS: dict[Action, str] = {"fixed": "fixed", "move": "moves", "expand": "expands"}
_BY_WORD = {word: action for action, word in _ACTIONS.items()}
_ROWS, _COLS, _OUTWARD = range(3, 6)
#: Columns, and the only action that they say something of.
_AMOUNTS: dict[int, Action] = {_ROWS: "move", _COLS: "move", _OUTWARD: "expand"}


class BoundaryTable(LabelTable):
    """Label, name, action, distances and confidence; `rows` are `BoundaryRule`s."""

    def __init__(self, view: Callable[[], View | None]) -> None:
        super().__init__(
            BOUNDARY,
            view,
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
                        partial(self._amount, column),
                        partial(self._typed, column),
                        lambda row: f"in {self._unit}",
                    )
                    for column in _AMOUNTS
                ),
                Column(
                    "confi-\ndence",
                    "How sure this is: from 0, unknown, to 1, certain.\nTwo numbers, such as "
                    "1 / 0.5, for rows and columns apart",
                    lambda row: " / ".join(f"{part:g}" for part in dict.fromkeys(row.confidence)),
                    _sure,
                ),
            ],
            default=default_rule,
            words=lambda row: _ACTIONS[row.action],
        )
        self.show_place("px", Directions())

    def show_place(self, unit: str, ways: Directions) -> None:
        """Say in which unit amounts are, and which way rows and columns run on the screen."""
        self._unit, self._ways = unit, ways
        for column, title, about in (
            (_ROWS, ways.label(0), ways.about(0)),
            (_COLS, ways.label(1), ways.about(1)),
            (_OUTWARD, "out", "How far outward; negative: inward"),
        ):
            words = title.replace(" ", "\n")  # the dock is narrow
            self.set_column(column, title=f"{words}\n{unit}", about=f"{about}, in {unit}")
        self._show(self.contents)

    def _typed(self, column: int, rule: BoundaryRule, text: str) -> BoundaryRule:
        amount = _number(text)
        if not math.isfinite(amount):
            raise ValueError(f"A distance must be a number, in {self._unit}")
        if column == _OUTWARD:
            return replace(rule, amount=amount)
        down, along = self._ways.seen(rule.vector)
        seen = (amount, along) if column == _ROWS else (down, amount)
        return replace(rule, vector=self._ways.along(seen))

    def _amount(self, column: int, rule: BoundaryRule) -> str:
        if rule.action != _AMOUNTS[column]:
            return ""
        if column == _OUTWARD:
            return f"{rule.amount:g}"
        return f"{round(self._ways.seen(rule.vector)[column - _ROWS], 9) + 0.0:g}"


def _sure(rule: BoundaryRule, text: str) -> BoundaryRule:
    parts = [_number(part) for part in text.split("/")]
    if len(parts) > 2 or not all(0 <= part <= 1 for part in parts):
        raise ValueError("Confidence must be a number from 0 to 1, or two: 1 / 0.5")
    return replace(rule, confidence=(parts[0], parts[-1]))


def _number(text: str) -> float:
    """A number as people type it, with a point or a comma; NaN for anything else."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan
