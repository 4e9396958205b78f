"""The part of the dock that says what tissue is taken to be, and how that is solved in detail."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, get_type_hints

from magicgui.widgets import Container, FloatSpinBox, RadioButtons, create_widget
from napari.layers import Image
from qtpy.QtCore import QSize
from qtpy.QtGui import QIcon
from qtpy.QtWidgets import QRadioButton

from napari_hmrf.solver.model_advice import ABOUT_POISSON, when_to_take
from napari_hmrf.solver.model_names import ELASTIC
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.study.models import SolverDetails, asked, optimizer_of, prior_of
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON
from napari_hmrf.ui import messages
from napari_hmrf.ui.forms import Prose, align_labels, menu, narrow

#: Of the picture of a plane, in pixels.
_PICTURE = QSize(64, 32)


class DetailsForm(Container):
    """A field for each of `SolverDetails`; those are seen that a model asks for."""

    def __init__(self) -> None:
        hints = get_type_hints(SolverDetails)
        super().__init__(
            widgets=[
                create_widget(each.default, hints[each.name], each.name, **each.metadata)
                for each in fields(SolverDetails)
            ]
        )
        align_labels(self)
        self["penalty"].native.setSpecialValueText("automatic")
        self["grip"].native.setSpecialValueText("by confidence")
        self["grip"].native.setDecimals(4)

    @property
    def details(self) -> SolverDetails:
        """What is chosen."""
        return SolverDetails(**self.asdict())

    @details.setter
    def details(self, details: SolverDetails) -> None:
        self.update(asdict(details))


class _PlaneChoice(RadioButtons):
    """Buttons with a picture each; whenever it is put elsewhere magicgui makes them anew."""

    def reset_choices(self, *_: Any) -> None:
        super().reset_choices()
        buttons = self.native.findChildren(QRadioButton)
        for button, plane in zip(buttons, messages.PLANES, strict=True):
            button.setIcon(QIcon(str(Path(__file__).with_name(f"plane-{plane}.svg"))))
            button.setIconSize(_PICTURE)


class ModelForm(Container):
    """One of the models, with a sentence of when to take which.

    Attributes
    ----------
    model : ComboBox
        A `ModelName`. Whoever chooses the paper's has its own numbers, too.
    plane : RadioButtons
        Of the elastic model: "stress" or "strain".
    poisson : FloatSpinBox
        Of the elastic model, where the tissue is an image of stiffness; labels have a table.
    in_detail : DetailsForm
        To be put elsewhere.
    """

    def __init__(self) -> None:
        low, _ = POISSON_RANGE
        self.model = menu(
            "model",
            messages.MODELS,
            "What tissue is taken to be. The paper's brings its own numbers back under Advanced",
            name="model",
        )
        narrow(self.model)
        self.plane = _PlaneChoice(
            name="plane",
            label="slice is",
            choices=[(words, plane) for plane, words in messages.PLANES.items()],
            value="stress",
            tooltip="What lies around the slice: nothing (plane stress), or tissue (plane strain)",
        )
        self.poisson = FloatSpinBox(
            name="poisson",
            label="Poisson's ratio",
            min=low,
            max=1.0,  # what is too much is refused in words, and not turned into 0
            step=0.05,
            value=USUAL_POISSON,
            tooltip=ABOUT_POISSON,
        )
        self._when = Prose()
        self._form = form = Container(widgets=[self.model, self.plane, self.poisson])
        super().__init__(widgets=[form, self._when], labels=False)
        form.margins = (0, 0, 0, 0)
        align_labels(form)
        self.poisson.native.setDecimals(3)
        self.poisson.native.setKeyboardTracking(False)  # "0." is no ratio yet
        self.in_detail = DetailsForm()
        self._tissue: Any = None
        self._volume = False
        self.model.changed.connect(self._on_model)
        # A menu tells of no change where what is chosen already is chosen again.
        self.model.native.activated.connect(lambda _: self._on_model(self.model.value))
        self.plane.changed.connect(self._show)
        self._show()

    @property
    def values(self) -> dict[str, Any]:
        """All that is chosen, by name."""
        return {**self._form.asdict(), "details": self.in_detail.details}

    @values.setter
    def values(self, values: Mapping[str, Any]) -> None:
        self._form.update(values)
        self.in_detail.details = values.get("details", self.in_detail.details)

    @property
    def is_elastic(self) -> bool:
        """Whether Poisson's ratios count."""
        return self.model.value in ELASTIC

    @property
    def prior(self) -> Prior:
        """The energy chosen; where tissues are labels, Poisson's ratios are still to come."""
        details = self.in_detail.details
        return prior_of(self.model.value, details, self.plane.value, self.poisson.value)

    @property
    def optimizer(self) -> Optimizer:
        """How it is minimised."""
        return optimizer_of(self.model.value, self.in_detail.details)

    def tissue_is(self, layer: Any) -> None:
        """Tell what the tissue is read from: an image has one Poisson's ratio for all of it."""
        if layer is not self._tissue:
            self._tissue = layer
            self._show()

    def extent_is(self, volume: bool) -> None:
        """Tell whether a volume is deformed, which lies in no plane."""
        self._volume = volume
        self._show()

    def _on_model(self, model: str) -> None:
        if model == "paper":
            device = self.in_detail["device"].value
            self.in_detail.details = SolverDetails(device=device)
        self._show()

    def _show(self, *_: Any) -> None:
        """Show what applies."""
        model = self.model.value
        self._when.say(when_to_take(model, None if self._volume else self.plane.value))
        self.plane.visible = self.is_elastic and not self._volume
        self.poisson.visible = self.is_elastic and isinstance(self._tissue, Image)
        for field in self.in_detail:
            field.visible = field.name in asked(model)
