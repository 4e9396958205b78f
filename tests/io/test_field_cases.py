"""Tests of files as scanners and other programs write them, in Python, the shell and the window.

Each file is read as it is, or refused with its reason; none is read as another one.
"""

import gzip
import json
import re
from dataclasses import replace
from pathlib import Path

import napari
import numpy as np
import pytest
import tifffile
from napari.components import ViewerModel
from napari.layers import Layer
from napari.layers._source import layer_source

from napari_hmrf import FileFormatError, HmrfError, ProblemError, read_study
from napari_hmrf.cli import main
from napari_hmrf.contributions import open_landmarks, open_scan
from napari_hmrf.fields import grid_of_image, read_field
from napari_hmrf.geometry import Geometry
from napari_hmrf.io import case, itk_files, itk_reader
from napari_hmrf.io.apply import FieldFile, _note_on_labels, apply_field
from napari_hmrf.io.case import as_labels, read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.decoded import Unreadable
from napari_hmrf.io.dicom_slices import tilted_step
from napari_hmrf.io.images import axes_of_tiff, is_scan, read_image, write_image
from napari_hmrf.io.landmark_files import is_landmark_file
from napari_hmrf.io.registration_files import relative_place
from napari_hmrf.io.segmentation_tables import read_label_names
from napari_hmrf.landmarks import read_points, write_points
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.solver.solution import Provenance, Solution
from tests.support.stored_scans import SHAPE, STORED, write_scan

sitk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")

AXIAL, SAGITTAL = (1, 0, 0, 0, 1, 0), (0, 1, 0, 0, 0, -1)


def write_slice(path, position, direction=AXIAL, slope=b"", value=3, series="1.2.3"):
    """Write a DICOM file with one slice of a series."""
    image = sitk.GetImageFromArray(np.full((6, 7), value, np.int16))
    along = {"0020|0032": position, "0020|0037": direction, "0028|0030": (1, 1)}
    texts = {key: "\\".join(map(str, values)) for key, values in along.items()}
    texts |= {"0008|0060": "CT", "0020|000e": series, "0020|000d": "1.2", "0020|0052": "1.2.4"}
    texts |= {"0008|0018": f"1.2.5.{path.stem[1:]}", "0020|0013": path.stem[1:]}
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for key, text in texts.items():
        image.SetMetaData(key, text)
    writer.SetFileName(str(path))
    writer.Execute(image)
    if slope:  # SimpleITK does not write integers with a slope that is none
        tag = b"\x28\x00\x53\x10"
        before, after = tag + b"\x02\x00\x00\x001 ", tag + b"\x04\x00\x00\x00" + slope
        path.write_bytes(path.read_bytes().replace(before, after))


def write_series(folder, positions, **others):
    folder.mkdir()
    for number, position in enumerate(positions):
        write_slice(folder / f"s{number}.dcm", position, **others)
    return folder


def along_z(*depths):
    return [(0, 0, depth) for depth in depths]


def write_frames(path, depths):
    """Write a DICOM file of several frames at depths of one digit."""
    sitk.WriteImage(sitk.GetImageFromArray(np.ones((len(depths), 6, 7), np.uint8)), str(path))
    texts = iter(depths)
    placed = re.sub(rb"(?<=0\\0\\)\d ", lambda _: b"%d " % next(texts), path.read_bytes())
    path.write_bytes(placed)
    return path


def nifti(path, sform=None, codes=(1, 1), pixels=None, kind=nibabel.Nifti1Image, **fields):
    """Write a NIfTI file; the qform is that of the zooms 1, 1, 2."""
    pixels = np.ones(SHAPE, np.float32) if pixels is None else pixels
    vectors = pixels.ndim == 4
    stored = np.moveaxis(pixels[None], -1, 0).T if vectors else pixels.T
    image = kind(stored, None)
    image.header.set_qform(np.diag([1.0, 1, 2, 1]), codes[0])
    image.header.set_sform(np.diag([1.0, 1, 2, 1]) if sform is None else sform, codes[1])
    image.header.set_xyzt_units("mm")
    image.header["intent_code"] = 1007 if vectors else 0
    for name, value in fields.items():
        image.header[name] = value
    raw = image.to_bytes()
    path.write_bytes(gzip.compress(raw) if path.suffix == ".gz" else raw)
    return path


def change_sizes(path, stated, shape=SHAPE):
    """Write a NIfTI file whose header states the handedness and the voxel sizes."""
    path = nifti(path, codes=(1, 0), pixels=np.ones(shape, np.float32))
    is_packed = path.suffix == ".gz"
    content = gzip.decompress(path.read_bytes()) if is_packed else path.read_bytes()
    content = content[:76] + np.array(stated, np.float32).tobytes() + content[92:]
    path.write_bytes(gzip.compress(content) if is_packed else content)
    return path


SHIFTED = np.array([[1.0, 0, 0, 3], [0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
SHEARED = np.array([[1.0, 0, 0, 0], [0, 1, 0.5, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
ROUNDED = np.array([[1.0, 0, 0, 3], [0, 1, 0.005, 0], [0, 0, 2, 0], [0, 0, 0, 1]])


def write_tiff(path, axes, sizes=(), unit="um"):
    shape = {"Z": 4, "C": 3, "T": 3, "Y": 8, "X": 9}
    facts = {"axes": axes}
    if sizes:
        facts |= {"spacing": sizes[0]} | ({"unit": unit} if unit else {})
    resolution = {"resolution": (1 / sizes[-1], 1 / sizes[-2])} if sizes else {}
    pixels = np.ones([shape[axis] for axis in axes], np.uint16)
    tifffile.imwrite(path, pixels, imagej=True, metadata=facts, **resolution)
    return path


def write_changed(path, old, new, image=None):
    """Write an image of SHAPE with a changed header."""
    image = sitk.GetImageFromArray(np.ones(SHAPE, np.int16)) if image is None else image
    sitk.WriteImage(image, str(path))
    content = path.read_bytes()
    changed = re.sub(old, new, content, count=1)
    assert changed != content
    path.write_bytes(changed)


def write_layers(path):
    """Write a segmentation of 3D Slicer with two segments in each of two layers."""
    image = sitk.GetImageFromArray(np.ones((*SHAPE, 2), np.uint8), isVector=True)
    for number in range(4):
        image.SetMetaData(f"Segment{number}_LabelValue", str(1 + number % 2))
        image.SetMetaData(f"Segment{number}_Name", f"organ {number}")
        image.SetMetaData(f"Segment{number}_Layer", str(number // 2))
    sitk.WriteImage(image, str(path))


def write_with_scout(folder):
    write_series(folder, along_z(0, 2, 4, 6))
    write_slice(folder / "s9.dcm", (0, 0, 0), SAGITTAL)


def write_two_series(folder):
    write_series(folder, along_z(0, 2, 4, 6))
    write_slice(folder / "s9.dcm", (0, 0, 0), SAGITTAL, series="1.2.6")


def write_truncated(folder, number):
    write_series(folder, along_z(0, 2, 4, 6, 8, 10))
    file = folder / f"s{number}.dcm"
    file.write_bytes(file.read_bytes()[:-20])


def write_without_size(path):
    written = path.with_suffix(".dcm")
    write_slice(written, (0, 0, 0))
    path.write_bytes(written.read_bytes().replace(b"\x28\x00\x30\x00", b"\x28\x00\x34\x00"))


def write_slopes(path):
    """Write frames, with elements of two slopes as in the sequence of enhanced files."""
    content = write_frames(path, (0, 3, 6, 9)).read_bytes()
    pixels = content.rindex(b"\xe0\x7f\x10\x00")
    slopes = b"".join(b"\x28\x00\x53\x10DS\x02\x00" + each for each in (b"1 ", b"2 "))
    path.write_bytes(content[:pixels] + slopes + content[pixels:])


def solution_of(displacement, frame=None, spacing=(1.0, 1.0)):
    tissue = np.ones(displacement.shape[:-1], bool)
    run = Provenance("cpu", "here")
    return Solution(displacement, np.zeros(1), (), tissue, tuple(spacing), run, frame=frame)


def refused(command, capsys):
    """Return the message of a command that fails."""
    assert main([str(each) for each in command]) == 1
    return capsys.readouterr().err


#: Names of images that are refused, functions that write them, and their reasons.
REFUSED = {
    "a missing slice": ("ct", lambda p: write_series(p, along_z(0, 2, 4, 8)), "s2.dcm and s3.dcm"),
    "a tilt": (
        "ct",
        lambda p: write_series(p, [(0, n / 2, 2 * n) for n in range(5)]),
        "tilt of 14",
    ),
    "a shifted slice": (
        "ct",
        lambda p: write_series(p, [(int(n == 2), 0, 2 * n) for n in range(5)]),
        "s2.dcm is 1 mm beside",
    ),
    "two volumes": ("ct", lambda p: write_series(p, along_z(0, 2, 4, 0, 2, 4)), "than one volume"),
    "a scout": ("ct", write_with_scout, "s9.dcm"),
    "two series": ("ct", write_two_series, "2 series (s0.dcm and 3 more, s9.dcm)"),
    "a truncated slice": ("ct", lambda p: write_truncated(p, 3), "s3.dcm is damaged"),
    "a truncated last slice": ("ct", lambda p: write_truncated(p, 5), "s5.dcm is damaged"),
    "no pixel size": ("a.dcm", lambda p: write_without_size(p), "size of its pixels"),
    "no size, no suffix": ("IM1", lambda p: write_without_size(p), "size of its pixels"),
    "different slopes": ("a.dcm", lambda p: write_slopes(p), "different rescale slopes"),
    "frames without order": ("a.dcm", lambda p: write_frames(p, (0, 6, 3, 9)), "order"),
    "frames in one place": ("a.dcm", lambda p: write_frames(p, (0, 3, 3, 6)), "position"),
    "missing frames": ("a.dcm", lambda p: write_frames(p, (0, 3, 9, 12)), "frame 2 and frame 3"),
    "two places": ("a.nii.gz", lambda p: nifti(p, SHIFTED, (1, 2)), "two places"),
    "a sheared sform": ("a.nii.gz", lambda p: nifti(p, SHEARED, (0, 1)), "right angles"),
    "a shear beside a qform": ("a.nii", lambda p: nifti(p, SHEARED, (1, 1)), "right angles"),
    "a sheared NRRD": (
        "a.nrrd",
        lambda p: write_changed(p, rb"0,1\)\n", b"0.5,1)\n"),
        "right angles",
    ),
    "FreeSurfer": ("a.mgz", lambda p: p.write_bytes(b"\x1f\x8b"), "mri_convert a.mgz a.nii.gz"),
    "no spacing": ("a.mha", lambda p: write_changed(p, rb"ElementSpacing.*\n", b""), "no spacing"),
    "spacing 0": ("a.mha", lambda p: write_changed(p, rb"ing = 1 1", b"ing = 1 0"), "positive"),
    "spacing -1": ("a.mha", lambda p: write_changed(p, rb"ing = 1 1", b"ing = 1 -1"), "positive"),
    "no directions": ("a.nrrd", lambda p: write_changed(p, rb"space dir.*\n", b""), "no spacing"),
    "no direction": ("a.nrrd", lambda p: write_changed(p, rb"\(0,0,1\)", b"none"), "of an axis is"),
    "size 0": ("a.nii", lambda p: change_sizes(p, (1, 1, 0, 2)), "sizes (pixdim) 1 x 0 x 2"),
    "size -2": ("a.nii", lambda p: change_sizes(p, (1, 1, 1, -2)), "sizes (pixdim) 1 x 1 x -2"),
    "no handedness": ("a.nii.gz", lambda p: change_sizes(p, (-2, 1, 1, 2)), "qfac"),
    "a DICOMDIR": (
        "DICOMDIR",
        lambda p: p.write_bytes(bytes(128) + b"DICM\x02\0\x02\0UI\x14\x001.2.840.10008.1.3.10"),
        "table of contents",
    ),
    "a result": (
        "a.npz",
        lambda p: solution_of(np.zeros((4, 5, 2), np.float32)).write(p),
        "export, apply, measure or play",
    ),
    "two units": (
        "a.nrrd",
        lambda p: write_changed(p, rb"\n\n", b'\nspace units: "um" "mm" "s"\n\n'),
        "units",
    ),
    "layers": ("a.seg.nrrd", write_layers, "2 layers"),
    "channels": ("a.tif", lambda p: write_tiff(p, "CYX"), "3 channels"),
    "a hyperstack": ("a.tif", lambda p: write_tiff(p, "ZCYX"), "Image > Duplicate"),
    "times": ("a.tif", lambda p: write_tiff(p, "TYX"), "3 times"),
    "another unit": ("a.tif", lambda p: write_tiff(p, "YX", (0.5, 0.5), "foo"), "unit of length"),
}


@pytest.mark.parametrize(("name", "write", "reason"), REFUSED.values(), ids=REFUSED)
def test_an_image_is_refused_with_its_reason(tmp_path, capsys, name, write, reason):
    path = tmp_path / name
    write(path)
    command = ["solve", path, "--hold-edge", "-o", tmp_path / "out"]
    said = [refused(command, capsys)]
    reads = [grid_of_image]
    is_scan_name = name not in ("a.mgz", "a.tif", "a.npz", "IM1")  # others read these
    reads += [open_scan(str(path))] * is_scan_name
    reads += [read_field] * (reason == "right angles") + [read_label_names] * (reason == "2 layers")
    for read in reads:
        with pytest.raises(HmrfError) as error:
            read(str(path))
        said.append(str(error.value))
    for message in said:
        assert name in message
        assert reason in message


def write_tilted_series(folder, pixels):
    folder.mkdir()
    for n, each in enumerate(pixels):
        write_slice(folder / f"s{n}.dcm", (0, round(0.4 * n, 1), 2 * n), value=each)


def write_tilted_frames(path, pixels):
    sitk.WriteImage(sitk.GetImageFromArray(pixels.astype(np.uint8)), str(path))
    frames = iter(range(len(pixels)))

    def placed(_):
        n = next(frames)
        return b"0\\%d\\%d " % (n, 3 * n)

    path.write_bytes(re.sub(rb"0\\0\\\d ", placed, path.read_bytes()))


def write_sheared_nrrd(path, pixels):
    image = sitk.GetImageFromArray(pixels.astype(np.int16))
    write_changed(path, rb"0,1\)\n", b"0.4,1)\n", image)


#: Images that are resampled on request, functions that write them, and the step along their third
#: axis in LPS.
SHEARS = {
    "a tilted series": ("ct", write_tilted_series, (0, 0.4, 2)),
    "tilted frames": ("a.dcm", write_tilted_frames, (0, 1, 3)),
    "a sheared sform": ("a.nii", lambda p, pixels: nifti(p, SHEARED, pixels=pixels), (0, 0.5, -2)),
    "a sheared NRRD": ("a.nrrd", write_sheared_nrrd, (0, 0.4, 1)),
}


@pytest.mark.parametrize(("name", "write", "step"), SHEARS.values(), ids=SHEARS)
def test_a_sheared_image_is_resampled_on_request(tmp_path, name, write, step):
    """A brightness that is linear in the patient stays so."""
    shape, affine = (4, 6, 7), np.eye(3)
    affine[:, 0] = step[::-1]
    if name == "a.nii":  # along right and anterior
        affine *= -1
    stored = Geometry(shape, np.block([[affine, np.zeros((3, 1))], [np.zeros(3), 1]]))

    def brightness(geometry):
        at = geometry.to_world(np.moveaxis(np.indices(geometry.shape), 0, -1))
        return 60 + at @ (5, 2, 1)

    pixels = np.rint(brightness(stored)).astype(np.int16)
    write(tmp_path / name, pixels)
    with pytest.raises(FileFormatError, match=f"napari-hmrf resample {name}"):
        read_image(tmp_path / name)
    image, labels = (
        read_image(tmp_path / name, resample=True, labels=labels) for labels in (False, True)
    )
    grid = image.geometry
    assert grid.right_angled() is grid
    assert len(grid.shape) == 3
    places = stored.to_pixels(grid.to_world(np.moveaxis(np.indices(grid.shape), 0, -1)))
    last = np.array(shape) - 1
    inside = ((places > -1e-6) & (places < last + 1e-6)).all(axis=-1)
    outside = ((places < -0.6) | (places > last + 0.6)).any(axis=-1)
    assert inside.sum() >= pixels.size - 12 * shape[0]
    np.testing.assert_allclose(image.pixels[inside], brightness(grid)[inside], atol=1)
    assert (image.pixels[outside] == pixels.min()).all()
    nearest = np.clip(np.rint(places), 0, last).astype(int)
    is_clear = inside & (np.abs(places - nearest) < 0.49).all(axis=-1)
    np.testing.assert_array_equal(labels.pixels[is_clear], pixels[*nearest[is_clear].T])
    assert (labels.pixels[outside] == 0).all()
    assert name in image.resampled


def test_the_commands_resample_on_request(tmp_path, capsys):
    """The study of a tilted scan is solved, applied and measured with labels of the same grid."""
    _, row, col = np.indices((6, 6, 7))
    disc = np.where(np.hypot(row - 2.5, col - 3) < 2, 200, 100)
    scan, labels, out = (tmp_path / each for each in ("ct", "labels.nrrd", "out"))
    write_tilted_series(scan, disc)
    image = sitk.GetImageFromArray((disc // 100).astype(np.uint8))
    image.SetSpacing((1, 1, float(np.hypot(0.4, 2))))
    turn = np.eye(3)
    turn[:, 2] = np.array((0, 0.4, 2)) / np.hypot(0.4, 2)
    image.SetDirection(turn.ravel().tolist())
    sitk.WriteImage(image, str(labels))
    at, to = tmp_path / "at.mrk.json", tmp_path / "to.mrk.json"
    write_points(at, np.array([[4.0, 3.0, 3.0]]))
    write_points(to, np.array([[4.0, 3.0, 3.5]]))
    ends = ["--boundary", at, "--targets", to, "--hold-edge", "--labels", labels]
    study, others = out / "ct.study", ["--resample", "--force", "-o", out]
    assert "napari-hmrf resample ct" in refused(["solve", scan, *ends, "-o", out], capsys)
    for command in (
        ["solve", scan, *ends, *others],
        ["apply", study, labels, "--labels", *others],
        ["apply", study, scan, *others],
        ["measure", study, "--labels", labels, *others[:-1], out / "table.csv"],
        ["resample", scan, *others[1:]],
        ["register", scan, scan, *others[:-1], tmp_path / "found"],
    ):
        assert main([str(each) for each in command]) == 0
        said = capsys.readouterr().out
        assert said.count("at right angles of 2 x 1 x 1 mm") == 1 + (command[0] == "register")
    written, moved = (read_image(out / each) for each in ("ct.nrrd", "labels.nrrd"))
    assert written.geometry.same_as(moved.geometry)
    assert written.pixels.shape == moved.pixels.shape == (6, 8, 7)
    assert set(np.unique(moved.pixels)) == {0, 1, 2}
    np.testing.assert_array_equal(written.pixels, read_study(study).study.pictures.image)
    (tmp_path / "marks.csv").write_text("a,true,3,3,4,4,3,4\n")
    command = ["solve", scan, "--boundary", tmp_path / "marks.csv", "--hold-edge", *others]
    assert "marks.csv: has coordinates along the axes" in refused(command, capsys)
    command = ["resample", out / "ct.nrrd", *others[1:]]
    assert "ct.nrrd are at right angles" in refused(command, capsys)


@pytest.mark.usefixtures("child_process")
def test_a_volume_is_read_in_the_order_of_its_positions_beside_other_files(tmp_path):
    folder = tmp_path / "ct"
    folder.mkdir()
    for number, depth in enumerate((4, 0, 6, 2)):
        write_slice(folder / f"s{number}.dcm", (0, 0, depth), value=depth)
    (folder / ".DS_Store").write_bytes(b"Mac")
    image = read_image(folder)
    assert image.geometry.spacing == (2, 1, 1)
    assert image.geometry.origin == (0, 0, 0)
    assert image.pixels[:, 0, 0].tolist() == [0, 2, 4, 6]
    assert is_scan(folder)
    frames = write_frames(tmp_path / "frames.dcm", (0, 3, 6, 9))
    assert read_image(frames).pixels.shape == (4, 6, 7)


def test_every_slice_has_its_own_slope(tmp_path):
    folder = tmp_path / "pet"
    folder.mkdir()
    for number, slope in enumerate((b"1.00", b"2.50", b"0.50")):
        write_slice(folder / f"s{number}.dcm", (0, 0, number), slope=slope)
    assert read_image(folder).pixels[:, 0, 0].tolist() == [3, 7.5, 1.5]


def test_the_distances_of_slices_may_be_rounded():
    normal, names = (0, 0, 1), [f"s{n}" for n in range(6)]
    tilted_step(along_z(0, 0.6, 1.3, 1.9, 2.5, 3.1), normal, (1, 1), names)
    with pytest.raises(Unreadable, match="s3 and s4"):
        tilted_step(along_z(0, 0.6, 1.2, 1.8, 3.1, 3.7), normal, (1, 1), names)


PLACES = {
    "one place": (np.diag([1.0, 1, 2, 1]), (1, 2)),
    "two places, of which all programs use the second": (SHIFTED, (2, 1)),
    "right angles up to rounding": (ROUNDED, (0, 1)),
    "right angles up to rounding, beside another place": (ROUNDED, (1, 1)),
    "two places": (SHIFTED, (1, 2)),
    "sheared": (SHEARED, (0, 1)),
}


@pytest.mark.parametrize(("sform", "codes"), PLACES.values(), ids=PLACES)
def test_an_image_of_nibabel_has_the_place_of_its_file(tmp_path, sform, codes):
    path = nifti(tmp_path / "a.nii.gz", sform, codes)
    image = nibabel.load(path)
    try:
        matrix = np.array(grid_of_image(path).place.matrix)
    except FileFormatError as error:
        reason = str(error).rpartition("as an image: ")[2]
        reason = reason.removeprefix("a.nii.gz: ").partition(" Resample")[0].rstrip(".")
        with pytest.raises(ProblemError, match=re.escape(reason)):
            grid_of_image(image)
        return
    at = np.array(grid_of_image(image).place.matrix) @ [1, 2, 3, 1]
    np.testing.assert_allclose(matrix @ [3, 2, 1, 1], at, atol=1e-5)


def test_the_content_of_a_nifti_file_counts_not_its_name(tmp_path):
    pixels = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)
    packed, plain, second = tmp_path / "a.nii", tmp_path / "b.nii.gz", tmp_path / "c.nii"
    plain.write_bytes(nifti(packed, pixels=pixels).read_bytes())
    packed.write_bytes(gzip.compress(packed.read_bytes()))
    nifti(second, pixels=pixels, kind=nibabel.Nifti2Image)
    nibabel.save(nibabel.Nifti1Pair(pixels.T, np.eye(4)), tmp_path / "d.hdr")
    for path in (packed, plain, second, tmp_path / "d.hdr", tmp_path / "d.img"):
        np.testing.assert_array_equal(read_image(path).pixels, pixels)


def test_what_the_standard_allows_as_voxel_sizes_is_read(tmp_path):
    reversed_ = read_image(change_sizes(tmp_path / "a.nii", (-1, 1, 1, 2)))
    assert reversed_.geometry.affine[0, 0] == -2
    assert read_image(change_sizes(tmp_path / "a.nii", (0, 1, 1, 2))).geometry.affine[0, 0] == 2
    picture = read_image(change_sizes(tmp_path / "b.nii", (1, 1, 3, 0), (6, 7)))
    assert picture.geometry.spacing == (3, 1)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_the_slope_of_a_nifti_file_counts(tmp_path, suffix):
    image = nibabel.Nifti1Image(np.full((3, 4, 5), 7, np.int16), np.eye(4))
    image.header.set_slope_inter(0.5, -2)
    nibabel.save(image, tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(read_image(tmp_path / f"a{suffix}").pixels, 1.5)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_nan_and_infinite_voxels_stay_so(tmp_path, dtype):
    pixels = np.arange(np.prod(SHAPE), dtype=dtype).reshape(SHAPE)
    pixels[1, 2, 3], pixels[4, 5, 6] = np.nan, -np.inf
    read = read_image(nifti(tmp_path / "a.nii", pixels=pixels))
    again = read_image(write_image(tmp_path / "b.nii.gz", read))
    for image in (read, again):
        np.testing.assert_array_equal(image.pixels, pixels)


def test_fields_of_other_programs_in_nifti_are_read_as_displacements(tmp_path):
    """Their vectors are positions or displacements along right, anterior, superior."""
    u = np.random.default_rng(0).normal(size=(*SHAPE, 3)).astype(np.float32)
    lps = (-1, -1, 1)
    index = np.moveaxis(np.indices(SHAPE), 0, -1)[..., ::-1] * (1, 1, 2)
    itk = read_field(nifti(tmp_path / "itk.nii", pixels=(u * lps).astype(np.float32)))
    positions = (index + u).astype(np.float32)
    for name, parameter, code, vectors in (
        (b"NREG_TRANS", 0, 1007, positions),
        (b"NREG_TRANS", 1, 1007, u),
        (b"Mapping", 0, 1007, positions),
        (b"", 0, 1006, u),
    ):
        fields = {"intent_name": name, "intent_p1": parameter, "intent_code": code}
        path = nifti(tmp_path / "other.nii", pixels=vectors, **fields)
        np.testing.assert_allclose(read_field(path).vectors, itk.vectors, atol=1e-5)
    for fields in ({"intent_name": b"NREG_TRANS", "intent_p1": 2}, {"sform": SHEARED}):
        with pytest.raises(FileFormatError, match=r"other\.nii"):
            read_field(nifti(tmp_path / "other.nii", pixels=u, **fields))
    u[0, 0, 0, 0] = np.nan
    with pytest.raises(FileFormatError, match="NaN"):
        read_field(nifti(tmp_path / "other.nii", pixels=u))


def test_the_unit_of_an_nrrd_counts(tmp_path):
    image = sitk.GetImageFromArray(np.ones(SHAPE, np.int16))
    image.SetSpacing((500.0, 500.0, 2000.0))
    path = tmp_path / "a.nrrd"
    sitk.WriteImage(image, str(path))
    head, _, rest = path.read_bytes().partition(b"\n\n")
    path.write_bytes(head + b'\nspace units: "um" "um" "um"\n\n' + rest)
    assert read_image(path).geometry.spacing == pytest.approx((2.0, 0.5, 0.5))


#: Axes, size of a pixel and unit of a .tif of ImageJ, and the unit in which it is read.
CALIBRATED = {
    "square": ("YX", (0.5, 0.5), "um", "µm"),
    "oblong": ("YX", (0.5, 0.7), "micron", "µm"),
    "flat": ("ZYX", (2.5, 0.5, 0.5), "\\u00B5m", "µm"),
    "flat, in pixels": ("ZYX", (2.5, 1.0, 1.0), "px", "pixel"),
}


@pytest.mark.parametrize(("axes", "sizes", "unit", "read_as"), CALIBRATED.values(), ids=CALIBRATED)
def test_the_calibration_of_a_tif_counts(tmp_path, monkeypatch, axes, sizes, unit, read_as):
    path = write_tiff(tmp_path / "cells.tif", axes, sizes, unit)
    n = len(sizes)
    at, to = np.full(n, 2.0), np.full(n, 2.0)
    to[-1] = 3.0
    stored = [",".join(map(str, (place * sizes)[::-1])) for place in (at, to)]
    marks = tmp_path / "marks.csv"
    marks.write_text(f"a,true,{stored[0]},{stored[1]}\n")
    study = read_case(Case(path, boundary=marks))
    for grid in (study.grid, grid_of_image(path)):
        assert grid.spacing == pytest.approx(sizes)
        assert grid.unit == read_as
    (mark,) = study.motion.drawing.marks
    np.testing.assert_allclose((mark.source, mark.target), (at, to))
    d = np.zeros((*study.grid.shape, n), np.float32)
    d[..., -1] = sizes[-1]
    frame = None if study.grid.place is None else study.grid.place.as_dict()
    field = FieldFile.of(replace(solution_of(d, frame, sizes), unit=read_as))
    for name in ("cells.tif", "marks.csv"):
        apply_field(field, tmp_path / name, tmp_path / f"moved {name}", labels=False)
    np.testing.assert_allclose(read_points(tmp_path / "moved marks.csv").points, [to * sizes])
    if read_as == "µm":
        twice = tuple(2 * size for size in sizes)
        write_tiff(tmp_path / "twice.tif", axes, twice, unit)
        with pytest.raises(ProblemError, match=r"twice\.tif: has pixels of"):
            apply_field(field, tmp_path / "twice.tif", tmp_path / "no.tif", labels=False)
    moved = read_image(tmp_path / "moved cells.tif")
    assert (moved.sizes, moved.unit) == (pytest.approx(sizes), read_as)

    viewer = ViewerModel()
    with layer_source(path=str(path)):
        layer = viewer.add_image(tifffile.imread(path))  # as napari's own reader does
    monkeypatch.setattr(napari, "current_viewer", lambda: viewer)
    for made, place in zip(open_landmarks(str(marks))(str(marks)), (at, to), strict=True):
        points = viewer.add_layer(Layer.create(*made))
        seen = layer.world_to_data(points.data_to_world(points.data[0]))
        np.testing.assert_allclose(seen, place)
    request = Request(image=layer, view=View.of(viewer.dims, volume=n == 3))
    if len(set(sizes)) == 1:
        assert any("pixels of 0.5 x 0.5 µm" in note for note in study_from_layers(request).notes)
        return
    with pytest.raises(ProblemError):
        study_from_layers(request)
    layer.scale, layer.units = sizes, (read_as,) * n
    assert study_from_layers(request).grid.spacing == pytest.approx(sizes)


@pytest.mark.parametrize(
    ("resolution", "per", "read_as"),
    [
        ((20000, 10000), "CENTIMETER", ((1e-4, 5e-5), "cm")),
        ((300, 300), "INCH", ((1 / 300, 1 / 300), "inch")),
        ((72, 72), "INCH", ((), "pixel")),
        ((0, 0), "INCH", ((), "pixel")),
        ((3, 3), "NONE", ((), "pixel")),
    ],
)
def test_the_resolution_of_a_tif_is_read_as_in_fiji(tmp_path, resolution, per, read_as):
    path, stack = tmp_path / "a.tif", np.ones((4, 8, 9), np.uint8)
    how = {"resolution": resolution, "resolutionunit": per, "photometric": "minisblack"}
    tifffile.imwrite(path, stack[0], **how)
    image = read_image(path)
    assert (image.sizes, image.unit) == (pytest.approx(read_as[0]), read_as[1])
    assert bool(image.resolution) == bool(read_as[0])
    assert axes_of_tiff(path)[1:] == (image.sizes, image.unit)
    tifffile.imwrite(path, stack, **how)
    if read_as[0]:
        with pytest.raises(ProblemError, match="not the distance of its slices"):
            read_image(path).refuse_as_volume("a.tif")


def test_a_resolution_counts_for_landmarks_and_may_be_replaced(tmp_path):
    path, marks = tmp_path / "a.tif", tmp_path / "marks.csv"
    tifffile.imwrite(path, np.ones((8, 9), np.uint8), resolution=(300, 300), resolutionunit="INCH")
    for size, spacing in ((1 / 300, None), (0.5, ((0.5, 0.5), "um"))):
        marks.write_text(f"a,true,{5 * size},{2 * size},{6 * size},{2 * size}\n")
        study = read_case(Case(path, boundary=marks, spacing=spacing))
        (mark,) = study.motion.drawing.marks
        np.testing.assert_allclose((mark.source, mark.target), ((2, 5), (2, 6)))
        assert any("resolution of a.tif" in note for note in study.notes) == (spacing is None)
    marks.write_text("a,true,5,2,6,2\n")
    with pytest.raises(ProblemError, match=r"have the unit of a\.tif \(in\)"):
        read_case(Case(path, boundary=marks))
    field = FieldFile.of(solution_of(np.zeros((8, 9, 2), np.float32), None, (0.5, 0.5)))
    apply_field(field, path, tmp_path / "moved.tif", labels=False)


def test_a_picture_without_a_pixel_size_can_be_given_one(tmp_path, capsys):
    write_tiff(tmp_path / "a.tif", "ZYX")
    (tmp_path / "marks.csv").write_text("a,true,1,1,5,1.5,1,5\n")
    command = [
        "solve",
        "a.tif",
        "--boundary",
        "marks.csv",
        "--hold-edge",
        "--spacing",
        "2.5/0.5/0.5um",
    ]
    command = [
        str(tmp_path / each) if "." in each and "/" not in each else each for each in command
    ]
    assert main([*command, "-o", str(tmp_path / "out")]) == 0
    study, solution = read_study(tmp_path / "out" / "a.study")
    assert (study.grid.spacing, study.grid.unit) == ((2.5, 0.5, 0.5), "µm")
    np.testing.assert_allclose(solution.displacement[2, 2, 2], (0, 0, 0.5), atol=1e-3)
    assert read_image(tmp_path / "out" / "a deformed.tif").sizes == (2.5, 0.5, 0.5)
    sitk.WriteImage(sitk.Image([7, 6, 5], sitk.sitkInt16), str(tmp_path / "a.nrrd"))
    for path, spacing in ((tmp_path / "a.nrrd", (1, 1, 1)), (tmp_path / "a.tif", (1, 1))):
        with pytest.raises(HmrfError, match=r"--spacing"):
            read_case(Case(path, spacing=(spacing, "mm")))
    with pytest.raises(SystemExit):
        main([*command[:-1], "2.5/0.5/0.5", "-o", str(tmp_path / "out")])
    assert "a unit" in capsys.readouterr().err


@pytest.mark.parametrize("axes", ["CYX", "TYX"])
def test_one_channel_or_time_of_a_stack_can_be_chosen(tmp_path, axes):
    path = write_tiff(tmp_path / "a.tif", axes)
    assert read_case(Case(path, slice=1)).grid.shape == (8, 9)
    assert grid_of_image(path, slice=1).shape == (8, 9)
    viewer = ViewerModel()
    with layer_source(path=str(path)):
        layer = viewer.add_image(tifffile.imread(path))
    chosen = Request(image=layer, view=View.of(viewer.dims))
    assert study_from_layers(chosen).grid.shape == (8, 9)
    with pytest.raises(ProblemError, match=r"3 (channels|times)"):
        study_from_layers(replace(chosen, view=View.of(viewer.dims, volume=True)))


def test_pictures_with_pixels_of_different_units_are_not_compared(tmp_path):
    one, other = (tmp_path / name for name in ("one.tif", "other.tif"))
    write_tiff(one, "YX", (0.5, 0.5))
    write_tiff(other, "YX")
    studies = [read_case(Case(path)) for path in (one, other)]
    with pytest.raises(ProblemError) as error:
        relative_place(("one.tif", "other.tif"), *studies)
    assert error.value.field == "other.tif"


def test_a_segmentation_that_slicer_has_cropped_is_refused_with_a_remedy(tmp_path):
    image, labels = tmp_path / "a.nrrd", tmp_path / "b.seg.nrrd"
    for path, shape in ((image, (4, 6, 7)), (labels, (4, 5, 7))):
        sitk.WriteImage(sitk.GetImageFromArray(np.ones(shape, np.uint8)), str(path))
    with pytest.raises(ProblemError, match="same size: export it in 3D Slicer as a labelmap"):
        read_case(Case(image, labels=labels))


@pytest.mark.parametrize("unit", ["mm", "um", "m", ["mm", "UCUM", "millimeter"]])
def test_points_of_slicer_are_read_in_their_unit(tmp_path, unit):
    factor = {"um": 1e3, "m": 1e-3}.get(str(unit), 1.0)
    points = [{"position": [factor * 1.0, factor * 2.0, factor * 3.0]}]
    markups = {"coordinateSystem": "LPS", "coordinateUnits": unit, "controlPoints": points}
    path = tmp_path / "a.mrk.json"
    path.write_text(json.dumps({"markups": [markups]}))
    np.testing.assert_allclose(read_points(path).points, [[3, 2, 1]])
    for other in ("parsec per second", "mm(", "1/0"):
        markups["coordinateUnits"] = other
        path.write_text(json.dumps({"markups": [markups]}))
        with pytest.raises(FileFormatError, match="unit"):
            read_points(path)


#: Names and texts of landmark files that are refused, with their reasons.
LANDMARKS = [
    ("a.csv", 'Pt,true,"1,5",2,3,4\n', "decimal point"),
    ("a.csv", "Pt,true,Infinity,2,3,4\n", "Infinity"),
    ("a.csv", "name,active,mx,my,fx,fy\nPt,true,1,2,3,4\n", "no column titles"),
    ("a.fcsv", "1,4,2,0\n", "CoordinateSystem"),
    ("a.fcsv", "# CoordinateSystem = IJK\n1,4,2,0\n", "LPS or RAS"),
    ("a.mrk.json", '{"markups": [{"controlPoints": []}]}', "coordinateSystem"),
    ("a.mrk.json", '{"markups": [{}, {}]}', "2 lists"),
]


@pytest.mark.parametrize(("name", "text", "reason"), LANDMARKS)
def test_other_landmark_files_are_refused_with_their_reason(tmp_path, name, text, reason):
    path = tmp_path / name
    path.write_text(text)
    for read in (read_points, open_landmarks(str(path))):
        with pytest.raises(FileFormatError, match=reason):
            read(str(path))


def test_pairs_are_read_from_two_files_of_slicer(tmp_path):
    image = sitk.Image([8, 9, 6], sitk.sitkInt16)
    image.SetOrigin((3, 4, 5))
    sitk.WriteImage(image, str(tmp_path / "a.nrrd"))
    at, to = np.array([[7.0, 7, 7], [7, 9, 8]]), np.array([[7.0, 7, 8], [7, 9, 8]])
    one, other = tmp_path / "one.mrk.json", tmp_path / "other.fcsv"
    write_points(one, at, names=["A", "B"])
    write_points(other, to, names=["A", "B"])
    study = read_case(Case(tmp_path / "a.nrrd", boundary=one, targets=other))
    np.testing.assert_allclose([mark.source for mark in study.motion.drawing.marks], at - (5, 4, 3))
    np.testing.assert_allclose([mark.target for mark in study.motion.drawing.marks], to - (5, 4, 3))
    for points, names in ((to[::-1], ["B", "A"]), (to[:1], ["A"])):
        write_points(other, points, names=names)
        with pytest.raises(ProblemError) as error:
            read_case(Case(tmp_path / "a.nrrd", boundary=one, targets=other))
        assert error.value.field == "other.fcsv"
    with pytest.raises(ProblemError, match="--targets"):
        read_case(Case(tmp_path / "a.nrrd", boundary=one))


@pytest.mark.parametrize("text", ["Pt;true;1,5;2;3;4\n", "Pt\ttrue\t1.5\t2\t3\t4\n"])
def test_landmarks_with_other_separators_are_read(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text)
    assert is_landmark_file(path)
    np.testing.assert_array_equal(read_points(path).points, [[2.0, 1.5]])


def test_landmarks_with_a_separator_of_thousands_are_refused_by_their_reader(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Pt;true;1.234,5;2;3;4\n")
    with pytest.raises(FileFormatError, match="thousands"):
        open_landmarks(str(path))(str(path))


@pytest.mark.parametrize("order", STORED.values(), ids=STORED)
def test_landmarks_along_the_axes_of_a_file_are_alike_in_all_doors(tmp_path, monkeypatch, order):
    """BigWarp stores landmarks from the first voxel along the axes of the file, in any order."""
    scan = write_scan(tmp_path / "scan.nii.gz", order)
    at, to = np.array([3.0, 2.0, 4.0]), np.array([3.0, 3.0, 4.0])  # x, y, z from the first voxel
    stored = [",".join(map(str, place[list(order)])) for place in (at, to)]
    marks = tmp_path / "marks.csv"
    marks.write_text(f"Pt-0,true,{stored[0]},{stored[1]}\n")
    study = read_case(Case(scan, boundary=marks))
    (mark,) = study.motion.drawing.marks
    viewer = ViewerModel()
    image = viewer.add_layer(Layer.create(*open_scan(str(scan))(str(scan))[0]))
    monkeypatch.setattr(napari, "current_viewer", lambda: viewer)
    layers = [Layer.create(*made) for made in open_landmarks(str(marks))(str(marks))]
    places = (mark.source, (2, 2, 3)), (mark.target, (2, 3, 3))
    for layer, (place, expected) in zip(layers, places, strict=True):
        seen = image.world_to_data(layer.data_to_world(layer.data[0]))
        np.testing.assert_allclose((place, seen), (expected, expected), atol=1e-4)
    assert bool(frame_of(image).file_axes) == (order != (0, 1, 2))
    moved = np.zeros((*SHAPE, 3), np.float32)
    moved[..., 1] = 1.0
    solution = solution_of(moved, frame=study.grid.place.as_dict(), spacing=study.grid.spacing)
    apply_field(FieldFile.of(solution), marks, tmp_path / "moved.csv", labels=False)
    expected = to[list(order)][::-1]
    np.testing.assert_allclose(read_points(tmp_path / "moved.csv").points, [expected], atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint32, np.int64, np.float64])
def test_labels_beyond_32_bits_are_moved_but_not_solved(tmp_path, dtype):
    labels = np.array([[0, 3e9, 2], [0, 3e9, 2]]).astype(dtype)
    tifffile.imwrite(tmp_path / "atlas.tif", labels)
    field = FieldFile.of(solution_of(np.zeros((2, 3, 2), np.float32)))
    apply_field(field, tmp_path / "atlas.tif", tmp_path / "moved.tif", labels=True)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "moved.tif"), labels)
    with pytest.raises(ProblemError, match="3000000000, beyond 32 bits"):
        as_labels(labels, Path("atlas.tif"))


def test_many_labels_moved_as_an_image_cause_a_note(tmp_path):
    labels = np.repeat(np.arange(0, 3000, 30, dtype=np.int16), 8)[:800].reshape(20, 40)
    tifffile.imwrite(tmp_path / "atlas.tif", labels)
    field = FieldFile.of(solution_of(np.zeros((20, 40, 2), np.float32)))
    applied = apply_field(field, tmp_path / "atlas.tif", tmp_path / "moved.tif", labels=False)
    assert "100 whole numbers" in applied.note
    scan = np.random.default_rng(0).integers(0, 900, (20, 40, 1)).astype(np.int16)
    assert not _note_on_labels(scan, "scan.nii")


@pytest.mark.parametrize("across", [0, 1, 2])
def test_a_volume_of_one_slice_is_solved_as_this_slice(tmp_path, across):
    """Scanners and programs store a slice as 1 x N x M, N x 1 x M or N x M x 1."""
    pixels = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)
    image = sitk.GetImageFromArray(pixels.take([1], axis=across))
    image.SetSpacing((1, 1, 2))
    image.SetOrigin((3, 4, 5))
    sitk.WriteImage(image, str(tmp_path / "slice.nii.gz"))
    at, to = np.array([2.0, 2.0, 2.0]), np.array([3.0, 3.0, 4.0])  # x, y, z from the first voxel
    at[2 - across] = to[2 - across] = 0
    (tmp_path / "marks.csv").write_text(f"a,true,{','.join(map(str, [*at, *to]))}\n")
    study = read_case(Case(tmp_path / "slice.nii.gz", boundary=tmp_path / "marks.csv"))
    assert grid_of_image(tmp_path / "slice.nii.gz") == grid_of_image(image)
    assert grid_of_image(image).shape == study.grid.shape
    np.testing.assert_array_equal(study.pictures.image, pixels.take(1, axis=across))
    (mark,) = study.motion.drawing.marks
    sizes = np.array((2, 1, 1))
    for stored, solved in ((at, mark.source), (to, mark.target)):
        np.testing.assert_allclose(np.delete(stored[::-1] / sizes, across), solved, atol=1e-4)
        world = np.array(study.grid.place.matrix) @ [0, *solved, 1]
        np.testing.assert_allclose(world[:3], np.add(stored[::-1], (5, 4, 3)), atol=1e-4)


def test_a_file_beyond_the_memory_is_refused_from_its_header(tmp_path, monkeypatch):
    sitk.WriteImage(sitk.GetImageFromArray(np.ones(SHAPE, np.uint8)), str(tmp_path / "a.nii.gz"))
    shapes = []

    def refuse(shape, *_):
        shapes.append(shape)
        raise ProblemError("a.nii.gz", "is too large.")

    monkeypatch.setattr(case, "require_memory", refuse)
    monkeypatch.setattr(case, "read_image", None)
    with pytest.raises(ProblemError):
        read_case(Case(tmp_path / "a.nii.gz"))
    assert shapes == [SHAPE]


def test_a_dicom_file_is_read_by_one_process(tmp_path, monkeypatch):
    called = []

    def call(size, function, *arguments):
        called.append(function)
        return function(*arguments)

    monkeypatch.setattr(itk_files, "call_in_child", call)
    read_case(Case(write_frames(tmp_path / "a.dcm", (0, 3, 6, 9))))
    assert called == [itk_reader.read_pixels]
