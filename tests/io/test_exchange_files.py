"""Tests of damaged exchange files and of the process that reads some of them."""

import os
import struct
import sys

import numpy as np
import pytest

from napari_hmrf import FileFormatError
from napari_hmrf.cli import main
from napari_hmrf.contributions import open_scan
from napari_hmrf.errors import HmrfError
from napari_hmrf.fields import read_field
from napari_hmrf.io import child_process
from napari_hmrf.io.child_process import ChildDied, call_in_child
from napari_hmrf.io.fields import is_field_file
from napari_hmrf.io.images import ImageFile, read_image, write_image
from validation.studies.damaged import make_foreign, read_all

sitk = pytest.importorskip("SimpleITK")

pytestmark = pytest.mark.usefixtures("child_process")


def heap_objects(content):
    """Yield the offset of each object in the global heap of an HDF5 file."""
    start = content.index(b"GCOL")
    at, end = start + 16, start + struct.unpack_from("<Q", content, start + 8)[0]
    while at < end and struct.unpack_from("<H", content, at)[0]:
        yield at
        at += 16 + -(-struct.unpack_from("<Q", content, at + 8)[0] // 8) * 8


def make_endless_transform(path):
    """Write a transform whose text objects have length 0, so that HDF5 reads without end."""
    make_foreign(path)
    content = bytearray(path.read_bytes())
    at = next(heap_objects(content))
    content[at : at + 16] = bytes(16)
    path.write_bytes(content)


def make_crashing_transform(path):
    """Write a transform whose name claims to be longer than any file."""
    make_foreign(path)
    content = bytearray(path.read_bytes())
    at = list(heap_objects(content))[-1]
    content[at + 8 : at + 16] = b"\xff" * 8
    path.write_bytes(content)


def test_a_file_that_is_read_without_end_is_refused_and_the_next_file_is_read(
    tmp_path, monkeypatch
):
    path = tmp_path / "hanging.h5"
    make_foreign(tmp_path / "good.h5")
    make_endless_transform(path)
    good = read_all(tmp_path / "good.h5")
    monkeypatch.setattr(child_process, "_LEAST_SECONDS", 1.0)
    assert is_field_file(path), "the file is not recognised, so no reader reports the damage"
    with pytest.raises(FileFormatError, match=r"hanging\.h5: .* does not finish"):
        read_field(path)
    monkeypatch.undo()
    assert read_all(tmp_path / "good.h5") == good


def test_the_shell_and_the_window_name_a_file_that_crashes_its_reader(tmp_path, capsys):
    path = tmp_path / "crashing.h5"
    make_crashing_transform(path)
    write_image(tmp_path / "image.png", ImageFile(np.ones((20, 24), np.uint8)))
    image, out = str(tmp_path / "image.png"), str(tmp_path / "out")
    for words in (
        ["apply", str(path), image, "-o", out],
        ["solve", image, "--boundary", str(path), "-o", out],
    ):
        assert main(words) == 1
        assert "crashing.h5: not a displacement field" in capsys.readouterr().err
    with pytest.raises(FileFormatError, match=r"crashing\.h5"):
        open_scan(str(path))(str(path))


def test_an_nrrd_file_whose_header_is_no_text_is_refused(tmp_path):
    """ITK crashes if the blank line after the header is damaged."""
    path = tmp_path / "a.nrrd"
    make_foreign(path)
    path.write_bytes(path.read_bytes().replace(b"\n\n", b"\n\x08\n", 1))
    with pytest.raises(FileFormatError, match="header is damaged"):
        read_field(path)


def test_a_metaimage_file_of_many_axes_is_refused(tmp_path):
    """ITK would read without end."""
    path = tmp_path / "a.mha"
    make_foreign(path)
    path.write_bytes(path.read_bytes().replace(b"NDims = 2", b"NDims = 999999999"))
    with pytest.raises(FileFormatError, match="header is damaged"):
        read_field(path)


def test_a_device_or_a_pipe_is_refused_as_a_field_or_an_image(tmp_path):
    if os.name != "posix":
        pytest.skip("needs named pipes (POSIX)")
    os.mkfifo(tmp_path / "a.mha")
    os.symlink("/dev/zero", tmp_path / "b.h5")
    for name in ("a.mha", "b.h5"):
        for read in (read_field, read_image):
            with pytest.raises(FileFormatError, match=f"{name}: it is a pipe or a device"):
                read(tmp_path / name)
        assert not is_field_file(tmp_path / name)


def test_a_child_process_returns_results_and_errors():
    assert call_in_child(0, divmod, 7, 2) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call_in_child(0, divmod, 7, 0)
    with pytest.raises(ChildDied):
        call_in_child(0, os.abort)


def test_the_start_of_a_child_process_has_its_own_limit_of_time(monkeypatch):
    assert call_in_child(0, eval, "'SimpleITK' in __import__('sys').modules")
    monkeypatch.setattr(child_process, "_SECONDS_TO_START", 1e-6)
    with pytest.raises(HmrfError, match="did not start in 1e-06 s"):
        call_in_child(0, divmod, 7, 2)


@pytest.mark.skipif(sys.platform != "linux", reason="needs the limit of memory of Linux")
def test_a_child_process_has_a_limit_of_memory():
    with pytest.raises(MemoryError):
        call_in_child(0, bytes, 3 * 2**30)


def test_an_application_without_a_python_interpreter_reports_the_missing_interpreter(monkeypatch):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    with pytest.raises(HmrfError, match="no Python interpreter was found"):
        call_in_child(0, divmod, 7, 2)
