"""Messages about the result and its overlays."""

from __future__ import annotations

from napari_hmrf.field.directions import Directions
from napari_hmrf.layers.result_layers import Name, PlacedSolution
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.ui import messages

NO_RESULT = "There is no result yet: pull tissue to get one."
NO_IMAGE = (
    "Open the image of this result to deform it: no image is on its pixel grid. The arrows and "
    "'overlay' need no image."
)
BURIED = (
    "This result is one slice, which is hidden inside the volume in the 3D view. Press napari's "
    "2D/3D button to see it."
)
#: Progress while an overlay is drawn, which cannot be cancelled.
DRAWING_OVERLAY = Monitor("drawing the overlay", 1.0)
ESTIMATING = "Estimating the uncertainty"
#: Messages about an estimate that was cancelled, or that is not possible.
NOT_ESTIMATED = "The uncertainty was not estimated."
NO_UNCERTAINTY = "Only results of the elastic model, solved in this session, have it."
#: Value of the overlay menu without an overlay, and its text.
NOTHING: str = "nothing"
_NONE = "none"
FULL = 100
_UPRIGHT = Directions()

_ABOUT: dict[Name, str] = {
    "magnitude": "displacement ({unit})",
    "jacobian": "{size} change",
    "equivalent": "strain: equivalent",
    "stretch": "strain: maximum stretch",
    "squeeze": "strain: maximum compression",
    "rows": "strain: {rows}",
    "columns": "strain: {columns}",
    "shear": "strain: shear",
    "von_mises": "stress: von Mises",
    "pressure": "stress: pressure",
    "grid": "grid",
    "labels": "tissue labels",
    "difference": "difference from known field ({unit})",
    "uncertainty": "uncertainty ({unit})",
    "folds": "folds and overlaps",
    "stiffness": "input: stiffness",
    "observed": "input: motion",
    "confidence": "input: confidence",
}
# Text of the overlay of a result without error bars.
_NO_BARS = "uncertainty (not of this result)"
#: Reasons why a requested overlay may be empty.
LACKING: dict[Name, str] = {
    "labels": "This result has no tissue labels.",
    **dict.fromkeys(("von_mises", "pressure"), "Stress needs the elastic model or large motion."),
    "folds": "The tissue does not fold, and no part of it has moved onto another part.",
    **dict.fromkeys(("stiffness", "observed", "confidence"), messages.FROM_A_FILE),
}
OVERLAY_TIP = (
    "Overlay on the image that moves with the tissue; its values belong to the visible tissue.\n"
    "Area change, volume change: ratio of sizes. Purple: shrinks, orange: grows, blue: folds.\n"
    "Strain: elastic strain in %, without the growth typed in the tissue table. Tissue grown with\n"
    "the wheel or with 'Grow' is stretched, which is strain. Negative: compression. Equivalent:\n"
    "von Mises strain in all three directions. Paper's model: total strain within the image.\n"
    "Uncertainty: standard deviation of the mean displacement of the patch around each point.\n"
    "Input motion: lines start at the undeformed tissue; a dot marks tissue that is held."
)


def overlay_choices(
    unit: str,
    ways: Directions = _UPRIGHT,
    *,
    has_bars: bool = True,
    compared: bool = False,
) -> list[tuple[str, str]]:
    """Return (label, name) pairs for all overlays.

    Parameters
    ----------
    unit : str
        Unit of lengths.
    ways : Directions
        Names of the directions along the axes.
    has_bars : bool
        True if the uncertainty of the result can be estimated.
    compared : bool
        True to add the difference.
    """
    rows, columns = (
        f"{ways.both(axis)} ({name})" if ways.both(axis) else f"along {name}"
        for axis, name in enumerate(("rows", "columns"))
    )
    size = "volume" if len(ways.order) == 3 else "area"
    words = {"unit": unit, "size": size, "rows": rows, "columns": columns}
    about = _ABOUT if has_bars else {**_ABOUT, "uncertainty": _NO_BARS}
    offered = {name: said for name, said in about.items() if compared or name != "difference"}
    return [(_NONE, NOTHING), *((said.format(**words), name) for name, said in offered.items())]


def least_sure(answer: PlacedSolution, estimated: Uncertainty) -> str:
    """Return a message about the patch with the longest error bar, where a landmark helps most."""
    # Without air, which is tissue of the problem only.
    site = estimated.least_sure(where=answer.solution.tissue)
    place = ", ".join(str(index) for index in site)
    longest = f"± {estimated.along[site]:.2g} {answer.unit}"
    return f"Least sure: {longest} at pixel ({place}). One more landmark helps most there."
