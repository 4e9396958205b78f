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
    """Subcommands of a parser, each with a one-sentence description and an example."""

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

        Returns
        -------
        argparse.ArgumentParser
            Parser of the command, for its options.
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
    """Help formatter that keeps the example on one line, so that the user can copy it."""

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
        "--volume", action="store_true", help="deform a volume: a head in which a tumour grows"
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
        "is overwritten)",
    )
    _add_force(demo)
    _add_backend(
        demo,
        "renderer: the shaders on a GPU, or else the loops on the CPU, which are compiled first, "
        "once per machine (default: %(default)s)",
    )
    demo.add_argument("--no-window", action="store_true", help="do not open napari")
    commands.add(
        "selftest",
        "Report the machine and the renderers, and check their results.",
        "napari-hmrf selftest",
        "Add its output to a bug report: it contains no names of folders or users.",
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
        help="write the forward field, which maps points to their new places (default: the "
        "backward field, which maps pixels to their origins and so moves images)",
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
        help="image on the pixel grid of the field, or landmarks (.csv, .mrk.json, .fcsv)",
    )
    apply.add_argument(
        "--labels", action="store_true", help="treat the images as labels: do not interpolate"
    )
    apply.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("moved"),
        metavar="DIR",
        help="folder for the moved files, which keep their names (default: %(default)s)",
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
    measure.add_argument(
        "-o", "--out", type=Path, metavar="TABLE", help="also write the table, as .csv"
    )
    _add_force(measure)
    play = commands.add(
        "play",
        "Write a movie of the image as it moves there and back, as .gif or .mp4.",
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
        "It writes the study with its field, and the deformed image. A saved study needs no option "
        "but --out.",
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
        help="boundary conditions: an image of labels with --rules, pairs of landmarks (.csv of "
        "BigWarp), or a displacement field",
    )
    solve.add_argument(
        "--rules",
        type=Path,
        metavar="TABLE",
        help=".csv with the columns label,action,row,col,amount,confidence and a line for each "
        "label of --boundary; the actions are fixed, move and expand, and press and pull, which "
        "are forces",
    )
    solve.add_argument(
        "--forward",
        action="store_true",
        help="read the field of --boundary as a forward field, from each point to its new place, "
        "even if its file does not say so (default: a backward field, as registrations write it)",
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
        help="holding force beyond which boundaries slip (default: boundaries are held exactly, or "
        "in the paper's models by a force that is large enough)",
    )
    solve.add_argument(
        "--weight",
        type=energy_option("weight"),
        metavar="ROW/COL",
        help="body force on elastic tissue along each axis, in the unit of stiffness per length, "
        "such as 0.00981/0 for water in kPa and mm; write an equals sign before a minus sign: "
        "--weight=-0.01/0",
    )
    _add_backend(solve)


def _add_result(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "result", type=Path, metavar="RESULT", help="study with its field, or saved result"
    )


def _add_force(command: argparse.ArgumentParser) -> None:
    command.add_argument("--force", action="store_true", help="overwrite existing files")


def _add_backend(
    command: argparse.ArgumentParser,
    text: str = "renderer (default: %(default)s)",
    usual: str = "auto",
) -> None:
    command.add_argument("--backend", choices=BACKEND_NAMES, default=usual, help=text)


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
        help="elastic tissue across the slice: thin and free to bulge (plane stress, the default), "
        "or held between its neighbours (plane strain)",
    )


def _add_tissue(command: argparse.ArgumentParser) -> None:
    """Add the options that define the tissue of each pixel."""
    command.add_argument("--labels", type=Path, metavar="IMAGE", help="image of tissue labels")
    command.add_argument(
        "--maps",
        type=Path,
        nargs="+",
        default=(),
        metavar="MAP",
        help="instead of --labels: one image of the probability of each tissue 1, 2 ...",
    )
    command.add_argument(
        "--materials",
        type=Path,
        metavar="TABLE",
        help="table with the columns label,name,stiffness,poisson,growth, where a growth of 0.2 or "
        "20%% makes lengths a fifth larger; or a table of the names of a segmentation's labels, as "
        "for the command materials",
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
        "Deform an image by known random fields, to validate a registration.",
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
        help="folder for the image, its labels, and a folder 001, 002 ... for each pair",
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
        help="seed of the random numbers; a seed always gives the same pairs (default: "
        "%(default)s)",
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
        "Find the published stiffness of a segmentation's labels by their names.",
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
        help="also write the table, as a .csv to correct and pass to --materials",
    )
    _add_force(materials)
    batch = commands.add(
        "batch",
        "Solve many cases from a table, by several processes or machines.",
        "napari-hmrf batch cases.csv out --jobs 4 --resume",
        "Each case gets a folder in OUT and a line in summary.csv. Only one batch at a time may "
        "write to a folder.",
    )
    batch.add_argument(
        "cases",
        type=Path,
        metavar="CASES",
        help=".csv with a line for each case and the columns name, image or study, and the options "
        "of solve; growth:TISSUE, stiffness:TISSUE, poisson:TISSUE, amount:BOUNDARY and poisson "
        "replace numbers in the files of the case. Several values in a cell, separated by "
        "semicolons, make one case each; a slice may be 3-7, or all",
    )
    batch.add_argument(
        "out", type=Path, metavar="OUT", help="folder for summary.csv and the folders of the cases"
    )
    where = batch.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=count_option,
        metavar="N",
        help="number of single-threaded processes (default: one for each core)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address or file of a dask scheduler, whose workers solve the cases (default: none)",
    )
    batch.add_argument(
        "--resume",
        action="store_true",
        help="keep finished cases whose line and files are unchanged, and solve the others",
    )
    _add_backend(batch, usual="cpu")
