"""What a label means that no table mentions yet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

UNPAINTED = "everything unpainted"
_STIFFNESS = 20.0


def default_material(label: int, known: Iterable[Material]) -> Material:
    """A new tissue behaves as the first known one that is not rigid, until told otherwise."""
    name = UNPAINTED if label == 0 else f"tissue {label}"
    first = next((material for material in known if material.is_deformable), None)
    if first is None:
        return Material(label, name, _STIFFNESS)
    return replace(first, label=label, name=name)


def default_rule(label: int) -> BoundaryRule:
    """A new boundary stays where it is, until told otherwise."""
    return BoundaryRule(label, "fixed", name=f"boundary {label}")
