"""Values of the dock that scripts read and set."""

from __future__ import annotations

from operator import attrgetter
from typing import Any, Generic, TypeVar, overload

from napari_hmrf.layers.slice_view import Sides
from napari_hmrf.results.comparison import Comparison
from napari_hmrf.solver.model_names import ModelName, Plane
from napari_hmrf.study.models import SolverDetails
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.unsaved import Prompt
from napari_hmrf.ui.viewer_dock import Dock

_T = TypeVar("_T")


class _Shown(Generic[_T]):
    """Attribute of the dock that shows an attribute of one of its parts.

    Parameters
    ----------
    path : str
        Place of the attribute, from the dock.
    about : str
        Docstring.
    """

    def __init__(self, path: str, about: str) -> None:
        self._part, _, self._attribute = path.rpartition(".")
        self._get = attrgetter(path)
        self._name, self.__doc__ = "", about

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, dock: None, owner: type) -> _Shown[_T]: ...

    @overload
    def __get__(self, dock: Dock, owner: type) -> _T: ...

    def __get__(self, dock: Dock | None, owner: type) -> _Shown[_T] | _T:
        if dock is None:
            return self
        value: _T = self._get(dock)
        return value

    def __set__(self, dock: Dock, value: _T) -> None:
        raise AttributeError(f"{self._name!r} cannot be set")


class _Chosen(_Shown[_T]):
    """Attribute of the dock that shows and sets an attribute of one of its parts."""

    def __set__(self, dock: Dock, value: _T) -> None:
        setattr(attrgetter(self._part)(dock), self._attribute, value)


class DockValues(Dock):
    """Dock widget with typed attributes for all values that a user can see or choose."""

    image = _Chosen[Any](
        "_form.image.value",
        "Image to deform; if None, only the motion of painted tissue is shown.",
    )
    extent = _Chosen[str](
        "_form.extent.value",
        'Extent of the deformation: "slice" (the visible slice alone) or "volume".',
    )
    tissue = _Chosen[Any](
        "_form.tissue.choice.value",
        'Labels layer, stiffness image or "brightness"; if None, the whole image is tissue.',
    )
    boundary = _Chosen[Any](
        "_form.motion.boundary.choice.value",
        "Labels layer of fixed and moved regions, Vectors layer of displacements, or None.",
    )
    confidence = _Chosen[Any](
        "_form.motion.boundary.confidence.value",
        'Confidence of the Vectors layer: image, Labels layer or "edges"; None means 1.',
    )
    materials = _Chosen[tuple[Material, ...]](
        "_form.tissue.table.rows",
        "Materials of the tissue labels, one row for each label.",
    )
    rules = _Chosen[tuple[BoundaryRule, ...]](
        "_form.motion.boundary.table.rows",
        "Rules of the boundary labels, one row for each label.",
    )
    curve = _Chosen[StiffnessCurve | None](
        "_binding.curve",
        "Curve that maps intensity to stiffness, or None if no curve defines the tissue.",
    )
    hold_edge = _Chosen[bool](
        "_form.motion.switches.hold_edge.value",
        "True if the outer edge of the tissue is fixed.",
    )
    weight = _Chosen[tuple[float, ...]](
        "_form.motion.weight.value",
        "Body force per unit volume on all tissue, along each axis; () if there is no force.",
    )
    cavity = _Chosen[Cavity](
        "_form.motion.cavity.value",
        "Pressure and fluid that act where tissue is removed.",
    )
    without_border = _Chosen[bool](
        "_form.tissue.border.value",
        "True if the dark, unpainted border of the image is excluded from the tissue.",
    )
    model = _Chosen[ModelName](
        "_form.model.model.value",
        'Tissue model; setting "paper" also sets `settings` to the settings of the paper.',
    )
    unfolds = _Chosen[bool](
        "_form.model.unfolds.value",
        "True if large motion takes the place of the elastic model where tissue folds; setting "
        "`model` to another model makes it False.",
    )
    plane = _Chosen[Plane](
        "_form.model.plane.value",
        'Plane assumption of the elastic model: "stress" or "strain".',
    )
    poisson = _Chosen[float](
        "_form.model.poisson.value",
        "Poisson's ratio of elastic tissue without labels; for labels, see `materials`.",
    )
    settings = _Chosen[SolverDetails](
        "_form.model.in_detail.details",
        "Immutable solver settings; to change them, assign `replace(dock.settings, sweeps=7)`.",
    )
    device = _Chosen[str](
        "_form.model.in_detail.device.value",
        "Device of the solver for all images, as the argument `backend` of `solve`.",
    )
    result = _Chosen[Any](
        "_view.arrows",
        "Vectors layer of the displayed (newest or last selected) result, or None.",
    )
    percent = _Chosen[int](
        "_form.result.slider.value",
        "Displayed fraction of the deformation in percent, from 0 to 100.",
    )
    before = _Chosen[bool](
        "_view.before",
        "True if the undeformed image is shown instead of the result.",
    )
    reference = _Chosen[Any](
        "_form.result.reference.value",
        "Field or other result that the displayed result is compared with, or None.",
    )
    overlay = _Chosen[str](
        "_form.result.overlay.value",
        'Overlay on the image: "nothing", or a name such as "magnitude", "grid" or "folds".',
    )
    arrows = _Chosen[bool](
        "_form.result.arrows.value",
        "True if the arrows of the result are shown; False by default for the result of an image.",
    )
    compare_with = _Chosen[Any](
        "_form.result.second.value",
        "Second image of the same tissue, to compare and to register, or None.",
    )
    in_colours = _Chosen[bool](
        "_form.result.in_colours.value",
        "True if the second image is shown over the deformed image, both in colours.",
    )
    live = _Chosen[bool](
        "_form.model.in_detail.live.value",
        "True if every edit updates the result.",
    )
    prompt = _Chosen[Prompt](
        "_unsaved.prompt",
        "Callback for the prompt about unsaved work before the window closes. The "
        'callback takes a question, and returns "save", "discard" or "cancel". The '
        "default callback shows a dialog.",
    )

    # State shown in the dock

    active = _Shown[bool](
        "_pointer.active",
        "True if the mouse draws instead of moving the view.",
    )
    playing = _Shown[bool](
        "_view.player.playing",
        "True while the deformation is played back and forth.",
    )
    comparison = _Shown[Comparison | None](
        "_view.comparison",
        "Difference between the result and `reference`; None until it is computed.",
    )
    residual = _Shown[str](
        "_form.result.landmarks.value",
        'Summary of the distances from landmarks to their targets; "" without landmarks.',
    )
    unsaved = _Shown[bool](
        "_unsaved.has_work",
        "True if there is unsaved work.",
    )
    sides = _Shown[Sides](
        "_sides.shown",
        'Side of the patient at each edge of the canvas, such as "R"; "" if unknown.',
    )
    status = _Shown[str](
        "_guide.scene.status",
        "Status text of the dock.",
    )
    invitation = _Shown[str](
        "_guide.situation.hint",
        "Hint about the next step.",
    )
    warning = _Shown[str](
        "_guide.scene.warning",
        "Warning about the visible tissue.",
    )
