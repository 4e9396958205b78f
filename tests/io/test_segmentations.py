"""Tests of tissue tables derived from the label names of a segmentation."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from napari_hmrf import FileFormatError, Material, read_study
from napari_hmrf.cli import main
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.io.segmentation_tables import tissue_table
from napari_hmrf.io.tables import read_materials
from napari_hmrf.resources import resource_folder
from napari_hmrf.tissue import RIGID, lookup_tissue, materials_by_name, read_label_names

TOTAL = {
    5: "liver",
    16: "trachea",
    20: "colon",
    21: "urinary_bladder",
    75: "femur_left",
    80: "gluteus_maximus_left",
    90: "brain",
    91: "skull",
    200: "subcutaneous_fat",
}
FREESURFER = """\
#$Id: a table of colours $
#No. Label Name:                            R   G   B   A

0   Unknown                                 0   0   0   0
2   Left-Cerebral-White-Matter              245 245 245 0
3   Left-Cerebral-Cortex                    205 62  78  0
4   Left-Lateral-Ventricle                  120 18  134 0
7   Left-Cerebellum-White-Matter            220 248 164 0
24  CSF                                     60  60  60  0

120 SC-Fat-Muscle                           240 128 200 0
123 Muscle                                  180 70  70  0
125 Adipose                                 255 255 0   0
130 Air                                     0   1   2   0
165 Skull                                   120 120 120 0
1001    ctx-lh-bankssts                     25  100 40  0
"""
SNAP = """\
################################################
# ITK-SnAP Label Description File
################################################
    0     0    0    0        0  0  0    "Clear Label"
    1   255    0    0        1  1  1    "cortical bone"
    2     0  255    0      0.5  1  1    "Left kidney"
"""
SLICER = """\
# Color table file tissues.ctbl
# 3 values
0 air 0 0 0 0
1 subcutaneous_fat 255 250 160 255
2 "white matter" 250 250 225 255
"""
SEGMENTS = (
    b"NRRD0004\ntype: unsigned char\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n"
    b"Segment0_ID:=Segment_1\nSegment0_LabelValue:=1\nSegment0_Layer:=0\nSegment0_Name:=tibia\n"
    b"Segment1_LabelValue:=3\nSegment1_Layer:=0\nSegment1_Name:=muscle\n"
    b"Segment1_Color:=1 0 0\n\n"
) + bytes(8)


def tissues(names):
    return {label: tissue.name for label, tissue in materials_by_name(names).tissues.items()}


@pytest.mark.parametrize(
    "content",
    [
        TOTAL,
        {"total": TOTAL},
        {"labels": {"background": 0, **{name: label for label, name in TOTAL.items()}}},
        {"labels": {"0": "background", **TOTAL}, "numTraining": 3, "name": "a data set"},
    ],
    ids=["a class map", "one of several maps", "dataset.json", "an earlier dataset.json"],
)
def test_a_class_map_of_totalsegmentator_is_read_as_tissue(tmp_path, content):
    path = tmp_path / "classes.json"
    path.write_text(json.dumps(content))
    names = read_label_names(path)
    assert {**names, 0: "background"} == {**TOTAL, 0: "background"}
    assert tissues(names) == {
        5: "liver",
        16: "air",
        21: "blood or another fluid",
        75: "bone",
        80: "muscle",
        90: "brain",
        91: "bone",
        200: "fat",
    }
    found = tissue_table(path)
    assert found.unit == "kPa"
    stiffness = {row.label: row.stiffness for row in found.materials}
    assert stiffness[91] == RIGID
    assert stiffness[16] == 0
    assert stiffness[21] < stiffness[90] < stiffness[80] < stiffness[5]
    assert found.unknown.items() >= {20: "colon"}.items()


def test_a_colour_table_of_freesurfer_is_read_as_tissue(tmp_path):
    path = tmp_path / "FreeSurferColorLUT.txt"
    path.write_text(FREESURFER)
    names = read_label_names(path)
    assert names[1001] == "ctx-lh-bankssts"
    assert tissues(names) == {
        2: "white matter",
        3: "grey matter",
        4: "cerebrospinal fluid",
        7: "white matter",
        24: "cerebrospinal fluid",
        123: "muscle",
        125: "fat",
        130: "air",
        165: "bone",
        1001: "grey matter",
    }
    assert materials_by_name(names).unknown == {0: "Unknown", 120: "SC-Fat-Muscle"}


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("labels.txt", SNAP, {0: "Clear Label", 1: "cortical bone", 2: "Left kidney"}),
        ("tissues.ctbl", SLICER, {0: "air", 1: "subcutaneous_fat", 2: "white matter"}),
        ("a.csv", "LabelValue,Name,Color_R\n1,liver,3\n2,,4\n", {1: "liver", 2: ""}),
        ("a.csv", "index, structure\n1, liver\n\n7.0, spleen\n", {1: "liver", 7: "spleen"}),
        ("some.seg.nrrd", SEGMENTS, {1: "tibia", 3: "muscle"}),
    ],
)
def test_label_names_are_read_from_tables_of_other_tools(tmp_path, file, content, expected):
    path = tmp_path / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert read_label_names(path) == expected


def test_an_invalid_table_of_names_is_refused(tmp_path):
    for file, content in (
        ("a.txt", b"a letter to a friend\n"),
        ("a.json", b"{]"),
        ("a.ctbl", b"1 bone 1 2 3 4\n1 fat 1 2 3 4\n"),
        ("a.txt", b"\xff\xfe1"),
    ):
        path = tmp_path / file
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=file):
            read_label_names(path)


def test_a_misspelt_column_is_not_replaced_by_published_values(tmp_path):
    for file, content, place in (
        ("a.csv", "label,name,young\n1,brain,3\n", "there is no column 'young'"),
        ("a.csv", "label,name,stiffnes\n1,brain,3\n", "there is no column 'stiffnes'"),
        ("a.csv", "label,name\nx,brain\n", "line 2"),
        (
            "a.json",
            '{"brain": {"label": 1, "young": 3}, "fat": {"label": 2, "young": 1}}',
            "'brain'",
        ),
        ("a.json", '{"1": "brain", "young": 2.5}', "'young'"),
        ("a.txt", "1 bone 1 2 3 4\n2 fat 1 2\n", "line 2"),
    ):
        path = tmp_path / file
        path.write_text(content)
        for read in (read_label_names, tissue_table):
            with pytest.raises(FileFormatError, match=rf"{file}: {place}"):
                read(path)


def test_a_table_of_materials_is_refused_as_a_list_of_names(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text("label,name,stiffness\n1,brain,3\n")
    assert tissue_table(path).materials == (Material(1, "brain", 3.0),)
    with pytest.raises(FileFormatError, match=r"m\.csv: a table of label names has no column 'st"):
        read_label_names(path)
    path.write_text("label,name,poisson\n1,brain,0.4\n")
    with pytest.raises(FileFormatError, match=r"m\.csv: line 2: stiffness is missing"):
        tissue_table(path)
    (tmp_path / "m.json").write_text('{"materials": [{"label": 1, "young": 3}]}')
    with pytest.raises(FileFormatError, match=r"m\.json: there is no column 'young'"):
        tissue_table(tmp_path / "m.json")


def test_a_list_of_names_with_other_columns_is_not_a_table_of_materials(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("LabelValue,Name,Color_R,Color_A,Type_CodeMeaning\n1,liver,3,255,Organ\n")
    assert tissue_table(path).materials[0].stiffness == 5.4


def test_no_tissue_is_guessed_for_an_ambiguous_name():
    for name in (
        "colon",
        "liver_lesion",
        "lung_nodules",
        "costal_cartilages",
        "fat and muscle",
        "left ventricle",
        "non-WM-hypointensities",
        "background",
        "lung wall",
        "heart",
        "",
    ):
        assert lookup_tissue(name) is None, name


@pytest.mark.parametrize(
    ("name", "tissue"),
    [
        ("kidney_cyst_left", "blood or another fluid"),
        ("heart_ventricle_left", "blood or another fluid"),
        ("Left-Lateral-Ventricle", "cerebrospinal fluid"),
        ("liver_tumor", "liver tumour"),
        ("portal_vein_and_splenic_vein", "blood or another fluid"),
        ("rib_left_12", "bone"),
        ("Brain-Stem", "brain"),
    ],
)
def test_a_longer_name_takes_precedence(name, tissue):
    assert lookup_tissue(name).name == tissue


def test_every_known_tissue_has_a_source_valid_values_and_unique_names():
    file = resource_folder("sample_data") / "tissue_names.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["unit"] == "kPa"
    names = [name for row in content["tissues"] for name in row["names"]]
    assert len(set(names)) == len(names)
    for row in content["tissues"]:
        assert row["source"]
        assert row["stiffness"] == "rigid" or 0 <= row["stiffness"] < 100
        assert 0 <= row["poisson"] <= 0.49
        assert {lookup_tissue(name).name for name in row["names"]} == {row["name"]}


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a picture with a skull, a brain, an air tube and a label of unknown stiffness."""
    monkeypatch.chdir(tmp_path)
    labels = np.full((24, 30), 91, np.uint8)
    labels[3:-3, 3:-3] = 90
    labels[10:14, 10:14], labels[10:14, 20:24] = 16, 20
    write_image("labels.png", ImageFile(labels))
    write_image("image.png", ImageFile(labels))
    write_image("rim.png", ImageFile(np.uint8(np.arange(24) == 5)[:, None].repeat(30, axis=1)))
    (tmp_path / "classes.json").write_text(json.dumps(TOTAL))
    (tmp_path / "rules.csv").write_text("label,action,row,col\n1,move,0,1\n")
    return tmp_path


def test_the_shell_writes_a_table_and_lists_labels_of_unknown_stiffness(files, capsys):
    assert main(["materials", "classes.json", "--labels", "labels.png", "-o", "m.csv"]) == 0
    said = capsys.readouterr().out
    assert "brain (1.642 kPa, nu 0.45): 90 brain\n" in said
    assert "air (0 kPa): 16 trachea\n" in said
    assert "unknown (fill in or remove): 20 colon\n" in said
    with pytest.raises(FileFormatError, match=r"m\.csv: line 3: stiffness is missing"):
        read_materials("m.csv")
    text = (files / "m.csv").read_text()
    (files / "m.csv").write_text(text.replace("20,colon,,,", "20,colon,7,0.4,my own"))
    assert read_materials("m.csv") == (
        Material(16, "trachea", 0.0),
        Material(20, "colon", 7.0, 0.4),
        Material(90, "brain", 1.642),
        Material(91, "skull", RIGID),
    )


def test_the_shell_solves_with_the_label_names_of_a_segmentation(files, capsys):
    command = "solve image.png --labels labels.png --materials classes.json --boundary rim.png "
    command += "--rules rules.csv -o out --backend cpu"
    assert main(command.split()) == 0
    said = capsys.readouterr().out
    assert "note: classes.json: no stiffness is known for 20 (colon): that of " in said
    assert (
        "note: classes.json: the table only names its labels, so published stiffness is used for "
        "16 (trachea), 90 (brain), 91 (skull)\n"
    ) in said
    study, _ = read_study(files / "out" / "image.study")
    assert study.tissue.unit == "kPa"
    assert {row.label for row in study.tissue.materials} == set(TOTAL)
    (files / "none.json").write_text(json.dumps({1: "a", 2: "b"}))
    command = "solve image.png --labels labels.png --materials none.json --hold-edge -o out"
    assert main(command.split()) == 1
    said = capsys.readouterr().err
    assert "none.json contains no stiffness, and none of its names (a, b) is a tissue" in said
    assert "Give a .csv with the columns label, name and stiffness." in said


def test_the_menu_of_the_dock_reads_the_label_names_of_a_segmentation(files, qtbot):
    from napari_hmrf.ui.tissue_tables import MaterialMenu

    rows = (Material(0, "", 0.0), Material(20, "tissue 20", 5.0), Material(91, "tissue 91", 5.0))
    table, said = SimpleNamespace(rows=rows, layer=None, contents=None), []
    menu = MaterialMenu(table, list)
    qtbot.addWidget(menu)
    menu.message.connect(said.append)
    menu.copy_materials("classes.json")
    assert table.contents.unit == "kPa"
    assert table.contents.rows == (
        Material(0, "", 0.0),
        Material(20, "colon", 5.4, 0.49),
        Material(91, "skull", RIGID),
    )
    assert said == [
        (
            "Materials: classes. The table only names its labels, so published stiffness is used "
            "for 91 (skull). No stiffness is known for 20 (colon): that of liver is used."
        )
    ]
    menu.copy_materials("classes.json")
    (files / "own.csv").write_text("label,name,stiffness\n91,skull,rigid\n20,colon,9\n")
    before = table.contents
    (files / "young.csv").write_text("label,name,young\n91,skull,3\n20,colon,9\n")
    with pytest.raises(FileFormatError, match=r"no column 'young'\. Did you mean 'stiffness'"):
        menu.copy_materials("young.csv")
    assert table.contents is before
    menu.copy_materials("own.csv")
    assert {row.label: row.stiffness for row in table.contents.rows} == {
        0: 0.0,
        20: 9.0,
        91: RIGID,
    }
