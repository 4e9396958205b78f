"""Running the commands of the shell, and their output."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_hmrf import commands
from napari_hmrf.augmentation.ground_truth import Truth, write_truth
from napari_hmrf.compute.compile_cache.loops import are_compiled
from napari_hmrf.compute.compile_cache.sets import EVERYTHING
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.errors import HmrfError, in_words
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.field.warp import has_volume_loops
from napari_hmrf.io.apply import apply_field, read_field_file, write_field_file
from napari_hmrf.io.batch import SUMMARY, solve_cases
from napari_hmrf.io.case import energy_of, solve_case
from napari_hmrf.io.case_options import Case, LabelledImage
from napari_hmrf.io.case_tables import read_cases
from napari_hmrf.io.fit_files import fit_file
from napari_hmrf.io.images import is_scan, read_image, result_suffix, stem_of, write_image
from napari_hmrf.io.moving_pictures import write_movie
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.registration_files import register_files
from napari_hmrf.io.results import estimate_uncertainty, image_of, labels_in, measured
from napari_hmrf.io.segmentation_tables import read_label_names
from napari_hmrf.io.study_file import read_study, replay
from napari_hmrf.io.tables import (
    measurement_table,
    write_measurements,
    write_named_materials,
)
from napari_hmrf.samples.demo import SAMPLE_SIZE, demonstrate, table, write_results
from napari_hmrf.samples.head import SAMPLE_SIZE as VOLUME_SIZE
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, SMALLEST
from napari_hmrf.samples.selftest import selftest
from napari_hmrf.samples.volume_demo import demonstrate_volume, write_volume_results
from napari_hmrf.solver.model_names import as_word
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.preparation import provide_loops
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.solution import SUM
from napari_hmrf.solver.solve import solve
from napari_hmrf.study.models import family_of, parts_of
from napari_hmrf.tissue.tissue_names import materials_by_name
from napari_hmrf.wording import in_shell_words

if TYPE_CHECKING:
    from napari_hmrf.contributions import LayerData
    from napari_hmrf.samples.demo import Demonstration
    from napari_hmrf.solver.solution import Solution


def run_and_report(options: Any) -> int:
    """Run a command, and print its errors.

    Parameters
    ----------
    options : dataclass
        One of `commands.COMMANDS`.

    Returns
    -------
    int
        Exit code: 0 on success, 1 on failure, 130 after an interrupt.
    """
    log, reworded = logging.getLogger("napari_hmrf"), _InShellWords()
    log.addFilter(reworded)
    try:
        return run(options)
    except KeyboardInterrupt:
        _report("interrupted")
        return 130
    except (HmrfError, OSError) as error:
        _report(f"napari-hmrf: {_in_shell(in_words(error))}")
        return 1
    finally:
        log.removeFilter(reworded)


@singledispatch
def run(options: Any) -> int:
    """Run a command, and return its exit code."""
    raise TypeError(f"{type(options).__name__} is not a command")


_OPTIONS = {option.name for command in commands.COMMANDS for option in fields(command)}


def _in_shell(message: str) -> str:
    """Name the settings in a message as in the shell."""
    return in_shell_words(message, _OPTIONS)


class _InShellWords(logging.Filter):
    """Logging filter that replaces Python names of settings with names of shell options."""

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = _in_shell(record.getMessage()), None
        return True


@run.register
def _selftest(_: commands.Selftest) -> int:
    return 0 if selftest(lambda line: print(line, flush=True)) else 1


@run.register
def _export(options: commands.Export) -> int:
    field = read_field_file(options.result)
    refuse_overwriting([options.out], overwrite=options.force)
    print(write_field_file(options.out, field, forward=options.forward))
    return 0


@run.register
def _apply(options: commands.Apply) -> int:
    moved = [options.out / _written_name(file) for file in options.files]
    _refuse_duplicates(moved)
    if options.out.is_dir():
        # If source and target are the same file, `apply_field` raises a more specific error.
        same = [
            source.samefile(target)
            for source, target in zip(options.files, moved, strict=True)
            if source.exists() and target.exists()
        ]
        if not any(same):
            refuse_overwriting(moved, overwrite=options.force)
    field = read_field_file(options.field)
    if len(field.shape) == 3 and not has_volume_loops():
        _report(f"{PREPARING} ...")
    options.out.mkdir(parents=True, exist_ok=True)
    failed = 0
    for file, target in zip(options.files, moved, strict=True):
        try:
            written = apply_field(
                field, file, target, labels=options.labels, resample=options.resample
            )
            print(f"written: {written.path}", flush=True)
            if written.note:
                _note(written.note)
        except (HmrfError, OSError) as error:
            failed += 1
            _report(f"napari-hmrf: {_in_shell(in_words(error))}")
    return int(failed > 0)


def _written_name(file: Path) -> str:
    """Return the name of a new version of a file: its own, but .nrrd for scans like DICOM."""
    return f"{stem_of(file)}{result_suffix(file)}" if is_scan(file) else file.name


def _refuse_duplicates(targets: Sequence[Path]) -> None:
    duplicate = next((each.name for each in targets if targets.count(each) > 1), None)
    if duplicate is not None:
        raise HmrfError(
            f"{duplicate} is the name of two files, so one result would overwrite the other. "
            "Use a separate command for each file, with different --out folders."
        )


@run.register
def _materials(options: commands.Materials) -> int:
    names = read_label_names(options.table)
    if options.out is not None:
        refuse_overwriting([options.out], overwrite=options.force)
    if options.labels is not None:
        labels = labels_in(options.labels)
        names = {label: names.get(label, "not in the table") for label in labels}
    materials = materials_by_name(names)
    print("\n".join(materials.described()))
    if options.out is not None:
        print(f"written: {write_named_materials(options.out, materials)}")
    return 0


@run.register
def _measure(options: commands.Measure) -> int:
    from pandas import DataFrame  # heavy: pandas

    if options.out is not None:
        refuse_overwriting([options.out], overwrite=options.force)
    with _shown_progress() as progress:
        measurement = measured(
            options.result,
            options.labels,
            uncertainty=options.uncertainty,
            resample=options.resample,
            progress=progress,
        )
    rows, is_volume = measurement.rows, measurement.of_volume
    titles, cells = measurement_table(rows, volume=is_volume)
    table = DataFrame(cells, columns=titles)
    print(table.to_string(index=False, float_format=_format_number))
    for note in measurement.notes:
        _note(note)
    if options.out is not None:
        path = write_measurements(options.out, rows, measurement.unit, volume=is_volume)
        print(f"written: {path}")
    return 0


@run.register
def _fit(options: commands.Fit) -> int:
    with _shown_progress() as progress:
        found = fit_file(
            options.study,
            options.out,
            second=options.second,
            stiffness=options.stiffness,
            growth=options.growth,
            poisson=options.poisson,
            load=options.load,
            backend=options.backend,
            overwrite=options.force,
            progress=progress,
        )
    for clause in found.described():
        print(f"fitted: {clause}")
    if found.agreement:
        print(f"agreement of the images: {found.agreement}")
    if options.out is not None:
        print(f"written: {options.out}")
    return 0


@run.register
def _uncertainty(options: commands.Uncertainty) -> int:
    with _shown_progress() as progress:
        estimated = estimate_uncertainty(
            options.study,
            options.out,
            n=options.samples,
            patch=options.patch,
            within=options.within,
            landmarks=options.landmarks,
            backend=options.backend,
            overwrite=options.force,
            progress=progress,
        )
    for clause in estimated.described():
        print(clause)
    for clause in estimated.landmarks.described() if estimated.landmarks else ():
        print(f"tested: {clause}")
    if estimated.note:
        _note(estimated.note)
    if estimated.paths:
        print(f"written: {', '.join(str(path) for path in estimated.paths)}")
    return 0


def _format_number(value: float) -> str:
    """Format a number with four significant digits, or all integer digits if it is large."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


@run.register
def _play(options: commands.Play) -> int:
    solution, image = image_of(options.result, options.image)
    refuse_overwriting([options.out], overwrite=options.force)
    number, shape = options.slice, solution.tissue.shape
    if len(shape) == 2 and number is not None:
        raise HmrfError(
            "--slice is only valid for volumes, but this result is a slice. Leave out --slice."
        )
    if len(shape) == 3:
        if number is None:
            number = shape[0] // 2
            _note(
                f"showing slice {number}, the middle of slices 0 to {shape[0] - 1}; use --slice to "
                "select another slice"
            )
        elif not 0 <= number < shape[0]:
            raise HmrfError(
                f"--slice is {number}, but the volume has slices 0 to {shape[0] - 1}. Choose one "
                "of these slices."
            )
    print(f"written: {write_movie(options.out, solution, image, number=number)}")
    return 0


@run.register
def _solve(options: commands.Solve) -> int:
    with _shown_progress() as progress:
        solved = solve_case(
            options,
            options.out,
            backend=options.backend,
            overwrite=options.force,
            progress=progress,
        )
    print(f"solved: {_described(solved.solution)}")
    for note in solved.notes:
        _note(note)
    written = ", ".join(sorted(path.name for path in options.out.iterdir()))
    print(f"in {options.out}: {written}")
    return 0


@run.register
def _register(options: commands.Register) -> int:
    for name in ("landmark_sd", "targets"):
        if getattr(options, name) is not None and options.landmarks is None:
            option = f"--{name.replace('_', '-')}"
            raise HmrfError(f"{option} requires --landmarks. Give --landmarks, or leave it out.")
    with _shown_progress() as progress:
        found = register_files(options, options.out, overwrite=options.force, progress=progress)
    report = found.report
    folds = "1 fold" if report["folds"] == 1 else f"{report['folds']} folds"
    sd = "" if report["sd"] is None else f", sd {report['sd']:g} {report['unit']}"
    before, after = report["similarity_before"], report["similarity_after"]
    digits = 2 if f"{before:.2f}" != f"{after:.2f}" else 4
    print(
        f"registered: similarity {before:.{digits}f} before and {after:.{digits}f} after{sd}, "
        f"{folds}, {report['seconds']:.1f} s"
    )
    for note in found.notes:
        _note(note)
    written = ", ".join(sorted(path.name for path in options.out.iterdir()))
    print(f"in {options.out}: {written}")
    return 0


@run.register
def _resample(options: commands.Resample) -> int:
    targets = [options.out / _written_name(file) for file in options.files]
    _refuse_duplicates(targets)
    refuse_overwriting(targets, overwrite=options.force)
    for file, target in zip(options.files, targets, strict=True):
        image = read_image(file, resample=True, labels=options.labels)
        if not image.resampled:
            raise HmrfError(f"the axes of {file.name} are at right angles. Use it as it is.")
        target.parent.mkdir(parents=True, exist_ok=True)
        print(f"written: {write_image(target, image)}", flush=True)
        _note(image.resampled)
    return 0


@run.register
def _batch(options: commands.Batch) -> int:
    if options.jobs is not None and options.scheduler is not None:
        raise HmrfError("--jobs has no effect with --scheduler. Leave one of them out.")
    line = _ProgressLine()
    cases = read_cases(options.cases)
    count = "1 case" if len(cases) == 1 else f"{len(cases)} cases"
    line.write(count)  # the first case can take a long time, because loops may be compiled first
    outcomes = solve_cases(
        cases,
        options.out,
        jobs=options.jobs,
        scheduler=options.scheduler,
        resume=options.resume,
        backend=options.backend,
        progress=lambda progress: line.write(progress.words),
        report=_note,
    )
    line.end()
    failed = [each for each in outcomes if each.state != "done"]
    for each in failed[:_MAX_PRINTED]:
        _report(f"{each.case}: {each.error}")
    if len(failed) > _MAX_PRINTED:
        _report(f"and {len(failed) - _MAX_PRINTED} more")
    are = "case is" if len(outcomes) == 1 else "cases are"
    done = f"{len(outcomes) - len(failed)} of {len(outcomes)} {are} solved"
    print(f"{done}; see {options.out / SUMMARY} for all results")
    if noted := sum(bool(each.notes) for each in outcomes):
        _note(f"the summary contains warnings for {noted} of the cases, in the column notes")
    return int(bool(failed))


@run.register
def _replay(options: commands.Replay) -> int:
    image = None if options.image is None else read_image(options.image).pixels
    study, before = read_study(options.study, image=image)
    if image is not None and study.pictures.image is not image:
        raise HmrfError(f"{options.study.name} contains its own image. Leave out --image.")
    with _shown_progress() as progress:
        now = replay(options.study, image=image, progress=progress)
    print(f"solved: {_described(now)}")
    if before is None:
        print("the study was saved without its field, so there is no field to compare with")
        return 0
    # The file stores float32 values, and only the displacement of tissue.
    again = now.displacement.astype(before.displacement.dtype)
    differences = abs(again - before.displacement)[before.tissue] / before.spacing
    difference, allowed = float(differences.max(initial=0)), 0.0
    for each in (now, before):
        allowed += 0.0 if each.convergence is None else each.convergence.error
    if difference == 0:
        result = "the fields are bit-for-bit identical"
    elif difference <= allowed:
        result = (
            f"the same field within its tolerance: the fields differ by at most {difference:.2g} "
            f"px, and {allowed:.2g} px is allowed (the last digits differ if a field was updated "
            "live, or was solved while loops were still being compiled)"
        )
    else:
        result = (
            f"the fields differ by at most {difference:.3g} px, but {allowed:.2g} px is allowed"
        )
    backend = before.provenance.backend
    origin = "a sum of solutions" if backend == SUM else f"solved on {backend}"
    print(f"{result}; the saved field was {origin}")
    return int(difference > allowed and backend in (SUM, now.provenance.backend))


def _described(solution: Solution) -> str:
    """Return a one-line description of a solution, with the model named as in the shell."""
    model = solution.provenance.model
    return repr(solution).replace(f", {model}, ", f", {as_word(model)}, ", 1)


@run.register
def _truth(options: commands.Truth) -> int:
    def report(truth: Truth) -> None:
        progress.end()
        part = "" if truth.scale == 1 else f", scaled to {truth.scale:.0%}"
        moved = f"moved up to {truth.farthest:.3g} {unit_symbol(truth.unit)}{part}"
        print(f"written: {truth.folder} ({moved})", flush=True)

    progress = _ProgressLine()
    given = {name: getattr(options, name) for name in ("amplitude", "patches", "weight")}
    write_truth(
        Case(**{each.name: getattr(options, each.name) for each in fields(LabelledImage)}),
        options.out,
        count=options.count,
        seed=options.seed,
        overwrite=options.force,
        progress=lambda done, of: progress.write(f"solved: {done} of {of}", "solving"),
        on_written=report,
        hold_edge=not options.free_edge,
        backend=options.backend,
        **{name: value for name, value in given.items() if value is not None},
    )
    print("field.mha maps each pixel of deformed.mha to its origin in image.mha")
    return 0


@run.register
def _demo(options: commands.Demo) -> int:
    if options.volume and options.phantom is not None:
        raise HmrfError("--phantom has no effect with --volume. Leave one of them out.")
    case = Case(Path(), model=options.model, poisson=options.poisson, plane=options.plane)
    prior, optimizer = energy_of(case, volume=options.volume)
    if options.volume:
        _demo_of_volume(options, prior, optimizer)
    else:
        _demo_of_image(options, prior, optimizer)
    return 0


def _demo_of_image(options: commands.Demo, prior: Prior, optimizer: Optimizer) -> None:
    size = options.size or SAMPLE_SIZE
    if size < SMALLEST:
        raise HmrfError(f"--size is {size}. Give a whole number of at least {SMALLEST}.")
    models = [(prior, optimizer)]
    if models[0] != parts_of("paper"):
        models.append(parts_of("paper"))
    folder, progress = _make_demo_folder(options), _ProgressLine()
    shown, *others = [
        demonstrate(
            options.phantom or PHANTOM_NAMES[0],
            size,
            backend=options.backend,
            progress=progress.show,
            prior=prior,
            optimizer=optimizer,
        )
        for prior, optimizer in models
    ]
    progress.end()
    print(table(shown, *others), flush=True)
    _report_written(folder, lambda: write_results(shown, folder))

    def layers() -> Sequence[LayerData]:
        from napari_hmrf.contributions import phantom_layers  # heavy: napari

        return phantom_layers(shown.phantom)

    if not _show_in_napari(options, layers, shown.solution, prior):
        _compile_loops(options, shown, prior, optimizer)
    _suggest_next_steps()


def _demo_of_volume(options: commands.Demo, prior: Prior, optimizer: Optimizer) -> None:
    more = {"poisson": float(prior.poisson)} if isinstance(prior, Elastic) else {}
    folder, progress = _make_demo_folder(options), _ProgressLine()
    shown = demonstrate_volume(
        options.size or VOLUME_SIZE,
        backend=options.backend,
        progress=progress.show,
        model=family_of(prior, optimizer),
        **more,
    )
    progress.end()
    print(table(shown), flush=True)
    if shown.note:
        _note(shown.note)
    _report_written(folder, lambda: write_volume_results(shown, folder))

    def layers() -> Sequence[LayerData]:
        from napari_hmrf.contributions import volume_layers  # heavy: napari

        return volume_layers(shown.head)

    _show_in_napari(options, layers, shown.solution, prior)


def _compile_loops(
    options: commands.Demo,
    demonstration: Demonstration,
    prior: Prior,
    optimizer: Optimizer | None,
) -> None:
    """Compile the loops, and solve again to show the time that the compiled loops take."""
    if options.backend != "auto" or are_compiled(EVERYTHING):
        return
    _report(
        f"{PREPARING} (all results have been written, and what has been prepared is kept, so it "
        "is safe to stop with Ctrl-C)"
    )
    progress = _ProgressLine()
    provide_loops(EVERYTHING, progress.show)
    progress.end()
    again = solve(demonstration.phantom.problem, prior, optimizer=optimizer)
    seconds = again.provenance.seconds
    print(f"prepared; the same solve now takes {seconds:.2g} s ({again.provenance.backend})")


def _suggest_next_steps() -> None:
    """Print suggestions for further commands after a demonstration."""
    folder = Path(sys.executable).parent
    if folder.is_relative_to(Path.cwd()):
        folder = folder.relative_to(Path.cwd())
    napari, here = folder / "napari", folder / "napari-hmrf"
    print("\nnext, try:")
    print(f"  {napari}  (then File > Open Sample > napari-hmrf, and drag the tissue)")
    print(f"  {here} demo --volume  (a head with a growing tumour)")
    print(f"  {here} solve --help  (your own image)", flush=True)


def _make_demo_folder(options: commands.Demo) -> Path:
    """Create the output folder of a demonstration, and return it.

    Without --force, an existing folder is overwritten only if it is the default folder.
    """
    folder = Path("demo-output") if options.out is None else options.out
    has_files = folder.is_dir() and any(folder.iterdir())
    if has_files and options.out is None:
        _note(f"an earlier demo in {folder} is overwritten")
    elif has_files and not options.force:
        raise HmrfError(
            f"{folder} already exists and is not empty. Give another folder, or add --force to "
            "overwrite its files."
        )
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _report_written(folder: Path, write: Callable[[], Sequence[Path]]) -> None:
    """Write the results of a demonstration, and print the names of the files."""
    _report("drawing ...")
    written = ", ".join(path.name for path in write())
    print(f"\nwritten to {folder}: {written}", flush=True)


def _show_in_napari(
    options: commands.Demo,
    layers: Callable[[], Sequence[LayerData]],
    solution: Solution,
    prior: Prior,
) -> bool:
    """Show a demonstration in napari, if requested and possible; return whether it was shown."""
    if options.no_window:
        return False
    if not _has_display():
        _report("napari is not opened, because there is no display or the variable CI is set")
        return False
    _report("opening napari ...")
    _open_napari(layers(), solution, prior)
    return True


# Time between progress lines, in seconds, if stderr is not a terminal.
_INTERVAL = 10.0
# Largest number of failed cases to print; the summary lists all failed cases.
_MAX_PRINTED = 10


class _ProgressLine:
    """Progress display on stderr.

    On a terminal, a single line is updated. Otherwise, new lines are printed at intervals.

    Parameters
    ----------
    stages : sequence of str
        If stderr is not a terminal, only messages that begin with one of these texts are printed.
    """

    def __init__(self, stages: Sequence[str] = (PREPARING, "preparing")) -> None:
        self._live, self._stages = sys.stderr.isatty(), stages
        self._shown = 0
        self._stage, self._last_time = "", 0.0

    def show(self, monitor: Monitor) -> None:
        line = f"{monitor.fraction:4.0%}  {monitor.message}"
        stage = next((each for each in self._stages if monitor.message.startswith(each)), "")
        if self._live or stage:
            self.write(line, stage)

    def write(self, line: str, stage: str = "") -> None:
        if self._live:
            sys.stderr.write("\r" + line.ljust(self._shown))
            sys.stderr.flush()
            self._shown = len(line)
            return
        now = time.monotonic()
        if stage != self._stage or now > self._last_time + _INTERVAL:
            _report(line.strip())
            self._stage, self._last_time = stage, now

    def end(self) -> None:
        if self._live and self._shown:
            sys.stderr.write("\r" + " " * self._shown + "\r")
            sys.stderr.flush()


@contextmanager
def _shown_progress() -> Iterator[Callable[[Monitor], None]]:
    """Yield a callback that shows the progress of a solve.

    If stderr is not a terminal, only the preparation of the computer is reported.
    """
    line = _ProgressLine(stages=(PREPARING,))
    try:
        yield line.show
    finally:
        line.end()


def _note(clause: str) -> None:
    """Print a note, with settings named as in the shell."""
    print(f"note: {_in_shell(clause)}", flush=True)


def _report(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _has_display() -> bool:
    """Return whether a display is available for a window."""
    if os.environ.get("CI"):
        return False
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open_napari(layers: Sequence[LayerData], solution: Solution, prior: Prior) -> None:
    """Show a demonstration in napari with the dock widget, and wait until the window is closed."""
    import napari  # heavy: napari
    from napari.layers import Layer  # heavy: napari

    viewer = napari.Viewer()
    for data, attributes, kind in layers:
        viewer.add_layer(Layer.create(data, attributes, kind))
    _, widget = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    widget.model = solution.provenance.model
    if isinstance(prior, Elastic):
        widget.plane = prior.plane
        widget.materials = tuple(replace(row, poisson=prior.poisson) for row in widget.materials)
    # Solve again in the widget, because it only updates result layers that it has created.
    widget.deform()
    napari.run()
