"""Messages of the dock about results, and hints before the first result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.errors import ConvergenceError, HmrfError, in_words
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.units import as_seen, unit_symbol
from napari_hmrf.layers.result_layers import CompleteResult, Outputs
from napari_hmrf.notes import Note, kind_of, short_of
from napari_hmrf.real_arrays import sites_in_words
from napari_hmrf.results.animation import FOLD_MARKS
from napari_hmrf.solver import live_solver
from napari_hmrf.solver.caveats import LOOSE
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.solver.model_names import ModelName, Plane
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.optimizers.base import Reach
from napari_hmrf.study.landmark_data import uncertain_landmarks
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.study.support import can_unfold
from napari_hmrf.ui.window_words import in_window_words

#: Labels of the button and of the menu entry that solve from a cold start, without and with *Live*.
DEFORM, PRECISELY = "Deform", "Solve precisely"
#: Tooltip of both.
ABOUT_PRECISELY = (
    "Compute the motion of the tissue from scratch, to the tolerance. If this stops before the "
    "tissue is fully there, the earlier result is kept."
)
#: The button or entry in a message; see `with_button`.
BUTTON = "[Deform]"
#: Kinds of messages: tissue does not move, and a file was saved.
NO_MOTION, SAVED = "no motion", "saved"

WELCOME = "Open an image first (File > Open), or a sample (File > Open Sample)."
CHOOSE = "Choose an image above, or open one (File > Open)."
READY = f"Press {BUTTON}."
STILL = Note("Nothing moves yet: choose a tool, then drag or paint tissue.", kind=NO_MOTION)
PAINT = "Paint in {}: click a row of a table, then paint with its label."
CURVE = "First guess: brighter tissue is stiffer. Drag the points of the curve to change it."
MEANWHILE = "The deformed image is hidden while you paint."
CHANGED = f"The inputs have changed since the last result. Press {BUTTON}."
CANCELLED = "Cancelled; nothing was changed."
#: Clause about a result in large motion that nobody has chosen.
UNFOLDED = ", in large motion, because it would fold in the elastic model"
#: Message if large motion cannot take the place of the elastic model.
ELASTIC_AGAIN = "The elastic model is used again, because large motion failed: {}"
STAYS = "The last result is still shown."
#: Message after a solve from a cold start that used up its budget.
KEPT_RESULT = (
    "Kept the earlier result: to solve from scratch, choose a larger 'largest work' under "
    "'Advanced'."
)
BEHIND = (
    "Cancelled: the picture and the warnings do not include the last edits. "
    f"Press {BUTTON} to update them."
)
#: Messages about a result that is missing, or that lacks an input.
LOST = (
    f"To restore the result, press {BUTTON} or pull tissue: its layer '{{layer}}' was deleted. "
    "To hide arrows, untick 'arrows' instead."
)
FROM_A_FILE = (
    "A result file does not contain the input stiffness, motion and confidence. "
    f"Press {BUTTON} to solve again."
)
NOT_CHOSEN = "'{}' was not chosen, because another image is in use. To use it, choose it above."
#: Message if a new image becomes the image, although another image is in use.
NEW_IMAGE = "'{}' is now the image to deform. To go on with '{}', choose it above."
#: Message if a new image becomes the second image.
SECOND = (
    "Press 'Register' to move the tissue until '{0}' looks like '{1}', the second image. Or pull "
    "tissue by hand."
)
#: Question before a reset.
RESET = (
    "Remove all marks of '{}' and restore the default settings? Layers and tables are kept. Undo "
    "restores everything."
)
WAS_RESET = "Removed all marks and restored the default settings. Press Undo to restore them."
_NO_IMAGE = "No image is chosen. Choose an image above to see its result."
_PAINT_HIDDEN = "Tissue hidden while pulling: {}. To show a layer, click its eye icon."
_HIDDEN = "Hidden to make '{}' visible: {}. Click the eye icon of a layer to show the layer again."
PAINT_HIDDEN = (
    "Hidden over the deformed image, because paint does not move with it: {}. To paint in a layer, "
    "select it in the layer list."
)
PAINT_SHOWN = "'{0}' belongs to the undeformed image, shown now. To see the result, hide '{0}'."
EDGE_GOES = (
    "The outer edge is no longer fixed, because '{}' sets the motion. Tick 'Fix outer edge' to "
    "fix the parts of the edge that the layer does not cover."
)
#: Messages about the data that is lost with a deleted layer.
DRAWING_GONE = "'{name}' was deleted with the drawing on it. napari cannot restore a deleted layer."
DRAWING_KEPT = "'{name}' was deleted. Its drawing is kept: 'Open it' above restores both."
DRAWING_SAVED = (
    "'{name}' was deleted. Its drawing is saved in '{file}': to restore it, open the file."
)
TISSUE_GONE = (
    "'{name}' was deleted with its stiffness values. napari cannot restore a deleted layer."
)
BOUNDARY_GONE = (
    "'{name}' was deleted: it no longer holds or moves tissue. napari cannot restore a deleted "
    "layer."
)

MODELS: dict[ModelName, str] = {
    "elastic": "elastic: finite elements",
    "large motion": "large motion: never folds",
    "paper": "paper: 70 sweeps per level",
    "paper, converged": "paper, converged",
}
#: Labels of the button that offers another model.
OFFER = "Use large motion"
#: Label of the button that takes this choice back.
BACK = "Use elastic"
#: Label of the button that continues a solve that used up its budget.
CONTINUE = "Continue"
#: Tooltips of these buttons.
ABOUT_OFFERS = {
    "": "",
    OFFER: "Solve with the model 'large motion', in which tissue never folds",
    BACK: "Solve with the model 'elastic', in which tissue folds; large motion has taken its place",
    CONTINUE: "Continue from this result; this sets a larger 'largest work' under 'Advanced'",
}
PLANES: dict[Plane, str] = {"stress": "free to bulge", "strain": "held at its faces"}
#: Prefixes of progress messages that are shown to the user unchanged.
_SHOWN = ("waiting for", "drawing the", "sample")
_WARNINGS = {
    "folds": "the tissue folds over itself, which real tissue cannot do. Move the tissue less; far "
    "from held tissue, a wider patch or boundary also helps.",
    "overlaps": "one part of the tissue has moved onto another part and hides it. The model does "
    "not include contact across a gap.",
}
#: Advice in addition to the warning about folds, if landmarks have an uncertainty.
_UNSURE_FOLDS = (
    "A landmark with an uncertainty (±) moves a single point: with a larger ±, tissue folds less; "
    "at ± 0, a patch moves as a whole."
)
#: Message after the view has moved to another slice of a volume.
MOST = "The view has moved to the slice with the most such voxels: {}."
# Smallest part of a motion that is told of tissue that stays short of its target.
_SOME_PART = 0.01
#: Largest number of marked sites that counts as rounding noise and causes no warning.
HANDFUL = 5


def no_image(*, has_layers: bool) -> str:
    """Return what to do if no image is chosen, in a viewer with or without layers."""
    return CHOOSE if has_layers else WELCOME


def with_button(text: str, is_live: bool) -> str:
    """Return a message with the button, or with *Live* the entry, that solves from a cold start."""
    return text.replace(BUTTON, f"'{PRECISELY}' under 'More'" if is_live else DEFORM)


def report(done: CompleteResult, *, unfolded: bool = False) -> str:
    """Describe the largest displacement and the drift, and whether an earlier result was kept.

    If `unfolded` is True, say that large motion has taken the place of the elastic model.
    """
    place, solution = done.moved.study.grid.known_place, done.outputs.solution
    largest = as_seen(float(magnitude(solution.displacement).max()), solution.spacing)
    if not largest:
        return STILL
    slice_name = place.slice_seen.replace("slice", "Slice")
    where = f"{slice_name}: tissue" if slice_name else "Tissue"
    unit = unit_symbol(place.unit)
    why = UNFOLDED if unfolded else ""
    short = _short_of_target(solution.reach, unit)
    moved = f"{where} moved up to {largest:.3g} {unit}{why}.{short}"
    moved = " ".join((moved, *map(_sentence, drift_clauses(solution))))
    is_kept = done.moved.settled and done.moved.is_earlier
    return f"{moved} {KEPT_RESULT}" if is_kept else moved


def _short_of_target(reach: Reach | None, unit: str) -> str:
    """Describe how far tissue stays short of its target, and what to do; "" if it does not."""
    if reach is None or reach.where is None:
        return ""
    remedy = f"press '{CONTINUE}'" if reach.stopped else "see the warning"
    way = f", after {reach.part:.0%} of its way" if reach.part >= _SOME_PART else ""
    return (
        f" Some tissue stays up to {reach.missing:.3g} {unit} short of its target{way}: {remedy}."
    )


def warnings_of(done: CompleteResult, overlay: str) -> tuple[str, str]:
    """Return the warnings of a result, and the label of the chip while `overlay` is shown."""
    counts, ndim = marks_of(done.outputs), len(done.moved.study.grid.shape)
    parts = [
        f"Warning: at {sites_in_words(number, ndim)} {_WARNINGS[mark]}"
        for mark, number in counts.items()
    ]
    if "folds" in counts and uncertain_landmarks(done.moved.study.motion.drawing):
        parts.append(_UNSURE_FOLDS)
    parts += map(_sentence, done.notes)
    if not counts:
        return " ".join(parts), _label(short_of(done.notes[0])) if done.notes else ""
    word, count = next(iter(counts.items()))
    label = f"Hide the {word}" if overlay == FOLD_MARKS else f"{count} {word}: show"
    return " ".join(parts), label


def offer_of(done: CompleteResult | None, model: ModelChoice) -> str:
    """Return the label of the button for the latest result while a model is chosen, or "".

    It offers more work for a solve that used up its budget, large motion if tissue folds, or the
    elastic model if large motion has taken its place.
    """
    if done is None:
        return ""
    study, solution = done.moved.study, done.moved.solution
    if model.name == "large motion":
        if solution is not None and live_solver.has_stopped(solution):
            return CONTINUE
        return BACK if model.unfolds else ""
    return OFFER if "folds" in marks_of(done.outputs) and can_unfold(study) else ""


def marks_of(outputs: Outputs) -> dict[str, int]:
    """Count the folds and the overlaps, and omit those that are only noise."""
    return {mark: number for mark in _WARNINGS if (number := getattr(outputs, mark)) > HANDFUL}


def unheld_warning(notes: Sequence[str]) -> str:
    """Return the note about unconstrained tissue as a sentence, or ""."""
    return next((_sentence(note) for note in notes if kind_of(note) == LOOSE), "")


def _sentence(clause: str) -> str:
    return f"{_label(clause)}."


def _label(clause: str) -> str:
    words = in_window_words(clause)
    return f"{words[0].upper()}{words[1:]}"


def in_short(error: Exception) -> str:
    """Explain in one or two sentences why there is no result."""
    if isinstance(error, ConvergenceError):
        return in_window_words(f"No result: {str(error).rstrip('.')}.")
    if isinstance(error, HmrfError | ValueError | OSError):
        return in_window_words(in_words(error))
    return f"The deformation failed: {type(error).__name__}: {error}"


def progress(monitor: Monitor, work: str = "Deforming") -> str:
    """Describe the progress in plain words; `monitor` has the technical description."""
    if monitor.message.startswith(PREPARING):
        return f"{_label(monitor.message)}, then {work.lower()}."
    if monitor.message.startswith(_SHOWN):
        return f"{work}: {monitor.message}."
    percent = min(round(100 * monitor.fraction), 99)  # the solve has not ended yet
    return f"{work} ... {percent} %" if percent > 0 else f"{work} ..."


def describe_hidden_paint(hidden: Sequence[Any]) -> str:
    """Return a message about painted layers that were hidden when a tool was chosen."""
    return _PAINT_HIDDEN.format(", ".join(f"'{layer.name}'" for layer in hidden))


def describe_image_choice(image: Any, hidden: Sequence[Any]) -> str:
    """Return a message if no image is chosen or if layers are hidden for the image, else ""."""
    names = ", ".join(f"'{layer.name}'" for layer in hidden)
    return _NO_IMAGE if image is None else names and _HIDDEN.format(image.name, names)
