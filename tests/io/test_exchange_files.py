"""Tests of damaged exchange files and of the process that decodes them."""

import os
import struct
import sys

import numpy as np
import psutil
import pytest

from napari_hmrf import FileFormatError
from napari_hmrf.atomic_write import CANNOT_SAVE
from napari_hmrf.cli import main
from napari_hmrf.contributions import open_scan
from napari_hmrf.fields import read_field, write_field
from napari_hmrf.io import decoder_process, itk_decoder, itk_files
from napari_hmrf.io.decoder_process import DecoderProcess, Undecodable, decoder
from napari_hmrf.io.fields import is_field_file
from napari_hmrf.io.images import ImageFile, read_image, write_image
from validation.studies.damaged import make_field, make_foreign, read_all

sitk = pytest.importorskip("SimpleITK")


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


@pytest.fixture(scope="module")
def hanging(tmp_path_factory):
    """Return a file that is read without end; only the first reader tries it."""
    path = tmp_path_factory.mktemp("hanging") / "hanging.h5"
    make_endless_transform(path)
    return path


def test_a_file_that_is_read_without_end_is_refused_and_the_next_file_is_read(hanging, tmp_path):
    make_foreign(tmp_path / "good.h5")
    good, me = read_all(tmp_path / "good.h5"), psutil.Process()
    before = me.memory_info().rss
    with pytest.raises(FileFormatError, match=r"hanging\.h5: .* did not finish"):
        read_field(hanging)
    assert read_all(tmp_path / "good.h5") == good
    assert me.memory_info().rss - before < 20e6


def test_a_file_that_is_read_without_end_is_tried_only_once(hanging, monkeypatch):
    with pytest.raises(FileFormatError):
        read_field(hanging)
    monkeypatch.setattr(decoder, "_send_request", None)
    for _ in range(2):
        assert is_field_file(hanging), "the file is not recognised, so no reader reports the damage"
        with pytest.raises(FileFormatError, match="did not finish"):
            read_field(hanging)


def test_a_file_that_crashes_its_decoder_is_refused(tmp_path):
    make_crashing_transform(tmp_path / "a.h5")
    with pytest.raises(FileFormatError, match=r"a\.h5: not a displacement field that can be read"):
        read_field(tmp_path / "a.h5")


def test_the_shell_and_the_window_name_a_damaged_file(hanging, tmp_path, capsys):
    write_image(tmp_path / "image.png", ImageFile(np.ones((20, 24), np.uint8)))
    image, out = str(tmp_path / "image.png"), str(tmp_path / "out")
    for words in (
        ["apply", str(hanging), image, "-o", out],
        ["solve", image, "--boundary", str(hanging), "-o", out],
    ):
        assert main(words) == 1
        assert "hanging.h5: not a displacement field" in capsys.readouterr().err
    with pytest.raises(FileFormatError, match=r"hanging\.h5"):
        open_scan(str(hanging))(str(hanging))


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


#: First lines of a decoder that reports that it is ready.
READY = """
import json, os, sys, time
sys.stdin.buffer.readline()
print('{"ready": true}', flush=True)
"""
CLAIM = """
sys.stdin.buffer.readline()
print('{"dtype": "<f8", "shape": [99999, 99999]}', flush=True)
time.sleep(99)
"""
ANSWER = 'sys.stdin.buffer.readline(); print("{\\"refused\\": \\"fine\\"}", flush=True)\n'


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("sys.stdin.buffer.readline(); os.abort()", "crashes"),
        ("sys.stdin.buffer.readline(); kept = b'a' * 2**28; time.sleep(99)", "too much memory"),
        ("time.sleep(99)", "does not respond"),
        (CLAIM, "contains fewer pixels"),
        (ANSWER, "fine"),
    ],
)
def test_a_decoder_that_fails_gives_a_reason(program, reason, tmp_path, monkeypatch):
    script, file = tmp_path / "decoder.py", tmp_path / "file"
    script.write_text(READY + program)
    file.write_bytes(b"some")
    monkeypatch.setattr(itk_decoder, "__file__", str(script))
    monkeypatch.setattr(decoder_process, "_LEAST_MEMORY", 2**27)
    if "respond" in reason:
        monkeypatch.setattr(decoder_process, "_LEAST_WAIT", 0.1)
    if "memory" in reason:
        monkeypatch.setattr(decoder_process, "_LEAST_SECONDS", 60.0)
    process = DecoderProcess()
    with pytest.raises(Undecodable, match=reason):
        process.decode(file, "pixels")
    process.kill()


def test_a_request_to_an_exiting_idle_decoder_is_sent_again(tmp_path, monkeypatch):
    script, file, other = tmp_path / "decoder.py", tmp_path / "file", tmp_path / "other"
    script.write_text(READY + ANSWER + "sys.stdin.buffer.readline()")
    file.write_bytes(b"some")
    other.write_bytes(b"some")
    monkeypatch.setattr(itk_decoder, "__file__", str(script))
    process = DecoderProcess()
    for each in (file, other):
        with pytest.raises(Undecodable, match="fine"):
            process.decode(each, "pixels")
    process.kill()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_forked_process_starts_its_own_decoder(tmp_path, monkeypatch):
    script, file, other = tmp_path / "decoder.py", tmp_path / "file", tmp_path / "other"
    script.write_text(READY + ANSWER + ANSWER)
    for each in (file, other):
        each.write_bytes(b"some")
    monkeypatch.setattr(itk_decoder, "__file__", str(script))
    process = DecoderProcess()
    with pytest.raises(Undecodable, match="fine"):
        process.decode(file, "pixels")
    of_parent = psutil.Process(process._process.pid)
    process.forget_after_fork()
    with pytest.raises(Undecodable, match="fine"):
        process.decode(other, "pixels")
    assert process._process.pid != of_parent.pid
    process.kill()
    of_parent.wait(60)


def test_a_field_that_was_stored_incompletely_replaces_no_file(tmp_path, monkeypatch):
    path = tmp_path / "a.nii.gz"
    make_field(path)
    before, write = path.read_bytes(), decoder.write

    def cut(file, *given, **more):
        write(file, *given, **more)
        content = file.read_bytes()
        file.write_bytes(content[:-100] + bytes(100))

    monkeypatch.setattr(decoder, "write", cut)
    with pytest.raises(OSError, match=f"{CANNOT_SAVE}.*a.nii.gz"):
        write_field(path, np.ones((4, 5, 2)), spacing=(1, 1), forward=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_application_without_a_python_interpreter_reports_the_missing_interpreter(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "exec_prefix", str(tmp_path))
    (tmp_path / "file").write_bytes(b"some")
    with pytest.raises(itk_files.HmrfError, match="no Python interpreter was found"):
        DecoderProcess().decode(tmp_path / "file", "pixels")
