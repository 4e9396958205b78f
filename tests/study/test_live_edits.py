"""Live solves during random edits, undo and redo, compared with cold solves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napari_hmrf import ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.live_solver import LiveSolver
from napari_hmrf.study.edit_history import EditHistory
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    boundary_images,
    poisson_image,
    stiffness_image,
)
from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Rendering, Stroke
from tests.support.timeouts import LONG

SHAPE = (18, 20)
ROWS, COLS = np.indices(SHAPE)
TISSUE = np.where(np.hypot(ROWS - 9, COLS - 12) < 4, 2, 1)
BOUNDARY = np.zeros(SHAPE, int)
BOUNDARY[0] = BOUNDARY[-1] = BOUNDARY[:, 0] = 1
BOUNDARY[4:14, -1] = 2

FIRST = {
    "drawing": Drawing(),
    "materials": (Material(1, "soft", 10.0), Material(2, "stiff", 40.0)),
    "rules": (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 1.0))),
}

places = st.tuples(st.integers(3, 14), st.integers(3, 16))
moves = st.tuples(st.floats(-2, 2, width=16), st.floats(-2, 2, width=16))
edits = st.lists(
    st.tuples(
        st.sampled_from(["pull", "drag", "pin", "free", "remove", "stiffness", "poisson", "rule"])
        | st.sampled_from(["undo", "undo", "redo"]),
        places,
        moves,
        st.sampled_from(["at once", "at once", "a solve later", "when settled"]),
    ),
    min_size=1,
    max_size=14,
)


def new_history():
    steps = EditHistory()
    for slot, value in FIRST.items():
        steps.setdefault(slot, value)
    return steps


def edit(steps, what, place, move, submit_state):
    """Apply one edit and call `submit_state` after every intermediate state."""
    drawing, materials, rules = (steps.get(slot) for slot in FIRST)
    if what in ("undo", "redo"):
        getattr(steps, what)()
    elif what == "pull":
        steps.do("drawing", drawing.with_mark(Arrow(place, move, 2.0)), "pulled")
    elif what == "drag":
        steps.begin("drawing", "dragged")
        for part in (0.25, 0.5, 1.0):
            by = (part * move[0], part * move[1])
            steps.update(drawing.with_mark(Arrow(place, by, 2.0)))
            submit_state()
        steps.end()
    elif what in ("pin", "free"):
        line = (place, (place[0], min(place[1] + 4, 18)))
        steps.do("drawing", drawing.with_mark(Stroke(what, (line,), 1.5)), what)
    elif what == "remove" and drawing.marks:
        steps.do("drawing", drawing.without(place[0] % len(drawing.marks)), "removed")
    elif what == "stiffness":
        lump = Material(2, "stiff", 10.0 * 4 ** move[0], materials[1].poisson)
        steps.do("materials", (materials[0], lump), "stiffened")
    elif what == "poisson":
        softer = Material(1, "soft", 10.0, 0.2 + 0.1 * abs(move[0]))
        steps.do("materials", (softer, materials[1]), "changed")
    elif what == "rule":
        steps.do("rules", (rules[0], BoundaryRule(2, "move", vector=move)), "pushed")
    submit_state()


def painted_canvas(rules):
    """Return a canvas with the painted boundary."""
    canvas = Canvas.blank(BOUNDARY.shape)
    canvas.observed[...], canvas.confidence[...] = boundary_images(BOUNDARY, rules, spacing=1)
    return canvas


def problem_of(state, prior, rendering=None):
    """Return the problem and the prior of a state."""
    if rendering is not None and state["rules"] == FIRST["rules"]:
        rendering.show(state["drawing"])
        canvas = rendering.canvas
    else:
        canvas = state["drawing"].render(painted_canvas(state["rules"]))
    if isinstance(prior, ElasticPrior):
        prior = ElasticPrior(poisson_image(TISSUE, state["materials"]), penalty=prior.penalty)
    return Problem(
        observed=canvas.observed,
        confidence=canvas.confidence,
        stiffness=stiffness_image(TISSUE, state["materials"]),
    ), prior


@pytest.mark.parametrize(
    "prior",
    [ElasticPrior(), ElasticPrior(penalty=0.2), SeilerPrior()],
    ids=["exact", "slips", "paper"],
)
@settings(max_examples=4)
@given(sequence=edits)
def test_live_results_match_a_cold_solve(prior, sequence):
    steps, updates = new_history(), []
    rendering = Rendering(painted_canvas(FIRST["rules"]))

    def now():
        return {slot: steps.get(slot) for slot in FIRST}

    with LiveSolver(updates.append, optimizer=Multigrid(0.01), backend="cpu") as live:

        def submit_state():
            state = now()
            live.submit(lambda: problem_of(state, prior, rendering))

        for what, place, move, next_comes in sequence:
            edit(steps, what, place, move, submit_state)
            if next_comes == "a solve later":
                compute_thread.submit(lambda: None).result(LONG)
            elif next_comes == "when settled":
                assert live.wait(LONG)
                check(updates[-1], now(), prior)
        last = now()
        assert live.wait(LONG)
        check(updates[-1], last, prior)
        while steps.undo() is not None:
            submit_state()
        assert now() == FIRST
        assert live.wait(LONG)
    check(updates[-1], FIRST, prior)


def check(update, state, prior):
    assert update.error is None
    problem, complete = problem_of(state, prior)
    cold = solve(problem, complete, optimizer=Multigrid(1e-4), backend="cpu")
    assert np.abs(update.solution.displacement - cold.displacement).max() <= 0.02
