"""Tests of landmarks and tissue maps given as arrays."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    BoundaryRule,
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    ProblemError,
    Study,
    Tissue,
    solve_study,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.io.case import Case, read_case
from napari_hmrf.io.images import ImageFile, write_image

SHAPE = 20, 24


def test_landmarks_move_tissue_from_source_to_target():
    source, target = np.array([[10, 12], [5, 6]]), np.array([[10, 14.5], [6, 6]])
    drawing = Drawing.from_landmarks(source, target, radius=1.5, confidence=0.9, shape=SHAPE)
    assert drawing.marks == (
        Landmark((10.0, 12.0), (10.0, 14.5), 1.5, 0.9),
        Landmark((5.0, 6.0), (6.0, 6.0), 1.5, 0.9),
    )
    certain = Drawing.from_landmarks(source, target, radius=1.5)
    tissue, motion = Tissue(stiffness=np.ones(SHAPE)), Motion(hold_edge=True, drawing=certain)
    solution = solve_study(Study(Grid(SHAPE, (0.5, 2.0), "mm"), tissue, motion), backend="cpu")
    np.testing.assert_allclose(solution.displacement[10, 12], (0, 5.0), atol=2e-3)
    np.testing.assert_allclose(solution.displacement[5, 6], (0.5, 0), atol=2e-3)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        pytest.param([[1, 2], [3, 4]], [[1, 2]], id="another number of targets"),
        pytest.param([[1, 2]], [[1, 2, 3]], id="targets with another number of axes"),
        pytest.param([1, 2], [3, 4], id="numbers"),
        pytest.param(np.zeros((0, 2)), np.zeros((0, 2)), id="none"),
        pytest.param([[1, np.nan]], [[1, 2]], id="NaN"),
        pytest.param([[1, 2], [1.2, 2.3]], [[1, 2], [3, 4]], id="two in one pixel"),
        pytest.param([[1, 2], [3, 24]], [[1, 2], [3, 4]], id="outside the image"),
        pytest.param([[1, 2, 3]], [[1, 2, 4]], id="another number of axes than the image"),
    ],
)
def test_invalid_landmarks_are_refused(source, target):
    with pytest.raises(ProblemError) as refused:
        Drawing.from_landmarks(source, target, radius=1, shape=SHAPE)
    assert refused.value.field == "landmarks"


def test_a_grid_converts_points_in_physical_space_to_pixels():
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, -1, 0]]
    turn[:3, 3] = 3, -4, 5
    frame = Frame.at((2.0, 1.0, 0.5), ("millimeter",) * 3, affine=turn, volume=True)
    grid = Grid((6, 7, 8), (2.0, 1.0, 0.5), "millimeter", frame)
    pixels = np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 0.0]])
    points = (pixels * grid.spacing) @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(grid.to_pixels(points), pixels, atol=1e-12)
    plane = Grid((6, 8), (2.0, 0.5), "millimeter", frame.plane_at(1, 2))
    np.testing.assert_allclose(plane.to_pixels(points[:1]), [[1.0, 3.0]], atol=1e-12)
    unplaced = Grid(SHAPE, (1.0, 1.0))
    for of, beside in ((plane, points), (grid, [[1, 2]]), (unplaced, [[1, 2]])):
        with pytest.raises(ProblemError):
            of.to_pixels(beside)


def maps(high=1.0):
    grey, white = np.zeros((2, *SHAPE))
    grey[:, :10], white[:, 8:20] = 0.9 * high, 0.95 * high
    grey[:, :3] = 0.4 * high  # "none" is more likely.
    if high != 1:
        white[1, 12] = high  # The largest value makes the scale of the maps unambiguous.
    return {"grey matter": grey, "white matter": white}


@pytest.mark.parametrize("high", [1.0, 255.0])
def test_each_site_has_its_most_likely_tissue(high):
    tissue = Tissue.from_maps(maps(high), {"white matter": 2.0, "grey matter": 1.5, "none": 0.0})
    expected = np.zeros(SHAPE, int)
    expected[:, 3:8], expected[:, 8:20] = 1, 2
    np.testing.assert_array_equal(tissue.labels, expected)
    assert tissue.materials == (
        Material(0, "none", 0.0),
        Material(1, "grey matter", 1.5),
        Material(2, "white matter", 2.0),
    )


def test_python_and_the_shell_read_the_same_tissue_from_maps(tmp_path):
    names = []
    for name, values in maps().items():
        names.append(tmp_path / f"{name}.tif")
        write_image(names[-1], ImageFile(values.astype(np.float32)))
    write_image(tmp_path / "a.tif", ImageFile(np.ones(SHAPE, np.uint8)))
    of_shell = read_case(Case(tmp_path / "a.tif", maps=names, hold_edge=True))
    tissue = Tissue.from_maps(
        maps(), [Material(7, "white matter", 2), Material(9, "grey matter", 3)]
    )
    np.testing.assert_array_equal(tissue.labels, of_shell.tissue.labels)
    assert [(row.label, row.name) for row in tissue.materials] == [
        (0, "everything unpainted"),
        (1, "grey matter"),
        (2, "white matter"),
    ]


def test_published_stiffness_is_found_by_name_and_unknown_names_are_refused():
    tissue = Tissue.from_maps(maps())
    assert [row.label for row in tissue.materials] == [0, 1, 2]
    assert tissue.materials[0].stiffness == tissue.materials[1].stiffness
    assert tissue.unit == "kPa"
    pull = np.zeros(SHAPE, int)
    pull[9:12, 10:13] = 1
    motion = Motion(hold_edge=True, labels=pull, rules=(BoundaryRule(1, "move", vector=(0, 1)),))
    solved = solve_study(Study(Grid(SHAPE, (1.0, 1.0)), tissue, motion), backend="cpu")
    assert solved.displacement[10, 11, 1] == pytest.approx(1)
    with pytest.raises(ProblemError) as refused:
        Tissue.from_maps({"xyz": np.ones(SHAPE)})
    assert refused.value.field == "tissue"


@pytest.mark.parametrize(
    ("given", "materials"),
    [
        pytest.param({}, None, id="no maps"),
        pytest.param(
            {"a": np.ones((2, 3)), "b": np.ones((3, 2))}, {"a": 1, "b": 1}, id="of two shapes"
        ),
        pytest.param({"a": -np.ones((2, 3))}, {"a": 1}, id="negative"),
        pytest.param({"a": np.ones((2, 3))}, {"b": 1}, id="of another tissue"),
        pytest.param({"a": np.ones((2, 3))}, {"a": "soft"}, id="without a stiffness"),
        pytest.param(
            {"a": np.ones((2, 3)), "wm": np.full((2, 3), 60.0)}, {"a": 1, "wm": 1}, id="two scales"
        ),
        pytest.param({"a": np.full((2, 3), 300.0)}, {"a": 1}, id="above 255"),
        pytest.param({"a": np.full((2, 3), np.nan)}, {"a": 1}, id="NaN"),
        pytest.param({"a": np.full((2, 3), 60, np.uint8)}, {"a": 1}, id="100 or 255"),
    ],
)
def test_maps_that_do_not_match_their_materials_are_refused(given, materials):
    with pytest.raises(ProblemError) as refused:
        Tissue.from_maps(given, materials)
    assert refused.value.field == "tissue"


def test_the_scale_of_maps_is_common_to_all_maps_or_given():
    grey, white = np.array([[30, 0, 100]], np.uint8), np.array([[25, 60, 0]], np.uint8)
    materials, shares = {"a": 1.0, "b": 2.0}, {"a": grey, "b": white}
    assert Tissue.from_maps(shares, materials, scale=100).labels.tolist() == [[0, 2, 1]]
    assert Tissue.from_maps(shares, materials, scale=255).labels.tolist() == [[0, 0, 0]]
    floats = {name: values / 100 for name, values in shares.items()}
    assert Tissue.from_maps(floats, materials).labels.tolist() == [[0, 2, 1]]
    for scale in (1, 2):
        with pytest.raises(ProblemError):
            Tissue.from_maps(shares, materials, scale=scale)


def test_a_slice_of_maps_has_the_scale_of_the_whole_files(tmp_path):
    maps = np.zeros((2, 4, 8, 8), np.uint8)
    maps[0, 1:], maps[1, 1:, :, 4:] = 110, 60
    maps[1, 0] = 255
    paths = [tmp_path / "gm.nrrd", tmp_path / "wm.nrrd"]
    for path, values in zip(paths, maps, strict=True):
        write_image(path, ImageFile(values))
    write_image(tmp_path / "t1.nrrd", ImageFile(np.ones((4, 8, 8), np.uint8)))
    case = Case(tmp_path / "t1.nrrd", maps=paths, hold_edge=True)
    whole, part = read_case(case), read_case(replace(case, slice=2))
    np.testing.assert_array_equal(part.tissue.labels, whole.tissue.labels[2])
    assert part.tissue.labels[0].tolist() == [0] * 4 + [1] * 4
    assert "the maps are read as probabilities from 0 to 255" in part.notes
