"""Session: the studies of a viewer, with what is chosen, drawn and not saved.

Forms, tools, scripts and files write to the same session, and what is shown follows from it.

The parts of a study have different owners: a drawing belongs to a slice, a table of materials or
rules to a Labels layer, and a choice of layers and the tissue model to an image. Each part is
stored once, and an edit to a part changes the studies of all slices that use the part.
Layers can be any hashable objects; this module does not import napari or Qt.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from psygnal import Signal

from napari_hmrf.field.frame import Frame
from napari_hmrf.solver.model_names import ModelName, Plane
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.uncertain_landmarks import StrainScale
from napari_hmrf.study.edit_history import DEPTH, EditHistory
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.models import (
    SolverDetails,
    details_of,
    family_of,
    optimizer_of,
    prior_of,
)
from napari_hmrf.study.study import Conditions, Study
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.row_table import RowTable
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve

#: Kinds of parts: the drawing and the measured motion of a slice; the tables of a Labels layer; the
#: stiffness curve of an image; the choices for an image; its tissue model; and strokes of napari's
#: brush in a layer.
Kind = Literal[
    "drawing", "measured", "image", "tissue", "boundary", "curve", "choice", "model", "paint"
]
#: Kinds of tables; the table of an image is always empty.
TableKind = Literal["image", "tissue", "boundary"]
#: Value of `ImageChoice.tissue` if stiffness is computed from brightness by the image's curve.
BRIGHTNESS = "brightness"
# Attributes of `ImageChoice` that may be layers.
_LAYER_NAMES = "tissue", "boundary", "confidence", "compare_with"
# Name of the step that changes a choice, by attribute. The first changed attribute in this order
# determines the name. A change to other attributes, such as solver details, is not a step.
_STEP_NAMES = {
    "name": "chose another model",
    "plane": "chose another plane",
    "poisson": "changed Poisson's ratio",
    "strain": "changed the typical strain",
    "drift": "changed the drift",
    "tissue": "chose another source of stiffness",
    "boundary": "chose another boundary",
    "confidence": "chose another confidence",
    "without_border": "changed whether the dark border is tissue",
    **{each.name: each.metadata["step"] for each in fields(Conditions)},
    "extent": "changed between slice and volume",
    "preset": "chose other tissues to paint with",
}


@dataclass(frozen=True)
class Part:
    """Key of a part of the studies; a part is edited as a whole.

    Attributes
    ----------
    kind : Kind
    layer : hashable
        Owner of the part: an image, a Labels layer, or None. The parts of a removed layer are
        dropped.
    plane, index : tuple of int
        Slice of a drawing or of measured motion, as in its `Frame`; empty for other parts.
    slice_name : str
        Displayed name of the slice.
    """

    kind: Kind
    layer: Any
    plane: tuple[int, ...] = ()
    index: tuple[int, ...] = ()
    slice_name: str = field(default="", compare=False)

    @classmethod
    def of_slice(cls, kind: Kind, layer: Any, frame: Frame | None) -> Part:
        """Return the key of a part that belongs to a slice of a layer, or to a volume."""
        if frame is None:
            return cls(kind, layer)
        return cls(kind, layer, frame.plane, frame.index, frame.slice_seen)

    @property
    def title(self) -> str:
        """Name of the layer, with the slice if the layer has several slices."""
        return f"{self.layer.name} {self.slice_name}".strip()


@dataclass(frozen=True)
class ImageChoice(Conditions):
    """Layers and settings that are selected for an image, with the `Conditions` on its tissue.

    Attributes
    ----------
    tissue : layer, "brightness" or None
        Source of the tissue map: labels, an image of stiffness, or the brightness of the image. If
        None, all pixels of the image are tissue.
    boundary : layer or None
        Labels or observed displacements that prescribe the motion.
    confidence : layer, "edges" or None
        Confidence in observed displacements.
    without_border : bool
        True if dark surroundings with label 0 are void.
    hold_edge, weight, cavity
        See `Conditions`.
    extent : {"slice", "volume"}
        Part of the image that is solved.
    compare_with : layer or None
        Second image, to compare and to register.
    preset : Preset or None
        Tissues to paint with if the tissue has no table, as in `Tissue`.
    """

    tissue: Any = None
    boundary: Any = None
    confidence: Any = None
    without_border: bool = True
    hold_edge: bool = True
    extent: str = "slice"
    compare_with: Any = None
    preset: Preset | None = None

    @property
    def is_volume(self) -> bool:
        """True if a whole volume is solved."""
        return self.extent == "volume"

    @property
    def tissue_layer(self) -> Any:
        """Layer that is selected as the tissue map, or None."""
        return None if self.tissue == BRIGHTNESS else self.tissue

    @property
    def layers(self) -> tuple[Any, ...]:
        """Values of the attributes that may be layers."""
        return tuple(getattr(self, name) for name in _LAYER_NAMES)

    def without(self, layer: Hashable) -> ImageChoice:
        """Return the choices with a layer replaced by None."""
        cleared: dict[str, Any] = {
            name: None for name in _LAYER_NAMES if getattr(self, name) is layer
        }
        return replace(self, **cleared)


@dataclass(frozen=True)
class ModelChoice:
    """Selected tissue model and solver settings.

    Attributes
    ----------
    name : ModelName
    plane : {"stress", "strain"}
        Plane stress or plane strain, for elastic slices.
    poisson : float
        Poisson's ratio of tissue without a table.
    details : SolverDetails
        Optional solver settings.
    strain : float
        Typical strain of the tissue, as in `Motion`.
    drift : bool
        True if an affine drift is estimated with uncertain landmarks, as in `Motion`.
    unfolds : bool
        True if large motion takes the place of the elastic model where tissue folds. False for a
        model that the user, a script or a file has chosen.
    """

    name: ModelName = "elastic"
    plane: Plane = "stress"
    poisson: float = USUAL_POISSON
    details: SolverDetails = field(default_factory=SolverDetails)
    strain: float = StrainScale.strain
    drift: bool = False
    unfolds: bool = True

    @classmethod
    def of(cls, study: Study) -> ModelChoice:
        """Return the choice that corresponds to the prior and the optimizer of a study.

        An array of Poisson's ratios is ignored, because it belongs to the tissue map.
        """
        prior, optimizer = study.prior, study.optimizer
        motion, details = study.motion, details_of(prior, optimizer)
        choice = cls(
            family_of(prior, optimizer),
            details=details,
            strain=motion.typical_strain,
            drift=bool(motion.drift),
            unfolds=False,
        )
        if isinstance(prior, Elastic):
            choice = replace(choice, plane=prior.plane)
            if np.ndim(prior.poisson) == 0:
                choice = replace(choice, poisson=float(prior.poisson))
        return choice

    @property
    def before_unfolding(self) -> ModelChoice:
        """The elastic model if large motion has taken its place, else the model itself."""
        return replace(self, name="elastic") if self.has_unfolded else self

    @property
    def has_unfolded(self) -> bool:
        """True if large motion has taken the place of the elastic model."""
        return self.unfolds and self.name == "large motion"

    @property
    def prior(self) -> Prior:
        """Prior of the model, without the Poisson's ratios of labelled tissues."""
        return prior_of(self.name, self.details, self.plane, self.poisson)

    @property
    def optimizer(self) -> ICM | Multigrid:
        """Optimizer of the model."""
        return optimizer_of(self.name, self.details)


@dataclass(frozen=True)
class DisplayChoice:
    """How studies are solved and shown: for all images of the viewer, and without undo steps.

    Attributes
    ----------
    live : bool
        True if every edit updates the result.
    device : str
        Device of the solver, as the argument `backend` of `solve`.
    overlay : str
        Overlay on the image; "nothing" for none.
    in_colours : bool
        True if the second image is shown over the deformed image, both in colours.
    arrows : bool or None
        True if the arrows of results are shown. By default (None), they are shown only for results
        without an image, because they cover it.
    """

    live: bool = True
    device: str = "auto"
    overlay: str = "nothing"
    in_colours: bool = False
    arrows: bool | None = None


class UnsavedWork:
    """Register of slices with unsaved edits, which are identified by their drawings.

    An edit of a part that several slices use, such as a table, counts for the selected slice.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    paths : dict of Part to Path
        Path from which each slice was opened, or to which it was saved.
    saved_files : dict of Part to Path
        Path of the recovery file of each slice.
    noted : Signal()
        Emitted after an edit of a slice.
    """

    noted = Signal()

    def __init__(self, session: Session) -> None:
        self._session = session
        # Values of the edited parts of each slice before their first edit.
        self._before: dict[Part, dict[Part, object]] = {}
        self.paths: dict[Part, Path] = {}
        self.saved_files: dict[Part, Path] = {}
        session.edited.connect(self._on_edited)

    @property
    def slices(self) -> tuple[Part, ...]:
        """Slices with unsaved edits, identified by their drawings."""
        now = {part: self._session.get(part) for part in self._session.parts}
        return tuple(
            here
            for here, edited in self._before.items()
            if here in now and any(part in now and now[part] != edited[part] for part in edited)
        )

    @property
    def removed(self) -> dict[Part, Path]:
        """Path of the recovery file of each slice whose image was removed."""
        now = self._session.parts
        return {part: file for part, file in self.saved_files.items() if part not in now}

    def forget(self, file: Path) -> None:
        """Forget a recovery file of a removed image, which was opened or deleted."""
        for part in [part for part, each in self.removed.items() if each == file]:
            del self.saved_files[part]

    def add(self, here: Part) -> None:
        """Record that a slice is unsaved, even if all edits are undone."""
        self._before.setdefault(here, {})[here] = object()

    def save(self, here: Part) -> None:
        """Record that the edits of a slice were saved or discarded."""
        self._before.pop(here, None)

    def _on_edited(self, part: Part, before: object) -> None:
        others = part.kind == "paint" and part.layer not in self._session.choice.layers
        if part.kind in ("choice", "model") or others:
            return  # easy to choose again, or not part of the study
        here = part if part.kind == "drawing" else self._session.slice
        if here.layer is not None:
            self._before.setdefault(here, {}).setdefault(part, before)
            self.noted.emit()


class Session(EditHistory):
    """Studies of a viewer: their parts, the selected image and slice, and undo.

    `changed` is emitted with the `Part` that has changed, its value, and its previous value.

    Parameters
    ----------
    depth : int
        Largest number of undo steps.

    Attributes
    ----------
    image : hashable or None
        Selected image.
    image_is_gone : bool
        True if the user has removed the image or chosen none; tissue labels alone are then not
        deformed.
    slice : Part
        Key of the drawing of the selected slice; its layer is the layer that is deformed.
    results : dict of hashable to result
        Latest result of each deformed layer; its attribute `moved` is a `Deformation`.
    display : DisplayChoice
    unsaved : UnsavedWork
    selected : Signal(object, object)
        Emitted with the image and the previous image when another image is selected.
    displayed : Signal(DisplayChoice)
        Emitted when the display has changed.
    """

    selected = Signal(object, object)
    displayed = Signal(DisplayChoice)

    def __init__(self, depth: int = DEPTH) -> None:
        super().__init__(depth)
        self.image: Hashable | None = None
        self.image_is_gone = False
        self.slice = Part("drawing", None)
        self._study: Study | None = None
        self.results: dict[Hashable, Any] = {}
        self.display, self.unsaved = DisplayChoice(), UnsavedWork(self)

    # Selection

    def select(self, image: Hashable | None, *, is_gone: bool = False) -> None:
        """Select an image, or None; `is_gone` sets `image_is_gone`."""
        before, self.image = self.image, image
        if image is not before:
            self.image_is_gone = is_gone
            if is_gone:
                self.choose_display(in_colours=False)
            self.selected.emit(image, before)

    def select_slice(self, image: Hashable | None, frame: Frame | None = None) -> None:
        """End any drag in the previous slice, then select the drawing of a slice."""
        if self.drawing_in_progress:
            self.end()
        self.slice = Part.of_slice("drawing", image, frame)
        self.setdefault(self.slice, Drawing())

    # Study and result

    @property
    def study(self) -> Study | None:
        """Study of the selected slice as it was read last, with the current drawing, or None."""
        study, drawing = self._study, self.drawing
        if study is not None and study.motion.drawing is not drawing:
            self._study = study = replace(study, motion=replace(study.motion, drawing=drawing))
        return study

    @study.setter
    def study(self, study: Study | None) -> None:
        self._study = study

    @property
    def result(self) -> Any:
        """Latest result of the deformed layer, or None."""
        return self.results.get(self.slice.layer)

    @property
    def result_here(self) -> Any:
        """Latest result if it belongs to the grid of the study, else None."""
        result = self.result
        return None if result is None or not self.is_here(result.moved.study) else result

    def is_here(self, study: Study) -> bool:
        """Return whether a study is on the grid of the selected study."""
        return self.study is not None and self.study.grid == study.grid

    @property
    def is_fresh(self) -> bool:
        """True if the latest result belongs to the study."""
        result, study = self.result, self.study
        return result is not None and study is not None and bool(result.moved.study.same_as(study))

    def shows(self, study: Study) -> bool:
        """Return whether the latest result belongs to a study, except for the solver's settings."""
        if self.result is None:
            return False
        moved = replace(self.result.moved.study, optimizer=study.optimizer)
        return bool(moved.same_as(study))

    # Display

    def choose_display(self, **changes: Any) -> None:
        """Change attributes of the `display`."""
        now = replace(self.display, **changes)
        if now != self.display:
            self.display = now
            self.displayed.emit(now)

    # Choices

    @property
    def choice(self) -> ImageChoice:
        """Choices for the selected image."""
        choice: ImageChoice = self.get(Part("choice", self.image), ImageChoice())
        return choice

    def choose(self, *, step: bool = True, **changes: Any) -> None:
        """Change attributes of the `choice`.

        Parameters
        ----------
        step : bool
            If True, undo can restore the previous values.
        **changes
            New values of attributes of `ImageChoice`.
        """
        now = replace(self.choice, **changes)
        # Without an image, there would be no choices for undo to restore.
        self._edit(Part("choice", self.image), now, step and self.image is not None)

    @property
    def model(self) -> ModelChoice:
        """Tissue model of the selected image."""
        choice: ModelChoice = self.get(self.model_part, ModelChoice())
        return choice

    @property
    def model_part(self) -> Part:
        """Key of the tissue model of the selected image."""
        return Part("model", self.image)

    def choose_model(self, choice: ModelChoice, *, step: bool = True) -> None:
        """Change the tissue model of the selected image.

        Parameters
        ----------
        choice : ModelChoice
        step : bool
            If True, undo can restore the previous model; a change to solver details alone is not a
            step.
        """
        # Without an image, there would be no model for undo to restore.
        self._edit(self.model_part, choice, step and self.image is not None)

    def unfold(self) -> None:
        """Choose large motion as part of the edit that folds elastic tissue; see `ModelChoice`."""
        self.setdefault(self.model_part, ModelChoice())
        self.join(self.model_part, replace(self.model, name="large motion"))

    def take_back_unfolding(self, *, unfolds: bool) -> None:
        """Choose the elastic model again as part of the last edit.

        Parameters
        ----------
        unfolds : bool
            True if large motion may take its place again; False if it cannot solve the study.
        """
        self.join(self.model_part, replace(self.model, name="elastic", unfolds=unfolds))

    def use_elastic(self) -> None:
        """Choose the elastic model although tissue folds."""
        self.choose_model(replace(self.model, name="elastic", unfolds=False))

    def restore(self, study: Study, layers: Mapping[str, Hashable]) -> None:
        """Select the image and restore the choices of a study, without undo steps.

        The drawing of the study is not restored.

        Parameters
        ----------
        study : Study
        layers : mapping of str to layer
            Layer of each of the parts "image", "tissue", "boundary" and "confidence", and of the
            second image, "second".
        """
        tissue, motion = study.tissue, study.motion
        image = layers.get("image")
        self.select(image)
        if tissue.curve is not None:
            self._set(Part("curve", image), tissue.curve, "", tissue.curve)
        self.choose(
            step=False,
            tissue=layers.get("tissue") if tissue.curve is None else BRIGHTNESS,
            boundary=layers.get("boundary"),
            confidence=layers.get("confidence"),
            without_border=tissue.without_border,
            **motion.conditions,
            extent="volume" if len(study.grid.shape) == 3 else "slice",
            compare_with=layers.get("second"),
            preset=tissue.preset,
        )
        self.choose_model(ModelChoice.of(study), step=False)

    def image_of(self, part: Part) -> Any:
        """Return the image that a part belongs to, or None.

        A layer of several images, such as a tissue layer, belongs to the selected image if that
        image uses the layer.
        """
        if part.kind not in ("tissue", "boundary", "paint"):
            return part.layer
        choices = [self.image, *(each.layer for each in self.parts if each.kind == "choice")]
        for image in choices:
            choice: ImageChoice = self.get(Part("choice", image), ImageChoice())
            if part.layer in choice.layers:
                return image
        return None

    # Tissue and boundary

    def table(self, kind: TableKind, layer: Hashable) -> RowTable[Any] | None:
        """Return the table of a layer, or None if the layer has no table."""
        table: RowTable[Any] | None = self.get(Part(kind, layer))
        return table

    def set_table(
        self, kind: TableKind, layer: Hashable, table: RowTable[Any], word: str = ""
    ) -> None:
        """Change the table of a layer as a step named `word`, or without a step if `word` is ""."""
        self._set(Part(kind, layer), table, word, table)

    @property
    def curve(self) -> StiffnessCurve | None:
        """Stiffness curve of the selected image, even if it is not used; None if there is none."""
        curve: StiffnessCurve | None = self.get(Part("curve", self.image))
        return curve

    def set_curve(self, curve: StiffnessCurve, word: str) -> None:
        """Change the curve of the selected image; all changes until `end` form one step."""
        part = Part("curve", self.image)
        if self.setdefault(part, curve) != curve:
            if self.in_progress != part:
                self.begin(part, word)
            self.update(curve)

    # Drawing

    @property
    def drawing(self) -> Drawing:
        """Drawing of the selected slice, including an edit in progress."""
        drawing: Drawing = self.get(self.slice, Drawing())
        return drawing

    @property
    def drawing_in_progress(self) -> bool:
        """True if an edit to the selected drawing is in progress."""
        return self.in_progress == self.slice

    def draw(self, drawing: Drawing, word: str) -> None:
        """Change the drawing as a step named `word`, or without a step if `word` is ""."""
        self._set(self.slice, drawing, word, Drawing())

    def begin_drawing(self, word: str) -> None:
        """Begin a drag; all its changes form one step."""
        self.setdefault(self.slice, Drawing())
        self.begin(self.slice, word)

    def update_drawing(self, drawing: Drawing) -> None:
        """Change the drawing during a drag.

        Raises
        ------
        RuntimeError
            If no drag of the selected drawing is in progress.
        """
        if not self.drawing_in_progress:
            raise RuntimeError("no edit is in progress; call begin_drawing() first, or use draw()")
        self.update(drawing)

    def end_drawing(self, word: str = "") -> str:
        """End the drag, if any; return the name of its step, or "" if there is no step.

        `word` names the step; by default, the step has the name that the drag began with.
        """
        step = self.end(word) if self.drawing_in_progress else None
        return "" if step is None else step.word

    def cancel_drawing(self) -> None:
        """Cancel the drag, if any, and restore the drawing to its state before the drag."""
        if self.drawing_in_progress:
            self.cancel()

    # Measured motion

    @property
    def measured_part(self) -> Part:
        """Key of the measured motion of the selected slice."""
        return replace(self.slice, kind="measured")

    def set_measured(self, measured: MeasuredMotion | None) -> None:
        """Change the measured motion of the selected slice, without a step."""
        self._set(self.measured_part, measured, "", None)

    def register(self, part: Part, measured: MeasuredMotion) -> None:
        """Set the measured motion of a slice and release the edge of its image, as one step.

        A model that large motion has replaced is elastic again, as for the registration.

        Parameters
        ----------
        part : Part
            `measured_part` of the slice.
        measured : MeasuredMotion
            Result of a registration.
        """
        chosen, model = Part("choice", part.layer), Part("model", part.layer)
        self.setdefault(part, None)
        free = replace(self.setdefault(chosen, ImageChoice()), hold_edge=False)
        if any(each.frees_edge for each in self._measured_beside(part)):
            measured = replace(measured, frees_edge=True)
        values = {part: measured, chosen: free}
        if model in self.parts:
            values[model] = self.get(model).before_unfolding
        self.do_all(values, "registered the images")

    def unregister(self, part: Part, word: str, values: Mapping[Part, Any] | None = None) -> None:
        """Remove the measured motion of a slice as a step named `word`.

        The edge of the image is held again if a registration has freed it, once no other slice is
        registered; see `Motion.unmeasured`.

        Parameters
        ----------
        part : Part
            `measured_part` of the slice.
        word : str
        values : mapping of Part to value, optional
            Other parts that the step changes.
        """
        measured, chosen = self.get(part), Part("choice", part.layer)
        changed: dict[Part, Any] = {**(values or {}), part: None}
        if measured.frees_edge and not self._measured_beside(part):
            changed[chosen] = replace(self.get(chosen), hold_edge=True)
        self.do_all(changed, word)

    def _measured_beside(self, part: Part) -> list[MeasuredMotion]:
        """Return the measured motion of the other slices of an image."""
        others = [each for each in self.parts if each.kind == "measured" and each != part]
        every = [self.get(each) for each in others if each.layer is part.layer]
        return [each for each in every if each is not None]

    # Common

    def reset(self) -> None:
        """Remove the drawing and the registration, and restore the default settings, as one step.

        The chosen layers and their tables are kept. With a boundary layer, so is whether the edge
        is fixed; without one, it is fixed, as for a new image.
        """
        choice, measured = self.choice, self.get(self.measured_part)
        edge = ImageChoice.hold_edge
        if choice.boundary is not None:
            edge = choice.hold_edge or (measured is not None and measured.frees_edge)
        conditions = {**ImageChoice().conditions, "hold_edge": edge}
        default = replace(choice, without_border=True, preset=None, **conditions)
        usual: dict[Part, Any] = {
            self.slice: Drawing(),
            Part("choice", self.image): default,
            self.model_part: ModelChoice(),
            self.measured_part: None,
        }
        for part, value in usual.items():
            self.setdefault(part, value)
        self.do_all(usual, "reset the study")

    def remove(self, layer: Hashable) -> None:
        """Drop the parts of a removed layer, and remove the layer from all choices."""
        if layer is self.choice.compare_with:
            self.choose_display(in_colours=False)
        if layer is self.image:
            self.select(None, is_gone=True)
        self.results.pop(layer, None)
        self.drop(lambda part: part.layer is layer)
        for part in self.parts:
            if part.kind == "choice":
                choice: ImageChoice = self.get(part)
                self.amend(part, choice.without(layer))

    def _edit(self, part: Part, now: ImageChoice | ModelChoice, step: bool) -> None:
        before = self.setdefault(part, type(now)())
        changed = [each.name for each in fields(now) if _differ(before, now, each.name)]
        word = next((_STEP_NAMES[name] for name in _STEP_NAMES if name in changed), "")
        if not (step and word):
            self._change_earlier(part, before, now, changed)
        self._set(part, now, word if step else "", before)

    def _change_earlier(self, part: Part, before: Any, now: Any, changed: list[str]) -> None:
        """Apply a change that cannot be undone on its own to all states of a part in the history.

        Undo then preserves the change. A state that has another value of a changed attribute is not
        changed.
        """
        for steps in (self._past, self._future):
            for number, step in enumerate(steps):
                if (value := step.values.get(part)) is not None:
                    names = [each for each in changed if not _differ(value, before, each)]
                    same = {name: getattr(now, name) for name in names}
                    values = {**step.values, part: replace(value, **same)}
                    steps[number] = step._replace(values=values)

    def _set(self, part: Part, value: Any, word: str, usual: Any) -> None:
        """Set a part that had the `usual` value so far, if it had none; without a word, no step."""
        self.setdefault(part, usual)
        if word:
            self.do(part, value, word)
        else:
            self.amend(part, value)


def _differ(one: Any, other: Any, name: str) -> bool:
    return bool(getattr(one, name) != getattr(other, name))
