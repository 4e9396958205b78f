"""How to solve: the choices that the first minute does not need."""

from __future__ import annotations

import math
from typing import Any

from magicgui.widgets import Container, FloatSpinBox, SpinBox

from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.optimizers import ICM, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior, SeilerPrior
from napari_hmrf.ui.forms import Prose, align_labels, menu
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
_NAMES = (
    "reading", "sentence", "method", "sweeps", "tolerance", "penalty", "grip", "accuracy", "device",
)  # fmt: skip
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

    Attributes
    ----------
    details : dict of str to ValueWidget
        All fields but the device, by names.
    """

    def __init__(self, model: TissueModel) -> None:
        prior, optimizer = SeilerPrior(), ICM()
        self.reading = menu(
            "reading",
            {name: name for name in _READINGS},
            "Which cliques count when a site chooses its displacement",
            value=prior.conditional,
        )
        self.sentence = Prose(label=" ", value=_READINGS[prior.conditional])
        self.method = menu(
            "site update",
            {"steps": "candidate steps", "closed form": "closed form"},
            "Candidate steps: the paper's, of 1, 0.1, 0.01 and 0.001 pixels.\n"
            "Closed form: straight to the site's best displacement.",
        )
        self.sweeps = SpinBox(
            label="sweeps per level",
            min=1,
            max=100_000,
            value=optimizer.iterations,
            tooltip="Updates of all sites on each level; with a tolerance, the most there may be",
        )
        self.tolerance = menu(
            "stop when stable to",
            {
                0.0: "never early",
                **{part: f"{100 * part:g} %" for part in (1e-2, 1e-3, 1e-4, 1e-5)},
            },
            "Leave a level when its mean energy has changed by less than this fraction over ten "
            "sweeps",
        )
        self.penalty = FloatSpinBox(
            label="penalty K",
            value=0,
            max=1e9,
            step=1000,
            tooltip="Energy per pixel of deviation from a boundary of confidence 1; the larger, "
            "the firmer boundaries hold. Automatic: large enough to hold them",
        )
        self.grip = FloatSpinBox(
            label="penalty K",
            value=0,
            max=1e6,
            step=0.01,
            tooltip="The greatest force that holds a boundary pixel of confidence 1; 1 is what "
            "strains a pixel of the stiffest tissue by 1. Where tissue pulls harder, it slips",
        )
        self.accuracy = menu(
            "converged to",
            {distance: f"{distance:g} px" for distance in (1e-1, 1e-2, 1e-3, 1e-4)},
            "No pixel is estimated to be further than this from where the model has it in the end",
            value=Multigrid.tolerance,
        )
        self.device = menu(
            "device",
            {name: _DEVICES.get(name, name) for name in BACKEND_NAMES},
            "Automatic: the graphics card if there is one, else compiled loops on the CPU",
        )
        fields = {name: getattr(self, name) for name in _NAMES}
        for name, field in fields.items():
            field.name = name
        super().__init__(widgets=fields.values())
        align_labels(self)
        self._model = model
        self.penalty.native.setSpecialValueText("automatic")
        self.grip.native.setSpecialValueText("held exactly")
        self.grip.native.setDecimals(4)
        self.details = {name: fields[name] for name in _NAMES if name not in ("sentence", "device")}
        self._beginning = {name: field.value for name, field in self.details.items()}
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
    def is_the_papers(self) -> bool:
        """Whether a solve is that of the paper."""
        return (self.prior, self.optimizer) == (SeilerPrior(), ICM())

    def back_to_the_paper(self) -> None:
        """Choose the paper's energy and schedule; the device stays."""
        self._model.energy.value = self._model.schedule.value = "paper"
        for name, value in self._beginning.items():
            self.details[name].value = value

    def _show(self, *_: Any) -> None:
        """Show what applies."""
        optimizer = self.optimizer
        seiler, multigrid = not self._model.is_elastic, isinstance(optimizer, Multigrid)
        schedule = seiler and self._model.schedule.value == "paper"
        self.sentence.say(_READINGS[self.reading.value])
        for applies, *fields in (
            (seiler, self.reading, self.sentence, self.penalty),
            (schedule, self.method, self.sweeps, self.tolerance),
            (not seiler, self.grip),
            (multigrid, self.accuracy),
        ):
            for field in fields:
                field.visible = applies
        self._model.back.visible = not self.is_the_papers
