"""Tests of the validation report and of its reference solutions."""

import numpy as np
import pytest
import validation
from fem import plane_stress_displacement, rmsd
from report import analytic, calculix, contenders, levels
from report.assembly import assemble, solve_directly
from report.page import Section, Settings, Target, write_page
from report.warm import moved_patch

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.data import phantom


def random_problem(spacing=(1.0, 1.0)):
    """Return random tissue with a hole; the top edge is fixed, the bottom edge in one component."""
    rng = np.random.default_rng(3)
    shape = (12, 9)
    m = rng.random(shape) + 0.2
    m[4, 5] = 0
    c = np.zeros((*shape, 2))
    c[0] = c[-1, :, 0] = 1
    return Problem(rng.normal(size=(*shape, 2)), c, m, spacing=spacing)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (2.0, 0.5)])
@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_the_assembled_matrix_gives_the_energy_of_the_prior(plane, spacing):
    problem, prior = random_problem(spacing), ElasticPrior(0.4, plane=plane)
    system = assemble(problem, prior)
    assert abs(system.matrix - system.matrix.T).max() < 1e-12
    found = solve_directly(problem, prior) * problem.unit
    held = problem.confidence > 0
    np.testing.assert_allclose(found[held], problem.observed[held], atol=1e-12)
    forces = prior.forces(problem, found)
    assert np.abs(forces[held]).max() > 0.1
    assert np.abs(forces[~held & problem.tissue[..., None]]).max() < 1e-10


def test_a_patch_of_uniform_strain_is_exact():
    case = analytic.patch(48)
    assert case.error(solve_directly(case.problem, ElasticPrior(0.3))) < 1e-6


def test_the_annulus_converges_with_second_order_and_a_staircase_interface_does_not():
    def order(make):
        return analytic.observed_order([analytic.errors(make(n), n) for n in (24, 96)])

    assert order(analytic.annulus) > 1.8
    assert 0.5 < order(analytic.inclusion) < 1.8


def test_an_inclusion_of_equal_stiffness_has_the_strain_of_its_surroundings():
    case = analytic.inclusion(64, ratio=1.0)
    row = case.exact[32, 32:, 1]
    np.testing.assert_allclose(np.diff(row), np.diff(row)[0], rtol=1e-4)


def test_a_bar_of_elements_is_solved_exactly():
    case = analytic.bar(40)
    assert case.error(solve_directly(case.problem, ElasticPrior(0.0))) < 1e-6
    assert np.abs(case.exact - analytic.sharp_bar(40)).max() < 0.5


def cards(deck):
    """Return the keywords of a deck with the lines of numbers below each, in order."""
    found = []
    for line in deck.splitlines():
        if line.startswith("*"):
            found.append((line, []))
        else:
            found[-1][1].append(line)
    return found


@pytest.mark.parametrize("element", ["CPE4", "CPS3"])
def test_an_input_deck_is_well_formed(element):
    problem = random_problem()
    deck = cards(calculix.deck(problem, element, 0.3))
    keywords = [keyword.split(",")[0] for keyword, _ in deck]
    assert keywords[0] == "*NODE"
    assert keywords[-5:] == ["*STEP", "*STATIC", "*BOUNDARY", "*NODE PRINT", "*END STEP"]
    nodes = {int(line.split(",")[0]) for line in deck[0][1]}
    assert nodes == {n + 1 for n in range(108) if n != 4 * 9 + 5}
    lines = [line for keyword, lines in deck if keyword.startswith("*ELEMENT") for line in lines]
    around = np.array([list(map(int, line.split(","))) for line in lines])
    triangles = element == "CPS3"
    assert len(set(around[:, 0])) == len(around) == (11 * 8 - 4) * (2 if triangles else 1)
    x, y = np.divmod(around[:, 1:] - 1, 9)
    areas = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    assert (areas == (0.5 if triangles else 1.0)).all(), (
        "the elements are not anticlockwise or do not cover one pixel"
    )
    assert keywords.count("*ELEMENT") == keywords.count("*SOLID SECTION")
    held = deck[keywords.index("*BOUNDARY")][1]
    assert len(held) == int((problem.confidence > 0).sum())


@pytest.mark.skipif(not calculix.is_there(), reason="CalculiX is not installed")
def test_calculix_and_the_reference_agree_in_textbook_plane_stress():
    problem = phantom("mass-effect", 32).problem
    found = calculix.textbook_plane_stress(problem, 0.3)
    assert rmsd(found, plane_stress_displacement(problem, 0.3), problem.tissue) < 1e-5
    elastic = solve(problem, ElasticPrior(0.3), backend="cpu").displacement
    assert rmsd(found, elastic, problem.tissue) < 0.01


def test_a_displacement_table_is_read(tmp_path):
    file = tmp_path / "job.dat"
    table = "\n displacements (vx,vy,vz) for set ALL and time  0.1000000E+01\n\n"
    file.write_text(table + "  7  1.5E+00 -2.0E-01 0.0E+00\n  9  0.0E+00  1.0E+00 0.0E+00\n")
    numbers, values = calculix.read_displacements(file)
    assert numbers.tolist() == [7, 9]
    assert values[0].tolist() == [1.5, -0.2, 0]


def test_more_levels_need_fewer_iterations():
    problem = phantom("mass-effect", 64).problem
    one, deepest = levels.multigrid_cycles(problem, 1)
    assert levels.multigrid_cycles(problem, deepest)[0] < one
    truth = levels.solve_exactly(problem, "centred")
    assert sum(levels.icm_sweeps(problem, truth, 4)) < sum(levels.icm_sweeps(problem, truth, 1))


def test_pyamg_is_stopped_at_the_required_accuracy():
    pytest.importorskip("pyamg")
    problem = phantom("mass-effect", 48).problem
    reference = solve_directly(problem, contenders.PRIOR)
    count = contenders.pyamg_iterations(problem, reference, tuned=True)
    found, _ = contenders.run_pyamg(problem, count, tuned=True)
    sooner, _ = contenders.run_pyamg(problem, count - 1, tuned=True)
    assert np.abs(found - reference).max() <= contenders.WITHIN < np.abs(sooner - reference).max()


def test_an_edit_moves_one_patch_of_the_boundary_by_a_pixel():
    problem = phantom("mass-effect", 64).problem
    change = moved_patch(problem).observed - problem.observed
    moved = np.abs(change).max(axis=-1) > 0
    assert 5 < moved.sum() < 0.3 * (np.abs(problem.observed).max(axis=-1) > 0).sum()
    assert np.abs(change).max() == pytest.approx(1)


def test_a_solver_in_a_separate_process_is_measured(tmp_path):
    problem = phantom(contenders.PHANTOM, 48).problem
    file = tmp_path / "reference.npy"
    np.save(file, solve_directly(problem, contenders.PRIOR))
    run = contenders.measure("cpu", 48, 2, file)
    assert run.seconds > 0
    assert run.error <= contenders.WITHIN
    found = solve(problem, contenders.PRIOR, optimizer=Multigrid(contenders.WITHIN), backend="cpu")
    assert run.iterations == found.iterations


@pytest.mark.campaign
def test_the_quick_report_is_a_page_with_pictures(tmp_path):
    sections = ["levels", "analytic", "finite-elements", "metropolis"]
    assert validation.main(["--quick", "--out", str(tmp_path), "--only", *sections]) == 0
    page = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "A quick report" in page
    for picture in tmp_path.glob("*.png"):
        assert f"({picture.name})" in page
    assert len(list(tmp_path.glob("*.png"))) == 7
    for title in ("How many levels", "Analytic fields", "Finite elements", "Global optimisers"):
        assert f"\n## {title}" in page


def test_a_page_counts_the_targets_that_are_met(tmp_path):
    section = Section("Something")
    section.targets += [Target("low", 1.0, 2.0), Target("high", 1.0, 2.0, at_least=True)]
    section.table(["a", "b"], [[1.23456, None], ["x", 12345.6]])
    section.missing("A tool", "get it")
    write_page(tmp_path / "page.md", [section], Settings(tmp_path), 0.0)
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "1 of 2 met" in page
    assert "MISSED  high: 1 (>= 2)" in page
    assert "| 1.23 | - |\n| x | 12346 |" in page
    assert "A tool is not installed here" in page
