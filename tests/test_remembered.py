"""What a dock remembers from one session to the next, and within one."""

from qtpy.QtCore import QSettings

from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.priors import ElasticPrior


def another(qtbot, viewer=None):
    from napari.components import ViewerModel

    from napari_hmrf.ui.soft_tissue import SoftTissue

    made = SoftTissue(ViewerModel() if viewer is None else viewer)
    qtbot.addWidget(made.native)
    return made


def test_the_device_is_remembered(qtbot):
    another(qtbot).settings.device.value = "cpu"
    assert another(qtbot).settings.backend == "cpu"


def test_a_session_begins_with_the_layers_of_the_first_minute(qtbot):
    def drawn(dock):
        return dock.arrows, dock.overlay

    first = another(qtbot)
    before = drawn(first)
    first.overlay = "magnitude"
    assert drawn(another(qtbot)) == before == (True, "nothing")


def test_what_is_computed_begins_with_elastic_tissue_each_time(qtbot):
    first = another(qtbot)
    first.model.energy.value = "paper"
    first.settings.sweeps.value = 7
    second = another(qtbot)
    assert (second.settings.prior, second.settings.optimizer) == (ElasticPrior(), Multigrid())
    second.settings.back_to_the_paper()
    assert second.settings.is_the_papers


def test_a_dock_that_is_opened_again_is_as_it_was_left(qtbot):
    first = another(qtbot)
    first.model.energy.value = "elastic"
    first.model.plane.value = "strain"
    first.settings.accuracy.value = 1e-4
    again = another(qtbot, first._viewer)
    for each in ("prior", "optimizer", "backend"):
        assert getattr(again.settings, each) == getattr(first.settings, each)
    assert again.settings.optimizer.tolerance == 1e-4
    again.settings.back_to_the_paper()
    assert another(qtbot, first._viewer).settings.is_the_papers


def test_how_many_arrows_are_drawn_is_remembered_but_not_that_they_are_longer_than_true(qtbot):
    first = another(qtbot)
    first.arrow_count, first.arrow_length = 50, 2.5
    second = another(qtbot)
    assert (second.arrow_count, second.arrow_length) == (50, 1.0)


def test_nonsense_in_the_file_is_left_alone(qtbot):
    store = QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )
    store.setValue("deform/device", "abacus")
    store.setValue("look/count", "many")
    store.sync()
    assert another(qtbot).settings.backend == "auto"
