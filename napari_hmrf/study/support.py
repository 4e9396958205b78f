"""Which model supports which input of a study, and which analysis of a result.

This is the only place that decides it for studies: the Python API, the shell and the window ask
here before they solve, offer or refuse anything. The solver checks a `Problem` by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache.loops import are_compiled
from napari_hmrf.compute.compile_cache.sets import LARGE_IMAGES, LARGE_VOLUMES
from napari_hmrf.errors import LayerError, ProblemError
from napari_hmrf.solver.model_names import ELASTIC, ModelName
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.study.landmark_data import uncertain_landmarks
from napari_hmrf.study.models import family_of, parts_of
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing

#: Analyses of a study that only some models support.
Analysis = Literal["registration", "fit", "uncertainty"]

_LINEAR: tuple[ModelName, ...] = ("elastic",)
# Models that support each analysis, and the analysis in a sentence.
_ANALYSES: dict[Analysis, tuple[tuple[ModelName, ...], str]] = {
    "registration": (_LINEAR, "a registration"),
    "fit": (ELASTIC, "a fit"),
    "uncertainty": (_LINEAR, "an uncertainty"),
}
_LOADS = {
    "tissue": "has growth",
    "boundary": "has forces",
    "weight": "is a force",
    "cavity": "has forces",
}
# Largest number of sites that large motion solves within minutes, with the first pictures within
# seconds.
_MOST_SITES = 2_000_000
_USE_ELASTIC = "the elastic model (`model='elastic'`)"


class _Content(NamedTuple):
    """Study whose inputs are examined, with its current drawing and tissue labels."""

    study: Study
    drawing: Drawing
    labels: npt.NDArray[Any] | None
    slides: bool


class _Found(NamedTuple):
    """Part of a study with an input, in the words of `Study.named`, and a clause about it."""

    parts: tuple[str, ...]
    clause: str


@dataclass(frozen=True)
class _Input:
    """Input that some models do not support.

    Attributes
    ----------
    find : callable
        Function that returns where a study has this input; None if it has none.
    models : tuple of ModelName
        Models that support the input.
    remedy : str
        What to change in the input, as an alternative to another model.
    is_exact : bool
        True if constraints must be exact in large motion.
    """

    find: Callable[[_Content], _Found | None]
    models: tuple[ModelName, ...]
    remedy: str
    is_exact: bool = False


def _sliding_surface(content: _Content) -> _Found | None:
    if not content.slides:
        return None
    by_label = any(rule.action == "slide" for rule in content.study.motion.rules)
    return _Found(("boundary" if by_label else "drawing",), "has tissue that slides")


def _sliding_tissue(content: _Content) -> _Found | None:
    rows = [row for row in content.study.tissue.materials if row.slides and row.stiffness > 0]
    names = _painted(rows, content.labels)
    if not names:
        return None
    return _Found(("tissue", "image"), f"has tissue that slides along other tissue ({names})")


def _sliding_with_rigid_tissue(content: _Content) -> _Found | None:
    slides, rigid = _sliding_tissue(content), _rigid_tissue(content)
    if slides is None or rigid is None:
        return None
    return _Found(slides.parts, f"{rigid.clause} beside tissue that slides along other tissue")


def _loads(content: _Content) -> _Found | None:
    loaded = content.study.loaded_parts
    if not loaded:
        return None
    parts = ("tissue", "image") if loaded[0] == "tissue" else loaded[:1]
    return _Found(parts, _LOADS[loaded[0]])


def _rigid_tissue(content: _Content) -> _Found | None:
    tissue = content.study.tissue
    names = _painted([row for row in tissue.materials if row.is_rigid], content.labels)
    if tissue.stiffness is not None and (tissue.stiffness == np.inf).any():
        names = "an infinite stiffness"
    return _Found(("tissue", "image"), f"has rigid tissue ({names})") if names else None


def _uncertain_landmarks(content: _Content) -> _Found | None:
    count = len(uncertain_landmarks(content.drawing))
    if not count:
        return None
    pairs = "a landmark" if count == 1 else f"{count} landmarks"
    return _Found(("drawing",), f"has {pairs} with an uncertainty (±)")


def _drift(content: _Content) -> _Found | None:
    found = _uncertain_landmarks(content)
    if found is None or not content.study.motion.drift:
        return None
    return _Found(found.parts, "has landmarks with an affine drift")


def _measured_motion(content: _Content) -> _Found | None:
    is_measured = content.study.motion.measured is not None
    return _Found(("registration",), "measures the motion") if is_measured else None


# The cliques of the paper have no stress that could balance a load, and no unit that data could be
# compared with. The direction of a sliding surface is that at rest, which large motion turns. The
# contact of sliding tissue in large motion follows neither rigid bodies nor observations that slip.
# A drift costs no energy at small strain only.
_INPUTS = (
    _Input(_sliding_surface, _LINEAR, "remove the sliding surface"),
    _Input(_sliding_tissue, ELASTIC, "let no tissue slide (`slides=False`)", is_exact=True),
    _Input(_sliding_with_rigid_tissue, _LINEAR, "let no tissue slide (`slides=False`)"),
    _Input(_loads, ELASTIC, "a boundary that moves or expands"),
    _Input(_rigid_tissue, ELASTIC, "use a finite stiffness", is_exact=True),
    _Input(_uncertain_landmarks, ELASTIC, "set ± to 0 (`sd=0`)"),
    _Input(_drift, _LINEAR, "estimate no drift (`drift=False`)"),
    _Input(_measured_motion, ELASTIC, "undo the registration (`measured=None`)"),
)


def _painted(rows: list[Any], labels: npt.NDArray[Any] | None) -> str:
    """Return the names of the tissues of a table that occur in an image of labels."""
    here = [row for row in rows if labels is not None and (labels == row.label).any()]
    return " and ".join(f"'{row.name or row.label}'" for row in here)


def unsupported(
    study: Study,
    model: tuple[Prior, Optimizer] | None = None,
    *,
    drawing: Drawing | None = None,
    labels: npt.NDArray[Any] | None = None,
    slides: bool | None = None,
) -> LayerError | None:
    """Return an error for the first input of a study that a model does not support.

    Parameters
    ----------
    study : Study
    model : (Prior, Optimizer), optional
        By default, the model of the study.
    drawing : Drawing, optional
        By default, the drawing of the study.
    labels : ndarray of int, shape ([D,] H, W), optional
        Tissue labels with brush strokes; by default, the labels of the study.
    slides : bool, optional
        True if tissue slides along a label or a stroke; by default, as in the study.

    Returns
    -------
    LayerError or None
        Error that names the part of the study and suggests a remedy; None if the model supports
        the study.
    """
    prior, optimizer = model or (study.prior, study.optimizer)
    content = _Content(
        study,
        study.motion.drawing if drawing is None else drawing,
        study.tissue.labels if labels is None else labels,
        study.slides if slides is None else slides,
    )
    name = family_of(prior, optimizer)
    can_slip = isinstance(prior, NeoHookeanPrior) and prior.penalty not in (None, math.inf)
    for each in _INPUTS:
        slipping = each.is_exact and can_slip
        if name in each.models and not slipping:
            continue
        found = each.find(content)
        if found is not None:
            by = f"the model '{name}'{' with boundaries that may slip' if slipping else ''}"
            return LayerError(
                study.named(*found.parts),
                f"{found.clause}, which {by} does not support. Use {_USE_ELASTIC}, or "
                f"{each.remedy}.",
            )
    return None


def refuse_unsupported(study: Study, **content: Any) -> None:
    """Raise the error of `unsupported`, which also describes the parameters.

    Raises
    ------
    LayerError
        If the model of the study does not support one of its inputs.
    """
    error = unsupported(study, **content)
    if error is not None:
        raise error


def can_unfold(study: Study) -> bool:
    """Return whether large motion can solve an elastic study, so that no tissue folds."""
    is_elastic = family_of(study.prior, study.optimizer) == "elastic"
    return is_elastic and unsupported(study, parts_of("large motion")) is None


def unfolds_quickly(study: Study) -> bool:
    """Return whether large motion may take the place of the elastic model without a question.

    On a new computer, it must be prepared: the user would wait for a picture otherwise. Tissue that
    slides along other tissue takes minutes.
    """
    shape = study.grid.shape
    is_small = math.prod(shape) <= _MOST_SITES
    is_prepared = are_compiled(LARGE_VOLUMES if len(shape) == 3 else LARGE_IMAGES)
    slides = any(row.slides for row in study.tissue.materials)
    return is_small and is_prepared and not slides and can_unfold(study)


def supports(model: ModelName, analysis: Analysis) -> bool:
    """Return whether an analysis is available for a model."""
    return model in _ANALYSES[analysis][0]


def refuse_model(study: Study, analysis: Analysis) -> None:
    """Raise an error if an analysis is not available for the model of a study.

    Raises
    ------
    ProblemError
        If the model does not support the analysis.
    """
    name = family_of(study.prior, study.optimizer)
    models, described = _ANALYSES[analysis]
    if name not in models:
        use = " or ".join(f"'{each}'" for each in models)
        raise ProblemError(
            "model", f"is '{name}', for which {described} is not available. Use {use}."
        )


def refuse_sliding_parts(study: Study, problem: Problem, analysis: Analysis) -> None:
    """Raise an error if tissue slides along other tissue, which no analysis supports.

    Raises
    ------
    LayerError
        If the problem of the study has sliding parts.
    """
    if problem.sliding is not None:
        raise LayerError(
            study.named("tissue", "image"),
            "has tissue that slides along other tissue, for which "
            f"{_ANALYSES[analysis][1]} is not available. Let no tissue slide (`slides=False`).",
        )
