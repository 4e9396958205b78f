"""Tests of study files: reading back, replaying and refusing damaged files."""

import dataclasses
import io
import json
import os
import subprocess
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest

from napari_hmrf import (
    ICM,
    ArgumentError,
    Arrow,
    BoundaryRule,
    Drawing,
    ElasticPrior,
    FileFormatError,
    Grid,
    HmrfError,
    Landmark,
    Material,
    Motion,
    Multigrid,
    Pictures,
    ProblemError,
    SeilerPrior,
    Solution,
    Stroke,
    Study,
    Tissue,
    read_study,
    replay,
    solve_study,
    write_study,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.fields import is_study_file
from napari_hmrf.io.tables import read_materials, read_preset
from napari_hmrf.landmarks import read_points
from napari_hmrf.tissue import PRESETS, StiffnessCurve
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion
from validation.studies.damaged import MOST_BYTES, damaged, look, plain
from validation.studies.damaged import STUDIES as KEPT

SHAPE = (20, 24)
GRID = Grid(SHAPE, (0.5, 0.8), "millimeter", Frame.at((0.5, 0.8), ("mm", "mm")))
PULL = Drawing(
    (
        Arrow(at=(10, 12), by=(0.5, 1), radius=2, components="row"),
        Landmark((4, 5), (4.5, 6), 1.5, confidence=0.5),
        Stroke("pin", (((2, 3), (2, 8)),), 1.0),
    )
)


def picture(seed=3):
    return np.random.default_rng(seed).integers(1, 255, SHAPE, dtype=np.uint8)


def labels():
    found = np.ones(SHAPE, np.uint8)
    found[8:12, 8:16] = 2
    return found


def painted():
    rim = np.zeros(SHAPE, np.int32)
    rim[0], rim[-1] = 1, 2
    return rim


def by_labels():
    rows = (Material(1, "liver", 5.0, 0.49), Material(2, "bone", np.inf))
    rules = (
        BoundaryRule(1, "fixed", name="holds"),
        BoundaryRule(2, "move", vector=(0.5, 0.0), confidence=(1.0, 0.25)),
    )
    return Study(
        GRID,
        Tissue(labels=labels(), materials=rows, unit="kPa", record={"layer": "Tissue"}),
        Motion(labels=painted(), rules=rules, drawing=PULL),
        prior=ElasticPrior(plane="strain"),
        optimizer=Multigrid(1e-2),
        pictures=Pictures(picture(), labels(), "t1", "Tissue"),
        names={"image": "t1"},
        notes=("its first note",),
    )


def by_curve():
    curve = StiffnessCurve(((0.0, 1.0), (255.0, 10.0)), void_below=0.5)
    stiff = Stroke("tissue", (((14, 6), (14, 14)),), 1.5, label=3)
    motion = Motion(hold_edge=True, drawing=Drawing((*PULL.marks, stiff)))
    tissue = Tissue(curve=curve, preset=PRESETS[1])
    return Study(GRID, tissue, motion, pictures=Pictures(picture(), name="t1"))


def by_arrays():
    c = np.zeros(SHAPE)
    c[0] = c[-1] = 1
    y = np.zeros((*SHAPE, 2))
    y[-1, :, 1] = 0.7
    return Study(
        Grid(SHAPE, (1.0, 1.0)),
        Tissue(stiffness=np.linspace(1, 2, c.size).reshape(SHAPE)),
        Motion(observed=y, confidence=c),
        prior=ElasticPrior(np.linspace(0.1, 0.45, c.size).reshape(SHAPE)),
    )


def by_the_paper():
    motion = Motion(hold_edge=True, drawing=PULL)
    tissue = Tissue(stiffness=np.ones(SHAPE))
    prior = SeilerPrior(penalty=1e5, conditional="blanket")
    return Study(GRID, tissue, motion, prior=prior, optimizer=ICM(12, steps=None))


STUDIES = [by_labels, by_curve, by_arrays, by_the_paper]


@pytest.fixture(params=STUDIES, ids=lambda make: make.__name__)
def study(request):
    return request.param()


def test_a_saved_study_is_read_back_unchanged(study, tmp_path):
    solution = solve_study(study, backend="cpu")
    saved = read_study(write_study(tmp_path / "case", study, solution))
    assert plain(saved.study) == plain(study)
    assert plain(saved.solution.displacement) == plain(solution.displacement)
    assert saved.solution.provenance.model == study.model_name


def test_the_stiffness_may_be_an_image_of_integers(tmp_path):
    shades = np.arange(1, 481, dtype=np.uint16).reshape(20, 24)
    for kind in (np.uint8, np.uint16, np.int32, np.float16):
        study = Study(
            Grid(shades.shape, (1.0, 1.0)), Tissue(stiffness=shades.astype(kind)), Motion(True)
        )
        saved = read_study(write_study(tmp_path / "case", study)).study
        assert plain(saved.tissue.stiffness) == plain(study.tissue.stiffness)


def test_a_study_is_saved_without_a_solution(study, tmp_path):
    path = write_study(tmp_path / "case.study", study)
    assert path.name == "case.study"
    assert is_study_file(path)
    saved = read_study(path)
    assert saved.solution is None
    assert plain(saved.study) == plain(study)


#: Solve and save a study in one process, and replay it in another one, which has solved nothing.
REPLAY = """
import os
import sys

import numba  # otherwise imported by both

from napari_hmrf import read_study, replay, solve_study, write_study

path = sys.argv[1]
child = os.fork()
if not child:
    study = read_study(path).study
    write_study(path, study, solve_study(study, backend="cpu"))
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
print((read_study(path).solution.displacement == replay(path).displacement).all())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="os.fork is not available")
def test_a_study_is_replayed_bit_by_bit_in_a_new_process(tmp_path):
    path = write_study(tmp_path / "a.study", by_labels())
    # A process that compiles a loop rounds differently from a process that loads the loop from
    # disk. The number of threads has no effect.
    solve_study(by_labels(), backend="cpu")
    alone = {**os.environ, "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-c", REPLAY, path]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=alone)
    assert done.stdout == "True\n"


def by_held_patches(count=100):
    """Return a study with a pull and clicks that hold patches of radius 32 pixels as they are."""
    shape, random = (96, 96), np.random.default_rng(5)
    marks = [Arrow((48, 48), (0.0, 4.0), 6.0)]
    for at in random.uniform(0, 95, (count, 2)).tolist():
        lattice = {"start": (at[0] - 32, at[1] - 32), "step": 2, "shape": (33, 33)}
        motion = PatchMotion(**lattice, values=random.normal(0, 0.1, 2 * 33**2))
        marks.append(Arrow(tuple(at), (0, 0), 32.0, motion=motion))
    motion = Motion(hold_edge=True, drawing=Drawing(tuple(marks)))
    return Study(Grid(shape, (1.0, 1.0)), motion=motion)


def header_in(path):
    with np.load(path) as archive:
        return json.loads(archive["header"].item())


def test_a_study_with_a_hundred_held_patches_is_replayed_bit_by_bit(tmp_path):
    study = by_held_patches()
    solution = solve_study(study, backend="cpu")
    in_window = dataclasses.replace(solution, frame={"drawing": study.motion.drawing.as_dict()})
    path = write_study(tmp_path / "held", study, in_window)
    saved = read_study(path)
    assert saved.study.motion.drawing == study.motion.drawing
    assert replay(path).displacement.tobytes() == solution.displacement.tobytes()
    assert header_in(path)["solution"]["frame"] is None, "the drawing is in the file twice"


@pytest.mark.parametrize("path", ["", ".", "folder/..", "a\0b"])
def test_a_path_that_names_no_file_is_refused(path):
    with pytest.raises(ArgumentError, match=r"^path"):
        write_study(path, by_held_patches(2))


@pytest.mark.parametrize("size", [2177, 2179])
def test_held_patches_with_too_few_or_too_many_displacements_are_refused(size, tmp_path):
    path = write_study(tmp_path / "good", by_held_patches(2))
    motion = {"study.motion.drawing.marks.1.motion.values": as_npy(np.zeros(size, np.float32))}
    with pytest.raises(FileFormatError, match=r"bad\.study: .* has a mark with an invalid motion"):
        read_study(with_members(path, tmp_path / "bad.study", **motion))


def test_a_study_saved_without_its_image_accepts_only_that_image(tmp_path):
    study = by_curve()
    path = write_study(tmp_path / "case", study, solve_study(study, backend="cpu"), image=False)
    assert read_study(path).study.pictures.image is None
    assert plain(read_study(path, image=picture()).study) == plain(study)
    with pytest.raises(
        FileFormatError, match=r"case.study: the study was created from another .*'t1'"
    ):
        read_study(path, image=picture(4))
    with pytest.raises(HmrfError, match=r"case.study: the tissue is derived from the image 't1'"):
        replay(path)
    again = replay(path, image=picture())
    assert np.array_equal(again.displacement, read_study(path).solution.displacement)


def test_a_result_file_is_refused_as_a_study(tmp_path):
    solution = solve_study(by_arrays(), backend="cpu").write(tmp_path / "result.npz")
    assert not is_study_file(solution)
    with pytest.raises(FileFormatError, match=r"not a valid napari-hmrf study: it is another kind"):
        read_study(solution)


def test_an_image_of_an_unsupported_type_is_refused_and_the_old_file_remains(tmp_path):
    study = by_curve()
    path = write_study(tmp_path / "case", study)
    strange = Pictures(picture().astype(complex), name="t1")
    with pytest.raises(ValueError, match=r"cannot be saved: study\.pictures.image: .* complex128"):
        write_study(path, dataclasses.replace(study, pictures=strange))
    assert plain(read_study(path).study) == plain(study)


def test_a_damaged_study_is_read_unchanged_or_refused_with_little_memory(tmp_path):
    study, path = by_labels(), tmp_path / "damaged.study"
    content = write_study(path, study, solve_study(study, backend="cpu")).read_bytes()
    original, outcomes = read_study(path), set()
    tracemalloc.start()
    for version in damaged(content, 30):
        path.write_bytes(version.content)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        outcomes.add((version.kind, look(path, version, original, KEPT)))
        assert tracemalloc.get_traced_memory()[1] - before < MOST_BYTES, version.kind
    tracemalloc.stop()
    assert "refused" in {found for _, found in outcomes}


def with_members(path, target, **changed):
    """Write a copy of an archive with some members replaced, and return its path."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members |= {f"{name}.npy": data for name, data in changed.items()}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return target


def as_npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tissue": {"labels": [1, 2]}}, "study.tissue.labels: Input should be an instance of"),
        ({"tissue": {"colour": 1}}, "study.tissue.colour: Unexpected keyword argument"),
        ({"grid": {"shape": [20, -1]}}, r"study.grid: grid: has shape \(20, -1\)"),
        ({"prior": {"class": "Solid"}}, "study.prior: Input tag 'Solid' .* 'ElasticPrior'"),
        ({"prior": {"class": "ElasticPrior", "plane": 3}}, "study.prior.ElasticPrior.plane: "),
    ],
)
def test_a_wrong_value_in_a_file_is_named(change, said, tmp_path):
    path = write_study(tmp_path / "good", Study(GRID))
    header = header_in(path)
    for part, values in change.items():
        header["study"][part] = {**header["study"][part], **values}
    bad = with_members(path, tmp_path / "bad.study", header=as_npy(np.array(json.dumps(header))))
    with pytest.raises(FileFormatError, match=rf"bad\.study: not a valid .* study: {said}"):
        read_study(bad)


def test_an_array_is_expanded_without_a_second_copy(tmp_path):
    image = np.zeros((3000, 3000), np.uint8)
    path = write_study(tmp_path / "a", Study(Grid(image.shape, (1, 1)), pictures=Pictures(image)))
    tracemalloc.start()
    read_study(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1.5 * image.nbytes


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX devices and FIFOs")
def test_devices_and_pipes_are_refused_as_studies_and_tables(tmp_path):
    fifo, device = tmp_path / "a.study", tmp_path / "b.study"
    os.mkfifo(fifo)
    device.symlink_to("/dev/zero")
    for path in (fifo, device):
        for load in (read_study, Solution.read):
            with pytest.raises(FileFormatError, match=r"\.study: it is a pipe or a device"):
                load(path)
    for load, name in ((read_points, "a.csv"), (read_materials, "a.csv"), (read_preset, "a")):
        endless = tmp_path / f"endless-{load.__name__}-{name}"
        endless.symlink_to("/dev/zero")
        with pytest.raises(FileFormatError, match="too large"):
            load(endless)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"spacing": (1.0, 1.0)},
            r"field has pixels of 1 x 1 millimeter.*Use the solution",
        ),
        ({"unit": "um"}, r"field has pixels of 0\.5 x 0\.8 um"),
        (
            {"frame": Frame.at((0.5, 0.8), ("mm",) * 2, affine=np.diag([1, -1, 1])).as_dict()},
            "place",
        ),
        (
            {
                "tissue": np.ones((20, 25), bool),
                "displacement": np.zeros((20, 25, 2)),
                "elasticity": None,
            },
            "is 20 x 24, but the field is 20 x 25",
        ),
    ],
)
def test_a_solution_on_another_grid_is_not_saved_with_a_study(change, said, tmp_path):
    study = by_labels()
    solution = solve_study(study, backend="cpu")
    with pytest.raises(ProblemError, match=said):
        write_study(tmp_path / "case", study, dataclasses.replace(solution, **change))
    assert not (tmp_path / "case.study").exists()


def test_a_saved_field_retains_its_unit(tmp_path):
    study = by_labels()
    solution = solve_study(study, backend="cpu")
    in_micrometres = dataclasses.replace(
        solution, spacing=(500.0, 800.0), displacement=1000 * solution.displacement, unit="um"
    )
    saved = read_study(write_study(tmp_path / "case", study, in_micrometres)).solution
    assert (saved.spacing, saved.unit) == ((500.0, 800.0), "um")
    unknown = dataclasses.replace(solution, unit="")
    assert read_study(write_study(tmp_path / "case", study, unknown)).solution.unit == "millimeter"
