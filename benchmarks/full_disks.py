"""Test of all functions that write files on a full disk: earlier files must remain unchanged.

    python benchmarks/full_disks.py [--commands] [--only NAME] [--page PAGE]

Each writing function, and with --commands each command, runs four times: with enough space, with a
limit of the file size, on a full disk, and with a full disk only for temporary files. The second
and third runs must raise one error that names a file and the reason, and must leave all files
unchanged; the last run must succeed. Disks are mounted in memory, which requires root and Linux;
otherwise only the file size limit is tested. Exits with 1 on any other outcome.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Motion,
    Pictures,
    Solution,
    Study,
    Tissue,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.augmentation.ground_truth import write_truth
from napari_hmrf.cli import main as command
from napari_hmrf.contributions import write_solution
from napari_hmrf.data import phantom
from napari_hmrf.errors import HmrfError, in_words
from napari_hmrf.field.measurement import Measurement
from napari_hmrf.fields import write_field, write_movie
from napari_hmrf.io.apply import FieldFile, apply_field, write_field_file
from napari_hmrf.io.case import Case, solve_case
from napari_hmrf.io.csv_files import write_csv
from napari_hmrf.io.fields import export_field, write_mapping
from napari_hmrf.io.figures import write_pictures, write_result_pictures, write_volume_pictures
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.io.material_tables import write_preset
from napari_hmrf.io.moving_pictures import write_film
from napari_hmrf.io.registration_files import RegistrationCase, register_files
from napari_hmrf.io.tables import write_measurements, write_named_materials
from napari_hmrf.io.uncertainty_files import write_uncertainty
from napari_hmrf.landmarks import write_points
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.random import RandomDeformation
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.tissue.tissue_names import materials_by_name

_SHAPE = (14, 16)


class Writer(NamedTuple):
    """Function that writes files, and its name.

    Attributes
    ----------
    name : str
        Module and name of the function, and the kind of file.
    write : callable
        Function that writes into a given folder.
    """

    name: str
    write: Callable[[Path], Any]


@cache
def study() -> Study:
    """Return a small study with an image of noise, which cannot be compressed."""
    image = np.random.default_rng(3).integers(1, 255, _SHAPE, dtype=np.uint8)
    labels = np.ones(_SHAPE, np.uint8)
    pull = Drawing((Arrow((7, 8), (0.5, 1.0), 2.0),))
    return Study(
        Grid(_SHAPE, (1.0, 1.0), "millimeter"),
        Tissue(labels=labels, materials=(Material(1, "tissue", 1.0, 0.3),)),
        Motion(hold_edge=True, drawing=pull),
        pictures=Pictures(image, labels, "noise"),
    )


@cache
def solution() -> Solution:
    """Return the solution of the study."""
    return solve_study(study(), backend="cpu")


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
    materials = study().tissue.materials
    return RandomDeformation(study().tissue.labels, materials, spacing=(1.0, 1.0))


def _pixels() -> np.ndarray:
    image = study().pictures.image
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
    write_image(folder / "labels.png", ImageFile(np.ones(_SHAPE, np.uint8)))
    write_study(folder / "case.study", study(), solution())
    (folder / "m.csv").write_text("label,name,stiffness\n1,brain,3\n")
    (folder / "names.csv").write_text("label,name\n1,liver\n2,spleen\n")
    rim = np.zeros(_SHAPE, np.uint8)
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


def writers() -> list[Writer]:
    """List all functions of the package that write files, with their formats."""
    points = np.random.default_rng(0).normal(size=(9, 2))
    required = len(Measurement._fields) - len(Measurement._field_defaults)
    rows = [Measurement(*([1] * required))]
    named = materials_by_name({1: "liver", 2: "something"}, name="names")
    made: dict[str, Callable[[Path], Any]] = {
        "solver.solution.Solution.write": lambda at: solution().write(at / "a.npz"),
        "io.study_file.write_study": lambda at: write_study(at / "a.study", study(), solution()),
        "augmentation.random_deformation.RandomDeformation.write": lambda at: _deformation().write(
            at / "a.npz"
        ),
        **{
            f"io.fields.write_field {suffix}": partial(_field, suffix=suffix)
            for suffix in (".nii", ".nii.gz", ".mha", ".nrrd", ".h5")
        },
        "io.fields.write_mapping": lambda at: write_mapping(
            at / "a.mha", np.ones((*_SHAPE, 2)), spacing=(1, 1)
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
        "io.moving_pictures.write_film": lambda at: write_film(
            at / "b.gif", solution(), _pixels(), frames=2
        ),
        "io.csv_files.write_csv": lambda at: write_csv(at / "a.csv", ["a", "b"], [[1, "c" * 99]]),
        "io.tables.write_named_materials": lambda at: write_named_materials(at / "a.csv", named),
        "io.tables.write_measurements": lambda at: write_measurements(at / "a.csv", rows),
        "io.material_tables.write_preset": lambda at: write_preset(at / "a.json", PRESETS[0]),
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
    return [Writer(name, write) for name, write in made.items()]


def commands() -> list[Writer]:
    """List all commands that write files; they run in this process."""
    at = _inputs()
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
        "demo": ["demo", "--no-window", "--backend", "cpu", "--out", "."],
        "demo --volume": ["demo", "--volume", "--size", "32", "--no-window", "--out", "."],
    }
    return [
        Writer(f"napari-hmrf {name}", partial(_run, arguments=[*map(str, words), "--force"]))
        for name, words in typed.items()
    ] + [Writer("napari-hmrf batch", _batch)]


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


def outcome(writer: Writer, folder: Path, before: dict[str, bytes]) -> str:
    """Write without free space, and return a description of the problem, or "" if correct."""
    try:
        writer.write(folder)
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


def trial(writer: Writer, *, can_mount: bool) -> list[str]:
    """Run a writer in all four ways and return the problems, "" if there is none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        writer.write(folder)
        before = contents(folder)
        smallest = min(map(len, before.values()))
        found = []
        for limit in (1, smallest // 2):  # an early write fails, then a later write
            with limited(limit):
                found.append(outcome(writer, folder, before))
    found = [next(filter(None, found), "")]
    if not can_mount:
        return [*found, "not tried", "not tried"]
    with disk(24) as folder:
        writer.write(folder)
        before = contents(folder)
        fill(folder)
        found.append(outcome(writer, folder, before))
    with disk(1) as full, tempfile.TemporaryDirectory() as name, _temporary_files_in(full):
        fill(full)
        try:
            writer.write(Path(name))
            found.append("" if contents(Path(name)).keys() == before.keys() else "other files")
        except Exception as error:  # noqa: BLE001 - unexpected errors are findings
            found.append(f"{type(error).__name__}: {error}"[:300])
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Test all writers and print the outcome of each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", action="store_true", help="commands as well as functions")
    parser.add_argument("--page", type=Path, help="path of a Markdown page to write")
    parser.add_argument("--only", default="", help="only writers whose name contains this text")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    can_mount = sys.platform == "linux" and os.geteuid() == 0
    lines = [
        "| writer | limit of file size | full disk | full temporary disk |",
        "| --- | --- | --- | --- |",
    ]
    wrong = 0
    for writer in [*writers(), *(commands() if options.commands else [])]:
        if options.only not in writer.name:
            continue
        found = trial(writer, can_mount=can_mount)
        good = ("refused", "refused", "written")
        told = [each or right for each, right in zip(found, good, strict=True)]
        wrong += any(each not in ("", "not tried") for each in found)
        lines.append(f"| {writer.name} | {' | '.join(told)} |")
        print(lines[-1], flush=True)
    print(f"{wrong} of {len(lines) - 2} went wrong")
    if options.page:
        intro = (
            "# Full disks\n\nMade by `make disks`. Each writing function and command overwrites "
            "its own earlier files. *Refused*: one error names a file and the reason, every "
            "earlier file is unchanged, and no other file is left. *Written*: the folder for "
            "temporary files is not used.\n\n"
        )
        options.page.write_text(intro + "\n".join(lines) + "\n", encoding="utf-8")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
