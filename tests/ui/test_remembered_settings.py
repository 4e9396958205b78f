"""Tests of the settings that a dock restores, in the same session and in a later one."""

from dataclasses import replace

from qtpy.QtCore import QSettings
from superqt import QCollapsible

from napari_hmrf.study.models import SolverDetails
from tests.support.screen import Screen


def open_dock(qtbot, viewer=None):
    from napari.components import ViewerModel

    from napari_hmrf.ui.soft_tissue import SoftTissue

    made = SoftTissue(ViewerModel() if viewer is None else viewer)
    qtbot.addWidget(made.native)
    return made


def test_the_device_is_remembered_between_sessions(qtbot):
    open_dock(qtbot).settings = replace(open_dock(qtbot).settings, device="cpu")
    assert open_dock(qtbot).settings.device == "cpu"


def test_sections_are_closed_until_opened_and_remembered_between_sessions(qtbot):
    def opened(dock):
        sections = dock.native.findChildren(QCollapsible)
        return [each.text() for each in sections if each.isExpanded()]

    first = open_dock(qtbot)
    assert opened(first) == []
    for title in ("Advanced", "Tissue and stiffness"):
        Screen(first).press(title)
    second = open_dock(qtbot)
    assert opened(second) == ["Tissue and stiffness", "Advanced"]
    Screen(second).press("Advanced")
    assert opened(open_dock(qtbot)) == ["Tissue and stiffness"]


def test_a_session_starts_without_an_overlay(qtbot):
    first = open_dock(qtbot)
    first.overlay = "magnitude"
    assert open_dock(qtbot).overlay == "nothing"


def test_a_session_starts_with_the_elastic_model(qtbot):
    first = open_dock(qtbot)
    first.model = "paper"
    first.settings = replace(first.settings, sweeps=7)
    second = open_dock(qtbot)
    assert (second.model, second.settings) == ("elastic", SolverDetails())


def test_a_dock_opened_again_restores_its_settings(qtbot):
    first = open_dock(qtbot)
    first.model = "elastic"
    first.plane = "strain"
    first.poisson = 0.3
    first.settings = replace(first.settings, accuracy=1e-4)
    again = open_dock(qtbot, first._viewer)
    assert (again.model, again.plane, again.poisson) == ("elastic", "strain", 0.3)
    assert again.settings == SolverDetails(accuracy=1e-4)
    again.model = "paper"
    again.settings = replace(again.settings, sweeps=7)
    last = open_dock(qtbot, first._viewer)
    assert (last.model, last.settings) == ("paper", SolverDetails(sweeps=7))


def test_an_invalid_stored_setting_is_ignored(qtbot):
    store = QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )
    store.setValue("deform/device", "abacus")
    store.sync()
    assert open_dock(qtbot).settings.device == "auto"
