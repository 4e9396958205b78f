"""How to solve: the choices that the first minute does not need."""

from __future__ import annotations

import math
from typing import Any

from magicgui.widgets import ComboBox, Container, FloatSpinBox, SpinBox

from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior, SeilerPrior
from napari_hmrf.ui.forms import Prose, align_labels
from napari_hmrf.ui.model import TissueModel

_READINGS = {
    "centred": (
        "Centred: each site weighs the cliques whose middle it is. Nearest to finite elements, and "
        "independent of the pixel size."
    ),
    "blanket": (
        "Blanket: each site weighs all cliques that contain it, the textbook reading of the "
        "energy. Stiff-soft borders lock, the more so the finer the pixels."
    ),
}
_DEVICES = {
    "auto": "automatic",
    "opengl": "OpenGL",
    "opengl:fragment": "OpenGL, fragment",
    "opengl:compute": "OpenGL, compute",
    "cpu": "CPU",
}


class SolverSettings(Container):
    """Prior, optimizer and device, as the solver takes them; shows what applies to the model.

    Parameters
    ----------
    model : TissueModel
        Which energy, and how far it is minimised.
    """

    def __init__(self, model: TissueModel) -> None:
        prior, optimizer = SeilerPrior(), ICM()
        super().__init__(
            widgets=[
                ComboBox(
                    name="reading",
                    label="reading",
                    choices=[("centred", "centred"), ("blanket", "blanket")],
                    value=prior.conditional,
                    tooltip="Which cliques count when a site chooses its displacement",
                ),
                Prose(name="sentence", label=" ", value=_READINGS[prior.conditional]),
                ComboBox(
                    name="method",
                    label="site update",
                    choices=[("candidate steps", "steps"), ("closed form", "closed form")],
                    tooltip="Candidate steps: the paper's, of 1, 0.1, 0.01 and 0.001 pixels.\n"
                    "Closed form: straight to the site's best displacement.",
                ),
                SpinBox(
                    name="sweeps",
                    label="sweeps per level",
                    min=1,
                    max=100_000,
                    value=optimizer.iterations,
                    tooltip="Updates of all sites on each level; with a tolerance, the most there "
                    "may be",
                ),
                ComboBox(
                    name="tolerance",
                    label="stop when stable to",
                    choices=[
                        ("never early", 0.0),
                        ("1 %", 1e-2),
                        ("0.1 %", 1e-3),
                        ("0.01 %", 1e-4),
                        ("0.001 %", 1e-5),
                    ],
                    tooltip="Leave a level when its mean energy has changed by less than this "
                    "fraction over ten sweeps",
                ),
                FloatSpinBox(
                    name="penalty",
                    label="penalty K",
                    min=0,
                    max=1e9,
                    step=1000,
                    value=0,
                    tooltip="Energy per pixel of deviation from a boundary of confidence 1; the "
                    "larger, the firmer boundaries hold. Automatic: large enough to hold them",
                ),
                FloatSpinBox(
                    name="grip",
                    label="penalty K",
                    min=0,
                    max=1e6,
                    step=0.01,
                    value=0,
                    tooltip="The greatest force that holds a boundary pixel of confidence 1; 1 is "
                    "what strains a pixel of the stiffest tissue by 1. Where tissue pulls harder, "
                    "it slips",
                ),
                ComboBox(
                    name="accuracy",
                    label="converged to",
                    choices=[
                        (f"{distance:g} px", distance) for distance in (1e-1, 1e-2, 1e-3, 1e-4)
                    ],
                    value=Multigrid.tolerance,
                    tooltip="No pixel is estimated to be further than this from where the model "
                    "has it in the end",
                ),
                ComboBox(
                    name="device",
                    label="device",
                    choices=[(_DEVICES.get(name, name), name) for name in BACKEND_NAMES],
                    value="auto",
                    tooltip="Automatic: the graphics card if there is one, else compiled loops on "
                    "the CPU",
                ),
            ]
        )
        align_labels(self)
        self._model = model
        self.penalty.native.setSpecialValueText("automatic")
        self.grip.native.setSpecialValueText("held exactly")
        self.grip.native.setDecimals(4)
        self._beginning = {
            widget.name: widget.value
            for widget in self
            if widget not in (self.sentence, self.device)
        }
        for container in (self, model):
            container.changed.connect(self._show)
        model.back.changed.connect(self.back_to_the_paper)
        self._show()

    @property
    def prior(self) -> Prior:
        """The energy chosen; where tissues are labels, Poisson's ratios are still to come."""
        model = self._model
        if model.is_elastic:
            grip = self.grip.value or math.inf
            return ElasticPrior(model.poisson.value, plane=model.plane.value, penalty=grip)
        return SeilerPrior(penalty=self.penalty.value or None, conditional=self.reading.value)

    @property
    def optimizer(self) -> Optimizer:
        """The schedule chosen."""
        if self._model.is_elastic or self._model.schedule.value == "converged":
            return Multigrid(self.accuracy.value)
        options: dict[str, Any] = {} if self.method.value == "steps" else {"steps": None}
        return ICM(self.sweeps.value, energy_change=self.tolerance.value or None, **options)

    @property
    def backend(self) -> str:
        """The device chosen."""
        return str(self.device.value)

    @property
    def details(self) -> tuple[str, ...]:
        """The names of all fields but the device."""
        return tuple(self._beginning)

    @property
    def is_the_papers(self) -> bool:
        """Whether a solve is that of the paper."""
        return (self.prior, self.optimizer) == (SeilerPrior(), ICM())

    def back_to_the_paper(self) -> None:
        """Choose the paper's energy and schedule; the device stays."""
        self._model.energy.value = self._model.schedule.value = "paper"
        for name, value in self._beginning.items():
            self[name].value = value

    def _show(self, *_: Any) -> None:
        """Show what applies."""
        optimizer = self.optimizer
        seiler, multigrid = not self._model.is_elastic, isinstance(optimizer, Multigrid)
        schedule = seiler and self._model.schedule.value == "paper"
        self.sentence.say(_READINGS[self.reading.value])
        for widget, applies in (
            (self.reading, seiler),
            (self.sentence, seiler),
            (self.method, schedule),
            (self.sweeps, schedule),
            (self.tolerance, schedule),
            (self.penalty, seiler),
            (self.grip, not seiler),
            (self.accuracy, multigrid),
        ):
            widget.visible = applies
        self._model.back.visible = not self.is_the_papers
