"""One study, with another number in it: what a sweep over parameters changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from napari_hmrf.errors import HmrfError
from napari_hmrf.io.tissue_names import known_tissue
from napari_hmrf.solver.priors import Elastic
from napari_hmrf.study.models import chosen
from napari_hmrf.study.study import Study, Tissue
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    default_material,
    unlisted,
)

#: What can be changed of a tissue, and of a boundary.
OF_TISSUES = "growth", "stiffness", "poisson"
OF_BOUNDARIES = ("amount",)


class Change(NamedTuple):
    """One number of a study, or its model.

    Attributes
    ----------
    what : {"growth", "stiffness", "poisson", "amount", "model"}
    value : float, tuple of float or str
        As a `Material` or a `BoundaryRule` has it. An amount is how far the boundary expands, or
        how strongly it is pressed; of what moves or is pulled it is the length of the vector.
    of : str
        The label of a tissue or a boundary, or its name, or the name of a known tissue that it is
        called after; "" is all tissue.
    """

    what: str
    value: Any
    of: str = ""


def changed(study: Study, changes: Iterable[Change]) -> Study:
    """A study with other numbers.

    Raises
    ------
    HmrfError
        If it has no such tissue or boundary, or the change means nothing to it.
    """
    for change in changes:
        study = _changed(study, change)
    return study


def _changed(study: Study, change: Change) -> Study:
    if change.what == "model":
        prior, optimizer = chosen(change.value)
        return replace(study, prior=prior, optimizer=optimizer)
    if change.what == "poisson" and not isinstance(study.prior, Elastic):
        raise HmrfError("poisson is for elastic tissue: the paper's has no Poisson's ratio")
    if change.what in OF_BOUNDARIES:
        motion = study.motion
        rules = _edited(motion.rules, change, lambda rule: _moved_by(rule, change.value))
        return replace(study, motion=replace(motion, rules=rules))
    if not change.of and study.tissue.labels is None:
        return replace(study, prior=replace(study.prior, poisson=change.value))
    if not change.of and change.what == "poisson":
        return replace(study, tissue=with_ratio(study.tissue, change.value))
    rows = _edited(
        study.tissue.materials, change, lambda row: replace(row, **{change.what: change.value})
    )
    return replace(study, tissue=replace(study.tissue, materials=rows))


def with_ratio(tissue: Tissue, ratio: float) -> Tissue:
    """Return tissue by labels that has one Poisson's ratio, also where a label has no row."""
    if tissue.labels is None:
        return tissue
    known = tissue.materials
    added = [default_material(label, known) for label in unlisted(tissue.labels, known)]
    return replace(tissue, materials=tuple(replace(row, poisson=ratio) for row in (*known, *added)))


def _edited(rows: Sequence[Any], change: Change, edit: Callable[[Any], Any]) -> tuple[Any, ...]:
    """The rows of a table, of which those that a change speaks of are edited."""
    meant = _meant(rows, change.of)
    if not meant:
        kind = "boundary" if change.what in OF_BOUNDARIES else "tissue"
        known = ", ".join(f"{row.label} {row.name}".strip() for row in rows) or "none"
        raise HmrfError(f"{change.what}:{change.of}: there is no such {kind}. There is: {known}")
    return tuple(edit(row) if row in meant else row for row in rows)


def _meant(rows: Sequence[Any], of: str) -> list[Any]:
    """The rows of a label, else of a name, else those that are called after a known tissue."""
    wanted = of.casefold()
    if not of:
        return list(rows)
    for means in (
        lambda row: str(row.label) == wanted,
        lambda row: row.name.casefold() == wanted,
        lambda row: isinstance(row, Material) and _tissue_name(row) == wanted,
    ):
        if found := [row for row in rows if means(row)]:
            return found
    return []


def _tissue_name(row: Material) -> str:
    tissue = known_tissue(row.name)
    return tissue.name if tissue is not None else ""


def _moved_by(rule: BoundaryRule, amount: float) -> BoundaryRule:
    if rule.action in ("expand", "press"):
        return replace(rule, amount=amount)
    length = math.hypot(*rule.vector)
    if not length:
        raise HmrfError(
            f"amount:{rule.name or rule.label}: the boundary does not move, so that there is no "
            "way for it to go. Give it row and col in the table of rules."
        )
    return replace(rule, vector=tuple(step * amount / length for step in rule.vector))
