"""A short campaign of random problems; ``make trust`` runs the long one."""

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
    """A small block, its upper edge held and its lower edge pushed, unless something else is."""
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
def answer(monkeypatch):
    """Put something in the place of the solver: what is done to its solution, or an error."""

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


def test_a_good_answer_is_one(answer):
    answer()
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
def test_an_answer_is_judged_by_its_true_error(answer, shift, reported, outcome):
    answer(shift=shift, reported=reported)
    assert trust.judge(drawn(), "cpu").outcome == outcome


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (ConvergenceError("no"), "refused"),
        (ProblemError("confidence", "no"), "refused"),
        (ZeroDivisionError("no"), "crashed"),
    ],
)
def test_a_problem_that_has_an_answer_may_not_be_refused(answer, error, outcome):
    answer(error)
    verdict = trust.judge(drawn(), "cpu")
    assert verdict.outcome == outcome
    assert "no" in verdict.saying


def turning():
    """A block that is held at one site."""
    c = np.zeros((6, 5, 2))
    c[2, 2] = 1
    return drawn(y=np.zeros_like(c), c=c)


def test_a_problem_that_has_none_may_be(answer):
    answer(ConvergenceError("no"))
    assert trust.judge(turning(), "cpu").outcome == "refused, free"
    answer(RuntimeError("no"))
    assert trust.judge(turning(), "cpu").outcome == "crashed"


def test_or_else_its_answer_must_be_the_least_motion(monkeypatch):
    firm, free = drawn(), turning()
    solution = solve(firm.problem, firm.prior, backend="cpu")
    still = replace(solution, displacement=np.zeros_like(solution.displacement))
    monkeypatch.setattr(trust, "solve", lambda *args, **kwargs: still)
    assert trust.judge(free, "cpu").outcome == "answered"
    monkeypatch.setattr(trust, "solve", lambda *args, **kwargs: solution)
    assert trust.judge(free, "cpu").outcome == "free"


def test_tissue_that_is_nowhere_two_pixels_wide_may_be_refused():
    m = np.zeros((6, 5))
    m[:, 2] = 1
    assert trust.judge(drawn(m=m), "cpu").outcome == "refused, free"


def test_a_solve_that_does_not_end_is_late(monkeypatch):
    monkeypatch.setattr(trust, "_SECONDS", 0.0)
    assert trust.judge(drawn(), "cpu").outcome == "late"


def test_a_field_that_is_not_sure_judges_nothing(answer, monkeypatch):
    answer(shift=1.0)
    monkeypatch.setattr(
        trust, "exact_field", lambda *given: replace(exact_field(*given), sure=False)
    )
    assert trust.judge(drawn(), "cpu").outcome == "unsure"


def test_a_problem_can_be_made_alone():
    first, again, other = (random_problem(*which) for which in ((3, 7), (3, 7), (3, 8)))
    for field in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert first.words == again.words != other.words
    assert first.prior == again.prior


def test_every_kind_of_problem_comes_up():
    made = [random_problem(0, number) for number in range(400)]
    assert len({each.reading for each in made}) == 8
    assert max(each.contrast for each in made) > 3e6
    assert max(max(each.stiffness.shape) for each in made) > 60
    assert min(min(each.stiffness.shape) for each in made) == 1
    assert {each.void for each in made} == {"none", "holes", "around", "specks", "gaps"}
    assert {each.tolerance for each in made} == {1e-2, 1e-3, 1e-4}


def test_a_report_counts_and_says_how_to_see_each_again(answer, capsys, tmp_path):
    answer(ConvergenceError("not within 0.001 px"))
    page = tmp_path / "trust.md"
    some = ["--loops", "3", "--shaders", "0", "--volumes", "2", "--seed", "5"]
    assert trust.main([*some, "--page", str(page)]) == 1
    said, written = capsys.readouterr().out, page.read_text(encoding="utf-8")
    for text in (said, written):
        assert "3 problems of seed 5 (3 on cpu)" in text
        assert "saying “not within # px”" in text
        assert "Of 2 random volumes" in text
        assert "`--seed 5 --only " in text
    assert written.startswith("# Random problems against exact solutions\n")


def test_a_problem_is_run_again_by_its_number(answer, capsys):
    answer(ConvergenceError("no"))
    assert trust.main(["--only", "2", "--seed", "5"]) == 1
    assert capsys.readouterr().out.startswith("refused: `--seed 5 --only 2 --backend cpu`")


def test_random_problems_are_answered_as_they_should_be():
    run = trust.campaign([(number, "cpu") for number in range(30)])
    assert run.sound, trust.report(run)


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(3423, id="fibres whose softest motion costs 4e-14 of their stiffest"),
        pytest.param(4280, id="blobs, slipping, of a softest motion of 9e-12", marks=campaign),
        pytest.param(
            1195,
            id="stiff fibres that one observation holds, and in one direction none",
            marks=campaign,
        ),
        pytest.param(
            1079, id="soft blobs that slip at a force that rounding of stiff ones exceeds"
        ),
        pytest.param(3527, id="tissue that reaches 190,000 pixels"),
        pytest.param(1510, id="centred: one that slips or not moves the rest by half a pixel"),
        pytest.param(4194, id="centred: so do two rows of fibres"),
        pytest.param(2015, id="a checkerboard of four pixels by thirteen"),
        pytest.param(
            2797, id="nearly incompressible layers that swing by 26 pixels", marks=campaign
        ),
        pytest.param(3249, id="a strip three pixels wide that slips"),
    ],
)
def test_what_is_hardest_is_answered_too(number):
    verdict = trust.judge(random_problem(0, number), "cpu")
    assert verdict.outcome == "answered", verdict


@campaign
def test_an_interior_point_that_went_in_circles_arrives():
    verdict = trust.judge(random_problem(7001, 2400), "cpu")
    assert verdict.outcome == "answered", verdict


def test_what_rounding_leaves_is_not_solved_for_again_and_again():
    drawn = random_problem(0, 3527)
    said = []
    solve(
        drawn.problem,
        drawn.prior,
        optimizer=Multigrid(drawn.tolerance),
        backend="cpu",
        progress=said.append,
    )
    solutions = [monitor for monitor in said if monitor.message.startswith("solution")]
    assert 0 < len(solutions) < 30


def test_so_they_are_by_shaders():
    require_opengl()
    run = trust.campaign([(number, "opengl") for number in range(6)])
    assert run.sound, trust.report(run)


def test_states_that_let_go_of_too_much_are_passed_through():
    """On the way some states move tissue by 367,727 px, where no residual reaches the tolerance."""
    assert trust.judge(random_problem(301, 1482), "cpu").outcome == "answered"


def test_slipping_tissue_is_answered_at_any_tolerance():
    # Interior points that start where exchanges ended arrive at some tolerances only.
    drawn = random_problem(7, 546)
    fields = [
        solve(drawn.problem, drawn.prior, optimizer=Multigrid(tolerance), backend="cpu")
        for tolerance in (1e-2, 1e-4)
    ]
    np.testing.assert_allclose(fields[0].displacement, fields[1].displacement, atol=1e-6)


def test_the_start_of_an_interior_point_keeps_what_no_clique_pulls_at():
    assert trust.judge(random_problem(403, 464), "cpu").outcome == "answered"
