"""Solution files: exact round trip, and rejection of any other file with one sentence."""

import dataclasses
import errno
import io
import json
import os
import re
import tracemalloc
import zipfile

import numpy as np
import pytest

from napari_hmrf import (
    FileFormatError,
    Provenance,
    SeilerPrior,
    Solution,
    archive,
    atomic_write,
    solve,
)
from napari_hmrf.data import phantom
from napari_hmrf.fields import is_solution_file
from napari_hmrf.solver.optimizers.base import LevelRun
from validation.studies.damaged import MOST_BYTES, damaged, look

MEMBERS = {"displacement.npy", "energy.npy", "header.npy", "tissue.npy"}


def random_solution(shape=(7, 11), frame=None):
    """Return a random solution with all kinds of numbers."""
    rng = np.random.default_rng(5)
    return Solution(
        displacement=rng.normal(size=(*shape, 2)).astype(np.float32),
        energy=rng.random(30),
        levels=(LevelRun(1, (4, 6), 20), LevelRun(0, shape, 10)),
        tissue=rng.random(shape) > 0.2,
        spacing=(0.1, 1 / 3),
        provenance=Provenance(
            backend="cpu",
            renderer="compiled loops on ½ a machine",
            reason="asked for",
            seconds=0.1 + 0.2,
            preparation_seconds=1e-9,
            parameters={"prior": {"penalty": 1e4, "damping": None}, "steps": [1.0, 0.1]},
            versions={"napari-hmrf": "0.1.0"},
            inputs={"observed": "00ff"},
        ),
        frame=frame,
    )


@pytest.fixture
def solution():
    return random_solution(frame={"units": ["mm", "mm"], "slice": 3, "scale": [0.1, 1 / 3]})


@pytest.fixture
def path(solution, tmp_path):
    return solution.write(tmp_path / "result.npz")


def as_json(provenance):
    return json.loads(json.dumps(dataclasses.asdict(provenance)))


def assert_same(a, b):
    for name in ("displacement", "energy", "tissue"):
        first, second = getattr(a, name), getattr(b, name)
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)
    assert a.levels == b.levels
    assert a.spacing == b.spacing
    assert a.frame == b.frame
    assert as_json(a.provenance) == as_json(b.provenance)


def repacked(path, target, compression=zipfile.ZIP_DEFLATED, **members):
    """Return a copy of a file with members replaced, added or, if None, removed."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    content.update({f"{name}.npy": data for name, data in members.items()})
    with zipfile.ZipFile(target, "w", compression) as archive:
        for name, data in content.items():
            if data is not None:
                archive.writestr(name, data)
    return target


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def header_of(path):
    with np.load(path) as file:
        return json.loads(file["header"].item())


def with_header(path, target, **changes):
    return repacked(path, target, header=npy(np.array(json.dumps({**header_of(path), **changes}))))


def error_message(path):
    """Return the one-sentence error for an invalid file."""
    with pytest.raises(FileFormatError) as caught:
        Solution.read(path)
    message = str(caught.value)
    start = f"{path.name}: not a valid napari-hmrf result: "
    assert message.startswith(start)
    assert "pickle" not in message
    assert "\n" not in message
    assert len(message) < 400
    return message.removeprefix(start)


def test_a_saved_solution_is_read_back_exactly(solution, path):
    assert_same(Solution.read(path), solution)
    assert_same(Solution.read(str(path)), solution)


def test_a_solved_phantom_is_read_back_exactly(tmp_path):
    solution = solve(phantom("mass-effect", 32).problem, SeilerPrior(), backend="cpu")
    back = Solution.read(solution.write(tmp_path / "solution.npz"))
    assert_same(back, solution)
    assert back.iterations == solution.iterations
    assert back.mean_energy == solution.mean_energy


def test_a_highly_compressible_field_of_zeros_is_accepted(tmp_path):
    still = dataclasses.replace(
        random_solution((600, 600)), displacement=np.zeros((600, 600, 2), "f4")
    )
    assert not Solution.read(still.write(tmp_path / "still.npz")).displacement.any()


def test_a_solution_file_can_be_read_with_numpy_alone(solution, path):
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["displacement"], solution.displacement)
        header = json.loads(file["header"].item())
    assert header["format"] == "napari-hmrf result"
    assert header["version"] == 1
    assert header["spacing"] == list(solution.spacing)


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("result.npz", "result.npz"),
        ("result", "result.npz"),
        ("result.dat", "result.dat"),
        ("my result ünïcödé 脳.npz", "my result ünïcödé 脳.npz"),
        ("v1.2 of it.npz", "v1.2 of it.npz"),
        ("x" * 240 + ".npz", "x" * 240 + ".npz"),
    ],
)
def test_a_file_gets_the_requested_name(solution, tmp_path, given, written):
    assert solution.write(tmp_path / given) == tmp_path / written
    assert os.listdir(tmp_path) == [written]
    assert_same(Solution.read(tmp_path / written), solution)


def test_saving_again_replaces_the_file(solution, path):
    other = random_solution((5, 5))
    other.write(path)
    assert_same(Solution.read(path), other)
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.skipif(os.name != "posix", reason="creating links on Windows requires privileges")
def test_a_symbolic_link_is_followed_and_not_replaced(solution, path):
    link = path.with_name("link.npz")
    link.symlink_to(path)
    other = random_solution((5, 5))
    other.write(link)
    assert link.is_symlink()
    assert_same(Solution.read(path), other)


def disk_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_keeps_the_old_file_and_no_temporary_file(solution, path, monkeypatch, step):
    monkeypatch.setattr(atomic_write.os, step, disk_full)
    with pytest.raises(OSError, match=r"cannot save the file: No space left.*result\.npz"):
        random_solution((5, 5)).write(path)
    monkeypatch.undo()
    assert_same(Solution.read(path), solution)
    assert os.listdir(path.parent) == [path.name]


def test_a_missing_or_unwritable_folder_is_named(solution, tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"cannot save the file.*nowhere"):
        solution.write(tmp_path / "nowhere" / "result.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(IsADirectoryError, match=r"cannot save .*folder"):
        solution.write(tmp_path / "folder.npz")

    def closed(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("builtins.open", closed)
    with pytest.raises(PermissionError, match=r"cannot save the file: Permission denied"):
        solution.write(tmp_path / "result.npz")


def test_a_solution_that_could_not_be_read_is_not_written(path, solution):
    good = random_solution()
    field = good.displacement.copy()
    field[0, 0] = np.nan
    bad = dataclasses.replace(good, displacement=field)
    with pytest.raises(ValueError, match=r"cannot be saved: displacement: .* NaN or infinite"):
        bad.write(path)
    with pytest.raises(TypeError, match="JSON"):
        random_solution(frame={"layer": object()}).write(path)
    assert_same(Solution.read(path), solution)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9999])
def test_a_truncated_file_is_rejected(path, part):
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    assert error_message(path) == "it is damaged or incomplete"
    assert not is_solution_file(path)


def test_a_flipped_bit_anywhere_is_detected_or_harmless(solution, path):
    content = path.read_bytes()
    found = 0
    for at in np.linspace(0, len(content) - 1, 50).astype(int):
        damaged = bytearray(content)
        damaged[at] ^= 0x10
        path.write_bytes(damaged)
        try:
            back = Solution.read(path)
        except FileFormatError:
            found += 1
        else:  # a bit without effect, such as in a date
            assert_same(back, solution)
    assert found > 30


def test_an_archive_with_a_corrupt_directory_is_rejected(path):
    content = bytearray(path.read_bytes())
    at = content.rindex(b"PK\x05\x06") + 12  # size of the directory, in its last record
    content[at : at + 4] = (2**31).to_bytes(4, "little")
    path.write_bytes(content)
    assert error_message(path) == "it is damaged or incomplete"
    content[at : at + 4] = (len(content) - 23).to_bytes(4, "little")
    path.write_bytes(content)
    assert error_message(path) == "it is damaged or incomplete"


def test_a_read_error_is_not_reported_as_an_invalid_file(path, monkeypatch):
    monkeypatch.setattr(archive.zipfile, "ZipFile", disk_full)
    with pytest.raises(OSError, match="No space"):
        Solution.read(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"row,col\n1,2\n", b"\x93NUMPY", b"\0" * 999])
def test_other_content_is_rejected(tmp_path, content):
    path = tmp_path / "odd.npz"
    path.write_bytes(content)
    is_damaged = content in (b"", b"PK")
    why = "it is damaged or incomplete" if is_damaged else "it is another kind of file"
    assert error_message(path) == why
    assert not is_solution_file(path)


def test_a_lone_array_or_foreign_archive_is_another_kind_of_file(tmp_path):
    np.savez(tmp_path / "foreign.npz", a=np.ones(3), b=np.ones((2, 2)))
    assert error_message(tmp_path / "foreign.npz") == "it is another kind of file"
    np.savez(tmp_path / "header.npz", header=np.array('{"format": "other", "version": 1}'))
    assert error_message(tmp_path / "header.npz") == "it is another kind of file"
    np.savez(tmp_path / "list.npz", header=np.array("[1, 2]"))
    assert error_message(tmp_path / "list.npz") == "it is another kind of file"
    np.save(tmp_path / "lone.npy", np.ones(3))
    assert error_message(tmp_path / "lone.npy") == "it is another kind of file"
    for name in os.listdir(tmp_path):
        assert not is_solution_file(tmp_path / name)


def test_a_missing_file_is_not_reported_as_invalid(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        Solution.read(tmp_path / "none.npz")
    assert not is_solution_file(tmp_path / "none.npz")
    assert error_message(tmp_path) == "it is a folder"
    assert not is_solution_file(tmp_path)


class Trap:
    """Object that runs code when it is unpickled."""

    def __reduce__(self):
        return (exec, ("raise SystemExit('code from a file was run')",))


@pytest.mark.parametrize("member", ["displacement", "energy", "tissue", "header"])
def test_code_in_a_file_is_never_run(path, tmp_path, member):
    trap = np.empty({"displacement": (7, 11, 2), "energy": 30, "tissue": (7, 11)}.get(member, ()),
                    dtype=object)  # fmt: skip
    trap.fill(Trap())
    bad = repacked(path, tmp_path / "trap.npz", **{member: npy(trap, allow_pickle=True)})
    assert member in error_message(bad)


def test_a_field_that_compresses_well_can_be_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "_HARMLESS", 2**16)
    moved = dataclasses.replace(
        random_solution((300, 300)),
        displacement=np.zeros((300, 300, 2), np.float32),
        tissue=np.ones((300, 300), bool),
    )
    path = moved.write(tmp_path / "a.npz")
    np.testing.assert_array_equal(Solution.read(path).displacement, moved.displacement)


def test_a_zip_bomb_costs_no_memory(path, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "_HARMLESS", 2**20)
    rows = 1_000
    start = npy(np.zeros((1, 1), "f4"))[:128].replace(
        b"(1, 1), ", b"(%d, %d, 2), " % (rows, rows)
    )  # fmt: skip
    bomb = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path) as whole:
        rest = {name: whole.read(name) for name in MEMBERS - {"displacement.npy"}}
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as made:
        for name, data in rest.items():
            made.writestr(name, data)
        with made.open("displacement.npy", "w", force_zip64=True) as member:
            member.write(start)
            for _ in range(rows // 100):
                member.write(bytes(100 * rows * 8))
    tracemalloc.start()
    assert "more than such a file may contain" in error_message(bomb)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


@pytest.mark.parametrize("member", ["displacement", "header"])
def test_a_header_with_a_false_size_costs_no_memory(path, tmp_path, member):
    if member == "header":
        lie = npy(np.array("x" * 10)).replace(b"<U10'", b"<U999999999'")
    else:
        lie = npy(np.zeros((7, 11, 2), "f4")).replace(b"(7, 11, 2)", b"(700000, 700000, 2)")
    bad = repacked(path, tmp_path / "liar.npz", **{member: lie})
    tracemalloc.start()
    error_message(bad)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"energy": None}, "lacks the array 'energy'"),
        ({"header": None}, "another kind of file"),
        (
            {"extra": npy(np.ones(3))},
            "contains 'extra', which does not belong to a napari-hmrf result",
        ),
        ({"../../evil": npy(np.ones(3))}, "does not belong to a napari-hmrf result"),
        ({"displacement": npy(np.zeros((7, 11, 2), ">f4"))}, "displacement of type >f4"),
        (
            {"displacement": npy(np.zeros((7, 11, 2), "c8"))},
            "array of complex64, not of",
        ),
        ({"displacement": npy(np.zeros((7, 11), "f4"))}, r"of shape \(7, 11\)"),
        ({"displacement": npy(np.zeros((11, 7, 2), "f4"))}, "Use the same grid"),
        ({"displacement": npy(np.full((7, 11, 2), np.inf, "f4"))}, "NaN or infinite"),
        ({"energy": npy(np.zeros(29))}, "but 30 iterations"),
        ({"tissue": npy(np.zeros((7, 11), np.uint8))}, "tissue of type uint8"),
        ({"header": npy(np.array("{"))}, "damaged"),
        ({"header": npy(np.array(3))}, "it is another kind of file"),
        ({"header": b"\x93NUMPY\x03\x00"}, "format"),
        ({"header": npy(np.array("[" * 100_000))}, "damaged"),
    ],
)
def test_a_file_with_wrong_members_is_rejected(path, tmp_path, changes, complaint):
    bad = repacked(path, tmp_path / "bad.npz", **changes)
    assert re.search(complaint, error_message(bad))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"version": 2}, "has version 2, but .* reads version 1. Use the version .* that wrote"),
        ({"spacing": [1.0]}, r"the spacing \(1.0,\). Use the same grid"),
        ({"spacing": [1.0, -1.0]}, "spacing.1: Input should be greater than 0"),
        ({"spacing": None}, "spacing: Input should be a valid tuple"),
        ({"levels": [{"number": 0}]}, "levels.0.shape: Field required"),
        ({"provenance": 3}, "provenance: "),
        ({"provenance": {"renderer": "no backend"}}, "provenance.backend: Field required"),
        ({"frame": [1, 2]}, "frame: "),
        ({"convergence": {"error": 1}}, "convergence.residual: Field required"),
        ({"mood": "sunny"}, "mood: Unexpected keyword argument"),
    ],
)
def test_an_invalid_header_is_rejected(path, tmp_path, changes, complaint):
    bad = with_header(path, tmp_path / "bad.npz", **changes)
    assert re.search(complaint, error_message(bad))
    assert is_solution_file(bad)  # recognised as a solution, so that reading reports the error


def test_a_duplicate_member_is_rejected(path, tmp_path):
    bad = tmp_path / "twice.npz"
    bad.write_bytes(path.read_bytes())
    with zipfile.ZipFile(bad, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("tissue.npy", npy(np.ones((7, 11), dtype=bool)))
    assert error_message(bad) == "two of its members have the same name"


def test_a_damaged_file_is_read_exactly_or_rejected_with_little_memory(tmp_path):
    path = tmp_path / "damaged.npz"
    original = random_solution(frame={"units": ["mm", "mm"], "slice": 3})
    content = original.write(path).read_bytes()
    original = Solution.read(path)
    outcomes = set()
    tracemalloc.start()
    for version in damaged(content, 50):
        path.write_bytes(version.content)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        outcomes.add((version.kind, look(path, version, original)))
        assert tracemalloc.get_traced_memory()[1] - before < MOST_BYTES, version.kind
    tracemalloc.stop()
    for kind in {kind for kind, _ in outcomes}:
        assert (kind, "refused") in outcomes


@pytest.mark.parametrize("bracket", [b"(", b"[", b"{", b"(((("])
def test_an_array_header_with_an_open_bracket_is_rejected(path, tmp_path, bracket):
    header = npy(np.array("x")).replace(b"(), }", bracket.ljust(5))
    bad = repacked(path, tmp_path / "open.npz", header=header)
    assert error_message(bad) == "it is damaged or incomplete"
    assert not is_solution_file(bad)


def test_a_header_too_deeply_nested_to_be_saved_again_is_rejected(path, tmp_path):
    deep = []
    for _ in range(300):
        deep = [deep]
    assert "levels of nesting" in error_message(
        with_header(path, tmp_path / "deep.npz", frame={"deep": deep})
    )
    with pytest.raises(ValueError, match=r"cannot be saved.*nesting"):
        random_solution(frame={"deep": deep}).write(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_with_another_compression_are_rejected_unread(path, tmp_path, method):
    # LZMA allocates the memory that a file claims in advance: 700 MB for 1.8 kB.
    assert "compressed by a method" in error_message(repacked(path, tmp_path / "other.npz", method))


def test_uncompressed_members_are_read(solution, path, tmp_path):
    stored = repacked(path, tmp_path / "stored.npz", zipfile.ZIP_STORED)
    assert_same(Solution.read(stored), solution)


def test_a_solution_file_is_recognised_by_its_content(solution, tmp_path):
    assert is_solution_file(solution.write(tmp_path / "anything.dat"))
