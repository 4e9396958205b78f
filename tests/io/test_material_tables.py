"""Tests of material files and of presets that replace a table."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from napari.layers import Image, Labels

from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.tables import read_preset, write_preset
from napari_hmrf.layers.metadata import (
    METADATA,
    TISSUE,
    layer_metadata,
    metadata_of,
    rows_of,
    tissue_record,
    tissue_recorded,
)
from napari_hmrf.solver.solution import Provenance
from napari_hmrf.tissue.boundary_rules import RIGID, Material, default_material
from napari_hmrf.tissue.material_presets import PRESETS, Preset
from napari_hmrf.tissue.tissue_names import materials_by_name

LIVER = Preset(
    "Liver",
    "kPa",
    "measured by us",
    (Material(0, "air", 0.0), Material(1, "liver, größer", 5.4, 0.49), Material(7, "fat", 2.0)),
)


def test_a_saved_preset_is_read_back_unchanged(tmp_path):
    for preset in (*PRESETS, LIVER):
        assert read_preset(write_preset(tmp_path / "table.json", preset)) == preset


def test_a_material_file_is_readable_text(tmp_path):
    path = write_preset(tmp_path / "mine", LIVER)
    assert path.name == "mine.json"
    text = path.read_text(encoding="utf-8")
    assert '"name": "liver, größer"' in text
    assert json.loads(text)["materials"][1]["stiffness"] == 5.4


def test_missing_keys_of_a_material_file_have_defaults(tmp_path):
    path = tmp_path / "by hand.json"
    expected = Preset("by hand", "", "the file by hand.json", (Material(1, "tissue 1", 3.0),))
    for rows in ([{"label": 1, "stiffness": 3}], [{"label": 1, "stiffness": "3", "source": "me"}]):
        for content in (rows, {"materials": rows}):
            path.write_text(json.dumps(content))
            assert read_preset(path) == expected


def spoilt(**changes):
    row = {"label": 1, "name": "gel", "stiffness": 2.0, "poisson": 0.4}
    return {"name": "a", "unit": "kPa", "materials": [row, {**row, "label": 2, **changes}]}


#: Contents of invalid files, and text of the message.
INVALID = [
    ([], "has no rows"),
    ({"materials": []}, "has no rows"),
    (5, "not a table"),
    ({"materials": [5]}, "not a table"),
    ({"materials": [{"label": 1, "stiffness": 1}], "unit": 3}, "unit must be text"),
    ({"materials": [{"label": 1, "stiffness": 1}], "untit": "kPa"}, "untit"),
    ({"materials": [{"label": 1}]}, "row 1: stiffness is missing"),
    ({"materials": [{"label": 1, "stiffness": 0}]}, "no stiffness above 0"),
    (spoilt(label=1), "row 2: label 1 occurs twice"),
    (spoilt(label=1.5), "row 2: label must be"),
    (spoilt(stiffness="stiff"), "row 2: stiffness must be"),
    (spoilt(stiffness=float("inf")), "not valid JSON"),
    (spoilt(poisson=0.5), "row 2: poisson must be a number from 0 to 0.499, not 0.5"),
    (spoilt(poison=0.5), "there is no column 'poison'. Did you mean 'poisson'?"),
]


def test_an_invalid_material_file_is_refused_by_its_name_and_row(tmp_path):
    path = tmp_path / "table.json"
    for values, said in INVALID:
        path.write_text(json.dumps(values))
        with pytest.raises(FileFormatError, match=rf"^table\.json.*{re.escape(said)}"):
            read_preset(path)


SKULL = Preset("Head", "kPa", "", (Material(1, "brain", 3.0), Material(2, "skull", float("inf"))))


def test_rigid_tissue_is_saved_as_a_word(tmp_path):
    path = write_preset(tmp_path / "head.json", SKULL)
    assert read_preset(path) == SKULL
    values = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert values["materials"][1]["stiffness"] == "rigid"


def test_metadata_and_records_of_rigid_tissue_are_valid_json():
    labels = Labels(np.zeros((4, 4), np.uint8), name="Tissue")
    labels.metadata.update(layer_metadata(TISSUE, SKULL.materials, "kPa"))
    record = tissue_record(labels, SKULL.materials)
    json.dumps([metadata_of(labels), record], allow_nan=False)
    assert rows_of(labels, TISSUE) == SKULL.materials
    run = Provenance("cpu", "here", "1", 0.0, parameters={"tissue": record})
    made = Image(
        np.zeros((4, 4)), metadata={METADATA: {"solution": SimpleNamespace(provenance=run)}}
    )
    assert tissue_recorded(made) == (SKULL.materials, "kPa")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 200_000, b" " * 2**21])
def test_a_file_without_json_is_refused(tmp_path, content):
    path = tmp_path / "table.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"table\.json"):
        read_preset(path)


def test_a_preset_matches_rows_by_name_then_by_label_and_reports_missing_rows():
    brain = Preset("", "kPa", "", (Material(1, "fluid", 0.1), Material(2, "Tumour ", 8.0)))
    table = (
        Material(0, "air", 0.0),
        Material(1, "normal tissue", 20.0),
        Material(2, "soft tissue", 10.0),
        Material(3, "tumour", 40.0),
    )
    found, words = brain.replace_materials(table)
    assert [(row.label, row.stiffness) for row in found] == [(0, 0), (1, 0.1), (2, 0.1), (3, 8)]
    assert words == "'normal tissue' is now fluid, 'soft tissue' is now as stiff as fluid."
    found, words = PRESETS[0].replace_materials(table)
    assert (found[1:], words) == (PRESETS[0].materials, ""), "equal names are reported"
    liver = next(preset for preset in PRESETS if preset.name.startswith("Liver"))
    words = liver.replace_materials((Material(0, "unpainted", 20.0), *table[1:]))[1]
    assert words == (
        "'unpainted' is now as stiff as liver, 'normal tissue' is now liver, "
        "'soft tissue' is now hepatocellular carcinoma, 'tumour' is now as stiff as liver."
    )


def test_a_preset_preserves_growth_and_sliding_and_may_set_them():
    tumour, lung = Material(2, "tumour", 40.0, growth=0.2), Material(3, "lung", 1.0, slides=True)
    table = (Material(1, "muscle", 20.0), tumour, lung, Material(4, "fat", 1.0, slides=True))
    rows = (Material(2, "tumour", 8.0), Material(3, "lung", 2.0), Material(4, "bone", RIGID))
    found, _ = Preset("", "kPa", "", rows).replace_materials(table)
    assert found[1:3] == (replace(tumour, stiffness=8.0), replace(lung, stiffness=2.0))
    assert not found[3].slides, "rigid tissue cannot slide"
    own = (Material(1, "muscle", 3.0, slides=True), replace(tumour, growth=0.5))
    found, _ = Preset("", "kPa", "", own).replace_materials(table)
    assert found[:2] == own
    named = materials_by_name({2: "tumour", 3: "lung"})
    found, _ = named.replace_materials(table[1:3])
    assert found[0].growth == 0.2
    assert found[1].slides


def test_a_preset_preserves_rigid_tissue_and_makes_no_other_tissue_rigid():
    table = (Material(0, "air", 0.0), Material(1, "gel", 20.0), Material(9, "implant", RIGID))
    found, words = LIVER.replace_materials(table)
    assert found[-1].is_rigid
    assert "implant" not in words
    bone_first = Preset("", "kPa", "", (Material(1, "bone", RIGID), Material(2, "brain", 3.0)))
    found, words = bone_first.replace_materials((*table, Material(4, "fat", 2.0)))
    assert [row.stiffness for row in found] == [0, RIGID, 3, 3, RIGID]
    assert words.endswith("'fat' is now as stiff as brain.")
    only_bone = replace(bone_first, materials=bone_first.materials[:1])
    assert only_bone.replace_materials((*table, Material(4, "fat", 2.0)))[0][2].stiffness == 2.0


def test_a_new_label_is_not_rigid():
    known = (Material(0, "air", 0.0), Material(1, "bone", RIGID), Material(2, "gel", 5.0))
    assert default_material(3, known).stiffness == 5.0
    assert default_material(3, known[:2]).is_deformable


def test_a_material_gets_a_new_label_if_a_name_matches_its_label():
    brain = Preset("", "kPa", "", (Material(1, "fluid", 0.1), Material(2, "tumour", 8.0)))
    found, words = brain.replace_materials((Material(1, "tumour", 40.0),))
    assert found == (Material(1, "tumour", 8.0), Material(3, "fluid", 0.1))
    assert not words
