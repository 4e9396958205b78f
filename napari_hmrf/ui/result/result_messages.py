"""Messages about a result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from napari_hmrf.field.comparison import Comparison
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.units import as_seen
from napari_hmrf.layers.result_layers import Name, PlacedSolution

NO_RESULT = "There is no result to look at yet: drag tissue, or press Deform."
LOST = (
    "The result was in the layer '{layer}', which was deleted. Press Deform, or pull again, to "
    "create it again. To hide arrows, click the eye of their layer."
)
NO_IMAGE = (
    "There is no image on the pixels of this result, so none can be moved. Open the image it was "
    "made from; the arrows, and the choices of 'show', work without it."
)
NO_FORCES = (
    "Forces are known of elastic tissue and of large motion, while the result is worked on: press "
    "Deform. The paper's model and files of results have none."
)
NOTHING: str = "nothing"
SAVING = "Saving pictures ..."
FULL = 100
_UPRIGHT = Directions()

_ABOUT: dict[Name, str] = {
    "magnitude": "how far ({unit})",
    "jacobian": "Jacobian",
    "equivalent": "strain: equivalent",
    "stretch": "strain: largest stretch",
    "squeeze": "strain: largest squeeze",
    "rows": "strain: {rows}",
    "columns": "strain: {columns}",
    "shear": "strain: shear",
    "grid": "grid",
    "labels": "tissue labels",
    "difference": "from the reference ({unit})",
    "folds": "folds",
    "overlaps": "overlaps",
    "stiffness": "given: stiffness",
    "observed": "given: motion",
    "confidence": "given: confidence",
}
_FROM_A_FILE = (
    "The given stiffness, motion and confidence are not in the file of a result. Press Deform to "
    "solve again."
)
#: Reasons why a requested overlay may have nothing to show.
LACKING: dict[Name, str] = {
    "labels": "No labels of tissue have moved with this result.",
    "folds": "The tissue folds nowhere.",
    "overlaps": "No part of the tissue has moved onto another.",
    **dict.fromkeys(("stiffness", "observed", "confidence"), _FROM_A_FILE),
}
OVERLAY_TIP = (
    "Overlay on the image that moves with the tissue; its values belong to the visible tissue.\n"
    "Jacobian: by which factor its area changes; purple shrinks, orange grows, yellow folds.\n"
    "Strain: elastic, without growth, in per cent, squeeze below 0; equivalent: von Mises's, in\n"
    "all three directions. The paper's model has total strain, within the image.\n"
    "Given motion begins where tissue was before it moved; a dot: where it is held."
)


def overlay_choices(
    unit: str, ways: Directions = _UPRIGHT, compared: bool = False
) -> list[tuple[str, str]]:
    """Return pairs of label and name of all overlays; `compared` adds the difference."""
    rows, columns = (
        f"{ways.both(axis)} ({name})" if ways.both(axis) else f"along {name}"
        for axis, name in enumerate(("rows", "columns"))
    )
    words = {"unit": unit, "rows": rows, "columns": columns}
    offered = {name: said for name, said in _ABOUT.items() if compared or name != "difference"}
    return [(NOTHING, NOTHING), *((said.format(**words), name) for name, said in offered.items())]


def how_far(
    result: PlacedSolution, longest: float, percent: int, compared: Comparison | None = None
) -> str:
    """Describe the displayed deformation, its slice, and its difference from a reference."""
    far = as_seen(longest * percent / FULL, result.solution.spacing)
    where = f" in {result.frame.slice_seen}" if result.frame.slice_seen else ""
    moved = f"{percent} %: tissue moved up to {far:.3g} {result.unit}{where}"
    if compared is None:
        return moved
    return f"{moved}. {compared.in_words(result.solution, result.unit)}"


def saved(paths: Sequence[Path]) -> str:
    """Report the names and the folder of written pictures."""
    return f"Saved in {paths[0].parent}: {', '.join(path.name for path in paths)}."
