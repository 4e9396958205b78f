"""Tests of the examples: each is run, and its printed numbers are checked.

Three run in the suite, and the others in campaigns.
"""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from napari_hmrf import Solution
from napari_hmrf.data import phantom

campaign = pytest.mark.campaign

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

pytestmark = pytest.mark.skipif(not EXAMPLES.exists(), reason="needs a checkout of the repository")


@pytest.fixture
def run_example(monkeypatch, capsys, tmp_path):
    """Return a function that runs an example in a temporary folder and returns its output."""

    def run(name: str) -> str:
        monkeypatch.chdir(tmp_path)
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return run


def number(pattern: str, text: str) -> float:
    """Return the number at `#` in a pattern that occurs once in a text."""
    (found,) = re.findall(pattern.replace("#", r"(-?[\d.]+)"), text)
    return float(found)


def test_a_stiff_disc_is_hardly_strained_and_moves_half_of_the_distance(run_example):
    text = run_example("stiff_disc")
    within = number("mean within the disc: # %", text)
    assert 0 < within < 0.2 * number("mean around the disc: # %", text)
    assert number("# to the right", text) == pytest.approx(4, abs=0.3)


@campaign
def test_stress_beside_a_hole_is_right_away_from_the_staircase(run_example):
    rows = [
        [float(value) for value in re.findall(r"[\d.]+", line)]
        for line in run_example("stress_at_a_hole").splitlines()[1:]
    ]
    for _, _, beside, exact, *_ in rows:
        assert beside == pytest.approx(exact, rel=0.06)
    assert rows[-1][1] > 3
    assert rows[-1][4] == pytest.approx(rows[-1][5], rel=0.02)


@campaign
def test_a_growing_tumour_compresses_the_surrounding_tissue(run_example, tmp_path):
    text = run_example("growing_tumour")
    assert number("area of the tumour: # %", text) > 120
    assert number("area of the ventricles: # %", text) < 100
    assert number("area of the normal tissue: # %", text) < 100
    assert number("tissue folds: #", text) == 0
    assert number("elastic, grown by 150 %: folds at # pixels", text) > 5
    assert number("large motion, grown by 150 %: folds at # pixels", text) == 0
    before, after = re.findall(r"(\d+) before, (\d+) after", text)[0]
    assert int(after) > 1.2 * int(before)
    saved = Solution.read(tmp_path / "growing-tumour.npz")
    assert (saved.tissue == phantom("mass-effect", size=150).problem.tissue).all()


@campaign
def test_a_sphere_grows_in_slice_and_volume_and_its_files_have_the_place_of_the_scan(
    run_example, tmp_path
):
    sitk = pytest.importorskip("SimpleITK")
    away = np.linalg.norm((np.indices((16, 20, 24)).T - (8, 10, 12)) * (3, 2, 2), axis=-1).T
    scan = sitk.GetImageFromArray(np.float32(away < 10))
    scan.SetSpacing((2, 2, 3))
    scan.SetOrigin((-10, 20, 30))
    sitk.WriteImage(scan, str(tmp_path / "scan.nii.gz"))
    text = run_example("growing_sphere")
    assert 20 < number("slice: the tumour grows by # %", text) < 44, (
        "unconstrained, the area grows by 44 %"
    )
    assert 30 < number("volume: the tumour grows by # %", text) < 73, (
        "unconstrained, the volume grows by 73 %"
    )
    deformed = sitk.ReadImage(str(tmp_path / "volume-deformed.nii.gz"))
    assert deformed.GetOrigin() == pytest.approx(scan.GetOrigin(), abs=1e-4)
    assert sitk.GetArrayFromImage(deformed).sum() > 1.3 * (away < 10).sum()
    # Compare with SimpleITK, which uses only the field.
    field = sitk.ReadImage(str(tmp_path / "volume-field.nii.gz"), sitk.sitkVectorFloat64)
    moved = sitk.Resample(scan, sitk.DisplacementFieldTransform(field))
    difference = sitk.GetArrayFromImage(moved) - sitk.GetArrayFromImage(deformed)
    assert np.abs(difference[2:-2, 2:-2, 2:-2]).mean() < 0.01
    assert (tmp_path / "slice-field.nii.gz").exists()


def test_landmarks_in_millimetres_reach_their_targets(run_example):
    text = run_example("slice_in_millimetres")
    moves = re.findall(r"moves (-?[\d.]+) mm down and (-?[\d.]+) mm to the right", text)
    # Two rows of 1.5 mm, four columns of 0.75 mm, and no motion.
    expected = [(3, 0), (0, 3), (0, 0)]
    for found, wanted in zip(moves, expected, strict=True):
        assert tuple(map(float, found)) == pytest.approx(wanted, abs=0.01)
    assert number("further than # mm", text) == pytest.approx(3, abs=0.05)


@campaign
def test_the_converged_and_the_elastic_fields_are_closer_to_finite_elements_than_the_paper(
    run_example,
):
    text = run_example("paper_beside_elastic")
    paper = number("^paper: # px", text)
    converged, elastic = number("paper, converged: # px", text), number("elastic: # px", text)
    assert elastic < 0.005 < converged < 0.5 * paper
    assert paper < 1.44, "the error exceeds that reported by the paper"


@campaign
def test_a_tissue_model_improves_a_registration_and_leaves_bone_unstrained(
    run_example,
):
    pytest.importorskip("SimpleITK")
    text = run_example("registration")
    by = {name: number(f"{name}: # px", text) for name in ("demons alone", "with tissue")}
    assert by["with tissue"] < 0.75 * by["demons alone"]
    strained = [float(found) for found in re.findall(r"strained by ([\d.]+) %", text)]
    assert strained[1] < 0.2 < 3 < strained[0]


@campaign
def test_masks_keep_a_removed_tumour_from_moving_the_brain(run_example):
    text = run_example("removed_tumour")
    by = {
        name: number(f"{name}: error around it # px", text)
        for name in ("all pixels", "without removed tissue")
    }
    assert by["without removed tissue"] < 0.5 * by["all pixels"]
    assert by["without removed tissue"] < 0.7
    assert text.count("folds 0") == 2


@campaign
def test_a_brain_sinks_into_the_cavity_of_a_resection(run_example):
    text = run_example("resected_tumour")
    moves = {
        name: re.search(rf"^{name} cavity: .* by (-?[\d.]+) mm, .* by (-?[\d.]+) mm", text, re.M)
        for name in ("empty", "half full", "full")
    }
    roof, floor = ({name: float(each[n]) for name, each in moves.items()} for n in (1, 2))
    assert min(roof.values()) > 1
    assert floor["empty"] < floor["half full"] < floor["full"] < 0  # fluid presses on the floor


@campaign
def test_sliding_lungs_slip_along_the_wall_and_are_strained_less_than_sticking_lungs(run_example):
    text = run_example("sliding_lungs")
    slip = {name: number(f"{name} lungs: slip # px", text) for name in ("sliding", "sticking")}
    assert slip["sliding"] > 7
    assert slip["sticking"] < 1.5
    strain = {name: number(f"{name} lungs: .* strain # %", text) for name in slip}
    assert strain["sliding"] < 0.85 * strain["sticking"]
    assert text.count("folds 0") == 2


@campaign
def test_registered_sections_match_like_those_of_the_block(run_example):
    text = run_example("sections")
    match = {name: number(f"{name}: .* by #", text) for name in ("block", "as cut", "registered")}
    assert 1 - match["registered"] < 0.1 * (1 - match["as cut"])
    assert match["registered"] <= match["block"]
    assert number("^.*folds: #$", text.strip().splitlines()[-1]) == 0


@campaign
def test_the_error_bar_of_a_tumour_contains_its_true_place(run_example):
    text = run_example("uncertainty")
    truth = number("tumour: # px down in truth", text)
    found = re.findall(r"tumour: ([\d.]+) \+- ([\d.]+) px down", text)
    assert len(found) == 4
    for place, spread in found:
        assert abs(float(place) - truth) < 2 * float(spread)
    assert float(found[-1][1]) < float(found[0][1]), "a landmark at the tumour did not help"


def test_warm_starts_give_the_field_of_cold_starts_with_fewer_iterations(run_example):
    text = run_example("drag")
    apart = [float(found) for found in re.findall(r"([\d.]+) px from a cold start", text)]
    assert len(apart) == 8
    assert max(apart) < 0.003, "each field has the tolerance 0.001 px"
    assert number("# iterations in all", text) < number("each time, #", text)


@campaign
def test_a_growing_tumour_compresses_the_surrounding_volume(run_example):
    text = run_example("volume")
    volumes = {name: float(share) for name, share in re.findall(r"(\w+): .* is ([\d.]+) %", text)}
    assert volumes["tumour"] > 130
    assert max(volumes["brain"], volumes["ventricles"]) < 100
    before, after = re.findall(r"(\d+) before, (\d+) after", text)[0]
    assert int(after) > 1.3 * int(before)
    assert number("within # px", text) <= 0.001


@campaign
def test_ventricles_shrink_with_the_growth_and_the_stiffness_of_the_tumour(run_example):
    found = re.findall(
        r"growth-tumour-([\d.]+)_stiffness-tumour-(\d+): ventricles (.*) %", run_example("sweep")
    )
    narrower = {(growth, stiffness): float(change) for growth, stiffness, change in found}
    assert len(narrower) == 6
    for stiffness in ("3", "30"):
        assert narrower["0.3", stiffness] < narrower["0.2", stiffness] < narrower["0.1", stiffness]
    assert narrower["0.1", "30"] < narrower["0.1", "3"] < 0


@campaign
def test_random_deformations_do_not_fold_leave_bone_rigid_and_match_full_solves(
    run_example, tmp_path
):
    text = run_example("random_deformations")
    assert number("folds at # pixels", text) == 0
    assert 0.5 < number("moved up to # px", text) <= 5.5
    assert number("strained by # %", text) < 0.3, (
        "a rotation by a few degrees, linearised, has this strain"
    )
    assert number("within # px", text) < 0.01
    with np.load(tmp_path / "deformed.npz") as kept:
        assert kept["images"].shape == kept["labels"].shape == (8, 96, 96)
