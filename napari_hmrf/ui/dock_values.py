"""Values of the dock that scripts read and set."""

from __future__ import annotations

from typing import Any

from napari_hmrf.field.comparison import Comparison
from napari_hmrf.layers.screen_directions import Sides
from napari_hmrf.solver.model_names import ModelName
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.study.models import SolverDetails
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.form_binding import FormBinding
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.motion.pointer import Pointer
from napari_hmrf.ui.patient_sides import PatientSides
from napari_hmrf.ui.result.result_view import ResultView
from napari_hmrf.ui.unsaved import Prompt, Unsaved
from napari_hmrf.ui.viewer_dock import Dock


class DockValues(Dock):
    """Dock widget with typed attributes for all values that a user can see or choose."""

    _form: DockForm
    _binding: FormBinding
    _pointer: Pointer
    _view: ResultView
    _guide: Guide
    _sides: PatientSides
    _unsaved: Unsaved

    # User choices
    @property
    def image(self) -> Any:
        """Image to deform; if None, only the motion of painted tissue is shown."""
        value: Any = self._form.image.value
        return value

    @image.setter
    def image(self, value: Any) -> None:
        self._form.image.value = value

    @property
    def extent(self) -> str:
        """Extent of the deformation: "slice" (the visible slice alone) or "volume"."""
        value: str = self._form.extent.value
        return value

    @extent.setter
    def extent(self, value: str) -> None:
        self._form.extent.value = value

    @property
    def tissue(self) -> Any:
        """Labels layer, stiffness image or "brightness"; if None, the whole image is tissue."""
        value: Any = self._form.tissue.choice.value
        return value

    @tissue.setter
    def tissue(self, value: Any) -> None:
        self._form.tissue.choice.value = value

    @property
    def boundary(self) -> Any:
        """Labels layer of fixed and moved regions, Vectors layer of displacements, or None."""
        value: Any = self._form.motion.boundary.choice.value
        return value

    @boundary.setter
    def boundary(self, value: Any) -> None:
        self._form.motion.boundary.choice.value = value

    @property
    def confidence(self) -> Any:
        """Confidence of the Vectors layer: image, Labels layer or "edges"; None means 1."""
        value: Any = self._form.motion.boundary.confidence.value
        return value

    @confidence.setter
    def confidence(self, value: Any) -> None:
        self._form.motion.boundary.confidence.value = value

    @property
    def materials(self) -> tuple[Material, ...]:
        """Materials of the tissue labels, one row for each label."""
        value: tuple[Material, ...] = self._form.tissue.table.rows
        return value

    @materials.setter
    def materials(self, value: tuple[Material, ...]) -> None:
        self._form.tissue.table.rows = value

    @property
    def rules(self) -> tuple[BoundaryRule, ...]:
        """Rules of the boundary labels, one row for each label."""
        value: tuple[BoundaryRule, ...] = self._form.motion.boundary.table.rows
        return value

    @rules.setter
    def rules(self, value: tuple[BoundaryRule, ...]) -> None:
        self._form.motion.boundary.table.rows = value

    @property
    def curve(self) -> StiffnessCurve | None:
        """Curve that maps intensity to stiffness, or None if no curve defines the tissue."""
        value: StiffnessCurve | None = self._binding.curve
        return value

    @curve.setter
    def curve(self, value: StiffnessCurve | None) -> None:
        self._binding.curve = value

    @property
    def hold_edge(self) -> bool:
        """True if the outer edge of the tissue is fixed."""
        value: bool = self._form.motion.edge.value
        return value

    @hold_edge.setter
    def hold_edge(self, value: bool) -> None:
        self._form.motion.edge.value = value

    @property
    def weight(self) -> tuple[float, ...]:
        """Body force per unit volume on all tissue, along each axis; () if there is no force."""
        value: tuple[float, ...] = self._form.motion.weight.value
        return value

    @weight.setter
    def weight(self, value: tuple[float, ...]) -> None:
        self._form.motion.weight.value = value

    @property
    def cavity(self) -> Cavity:
        """Pressure and fluid that act where tissue is removed."""
        value: Cavity = self._form.motion.cavity.value
        return value

    @cavity.setter
    def cavity(self, value: Cavity) -> None:
        self._form.motion.cavity.value = value

    @property
    def without_border(self) -> bool:
        """True if the dark, unpainted border of the image is excluded from the tissue."""
        value: bool = self._form.tissue.border.value
        return value

    @without_border.setter
    def without_border(self, value: bool) -> None:
        self._form.tissue.border.value = value

    @property
    def model(self) -> ModelName:
        """Tissue model; setting "paper" also sets `settings` to the settings of the paper."""
        value: ModelName = self._form.model.model.value
        return value

    @model.setter
    def model(self, value: ModelName) -> None:
        self._form.model.model.value = value

    @property
    def plane(self) -> Plane:
        """Plane assumption of the elastic model: "stress" or "strain"."""
        value: Plane = self._form.model.plane.value
        return value

    @plane.setter
    def plane(self, value: Plane) -> None:
        self._form.model.plane.value = value

    @property
    def poisson(self) -> float:
        """Poisson's ratio of elastic tissue without labels; for labels, see `materials`."""
        value: float = self._form.model.poisson.value
        return value

    @poisson.setter
    def poisson(self, value: float) -> None:
        self._form.model.poisson.value = value

    @property
    def settings(self) -> SolverDetails:
        """Immutable solver settings; to change them, assign `replace(dock.settings, sweeps=7)`."""
        value: SolverDetails = self._form.model.in_detail.details
        return value

    @settings.setter
    def settings(self, value: SolverDetails) -> None:
        self._form.model.in_detail.details = value

    @property
    def device(self) -> str:
        """Device of the solver for all images, as the argument `backend` of `solve`."""
        value: str = self._form.model.in_detail.device.value
        return value

    @device.setter
    def device(self, value: str) -> None:
        self._form.model.in_detail.device.value = value

    @property
    def result(self) -> Any:
        """Vectors layer of the displayed (newest or last selected) result, or None."""
        value: Any = self._view.arrows
        return value

    @result.setter
    def result(self, value: Any) -> None:
        self._view.arrows = value

    @property
    def percent(self) -> int:
        """Displayed fraction of the deformation in percent, from 0 to 100."""
        value: int = self._form.result.slider.value
        return value

    @percent.setter
    def percent(self, value: int) -> None:
        self._form.result.slider.value = value

    @property
    def before(self) -> bool:
        """True if the undeformed image is shown instead of the result."""
        value: bool = self._view.before
        return value

    @before.setter
    def before(self, value: bool) -> None:
        self._view.before = value

    @property
    def reference(self) -> Any:
        """Field or other result that the displayed result is compared with, or None."""
        value: Any = self._form.result.reference.value
        return value

    @reference.setter
    def reference(self, value: Any) -> None:
        self._form.result.reference.value = value

    @property
    def overlay(self) -> str:
        """Overlay on the image: "nothing", or a name such as "magnitude", "grid" or "folds"."""
        value: str = self._form.result.overlay.value
        return value

    @overlay.setter
    def overlay(self, value: str) -> None:
        self._form.result.overlay.value = value

    @property
    def compare_with(self) -> Any:
        """Second image, shown over the deformed image, or None."""
        value: Any = self._form.result.second.value
        return value

    @compare_with.setter
    def compare_with(self, value: Any) -> None:
        self._form.result.second.value = value

    @property
    def live(self) -> bool:
        """True if every edit updates the result; the default depends on the size of the image."""
        value: bool = self._form.footer.live.value
        return value

    @live.setter
    def live(self, value: bool) -> None:
        self._form.footer.live.value = value

    @property
    def prompt(self) -> Prompt:
        """Callback for the prompt about unsaved work before the window closes.

        The callback takes a question, and returns "save", "discard" or "cancel". The default
        callback shows a dialog.
        """
        return self._unsaved.prompt

    @prompt.setter
    def prompt(self, value: Prompt) -> None:
        self._unsaved.prompt = value

    # State shown in the dock

    @property
    def active(self) -> bool:
        """True if the mouse draws instead of moving the view."""
        value: bool = self._pointer.active
        return value

    @property
    def playing(self) -> bool:
        """True while the deformation is played back and forth."""
        value: bool = self._view.player.playing
        return value

    @property
    def comparison(self) -> Comparison | None:
        """Difference between the result and `reference`; None until it is computed."""
        value: Comparison | None = self._view.comparison
        return value

    @property
    def residual(self) -> str:
        """Summary of the distances from landmarks to their targets; "" without landmarks."""
        value: str = self._form.result.landmarks.value
        return value

    @property
    def unsaved(self) -> bool:
        """True if there is unsaved work."""
        value: bool = self._unsaved.has_work
        return value

    @property
    def sides(self) -> Sides:
        """Side of the patient at each edge of the canvas, such as "R"; "" if unknown."""
        value: Sides = self._sides.shown
        return value

    @property
    def status(self) -> str:
        """Status text of the dock."""
        value: str = self._guide.scene.status
        return value

    @property
    def invitation(self) -> str:
        """Hint about the next step."""
        value: str = self._guide.situation.hint
        return value

    @property
    def warning(self) -> str:
        """Warning about the visible tissue."""
        value: str = self._form.footer.warning
        return value
