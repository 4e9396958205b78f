"""What the widget says about a result, and while there is none yet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from napari_hmrf.errors import ConvergenceError, HmrfError
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.units import as_seen, unit_symbol
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, role_of, rows_of
from napari_hmrf.solver.model_names import ModelName, in_words, is_multigrid
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.study.study import Study
from napari_hmrf.ui.follower import Done

WELCOME = "Open an image first (File > Open), or a sample (File > Open Sample)."
CHOOSE = "Choose an image above, or open one (File > Open)."
READY = "Press Deform."
STILL = "Nothing moves yet: take a tool and drag tissue, or paint what moves."
PAINT = (
    "Paint tissues in 'Tissue' and what holds or moves in 'Boundary': click a row of a table, then "
    "paint with its label."
)
CURVE = "A first guess: the brighter, the stiffer. Drag the points of the curve."
MEANWHILE = "What was deformed is hidden while you paint."
CHANGED = "Changed since the last result: press Deform."
OTHER_SLICE = "Another slice than the one deformed: press Deform to deform this one."
CANCELLED = "Cancelled; nothing was changed."
STAYS = "The last result stays."
COMPILING = "getting ready, as for the first time on this machine: some seconds."

MODELS: dict[ModelName, str] = {
    "elastic": "elastic: as finite elements",
    "paper": "paper's: 70 sweeps per level",
    "paper, converged": "paper's, computed to the end",
}
PLANES: dict[Plane, str] = {
    "stress": "free to bulge",
    "strain": "held at its faces",
}
# The figures are those of the README, by `make benchmarks`: on two cores, without a GPU.
_WHEN: dict[ModelName, str] = {
    "elastic": "Tissue stretches and bulges as elastic material does. Boundaries are held exactly.",
    "paper": "The paper's own results. It stops a little early; squeezed tissue does not bulge.",
    "paper, converged": "The paper's model, computed to the end. Squeezed tissue does not bulge.",
}
_OFF: dict[ModelName, float] = {"elastic": 0.0002, "paper": 1.03, "paper, converged": 0.23}
_FROM_FEM = (
    "Where the sample brain moves by 7.4 px, it is {} px from finite elements, the engineers' "
    "standard, of Poisson's ratio 0.3 (0.02 s)."
)
_WHEN_PLANE: dict[Plane, str] = {
    "stress": "Squeezed tissue can bulge out of the image, as in a thin cut.",
    "strain": "Squeezed tissue can give way only within the image, as deep in a body.",
}
_HOW_MUCH = (
    "Try both choices: their fields differ by a few per cent to more than half of the movement. "
    "They differ most where Poisson's ratio is near 0.5."
)
ABOUT_POISSON = (
    "How much tissue bulges when it is squeezed: 0, not at all; 0.499, so much that it loses "
    "hardly any volume.\n0.45 is common for soft tissue."
)
ELASTIC = "Take the elastic model"

#: What people can do something about, or have to wait for.
_WAITS = ("waiting for", "compiling", "starting to compile")
#: So few folded pixels are noise of the rounding, and nothing to warn of.
HANDFUL = 5


def when_to_take(model: ModelName, plane: Plane) -> str:
    """What a choice is good for, and what was measured of it."""
    said = f"{_WHEN[model]} {_FROM_FEM.format(_OFF[model])}"
    return f"{said} {_WHEN_PLANE[plane]} {_HOW_MUCH}" if model == "elastic" else said


def cannot_be_rigid(names: Sequence[str]) -> str:
    """Why the paper's model does not go with rigid tissues of these names; "" if there are none."""
    if not names:
        return ""
    which, isare = " and ".join(f"'{name}'" for name in names), "is" if len(names) == 1 else "are"
    return (
        f"{which} {isare} rigid, which the paper's model cannot have: it compares stiffness by "
        "ratios. Take the elastic model, or give a number in the table."
    )


def report(done: Done) -> str:
    """What came out, in a sentence."""
    place = done.moved.study.grid.place
    seen = place.slice_seen.replace("slice", "Slice")
    where = f"{seen}: tissue" if seen else "Tissue"
    solution = done.outputs.solution
    if not as_seen(float(np.abs(solution.displacement).max()), solution.spacing):
        return STILL
    return f"{where} moved up to {_farthest(done)}."


def warnings_of(done: Done) -> tuple[str, str]:
    """What to beware of, in sentences and in a few words; "" if nothing."""
    outputs, parts, short = done.outputs, list[str](), ""
    if outputs.folds > HANDFUL:
        short = f"Folds at {outputs.folds} pixels: show where"
        parts.append(
            f"Warning: at {outputs.folds} pixels the tissue is pushed through itself (it folds), "
            f"which no tissue does. {_less(done.moved.study)}."
        )
    if outputs.overlaps > HANDFUL:
        short = short or f"Overlaps at {outputs.overlaps} pixels"
        parts.append(
            f"Warning: at {outputs.overlaps} pixels one part of the tissue has moved onto another "
            "and hides it; parts do not feel each other across a gap."
        )
    parts += map(sentence_of, done.notes)
    if len(parts) > 1:
        short = f"{len(parts)} warnings" + (": show where" if short.startswith("Folds") else "")
    return " ".join(parts), short


def sentence_of(clause: str) -> str:
    """A clause as a sentence of its own."""
    return f"{clause[0].upper()}{clause[1:]}."


def _less(study: Study) -> str:
    """What keeps tissue from folding, of what there is to change."""
    motion = study.motion
    painted = motion.observed is not None or (motion.labels is not None and motion.labels.any())
    if motion.drawing.marks and not painted:
        return "Move it less; far from all that is held take a larger patch, near it a smaller one"
    return "Let it move less or over a wider boundary"


def in_short(error: Exception) -> str:
    """Why there is no result, as one sentence or two."""
    if isinstance(error, ConvergenceError):
        return f"No result: {str(error).rstrip('.')}."
    if isinstance(error, HmrfError | ValueError):
        return str(error)
    return f"The deformation failed: {type(error).__name__}: {error}"


def details(done: Done) -> str:
    """What ran, how long and how well; for those who want to know."""
    solution = done.outputs.solution
    run = solution.provenance
    seconds = f"{run.seconds:.2g} s"
    if run.preparation_seconds >= 0.1:
        seconds += f" (after {run.preparation_seconds:.1f} s of preparation)"
    count = done.outputs.folds
    folds = f", {count} folded pixel{'s' if count > 1 else ''}" if count else ""
    turn = "cycle" if is_multigrid(run.parameters) else "sweep"
    turns = turn if solution.iterations == 1 else f"{turn}s"
    model, reached = in_words(run.parameters), solution.convergence
    near = "" if reached is None else f", within {reached.error:.1g} px of the converged field"
    return (
        f"{model[0].upper()}{model[1:]}: {solution.iterations} {turns} in {seconds}{near}, on "
        f"{run.renderer}; mean energy {solution.mean_energy:.3g} px²{folds}."
    )


def brief(done: Done) -> str:
    """The model, how far tissue moved and how long that took, in a line."""
    run = done.outputs.solution.provenance
    time = f"{1000 * run.seconds:.0f} ms" if run.seconds < 1 else f"{run.seconds:.2g} s"
    return f"{run.model}: moved up to {_farthest(done)} in {time}"


def removed(layer: Any) -> str:
    """Why nothing is computed any more."""
    return f"Cancelled: '{layer.name}' was removed."


def painting(layer: Any) -> str:
    """What is painted with from now on, by its name in the table if it has one."""
    label, role = int(layer.selected_label), role_of(layer)
    rows = rows_of(layer, role) if role in (TISSUE, BOUNDARY) else ()
    name = next((row.name for row in rows if row.label == label), "")
    what = f"'{name}' (label {label})" if name else f"label {label}"
    return f"Painting {what} in '{layer.name}'."


def progress(monitor: Monitor, seconds: float, what: str = "Deforming") -> str:
    """How far the work is after so many seconds, in words for all; `monitor` has the others."""
    if monitor.message.startswith(_WAITS):
        return f"{what}: {monitor.message}."
    if monitor.message.startswith("preparing") and seconds >= 1:
        return f"{what}: {COMPILING}"
    percent = round(100 * monitor.fraction)
    return f"{what}: {percent} %" if percent else f"{what} ..."


def _farthest(done: Done) -> str:
    """The longest displacement, in the unit of the image; in pixels, too, if they are square."""
    solution = done.outputs.solution
    length = as_seen(float(magnitude(solution.displacement).max()), solution.spacing)
    unit, size = unit_symbol(done.moved.study.grid.place.unit), solution.spacing[0]
    if any(other != size for other in solution.spacing):
        return f"{length:.3g} {unit}"
    pixels = f"{length / size:.1f} px"
    return pixels if unit == "px" and size == 1 else f"{pixels} ({length:.3g} {unit})"


def saved_study(name: str, solved: bool) -> str:
    """Of a study's file."""
    return f"Saved {name}{'' if solved else ', without a field: press Deform to have one'}."
