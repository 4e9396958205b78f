"""Tests of fits of saved studies to second image files, in the shell."""

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from napari_hmrf import (
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    Pictures,
    Study,
    Tissue,
    read_study,
    solve_study,
    write_study,
)
from napari_hmrf.cli import main

LABELS = np.ones((60, 64), np.int32)
LABELS[18:36, 20:42] = 2
GROWTH = 0.3
IMAGE = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=LABELS.shape), 1.5)
IMAGE = (255 * (IMAGE - IMAGE.min()) / np.ptp(IMAGE)).astype(np.uint8)


def study_of(growth=0.0, **motion):
    rows = Material(1, "healthy", 3.0), Material(2, "tumour", 3.0, growth=growth)
    return Study(
        Grid(LABELS.shape, (1, 1)),
        Tissue(labels=LABELS, materials=rows, unit="kPa"),
        Motion(hold_edge=True, **motion),
        pictures=Pictures(IMAGE, name="before"),
    )


@pytest.fixture
def files(tmp_path):
    """Return the files of a study whose tumour does not grow, and of its image after growth."""
    after = solve_study(study_of(GROWTH)).warp(IMAGE)
    Image.fromarray(np.rint(20 + 0.7 * after).astype(np.uint8)).save(tmp_path / "after.png")
    return write_study(tmp_path / "before.study", study_of()), tmp_path / "after.png"


def test_the_shell_prints_and_writes_the_growth_of_a_tumour(files, capsys):
    study, after = files
    out = study.with_name("fitted.study")
    given = ["fit", str(study), "--second", str(after), "--growth", "Tumour", "-o", str(out)]
    assert main(given) == 0
    words = capsys.readouterr().out
    assert "fitted: growth of 'tumour': " in words
    assert "agreement of the images: " in words
    fitted = read_study(out)
    healthy, tumour = fitted.study.tissue.materials
    assert healthy.growth == 0
    assert tumour.growth == pytest.approx(GROWTH, rel=0.03)
    assert fitted.solution.displacement[36, 31, 0] > 1, "the study is solved with the fitted growth"
    assert main(given) == 1, "an existing file is kept"
    assert "fitted.study" in capsys.readouterr().err


def test_landmarks_of_the_study_replace_a_second_image(files, tmp_path, capsys):
    moved = solve_study(study_of(GROWTH)).displacement
    places = [(14, 30), (40, 30), (27, 15), (27, 47)]
    marks = [Landmark(p, tuple(p + moved[p]), radius=1, sd=0.05) for p in places]
    drawn = study_of(drawing=Drawing(tuple(marks)))
    path = write_study(tmp_path / "marked.study", drawn)
    assert main(["fit", str(path), "--growth", "2"]) == 0
    low, high = capsys.readouterr().out.partition("(")[2].partition(")")[0].split(" to ")
    assert float(low) < 100 * GROWTH < float(high)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (["--growth", "liver"], "'liver' is not a tissue of the study. Its tissues are 'healthy'"),
        ([], "name a label to fit"),
        (["--stiffness", "1", "2"], "only ratios of stiffness"),
    ],
)
def test_what_cannot_be_fitted_is_refused_without_a_file(files, given, reason, capsys):
    study, after = files
    out = study.with_name("fitted.study")
    assert main(["fit", str(study), "--second", str(after), *given, "-o", str(out)]) == 1
    assert reason in capsys.readouterr().err
    assert not out.exists()


def test_a_fit_without_a_second_image_and_landmarks_is_refused(files, capsys):
    study, _ = files
    assert main(["fit", str(study), "--growth", "tumour"]) == 1
    assert "'--second' is missing" in capsys.readouterr().err
