"""How to solve: the choices that the first minute does not need."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import ComboBox, Container, FloatSpinBox, Label, SpinBox
from qtpy.QtWidgets import QSizePolicy

from napari_hmrf.backends import BACKEND_NAMES
from napari_hmrf.optimizers import ICM
from napari_hmrf.priors import SeilerPrior

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
    """Prior, optimizer and device, as the solver takes them."""

    def __init__(self) -> None:
        prior, optimizer = SeilerPrior(), ICM()
        reading = ComboBox(
            name="reading",
            label="reading",
            choices=[("centred", "centred"), ("blanket", "blanket")],
            value=prior.conditional,
            tooltip="Which cliques count when a site chooses its displacement",
        )
        sentence = Label(name="sentence", label=" ", value=_READINGS[prior.conditional])
        sweeps = SpinBox(
            name="sweeps",
            label="sweeps per level",
            min=1,
            max=100_000,
            value=optimizer.iterations,
            tooltip="Updates of all sites on each level; with a tolerance, the most there may be",
        )
        method = ComboBox(
            name="method",
            label="site update",
            choices=[("candidate steps", "steps"), ("closed form", "closed form")],
            tooltip="Candidate steps: the paper's, of 1, 0.1, 0.01 and 0.001 pixels.\n"
            "Closed form: straight to the site's best displacement.",
        )
        tolerance = ComboBox(
            name="tolerance",
            label="stop when stable to",
            choices=[
                ("never early", 0.0),
                ("1 %", 1e-2),
                ("0.1 %", 1e-3),
                ("0.01 %", 1e-4),
                ("0.001 %", 1e-5),
            ],
            tooltip="Leave a level when its mean energy has changed by less than this fraction "
            "over ten sweeps",
        )
        penalty = FloatSpinBox(
            name="penalty",
            label="penalty K",
            min=0,
            max=1e9,
            step=1000,
            value=0,
            tooltip="Energy per pixel of deviation from a boundary of confidence 1; the larger, "
            "the firmer boundaries hold. Automatic: large enough to hold them",
        )
        penalty.native.setSpecialValueText("automatic")
        device = ComboBox(
            name="device",
            label="device",
            choices=[(_DEVICES.get(name, name), name) for name in BACKEND_NAMES],
            value="auto",
            tooltip="Automatic: the graphics card if there is one, else compiled loops on the CPU",
        )
        super().__init__(
            widgets=[
                reading,
                sentence,
                method,
                sweeps,
                tolerance,
                penalty,
                device,
            ]
        )
        words = self.sentence.native
        words.setWordWrap(True)
        words.setMinimumHeight(4 * words.fontMetrics().lineSpacing())
        words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.reading.changed.connect(self._on_reading)

    @property
    def prior(self) -> SeilerPrior:
        """The energy chosen."""
        return SeilerPrior(penalty=self.penalty.value or None, conditional=self.reading.value)

    @property
    def optimizer(self) -> ICM:
        """The schedule chosen."""
        options: dict[str, Any] = {} if self.method.value == "steps" else {"steps": None}
        return ICM(self.sweeps.value, tolerance=self.tolerance.value or None, **options)

    @property
    def backend(self) -> str:
        """The device chosen."""
        return str(self.device.value)

    def _on_reading(self, reading: str) -> None:
        self.sentence.value = _READINGS[reading]
