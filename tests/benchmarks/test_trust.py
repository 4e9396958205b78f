"""Tests of the campaign of random problems, with a short run; ``make trust`` runs a long one."""

from dataclasses import replace

import numpy as np
import pytest
import trust
from exact import exact_field
from random_problems import random_problem

from napari_hmrf import ConvergenceError, ElasticPrior, Multigrid, ProblemError, solve
from tests.support.opengl import require_opengl

campaign = pytest.mark.campaign


def drawn(y=None, c=None, m=None, prior=None, **more):
    """Return a small block, by default fixed at the top and pushed at the bottom."""
    shape = (6, 5)
    if c is None:
        c, y = np.zeros((*shape, 2)), np.zeros((*shape, 2))
        c[0] = c[-1] = 1
        y[-1, :, 0] = 1
    return replace(
        random_problem(0, 1),
        observed=y,
        confidence=c,
        stiffness=np.ones(shape) if m is None else m,
        spacing=(1.0, 1.0),
        prior=prior or ElasticPrior(0.3),
        tolerance=1e-3,
        **more,
    )


@pytest.fixture
def fake_solver(monkeypatch):
    """Return a function that replaces the solver: it shifts the solution or raises an error."""

    def put(error=None, shift=0.0, reported=None):
        def instead(*args, **kwargs):
            if error is not None:
                raise error
            solution = solve(*args, **kwargs)
            moved = solution.displacement.copy()
            moved[2, 2, 0] += shift
            claim = solution.convergence.error if reported is None else reported
            return replace(
                solution,
                displacement=moved,
                convergence=replace(solution.convergence, error=claim),
            )

        monkeypatch.setattr(trust, "solve", instead)

    return put


def test_a_correct_solution_passes(fake_solver):
    fake_solver()
    verdict = trust.judge(drawn(), "cpu")
    assert verdict.outcome == "answered"
    assert not verdict.violation
    assert verdict.error < 3e-3


@pytest.mark.parametrize(
    ("shift", "reported", "outcome"),
    [
        (0.0031 + 1e-3, 1.0, "wrong"),
        (0.001, 1e-5, "reported"),
        (0.001, 1e-3, "answered"),
        (np.nan, None, "crashed"),
    ],
)
def test_a_solution_is_judged_by_its_true_error(fake_solver, shift, reported, outcome):
    fake_solver(shift=shift, reported=reported)
    assert trust.judge(drawn(), "cpu").outcome == outcome


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (ConvergenceError("no"), "refused"),
        (ProblemError("confidence", "no"), "refused"),
        (ZeroDivisionError("no"), "crashed"),
    ],
)
def test_a_refusal_of_a_solvable_problem_is_a_failure(fake_solver, error, outcome):
    fake_solver(error)
    verdict = trust.judge(drawn(), "cpu")
    assert verdict.outcome == outcome
    assert "no" in verdict.saying


def rotating_block():
    """Return a block that is fixed at one site."""
    c = np.zeros((6, 5, 2))
    c[2, 2] = 1
    return drawn(y=np.zeros_like(c), c=c)


def test_a_refusal_of_a_problem_with_free_tissue_passes(fake_solver):
    fake_solver(ConvergenceError("no"))
    assert trust.judge(rotating_block(), "cpu").outcome == "refused, free"
    fake_solver(RuntimeError("no"))
    assert trust.judge(rotating_block(), "cpu").outcome == "crashed"


def test_a_solution_with_free_tissue_must_have_the_smallest_motion(monkeypatch):
    firm, free = drawn(), rotating_block()
    solution = solve(firm.problem, firm.prior, backend="cpu")
    still = replace(solution, displacement=np.zeros_like(solution.displacement))
    monkeypatch.setattr(trust, "solve", lambda *args, **kwargs: still)
    assert trust.judge(free, "cpu").outcome == "answered"
    monkeypatch.setattr(trust, "solve", lambda *args, **kwargs: solution)
    assert trust.judge(free, "cpu").outcome == "free"


def test_a_refusal_of_tissue_one_pixel_wide_passes():
    m = np.zeros((6, 5))
    m[:, 2] = 1
    assert trust.judge(drawn(m=m), "cpu").outcome == "refused, free"


def test_a_solve_beyond_the_time_limit_is_late(monkeypatch):
    monkeypatch.setattr(trust, "_SECONDS", 0.0)
    assert trust.judge(drawn(), "cpu").outcome == "late"


def test_a_solution_is_not_judged_by_an_uncertain_exact_field(fake_solver, monkeypatch):
    fake_solver(shift=1.0)
    monkeypatch.setattr(
        trust, "exact_field", lambda *given: replace(exact_field(*given), sure=False)
    )
    assert trust.judge(drawn(), "cpu").outcome == "unsure"


def test_a_random_problem_is_reproducible_by_seed_and_number():
    first, again, other = (random_problem(*which) for which in ((3, 7), (3, 7), (3, 8)))
    for field in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert first.words == again.words != other.words
    assert first.prior == again.prior


def test_random_problems_cover_all_kinds():
    made = [random_problem(0, number) for number in range(400)]
    assert len({each.reading for each in made}) == 8
    assert max(each.contrast for each in made) > 3e6
    assert max(max(each.stiffness.shape) for each in made) > 60
    assert min(min(each.stiffness.shape) for each in made) == 1
    assert {each.void for each in made} == {"none", "holes", "around", "specks", "gaps"}
    assert {each.tolerance for each in made} == {1e-2, 1e-3, 1e-4}


def test_a_report_counts_failures_and_gives_the_command_for_each(fake_solver, capsys, tmp_path):
    fake_solver(ConvergenceError("not within 0.001 px"))
    page = tmp_path / "trust.md"
    some = ["--loops", "3", "--shaders", "0", "--volumes", "2", "--seed", "5"]
    assert trust.main([*some, "--page", str(page)]) == 1
    said, written = capsys.readouterr().out, page.read_text(encoding="utf-8")
    for text in (said, written):
        assert "3 problems of seed 5 (3 on cpu)" in text
        assert "with the message “not within # px”" in text
        assert "2 random volumes: " in text
        assert "`--seed 5 --only " in text
    assert written.startswith("# Random problems against exact solutions\n")


def test_a_problem_is_run_again_by_its_number(fake_solver, capsys):
    fake_solver(ConvergenceError("no"))
    assert trust.main(["--only", "2", "--seed", "5"]) == 1
    assert capsys.readouterr().out.startswith("refused: `--seed 5 --only 2 --backend cpu`")


def test_random_problems_are_solved_on_the_cpu():
    # Of the first hundred, some whose exact solution is quick, of each energy.
    numbers = (1, 3, 7, 9, 10, 11, 12, 13, 21, 23, 82)
    run = trust.campaign([(number, "cpu") for number in numbers])
    assert len({verdict.reading for verdict in run.verdicts}) == 8
    assert run.sound, trust.report(run)


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(3423, id="fibres with an eigenvalue ratio of 4e-14"),
        pytest.param(4280, id="slipping blobs with an eigenvalue ratio of 9e-12", marks=campaign),
        pytest.param(
            1195,
            id="stiff fibres with one observation, and none in one direction",
            marks=campaign,
        ),
        pytest.param(1079, id="soft blobs that slip at a force below the rounding of stiff blobs"),
        pytest.param(3527, id="tissue with displacements of 190,000 pixels"),
        pytest.param(1510, id="centred: slipping of one site moves the rest by half a pixel"),
        pytest.param(4194, id="centred: slipping of two rows of fibres"),
        pytest.param(2015, id="a checkerboard of four pixels by thirteen"),
        pytest.param(
            2797, id="nearly incompressible layers with displacements of 26 pixels", marks=campaign
        ),
        pytest.param(3249, id="a slipping strip three pixels wide"),
    ],
)
def test_the_most_difficult_known_problems_are_solved(number):
    verdict = trust.judge(random_problem(0, number), "cpu")
    assert verdict.outcome == "answered", verdict


@campaign
def test_an_interior_point_method_does_not_cycle():
    verdict = trust.judge(random_problem(7001, 2400), "cpu")
    assert verdict.outcome == "answered", verdict


def test_residuals_of_rounding_size_do_not_cause_repeated_solves():
    drawn = random_problem(0, 3527)
    said = []
    solve(
        drawn.problem,
        drawn.prior,
        optimizer=Multigrid(drawn.tolerance),
        backend="cpu",
        progress=said.append,
    )
    solutions = [monitor for monitor in said if monitor.message.startswith("direct solve")]
    assert 0 < len(solutions) < 30


def test_random_problems_are_solved_by_shaders():
    require_opengl()
    run = trust.campaign([(number, "opengl") for number in range(6)])
    assert run.sound, trust.report(run)


def test_intermediate_states_with_too_few_constraints_are_passed():
    """Some intermediate states move tissue by 367,727 px, where no residual meets the tolerance."""
    assert trust.judge(random_problem(301, 1482), "cpu").outcome == "answered"


@campaign
def test_slipping_tissue_is_solved_at_any_tolerance():
    # Interior points that start at the end of the exchanges converge at some tolerances only.
    drawn = random_problem(7, 546)
    fields = [
        solve(drawn.problem, drawn.prior, optimizer=Multigrid(tolerance), backend="cpu")
        for tolerance in (1e-2, 1e-4)
    ]
    np.testing.assert_allclose(fields[0].displacement, fields[1].displacement, atol=1e-6)


def test_an_interior_point_starts_with_sites_that_have_no_clique():
    assert trust.judge(random_problem(403, 464), "cpu").outcome == "answered"
