"""Fit of the tissues of a study to a second image, a measured field or landmarks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.fit import Fit, FittedProperty, fit
from napari_hmrf.registration.result import agreement_in_words
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.study import Motion, Study
from napari_hmrf.study.support import refuse_model, refuse_sliding_parts
from napari_hmrf.tissue.boundary_rules import BoundaryRule


@dataclass(frozen=True, eq=False)
class StudyFit:
    """Study whose tissues have the properties that explain a measured motion.

    Attributes
    ----------
    study : Study
        The study with the fitted properties in its materials and loads, and without measured
        motion.
    fit : Fit
    """

    study: Study
    fit: Fit

    def __repr__(self) -> str:
        return f"StudyFit({'; '.join(self.described()) or 'nothing'})"

    @property
    def agreement(self) -> str:
        """Agreement of the images before and after the motion, in words; "" without images."""
        before, after = self.fit.similarity_before, self.fit.similarity
        return "" if before is None or after is None else agreement_in_words(before, after)

    def described(self) -> tuple[str, ...]:
        """Describe each property with its interval of 95 %, as clauses for the user."""
        names = {row.label: row.name for row in self.study.tissue.materials}
        clauses = []
        for subject, values, factor, unit in (
            ("growth", self.fit.growth, 100.0, "%"),
            ("stiffness", self.fit.stiffness, 1.0, self.study.tissue.unit),
            ("Poisson's ratio", self.fit.poisson, 1.0, ""),
        ):
            for label, value in values.items():
                name = names.get(label) or f"label {label}"
                words = f"{subject} of '{name}': {value_in_words(value, factor)} {unit}"
                clauses.append(words.rstrip())
        if self.fit.load is not None:
            clauses.append(f"factor on the forces: {value_in_words(self.fit.load)}")
        return tuple(clauses)


def fit_study(
    study: Study,
    second: SecondPicture | None = None,
    *,
    measured: npt.ArrayLike | None = None,
    sd: npt.ArrayLike | None = None,
    stiffness: Iterable[int] = (),
    growth: Iterable[int] = (),
    poisson: Iterable[int] = (),
    load: bool = False,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> StudyFit:
    """Find the properties of the tissues of a study with which it moves as measured.

    The motion is measured by a second image; by a displacement field; or by the landmarks of the
    drawing that have a standard deviation. Held and pulled tissue, forces and known growth of the
    study have their effect. A registration of the study has none: its result contains the stiffness
    that was assumed.

    Parameters
    ----------
    study : Study
        Study with tissue labels, and with the elastic model or large motion. The values of its
        materials are the initial values.
    second : SecondPicture, optional
        Image of the tissue after the motion, on the grid of the study, which has an image, too.
    measured, sd : array_like, optional
        Measured displacement in the unit of the grid, and its standard deviation, as for `fit`.
    stiffness, growth, poisson : iterable of int
        Tissue labels whose stiffness, growth strain or Poisson's ratio is fitted.
    load : bool
        True to fit a factor on all forces of the study: weight, pressure, traction and the contents
        of a cavity.
    backend, progress, cancel
        As for `solve`.

    Returns
    -------
    StudyFit

    Raises
    ------
    ProblemError
        If a part of the study is invalid, nothing is measured or fitted, or the measured motion
        does not determine a property.
    ArgumentError, ConvergenceError, Cancelled
        As for `fit`.
    """
    if study.tissue.labels is None:
        raise ProblemError(
            study.named("tissue", "image"),
            "has no labels, so there are no tissues to fit. Paint the tissues as labels.",
        )
    if study.slides:
        raise ProblemError(
            study.named("drawing"),
            "has tissue that slides, which a fit does not support. Remove the sliding surface.",
        )
    refuse_model(study, "fit")
    bare = replace(study, motion=study.motion.unmeasured)
    stated = Ground.of(bare).statement()
    refuse_sliding_parts(study, stated.problem, "fit")
    images, landmarks = None, None
    if second is None and measured is None:
        landmarks = stated.problem.landmarks
        if landmarks is None:
            raise ProblemError(
                "second image",
                "is missing. A fit needs a second image, a measured field, or landmarks with a "
                "standard deviation.",
            )
    if second is not None:
        image = study.intensities
        if image is None:
            raise ProblemError("image", "is missing. Choose the image before the motion.")
        images = np.asarray(image, np.float32), np.where(second.known, second.pixels, np.nan)
    with study.naming():
        found = fit(
            stated.problem,
            study.tissue.labels if stated.labels is None else stated.labels,
            measured=measured,
            sd=sd,
            landmarks=landmarks,
            images=images,
            stiffness=stiffness,
            growth=growth,
            poisson=poisson,
            load=load,
            prior=stated.prior,
            backend=backend,
            progress=progress,
            cancel=cancel,
        )
    return StudyFit(_with_properties(bare, found), found)


def _with_properties(study: Study, found: Fit) -> Study:
    """Return a study with the fitted properties, rounded to less than their uncertainty."""
    tissue, motion = study.tissue, study.motion
    rows = []
    for row in tissue.materials:
        changes: dict[str, Any] = {
            name: _rounded(values[row.label])
            for name in ("stiffness", "growth", "poisson")
            if row.label in (values := getattr(found, name))
        }
        rows.append(replace(row, **changes))
    if found.load is not None:
        motion = _scaled(motion, _rounded(found.load))
    return replace(study, tissue=replace(tissue, materials=tuple(rows)), motion=motion)


def _scaled(motion: Motion, factor: float) -> Motion:
    """Return motion with all forces multiplied by a factor."""

    def scaled(rule: BoundaryRule) -> BoundaryRule:
        if rule.action == "press":
            return replace(rule, amount=factor * rule.amount)
        if rule.action == "pull":
            return replace(rule, vector=tuple(factor * part for part in rule.vector))
        return rule

    weight = tuple(factor * part for part in motion.weight)
    # The direction of a fluid's weight is that of the tissue, which a negative factor reverses.
    old = motion.cavity
    cavity = replace(old, pressure=factor * old.pressure, fluid=abs(factor) * old.fluid)
    rules = tuple(map(scaled, motion.rules))
    return replace(motion, weight=weight, rules=rules, cavity=cavity)


def _digits(value: FittedProperty, factor: float = 1.0) -> int:
    """Return the number of decimals of a value with an error of a few percent of its interval."""
    low, high = value.interval
    return max(0, math.ceil(-math.log10(max(factor * (high - low), 1e-12))) + 1)


def _rounded(value: FittedProperty) -> float:
    return round(value.value, _digits(value) + 1)


def value_in_words(value: FittedProperty, factor: float = 1.0) -> str:
    """Format a value and its interval, times a factor: "40.0 (39.9 to 40.1)"."""
    digits = _digits(value, factor)
    low, high = value.interval
    words = [f"{factor * each:.{digits}f}" for each in (value.value, low, high)]
    return "{} ({} to {})".format(*words)
