"""The part of the widget that says what kind of material tissue is, and how far to solve it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from magicgui.widgets import Container, FloatSpinBox, PushButton
from napari.layers import Image
from qtpy.QtWidgets import QSizePolicy

from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON, Material
from napari_hmrf.ui.forms import Prose, align_labels, menu
from napari_hmrf.ui.messages import (
    ABOUT_POISSON,
    ELASTIC,
    MODELS,
    PAPERS,
    PLANES,
    SCHEDULES,
    cannot_be_rigid,
    when_to_take,
)


class TissueModel(Container):
    """The energy and how far it is minimised, with a sentence of when to take which.

    Attributes
    ----------
    energy : ComboBox
        "paper" or "elastic".
    schedule : ComboBox
        Of the paper's energy: "paper" or "converged".
    plane : ComboBox
        Of the elastic energy: "stress" or "strain".
    poisson : FloatSpinBox
        Of the elastic energy, where the tissue is an image of stiffness; labels have a table.
    elastic : PushButton
        To the elastic energy, where there is rigid tissue, which the paper's cannot have.
    back : PushButton
        Back to the paper's energy and schedule, which are what the widget starts with.
    """

    def __init__(self) -> None:
        low, high = POISSON_RANGE
        self.energy = menu("model", MODELS, "What tissue is taken to be")
        self.schedule = menu("solved", SCHEDULES, "How near to the model's own answer")
        self.plane = menu(
            "taken as",
            PLANES,
            "What is in front of the image and behind it. Plane stress: nothing that holds it; "
            "plane strain: tissue that lets nothing through",
        )
        self.poisson = FloatSpinBox(
            label="Poisson's ratio",
            min=low,
            max=high,
            step=0.05,
            value=USUAL_POISSON,
            tooltip=ABOUT_POISSON,
        )
        self._when = Prose()
        self._against = Prose()
        self.elastic = PushButton(text=ELASTIC, tooltip="In which bone and implants move as one")
        self.back = PushButton(
            text=PAPERS, tooltip="The paper's model and schedule, and its settings under Advanced"
        )
        form = Container(widgets=[self.energy, self.schedule, self.plane, self.poisson])
        super().__init__(
            widgets=[form, self._when, self._against, self.elastic, self.back], labels=False
        )
        form.margins = (0, 0, 0, 0)
        align_labels(form)
        self.poisson.native.setDecimals(3)
        for button in (self.elastic, self.back):
            button.native.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        self.elastic.changed.connect(lambda _: setattr(self.energy, "value", "elastic"))
        self._tissue: Any = None
        self._rigid: tuple[str, ...] = ()
        for choice in (self.energy, self.schedule, self.plane):
            choice.changed.connect(self._show)
        self._show()

    @property
    def is_elastic(self) -> bool:
        """Whether Poisson's ratios count."""
        return bool(self.energy.value == "elastic")

    @property
    def objection(self) -> str:
        """Why this model does not go with what the table of tissues says; "" if it does."""
        return "" if self.is_elastic else cannot_be_rigid(self._rigid)

    def tissue_is(self, layer: Any, materials: Iterable[Material] = ()) -> None:
        """Tell what the tissue is read from.

        Parameters
        ----------
        layer : napari.layers.Layer or None
            An image of stiffness has one Poisson's ratio for all of it.
        materials : iterable of Material
            The table of labels, some of which may be rigid.
        """
        rigid = tuple(row.name or f"label {row.label}" for row in materials if row.is_rigid)
        if layer is not self._tissue or rigid != self._rigid:
            self._tissue, self._rigid = layer, rigid
            self._show()

    def _show(self, *_: Any) -> None:
        """Show what applies."""
        elastic, one_for_all = self.is_elastic, isinstance(self._tissue, Image)
        self._when.say(when_to_take(self.energy.value, self.schedule.value, self.plane.value))
        self._against.say(self.objection)
        self.schedule.visible, self.plane.visible = not elastic, elastic
        self.poisson.visible = elastic and one_for_all
        self._against.visible = self.elastic.visible = bool(self.objection)
