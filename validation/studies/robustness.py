"""What survives: files on full disks, files of killed processes, and a window in long use.

`full-disks` runs all functions and commands that write files four times: with enough space, with a
limit of the file size, on a full disk, and with a full disk only for temporary files. The second
and third runs must raise one error that names a file and the reason, and must leave all files
unchanged; the last run must succeed. Disks are mounted in memory, which requires root and Linux;
otherwise only the file size limit is tested.

`killed` overwrites a study or a field in a child process that kills itself (SIGKILL) before or
after the n-th call into the system or a library: all n after writing starts (``--every``), and a
sample of the calls before (``--count``). Other children save a large study and are killed by their
parent as soon as a given part is on the disk. Afterwards, the file must contain either the earlier
or the later content, and only a temporary file may be left. Requires a system with fork.

`long-use` deforms hundreds of times (``--count``) in a window, and cancels many deformations at
random, while the viewer redraws. Every deformation is started through the dock, in turn on the
shaders and on the compiled loops, with the paper's energy and with elastic tissue. It requires a
display: ``sh scripts/headless.sh python -m validation robustness.long-use``.
"""

from __future__ import annotations

import contextlib
import gc
import io
import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clock import MemoryGrowth, now, since, timed
from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Motion,
    Pictures,
    Solution,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.augmentation.ground_truth import write_truth
from napari_hmrf.cli import main as command
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.contributions import write_solution
from napari_hmrf.data import phantom
from napari_hmrf.errors import HmrfError, in_words
from napari_hmrf.fields import read_field, write_field, write_movie
from napari_hmrf.io.apply import FieldFile, apply_field, write_field_file
from napari_hmrf.io.case import Case, solve_case
from napari_hmrf.io.case_options import RegistrationCase
from napari_hmrf.io.fields import export_field, write_mapping
from napari_hmrf.io.figures import write_pictures, write_result_pictures, write_volume_pictures
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.io.registration_files import register_files
from napari_hmrf.io.table_files import write_csv
from napari_hmrf.io.tables import write_measurements, write_named_materials, write_preset
from napari_hmrf.io.uncertainty_files import write_uncertainty
from napari_hmrf.landmarks import write_points
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.random import RandomDeformation
from napari_hmrf.results.measurement import Measurement
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.tissue.tissue_names import materials_by_name
from validation.studies.damaged import plain
from validation.study import Options, Results, Target, backends, study

#: Page of full disks; the other studies are not on a page, and run only if they are named.
PAGE = "full-disks.md"
#: Size of the image and of the study of most cases, in pixels.
SIZE = 16


@cache
def noise_study(pull: float = 1.0, size: int = SIZE) -> Study:
    """Return a study with an image of noise, which cannot be compressed, and a pull."""
    image = np.random.default_rng(size).integers(1, 255, (size, size), dtype=np.uint8)
    labels = np.ones(image.shape, np.uint8)
    drawing = Drawing((Arrow((size / 2, size / 2), (0.5, pull), 2.0),))
    return Study(
        Grid(image.shape, (1.0, 1.0), "millimeter"),
        Tissue(labels=labels, materials=(Material(1, "tissue", 1.0, 0.3),)),
        Motion(hold_edge=True, drawing=drawing),
        pictures=Pictures(image, labels, "noise"),
    )


# Full disks.

#: Function that writes files into a folder.
Write = Callable[[Path], Any]
# Right outcomes of the three trials.
_OUTCOMES = ("refused", "refused", "written")


@cache
def solution() -> Solution:
    """Return the solution of the study."""
    return solve_study(noise_study(), backend="cpu")


def _uncertainty() -> Uncertainty:
    """Return the uncertainty of the solution, with zeros."""
    found = solution()
    sd = np.zeros_like(found.displacement)
    return Uncertainty(found, sd, sd[..., 0], 1.0, 2, {})


@cache
def _volume() -> tuple[np.ndarray, Solution]:
    shape = (6, 8, 8)
    motion = Motion(hold_edge=True, drawing=Drawing((Arrow((3, 4, 4), (0, 0.5, 0.5), 1.0),)))
    whole = Study(Grid(shape, (1.0,) * 3), Tissue(stiffness=np.ones(shape)), motion)
    return np.ones(shape, np.uint8), solve_study(whole, backend="cpu")


@cache
def _deformation() -> RandomDeformation:
    materials = noise_study().tissue.materials
    return RandomDeformation(noise_study().tissue.labels, materials, spacing=(1.0, 1.0))


def _pixels() -> np.ndarray:
    image = noise_study().pictures.image
    assert image is not None
    return image


def _field(folder: Path, suffix: str) -> None:
    d = solution().displacement.astype(float)
    write_field(folder / f"field{suffix}", d, spacing=(1.0, 1.0))


def _pictures(folder: Path) -> None:
    sample = phantom("expansion", 16)
    write_pictures(folder, sample.image, sample.problem, solve(sample.problem, backend="cpu"))


def _case() -> Case:
    return Case(image=_inputs() / "case.study")


def _moved(folder: Path) -> None:
    source = _inputs() / "noise.mha"
    apply_field(FieldFile.of(solution()), source, folder / "moved.mha", labels=False)


@cache
def _inputs() -> Path:
    """Write the input files of the commands into a folder that is removed at exit."""
    made = tempfile.TemporaryDirectory()
    folder = Path(made.name)
    _KEPT.append(made)
    write_image(folder / "noise.mha", ImageFile(_pixels()))
    write_image(folder / "noise.png", ImageFile(_pixels()))
    write_image(folder / "labels.png", ImageFile(np.ones((SIZE, SIZE), np.uint8)))
    write_study(folder / "case.study", noise_study(), solution())
    (folder / "m.csv").write_text("label,name,stiffness\n1,brain,3\n")
    (folder / "names.csv").write_text("label,name\n1,liver\n2,spleen\n")
    rim = np.zeros((SIZE, SIZE), np.uint8)
    rim[0], rim[-1] = 1, 2
    write_image(folder / "rim.png", ImageFile(rim))
    (folder / "r.csv").write_text("label,name,action,row,col\n1,,fixed,,\n2,rim,move,0,1\n")
    titles = "name,image,labels,materials,boundary,rules"
    cells = "noise.png,labels.png,m.csv,rim.png,r.csv"
    (folder / "cases.csv").write_text(f"{titles}\none,{cells}\n")
    (folder / "more.csv").write_text(f"{titles}\none,{cells}\ntwo,{cells}\n")
    return folder


_KEPT: list[Any] = []


def _layer() -> dict[str, Any]:
    from napari_hmrf.layers.metadata import METADATA

    return {"name": "arrows", "metadata": {METADATA: {"solution": solution()}}}


def writers() -> dict[str, Write]:
    """Return all functions of the package that write files, by their names and formats."""
    points = np.random.default_rng(0).normal(size=(9, 2))
    required = len(Measurement._fields) - len(Measurement._field_defaults)
    rows = [Measurement(*([1] * required))]
    named = materials_by_name({1: "liver", 2: "something"}, name="names")
    return {
        "solver.solution.Solution.write": lambda at: solution().write(at / "a.npz"),
        "io.study_file.write_study": lambda at: write_study(
            at / "a.study", noise_study(), solution()
        ),
        "augmentation.random_deformation.RandomDeformation.write": lambda at: _deformation().write(
            at / "a.npz"
        ),
        **{
            f"io.fields.write_field {suffix}": partial(_field, suffix=suffix)
            for suffix in (".nii", ".nii.gz", ".mha", ".nrrd", ".h5")
        },
        "io.fields.write_mapping": lambda at: write_mapping(
            at / "a.mha", np.ones((SIZE, SIZE, 2)), spacing=(1, 1)
        ),
        "io.fields.export_field": lambda at: export_field(at / "a.mha", solution(), placed=False),
        "io.uncertainty_files.write_uncertainty": lambda at: write_uncertainty(
            at / "sd.mha", _uncertainty(), placed=False
        ),
        "io.apply.write_field_file": lambda at: write_field_file(
            at / "a.nrrd", FieldFile.of(solution())
        ),
        "io.apply.apply_field": _moved,
        **{
            f"io.images.write_image {suffix}": partial(
                lambda at, suffix: write_image(at / f"a{suffix}", ImageFile(_pixels())),
                suffix=suffix,
            )
            for suffix in (".png", ".tif", ".jpg", ".bmp", ".nii.gz", ".nii", ".mha", ".nrrd")
        },
        **{
            f"io.landmark_files.write_points {suffix}": partial(
                lambda at, suffix: write_points(at / f"a{suffix}", points), suffix=suffix
            )
            for suffix in (".csv", ".mrk.json", ".fcsv")
        },
        "io.moving_pictures.write_movie": lambda at: write_movie(
            at / "a.gif", solution(), _pixels(), frames=2
        ),
        "io.table_files.write_csv": lambda at: write_csv(at / "a.csv", ["a", "b"], [[1, "c" * 99]]),
        "io.tables.write_named_materials": lambda at: write_named_materials(at / "a.csv", named),
        "io.tables.write_measurements": lambda at: write_measurements(at / "a.csv", rows),
        "io.tables.write_preset": lambda at: write_preset(at / "a.json", PRESETS[0]),
        "io.figures.write_pictures": _pictures,
        "io.figures.write_result_pictures": lambda at: write_result_pictures(at, solution()),
        "io.figures.write_volume_pictures": lambda at: write_volume_pictures(
            at, *_volume(), (3, 4, 4)
        ),
        "augmentation.ground_truth.write_truth": lambda at: write_truth(
            _case(), at, amplitude=1.0, backend="cpu"
        ),
        "io.case.solve_case": lambda at: solve_case(_case(), at, backend="cpu"),
        "io.registration_files.register_files": lambda at: register_files(
            RegistrationCase(_inputs() / "noise.png", _inputs() / "noise.png"), at
        ),
        "contributions.write_solution": lambda at: write_solution(
            str(at / "a.npz"), None, _layer()
        ),
    }


def commands() -> dict[str, Write]:
    """Return all commands that write files, by name; they run in this process."""
    at, demo = _inputs(), ("--no-window", "--out", ".")
    typed: dict[str, list[Any]] = {
        "export .mha": ["export", at / "case.study", "a.mha"],
        "export .nii.gz": ["export", at / "case.study", "a.nii.gz"],
        "export .h5": ["export", at / "case.study", "a.h5"],
        "apply .png": ["apply", at / "case.study", at / "noise.png", "-o", "."],
        "apply .mha": ["apply", at / "case.study", at / "noise.mha", "-o", "."],
        "measure": ["measure", at / "case.study", "-o", "a.csv"],
        "play": ["play", at / "case.study", "a.gif"],
        "register": ["register", at / "noise.png", at / "noise.png", "-o", "."],
        "solve": ["solve", at / "case.study", "--backend", "cpu", "-o", "."],
        "materials": ["materials", at / "names.csv", "-o", "a.csv"],
        "truth": ["truth", at / "case.study", "--backend", "cpu", "-o", "."],
        "demo": ["demo", *demo, "--backend", "cpu"],
        "demo --volume": ["demo", *demo, "--volume", "--size", "32"],
    }
    made: dict[str, Write] = {
        f"napari-hmrf {name}": partial(_run, arguments=[*map(str, words), "--force"])
        for name, words in typed.items()
    }
    return made | {"napari-hmrf batch": _batch}


def _batch(folder: Path) -> None:
    """Solve a case, or a second case if the first is already solved."""
    table = "more.csv" if (folder / "out").exists() else "cases.csv"
    _run(folder, ["batch", str(_inputs() / table), "out", "--jobs", "1", "--resume"])


def _run(folder: Path, arguments: list[str]) -> None:
    """Run a command in a folder, and convert its error output to an exception."""
    out, err, before = io.StringIO(), io.StringIO(), Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = command(arguments)
    finally:
        os.chdir(before)
    if code:
        said = [each for each in err.getvalue().splitlines() if each.startswith("napari-hmrf: ")]
        raise HmrfError("\n".join(said))


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "filler"
    }


def outcome(write: Write, folder: Path, before: dict[str, bytes]) -> str:
    """Write without free space, and return a description of the problem, or "" if correct."""
    try:
        write(folder)
    except (HmrfError, OSError) as error:
        said = in_words(error)
    except Exception as error:  # noqa: BLE001 - unexpected errors are findings
        return f"{type(error).__name__}: {error}"[:300]
    else:
        return "no error"
    after = contents(folder)
    if after != before:
        new = sorted(after.keys() - before.keys())
        changed = sorted(name for name in before if after.get(name) != before[name])
        return f"left behind: {new}" if new else f"changed: {changed}"
    names = {Path(name).name for name in before}
    reasons = ("disk is full", "larger than the system allows", "No space left", "File too large")
    if not any(name in said for name in names) or not any(each in said for each in reasons):
        return f"the error does not say what and why: {said}"[:300]
    return "more than one line" if "\n" in said else ""


@contextmanager
def limited(size: int) -> Iterator[None]:
    """Limit the size of all files."""
    import resource  # available only on POSIX systems

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def disk(megabytes: int) -> Iterator[Path]:
    """Mount a small disk in memory."""
    folder = tempfile.mkdtemp()
    size = f"size={megabytes}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], check=True)
    try:
        yield Path(folder)
    finally:
        subprocess.run(["umount", "-l", folder], check=True)
        os.rmdir(folder)


def fill(folder: Path) -> None:
    """Fill a disk completely."""
    with open(folder / "filler", "ab", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(2**12))


@contextmanager
def _temporary_files_in(folder: Path) -> Iterator[None]:
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    os.environ["TMPDIR"] = str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = before
        del os.environ["TMPDIR"]


def _trials(options: Options) -> dict[str, Write]:
    """Return functions and commands by name."""
    found = list((writers() | commands()).items())
    return dict(found[:: options.choose(options.every, 12)])


def _others(results: Results) -> Iterator[Target]:
    """Yield the target of the outcomes."""
    wrong = sum(
        any(each not in (right, "not tried") for each, right in zip(row, _OUTCOMES, strict=True))
        for row in results.values()
    )
    yield Target("writers with another outcome", wrong, 0)


@study(
    "robustness.full-disks",
    _trials,
    ("writer", "file size limit", "full disk", "full disk for temporary files"),
    rows=lambda results: ([name, *row] for name, row in results.items()),
    targets=_others,
    page=PAGE,
)
def full_disks(write: Write) -> list[str]:
    """Write files where there is no space."""
    trials = (_with_limits, _on_full_disk, _beside_full_disk)
    if sys.platform != "linux" or os.geteuid() != 0:
        trials = (_with_limits, _not_tried, _not_tried)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        faults = [trial(write) for trial in trials]
    return [fault or right for fault, right in zip(faults, _OUTCOMES, strict=True)]


def _not_tried(_: Write) -> str:
    return "not tried"


def _with_limits(write: Write) -> str:
    """Overwrite files with a limit at which an early write fails, then at which a later one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        before = contents(folder)
        smallest = min(map(len, before.values()))
        for limit in (1, smallest // 2):
            with limited(limit):
                fault = outcome(write, folder, before)
            if fault:
                return fault
    return ""


def _on_full_disk(write: Write) -> str:
    """Overwrite files on a full disk."""
    with disk(24) as folder:
        write(folder)
        before = contents(folder)
        fill(folder)
        return outcome(write, folder, before)


def _beside_full_disk(write: Write) -> str:
    """Write while the disk for temporary files is full; return the fault, or ""."""
    with tempfile.TemporaryDirectory() as name:
        write(Path(name))
        expected = contents(Path(name)).keys()
    with disk(1) as full, tempfile.TemporaryDirectory() as name, _temporary_files_in(full):
        fill(full)
        try:
            write(Path(name))
        except Exception as error:  # noqa: BLE001 - unexpected errors are findings
            return f"{type(error).__name__}: {error}"[:300]
        return "" if contents(Path(name)).keys() == expected else "other files"


# Killed processes.

Save = Callable[[], Any]
#: Contents that the file may have afterwards.
_KNOWN = ("first", "second", "large")


class _Steps:
    """Profiler that counts the steps of a save, and kills the process at a given step."""

    def __init__(self, last: int = 0) -> None:
        self._last = last
        self.count = 0
        self.written_from = 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name == "write_whole":
            self.written_from = self.count + 1
        if event in ("c_call", "c_return"):
            self.count += 1
            if self.count == self._last:
                os.kill(os.getpid(), signal.SIGKILL)


def steps_of(save: Save) -> tuple[int, int]:
    """Return the first step at which the file is written, and the number of steps of a save."""
    steps = _Steps()
    sys.setprofile(steps)
    try:
        save()
    finally:
        sys.setprofile(None)
    return steps.written_from, steps.count


def killed_at(step: int, save: Save) -> bool:
    """Save in a child that kills itself at a step; return True if the step was reached."""
    child = os.fork()
    if not child:
        try:
            sys.setprofile(_Steps(step))
            save()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def killed_at_size(size: int, folder: Path, save: Save) -> bool:
    """Save in a child, kill it at a temporary file size, and return True if this was reached."""
    child = os.fork()
    if not child:
        try:
            save()
        finally:
            os._exit(0)
    while not os.waitpid(child, os.WNOHANG)[0]:
        if any(half >= size for half in _sizes(folder)):
            os.kill(child, signal.SIGKILL)
            return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    return False


def _sizes(folder: Path) -> Iterator[int]:
    for path in folder.glob("*.tmp"):
        try:
            yield path.stat().st_size
        except FileNotFoundError:  # the file has been renamed meanwhile
            continue


def left(path: Path, known: dict[str, Any], read: Callable[[Path], Any]) -> str:
    """Read the remaining file, remove temporary files, and return the name of its contents."""
    others = [each for each in path.parent.iterdir() if each != path]
    for each in others:
        if ".tmp" not in each.suffixes:
            return f"another file was left: {each.name}"
        each.unlink()
    try:
        found = read(path)
    except (HmrfError, OSError) as error:
        return f"broken: {error}"
    return next((name for name, one in known.items() if one == found), "another one")


class Kills(NamedTuple):
    """Kind of file whose saves are killed, and how often.

    Attributes
    ----------
    suffix : str
        ".study", or the suffix of a field.
    packing, half : int
        Number of kills before the file is written, and of a half-written large file.
    every : int
        Interval between steps of writing.
    seed : int
        Seed of the random moments.
    """

    suffix: str
    packing: int
    half: int
    every: int
    seed: int


def _kinds(options: Options) -> dict[str, Kills]:
    """Return the kinds of files."""
    count = options.count or options.choose(300, 6)
    every = options.choose(options.every, 40)
    kills = count, count // 3, every, *(options.seeds or [0])
    return {suffix: Kills(suffix, *kills) for suffix in (".study", ".mha")}


def _broken(results: Results) -> Iterator[Target]:
    """Yield the target of the contents."""
    rows = itertools.chain.from_iterable(results.values())
    wrong = sum(number for *_, number, what in rows if what not in _KNOWN)
    yield Target("killed saves after which the file has other contents", wrong, 0)


@study(
    "robustness.killed",
    _kinds,
    ("file", "killed while", "times", "contents afterwards"),
    targets=_broken,
    page=PAGE,
    on_request=True,
)
def killed(kills: Kills) -> list[list[Any]]:
    """Kill processes that overwrite a file."""
    with tempfile.TemporaryDirectory() as folder:
        find = _killed_studies if kills.suffix == ".study" else _killed_fields
        outcomes = Counter(find(kills, Path(folder, f"case{kills.suffix}")))
    return [[kills.suffix, when, n, what] for (when, what), n in sorted(outcomes.items())]


def _killed_fields(kills: Kills, path: Path) -> Iterator[tuple[str, str]]:
    """Kill at the steps of writing a field; yield the phase and the contents afterwards."""

    def save(seed: int) -> None:
        vectors = np.random.default_rng(seed).normal(size=(12, 14, 2))
        write_field(path, vectors, spacing=(1.0, 1.0), forward=True)

    def read(path: Path) -> bytes:
        return np.round(read_field(path, forward=True).vectors, 6).tobytes()

    known = {}
    for seed, name in enumerate(("first", "second")):
        save(seed)
        known[name] = read(path)
    for step in itertools.count(1, kills.every):
        save(0)
        came = killed_at(step, partial(save, 1))
        yield "writing" if came else "writing, not killed", left(path, known, read)
        if not came:
            return


def _killed_studies(kills: Kills, path: Path) -> Iterator[tuple[str, str]]:
    """Kill at the steps of saving a study, and while a large study is written."""
    dice = random.Random(kills.seed)
    first, second, large = noise_study(1.0, 24), noise_study(2.0, 24), noise_study(1.0, 2000)
    known = {name: plain(one) for name, one in zip(_KNOWN, (first, second, large), strict=True)}

    def read(path: Path) -> Any:
        return plain(read_study(path).study)

    save = partial(write_study, path, second, solve_study(second, backend="cpu"))
    write_study(path, first)
    start, count = steps_of(save)
    before = dice.sample(range(1, start), min(kills.packing, start - 1))
    for step in (*sorted(before), *range(start, count + 1, kills.every)):
        write_study(path, first)
        when = "packing" if step < start else "writing"
        came = killed_at(step, save)
        yield when if came else f"{when}, not killed", left(path, known, read)
    size = write_study(path, large).stat().st_size
    for _ in range(kills.half):
        write_study(path, first)
        came = killed_at_size(dice.randrange(size), path.parent, partial(write_study, path, large))
        yield "half written" if came else "half written, not killed", left(path, known, read)


# Long use.

# Energies, and the time limit of a deformation in seconds, which is sufficient to compile all
# kernels on a busy machine.
_ENERGIES, _PATIENCE = ("paper", "elastic"), 240.0


class Plan(NamedTuple):
    """Numbers of deformations that complete and that are cancelled, and the image in pixels."""

    solves: int
    cancels: int
    size: int


class Findings(NamedTuple):
    """Findings of a long use; times are in seconds.

    Attributes
    ----------
    finished, cancelled, wrong : int
        Numbers of deformations, and of those with another result than the first.
    growth : float
        Most memory after the tenth solve, above the memory then, in MB.
    longest_cancel : float
        Longest time until a cancelled solve had ended.
    threads_left, changed_pixels : int
        Threads after the viewer is closed, and pixels of its picture that differ from the first.
    closing : float
        Time to close the viewer during a solve.
    """

    finished: int
    cancelled: int
    wrong: int
    growth: float
    longest_cancel: float
    threads_left: int
    changed_pixels: int
    closing: float


def _plans(options: Options) -> dict[str, Plan]:
    """Return the plan of the command."""
    count = options.count or options.choose(500, 20)
    return {"window": Plan(count, count // 5, *options.sizes_or([96]))}


def _limits(results: Results) -> Iterator[Target]:
    """Yield the targets."""
    for found in map(Findings._make, results.values()):
        yield Target("wrong results", found.wrong, 0)
        yield Target("increase in memory after the tenth solve, MB", found.growth, 5)
        yield Target("threads left", found.threads_left, 0)
        yield Target("changed pixels of the viewer's picture", found.changed_pixels, 0)
        yield Target("closing the viewer during a solve, s", found.closing, 2)


@study(
    "robustness.long-use",
    _plans,
    (
        *("finished", "cancelled", "wrong", "increase in memory, MB", "longest cancel, s"),
        *("threads left", "changed pixels", "closing, s"),
    ),
    targets=_limits,
    page=PAGE,
    on_request=True,
)
def long_use(plan: Plan) -> Findings:
    """Deform hundreds of times in a window."""
    import napari
    from qtpy.QtWidgets import QApplication

    from napari_hmrf.contributions import phantom_layers
    from napari_hmrf.ui.soft_tissue import SoftTissue

    turns = [(backend, energy) for energy in _ENERGIES for backend in backends()]
    before = set(threading.enumerate())
    dice = random.Random(0)
    viewer = napari.Viewer(show=True)
    for data in phantom_layers(phantom("expansion", plan.size)):
        viewer._add_layer_from_data(*data)
    widget = SoftTissue(viewer)
    widget.live = False
    viewer.window.add_dock_widget(widget, name="Soft tissue")
    expected = {turn: _deform(widget, turn).displacement for turn in turns}
    camera = viewer.scene.camera if hasattr(viewer, "scene") else viewer.camera
    zoom = camera.zoom
    picture = viewer.screenshot(canvas_only=True, flash=False)
    usual = timed(lambda: _deform(widget, turns[-1]))[1].wall
    ends = [True] * plan.solves + [False] * plan.cancels
    dice.shuffle(ends)
    wrong, memory, cancels = 0, MemoryGrowth(warm_up=10), [0.0]
    for number, finish in enumerate(ends):
        turn = turns[number % len(turns)]
        camera.zoom = zoom * (1.001 if number % 2 else 1)  # force the canvas to redraw
        if finish:
            solution = _deform(widget, turn)
            wrong += not np.array_equal(solution.displacement, expected[turn])
        else:
            _start(widget, turn)
            _pump(dice.uniform(0, usual))
            cancels.append(timed(lambda: _cancel(widget))[1].wall)
        QApplication.processEvents()
        if finish:
            gc.collect()
            memory.measure()
    camera.zoom = zoom
    _deform(widget, turns[-1])
    changed = picture != viewer.screenshot(canvas_only=True, flash=False)
    _start(widget, turns[0])
    closing = timed(lambda: (viewer.close(), QApplication.processEvents()))[1].wall
    compute_thread.stop(_PATIENCE)
    after = set(threading.enumerate()) - before
    return Findings(
        finished=plan.solves,
        cancelled=plan.cancels,
        wrong=wrong,
        growth=memory.megabytes,
        longest_cancel=max(cancels),
        threads_left=sum("hmrf" in thread.name for thread in after),
        changed_pixels=int(changed.any(axis=-1).sum()),
        closing=closing,
    )


def _cancel(widget: Any) -> None:
    """Cancel a solve, and wait until it has ended."""
    widget.cancel()
    compute_thread.submit(lambda: None).result()


def _start(widget: Any, turn: tuple[str, str]) -> None:
    widget.device, widget.model = turn
    widget.deform()


def _deform(widget: Any, turn: tuple[str, str]) -> Any:
    _start(widget, turn)
    begun = now()
    while not widget.idle:
        _pump(0.005)
        if since(begun).wall > _PATIENCE:
            raise TimeoutError("a deformation did not end within four minutes")
    return widget.solution


def _pump(seconds: float) -> None:
    from qtpy.QtWidgets import QApplication

    begun = now()
    while True:
        QApplication.processEvents()
        if since(begun).wall >= seconds:
            return
        time.sleep(0.001)
