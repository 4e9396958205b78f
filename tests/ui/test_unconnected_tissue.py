"""Tests of unconnected pieces of tissue, which are excluded from the solve."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image

from napari_hmrf import ElasticPrior, Problem, ProblemError, solve
from napari_hmrf.layers.metadata import BOUNDARY, METADATA, TISSUE, layer_metadata
from napari_hmrf.solver.unconnected import left_at_rest, scraps
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.messages import STILL
from napari_hmrf.ui.motion.tools import BY_NAME
from tests.support.person import by_name
from tests.support.study_reader import read_ground


def block_and_specks(size=24):
    """Return a block of tissue with a speck at its corner and a separate speck, and the
    constraints."""
    tissue = np.zeros((size, size), dtype=bool)
    tissue[4:18, 4:18] = True
    tissue[17:19, 17:19] = True
    tissue[21:23, 2:5] = True
    held = np.zeros((size, size, 2), dtype=bool)
    held[4:18, 4] = True
    return tissue, held


def test_pieces_that_could_rotate_or_translate_are_excluded():
    tissue, held = block_and_specks()
    found = scraps(tissue, held)
    assert found[21:23, 2:5].all(), "the separate piece is not excluded"
    assert found[18, 18], "the piece at the corner, which could rotate, is not excluded"
    assert not found[17, 17], "the corner of the block is excluded"
    assert found.sum() == 6 + 3
    assert left_at_rest(found).startswith(
        "2 pieces of tissue with too few constraints stay at rest"
    )
    solution = solve(
        Problem(observed=0.0 * held, confidence=1.0 * held, stiffness=1.0 * (tissue & ~found)),
        ElasticPrior(),
    )
    assert not solution.displacement.any()
    with pytest.raises(ProblemError, match="free"):
        solve(
            Problem(observed=0.0 * held, confidence=1.0 * held, stiffness=1.0 * tissue),
            ElasticPrior(),
        )


def test_a_large_piece_with_few_observations_is_not_excluded():
    tissue, held = block_and_specks()
    held[:] = False
    held[10, 10] = True
    found = scraps(tissue, held)
    assert not found[4:17, 4:17].any(), (
        "the block is excluded, although the solver should refuse its rotation"
    )
    assert not scraps(tissue, np.zeros_like(held)).any()


@pytest.mark.parametrize(("pixels", "meant"), [(9, False), (10, True)])
def test_a_constrained_piece_of_a_hundredth_of_the_tissue_is_not_excluded(pixels, meant):
    tissue = np.zeros((40, 40), dtype=bool)
    tissue[:33, :30] = True
    tissue[36:38, 10:15] = True
    if pixels < 10:
        tissue[37, 14] = False
        tissue[0, 30] = True  # The amount of tissue remains the same.
    assert tissue.sum() == 1000
    held = np.zeros((40, 40, 2), dtype=bool)
    held[:33, 0] = True
    held[36, 10] = True  # The piece could rotate about this pixel.
    assert scraps(tissue, held)[36, 10] != meant


def test_a_fully_constrained_piece_is_not_excluded():
    tissue, held = block_and_specks()
    assert scraps(tissue, held)[21, 2]
    held[21:23, 2:5] = True
    assert not scraps(tissue, held)[21, 2]


def stiffness_with_specks():
    tissue, _ = block_and_specks()
    metadata = {METADATA: {"role": TISSUE}}
    picture = (tissue * 200).astype(np.uint8)
    return picture, Image(tissue.astype(np.float32), name="stiffness", metadata=metadata)


def test_tissue_with_specks_can_be_pulled(open_beside, settle):
    picture, stiffness = stiffness_with_specks()
    person, widget = open_beside(picture)
    person.viewer.add_layer(stiffness)
    widget.tissue = stiffness
    widget.hold_edge = False
    widget.start()
    widget.drawing = Drawing((Arrow((10, 10), (0, 2), 3.0),))
    settle(widget)
    field = widget.solution.displacement
    assert field[10, 10] == pytest.approx((0, 2), abs=0.02)
    assert not field[22, 3].any()
    assert "2 pieces of tissue with too few constraints stay at rest (9 pixels)" in widget.warning
    assert by_name(person.viewer, "MR deformed, elastic").visible


def test_an_error_about_unconstrained_tissue_names_the_layer():
    picture, stiffness = stiffness_with_specks()
    ground = read_ground(Image(picture, name="MR"), stiffness, hold_edge=False)
    canvas = Drawing((Arrow((10, 10), (0, 2), 0.5),)).render(ground.base)
    stated = ground.statement(canvas)
    problem, prior = stated.problem, stated.prior
    with pytest.raises(ProblemError, match=r"^confidence: leaves") as refused:
        solve(problem, prior)
    assert str(ground.study.in_words(refused.value)).startswith("'Motion' leaves a piece of tissue")


def paint(widget, wall=True, moves=True):
    """Show elastic tissue, specks, a fixed wall and a moving region beside the dock."""
    viewer = widget._viewer
    viewer.layers.clear()
    picture, stiffness = stiffness_with_specks()
    viewer.add_image(picture, name="MR")
    viewer.add_layer(stiffness)
    labels = np.zeros(picture.shape, np.uint8)
    if wall:
        labels[4:18, 4:6] = 1
    if moves:
        labels[9:12, 12:15] = 2
    rules = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 1.0)))
    viewer.add_labels(labels, name="Boundary", metadata=layer_metadata(BOUNDARY, rules))
    widget.model = "paper"


def test_missing_motion_or_missing_constraints_are_reported(widget, run):
    paint(widget, moves=False)
    run(widget)
    assert STILL in widget.status
    assert widget.warning.startswith("Nothing moves: mark tissue that moves")
    paint(widget)
    moved = widget.rules[1]
    widget.rules = (widget.rules[0], replace(moved, confidence=(0.0, 0.0)))
    run(widget)
    assert STILL in widget.status
    assert "Nothing moves: mark tissue that moves" in widget.warning
    widget.rules = (widget.rules[0], moved)
    widget.tissue.data[8:13, 11:16] = 0
    widget.tissue.refresh()
    run(widget)
    assert STILL in widget.status
    assert "9 boundary pixels outside tissue were ignored. Nothing moves" in widget.warning
    paint(widget, wall=False)
    run(widget)
    assert "Nothing holds the tissue" in widget.warning
    paint(widget)
    widget.model = "elastic"
    run(widget)
    assert "2 pieces of tissue with too few constraints stay at rest (9 pixels)." in widget.warning
    assert "othing" not in widget.warning.split("pieces")[0]


def test_a_pull_of_unconstrained_tissue_reports_its_rigid_motion(pulling_beside, settle):
    touch, widget = pulling_beside
    widget.hold_edge = False
    settle(widget)
    touch.drag((32, 32), (32, 36))
    settle(widget)
    said = "Nothing holds the tissue, so that all of it moves as one: hold its edge, or paint the"
    assert widget.active
    assert widget.status.startswith(said)
    assert widget.status.endswith(BY_NAME["pull"].hint), "the hint of the tool is missing"
    assert widget.warning.startswith(said)
    field = widget.solution.displacement
    np.testing.assert_allclose(field, np.broadcast_to((0, 4), field.shape), atol=0.02)
    widget.tool = "pin"
    touch.paint((50, 8), (50, 16))
    settle(widget)
    assert "othing holds" not in widget.status + widget.warning
    widget.drawing = Drawing(widget.drawing.marks[:1])
    settle(widget)
    assert widget.warning.startswith(said)
    widget.hold_edge = True
    settle(widget)
    assert "othing holds" not in widget.status + widget.warning
