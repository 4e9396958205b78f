"""Changes to single numbers in a study, for parameter sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from napari_hmrf.checks import Growth, Number, Poisson, Stiffness
from napari_hmrf.errors import HmrfError
from napari_hmrf.solver.priors import Elastic
from napari_hmrf.study.models import parts_of
from napari_hmrf.study.study import Study, Tissue
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    default_material,
    unlisted,
)
from napari_hmrf.tissue.tissue_names import lookup_tissue

#: Type of each property of tissues and boundaries that can be changed.
NUMBERS = {"growth": Growth, "stiffness": Stiffness, "poisson": Poisson, "amount": Number}


class Change(NamedTuple):
    """Change to one number in a study, or to its model.

    Attributes
    ----------
    what : {"growth", "stiffness", "poisson", "amount", "model"}
        Changed property.
    value : float, tuple of float or str
        New value, as in a `Material` or `BoundaryRule`. For the actions "expand", "slide"
        and "press", "amount" is the distance or the pressure; for other actions, it is the length
        of the vector.
    of : str
        Label or name of a tissue or boundary; for a tissue, also the name of the known tissue that
        matches its name; "" for all tissue.
    """

    what: str
    value: Any
    of: str = ""


def changed(study: Study, changes: Iterable[Change]) -> Study:
    """Return a copy of a study with changed numbers.

    Raises
    ------
    HmrfError
        If a tissue or boundary does not exist, or its property cannot be changed.
    """
    for change in changes:
        study = _changed(study, change)
    return study


def _changed(study: Study, change: Change) -> Study:
    if change.what == "model":
        prior, optimizer = parts_of(change.value)
        return replace(study, prior=prior, optimizer=optimizer)
    if change.what == "poisson" and not isinstance(study.prior, Elastic):
        raise HmrfError("poisson requires elastic tissue: the paper's model has no Poisson's ratio")
    if change.what == "amount":
        motion = study.motion
        rules = _edited(motion.rules, change, lambda rule: _with_amount(rule, change.value))
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
    """Return tissue with the same Poisson's ratio for all labels, also without a table."""
    if tissue.labels is None:
        return tissue
    known = tissue.materials
    added = [default_material(label, ()) for label in unlisted(tissue.labels, ()) if not known]
    return replace(tissue, materials=tuple(replace(row, poisson=ratio) for row in (*known, *added)))


def _edited(rows: Sequence[Any], change: Change, edit: Callable[[Any], Any]) -> tuple[Any, ...]:
    """Return the rows of a table, after applying `edit` to the rows that a change refers to."""
    matching = _matching_rows(rows, change.of)
    if not matching:
        kind = "boundary" if change.what == "amount" else "tissue"
        known = ", ".join(f"{row.label} {row.name}".strip() for row in rows) or "none"
        raise HmrfError(
            f"{change.what}:{change.of}: there is no such {kind}. Use one of these: {known}"
        )
    return tuple(edit(row) if row in matching else row for row in rows)


def _matching_rows(rows: Sequence[Any], of: str) -> list[Any]:
    """Return the rows that match a label, or else a name, or else a known tissue's name."""
    name = of.casefold()
    if not of:
        return list(rows)
    for matches in (
        lambda row: str(row.label) == name,
        lambda row: row.name.casefold() == name,
        lambda row: isinstance(row, Material) and _tissue_name(row) == name,
    ):
        if matching := [row for row in rows if matches(row)]:
            return matching
    return []


def _tissue_name(row: Material) -> str:
    tissue = lookup_tissue(row.name)
    return tissue.name if tissue is not None else ""


def _with_amount(rule: BoundaryRule, amount: float) -> BoundaryRule:
    if rule.action in ("expand", "press", "slide"):
        return replace(rule, amount=amount)
    length = math.hypot(*rule.vector)
    if not length:
        raise HmrfError(
            f"amount:{rule.name or rule.label}: the boundary does not move, so it has no "
            "direction. Give row and col in the table of rules."
        )
    return replace(rule, vector=tuple(step * amount / length for step in rule.vector))
