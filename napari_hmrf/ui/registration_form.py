"""Form for the registration of the image to the second image."""

from __future__ import annotations

import importlib.util

from magicgui.widgets import Container, PushButton
from psygnal import Signal

from napari_hmrf.extras import how_to_install
from napari_hmrf.real_arrays import sites_in_words
from napari_hmrf.registration.alignment import Kind
from napari_hmrf.registration.result import agreement_in_words
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.ui.forms import Form, Prose, menu, narrow, row

_ALIGNMENTS: dict[Kind | None, str] = {
    None: "as placed",
    "rigid": "shift and turn",
    "affine": "shift, turn, stretch",
}
_ABOUT = (
    "Move the tissue until the image looks like the second image. Tissue that is held, pulled or "
    "rigid, and landmarks, have their effect. The outer edge is no longer fixed. Undo restores the "
    "state before."
)
#: Similarity below which images agree poorly.
_POOR = 0.25
_CHOOSE = (
    "Choose a second image above: a later image of the same tissue, of the same kind. Open it with "
    "File > Open."
)
_ELASTIC = "Choose the model 'elastic' first (under 'Model'); other models do not support this"
_ABOUT_FIT = (
    "Find the growth or the stiffness of tissues with which the image moves to the second image, "
    "with intervals"
)
_TISSUES = "Paint tissues first: choose or make a tissue layer (under 'Tissue')"
_ELASTIC_FIT = "Choose the model 'elastic' or 'large motion' first (under 'Model')"
_ALIGN = (
    "Position of the second image before tissue moves: as the viewer shows it; or shifted and "
    "turned, or also stretched, to fit. Its layer moves there; this is no motion of the tissue. "
    "Both images must overlap."
)


class RegistrationForm(Container):
    """Controls that register the image to the second image, and describe the registration.

    Attributes
    ----------
    alignment : ComboBox
        Alignment of the second image before the registration.
    register, remove : PushButton
        Buttons that register the images, and remove the registration.
    fit : PushButton
        Button that opens the window for a fit of the tissues.
    description : Prose
        Name of the second image, and agreement before and after.
    is_registered : bool
        True if the visible slice is registered.
    """

    #: Emitted after `show`.
    shown = Signal()

    def __init__(self) -> None:
        self.alignment = menu("align first", _ALIGNMENTS, _ALIGN)
        narrow(self.alignment)
        self.register = PushButton(text="Register")
        self.remove = PushButton(
            text="Unregister", tooltip="Remove the registration; the marks are kept"
        )
        self.fit = PushButton(text="Fit to second image ...")
        self.description, self.is_registered = Prose(), False
        if importlib.util.find_spec("SimpleITK") is None:
            self.alignment.enabled = False
            self.alignment.tooltip = f"Requires SimpleITK: {how_to_install('medical')}"
        buttons, aligned = row(self.register, self.remove), Form([self.alignment])
        parts = [buttons, self.description, aligned, self.fit]
        super().__init__(widgets=parts, labels=False)
        for part in (self, buttons):
            part.margins = (0, 0, 0, 0)

    def show(
        self,
        measured: MeasuredMotion | None,
        *,
        second_name: str,
        is_elastic: bool,
        is_busy: bool,
    ) -> None:
        """Enable the controls, and describe the registration.

        Parameters
        ----------
        measured : MeasuredMotion or None
            Result of the registration of the visible slice; None if there is none.
        second_name : str
            Name of the second image; "" if none is chosen.
        is_elastic : bool
            True if the model supports a registration.
        is_busy : bool
            True while a registration is running.
        """
        self.register.text = "Register again" if measured is not None else "Register"
        conditions = (second_name, _CHOOSE), (is_elastic, _ELASTIC), (not is_busy, _ABOUT)
        _offer(self.register, _ABOUT, *conditions)
        self.is_registered = measured is not None
        self.remove.visible, self.remove.enabled = self.is_registered, not is_busy
        self.description.show_text("" if measured is None else described(measured))
        self.shown.emit()

    def show_fit(self, *, has_second: bool, has_tissues: bool, is_elastic: bool) -> None:
        """Enable the button for a fit.

        Parameters
        ----------
        has_second : bool
            True if a second image is chosen.
        has_tissues : bool
            True if the image has a tissue table.
        is_elastic : bool
            True if the model supports a fit.
        """
        conditions = (has_second, _CHOOSE), (has_tissues, _TISSUES), (is_elastic, _ELASTIC_FIT)
        _offer(self.fit, _ABOUT_FIT, *conditions)


def _offer(button: PushButton, about: str, *conditions: tuple[object, str]) -> None:
    """Enable a button if all conditions are met; otherwise, its tooltip is the first reason."""
    missing = [reason for is_met, reason in conditions if not is_met]
    button.enabled = not missing
    button.tooltip = missing[0] if missing else about


def described(measured: MeasuredMotion) -> str:
    """Describe a registration: the name of the second image, and the agreement of both images."""
    record = measured.record
    name, before, after = (record.get(key) for key in ("second image", "before", "similarity"))
    text = f"Registered to '{name}'." if name else "Registered."
    if isinstance(before, float) and isinstance(after, float):
        text += f" Agreement when registered: {agreement_in_words(before, after)}."
        if record.get("relation", "same") != "same":
            text += " The images have different contrasts."
        if count := record.get("missing sites", 0):
            sites = sites_in_words(count, len(measured.shape) - 1)
            text += (
                f" Tissue without counterpart ({sites}) was not compared: correct it in the layer "
                "'... without counterpart', and register again."
            )
        if after < _POOR:
            text += " The images agree poorly: use 'align first', or choose another second image."
    return text
