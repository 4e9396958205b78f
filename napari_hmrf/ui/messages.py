"""What the widget says about a result, and while there is none yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from napari_hmrf.errors import ConvergenceError, HmrfError, in_words
from napari_hmrf.field.animation import MARKS, Mark
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.units import as_seen, unit_symbol
from napari_hmrf.layers.result_layers import Outputs
from napari_hmrf.solver.caveats import LOOSE
from napari_hmrf.solver.model_names import ModelName
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.ui.follower import Done
from napari_hmrf.wording import in_words_of

WELCOME = "Open an image first (File > Open), or a sample (File > Open Sample)."
CHOOSE = "Choose an image above, or open one (File > Open)."
READY = "Press Deform."
STILL = "Nothing moves yet: take a tool and drag tissue, or paint what moves."
PAINT = "Paint in {}: click a row of a table, then paint with its label."
CURVE = "A first guess: the brighter, the stiffer. Drag the points of the curve."
MEANWHILE = "What was deformed is hidden while you paint."
CHANGED = "Changed since the last result: press Deform."
CANCELLED = "Cancelled; nothing was changed."
STAYS = "The last result stays."
BEHIND = "Cancelled: picture and warnings lack what was edited since: press Deform, or go on."
NOT_CHOSEN = "'{}' is not chosen, as work has begun on another image: choose it above to go over."
_NO_IMAGE = "No image is chosen. What came of the last one is seen again when you choose it."
_HIDDEN = "Hidden, to show '{}': {}. Click an eye in the list of layers to see that again."
EDGE_GOES = (
    "The edge is held no more, as '{}' says how tissue moves: tick 'hold the edge of the tissue' "
    "to hold what of it that leaves out."
)
#: What goes with a layer that was deleted.
DRAWING_GONE = "'{name}' is gone, and what was drawn on it: napari brings no layer back."
TISSUE_GONE = "'{name}' is gone, with all it said of stiffness: napari brings no layer back."
BOUNDARY_GONE = "'{name}' is gone: it holds and moves nothing any more. napari brings none back."

MODELS: dict[ModelName, str] = {
    "elastic": "elastic: as finite elements",
    "large motion": "large motion: never folds",
    "paper": "paper's: 70 sweeps per level",
    "paper, converged": "paper's, computed to the end",
}
#: What another model is offered for.
OFFERS: dict[ModelName, str] = {
    "large motion": "Take large motion, which never folds",
    "elastic": "Take the elastic model",
}
PLANES: dict[Plane, str] = {"stress": "free to bulge", "strain": "held at its faces"}
#: What people can do something about, or have to wait for.
_WAITS = ("waiting for", "compiling", "starting to compile")
_WARNINGS: dict[Mark, str] = {
    "folds": "the tissue is pushed through itself (it folds), which no tissue does. Move it less; "
    "far from all that is held also by a wider patch or boundary.",
    "overlaps": "one part of the tissue has moved onto another and hides it; parts do not feel "
    "each other across a gap.",
}
#: Where a volume is seen now.
MOST = "The slice that is seen now has most of them: {}."
#: So few folded pixels are noise of the rounding, and nothing to warn of.
HANDFUL = 5


def report(done: Done) -> str:
    """What came out, in a sentence."""
    place, solution = done.moved.study.grid.known_place, done.outputs.solution
    far = as_seen(float(magnitude(solution.displacement).max()), solution.spacing)
    if not far:
        return STILL
    seen = place.slice_seen.replace("slice", "Slice")
    where = f"{seen}: tissue" if seen else "Tissue"
    return f"{where} moved up to {far:.3g} {unit_symbol(place.unit)}."


def warnings_of(done: Done, seen: str) -> tuple[str, str]:
    """What to beware of, in sentences; and what a click shows after what is `seen`, in short."""
    sites = "voxels" if len(done.moved.study.grid.shape) == 3 else "pixels"
    found = marks_of(done.outputs)
    parts = [f"Warning: at {number} {sites} {_WARNINGS[mark]}" for mark, number in found.items()]
    parts += map(_sentence, done.notes)
    if (mark := next_mark(done.outputs, seen)) is not None:
        return " ".join(parts), f"{mark.capitalize()} at {found[mark]} {sites}: show where"
    return " ".join(parts), f"Hide the {seen}" if seen in found else ""


def can_unfold(done: Done) -> bool:
    """Whether tissue folds that would not in large motion."""
    flat = len(done.moved.study.grid.shape) == 2
    return flat and "folds" in marks_of(done.outputs) and done.moved.study.model_name == "elastic"


def marks_of(outputs: Outputs) -> dict[Mark, int]:
    """At how many sites tissue does what is to be marked; of what is noise, nothing."""
    return {mark: number for mark in MARKS if (number := getattr(outputs, mark)) > HANDFUL}


def loose(notes: Sequence[str]) -> str:
    """That nothing holds the tissue, in a sentence; "" if none of the notes says so."""
    return next((_sentence(note) for note in notes if note.startswith(LOOSE)), "")


def _sentence(clause: str) -> str:
    said = in_words_of("window", clause)
    return f"{said[0].upper()}{said[1:]}."


def next_mark(outputs: Outputs, seen: str) -> Mark | None:
    """What is marked after what is seen: folds, then overlaps, then neither."""
    marks = [*marks_of(outputs)]
    return next(iter(marks[marks.index(seen) + 1 :] if seen in marks else marks), None)


def in_short(error: Exception) -> str:
    """Why there is no result, as one sentence or two."""
    if isinstance(error, ConvergenceError):
        return in_words_of("window", f"No result: {str(error).rstrip('.')}.")
    if isinstance(error, HmrfError | ValueError | OSError):
        return in_words_of("window", in_words(error))
    return f"The deformation failed: {type(error).__name__}: {error}"


def progress(monitor: Monitor, what: str = "Deforming") -> str:
    """How far the work is, in words for all; `monitor` has the others."""
    if monitor.message.startswith(_WAITS):
        return f"{what}: {monitor.message}."
    percent = round(100 * monitor.fraction)  # once it is solved, it has to be drawn
    return f"{what}: {percent} %" if 0 < percent < 100 else f"{what} ..."


def chosen(image: Any, hidden: Sequence[Any]) -> str:
    """What became of the picture when an image was chosen, or none; "" if no layer was hidden."""
    names = ", ".join(f"'{layer.name}'" for layer in hidden)
    return _NO_IMAGE if image is None else names and _HIDDEN.format(image.name, names)


def saved_study(name: str, solved: bool, pairs: str) -> str:
    """Of a study's file, and of a layer with pairs that are not in it."""
    apart = f" Landmarks of '{pairs}' are not in it: press 'Take as landmarks'." if pairs else ""
    return f"Saved {name}{'' if solved else ', without a field: press Deform to have one'}.{apart}"
