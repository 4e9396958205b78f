"""Live solver: the last edit is delivered, for any order and timing of edits."""

import threading
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napari_hmrf import (
    ICM,
    ArgumentError,
    ElasticPrior,
    Multigrid,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver import live_solver as live_module
from napari_hmrf.solver.live_solver import LiveSolver
from tests.support.timeouts import LONG
from validation.bodies import pulled_problem

SIZE = 20


def unconstrained_problem():
    """Return a problem with an unconstrained right half."""
    problem = pulled_problem()
    m = np.array(problem.stiffness)
    m[:, 10] = 0
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence * (np.arange(SIZE) < 9)[:, None],
        stiffness=m,
    )


def raise_problem_error():
    raise ProblemError("observed", "cannot be read")


@pytest.fixture
def updates():
    return []


@pytest.fixture
def live(updates):
    with LiveSolver(updates.append, backend="cpu") as made:
        yield made


@pytest.fixture
def pause():
    """Block the compute thread until the event is set."""
    go = threading.Event()
    compute_thread.submit(lambda: go.wait(30))
    yield go
    go.set()


def cold(problem, prior=None):
    return solve(problem, prior or ElasticPrior(), optimizer=Multigrid(1e-4), backend="cpu")


def largest_distance(one, other):
    return float(np.abs(one.displacement - other.displacement).max())


#: Number of turns of the compute thread between two edits.
turns = st.sampled_from([0, 0, 0, 1, 2])


def run_turns(turns):
    for _ in range(turns):
        compute_thread.submit(lambda: None).result(LONG)


edits = st.lists(
    st.tuples(
        st.sampled_from(["move", "move", "move", "elsewhere", "stiffen", "grid", "bad", "cancel"]),
        st.tuples(st.floats(-4, 4), st.floats(-4, 4)),
        st.booleans(),
        turns,
    ),
    min_size=1,
    max_size=12,
)


@settings(max_examples=4)
@given(edits, st.sampled_from([0.0, 0.004, 0.1]), st.sampled_from([np.inf, 0.05]))
def test_the_final_result_depends_only_on_the_last_edit(edits, patience, penalty):
    updates, latest = [], {}
    prior = ElasticPrior(poisson=0.4, penalty=penalty)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_module, "PATIENCE", patience)
        with LiveSolver(updates.append, prior, backend="cpu") as live:
            state = {}
            for kind, vector, late, later in [*edits, ("move", (1.0, 2.0), True, 0)]:
                state["vector"] = vector
                if kind == "elsewhere":
                    state["at"] = (8 + vector[0], 10 + vector[1])
                elif kind == "stiffen":
                    state["stiff"] = 10.0 * 2 ** vector[0]
                elif kind == "grid":
                    state["size"] = 16 if state.get("size", SIZE) == SIZE else SIZE
                elif kind == "cancel":
                    live.cancel()
                if kind == "bad":
                    live.submit(raise_problem_error)
                else:
                    latest = dict(state)
                    edit = partial(pulled_problem, **latest)
                    live.submit(edit if late else edit())
                run_turns(later)
            number = live.submit(pulled_problem(**latest))
            assert live.wait(LONG)
    last = updates[-1]
    assert (last.number, last.final, last.error) == (number, True, None)
    assert largest_distance(last.solution, cold(pulled_problem(**latest), prior)) <= 0.02
    numbers = [update.number for update in updates]
    assert numbers == sorted(numbers)


def test_only_the_latest_pending_edit_is_evaluated(live, updates, pause):
    read = []

    def reading(vector):
        read.append(vector)
        return pulled_problem(vector)

    for row in range(6):
        live.submit(lambda row=row: reading((row, 0.0)))
    pause.set()
    assert live.wait(LONG)
    assert read == [(5, 0.0)]
    assert [(update.number, update.final) for update in updates] == [(6, True)]


@pytest.mark.parametrize("patience", [0.0, 60.0])
def test_every_result_of_an_uninterrupted_drag_is_delivered(monkeypatch, patience):
    """The next edit is already pending at each result, but no result is discarded."""
    monkeypatch.setattr(live_module, "PATIENCE", patience)
    updates = []

    def next_edit(update):
        updates.append(update)
        if update.number < 8:
            live.submit(pulled_problem((update.number / 4, 1.0)))

    with LiveSolver(next_edit, backend="cpu") as live:
        live.submit(pulled_problem((0.0, 1.0)))
        assert live.wait(LONG)
    assert {update.number for update in updates} == set(range(1, 9))
    assert [update.final for update in updates if update.number == 8][-1]


def test_moving_a_patch_again_takes_fewer_cycles(live, updates):
    for step in range(8):
        live.submit(pulled_problem((0.4 * step, 0.1 * step**2)))
        assert live.wait(LONG)
    cycles = [update.solution.iterations for update in updates]
    assert max(cycles[4:]) < max(cycles[:2])


def test_a_long_solve_delivers_a_preview_first(monkeypatch, live, updates):
    monkeypatch.setattr(live_module, "PATIENCE", 0.0)
    live.submit(pulled_problem())
    assert live.wait(LONG)
    preview, answer = updates
    assert (preview.final, answer.final) == (False, True)
    assert (preview.number, answer.number) == (1, 1)
    exact = cold(pulled_problem())
    assert largest_distance(preview.solution, exact) <= live_module.PREVIEW_TOLERANCE
    assert largest_distance(answer.solution, exact) <= live_module.TOLERANCE


def test_a_solve_after_cancel_equals_a_cold_solve_bit_for_bit(monkeypatch, live, updates):
    monkeypatch.setattr(live_module, "PATIENCE", 0.0)
    live.submit(pulled_problem((3.0, 0.0)))
    assert live.wait(LONG)
    live.cancel()
    updates.clear()
    live.submit(pulled_problem(), preview=False)
    assert live.wait(LONG)
    (answer,) = updates
    cold = solve(pulled_problem(), live.prior, optimizer=live.optimizer, backend="cpu")
    assert np.array_equal(answer.solution.displacement, cold.displacement)


def test_a_newer_edit_replaces_the_solve_after_a_preview(monkeypatch):
    monkeypatch.setattr(live_module, "PATIENCE", 0.0)
    updates = []

    def edit_during_the_first(update):
        updates.append(update)
        if len(updates) == 1:
            live.submit(pulled_problem((-3.0, 0.0)))

    with LiveSolver(edit_during_the_first, backend="cpu") as live:
        live.submit(pulled_problem((3.0, 0.0)))
        assert live.wait(LONG)
    assert [(u.number, u.final) for u in updates] == [(1, False), (2, True)]


@pytest.mark.parametrize(("patience", "answered"), [(None, [1, 2]), (0.0, [2])])
def test_a_solve_beyond_its_patience_is_cancelled_for_a_newer_edit(
    live, updates, patience, answered
):
    def edited_meanwhile():
        live.submit(pulled_problem((-3.0, 0.0)))
        return pulled_problem((3.0, 0.0))

    live.submit(edited_meanwhile, preview=False, patience=patience)
    assert live.wait(LONG)
    assert [update.number for update in updates] == answered


def test_errors_are_delivered_and_later_edits_are_solved(live, updates):
    for problem in (
        raise_problem_error,
        unconstrained_problem,
        lambda: Problem(observed=1, confidence=2, stiffness=3),
        pulled_problem,
    ):
        live.submit(problem)
        assert live.wait(LONG)
    assert [type(update.error) for update in updates] == [ProblemError] * 3 + [type(None)]
    assert [update.problem is None for update in updates] == [True, False, True, False]
    assert all((update.solution is None) != (update.error is None) for update in updates)


def test_unexpected_errors_are_delivered_and_logged(live, updates, caplog):
    live.submit(lambda: 1 / 0)
    assert live.wait(LONG)
    assert isinstance(updates[0].error, ZeroDivisionError)
    assert "a live solve failed" in caplog.text


def test_the_error_of_a_replaced_edit_is_not_delivered(live, updates):
    def hesitating():
        live.submit(pulled_problem())  # submitted while this edit is evaluated
        raise_problem_error()

    live.submit(hesitating)
    assert live.wait(LONG)
    assert [update.error for update in updates] == [None]


@pytest.mark.parametrize("end", ["cancel", "close"])
def test_a_dropped_edit_delivers_no_result(updates, pause, end):
    live = LiveSolver(updates.append, backend="cpu")
    live.submit(pulled_problem())
    assert live.busy
    getattr(live, end)()
    assert not live.busy, "the solver should be idle even while the thread is blocked"
    pause.set()
    assert live.wait(LONG)
    assert updates == []


def test_a_solve_cancelled_while_running_delivers_no_result(live, updates):
    def interrupted():
        live.cancel()
        return pulled_problem()

    live.submit(interrupted)
    assert live.wait(LONG)
    assert updates == []
    live.submit(pulled_problem())
    assert live.wait(LONG)
    assert [update.number for update in updates] == [2]


def test_a_closed_solver_accepts_no_edits(updates):
    live = LiveSolver(updates.append)
    live.close()
    live.close()
    with pytest.raises(RuntimeError, match="closed"):
        live.submit(pulled_problem())


def test_edits_can_change_the_size_of_the_image(live, updates):
    for size in (SIZE, 28, SIZE):
        live.submit(pulled_problem(size=size))
        assert live.wait(LONG)
    for update, size in zip(updates, (SIZE, 28, SIZE), strict=True):
        assert largest_distance(update.solution, cold(pulled_problem(size=size))) <= 0.02


@pytest.mark.parametrize(
    ("prior", "optimizer"), [(SeilerPrior(), ICM(iterations=5)), (SeilerPrior(), Multigrid(0.01))]
)
def test_the_prior_of_the_paper_can_be_solved_live(updates, prior, optimizer):
    with LiveSolver(updates.append, prior, optimizer=optimizer, backend="cpu") as live:
        for row in (1.0, 2.0):
            live.submit(pulled_problem((row, 0.0)))
            assert live.wait(LONG)
    expected = solve(pulled_problem((2.0, 0.0)), prior, optimizer=optimizer, backend="cpu")
    assert largest_distance(updates[-1].solution, expected) <= 0.02


def test_the_backend_can_change_between_edits(live, updates):
    for backend in ("abacus", "cpu"):
        live.backend = backend
        live.submit(pulled_problem())
        assert live.wait(LONG)
    assert "abacus" in str(updates[0].error)
    assert updates[1].error is None


def test_the_prior_can_change_between_edits(live, updates):
    softer, flat = ElasticPrior(0.1), ElasticPrior(0.3, plane="strain")
    live.prior = softer
    live.submit(pulled_problem())
    assert live.wait(LONG)
    live.submit((pulled_problem(), flat))
    assert live.wait(LONG)
    for update, prior in zip(updates, (softer, flat), strict=True):
        assert largest_distance(update.solution, cold(pulled_problem(), prior)) <= 0.02


def test_results_are_delivered_on_the_compute_thread_without_new_threads():
    came = []
    solve(pulled_problem(), ElasticPrior(), backend="cpu")
    before = set(threading.enumerate())
    with LiveSolver(lambda _: came.append(compute_thread.is_current()), backend="cpu") as live:
        live.submit(pulled_problem())
        assert live.wait(LONG)
        assert set(threading.enumerate()) <= before
    assert came == [True]


def test_a_failing_callback_does_not_stop_the_solver(caplog):
    seen = []

    def fragile(update):
        seen.append(update.number)
        raise RuntimeError("the window is gone")

    with LiveSolver(fragile, backend="cpu") as live:
        for _ in range(2):
            live.submit(pulled_problem())
            assert live.wait(LONG)
    assert seen == [1, 2]
    assert "could not be shown" in caplog.text


def test_a_live_solve_reports_progress(updates):
    said = []
    with LiveSolver(updates.append, backend="cpu", progress=said.append) as live:
        live.submit(pulled_problem())
        assert live.wait(LONG)
    assert said[0].message.startswith("preparing")


@pytest.mark.parametrize("name", ["optimiser", "piror"])
def test_a_misspelt_attribute_is_rejected(live, name):
    with pytest.raises(AttributeError, match=name):
        setattr(live, name, None)


@pytest.mark.parametrize("patience", ["a", -1, float("nan"), (1,)])
def test_patience_must_be_a_time(live, patience):
    with pytest.raises(ArgumentError, match="patience must be a time in seconds"):
        live.submit(pulled_problem(), patience=patience)


def test_a_closed_live_solver_names_itself(live):
    live.close()
    with pytest.raises(RuntimeError, match=r"the live solver is closed\. Create a new Live"):
        live.submit(pulled_problem())
