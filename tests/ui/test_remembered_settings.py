"""Tests of the settings that a dock restores, in the same session and in a later one."""

from dataclasses import replace

import pytest
from napari.components import ViewerModel
from qtpy.QtCore import QSettings
from superqt import QCollapsible

from napari_hmrf.study.models import SolverDetails
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.screen import Screen


@pytest.fixture
def new_dock(qtbot):
    """Return a function that opens a new dock, beside a new viewer by default."""

    def made(viewer=None):
        found = SoftTissue(ViewerModel() if viewer is None else viewer)
        qtbot.addWidget(found.native)
        return found

    return made


def opened_sections(dock):
    sections = dock.native.findChildren(QCollapsible)
    return [each.text() for each in sections if each.isExpanded() and not each.isHidden()]


def test_a_later_session_restores_device_and_sections_and_a_later_dock_all_settings(new_dock):
    first = new_dock()
    assert opened_sections(first) == []
    for title in ("Advanced", "Tissue and stiffness"):
        Screen(first).press(title)
    first.overlay, first.model = "magnitude", "paper"
    first.settings, first.device = replace(first.settings, sweeps=7), "cpu"
    second = new_dock()
    assert opened_sections(second) == ["Tissue and stiffness", "Advanced"]
    assert second.overlay == "nothing"
    assert (second.model, second.settings) == ("elastic", SolverDetails())
    assert second.device == "cpu"
    Screen(second).press("Advanced")
    stored = QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )
    stored.setValue("deform/device", "abacus")
    stored.sync()
    third = new_dock()
    assert opened_sections(third) == ["Tissue and stiffness"]
    assert third.device == "auto", "an invalid stored device was not ignored"
    third.plane = "strain"
    third.poisson = 0.3
    third.settings = replace(third.settings, accuracy=1e-4)
    again = new_dock(third._viewer)
    assert (again.model, again.plane, again.poisson) == ("elastic", "strain", 0.3)
    assert again.settings == SolverDetails(accuracy=1e-4)
