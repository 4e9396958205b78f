"""What a label means that no table mentions yet."""

from __future__ import annotations

from collections.abc import Iterable

from napari_hmrf.annotation import BoundaryRule, Material

UNPAINTED = "everything unpainted"
_STIFFNESS = 20.0


def default_material(label: int, known: Iterable[Material]) -> Material:
    """A new tissue behaves as the first known one, until told otherwise."""
    stiff = [material.stiffness for material in known if material.stiffness > 0]
    name = UNPAINTED if label == 0 else f"tissue {label}"
    return Material(label, name, stiff[0] if stiff else _STIFFNESS)


def default_rule(label: int) -> BoundaryRule:
    """A new boundary stays where it is, until told otherwise."""
    return BoundaryRule(label, "fixed", name=f"boundary {label}")
