"""The commands of ``napari-hmrf``: what is typed, and what is printed."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import napari_hmrf
from napari_hmrf.errors import HmrfError, in_words
from napari_hmrf.samples.demo import SAMPLE_SIZE
from napari_hmrf.samples.head import SAMPLE_SIZE as VOLUME_SIZE
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, SMALLEST
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.model_names import ModelName
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.priors.elastic import POISSON_RANGE, Plane
from napari_hmrf.study.models import chosen, family_of
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON

if TYPE_CHECKING:
    from napari_hmrf.contributions import LayerData
    from napari_hmrf.solver.solution import Solution


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        What was typed after ``napari-hmrf``; by default what was typed.

    Returns
    -------
    int
        The exit code: 0 if all went well, 1 if not, 130 if it was interrupted.
    """
    options = _parser().parse_args(arguments)
    try:
        return _COMMANDS[options.command](options)
    except KeyboardInterrupt:
        _tell("interrupted")
        return 130
    except (HmrfError, OSError) as error:
        _tell(f"napari-hmrf: {in_words(error)}")
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="napari-hmrf",
        description="How soft tissue moves, computed on the pixels of an image.",
    )
    parser.add_argument(
        "--version", action="version", version=f"napari-hmrf {napari_hmrf.__version__}"
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser(
        "demo", help="deform a sample, draw it, and open it in napari where there is a display"
    )
    which = demo.add_mutually_exclusive_group()
    which.add_argument(
        "--phantom", choices=PHANTOM_NAMES, default=PHANTOM_NAMES[0], help="default: %(default)s"
    )
    which.add_argument(
        "--volume", action="store_true", help="a head, in which a tumour grows, as a volume"
    )
    demo.add_argument(
        "--model",
        choices=[name.replace(", ", "-") for name in get_args(ModelName)],
        default="elastic",
        help="what tissue is taken to be: elastic, the paper's Markov random field by its "
        "schedule, or that field converged (default: %(default)s). What the paper's schedule makes "
        "of it is printed beside it",
    )
    low, high = POISSON_RANGE
    demo.add_argument(
        "--poisson",
        type=_poisson,
        metavar="NU",
        help=f"of elastic tissue: Poisson's ratio, {low:g} to {high:g} (default: {USUAL_POISSON})",
    )
    demo.add_argument(
        "--plane",
        choices=get_args(Plane),
        help="of elastic tissue: a thin slice, free to bulge (stress, the default), or one held "
        "between its neighbours (strain)",
    )
    demo.add_argument(
        "--size",
        type=_size,
        metavar="N",
        help=f"pixels along each side (default: {SAMPLE_SIZE}, the size with a finite-element "
        f"field; of a volume from front to back: {VOLUME_SIZE}, voxels of 2 mm)",
    )
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("demo-output"),
        metavar="DIR",
        help="where the pictures and the result go (default: %(default)s)",
    )
    demo.add_argument(
        "--backend",
        choices=BACKEND_NAMES,
        default="auto",
        help="default: what napari takes (%(default)s): the shaders on a GPU, else the loops for "
        "the processor, which are compiled first, once on a machine",
    )
    demo.add_argument("--no-window", action="store_true", help="do not open napari")
    commands.add_parser("selftest", help="report what this runs on, and check it: for a bug report")
    _add_file_commands(commands)
    return parser


def _add_file_commands(commands: Any) -> None:
    export = commands.add_parser("export", help="write a result's field for other tools")
    export.add_argument("result", type=Path, metavar="RESULT", help="a saved result, or a study")
    export.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help="ends in .nii.gz, .mha, .nrrd, or, of a field for images, .h5: where what is seen "
        "came from, in mm, LPS",
    )
    export.add_argument(
        "--forward",
        action="store_true",
        help="write where tissue goes: to move points, not images",
    )
    apply = commands.add_parser("apply", help="move images, labels or landmarks by a field")
    apply.add_argument(
        "field", type=Path, metavar="FIELD", help="a result, a study, or another tool's field"
    )
    apply.add_argument("files", type=Path, nargs="+", metavar="FILE")
    apply.add_argument("--labels", action="store_true", help="the images are labels")
    apply.add_argument("-o", "--out", type=Path, default=Path("moved"), metavar="DIR")
    measure = commands.add_parser("measure", help="print what happened to each tissue")
    measure.add_argument("result", type=Path, metavar="RESULT", help="a study, or a saved result")
    measure.add_argument("--labels", type=Path, help="an image of labels, if not the study's own")
    measure.add_argument("-o", "--out", type=Path, metavar="TABLE", help="a .csv to write as well")
    play = commands.add_parser("play", help="write the image as it moves: a .gif or .mp4")
    play.add_argument("result", type=Path, metavar="RESULT", help="a study, or a saved result")
    play.add_argument("out", type=Path, metavar="OUT")
    play.add_argument("--image", type=Path, help="if not the study's own")
    solve = commands.add_parser("solve", help="solve a study, or images with their tables")
    solve.add_argument("image", type=Path, metavar="STUDY|IMAGE")
    solve.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    solve.add_argument("--labels", type=Path, help="an image of tissue labels")
    solve.add_argument(
        "--maps",
        type=Path,
        nargs="+",
        default=(),
        metavar="MAP",
        help="instead: how likely tissue 1, 2 ... is, an image for each",
    )
    solve.add_argument(
        "--materials", type=Path, metavar="TABLE", help=".csv: label,name,stiffness,poisson"
    )
    solve.add_argument(
        "--boundary",
        type=Path,
        metavar="FILE",
        help="an image of labels with --rules, pairs of landmarks (.csv), or a field",
    )
    solve.add_argument(
        "--rules",
        type=Path,
        metavar="TABLE",
        help=".csv: label,action,row,col,amount,confidence; actions are fixed, move and expand",
    )
    solve.add_argument(
        "--confidence",
        metavar="IMAGE|edges",
        help="how sure a field is: an image from 0 to 1, a mask, or where the image has edges",
    )
    solve.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="of a volume only this slice along its first axis; by default all of it",
    )
    solve.add_argument(
        "--hold-edge", action="store_true", help="the outer edge of the tissue stays"
    )
    solve.add_argument("--model", choices=get_args(ModelName), help="default: elastic")
    solve.add_argument("--backend", choices=BACKEND_NAMES, default="auto")
    replay = commands.add_parser("replay", help="solve a saved study again, and compare the fields")
    replay.add_argument("study", type=Path, metavar="STUDY")
    replay.add_argument("--image", type=Path, metavar="IMAGE", help="if it is not in the file")


def _size(text: str) -> int:
    try:
        size = int(text)
    except ValueError:
        size = 0
    if size < SMALLEST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {SMALLEST}")
    return size


def _poisson(text: str) -> float:
    low, high = POISSON_RANGE
    try:
        poisson = float(text)
    except ValueError:
        poisson = -1.0
    if not low <= poisson <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
    return poisson


def _model(options: argparse.Namespace) -> tuple[Prior, Optimizer]:
    """The energy asked for, and how it is minimised."""
    name = next(name for name in get_args(ModelName) if name.replace(", ", "-") == options.model)
    prior, optimizer = chosen(name)
    if isinstance(prior, ElasticPrior):
        nu = USUAL_POISSON if options.poisson is None else options.poisson
        return ElasticPrior(nu, plane=options.plane or "stress"), optimizer
    if options.poisson is not None or options.plane is not None:
        raise HmrfError("--poisson and --plane are for --model elastic: the paper's has neither")
    return prior, optimizer


def _selftest(_: argparse.Namespace) -> int:
    from napari_hmrf.samples.selftest import selftest

    return 0 if selftest(lambda line: print(line, flush=True)) else 1


def _export(options: argparse.Namespace) -> int:
    from napari_hmrf.io.apply import load_field, save_field

    print(save_field(options.out, load_field(options.result), forward=options.forward))
    return 0


def _apply(options: argparse.Namespace) -> int:
    from napari_hmrf.io.apply import apply_field, load_field

    names = [file.name for file in options.files]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise HmrfError(
            f"{twice} is the name of two files, of which one would be written over the other. "
            "Move them one after the other, with another --out for each"
        )
    field = load_field(options.field)
    options.out.mkdir(parents=True, exist_ok=True)
    failed = 0
    for file in options.files:
        try:
            written = apply_field(field, file, options.out / file.name, labels=options.labels)
            print(f"written: {written}", flush=True)
        except (HmrfError, OSError) as error:
            failed += 1
            _tell(f"napari-hmrf: {in_words(error)}")
    return int(failed > 0)


def _measure(options: argparse.Namespace) -> int:
    from pandas import DataFrame

    from napari_hmrf.io.case import measured
    from napari_hmrf.io.tables import measurement_titles, save_measurements

    found = measured(options.result, options.labels)
    table = DataFrame(found.rows, columns=measurement_titles(volume=found.of_volume))
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    if options.out is not None:
        path = save_measurements(options.out, found.rows, found.unit, volume=found.of_volume)
        print(f"written: {path}")
    return 0


def _play(options: argparse.Namespace) -> int:
    from napari_hmrf.io.case import image_of
    from napari_hmrf.io.moving_pictures import save_moving_picture

    solution, image = image_of(options.result, options.image)
    print(f"written: {save_moving_picture(options.out, solution, image)}")
    return 0


def _solve(options: argparse.Namespace) -> int:
    from napari_hmrf.io.case import Case, notes_on, solve_case

    sure = options.confidence
    case = Case(
        image=options.image,
        labels=options.labels,
        materials=options.materials,
        maps=options.maps,
        boundary=options.boundary,
        rules=options.rules,
        confidence=sure if sure in (None, "edges") else Path(sure),
        slice=options.slice,
        hold_edge=options.hold_edge,
        model=options.model,
    )
    saved = solve_case(case, options.out, backend=options.backend)
    print(f"solved: {saved.solution!r}")
    for note in notes_on(saved):
        print(f"note: {note}")
    written = ", ".join(sorted(path.name for path in options.out.iterdir()))
    print(f"in {options.out}: {written}")
    return 0


def _replay(options: argparse.Namespace) -> int:
    from napari_hmrf.io.images import load_image
    from napari_hmrf.io.study_file import load_study, replay

    image = None if options.image is None else load_image(options.image).pixels
    study, before = load_study(options.study, image=image)
    if image is not None and study.pictures.image is not image:
        raise HmrfError(f"{options.study.name} holds its own image. Leave out --image.")
    now = replay(options.study, image=image)
    print(f"solved: {now!r}")
    if before is None:
        print("the study was saved without its field, so there is none to compare with")
        return 0
    # What is no tissue of the study's has no field in its file, which keeps float32.
    again = now.displacement.astype(before.displacement.dtype)
    far = abs(again - before.displacement)[before.tissue] / before.spacing
    apart, allowed = float(far.max(initial=0)), 0.0
    for each in (now, before):
        allowed += 0.0 if each.convergence is None else each.convergence.error
    if apart == 0:
        said = "bit by bit the same field"
    elif apart <= allowed:
        said = (
            f"the same field within its tolerance: at most {apart:.2g} px apart, where "
            f"{allowed:.2g} px may be (last digits are others of one that followed a "
            "hand, or was found while loops were still being compiled)"
        )
    else:
        said = f"fields differ by at most {apart:.3g} px"
    print(f"{said}; saved from {before.provenance.backend}")
    return int(apart > allowed and now.provenance.backend == before.provenance.backend)


def _demo(options: argparse.Namespace) -> int:
    from napari_hmrf.contributions import phantom_layers
    from napari_hmrf.samples.demo import demonstrate, table, write_results

    if options.volume:
        return _demo_volume(options)
    models = [_model(options)]
    if models[0] != chosen("paper"):
        models.append(chosen("paper"))
    # Before the work, so that it is not done in vain.
    options.out.mkdir(parents=True, exist_ok=True)
    progress = _ProgressLine()
    demonstrations = [
        demonstrate(
            options.phantom,
            options.size or SAMPLE_SIZE,
            backend=options.backend,
            progress=progress.show,
            prior=prior,
            optimizer=optimizer,
        )
        for prior, optimizer in models
    ]
    progress.end()
    print(table(*demonstrations), flush=True)
    demonstration = demonstrations[0]
    _tell("drawing ...")
    _tell_written(options, write_results(demonstration, options.out))
    layers = phantom_layers(demonstration.phantom)
    _show_in_napari(options, layers, demonstration.solution, models[0][0])
    return 0


def _demo_volume(options: argparse.Namespace) -> int:
    from napari_hmrf.contributions import volume_layers
    from napari_hmrf.samples.demo import table
    from napari_hmrf.samples.volume_demo import demonstrate_volume, write_volume_results

    prior, optimizer = _model(options)
    if options.plane is not None:
        raise HmrfError("--plane is for slices: a volume is strained in all directions")
    more = {"poisson": float(prior.poisson)} if isinstance(prior, ElasticPrior) else {}
    options.out.mkdir(parents=True, exist_ok=True)
    progress = _ProgressLine()
    demonstration = demonstrate_volume(
        options.size or VOLUME_SIZE,
        backend=options.backend,
        progress=progress.show,
        model=family_of(prior, optimizer),
        **more,
    )
    progress.end()
    print(table(demonstration), flush=True)
    _tell("drawing ...")
    _tell_written(options, write_volume_results(demonstration, options.out))
    layers = volume_layers(demonstration.head)
    _show_in_napari(options, layers, demonstration.solution, prior)
    return 0


def _tell_written(options: argparse.Namespace, written: Sequence[Path]) -> None:
    print(f"\nwritten to {options.out}: {', '.join(path.name for path in written)}", flush=True)


def _show_in_napari(
    options: argparse.Namespace, layers: Sequence[LayerData], solution: Solution, prior: Prior
) -> None:
    """Open napari, unless nobody wants it or may see it."""
    if options.no_window:
        return
    if _has_display():
        _tell("opening napari ...")
        _open_napari(layers, solution, prior)
    else:
        _tell("napari is not opened, as there is no display (or CI is set)")


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "apply": _apply,
    "demo": _demo,
    "export": _export,
    "measure": _measure,
    "play": _play,
    "replay": _replay,
    "selftest": _selftest,
    "solve": _solve,
}

# Seconds between two lines of progress where they stay.
_SELDOM = 10.0


class _ProgressLine:
    """Progress on stderr: one line that changes on a terminal, now and then a line elsewhere."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._shown = 0
        self._stage, self._told = "", 0.0

    def show(self, monitor: Monitor) -> None:
        line = f"{monitor.fraction:4.0%}  {monitor.message}"
        if self._live:
            sys.stderr.write("\r" + line.ljust(self._shown))
            sys.stderr.flush()
            self._shown = len(line)
            return
        stage, now = monitor.message.partition(" ")[0], time.monotonic()
        if stage in ("compiling", "preparing") and (
            stage != self._stage or now > self._told + _SELDOM
        ):
            _tell(line.strip())
            self._stage, self._told = stage, now

    def end(self) -> None:
        if self._live and self._shown:
            sys.stderr.write("\r" + " " * self._shown + "\r")
            sys.stderr.flush()


def _tell(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _has_display() -> bool:
    """Whether somebody may be there to see a window."""
    if os.environ.get("CI"):
        return False
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open_napari(layers: Sequence[LayerData], solution: Solution, prior: Prior) -> None:
    """Show a demonstration in napari, with the widget beside it, until the window is closed."""
    import napari
    from napari.layers import Layer

    viewer = napari.Viewer()
    for data, attributes, kind in layers:
        viewer.add_layer(Layer.create(data, attributes, kind))
    _, widget = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    widget.model = solution.provenance.model
    if isinstance(prior, ElasticPrior):
        widget.plane = prior.plane
        widget.materials = tuple(replace(row, poisson=prior.poisson) for row in widget.materials)
    # Solved again, so that the layers of the result are the widget's own, which it will update.
    widget.deform()
    napari.run()
