"""Tests of the choice of the tissue model in the dock."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image

from napari_hmrf import ICM, ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.read import Request
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.solver.model_names import converged
from napari_hmrf.study.ground import build_problem
from napari_hmrf.study.models import SolverDetails
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.ui.messages import MODELS
from napari_hmrf.ui.model import ModelForm
from tests.support.docks import viewer_of
from tests.support.screen import Cell, Screen

POISSON = 3  # Column of the table of tissues.


def names(widget):
    return [layer.name for layer in viewer_of(widget).layers]


def elastic(widget):
    widget.model = "elastic"


def solved(widget):
    """Return the chosen prior and optimizer."""
    chosen = widget.session.model
    return chosen.prior, chosen.optimizer


# Choosing a model


def test_each_image_keeps_its_own_model(widget):
    viewer = viewer_of(widget)
    first = viewer.add_image(np.zeros((20, 24)), name="first")
    widget.model = "large motion"
    second = viewer.add_image(np.zeros((20, 24)), name="second")
    widget.image = second
    assert widget.model == "elastic"
    widget.poisson = 0.3
    widget.image = first
    assert (widget.model, widget.poisson) == ("large motion", ModelChoice().poisson)
    widget.image = second
    assert (widget.model, widget.poisson) == ("elastic", 0.3)
    viewer.layers.clear()
    viewer.add_image(np.zeros((20, 24)), name="third")
    assert (widget.model, widget.poisson) == ("elastic", ModelChoice().poisson)


def test_the_device_is_the_same_for_all_images(widget):
    viewer = viewer_of(widget)
    viewer.add_image(np.zeros((20, 24)), name="first")
    second = viewer.add_image(np.zeros((20, 24)), name="second")
    widget.device = "cpu"
    widget.image = second
    assert widget.device == "cpu"


def test_the_paper_model_can_be_solved_to_convergence(widget, small_sample, run):
    small_sample(viewer_of(widget))
    widget.model = "paper, converged"
    prior, optimizer = solved(widget)
    assert prior == SeilerPrior()
    assert converged(optimizer.parameters)
    solution = run(widget).solution
    longer = solve_again(widget, SeilerPrior(), ICM(100_000, steps=None, energy_change=1e-9))
    np.testing.assert_allclose(solution.displacement, longer.displacement, atol=0.01)
    assert solution.convergence.error <= Multigrid.tolerance
    assert "iterations in" in widget.details


def solve_again(widget, prior, optimizer=None):
    """Solve the study of the layers as a script would, and return the solution."""
    stated = build_problem(replace(widget.study, prior=prior))
    return solve(stated.problem, stated.prior, optimizer=optimizer, backend="cpu")


def test_the_dock_and_a_script_solve_elastic_tissue_alike(widget, small_sample, run):
    small_sample(viewer_of(widget))
    elastic(widget)
    widget.plane = "strain"
    solution = run(widget).solution
    expected = solve_again(widget, ElasticPrior(0.45, plane="strain"))
    np.testing.assert_array_equal(solution.displacement, expected.displacement)
    stress = solve_again(widget, ElasticPrior(0.45, plane="stress"))
    assert np.abs(solution.displacement - stress.displacement).max() > 0.05


def test_only_settings_of_the_chosen_model_are_shown(widget, small_sample):
    image, *_ = small_sample(viewer_of(widget))
    form = widget._form.model
    always = {"device", "live"}
    papers = {"reading", "penalty"}
    sweeps = {"method", "sweeps", "energy_change"}

    def visible_settings():
        return {field.name for field in form.in_detail if not field.native.isHidden()}

    assert visible_settings() == always | papers | sweeps
    widget.model = "paper, converged"
    assert visible_settings() == always | papers | {"accuracy"}
    assert form.plane.native.isHidden()
    elastic(widget)
    assert visible_settings() == always | {"accuracy", "grip", "strain", "drift"}
    assert not form.plane.native.isHidden()
    assert form.poisson.native.isHidden()  # The table has the ratios.
    widget.tissue = image
    assert not form.poisson.native.isHidden()
    widget.model = "paper"
    assert form.plane.native.isHidden()
    assert form.poisson.native.isHidden()


RIGID = "'Tissue' has rigid tissue ('gel'), which the model 'paper' does not support"


def make_rigid(widget):
    Cell(widget._form.tissue.table, 1, 2).write("rigid")


def test_an_error_of_the_paper_model_with_rigid_tissue_is_shown_without_a_solve(
    widget, small_sample, wait_for
):
    small_sample(viewer_of(widget))
    make_rigid(widget)
    wait_for(lambda: RIGID in widget.status)
    widget.model = "elastic"
    wait_for(lambda: widget.status == "Press Deform.")
    widget.model = "paper"
    wait_for(lambda: RIGID in widget.status)
    Cell(widget._form.tissue.table, 1, 2).write("900")
    wait_for(lambda: widget.status == "Press Deform.")


def paint_bone(widget, *place):
    tissue = widget.tissue
    painted = np.array(tissue.data)
    painted[place] = label = widget._form.tissue.table.add()
    *others, new = widget.materials
    widget.materials = (*others, replace(new, name="bone or implant", stiffness=np.inf))
    assert new.label == label
    tissue.data = painted


def test_painted_bone_moves_as_a_rigid_body(widget, small_sample, run):
    small_sample(viewer_of(widget))
    paint_bone(widget, slice(4, 8), slice(9, 14))
    elastic(widget)
    d = run(widget).solution.displacement[4:8, 9:14].astype(float)
    rows, cols = np.indices(d.shape[:2])
    turn = np.polyfit(cols[0], d[0, :, 0], 1)[0]
    still = d - turn * np.stack([cols, -rows], axis=-1)
    assert np.ptp(still, axis=(0, 1)).max() < 1e-4
    assert abs(turn) > 1e-3, "the bone, which lies off the centre, does not rotate"
    assert d[..., 1].min() > 0.5


def test_a_boundary_that_would_deform_a_rigid_body_is_refused_by_name(widget, small_sample, run):
    small_sample(viewer_of(widget))
    paint_bone(widget, slice(4, 16), slice(2, -2))
    elastic(widget)
    assert run(widget) is None
    assert widget.status.startswith("'Boundary' moves pixels of the rigid body around")


def test_the_tolerance_can_be_chosen(widget):
    widget.model = "paper, converged"
    assert solved(widget)[1] == Multigrid()
    widget.settings = replace(widget.settings, accuracy=0.1)
    assert solved(widget)[1] == Multigrid(0.1)


def test_choosing_the_paper_model_restores_the_settings_of_the_paper(widget, small_sample, run):
    small_sample(viewer_of(widget))
    widget.settings = replace(widget.settings, sweeps=70)
    papers = run(widget).solution
    elastic(widget)
    widget.settings = SolverDetails("blanket", "closed form", sweeps=12, penalty=5.0, accuracy=0.1)
    widget.device = "cpu"
    run(widget)
    Screen(widget).choose(MODELS["paper"])
    assert solved(widget) == (SeilerPrior(), ICM())
    assert (widget.settings, widget.device) == (SolverDetails(), "cpu")
    again = run(widget).solution
    np.testing.assert_array_equal(again.displacement, papers.displacement)
    np.testing.assert_array_equal(again.energy, papers.energy)


def test_the_typical_strain_belongs_to_elastic_models_and_a_drift_to_linear_ones(qtbot):
    form = ModelForm()
    qtbot.addWidget(form.native)
    for model, has_strain in (("elastic", True), ("large motion", True), ("paper", False)):
        form.choice = ModelChoice(model)
        assert form.in_detail.strain.native.isHidden() != has_strain
        assert form.in_detail.drift.native.isHidden() == (model != "elastic")
    # A drift that was ticked before can be switched off.
    form.choice = ModelChoice("large motion", drift=True)
    assert not form.in_detail.drift.native.isHidden()


def test_settings_that_cannot_be_typed_are_shown(qtbot):
    form = ModelForm()
    qtbot.addWidget(form.native)
    for details in (SolverDetails(sweeps=200_000), SolverDetails(penalty=1e12)):
        form.choice = ModelChoice("paper", details=details)
        assert form.choice.details == details


def test_choosing_the_same_model_again_restores_its_settings(widget):
    assert widget.settings.sweeps == 3
    menu = widget._form.model.model.native
    menu.activated.emit(menu.currentIndex())
    assert solved(widget) == (SeilerPrior(), ICM())


def test_the_plane_conditions_differ_most_for_nearly_incompressible_tissue():
    changes = {}
    for name in ("expansion", "mass-effect"):
        problem = phantom(name, 128).problem
        for nu in (0.45, 0.49):
            thin, thick = (
                solve(problem, ElasticPrior(nu, plane=plane), backend="cpu").displacement
                for plane in ("stress", "strain")
            )
            tissue = problem.stiffness > 0
            changes[name, nu] = np.linalg.norm((thin - thick)[tissue]) / np.linalg.norm(
                thin[tissue]
            )
        assert changes[name, 0.45] < changes[name, 0.49]
    assert changes["expansion", 0.45] < 0.08
    assert changes["mass-effect", 0.49] > 0.5


# Poisson's ratio


def test_the_table_has_poisson_ratios_only_for_deformable_tissue_and_elastic_models(
    widget, small_sample
):
    small_sample(viewer_of(widget))
    table = widget._form.tissue.table
    assert [Cell(table, row, POISSON).text() for row in (0, 1)] == ["", "0.45"]
    make_rigid(widget)
    assert table.isColumnHidden(POISSON)


def test_a_valid_poisson_ratio_is_accepted_and_an_invalid_one_is_reset(widget, small_sample):
    _, tissue, _ = small_sample(viewer_of(widget))
    elastic(widget)
    table = widget._form.tissue.table
    Cell(table, 1, POISSON).write("0,3")
    assert widget.materials[1].poisson == 0.3
    assert tissue.metadata[METADATA]["materials"][1]["poisson"] == 0.3
    for nonsense in ("0.5", "-0.1", "much"):
        Cell(table, 1, POISSON).write(nonsense)
        assert widget.materials[1].poisson == 0.3


def test_tables_without_poisson_ratios_can_be_opened(widget, small_sample):
    _, tissue, _ = small_sample(viewer_of(widget))
    kept = dict(tissue.metadata[METADATA])
    kept["materials"] = [{"label": 1, "name": "gel", "stiffness": 7.0}]
    other = viewer_of(widget).add_labels(tissue.data, name="old", metadata={METADATA: kept})
    widget.tissue = other
    assert Material(1, "gel", 7.0, 0.45) in widget.materials


def test_tissue_with_a_larger_poisson_ratio_bulges_more(widget, small_sample, run):
    """Squeeze a block between two sliding walls: it widens according to its ratio."""
    _, tissue, boundary = small_sample(viewer_of(widget))
    elastic(widget)
    widget.rules = (
        BoundaryRule(1, "move", vector=(0.0, 2.0), confidence=(0.0, 1.0)),
        BoundaryRule(2, "move", vector=(0.0, -2.0), confidence=(0.0, 1.0)),
    )
    boundary.data[9, 11] = 3
    boundary.refresh()
    widget.rules = (*widget.rules, BoundaryRule(3, "fixed", confidence=(1.0, 0.0)))
    grown = []
    for poisson in (0.0, 0.3):
        widget.materials = (widget.materials[0], Material(1, "gel", 20.0, poisson))
        d = run(widget).solution.displacement
        inside = tissue.data == 1
        rows = np.nonzero(inside.any(axis=1))[0]
        top, bottom = rows.min(), rows.max()
        grown.append(float((d[bottom, 11, 0] - d[top, 11, 0]) / (bottom - top)))
        cols = np.nonzero(inside.any(axis=0))[0]
        squeezed = -4.0 / (cols.max() - cols.min())
    np.testing.assert_allclose(grown, [0.0, -0.3 * squeezed], atol=2e-3)


def test_each_tissue_has_its_own_poisson_ratio(widget, small_sample, run):
    _, tissue, _ = small_sample(viewer_of(widget))
    tissue.data[2:-2, 12:-2] = 2
    tissue.refresh()
    elastic(widget)
    air = Material(0, "air", 0.0)
    fields = []
    for first, second in ((0.1, 0.1), (0.1, 0.45), (0.45, 0.45)):
        widget.materials = (air, Material(1, "a", 20.0, first), Material(2, "b", 20.0, second))
        fields.append(run(widget).solution.displacement)
    low, mixed, high = fields
    left, right = np.s_[8, 7, :], np.s_[4, 17, 0]
    assert np.abs(mixed - low).max() > 0.05
    assert np.abs(mixed - high).max() > 0.05
    assert np.isfinite(mixed[left]).all()
    assert abs(mixed[right] - high[right]) < abs(mixed[right] - low[right])


def test_a_preset_sets_poisson_ratios(widget, small_sample):
    small_sample(viewer_of(widget))
    glia = PRESETS[1]
    widget.take_materials(glia)
    found = {material.label: material.poisson for material in widget.materials}
    assert (found[1], found[2], found[3]) == (0.4, 0.1, 0.45)


def test_a_new_tissue_has_the_values_of_the_first_tissue_except_its_name(widget, small_sample):
    small_sample(viewer_of(widget))
    widget.materials = (widget.materials[0], Material(1, "gel", 33.0, 0.2))
    widget._form.tissue.table.add()
    assert widget.materials[-1] == Material(2, "tissue 2", 33.0, 0.2)


def test_an_image_of_stiffness_has_one_poisson_ratio(widget, small_sample, run):
    viewer = viewer_of(widget)
    _, tissue, _ = small_sample(viewer)
    stiffness = viewer.add_image(20.0 * (tissue.data == 1), name="stiffness")
    elastic(widget)
    widget.tissue = stiffness
    widget.poisson = 0.2
    solution = run(widget).solution
    assert solution.provenance.parameters["prior"]["poisson"] == 0.2
    widget.tissue = tissue
    widget.materials = (widget.materials[0], Material(1, "gel", 20.0, 0.2))
    np.testing.assert_array_equal(run(widget).solution.displacement, solution.displacement)


# Results


def test_results_name_their_model(widget, small_sample, run):
    small_sample(viewer_of(widget))
    run(widget)
    assert "MR arrows, paper" in names(widget)
    assert ", paper, moved up to" in widget.details
    elastic(widget)
    run(widget)
    assert {"MR arrows, elastic", "MR deformed, elastic"} < set(names(widget))
    assert "MR arrows, paper" not in names(widget)
    assert "iterations in" in widget.details
    assert ", within 0.0" in widget.details
    known = viewer_of(widget).layers["MR arrows, elastic"].metadata[METADATA]
    assert known["model"] == "elastic (Poisson's ratio 0.45, plane stress), converged"
    assert known["provenance"]["parameters"]["prior"]["name"] == "ElasticPrior"
    assert known["provenance"]["model"] == "elastic"
    widget.model = "paper, converged"
    run(widget)
    assert "MR arrows, paper, converged" in names(widget)


def test_a_layer_name_chosen_by_the_user_is_preserved(widget, small_sample, run):
    small_sample(viewer_of(widget))
    run(widget)
    viewer_of(widget).layers["MR arrows, paper"].name = "mine"
    widget.model = "elastic"
    run(widget)
    assert "mine" in names(widget)
    assert "MR deformed, elastic" in names(widget)


def test_a_change_of_the_model_marks_the_result_as_outdated(widget, small_sample, run, wait_for):
    small_sample(viewer_of(widget))
    widget.settings = replace(widget.settings, sweeps=70)
    run(widget)
    elastic(widget)
    wait_for(
        lambda: widget.status == "The inputs have changed since the last result. Press Deform."
    )
    widget.model = "paper"
    wait_for(lambda: widget.status.startswith("Tissue moved"))


# Errors


def test_tissue_that_could_rotate_is_refused_in_one_sentence(widget, small_sample, run):
    *_, boundary = small_sample(viewer_of(widget))
    boundary.data[:] = 0
    boundary.data[10, 10] = 1
    boundary.refresh()
    elastic(widget)
    assert run(widget) is None
    assert widget.status.startswith("'Boundary' leaves a piece of tissue free: the piece of 320 ")
    assert "could still move by turning" in widget.status
    assert "Fix part of it in place" in widget.status
    assert not any("arrows" in name for name in names(widget))
    widget.model = "paper"
    assert run(widget) is not None


def test_a_solve_that_does_not_converge_is_reported_and_adds_no_layer(
    widget, small_sample, run, monkeypatch
):
    small_sample(viewer_of(widget))
    elastic(widget)
    hasty = property(lambda _: Multigrid(1e-3, max_iterations=1))
    monkeypatch.setattr(ModelChoice, "optimizer", hasty)
    assert run(widget) is None
    assert widget.status.startswith("No result: ")
    assert "error of the field is still" in widget.status
    assert widget.status.endswith(".")
    assert not any("arrows" in name for name in names(widget))


def test_tissue_of_low_confidence_may_slip_and_certain_tissue_is_prescribed(
    widget, small_sample, run
):
    small_sample(viewer_of(widget))
    widget.rules = (
        widget.rules[0],
        BoundaryRule(2, "move", vector=(0.0, 3.0), confidence=(0.5, 0.5)),
    )
    run(widget)
    assert "held exactly" not in widget.status
    elastic(widget)
    pushed = widget.boundary.data == 2
    slipped = run(widget).solution.displacement[pushed]
    assert "held exactly" not in widget.status
    assert slipped[:, 1].min() > 0
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(0.0, 3.0)))
    np.testing.assert_allclose(run(widget).solution.displacement[pushed], [[0, 3]] * 16, atol=1e-4)


def test_a_boundary_with_a_small_holding_force_slips(widget, small_sample, run):
    small_sample(viewer_of(widget))
    elastic(widget)

    def stretched():
        across = run(widget).solution.displacement[10, :, 1]
        return across[-3] - across[2]

    assert stretched() == pytest.approx(3, abs=1e-3)
    widget.settings = replace(widget.settings, grip=0.05)
    # Both sides slip alike, so only the difference is determined.
    assert 0.1 < stretched() < 2.9


def test_a_boundary_too_thin_for_the_schedule_causes_no_note_for_elastic_tissue():
    from napari.layers import Labels

    from tests.support.study_reader import read_layers

    rows, cols = np.mgrid[:160, :160]
    r = np.hypot(rows - 80, cols - 80)
    labels = ((r > 50) & (r <= 51)).astype(np.uint8)
    wanted = Request(
        tissue=Labels(np.ones((160, 160), np.uint8), name="Tissue"),
        boundary=Labels(labels, name="Boundary"),
        image=Image(np.zeros((160, 160)), name="MR"),
        materials=(Material(1, "gel", 20.0),),
        rules=(BoundaryRule(1, "expand", amount=3.0),),
    )
    assert any("so thin" in note for note in read_layers(wanted).notes)
    notes = read_layers(wanted, ElasticPrior()).notes
    assert not any("so thin" in note for note in notes)


def test_all_typed_digits_of_a_force_are_accepted(widget, qtbot):
    field = widget._form.model.in_detail["grip"]
    field.native.selectAll()
    qtbot.keyClicks(field.native, "0.25")
    field.native.interpretText()
    assert widget.settings.grip == 0.25
