"""What a dock remembers from one session to the next, and within one."""

from qtpy.QtCore import QSettings

from napari_hmrf.solver.priors import SeilerPrior


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
    first = another(qtbot)
    before = first.outputs
    first.outputs = (*before, "grid", "folds")
    assert another(qtbot).outputs == before == ("image", "arrows")


def test_what_is_computed_begins_with_the_paper_each_time(qtbot):
    first = another(qtbot)
    first.model.energy.value = "elastic"
    first.settings.accuracy.value = 1e-4
    second = another(qtbot)
    assert second.settings.prior == SeilerPrior()
    assert second.settings.is_the_papers


def test_a_dock_that_is_opened_again_is_as_it_was_left(qtbot):
    first = another(qtbot)
    first.model.energy.value = "elastic"
    first.model.plane.value = "strain"
    first.settings.accuracy.value = 1e-4
    first.outputs = ("image", "magnitude")
    again = another(qtbot, first._viewer)
    for each in ("prior", "optimizer", "backend"):
        assert getattr(again.settings, each) == getattr(first.settings, each)
    assert again.settings.optimizer.tolerance == 1e-4
    assert again.outputs == first.outputs
    again.settings.back_to_the_paper()
    assert another(qtbot, first._viewer).settings.is_the_papers


def test_how_many_arrows_are_drawn_is_remembered_but_not_that_they_are_longer_than_true(qtbot):
    from napari.components import ViewerModel

    from napari_hmrf.ui.result.look_dock import LookAtResult

    first, second = None, None
    for _ in range(2):
        made = LookAtResult(ViewerModel())
        qtbot.addWidget(made.native)
        first, second = second, made
        if first is None:
            made._form.count.value, made._form.length.value, made._form.grid.value = 50, 2.5, True
    assert (second._form.count.value, second._form.length.value) == (50, 1.0)
    assert second._form.grid.value is False


def test_nonsense_in_the_file_is_left_alone(qtbot):
    store = QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )
    store.setValue("deform/device", "abacus")
    store.setValue("look/count", "many")
    store.sync()
    assert another(qtbot).settings.backend == "auto"
