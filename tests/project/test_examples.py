"""The examples do what they say: each is run as it stands, and its words are looked at."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from napari_hmrf import Solution
from napari_hmrf.data import phantom

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"

pytestmark = pytest.mark.skipif(not EXAMPLES.exists(), reason="needs a checkout of the repository")


@pytest.fixture
def said(monkeypatch, capsys, tmp_path):
    """Run an example in a folder of its own; what it prints."""

    def run(name: str) -> str:
        monkeypatch.chdir(tmp_path)
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return run


def number(pattern: str, text: str) -> float:
    """The number in words that are there once."""
    (found,) = re.findall(pattern.replace("#", r"(-?[\d.]+)"), text)
    return float(found)


def test_a_stiff_disc_is_hardly_stretched_and_moves_half_the_way(said):
    text = said("stiff_disc")
    within = number("mean within the disc: # %", text)
    assert 0 < within < 0.2 * number("mean around the disc: # %", text)
    assert number("# to the right", text) == pytest.approx(4, abs=0.3)


def test_a_tumour_grows_at_the_cost_of_what_is_around_it(said, tmp_path):
    text = said("growing_tumour")
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


def test_a_sphere_grows_in_a_slice_and_in_a_volume_and_files_lie_where_the_scan_does(
    said, tmp_path
):
    sitk = pytest.importorskip("SimpleITK")
    away = np.linalg.norm((np.indices((16, 20, 24)).T - (8, 10, 12)) * (3, 2, 2), axis=-1).T
    scan = sitk.GetImageFromArray(np.float32(away < 10))
    scan.SetSpacing((2, 2, 3))
    scan.SetOrigin((-10, 20, 30))
    sitk.WriteImage(scan, str(tmp_path / "scan.nii.gz"))
    text = said("growing_sphere")
    assert 20 < number("slice: the tumour grows by # %", text) < 44, "free, it grows by 44 %"
    assert 30 < number("volume: the tumour grows by # %", text) < 73, "free, it grows by 73 %"
    deformed = sitk.ReadImage(str(tmp_path / "volume-deformed.nii.gz"))
    assert deformed.GetOrigin() == pytest.approx(scan.GetOrigin(), abs=1e-4)
    assert sitk.GetArrayFromImage(deformed).sum() > 1.3 * (away < 10).sum()
    # The same by SimpleITK, from the field alone
    field = sitk.ReadImage(str(tmp_path / "volume-field.nii.gz"), sitk.sitkVectorFloat64)
    moved = sitk.Resample(scan, sitk.DisplacementFieldTransform(field))
    difference = sitk.GetArrayFromImage(moved) - sitk.GetArrayFromImage(deformed)
    assert np.abs(difference[2:-2, 2:-2, 2:-2]).mean() < 0.01
    assert (tmp_path / "slice-field.nii.gz").exists()


def test_landmarks_go_where_they_should_be_in_millimetres(said):
    text = said("slice_in_millimetres")
    moves = re.findall(r"moves (-?[\d.]+) mm down and (-?[\d.]+) mm to the right", text)
    # Two rows of 1.5 mm, four columns of 0.75 mm, and nothing.
    expected = [(3, 0), (0, 3), (0, 0)]
    for found, wanted in zip(moves, expected, strict=True):
        assert tuple(map(float, found)) == pytest.approx(wanted, abs=0.01)
    assert number("further than # mm", text) == pytest.approx(3, abs=0.05)


def test_the_papers_field_is_nearer_to_finite_elements_converged_and_elastic_is_there(said):
    text = said("paper_beside_elastic")
    paper = number("^paper: # px", text)
    converged, elastic = number("paper, converged: # px", text), number("elastic: # px", text)
    assert elastic < 0.005 < converged < 0.5 * paper
    assert paper < 1.44, "as far as the paper's own"


def test_what_a_registration_found_at_edges_is_nearer_to_the_truth_with_tissue_and_leaves_bone(
    said,
):
    pytest.importorskip("SimpleITK")
    text = said("registration")
    by = {name: number(f"{name}: # px", text) for name in ("demons alone", "with tissue")}
    assert by["with tissue"] < 0.75 * by["demons alone"]
    strained = [float(found) for found in re.findall(r"strained by ([\d.]+) %", text)]
    assert strained[1] < 0.2 < 3 < strained[0]


def test_a_drag_that_goes_on_as_it_did_is_the_same_field_for_less_work(said):
    text = said("drag")
    apart = [float(found) for found in re.findall(r"([\d.]+) px from a cold start", text)]
    assert len(apart) == 8
    assert max(apart) < 0.003, "both are within the tolerance, a thousandth of a pixel"
    assert number("# iterations in all", text) < number("each time, #", text)


def test_in_a_volume_a_tumour_grows_at_the_cost_of_what_is_around_it(said):
    text = said("volume")
    volumes = {name: float(share) for name, share in re.findall(r"(\w+): .* is ([\d.]+) %", text)}
    assert volumes["tumour"] > 130
    assert max(volumes["brain"], volumes["ventricles"]) < 100
    before, after = re.findall(r"(\d+) before, (\d+) after", text)[0]
    assert int(after) > 1.3 * int(before)
    assert number("within # px", text) <= 0.001


def test_the_more_a_tumour_grows_and_the_stiffer_it_is_the_narrower_are_ventricles(said):
    found = re.findall(
        r"growth-tumour-([\d.]+)_stiffness-tumour-(\d+): ventricles (.*) %", said("sweep")
    )
    narrower = {(growth, stiffness): float(change) for growth, stiffness, change in found}
    assert len(narrower) == 6
    for stiffness in ("3", "30"):
        assert narrower["0.3", stiffness] < narrower["0.2", stiffness] < narrower["0.1", stiffness]
    assert narrower["0.1", "30"] < narrower["0.1", "3"] < 0


def test_random_deformations_fold_nothing_leave_bone_and_are_those_of_full_solves(said, tmp_path):
    text = said("random_deformations")
    assert number("folds at # pixels", text) == 0
    assert 0.5 < number("moved up to # px", text) <= 5.5
    assert number("strained by # %", text) < 0.3, (
        "a turn of few degrees, which linear tissue rounds"
    )
    assert number("within # px", text) < 0.01
    with np.load(tmp_path / "deformed.npz") as kept:
        assert kept["images"].shape == kept["labels"].shape == (8, 96, 96)
