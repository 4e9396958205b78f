"""What can be typed after ``napari-hmrf``: its commands and their options."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

import napari_hmrf
from napari_hmrf.samples.demo import SAMPLE_SIZE
from napari_hmrf.samples.head import SAMPLE_SIZE as VOLUME_SIZE
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, SMALLEST
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.model_names import MODELS, as_word
from napari_hmrf.solver.priors.elastic import POISSON_RANGE, Plane
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON


def parser_of_commands() -> argparse.ArgumentParser:
    """The parser of all commands; which of them was typed is its `command`."""
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
        type=as_word,
        choices=MODELS,
        default="elastic",
        help="what tissue is taken to be: elastic, elastic for large motion, the paper's Markov "
        "random field by its schedule, or that field converged (default: %(default)s). What the "
        "paper's schedule makes of it is printed beside it",
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
    _add_tissue(solve)
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
        help=".csv: label,action,row,col,amount,confidence; actions are fixed, move, "
        "expand, and press and pull, which are forces",
    )
    solve.add_argument(
        "--confidence",
        metavar="IMAGE|edges",
        help="how sure a field is: an image from 0 to 1, a mask, or where the image has edges",
    )
    _add_slice(solve)
    solve.add_argument(
        "--hold-edge", action="store_true", help="the outer edge of the tissue stays"
    )
    solve.add_argument("--model", type=as_word, choices=MODELS, help="default: elastic")
    solve.add_argument("--backend", choices=BACKEND_NAMES, default="auto")
    _add_many_commands(commands)
    replay = commands.add_parser("replay", help="solve a saved study again, and compare the fields")
    replay.add_argument("study", type=Path, metavar="STUDY")
    replay.add_argument("--image", type=Path, metavar="IMAGE", help="if it is not in the file")
    _add_truth(commands)


def _add_tissue(command: argparse.ArgumentParser) -> None:
    """What says which tissue is where."""
    command.add_argument("--labels", type=Path, help="an image of tissue labels")
    command.add_argument(
        "--maps",
        type=Path,
        nargs="+",
        default=(),
        metavar="MAP",
        help="instead: how likely tissue 1, 2 ... is, an image for each",
    )
    command.add_argument(
        "--materials",
        type=Path,
        metavar="TABLE",
        help=".csv: label,name,stiffness,poisson,growth; a growth of 0.2 or 20%% is a fifth "
        "longer; or what a segmentation calls its labels, as for the command materials",
    )


def _add_slice(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="of a volume only this slice along its first axis; by default all of it",
    )


def _add_truth(commands: Any) -> None:
    truth = commands.add_parser(
        "truth",
        help="deform an image at random by a field that is known, to validate a registration",
    )
    truth.add_argument("image", type=Path, metavar="STUDY|IMAGE")
    _add_tissue(truth)
    _add_slice(truth)
    truth.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    truth.add_argument("--count", type=int, default=1, metavar="N", help="pairs; default: 1")
    truth.add_argument("--seed", type=int, default=0, metavar="S", help="default: 0")
    truth.add_argument(
        "--amplitude",
        type=_lengths,
        metavar="A|LOW-HIGH",
        help="how far tissue is pulled where it is pulled farthest, or from where to where, in mm, "
        "or in pixels of what has no size; by default from nothing to a quarter of how far its "
        "pulls lie apart, in a volume an eighth",
    )
    truth.add_argument(
        "--patches",
        type=int,
        metavar="P",
        help="places where tissue is pulled (default: 12, in a volume 8)",
    )
    truth.add_argument(
        "--weight",
        type=float,
        metavar="W",
        help="how much pulls at all tissue in a random direction, as its own weight does, at most; "
        "in the unit of stiffness per mm, or per pixel (water in kPa: 0.00981; default: 0)",
    )
    truth.add_argument(
        "--free-edge",
        action="store_false",
        dest="hold_edge",
        help="the outer edge of the tissue moves, too; by default it stays",
    )
    truth.add_argument("--backend", choices=BACKEND_NAMES, default="auto")


def _add_many_commands(commands: Any) -> None:
    materials = commands.add_parser(
        "materials", help="find stiffness by what a segmentation calls its labels"
    )
    materials.add_argument(
        "table",
        type=Path,
        metavar="TABLE",
        help="TotalSegmentator's class map or dataset.json, FreeSurferColorLUT.txt, label "
        "descriptions of ITK-SNAP, a colour table or .seg.nrrd of 3D Slicer, or a .csv: label,name",
    )
    materials.add_argument(
        "--labels", type=Path, metavar="IMAGE", help="only what is in this image"
    )
    materials.add_argument(
        "-o", "--out", type=Path, metavar="TABLE", help="a .csv to write as well"
    )

    batch = commands.add_parser("batch", help="solve many cases, by several processes or machines")
    batch.add_argument(
        "cases",
        type=Path,
        metavar="CASES",
        help=".csv, a case a line: name, image or study, and the options of solve; growth:TISSUE, "
        "stiffness:TISSUE, amount:BOUNDARY and poisson are numbers other than in its files. "
        "Several values in a cell, with semicolons between them, are a case each; a slice may be "
        "3-7, or all",
    )
    batch.add_argument("out", type=Path, metavar="OUT", help="a folder for a folder of each case")
    where = batch.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=_count, metavar="N", help="processes, of one thread each (default: cores)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="of dask.distributed, or its file; default: none"
    )
    batch.add_argument("--resume", action="store_true", help="do only what is not finished")
    batch.add_argument("--backend", choices=BACKEND_NAMES, default="cpu")


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def _lengths(text: str) -> float | tuple[float, float]:
    """A length, or two with a dash between them."""
    try:
        return float(text)
    except ValueError:
        pass
    low, _, high = text.partition("-")
    try:
        return float(low), float(high)
    except ValueError:
        said = f"{text!r} is not a length such as 3, or two such as 1-4"
        raise argparse.ArgumentTypeError(said) from None


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
