"""Tests of `atomic_write`: a file is written completely or not at all."""

import errno
import os
import stat
import threading

import pytest

from napari_hmrf import atomic_write
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import in_words

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions and FIFOs")


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EACCES, "a.png: permission is denied. Change its permissions, or use"),
        (errno.ENOENT, "a.png: there is no such file or folder. Check its name."),
        (errno.EISDIR, "a.png: it is a folder. Choose a file in it."),
        (errno.ENOTDIR, "a.png: a part of its path is a file, not a folder. Check its name."),
        (errno.EIO, "a.png: Input/output error."),
    ],
)
def test_a_file_system_error_is_reported_in_a_plain_sentence(number, said):
    assert in_words(OSError(number, os.strerror(number), "a.png")).startswith(said)


@pytest.fixture
def path(tmp_path):
    """Return the path of an existing file."""
    made = tmp_path / "kept.png"
    made.write_bytes(b"what was there")
    return made


def test_a_full_disk_leaves_the_old_file_unchanged(path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic_write.os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot save the file: No space left.*kept\.png"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"what was there"
    assert os.listdir(path.parent) == [path.name]
    monkeypatch.undo()
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"


@posix
def test_a_file_at_the_size_limit_of_the_system_is_not_truncated(path):
    import resource  # available only on POSIX systems

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
    try:
        with pytest.raises(OSError, match=r"cannot save the file: .*kept\.png") as refused:
            write_whole(path, b"new" * 10_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused.value.errno == errno.EFBIG
    assert path.read_bytes() == b"what was there"
    assert os.listdir(path.parent) == [path.name]


@posix
@pytest.mark.parametrize("mode", [0o600, 0o755])
def test_a_replaced_file_retains_its_permissions(path, mode):
    path.chmod(mode)
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == mode


@posix
def test_a_new_file_has_default_permissions(tmp_path):
    usual, ours = tmp_path / "usual", tmp_path / "ours"
    before = os.umask(0o027)
    try:
        usual.touch()
        write_whole(ours, b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE(ours.stat().st_mode) == stat.S_IMODE(usual.stat().st_mode) == 0o640


@posix
def test_a_private_file_is_unreadable_for_others_while_it_is_replaced(path, monkeypatch):
    path.chmod(0o600)
    seen = []

    def look(_):
        seen.extend(stat.S_IMODE(each.stat().st_mode) for each in path.parent.iterdir())

    monkeypatch.setattr(atomic_write.os, "fsync", look)
    write_whole(path, b"secret")
    assert set(seen) == {0o600}


def test_a_file_without_write_permission_is_not_replaced(path, monkeypatch):
    # Root may write to all files, so simulate the answer of the system.
    monkeypatch.setattr(atomic_write.os, "access", lambda *_: False)
    with pytest.raises(PermissionError, match=r"cannot save the file: .*kept\.png"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"what was there"


@posix
def test_a_link_is_followed_to_the_replaced_file(path):
    link = path.with_name("link.png")
    link.symlink_to(path)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert path.read_bytes() == b"new"


@posix
def test_a_fifo_is_written_and_remains_a_fifo(tmp_path):
    fifo = tmp_path / "fifo.png"
    os.mkfifo(fifo)
    read = []
    reader = threading.Thread(target=lambda: read.append(fifo.read_bytes()), daemon=True)
    reader.start()
    write_whole(fifo, b"new")
    reader.join(60)
    assert fifo.is_fifo()
    assert read == [b"new"]


@posix
def test_a_device_is_written():
    write_whole("/dev/null", b"anything")
    assert atomic_write.is_stream("/dev/null")
    with pytest.raises(OSError, match=r"cannot save the file: No space left.*full"):
        write_whole("/dev/full", b"anything")
