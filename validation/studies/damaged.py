"""Robustness of reading damaged, foreign and malicious files.

    python -m validation damaged [--cases result .h5 .nrrd-scan] [--count 2000] [--seeds 0]

A kind is "result", "study", or the suffix of a field, of landmarks, or of a scan. All versions of a
kind are read in one process, which must survive. Flipped bits in numbers without a checksum cannot
be detected, so exchange files may be read with other values, unless they are truncated or gzip's
checksum covers the whole file. It is an error if any other file was read with contents that were
never saved, or if an error was not one of the package's; the targets also limit the time of a
version, and the memory.
"""

from __future__ import annotations

import io
import json
import random
import re
import struct
import tempfile
import tracemalloc
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clock import MemoryGrowth, timed
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
from napari_hmrf.fields import is_solution_file, is_study_file, read_field, write_field
from napari_hmrf.io.fields import FIELD_SUFFIXES
from napari_hmrf.io.images import MEDICAL_SUFFIXES, read_image
from napari_hmrf.io.landmark_files import POINT_SUFFIXES
from napari_hmrf.landmarks import read_points, write_points
from validation.study import Options, Results, Target, study

#: Largest accepted time of a version, in seconds: a child process is ended after ten seconds.
MOST_SECONDS = 12.0
#: Largest accepted peak of one version of an archive, and growth over all versions of a kind.
MOST_BYTES, MOST_GROWTH = 100e6, 20e6
#: Size of the start of a file, in bytes, which describes its contents; a third of flips are there.
_HEAD = 600
#: Number of versions read before memory is measured, because libraries allocate memory once.
_WARM_UP = 50

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
        True if other contents cannot be detected: all checksums are valid, as in a deliberately
        crafted file, or the format has none.
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
    """Functions for a kind of file: detection, reading, writing, and comparison of contents.

    Exchange files have no function for writing, as what is read is only compared.
    """

    is_one: Callable[[Path], bool]
    load: Callable[[Path], Any]
    save: Callable[[Path, Any], Path] | None
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
    if save is None:
        return "another"
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


def _save_result(path: Path) -> None:
    problem = phantom("expansion", 24).problem
    solve(problem, SeilerPrior(), backend="cpu").write(path)


def _write_study(path: Path) -> None:
    sample = phantom("mass-effect", 32)
    labels = sample.tissue_labels.astype(np.uint8)
    study = Study(
        Grid(labels.shape, (0.5, 0.5), "millimeter"),
        Tissue(labels=labels, materials=sample.materials),
        Motion(hold_edge=True, drawing=Drawing((Arrow((16, 12), (0.5, 1), 2.0),))),
        pictures=Pictures(sample.image, labels, "t1"),
    )
    write_study(path, study, solve_study(study, backend="cpu"))


def flipped(content: bytes, dice: random.Random) -> bytes:
    """Flip some bits."""
    made = bytearray(content)
    for _ in range(dice.choice((1, 1, 2, 8))):
        made[dice.randrange(len(made))] ^= 1 << dice.randrange(8)
    return bytes(made)


def cut(content: bytes, dice: random.Random) -> bytes:
    """Remove the end."""
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


def _displacement() -> np.ndarray:
    rows, cols = np.indices((40, 48)) / 40
    return 2 * np.stack([np.sin(3 * rows), np.cos(2 * cols)], axis=-1)


def make_field(path: Path) -> None:
    """Write a field of one slice in a volume; .tfm files are written by SimpleITK instead."""
    if path.suffix == ".tfm":
        make_foreign(path)
    else:
        turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
        write_field(
            path,
            _displacement(),
            spacing=(3.0, 1.3, 0.7),
            origin=(-10.0, 20.0, 5.0),
            direction=turn,
            forward=path.suffix != ".h5",
        )


def make_foreign(path: Path) -> None:
    """Write a field with SimpleITK only."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(_displacement(), isVector=True)
    image.SetSpacing((0.7, 1.3))
    if path.suffix in (".h5", ".tfm"):
        sitk.WriteTransform(sitk.DisplacementFieldTransform(image), str(path))
    else:
        sitk.WriteImage(image, str(path), useCompression=True)


def make_scan(path: Path) -> None:
    """Write a scan with SimpleITK only, with compressed pixels."""
    import SimpleITK as sitk

    rows = np.add.outer(np.arange(24), np.arange(20))
    image = sitk.GetImageFromArray(rows[None].astype(np.int16))
    image.SetSpacing((0.7, 1.3, 2.0))
    sitk.WriteImage(image, str(path), useCompression=True)


def make_landmarks(path: Path) -> None:
    """Write pairs of landmarks, or a single list if the format does not support pairs."""
    points = np.random.default_rng(0).normal(size=(40, 3))
    write_points(path, points, points + 1 if path.suffix == ".csv" else None)


def read_all(path: Path) -> tuple[Any, ...]:
    """Return the vectors and geometry of a field, for comparison."""
    field = read_field(path, forward=True)
    vectors = field.vectors
    place = (field.spacing, field.origin, field.direction.tobytes(), field.back)
    return vectors.dtype.str, vectors.shape, vectors.tobytes(), *place


def read_scan(path: Path) -> tuple[Any, ...]:
    """Return the pixels and geometry of a scan, for comparison."""
    image = read_image(path)
    geometry = b"" if image.geometry is None else image.geometry.affine.tobytes()
    return image.pixels.dtype.str, image.pixels.shape, image.pixels.tobytes(), geometry


def read_landmarks(path: Path) -> tuple[Any, ...]:
    """Return the contents of a landmark file, for comparison."""
    found = read_points(path)
    targets = b"" if found.targets is None else found.targets.tobytes()
    return found.points.tobytes(), targets, found.names, found.unit


def _exchanged(read: Callable[[Path], Any]) -> Kept:
    return Kept(lambda _: True, read, None, lambda contents: contents)


class Kind(NamedTuple):
    """Kind of file: its suffix, its writer, functions that read it, and whether it is text."""

    suffix: str
    make: Callable[[Path], None]
    kept: Kept
    is_text: bool = False

    def versions(self, content: bytes, count: int, seed: int) -> Iterator[Damaged]:
        """Yield damaged versions of a file."""
        if self.kept.save is not None:
            yield from damaged(content, count, seed)
            return
        dice = random.Random(seed)
        for number in range(count):
            kind = ("flips", "flips in the head", "flips", "cut", "torn")[number % 5]
            sealed = self.suffix != ".nii.gz" and (kind != "cut" or self.is_text)
            if kind == "flips in the head":
                version = flipped(content[:_HEAD], dice) + content[_HEAD:]
            else:
                version = {"flips": flipped, "cut": cut, "torn": torn}[kind](content, dice)
            yield Damaged(kind, version, sealed)


KINDS = {
    "result": Kind(".npz", _save_result, SOLUTIONS),
    "study": Kind(".study", _write_study, STUDIES),
    **{
        suffix: Kind(suffix, make_foreign, _exchanged(read_all))
        for suffix in (*FIELD_SUFFIXES, ".tfm")
    },
    **{
        suffix: Kind(suffix, make_landmarks, _exchanged(read_landmarks), is_text=True)
        for suffix in POINT_SUFFIXES
    },
    **{
        f"{suffix}-scan": Kind(suffix, make_scan, _exchanged(read_scan))
        for suffix in MEDICAL_SUFFIXES
    },
}
_OUTCOMES = "refused", "the same", "another", "failed"


class Findings(NamedTuple):
    """Findings of a kind: numbers of versions by outcome, time in seconds, and memory in MB.

    Attributes
    ----------
    name : str
    refused, same, another, failed : int
    longest : float
        Longest time of a version.
    growth : float or None
        Increase in memory over all versions; None for archives, because they are traced.
    peak : float or None
        Largest peak of a version; None for exchange files.
    """

    name: str
    refused: int
    same: int
    another: int
    failed: int
    longest: float
    growth: float | None
    peak: float | None


def _trials(options: Options) -> dict[str, tuple[str, int, int]]:
    """Return the name of each kind, the number of its versions, and the seed."""
    files, seeds = options.count or options.choose(2000, 10), options.seeds or [0]
    return {name: (name, files, *seeds) for name in KINDS}


def _targets(results: Results) -> Iterator[Target]:
    """Yield the targets of all kinds together."""
    found = [Findings(*each) for each in results.values()]
    growths = [each.growth for each in found if each.growth is not None]
    peaks = [each.peak for each in found if each.peak is not None]
    yield Target("other errors", sum(each.failed for each in found), 0)
    yield Target("longest time of a version, s", max(each.longest for each in found), MOST_SECONDS)
    yield Target("increase in memory, MB", max(growths, default=0.0), MOST_GROWTH / 1e6)
    yield Target("peak of a version of an archive, MB", max(peaks, default=0.0), MOST_BYTES / 1e6)


@study(
    "damaged.files",
    _trials,
    (
        *("kind", "refused", "read unchanged", "read with changes", "other errors"),
        *("longest time, s", "increase in memory, MB", "peak of a version, MB"),
    ),
    targets=_targets,
    page="damaged.md",
)
def read_damaged(trial: tuple[str, int, int]) -> Findings:
    """Read damaged versions of each kind of file, in a process that may crash."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            return pool.submit(_read_versions, *trial).result()
        except BrokenProcessPool:
            return Findings(trial[0], 0, 0, 0, trial[1], 0.0, None, None)


def _read_versions(name: str, files: int, seed: int) -> Findings:
    """Read damaged versions of a kind of file in this process."""
    kind = KINDS[name]
    is_archive = kind.kept.save is not None
    outcomes, longest, peak = Counter[str](), 0.0, 0
    memory = MemoryGrowth(_WARM_UP)
    with tempfile.TemporaryDirectory() as folder:
        # Each version replaces the file, beside which the pixels may be in another file.
        path = Path(folder, f"file{kind.suffix}")
        kind.make(path)
        original = kind.kept.load(path)
        for number, version in enumerate(kind.versions(path.read_bytes(), files, seed)):
            path.write_bytes(version.content)
            what = f"{kind.suffix} {number} ({version.kind}, {len(version.content)} bytes)"
            look_at = partial(look, path, version, original, kind.kept)
            outcome, times = timed(partial(_outcome, look_at, what))
            longest = max(longest, times.wall)
            if times.wall > MOST_SECONDS:
                print(f"{what}: took {times.wall:.1f} s")
            if is_archive:
                # Read again to trace memory, because tracing would distort the time.
                tracemalloc.start()
                with suppress(Exception):
                    look_at()
                peak = max(peak, tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
            memory.measure()
            outcomes[outcome] += 1
    counts = [outcomes[each] for each in _OUTCOMES]
    found = (None, peak / 1e6) if is_archive else (memory.megabytes, None)
    return Findings(name, *counts, longest, *found)


def _outcome(look_at: Callable[[], str], what: str) -> str:
    """Return the outcome of a version, or print an error and return "failed"."""
    try:
        return look_at()
    except Exception as error:  # noqa: BLE001 - unexpected errors are findings
        print(f"{what}: {type(error).__name__}: {error}"[:300])
        return "failed"
