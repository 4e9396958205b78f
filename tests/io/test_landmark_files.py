"""Tests of landmark files of BigWarp, 3D Slicer and napari."""

import json

import numpy as np
import pytest

from napari_hmrf import FileFormatError, ProblemError
from napari_hmrf.landmarks import read_points, write_points

AT = np.array([[1.5, 2.25, -3.0], [40.0, 5.0, 6.125]])  # In the order z, y, x.
TO = AT + np.array([0.5, -1.0, 2.0])


def test_a_bigwarp_line_has_moving_coordinates_before_target_coordinates(tmp_path):
    path = tmp_path / "landmarks.csv"
    path.write_text(
        '"Pt-0","true","-3.0","2.25","1.5","-1.0","1.25","2.0"\n"Pt-1","false","1","2","3","4","5","6"\n'
    )
    found = read_points(path)
    assert found.names == ("Pt-0",), "an inactive pair was read"
    np.testing.assert_array_equal(found.points, AT[:1])
    np.testing.assert_array_equal(found.targets, TO[:1])


@pytest.mark.parametrize(("n", "pairs"), [(2, True), (3, False)])
def test_a_csv_file_of_landmarks_is_read_back_unchanged(tmp_path, n, pairs):
    path = tmp_path / "landmarks.csv"
    write_points(path, AT[:, -n:], TO[:, -n:] if pairs else None, names=["nose", "chin"])
    found = read_points(path)
    np.testing.assert_array_equal(found.points, AT[:, -n:])
    if pairs:
        np.testing.assert_array_equal(found.targets, TO[:, -n:])
        assert found.names == ("nose", "chin")
    else:
        assert found.targets is None
        assert path.read_text().startswith("index,axis-0,axis-1")


@pytest.mark.parametrize(("n", "pairs"), [(3, True), (2, False)])
def test_a_column_of_standard_deviations_is_read_back_unchanged(tmp_path, n, pairs):
    path = tmp_path / "landmarks.csv"
    write_points(path, AT[:, -n:], TO[:, -n:] if pairs else None, sd=[0.5, 0])
    found = read_points(path)
    assert found.sd.tolist() == [0.5, 0]
    np.testing.assert_array_equal(found.points, AT[:, -n:])
    if pairs:
        np.testing.assert_array_equal(found.targets, TO[:, -n:])
        first = path.read_text().splitlines()[0].rpartition(",")
        path.write_text(f"{first[0]},\n")
        assert read_points(path).sd.tolist() == [0], "an empty cell is not exact"
    else:
        assert path.read_text().splitlines()[0].endswith(",sd")


@pytest.mark.parametrize("suffix", [".mrk.json", ".fcsv"])
def test_a_slicer_file_is_read_back_unchanged_and_names_its_coordinate_system(tmp_path, suffix):
    path = tmp_path / f"points{suffix}"
    write_points(path, AT, names=["nose, tip", "chin"])
    assert "LPS" in path.read_text()
    found = read_points(path)
    np.testing.assert_array_equal(found.points, AT)
    assert found.names == ("nose, tip", "chin")
    assert found.unit == "mm"


def test_slicer_coordinates_in_ras_are_converted(tmp_path):
    markups = {
        "coordinateSystem": "RAS",
        "controlPoints": [{"label": "F", "position": [3, -2.25, 1.5]}],
    }
    (tmp_path / "a.mrk.json").write_text(json.dumps({"markups": [markups]}))
    np.testing.assert_array_equal(read_points(tmp_path / "a.mrk.json").points, AT[:1])
    (tmp_path / "old.fcsv").write_text(
        "# Markups fiducial file version = 4.6\n# CoordinateSystem = 0\n"
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
        "vtk_1,3,-2.25,1.5,0,0,0,1,1,1,0,F-1,,\n"
    )
    np.testing.assert_array_equal(read_points(tmp_path / "old.fcsv").points, AT[:1])


#: Names and texts of invalid files.
INVALID = [
    ("a.csv", ""),
    ("a.csv", "index,axis-0,axs-1\n0,1,2\n"),
    ("a.csv", "index,axis-1,axis-0\n0,1,2\n"),
    ("a.csv", "x,y\n1,2\n"),
    ("a.csv", "index,axis-0,axis-1\n0,one,2\n"),
    ("a.csv", "Pt-0,true,1,2,3,4,-1\n"),
    ("a.csv", "Pt-0,true,1,2,nan,4\n"),
    ("a.mrk.json", "{"),
    ("a.txt", ""),
]


def test_an_invalid_file_of_landmarks_is_refused_by_name(tmp_path):
    for name, text in INVALID:
        (tmp_path / name).write_text(text)
        with pytest.raises(FileFormatError, match=rf"^{name}: "):
            read_points(tmp_path / name)


def test_landmarks_that_cannot_be_saved_are_refused_and_no_file_is_written(tmp_path):
    for points, more, field in (
        ((AT, TO[:1]), {}, "targets"),
        ((AT[:, :1],), {}, "points"),
        ((AT, TO), {"sd": [1, 2, 3]}, "sd"),
    ):
        with pytest.raises(ProblemError) as refused:
            write_points(tmp_path / "a.csv", *points, **more)
        assert refused.value.field == field
    for points, more in (((AT, TO), {}), ((AT,), {"sd": 1.0})):
        with pytest.raises(FileFormatError, match=r"a\.fcsv"):
            write_points(tmp_path / "a.fcsv", *points, **more)
    assert not list(tmp_path.iterdir())
