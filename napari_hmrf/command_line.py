"""Commands of ``napari-hmrf`` and their options."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

import napari_hmrf
from napari_hmrf.io.option_types import (
    count_option,
    energy_option,
    lengths_option,
    poisson_option,
    size_option,
)
from napari_hmrf.samples.demo import SAMPLE_SIZE
from napari_hmrf.samples.head import SAMPLE_SIZE as VOLUME_SIZE
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, SMALLEST
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.model_names import MODELS, as_word
from napari_hmrf.solver.priors.elastic import POISSON_RANGE, Plane
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON


class Commands:
    """Commands of a parser, each with a one-sentence description and an example."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(
        self, name: str, sentence: str, example: str, more: str = ""
    ) -> argparse.ArgumentParser:
        """Add a command.

        Parameters
        ----------
        name : str
        sentence : str
            Sentence in the imperative; the list of commands shows it without the period.
        example : str
            A complete command line.
        more : str
            Sentences that only the help of the command shows.
        """
        command: argparse.ArgumentParser = self._commands.add_parser(
            name,
            help=f"{sentence[0].lower()}{sentence[1:].rstrip('.')}",
            description=f"{sentence} {more}".strip(),
            epilog=f"example: {example}",
            formatter_class=_Formatter,
        )
        return command


class _Formatter(argparse.HelpFormatter):
    """Help formatter that keeps the example on one line, to be copied."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example: ") else super()._fill_text(text, width, indent)


def parser_of_commands() -> argparse.ArgumentParser:
    """Return the parser of all commands; it stores the name of the command as `command`."""
    parser = argparse.ArgumentParser(
        prog="napari-hmrf",
        description="Compute the motion of soft tissue on the pixels of an image.",
        epilog="napari-hmrf COMMAND --help explains a command and has an example.",
    )
    parser.add_argument(
        "--version", action="version", version=f"napari-hmrf {napari_hmrf.__version__}"
    )
    commands = Commands(parser)
    demo = commands.add(
        "demo",
        "Deform a sample, draw it, and open it in napari where there is a display.",
        "napari-hmrf demo --phantom mass-effect --no-window",
        "It prints a table, and writes pictures and the result to a folder.",
    )
    which = demo.add_mutually_exclusive_group()
    which.add_argument(
        "--phantom",
        choices=PHANTOM_NAMES,
        default=PHANTOM_NAMES[0],
        help="sample to deform (default: %(default)s)",
    )
    which.add_argument(
        "--volume", action="store_true", help="a head, in which a tumour grows, as a volume"
    )
    demo.add_argument(
        "--model",
        type=as_word,
        choices=MODELS,
        default="elastic",
        help="model of the tissue: elastic, elastic for large motion, the paper's Markov random "
        "field by its schedule, or that field converged (default: %(default)s). The result of the "
        "paper's schedule is printed beside it",
    )
    _add_material(demo)
    demo.add_argument(
        "--size",
        type=size_option(SMALLEST),
        metavar="N",
        help=f"pixels along each side (default: {SAMPLE_SIZE}, the size with a finite-element "
        f"field); for a volume, voxels from front to back (default: {VOLUME_SIZE}, of 2 mm)",
    )
    demo.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the pictures and the result (default: demo-output, where an earlier demo "
        "is written over)",
    )
    _add_force(demo)
    _add_backend(
        demo,
        "renderer: the shaders on a GPU, else the loops for the processor, which are compiled "
        "first, once on a machine (default: %(default)s)",
    )
    demo.add_argument("--no-window", action="store_true", help="do not open napari")
    commands.add(
        "selftest",
        "Report the machine and the renderers, and check their results.",
        "napari-hmrf selftest",
        "Its output belongs into a bug report, and names no folder and no user.",
    )
    _add_solve(commands)
    _add_result_commands(commands)
    _add_many_commands(commands)
    _add_truth(commands)
    return parser


def _add_result_commands(commands: Commands) -> None:
    export = commands.add(
        "export",
        "Write the field of a result for other tools.",
        "napari-hmrf export out/scan.study field.nii.gz",
        "ITK, SimpleITK, ANTs, elastix and 3D Slicer read it: vectors in mm, LPS.",
    )
    _add_result(export)
    export.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help="file that ends in .nii.gz, .mha, .nrrd, or, for a field that moves images, .h5",
    )
    export.add_argument(
        "--forward",
        action="store_true",
        help="write where tissue goes, which moves points; by default the field leads to where the "
        "pixels came from, which moves images",
    )
    _add_force(export)
    apply = commands.add(
        "apply",
        "Move images, labels or landmarks by a field.",
        "napari-hmrf apply out/scan.study channel.tif landmarks.csv -o moved",
    )
    apply.add_argument(
        "field",
        type=Path,
        metavar="FIELD",
        help="study with its field, saved result, or field of another tool",
    )
    apply.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="image of the pixels of the field, or landmarks (.csv, .mrk.json, .fcsv)",
    )
    apply.add_argument(
        "--labels", action="store_true", help="the images are labels, not to be interpolated"
    )
    apply.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("moved"),
        metavar="DIR",
        help="folder for files of the same names (default: %(default)s)",
    )
    _add_force(apply)
    measure = commands.add(
        "measure",
        "Print how far each tissue moved, and how its size and shape changed.",
        "napari-hmrf measure out/scan.study -o measurements.csv",
    )
    _add_result(measure)
    measure.add_argument(
        "--labels", type=Path, metavar="IMAGE", help="image of labels (default: the study's own)"
    )
    measure.add_argument("-o", "--out", type=Path, metavar="TABLE", help=".csv to write as well")
    _add_force(measure)
    play = commands.add(
        "play",
        "Write the image as it moves, there and back, as a .gif or .mp4.",
        "napari-hmrf play out/scan.study scan.gif",
    )
    _add_result(play)
    play.add_argument("out", type=Path, metavar="OUT", help="file that ends in .gif or .mp4")
    play.add_argument(
        "--image", type=Path, metavar="IMAGE", help="image to move (default: the study's own)"
    )
    play.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="slice of a volume along its first axis (default: the middle one)",
    )
    _add_force(play)
    replay = commands.add(
        "replay",
        "Solve a saved study again, and compare the fields.",
        "napari-hmrf replay out/scan.study",
        "The exit code is 1 if they differ by more than the tolerance.",
    )
    replay.add_argument("study", type=Path, metavar="STUDY", help="study with its field")
    replay.add_argument(
        "--image", type=Path, metavar="IMAGE", help="image of the study, if its file has none"
    )


def _add_solve(commands: Commands) -> None:
    solve = commands.add(
        "solve",
        "Solve a study, or an image with its tables.",
        "napari-hmrf solve scan.png --boundary rim.png --rules rules.csv -o out",
        "The folder gets the study with its field, and the deformed image. A study needs no other "
        "option.",
    )
    solve.add_argument(
        "image", type=Path, metavar="STUDY|IMAGE", help="saved study, or the image to deform"
    )
    solve.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    _add_force(solve)
    _add_tissue(solve)
    solve.add_argument(
        "--boundary",
        type=Path,
        metavar="FILE",
        help="how tissue moves: an image of labels with --rules, pairs of landmarks (.csv of "
        "BigWarp), or a field",
    )
    solve.add_argument(
        "--rules",
        type=Path,
        metavar="TABLE",
        help=".csv with the columns label,action,row,col,amount,confidence: a line for each label "
        "of --boundary; an action is fixed, move, expand, press or pull; the last two are forces",
    )
    solve.add_argument(
        "--forward",
        action="store_true",
        help="a field of --boundary leads to where tissue goes, though its file does not say so "
        "(default: to where the pixels came from, as registrations write it)",
    )
    solve.add_argument(
        "--confidence",
        metavar="IMAGE|edges",
        help="confidence in the field of --boundary: an image from 0 to 1, a mask, or the edges of "
        "the image",
    )
    _add_slice(solve)
    solve.add_argument(
        "--hold-edge", action="store_true", help="hold the outer edge of the tissue in place"
    )
    solve.add_argument(
        "--model", type=as_word, choices=MODELS, help="model of the tissue (default: elastic)"
    )
    _add_material(solve)
    solve.add_argument(
        "--tolerance",
        type=energy_option("tolerance"),
        metavar="PX",
        help="largest estimated error of the field, in pixels (default: 0.001); the model paper "
        "has none",
    )
    solve.add_argument(
        "--penalty",
        type=energy_option("penalty"),
        metavar="K",
        help="holding force beyond which boundaries slip (default: they are held exactly; in the "
        "paper's models large enough to hold)",
    )
    solve.add_argument(
        "--weight",
        type=energy_option("weight"),
        metavar="ROW/COL",
        help="force at each part of elastic tissue along each axis, in the unit of stiffness per "
        "length, such as 0.00981/0 for water in kPa and mm; before a minus write an equals sign: "
        "--weight=-0.01/0",
    )
    _add_backend(solve)


def _add_result(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "result", type=Path, metavar="RESULT", help="study with its field, or saved result"
    )


def _add_force(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--force", action="store_true", help="write over files that are there already"
    )


def _add_backend(
    command: argparse.ArgumentParser,
    what: str = "renderer (default: %(default)s)",
    usual: str = "auto",
) -> None:
    command.add_argument("--backend", choices=BACKEND_NAMES, default=usual, help=what)


def _add_material(command: argparse.ArgumentParser) -> None:
    """Add the parameters of elastic tissue."""
    low, high = POISSON_RANGE
    command.add_argument(
        "--poisson",
        type=poisson_option,
        metavar="NU",
        help=f"Poisson's ratio of all elastic tissue, {low:g} to {high:g} (default: "
        f"{USUAL_POISSON}, or that of each tissue in its table)",
    )
    command.add_argument(
        "--plane",
        choices=get_args(Plane),
        help="slice of elastic tissue: thin and free to bulge (stress, the default), or held "
        "between its neighbours (strain)",
    )


def _add_tissue(command: argparse.ArgumentParser) -> None:
    """Add the options that say where each tissue is."""
    command.add_argument("--labels", type=Path, metavar="IMAGE", help="image of tissue labels")
    command.add_argument(
        "--maps",
        type=Path,
        nargs="+",
        default=(),
        metavar="MAP",
        help="instead of --labels: an image of the likelihood of each tissue 1, 2 ...",
    )
    command.add_argument(
        "--materials",
        type=Path,
        metavar="TABLE",
        help="table with the columns label,name,stiffness,poisson,growth, where a growth of 0.2 or "
        "20%% is a fifth longer; or the names that a segmentation gives its labels, as for the "
        "command materials",
    )


def _add_slice(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="slice of a volume along its first axis (default: the whole volume)",
    )


def _add_truth(commands: Commands) -> None:
    truth = commands.add(
        "truth",
        "Deform an image by random fields that are known, to validate a registration.",
        "napari-hmrf truth scan.nii.gz --labels labels.nii.gz --materials tissue.csv -o truth "
        "--count 10",
    )
    truth.add_argument(
        "image",
        type=Path,
        metavar="STUDY|IMAGE",
        help="image with --labels or --maps, or a study that has them",
    )
    _add_tissue(truth)
    _add_slice(truth)
    truth.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for the image, its labels, and a folder 001, 002 ... of each pair",
    )
    _add_force(truth)
    truth.add_argument(
        "--count", type=int, default=1, metavar="N", help="number of pairs (default: %(default)s)"
    )
    truth.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="S",
        help="number that repeats the same pairs (default: %(default)s)",
    )
    truth.add_argument(
        "--amplitude",
        type=lengths_option,
        metavar="A|LOW-HIGH",
        help="largest pull of a pair, or its range, in mm, or in pixels if the image has no pixel "
        "size (default: from 0 to a quarter of the distance between pulls, in a volume an eighth)",
    )
    truth.add_argument(
        "--patches",
        type=int,
        metavar="P",
        help="number of places where tissue is pulled (default: 12, in a volume 8)",
    )
    truth.add_argument(
        "--weight",
        type=float,
        metavar="W",
        help="largest body force in a random direction, like the tissue's own weight, in the unit "
        "of stiffness per mm, or per pixel (water in kPa: 0.00981; default: 0)",
    )
    truth.add_argument(
        "--free-edge",
        action="store_false",
        dest="hold_edge",
        help="let the outer edge of the tissue move (default: it is held)",
    )
    _add_backend(truth)


def _add_many_commands(commands: Commands) -> None:
    materials = commands.add(
        "materials",
        "Find published stiffness by the names that a segmentation gives its labels.",
        "napari-hmrf materials FreeSurferColorLUT.txt --labels aseg.nii.gz -o materials.csv",
    )
    materials.add_argument(
        "table",
        type=Path,
        metavar="TABLE",
        help="TotalSegmentator's class map or dataset.json, FreeSurferColorLUT.txt, label "
        "descriptions of ITK-SNAP, a colour table or .seg.nrrd of 3D Slicer, or a .csv with the "
        "columns label,name",
    )
    materials.add_argument(
        "--labels", type=Path, metavar="IMAGE", help="list only the labels of this image"
    )
    materials.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="TABLE",
        help=".csv to write as well, to be corrected and given to --materials",
    )
    _add_force(materials)
    batch = commands.add(
        "batch",
        "Solve many cases from a table, by several processes or machines.",
        "napari-hmrf batch cases.csv out --jobs 4 --resume",
        "Each case gets a folder in OUT, and summary.csv a line. One batch at a time writes into a "
        "folder.",
    )
    batch.add_argument(
        "cases",
        type=Path,
        metavar="CASES",
        help=".csv with a line for each case and the columns name, image or study, and the options "
        "of solve; growth:TISSUE, stiffness:TISSUE, poisson:TISSUE, amount:BOUNDARY and poisson "
        "replace numbers of its files. Several values in a cell, with semicolons between them, are "
        "one case each; a slice may be 3-7, or all",
    )
    batch.add_argument(
        "out", type=Path, metavar="OUT", help="folder for summary.csv and a folder of each case"
    )
    where = batch.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=count_option,
        metavar="N",
        help="number of processes, of one thread each (default: one for each core)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address or file of a dask scheduler, whose workers solve the cases (default: none)",
    )
    batch.add_argument(
        "--resume",
        action="store_true",
        help="keep finished cases whose line and files are the same, and solve the others",
    )
    _add_backend(batch, usual="cpu")
