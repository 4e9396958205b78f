"""Tests of the commands: output, written files and exit codes."""

import os
import re
import runpy
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf import SeilerPrior, Solution, cli, run, solve
from napari_hmrf.compute.compile_cache.sets import EVERYTHING
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.data import phantom
from napari_hmrf.field.frame import PATIENT_AXES
from napari_hmrf.io import figures
from napari_hmrf.io.study_file import read_study
from napari_hmrf.samples import selftest
from napari_hmrf.solver.optimizers import Monitor

#: Rows of the table that compare a sample with a finite-element field.
FEM, OTHER = "RMSD from FEM, nu 0.3", "with another material"


@pytest.fixture(autouse=True)
def _no_window(monkeypatch):
    monkeypatch.setenv("CI", "true")


@pytest.fixture
def pictures():
    """Let the demo draw its pictures, which takes most of its time."""


@pytest.fixture(autouse=True)
def _no_pictures(request, monkeypatch):
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr("napari_hmrf.samples.demo.write_pictures", lambda *_, **__: [])
        monkeypatch.setattr(
            "napari_hmrf.samples.volume_demo.write_volume_pictures", lambda *_, **__: []
        )


def demo(tmp_path, *more):
    return cli.main(["demo", "--backend", "cpu", "--out", str(tmp_path / "out"), *more])


def tables(printed):
    """Return the printed table as one dictionary per model."""
    lines = [line for line in printed.partition("\n\n")[0].splitlines() if line]
    names, *columns = zip(*(re.split(r" {2,}", line) for line in lines), strict=True)
    return [dict(zip(names, column, strict=True)) for column in columns]


def table(printed):
    return tables(printed)[0]


def test_the_demo_compares_the_elastic_model_with_the_paper(tmp_path, capsys):
    assert demo(tmp_path) == 0
    said = capsys.readouterr()
    assert "napari is not opened" in said.err
    elastic, papers = tables(said.out)
    for measured in (elastic, papers):
        assert set(measured) == {
            *("sample", "model", "renderer", "levels", "iterations", "seconds", "mean energy"),
            *(FEM, OTHER, "folds"),
        }
        assert measured["sample"] == "Brain that expands outward, 300 x 300"
    assert elastic["model"] == "elastic (Poisson's ratio 0.45, plane stress), converged"
    assert papers["model"] == "the paper's prior (centred), 70 sweeps per level"
    assert (elastic["levels"], papers["levels"]) == ("1", "10")
    assert (papers["iterations"], papers["folds"]) == ("700", "0")
    assert elastic[FEM].endswith(" px, solved with nu 0.3")
    assert elastic[OTHER] == "0.11 px, nu 0.45, plane stress"
    assert papers[OTHER] == "-"
    far = [each[FEM].partition(" px")[0] for each in (elastic, papers)]
    # The paper reports 1.44 px for its own phantom and this schedule.
    assert 0 < float(far[0]) < float(far[1]) < 1.44
    written = Solution.read(tmp_path / "out" / "solution.npz")
    assert written.provenance.model == "elastic"


def test_the_demo_has_no_finite_element_field_at_other_sizes(tmp_path, capsys):
    assert demo(tmp_path, "--size", "40", "--phantom", "mass-effect") == 0
    measured = table(capsys.readouterr().out)
    assert measured[FEM] == "-"
    assert measured["sample"] == "Brain with a tumour whose rim is pushed, 40 x 40"


def test_elastic_tissue_of_the_same_material_matches_the_finite_element_field(tmp_path, capsys):
    assert demo(tmp_path, "--model", "elastic", "--poisson", "0.3") == 0
    measured = table(capsys.readouterr().out)
    assert measured["model"] == "elastic (Poisson's ratio 0.3, plane stress), converged"
    # The reference field is stored to a thousandth of a pixel.
    assert 0 < float(measured[FEM].removesuffix(" px")) < 0.001


def test_the_demo_solves_the_converged_paper_model(tmp_path, capsys):
    options = ("--size", "40", "--model", "paper-converged")
    assert demo(tmp_path, *options) == 0
    measured = table(capsys.readouterr().out)
    assert measured["model"] == "the paper's prior (centred), converged"


def test_the_paper_model_refuses_a_poisson_ratio_and_a_plane(tmp_path, capsys):
    for option in (("--poisson", "0.3"), ("--plane", "strain")):
        assert demo(tmp_path, "--size", "40", "--model", "paper", *option) == 1
        assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_invalid_number_is_refused_before_the_demo_starts(tmp_path, capsys):
    for option in (
        *(f"--poisson={value}" for value in ("0.5", "-1", "nan", "much")),
        *(f"--size={value}" for value in ("-3", "2.5", "many")),
    ):
        with pytest.raises(SystemExit) as refused:
            demo(tmp_path, option)
        assert refused.value.code == 2
        assert option.partition("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_demo_writes_pictures_and_a_result_that_can_be_read(tmp_path, capsys, pictures):
    from PIL import Image

    assert demo(tmp_path, "--size", "48", "--phantom", "bar") == 0
    written = {path.name for path in (tmp_path / "out").iterdir()}
    drawn = {f"{name}.png" for name in ("input", "displacement", "warped", "grid", "energy")}
    assert written == {"solution.npz", *drawn}
    for name in drawn:
        with Image.open(tmp_path / "out" / name) as picture:
            assert min(picture.size) > 300
            assert len(set(picture.convert("L").resize((64, 64)).tobytes())) > 3, (
                "the page is empty"
            )
    solution = Solution.read(tmp_path / "out" / "solution.npz")
    assert solution.displacement.shape == (16, 48, 2)
    pull = solution.displacement[8, :, 1]
    assert pull[0] < pull[24] < pull[-1], "the bar is not pulled to the right"


def test_pictures_preserve_the_proportions_of_non_square_pixels():
    from napari_hmrf import Problem

    m = np.ones((20, 30))
    y = np.zeros((20, 30, 2))
    y[:, -1] = (0, 2)
    c = np.zeros_like(y)
    c[:, [0, -1]] = 1
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=(3.0, 1.0))
    figure = figures.boundary_picture(m, problem)
    figure.draw_without_rendering()
    box = figure.axes[0].get_window_extent()
    assert box.height / box.width == pytest.approx(20 * 3 / 30, rel=1e-3)


def test_arrows_in_pictures_point_along_the_displacement():
    from matplotlib.quiver import Quiver

    bar = phantom("bar", 48)
    solution = solve(bar.problem, SeilerPrior(), backend="cpu")
    figure = figures.displacement_picture(bar.image, solution)
    (quiver,) = (artist for artist in figure.axes[0].collections if isinstance(artist, Quiver))
    for x, y, right, down in zip(quiver.X, quiver.Y, quiver.U, quiver.V, strict=True):
        row, col = int(y), int(x)
        assert (down, right) == pytest.approx(tuple(solution.displacement[row, col]), abs=1e-3)
    low, high = figure.axes[0].get_ylim()
    assert low > high, "the row axis does not point down"


@pytest.mark.parametrize("kind", ["magnitude", "jacobian", "strain"])
def test_pictures_of_quantities_show_the_image_beneath_and_name_its_state(kind):
    from napari_hmrf.data import phantom

    bar = phantom("bar", 48)
    solution = solve(bar.problem, SeilerPrior(), backend="cpu")
    draw = getattr(figures, f"{kind}_picture")
    figure = draw(solution, image=bar.image)
    below, colours = figure.axes[0].images
    np.testing.assert_array_equal(below.get_array(), bar.image)
    no_change = {"magnitude": 0.0, "jacobian": 1.0, "strain": 0.0}[kind]
    clear = colours.cmap(colours.norm(no_change))[3]
    assert clear == pytest.approx(0, abs=0.02)
    assert colours.cmap(1.0)[3] == 1
    assert "at the original positions" in figure.axes[0].get_title()
    assert len(draw(solution).axes[0].images) == 1


@pytest.mark.parametrize(("backend", "jobs"), [("auto", [EVERYTHING]), ("cpu", [])])
def test_the_demo_writes_its_results_before_it_compiles_loops(
    backend, jobs, monkeypatch, tmp_path, capsys
):
    waited = []

    def wait(job, report):
        waited.append((job, (tmp_path / "solution.npz").exists()))

    monkeypatch.setattr("napari_hmrf.solver.solve.provide_loops", lambda *_: None)
    monkeypatch.setattr(run, "are_compiled", lambda job: False)
    monkeypatch.setattr(run, "provide_loops", wait)
    demo = ["demo", "--size", "32", "--backend", backend, "--no-window", "-o", str(tmp_path)]
    assert cli.main(demo) == 0
    assert waited == [(job, True) for job in jobs]
    said = capsys.readouterr()
    assert ("Ctrl-C" in said.err) == bool(jobs)
    assert "next, try:" in said.out


def test_progress_prints_one_line_per_stage_without_a_terminal(capsys):
    line = run._ProgressLine()
    for message in (f"{PREPARING}: 1", f"{PREPARING}: 2", "preparing", "level 2"):
        line.show(Monitor(message, 0.1))
    line.end()
    said = capsys.readouterr().err.splitlines()
    assert said == [f"10%  {PREPARING}: 1", "10%  preparing"]


def test_progress_and_errors_go_to_stderr_and_the_table_to_stdout(tmp_path, capsys):
    assert demo(tmp_path, "--size", "32") == 0
    said = capsys.readouterr()
    assert "preparing" in said.err
    assert "preparing" not in said.out
    assert "\r" not in said.err, "a line is rewritten without a terminal"


def test_an_output_folder_that_cannot_be_made_is_refused_before_the_solve(
    tmp_path, capsys, monkeypatch
):
    (tmp_path / "out").write_text("a file is here")
    monkeypatch.setattr("napari_hmrf.samples.demo.solve", None)
    assert demo(tmp_path) == 1
    assert str(tmp_path / "out") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("platform", "variables", "window"),
    [
        ("linux", {}, False),
        ("linux", {"DISPLAY": ":0"}, True),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, True),
        ("linux", {"DISPLAY": ":0", "CI": "true"}, False),
        ("darwin", {}, True),
        ("win32", {}, True),
        ("win32", {"CI": "true"}, False),
    ],
)
def test_a_window_opens_only_with_a_display_and_outside_ci(
    monkeypatch, platform, variables, window
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "CI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    assert run._has_display() is window


def test_the_affine_example_is_affine_inside_its_border():
    problem, field = selftest.affine_example()
    inside = problem.confidence[..., 0] == 0
    assert np.count_nonzero(inside) == 14 * 21
    assert np.array_equal(problem.observed[~inside], field[~inside].astype(np.float32))
    # Second differences of an affine field vanish, so it has no bending energy.
    assert np.allclose(np.diff(field, 2, axis=0), 0)
    assert np.allclose(np.diff(field, 2, axis=1), 0)
    problem, field = selftest.affine_example((5, 6, 7))
    assert np.count_nonzero(problem.confidence[..., 0] == 0) == 3 * 4 * 5
    for axis in range(3):
        assert np.allclose(np.diff(field, 2, axis=axis), 0)


def test_the_self_test_passes_and_prints_no_user_name(capsys, monkeypatch):
    # A small image shortens the timing; the checks are those of the command.
    monkeypatch.setattr(selftest, "phantom", lambda name: phantom(name, 24))
    home = os.path.expanduser("~")
    passed = cli.main(["selftest"]) == 0
    said = capsys.readouterr().out
    assert passed, said
    assert said.splitlines()[-1] == "PASS"
    assert f"napari-hmrf  {napari_hmrf.__version__}" in said
    assert home not in said
    assert said.count("PASS affine motion") >= 2
    assert ("stages           fragment, compute" in said) <= ("elastic volume" in said)
    assert "FAIL" not in said


def test_the_self_test_fails_if_a_backend_returns_a_wrong_field(monkeypatch):
    problem, field = selftest.affine_example()
    monkeypatch.setattr(selftest, "affine_example", lambda *shape: (problem, -field))
    monkeypatch.setattr(selftest, "_BACKENDS", ("cpu",))
    lines = []
    assert selftest.selftest(lines.append) is False
    assert any("FAIL affine motion" in line for line in lines)
    assert lines[-1] == "FAIL"


def test_the_self_test_hides_the_home_folder():
    home = os.path.expanduser("~")
    assert home not in selftest._anonymous(f"libGL.so from {home}/lib")


def test_the_commands_print_their_version(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["napari-hmrf", "--version"])
    for command in (cli.main, lambda: runpy.run_module("napari_hmrf", run_name="__main__")):
        with pytest.raises(SystemExit) as asked:
            command()
        assert asked.value.code == 0
        assert capsys.readouterr().out.strip() == f"napari-hmrf {napari_hmrf.__version__}"
    with pytest.raises(SystemExit) as nothing:
        cli.main([])
    assert nothing.value.code == 2


@pytest.fixture
def opened(frame, monkeypatch):
    """Return the docks that a command opens in napari, and the viewer, which has no window."""
    import napari

    docks = []

    def add_dock(plugin, name):
        docks.append(frame.open())
        return None, docks[-1]

    window = SimpleNamespace(add_plugin_dock_widget=add_dock)
    stand_in = SimpleNamespace(add_layer=frame.viewer.add_layer, window=window)
    monkeypatch.setattr(run, "_has_display", lambda: True)
    monkeypatch.setattr(napari, "Viewer", lambda: stand_in)
    monkeypatch.setattr(napari, "run", lambda: None)
    return docks, frame.viewer


def test_the_demo_opens_its_result_in_napari_on_a_display(tmp_path, opened, wait_for):
    docks, viewer = opened
    options = ("--model", "elastic", "--poisson", "0.3", "--plane", "strain")
    assert demo(tmp_path, "--size", "48", "--phantom", "mass-effect", *options) == 0
    (widget,) = docks
    wait_for(lambda: widget.idle)
    assert widget.solution.displacement.shape == (48, 48, 2)
    prior = widget.solution.provenance.parameters["prior"]
    assert (prior["name"], prior["poisson"], prior["plane"]) == ("ElasticPrior", 0.3, "strain")
    assert {"Image", "Labels", "Vectors"} <= {type(layer).__name__ for layer in viewer.layers}


def test_the_volume_demo_reports_the_growth_of_the_tumour(tmp_path, capsys, pictures):
    assert demo(tmp_path, "--volume", "--size", "48") == 0
    said = capsys.readouterr().out
    measured = table(said)
    assert list(measured) == [
        *("sample", "growth", "model", "renderer", "iterations", "seconds", "estimated error"),
        *("folds", "tumour before", "tumour after"),
    ]
    assert measured["sample"] == "Head with a growing tumour, 38 x 48 x 38 voxels of 3.96 mm"
    assert measured["model"] == "elastic (Poisson's ratio 0.45), converged"
    assert measured["growth"] == "by 2 mm in all directions"
    assert measured["folds"] == "0 voxels"
    assert "folds over itself" not in said
    before, after = (float(measured[f"tumour {when}"].split()[0]) for when in ("before", "after"))
    assert before == pytest.approx(4 / 3 * np.pi * 2**3, rel=0.03)
    assert 1.15 * before < after < 1.1**3 * before
    written = tmp_path / "out"
    assert {path.name for path in written.iterdir()} == {
        *("head.study", "before.png", "after.png", "magnitude.png")
    }
    saved = read_study(written / "head.study")
    assert saved.solution.displacement.shape == (38, 48, 38, 3)
    assert saved.study.grid.place.axis_labels == tuple(PATIENT_AXES)


def test_a_volume_demo_with_folds_explains_their_cause():
    from napari_hmrf.samples.volume_demo import demonstrate_volume

    shown = demonstrate_volume(24, backend="cpu", progress=lambda _: None, growth=10.0)
    assert shown.folds == shown.solution.count_folds() > 0
    assert shown.note == (
        f"the tissue folds over itself at {shown.folds} voxels, which real tissue cannot do: the "
        "growth of the tumour (10 mm) is too large. In Python, use head_phantom(24, growth=5) "
        "instead."
    )


def test_slices_of_a_volume_are_drawn_through_one_point_with_the_head_up(
    tmp_path, monkeypatch, pictures
):
    from napari_hmrf.samples.volume_demo import demonstrate_volume, write_volume_results

    drawn = {}
    monkeypatch.setattr(figures, "_save_figures", lambda _, made: drawn.update(made) or [])
    shown = demonstrate_volume(24, backend="cpu", progress=lambda _: None, poisson=0.3)
    assert shown.solution.provenance.parameters["prior"]["poisson"] == 0.3
    write_volume_results(shown, tmp_path)
    assert set(drawn) == {"before", "after", "magnitude"}
    for name, figure in drawn.items():
        across = [axes for axes in figure.axes if axes.get_title()]
        assert [axes.get_title()[0] for axes in across] == ["S", "P", "L"]
        ways = [bottom > top for bottom, top in (axes.get_ylim() for axes in across)]
        assert ways == [True, False, False], "a slice is upside down"
        assert len(figure.axes) == (4 if name == "magnitude" else 3)
        figure.draw_without_rendering()
        widths = [
            axes.get_window_extent().width / (axes.get_xlim()[1] - axes.get_xlim()[0])
            for axes in across
        ]
        assert widths == pytest.approx(widths[:1] * 3, rel=0.05), "the slices have different scales"


def test_the_volume_demo_refuses_options_without_effect_before_it_starts(tmp_path, capsys):
    for options, said in (
        ("--plane strain", "--plane"),
        ("--model paper --poisson 0.3", "--poisson"),
        ("--size 20", "at least 24"),
    ):
        assert demo(tmp_path, "--volume", *options.split()) == 1
        printed = capsys.readouterr()
        assert said in printed.err
        assert not printed.out


def test_the_volume_demo_opens_the_deformed_volume_in_napari(tmp_path, opened, wait_for):
    assert demo(tmp_path, "--volume", "--size", "24") == 0
    ((widget,), _) = opened
    wait_for(lambda: widget.idle)
    assert widget.extent == "volume"
    assert widget.solution.displacement.shape == (19, 24, 19, 3)
