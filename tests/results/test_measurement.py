"""Measurements of each tissue, and animations of a solution."""

import numpy as np
import pytest
from PIL import Image

from napari_hmrf import (
    ArgumentError,
    Arrow,
    Drawing,
    FileFormatError,
    Grid,
    Material,
    Motion,
    Pictures,
    Problem,
    ProblemError,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.fields import equivalent_strain, write_movie
from napari_hmrf.results.measurement import measure
from napari_hmrf.results.quantities import coloured
from napari_hmrf.solver.solution import Provenance, Solution

SHAPE = (40, 40)


def stretched_tissue():
    """Return tissue stretched by 10 % along its columns: a patch test."""
    y, c = np.zeros((2, *SHAPE, 2))
    y[..., 1] = 0.1 * 0.5 * np.arange(40)
    c[[0, -1]] = c[:, [0, -1]] = 1
    return solve(
        Problem(observed=y, confidence=c, stiffness=np.ones(SHAPE), spacing=(0.5, 0.5)),
        backend="cpu",
    )


def test_stretching_tissue_by_a_tenth_increases_its_area_by_a_tenth():
    labels = np.ones(SHAPE, int)
    labels[:, 30:] = 7
    one, other = measure(stretched_tissue(), labels, names={7: "liver"})
    assert (one.label, one.name, other.label, other.name) == (1, "", 7, "liver")
    assert (one.pixels, one.size) == (1200, 300)
    assert one.size_change == pytest.approx(10, abs=0.01)
    assert other.largest_displacement == pytest.approx(0.05 * 39, abs=1e-3)
    assert other.mean_displacement == pytest.approx(0.05 * 34.5, abs=1e-3)
    # The edge keeps the width, so the thickness shrinks by 0.1 nu / (1 - nu).
    across = -0.45 / 0.55 * 0.1
    expected = equivalent_strain(np.diag([0, 0.1]), across)
    assert one.mean_strain == pytest.approx(100 * float(expected), abs=0.02)
    assert one.folds == 0


@pytest.mark.parametrize("shape", [(24, 24), (12, 16, 16)])
def test_the_change_of_area_or_volume_is_exact_where_tissue_folds(shape):
    sites = np.stack(np.indices(shape), axis=-1).astype(float)
    away = sites - np.divide(shape, 2)
    bump = np.exp(-(away**2).sum(axis=-1) / 8)
    # The border does not move, so the total size is unchanged, with or without folds.
    displacement = bump[..., None] * np.array([2.0, 7.0, 4.0])[-len(shape) :]
    inner = (slice(1, -1),) * len(shape)
    held = np.zeros_like(displacement)
    held[inner] = displacement[inner]
    tissue = np.ones(shape, bool)
    solution = Solution(held, np.zeros(1), (), tissue, (1.0,) * len(shape), Provenance("cpu", ""))
    (all_of_it,) = measure(solution, np.ones(shape, int))
    assert all_of_it.folds > 10
    assert all_of_it.size_change == pytest.approx(0, abs=1e-6)
    halves = np.where(sites[..., -1] < shape[-1] // 2, 1, 2)
    one, other = measure(solution, halves)
    assert one.size_change == pytest.approx(-other.size_change, abs=1e-6)
    assert abs(one.size_change) > 0.5


def test_tissue_too_thin_for_cells_uses_the_size_change_of_its_pixels():
    held = np.zeros((1, 10, 2), np.float32)
    held[0, :, 1] = 0.2 * np.arange(10)
    tissue = np.ones((1, 10), bool)
    solution = Solution(held, np.zeros(1), (), tissue, (1.0, 1.0), Provenance("cpu", ""))
    (found,) = measure(solution, np.ones((1, 10), int))
    assert found.size_change == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize("quantity", ["equivalent", "jacobian"])
def test_colours_mark_only_the_folds_that_are_counted(quantity):
    tissue = np.zeros((5, 5), bool)
    tissue[1:4, 1:4] = tissue[0, 2] = True
    moved = np.zeros((5, 5, 2), np.float32)
    moved[0, 2] = 3, 0  # a pixel in no element
    solution = Solution(moved, np.zeros(1), (), tissue, (1.0, 1.0), Provenance("cpu", ""))
    assert solution.jacobian()[1, 2] < 0
    assert solution.count_folds() == 0
    assert not coloured(solution, quantity).folded
    moved[2, 2] = 2, 0
    assert coloured(solution, quantity).folded


def test_a_displacement_instead_of_a_solution_is_rejected():
    solution = stretched_tissue()
    with pytest.raises(ArgumentError, match="solution must be a Solution, such as the result of"):
        measure(solution.displacement, np.ones(SHAPE, int))


def test_labels_of_another_size_are_rejected():
    with pytest.raises(ProblemError, match=r"labels: are 4 x 5 of type int64\. Pass whole numbers"):
        measure(stretched_tissue(), np.ones((4, 5), int))


@pytest.fixture
def solved(tmp_path):
    """Write a solved study with labels and an image; return the path."""
    photo = np.random.default_rng(2).integers(1, 255, (*SHAPE, 3), dtype=np.uint8)
    labels = np.ones(SHAPE, np.uint8)
    labels[10:30, 10:30] = 2
    rows = (Material(1, "skin", 1.0), Material(2, "lump", 9.0))
    pull = Drawing((Arrow(at=(20, 20), by=(1.0, 3.0), radius=3),))
    study = Study(
        Grid(SHAPE, (1.0, 1.0)),
        Tissue(labels=labels, materials=rows),
        Motion(hold_edge=True, drawing=pull),
        pictures=Pictures(photo, name="photo"),
    )
    return write_study(tmp_path / "case", study, solve_study(study, backend="cpu"))


def test_all_tissue_is_measured_if_there_are_no_labels(tmp_path, capsys):
    pull = Drawing((Arrow((8, 8), (0, 2), 3),))
    study = Study(Grid((16, 16), (1.0, 1.0)), motion=Motion(hold_edge=True, drawing=pull))
    path = write_study(tmp_path / "plain", study, solve_study(study, backend="cpu"))
    assert main(["measure", str(path)]) == 0
    assert "tissue" in capsys.readouterr().out


def test_the_measure_command_prints_and_writes_the_table(solved, tmp_path, capsys):
    assert main(["measure", str(solved), "-o", str(tmp_path / "table.csv")]) == 0
    said = capsys.readouterr().out
    assert "lump" in said
    study, solution = read_study(solved)
    names = {row.label: row.name for row in study.tissue.materials}
    found = measure(solution, study.tissue.labels, names=names)
    lines = (tmp_path / "table.csv").read_text().splitlines()
    titles = lines[0].split(",")
    named = [each.removesuffix("_percent").replace("elastic_", "") for each in titles]
    without_error_bars = found[0]._fields[: found[0]._fields.index("strain")]
    of_image = [name.replace("size", "area") for name in without_error_bars]
    of_stress = ["mean_von_mises_stress", "largest_von_mises_stress", "mean_pressure"]
    assert named == [*of_image, *of_stress, "unit"]
    per_cent = [each.removesuffix("_percent") for each in titles if each.endswith("_percent")]
    assert per_cent == ["area_change", "mean_elastic_strain", "largest_elastic_strain"]
    assert [line.split(",")[1] for line in lines[1:]] == ["skin", "lump"]
    assert float(lines[2].split(",")[6]) == pytest.approx(found[1].largest_displacement)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("grey.png", "grey.png: is probably not a label image: it has "),
        ("photo.png", "photo.png: has colours"),
    ],
)
def test_a_photograph_is_rejected_as_labels(solved, tmp_path, capsys, name, said):
    photo = read_study(solved).study.pictures.image
    Image.fromarray(photo[..., 0] if name == "grey.png" else photo).save(tmp_path / name)
    assert main(["measure", str(solved), "--labels", str(tmp_path / name)]) == 1
    told = capsys.readouterr()
    assert said in told.err
    assert told.out == ""


def test_an_atlas_of_many_regions_is_accepted_as_labels(solved, tmp_path, capsys):
    atlas = np.kron(np.arange(100, dtype=np.uint8).reshape(10, 10), np.ones((4, 4), np.uint8))
    Image.fromarray(atlas[: SHAPE[0], : SHAPE[1]]).save(tmp_path / "atlas.png")
    assert main(["measure", str(solved), "--labels", str(tmp_path / "atlas.png")]) == 0


def test_an_animation_runs_from_rest_to_the_full_motion_and_back(solved, tmp_path):
    study, solution = read_study(solved)
    photo = study.pictures.image
    path = write_movie(tmp_path / "photo.gif", solution, photo, frames=5)
    with Image.open(path) as moving:
        assert moving.n_frames == 8
        assert moving.info["loop"] == 0, "the animation should repeat forever"
        frames = []
        for number in range(8):
            moving.seek(number)
            frames.append(np.asarray(moving.convert("RGB")).astype(float))
    still, moved = (
        each.astype(float) for each in (photo, warp(photo, solution.displacement, spacing=1))
    )
    # The colours are inexact because a .gif has only 256.
    assert abs(frames[0] - still).mean() < 20 < abs(frames[4] - still).mean()
    assert abs(frames[4] - moved).mean() < 20
    assert np.array_equal(frames[3], frames[5]), "the way back should mirror the way there"


def test_an_animation_of_oblong_pixels_has_the_proportions_of_the_image(tmp_path):
    pull = Drawing((Arrow((16, 8), (0, 2), 3),))
    study = Study(Grid((16, 24), (2.0, 1.0)), motion=Motion(hold_edge=True, drawing=pull))
    solution = solve_study(study, backend="cpu")
    photo = np.arange(16 * 24, dtype=float).reshape(16, 24)
    with Image.open(write_movie(tmp_path / "a.gif", solution, photo, frames=2)) as moving:
        assert moving.size == (24, 32)


def test_an_animation_of_another_format_or_of_one_frame_is_rejected(solved, tmp_path):
    study, solution = read_study(solved)
    photo = study.pictures.image
    with pytest.raises(
        FileFormatError, match=r"a\.png: animations cannot be written .* \.gif or \.mp4"
    ):
        write_movie(tmp_path / "a.png", solution, photo)
    with pytest.raises(ArgumentError, match=r"frames must be a whole number of at least 2, not 1"):
        write_movie(tmp_path / "a.gif", solution, photo, frames=1)
    assert main(["play", str(solved), str(tmp_path / "case.gif")]) == 0
    assert (tmp_path / "case.gif").exists()


def test_a_movie_is_a_standard_mp4_file(solved, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    study, solution = read_study(solved)
    path = write_movie(tmp_path / "a.mp4", solution, study.pictures.image, frames=4)
    assert b"ftyp" in path.read_bytes()[:12]
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == 6, (
        "the movie should have 4 frames there and 2 back"
    )
    rows, cols = study.pictures.image.shape[:2]
    assert next(imageio_ffmpeg.read_frames(str(path)))["size"] == (cols // 2 * 2, rows // 2 * 2)


def test_labels_can_be_integers_stored_as_floats():
    solution, labels = stretched_tissue(), np.ones(SHAPE)
    (found,) = measure(solution, labels, names={1.0: "muscle"})
    assert (found.label, found.name) == (1, "muscle")
    with pytest.raises(ProblemError, match=r"labels: have the value 1\.5 at \(0, 7\)"):
        measure(solution, np.where(np.indices(SHAPE).sum(axis=0) == 7, 1.5, labels))


@pytest.mark.parametrize(
    ("labels", "names", "said"),
    [
        (np.ones(SHAPE, int), {"1": "muscle"}, "names must be a mapping of labels to names"),
        (1, None, "labels must be an array of the labels of all pixels, not 1"),
    ],
)
def test_names_with_invalid_keys_and_scalar_labels_are_rejected(labels, names, said):
    with pytest.raises(ArgumentError, match=said):
        measure(stretched_tissue(), labels, names=names)
