"""Robustness of reading damaged, foreign and malicious versions of a saved result or study.

    python benchmarks/damaged.py [--of result] [--files 3000] [--seed 0]

Prints how many files were refused, and which files took the most time and memory. Exits with 1 if a
file was read with contents that were never saved, raised an exception other than `FileFormatError`,
or took more than 2 s or 100 MB.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import re
import struct
import sys
import tempfile
import time
import tracemalloc
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_hmrf import (
    Arrow,
    Drawing,
    FileFormatError,
    Grid,
    Motion,
    Pictures,
    SeilerPrior,
    Solution,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.data import phantom
from napari_hmrf.fields import is_solution_file, is_study_file

MOST_SECONDS = 2.0
MOST_BYTES = 100e6

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_LOCAL, _CENTRAL, _END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"
# Replacements for a part of an .npy header.
_ODD = (
    *(
        b"",
        b"(",
        b")",
        b"((",
        b"[",
        b"{",
        b"}",
        b"'",
        b",",
        b"-1",
        b"True",
        b"None",
        b"1e9",
        b"\x00",
    ),
    *(b"(7, (11, 2))", b"((7, 11), 2)", b"(-7, -11, 2)", b"(99999999, 99999999, 9)", b"(0, 11, 2)"),
    *(b"'|O'", b"'<U999999999'", b"'<f8'", b"'>f4'", b"'f4,f4'", b"[('a', '<f4')]", b"'(9999,)f4'"),
    *(b"9" * 5000, b"(" * 90, b"\xff\xfe", b"# \n", b"'''", b"\\"),
)
# Replacements for a value in the JSON header.
_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 2, 1e308, -0.0, float("nan"), float("inf"), 10**400),
    *("", "x", "\ud800", "9" * 3000, [], {}, [[]], [None], {"error": 1}, [0.0, 0.0], [1.0, 1.0]),
)


@dataclass(frozen=True)
class Damaged:
    """Damaged version of a file.

    Attributes
    ----------
    kind : str
        Kind of damage.
    content : bytes
        Content of the damaged file.
    sealed : bool
        True if all checksums are valid, as in a deliberately crafted file.
    """

    kind: str
    content: bytes
    sealed: bool


def damaged(content: bytes, count: int, seed: int = 0) -> Iterator[Damaged]:
    """Yield damaged versions of a saved result, reproducible for a given seed."""
    dice = random.Random(seed)
    kinds: list[tuple[Callable[[bytes, random.Random], bytes], bool]] = [
        *((kind, False) for kind in (flipped, cut, torn, _table_edited, _method_claimed)),
        *((kind, True) for kind in (_npy_edited, _header_edited, _swapped, _packed_otherwise)),
        *((kind, True) for kind in (_twice, _nested)),
    ]
    for number in range(count):
        make, sealed = kinds[number % len(kinds)]
        yield Damaged(make.__name__.strip("_").replace("_", " "), make(content, dice), sealed)


class Kept(NamedTuple):
    """Functions for a kind of file: detection, reading, writing, and comparison of contents."""

    is_one: Callable[[Path], bool]
    load: Callable[[Path], Any]
    save: Callable[[Path, Any], Path]
    told: Callable[[Any], Any]


def look(path: Path, version: Damaged, original: Any, kept: Kept | None = None) -> str:
    """Read a damaged version from a file, and return "refused", "the same" or "another".

    By default, the file is a solution.

    Raises
    ------
    AssertionError
        If the contents were never saved, or cannot be saved again.
    """
    is_one, load, save, told = kept or SOLUTIONS
    ours = is_one(path)
    try:
        found = load(path)
    except FileFormatError:
        return "refused"
    assert ours, f"{version.kind}: read, but not detected as this kind of file"
    if told(found) == told(original):
        return "the same"
    assert version.sealed, f"{version.kind}: read with other contents"
    again = load(save(path.with_name(f"again{path.suffix}"), found))
    assert told(again) == told(found), f"{version.kind}: different after saving it again"
    return "another"


def told(solution: Solution) -> tuple[Any, ...]:
    """Return all contents of a solution, for comparison."""
    arrays = (solution.displacement, solution.energy, solution.tissue)
    rest = asdict(solution) | dict.fromkeys(("displacement", "energy", "tissue"))
    return *(array.tobytes() for array in arrays), json.dumps(rest, sort_keys=True)


def plain(value: Any) -> Any:
    """Return all contents of a study or of its parts, for comparison."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        parts = {field.name: plain(getattr(value, field.name)) for field in fields(value)}
        return type(value).__name__, parts
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    return [plain(each) for each in value] if isinstance(value, tuple | list) else repr(value)


SOLUTIONS = Kept(is_solution_file, Solution.read, lambda path, it: it.write(path), told)
STUDIES = Kept(is_study_file, read_study, lambda path, it: write_study(path, *it), plain)


def _save_result(folder: Path) -> Path:
    problem = phantom("expansion", 24).problem
    return solve(problem, SeilerPrior(), backend="cpu").write(folder / "a.npz")


def _write_study(folder: Path) -> Path:
    sample = phantom("mass-effect", 32)
    labels = sample.tissue_labels.astype(np.uint8)
    study = Study(
        Grid(labels.shape, (0.5, 0.5), "millimeter"),
        Tissue(labels=labels, materials=sample.materials),
        Motion(hold_edge=True, drawing=Drawing((Arrow((16, 12), (0.5, 1), 2.0),))),
        pictures=Pictures(sample.image, labels, "t1"),
    )
    return write_study(folder / "a.study", study, solve_study(study, backend="cpu"))


def flipped(content: bytes, dice: random.Random) -> bytes:
    made = bytearray(content)
    for _ in range(dice.choice((1, 1, 2, 8))):
        made[dice.randrange(len(made))] ^= 1 << dice.randrange(8)
    return bytes(made)


def cut(content: bytes, dice: random.Random) -> bytes:
    return content[: dice.randrange(len(content))]


def torn(content: bytes, dice: random.Random) -> bytes:
    """Remove, clear, randomize or duplicate a block, or copy it from elsewhere in the file."""
    start, length = dice.randrange(len(content)), dice.choice((1, 16, 512, 4096))
    elsewhere = dice.randrange(len(content))
    block = (
        b"",
        bytes(length),
        dice.randbytes(length),
        content[elsewhere : elsewhere + length],
        content[start : start + length] * 2,
    )[dice.randrange(5)]
    return content[:start] + block + content[start + length :]


def _table_edited(content: bytes, dice: random.Random) -> bytes:
    """Write wrong numbers, small or huge, into the records of the archive."""
    made = bytearray(content)
    record, width = dice.choice(((_LOCAL, 30), (_CENTRAL, 46), (_END, 22)))
    at = dice.choice(_places(content, record)) + 4 + 2 * dice.randrange((width - 4) // 2)
    value = dice.choice((0, 1, 0x7FFF, 0xFFFF, dice.randrange(0x10000)))
    struct.pack_into("<H", made, at, value)
    if dice.random() < 0.5 and at + 4 <= len(made):
        struct.pack_into("<I", made, at, dice.choice((0xFFFFFFFF, 0x0FFFFFFF, len(content))))
    return bytes(made)


def _method_claimed(content: bytes, dice: random.Random) -> bytes:
    """Declare a wrong compression method."""
    made, method = bytearray(content), dice.choice((*_METHODS, 9, 97))
    for record, offset in ((_LOCAL, 8), (_CENTRAL, 10)):
        for at in _places(content, record):
            struct.pack_into("<H", made, at + offset, method)
    return bytes(made)


def _places(content: bytes, record: bytes) -> list[int]:
    return [found.start() for found in re.finditer(re.escape(record), content)]


def _npy_edited(content: bytes, dice: random.Random) -> bytes:
    """Replace a part of an array's .npy header; its stated length may then be wrong."""
    members = _members(content)
    name = dice.choice(sorted(members))
    data = members[name]
    length = int.from_bytes(data[8:10], "little")
    header, values = data[10 : 10 + length], data[10 + length :]
    start = dice.randrange(80)
    header = header[:start] + dice.choice(_ODD) + header[start + dice.choice((0, 1, 4, 12)) :]
    if dice.random() < 0.3:
        whole = b"{'descr': %s, 'fortran_order': False, 'shape': (7, 11, 2), }\n"
        header = whole % dice.choice(_ODD)
    if dice.random() < 0.2:
        values = values[: dice.randrange(len(values))]
    told = len(header) if dice.random() < 0.8 else dice.randrange(0x10000)
    version = b"\x01\x00" if dice.random() < 0.8 else bytes((dice.randrange(5), dice.randrange(3)))
    members[name] = b"\x93NUMPY" + version + told.to_bytes(2, "little") + header + values
    return _archive(members.items())


def _header_edited(content: bytes, dice: random.Random) -> bytes:
    """Replace, remove or add a value in the header."""
    members = _members(content)
    header = json.loads(np.load(io.BytesIO(members["header.npy"])).item())
    part: Any = header
    while True:
        keys = list(part) if isinstance(part, dict) else list(range(len(part)))
        key = dice.choice(keys)
        if not (isinstance(part[key], dict | list) and part[key]) or dice.random() < 0.3:
            break
        part = part[key]
    if dice.random() < 0.3:
        del part[key]
    else:
        part[key] = dice.choice(_VALUES)
    return _with_header(members, json.dumps(header))


def _nested(content: bytes, dice: random.Random) -> bytes:
    """Insert a deeply nested or very long value into the header."""
    members = _members(content)
    header = np.load(io.BytesIO(members["header.npy"])).item()
    depth = dice.choice((10, 100, 300, 900, 5000, 100_000))
    inner = dice.choice(("[" * depth + "]" * depth, '{"a":' * depth + "0" + "}" * depth))
    wide = "[" + ",".join(["{}"] * depth) + "]"
    key = dice.choice(("frame", "parameters", "convergence", "spacing", "levels", "odd"))
    return _with_header(members, f'{header[:-1]}, "{key}": {dice.choice((inner, wide))}}}')


def _swapped(content: bytes, dice: random.Random) -> bytes:
    """Swap the names of members, and possibly remove or rename a member."""
    members = _members(content)
    names = list(members)
    others = dice.sample(names, len(names))
    swapped = dict(zip(names, (members[name] for name in others), strict=True))
    if dice.random() < 0.3:
        swapped[dice.choice(("../evil.npy", "odd.npy", "header", "header.npy/"))] = members[
            names[0]
        ]
    if dice.random() < 0.3:
        del swapped[dice.choice(names)]
    return _archive(swapped.items())


def _packed_otherwise(content: bytes, dice: random.Random) -> bytes:
    """Use another compression method, possibly with additional zeros after a member."""
    members = _members(content)
    if dice.random() < 0.5:
        name = dice.choice(sorted(members))
        members[name] += bytes(dice.choice((1, 1000, 1_000_000)))
    return _archive(members.items(), dice.choice(_METHODS))


def _twice(content: bytes, dice: random.Random) -> bytes:
    members = _members(content)
    name = dice.choice(sorted(members))
    other = members[dice.choice(sorted(members))]
    return _archive([*members.items(), (name, other)])


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(members: Any, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method, compresslevel=1) as archive:
        for name, data in members:
            # Register the name separately, because zipfile warns about duplicate names.
            archive.NameToInfo.pop(name, None)
            archive.writestr(name, data)
    return file.getvalue()


def _with_header(members: dict[str, bytes], header: str) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array(header))
    return _archive({**members, "header.npy": file.getvalue()}.items())


def main(arguments: Sequence[str] | None = None) -> int:
    """Read all versions and print time, memory and outcomes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--of", choices=("result", "study"), default="result")
    parser.add_argument("--files", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        make, kept = (_write_study, STUDIES) if options.of == "study" else (_save_result, SOLUTIONS)
        saved = make(Path(folder))
        path = saved.with_stem("damaged")
        original = kept.load(saved)
        outcomes: Counter[tuple[str, str]] = Counter()
        slowest: tuple[float, str] = (0.0, "")
        hungriest: tuple[int, str] = (0, "")
        failed = False
        for number, version in enumerate(damaged(saved.read_bytes(), options.files, options.seed)):
            path.write_bytes(version.content)
            what = f"file {number} ({version.kind}, {len(version.content)} bytes)"
            started = time.perf_counter()
            try:
                outcome = look(path, version, original, kept)
            except Exception as error:  # noqa: BLE001 - unexpected errors are findings
                outcome, failed = "failed", True
                print(f"{what}: {type(error).__name__}: {error}"[:300])
            slowest = max(slowest, (time.perf_counter() - started, what))
            # Read again to trace memory, because tracing would distort the time.
            tracemalloc.start()
            with suppress(Exception):
                look(path, version, original, kept)
            hungriest = max(hungriest, (tracemalloc.get_traced_memory()[1], what))
            tracemalloc.stop()
            outcomes[version.kind, outcome] += 1
    for (kind, outcome), count in sorted(outcomes.items()):
        print(f"{kind:<16}  {outcome:<8}  {count:>5}")
    print(f"slowest: {slowest[0] * 1e3:.1f} ms, {slowest[1]}")
    print(f"hungriest: {hungriest[0] / 1e6:.1f} MB, {hungriest[1]}")
    return int(failed or slowest[0] > MOST_SECONDS or hungriest[0] > MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main())
