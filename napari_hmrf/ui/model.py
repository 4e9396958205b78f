"""Form for the model of the tissue and its solver settings."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, get_type_hints

from magicgui.widgets import (
    CheckBox,
    Container,
    RadioButtons,
    create_widget,
)
from napari.layers import Image
from qtpy.QtCore import QSize
from qtpy.QtGui import QIcon
from qtpy.QtWidgets import QRadioButton

from napari_hmrf.checks import POISSON_RANGE
from napari_hmrf.solver.model_advice import ABOUT_POISSON, when_to_take
from napari_hmrf.solver.model_names import ELASTIC
from napari_hmrf.solver.uncertain_landmarks import StrainScale
from napari_hmrf.study.models import SolverDetails, detail_names
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON
from napari_hmrf.ui import messages
from napari_hmrf.ui.forms import Form, Prose, menu, narrow, number, show_value

#: Size of the icon on a plane button, in pixels.
_PICTURE = QSize(64, 32)
# Range of the typical strain, in percent, and number of its decimals as a fraction.
_STRAINS = 0.01, 10_000.0
_DECIMALS = 6
_DEVICES = {
    "auto": "automatic",
    "opengl": "OpenGL",
    "opengl:fragment": "OpenGL, fragment",
    "opengl:compute": "OpenGL, compute",
    "cpu": "CPU",
}
_ABOUT_LIVE = (
    "Update the result after every edit to tissue, boundary or tables. Without it, press 'Deform' "
    "after the edits; tools always update the result"
)
_ABOUT_DEVICE = "Automatic: the graphics card if there is one, otherwise compiled loops on the CPU"
_ABOUT_STRAIN = (
    "Strain that is usual for this tissue, against which landmarks with an uncertainty (±) are "
    "weighed. A larger strain brings tissue closer to these landmarks; it has no other effect"
)
_ABOUT_UNFOLDS = (
    "Change to the model 'large motion' by itself when an edit folds elastic tissue. Choosing a "
    "model switches this off"
)
_ABOUT_DRIFT = (
    "Let all tissue also stretch, shrink or shear evenly, as much as the landmarks with an "
    "uncertainty (±) suggest: for example, if the scanner or the pixel size differs between "
    "two images. Needs three such landmarks that are not on one line, or four in a volume; "
    "without such landmarks, it has no effect. While the outer edge is held ('Fix outer edge'), it "
    "has little effect"
)


class DetailsForm(Form):
    """Form with the fields of `SolverDetails`; only the fields of the chosen model are visible.

    Attributes
    ----------
    strain : FloatSpinBox
        Typical strain of elastic tissue, in percent.
    drift : CheckBox
        Ticked if an affine drift is estimated with uncertain landmarks.
    device : ComboBox
        Argument `backend` of `solve`, which is the same for all images.
    live : CheckBox
        Ticked if every edit is solved at once.
    """

    def __init__(self) -> None:
        hints = get_type_hints(SolverDetails)
        made = [
            create_widget(each.default, hints[each.name], each.name, **each.metadata)
            for each in fields(SolverDetails)
        ]
        self.strain = number(
            "typical strain (%)",
            _ABOUT_STRAIN,
            name="strain",
            min=_STRAINS[0],
            max=_STRAINS[1],
            step=1.0,
            value=100 * StrainScale.strain,
        )
        self.drift = CheckBox(name="drift", text="affine drift", tooltip=_ABOUT_DRIFT)
        self.device = menu("device", _DEVICES, _ABOUT_DEVICE, name="device")
        self.live = CheckBox(
            name="live", value=True, text="Live: update after every edit", tooltip=_ABOUT_LIVE
        )
        super().__init__([self.strain, self.drift, *made, self.device, self.live])
        self["penalty"].native.setSpecialValueText("automatic")
        self["grip"].native.setSpecialValueText("by confidence")
        self["grip"].native.setDecimals(4)
        for name in ("penalty", "grip"):
            self[name].native.setKeyboardTracking(False)  # "0." is not a complete number

    @property
    def details(self) -> SolverDetails:
        """Chosen solver settings."""
        return SolverDetails(**{each.name: self[each.name].value for each in fields(SolverDetails)})

    @details.setter
    def details(self, details: SolverDetails) -> None:
        with self.changed.blocked():
            for name, value in asdict(details).items():
                show_value(self[name], value)
        self.changed.emit(self)


class _PlaneChoice(RadioButtons):
    """Radio buttons with icons; magicgui recreates the buttons when the widget is moved."""

    def reset_choices(self, *_: Any) -> None:
        super().reset_choices()
        buttons = self.native.findChildren(QRadioButton)
        for button, plane in zip(buttons, messages.PLANES, strict=True):
            button.setIcon(QIcon(str(Path(__file__).with_name(f"plane-{plane}.svg"))))
            button.setIconSize(_PICTURE)


class ModelForm(Container):
    """Form for the model, with advice on its use.

    Attributes
    ----------
    model : ComboBox
        A `ModelName`. Choosing "paper" also sets the solver settings to the settings of the paper.
    plane : RadioButtons
        Plane assumption of the elastic model: "stress" or "strain".
    poisson : FloatSpinBox
        Poisson's ratio of the elastic model if the tissue is a stiffness image; for labels, the
        ratios are in the tissue table.
    unfolds : CheckBox
        Ticked if large motion takes the place of the elastic model where tissue folds.
    in_detail : DetailsForm
        Further settings, in a section inside that of the model.
    """

    def __init__(self) -> None:
        low, _ = POISSON_RANGE
        self.model = menu(
            "model",
            messages.MODELS,
            "Tissue model; choosing the paper's model resets the settings under 'Advanced'",
            name="model",
        )
        narrow(self.model)
        self.plane = _PlaneChoice(
            name="plane",
            label="slice is",
            choices=[(words, plane) for plane, words in messages.PLANES.items()],
            value="stress",
            tooltip="Surroundings of the slice: nothing (plane stress), or tissue (plane strain)",
        )
        self.poisson = number(
            "Poisson's ratio",
            ABOUT_POISSON,
            name="poisson",
            decimals=3,
            min=low,
            max=1.0,  # too large a ratio causes an error message instead of becoming 0
            step=0.05,
            value=USUAL_POISSON,
        )
        self.unfolds = CheckBox(
            name="unfolds",
            value=True,
            text="large motion where tissue folds",
            tooltip=_ABOUT_UNFOLDS,
        )
        self._when = Prose()
        self._form = Form([self.model, self.unfolds, self.plane, self.poisson])
        super().__init__(widgets=[self._form, self._when], labels=False)
        self.in_detail = DetailsForm()
        self._tissue: Any = None
        self._volume = False
        self.model.changed.connect(self._on_model)
        # A menu emits no change when the current model is chosen again.
        self.model.native.activated.connect(lambda _: self._on_model(self.model.value))
        self.plane.changed.connect(self._show)
        self.in_detail.drift.changed.connect(self._show)
        self._show()

    @property
    def choice(self) -> ModelChoice:
        """Chosen model and settings."""
        form, detail = self._form.asdict(), self.in_detail
        parts = form["model"], form["plane"], form["poisson"], detail.details
        strain = round(detail.strain.value / 100, _DECIMALS)
        of_elastic = {"drift": detail.drift.value, "unfolds": form["unfolds"]}
        return ModelChoice(*parts, strain=strain, **of_elastic)

    @choice.setter
    def choice(self, choice: ModelChoice) -> None:
        values = {"model": choice.name, "plane": choice.plane, "poisson": choice.poisson}
        values["unfolds"] = choice.unfolds  # last, because a new model resets it
        self._form.update(values)
        detail, (low, high) = self.in_detail, _STRAINS
        with detail.changed.blocked():
            detail.strain.value = min(max(100 * choice.strain, low), high)
            detail.drift.value = choice.drift
        detail.details = choice.details

    @property
    def is_elastic(self) -> bool:
        """True if the chosen model uses Poisson's ratio."""
        return self.model.value in ELASTIC

    def tissue_is(self, layer: Any) -> None:
        """Set the layer that defines the tissue; `poisson` is visible only for an image."""
        if layer is not self._tissue:
            self._tissue = layer
            self._show()

    def extent_is(self, volume: bool) -> None:
        """Set whether a volume is deformed; a volume has no choice of plane."""
        self._volume = volume
        self._show()

    def _on_model(self, model: str) -> None:
        self.unfolds.value = False
        if model == "paper":
            self.in_detail.details = SolverDetails()
        self._show()

    def _show(self, *_: Any) -> None:
        """Show the fields that apply."""
        model = self.model.value
        self._when.show_text(when_to_take(model, None if self._volume else self.plane.value))
        self.plane.visible = self.is_elastic and not self._volume
        self.poisson.visible = self.is_elastic and isinstance(self._tissue, Image)
        self.unfolds.visible = self.is_elastic
        detail = self.in_detail
        for field in detail:
            is_general = field is detail.device or field is detail.live
            field.visible = is_general or field.name in detail_names(model)
        detail.strain.visible = self.is_elastic
        # A drift that another model refuses can be switched off.
        detail.drift.visible = model == "elastic" or (self.is_elastic and detail.drift.value)
