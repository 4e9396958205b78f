"""Command-line parser of ``napari-hmrf``: subcommands, options and help texts."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args

from pydantic import BeforeValidator, Field

import napari_hmrf
from napari_hmrf.arguments import did_you_mean
from napari_hmrf.checks import POISSON_RANGE, Number, Poisson, Positive, Words, convert
from napari_hmrf.errors import ArgumentError
from napari_hmrf.io.case_options import OPTIONS
from napari_hmrf.samples.demo import SAMPLE_SIZE
from napari_hmrf.samples.head import SAMPLE_SIZE as VOLUME_SIZE
from napari_hmrf.samples.phantoms import PHANTOM_NAMES, SMALLEST
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.model_names import MODELS, as_word
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON

#: Message of argparse about an unknown word: the argument, the word, and the known words.
_CHOICE = re.compile(r"(.*?)invalid choice: '?([^' ]*)'? \(choose from (.*)\)$", re.DOTALL)
#: Length, or range of lengths.
_LENGTHS = Annotated[
    Number | Annotated[tuple[Number, Number], BeforeValidator(lambda text: text.split("-"))],
    Words("a length such as 3, or a range such as 1-4"),
]


def _option(kind: Any) -> Callable[[str], Any]:
    """Return a function that converts the text of an option to a type of value."""

    def read(text: str) -> Any:
        try:
            return convert(kind, text)
        except ArgumentError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _at_least(smallest: int) -> Callable[[str], int]:
    words = Words(f"a whole number of at least {smallest}")
    return _option(Annotated[int, Field(ge=smallest), words])


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are one sentence, with a suggestion for a misspelt word."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, rest = self.parse_known_args(args, namespace)
        if rest:
            parser = self.commands.get(options.command, self)
            wrong = next((word for word in rest if word.startswith("-")), rest[0])
            known = [*parser._option_string_actions]
            hint = did_you_mean(wrong.partition("=")[0], known) if wrong.startswith("-") else ""
            parser.error(f"unrecognized argument {wrong}.{hint}")
        return options

    @property
    def commands(self) -> dict[str, Any]:
        """Parsers of the subcommands, by name."""
        return next(
            (dict(each.choices) for each in self._actions if isinstance(each.choices, dict)), {}
        )

    def error(self, message: str) -> NoReturn:
        choice = _CHOICE.match(message)
        if choice is not None:
            hint = did_you_mean(choice[2], re.findall(r"[\w.-]+", choice[3]))
            message = f"{choice[1]}there is no {choice[2]!r}.{hint} Choose from {choice[3]}."
        self.exit(2, f"{self.prog}: error: {message}\nSee {self.prog} --help for all options.\n")


class Commands:
    """Subcommands of a parser, each with a description and an example."""

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
            Description of the command, an imperative sentence. It is shown in the help of the
            command and, without the final period, in the list of commands.
        example : str
            Complete command line.
        more : str
            Further sentences, shown only in the help of the command.

        Returns
        -------
        argparse.ArgumentParser
            Parser of the command, to which options can be added.
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
    """Help formatter that does not wrap the example, so that the user can copy it."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example: ") else super()._fill_text(text, width, indent)


def parser_of_commands() -> argparse.ArgumentParser:
    """Return the parser for all commands, which stores the command's name as `command`."""
    parser = _Parser(
        prog="napari-hmrf",
        description="Compute the deformation of soft tissue on the pixel grid of an image.",
        epilog="napari-hmrf COMMAND --help describes a command and shows an example.",
    )
    parser.add_argument(
        "--version", action="version", version=f"napari-hmrf {napari_hmrf.__version__}"
    )
    commands = Commands(parser)
    demo = commands.add(
        "demo",
        "Deform a sample image, save pictures of the result, and show it in napari.",
        "napari-hmrf demo --phantom mass-effect --no-window",
        "The command also prints a table of measurements. If there is no display, napari is not "
        "opened.",
    )
    which = demo.add_mutually_exclusive_group()
    which.add_argument(
        "--phantom",
        choices=PHANTOM_NAMES,
        default=PHANTOM_NAMES[0],
        help="sample to deform (default: %(default)s)",
    )
    which.add_argument(
        "--volume", action="store_true", help="deform a volume: a head with a growing tumour"
    )
    demo.add_argument(
        "--model",
        type=as_word,
        choices=MODELS,
        default="elastic",
        help="model of the tissue: elastic, elastic for large motion, or the paper's Markov random "
        "field, solved either with its schedule or to convergence (default: %(default)s). The "
        "results of the paper's schedule are always printed for comparison",
    )
    _add_material(demo)
    demo.add_argument(
        "--size",
        type=_at_least(SMALLEST),
        metavar="N",
        help=f"number of pixels along each side (default: {SAMPLE_SIZE}, the size for which a "
        "finite-element solution is available); for a volume, number of voxels from front to back "
        f"(default: {VOLUME_SIZE}, each 2 mm in size)",
    )
    demo.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the pictures and the result (default: demo-output, in which an earlier "
        "demo is overwritten)",
    )
    _add_force(demo)
    _add_backend(
        demo,
        "renderer; auto uses shaders if there is a GPU, and otherwise loops on the CPU, which are "
        "compiled once per machine (default: %(default)s)",
    )
    demo.add_argument("--no-window", action="store_true", help="do not open napari")
    commands.add(
        "selftest",
        "Describe this machine and its renderers, and check the results of each renderer.",
        "napari-hmrf selftest",
        "Include the output in bug reports. It contains no names of folders or users.",
    )
    _add_solve(commands)
    _add_register(commands)
    _add_result_commands(commands)
    _add_many_commands(commands)
    _add_truth(commands)
    return parser


def _add_result_commands(commands: Commands) -> None:
    export = commands.add(
        "export",
        "Export the displacement field of a result for other tools.",
        "napari-hmrf export out/scan.study field.nii.gz",
        "ITK, SimpleITK, ANTs, elastix and 3D Slicer can read the file. Its vectors are in mm, in "
        "LPS coordinates.",
    )
    _add_result(export)
    export.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help="output file, ending in .nii.gz, .mha, .nrrd or, for a backward field only, .h5",
    )
    export.add_argument(
        "--forward",
        action="store_true",
        help="write the forward field, which maps points to their new positions (default: the "
        "backward field, which maps pixels to their original positions and is used to warp images)",
    )
    _add_force(export)
    apply = commands.add(
        "apply",
        "Deform images, labels or landmarks with a displacement field.",
        "napari-hmrf apply out/scan.study channel.tif landmarks.csv -o moved",
    )
    apply.add_argument(
        "field",
        type=Path,
        metavar="FIELD",
        help="solved study, saved result, or displacement field from another tool",
    )
    apply.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="image on the pixel grid of the field, or landmark file (.csv, .mrk.json, .fcsv)",
    )
    apply.add_argument(
        "--labels", action="store_true", help="treat the images as labels, without interpolation"
    )
    apply.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("moved"),
        metavar="DIR",
        help="folder for the deformed files, which have the same names (default: %(default)s)",
    )
    _add_force(apply)
    measure = commands.add(
        "measure",
        "Print the displacement, change in size and strain of each tissue.",
        "napari-hmrf measure out/scan.study -o measurements.csv",
    )
    _add_result(measure)
    measure.add_argument(
        "--labels", type=Path, metavar="IMAGE", help="label image (default: that of the study)"
    )
    measure.add_argument(
        "-o", "--out", type=Path, metavar="TABLE", help="also write the table to a .csv file"
    )
    measure.add_argument(
        "--uncertainty",
        action="store_true",
        help="add the standard deviation of the mean displacement of each tissue, along its motion "
        "and, in the .csv file, along each axis; for a study of the elastic model",
    )
    _add_force(measure)
    _add_uncertainty(commands)
    _add_fit(commands)
    play = commands.add(
        "play",
        "Write an animation of the deformation, forward and back, as .gif or .mp4.",
        "napari-hmrf play out/scan.study scan.gif",
    )
    _add_result(play)
    play.add_argument("out", type=Path, metavar="OUT", help="output file, ending in .gif or .mp4")
    play.add_argument(
        "--image", type=Path, metavar="IMAGE", help="image to deform (default: that of the study)"
    )
    play.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="index of a slice along the first axis of a volume (default: the middle slice)",
    )
    _add_force(play)
    replay = commands.add(
        "replay",
        "Solve a saved study again, and compare the new field with the saved field.",
        "napari-hmrf replay out/scan.study",
        "The exit code is 1 if the fields differ by more than the tolerance.",
    )
    replay.add_argument("study", type=Path, metavar="STUDY", help="solved study")
    replay.add_argument(
        "--image",
        type=Path,
        metavar="IMAGE",
        help="image of the study, if the study file does not contain it",
    )


def _add_fit(commands: Commands) -> None:
    fit = commands.add(
        "fit",
        "Find the growth or the stiffness of tissues with which a study moves to a second image.",
        "napari-hmrf fit before.study --second after.nii.gz --growth tumour -o fitted.study",
        "Values are printed with intervals of 95 %. Without a second image, the landmarks of the "
        "study that have a standard deviation are used.",
    )
    fit.add_argument("study", type=Path, metavar="STUDY", help="study with its image and labels")
    fit.add_argument(
        "--second",
        type=Path,
        metavar="IMAGE",
        help="image of the same kind after the motion, at its position in world coordinates",
    )
    for name, words in (
        ("growth", "growth"),
        ("stiffness", "stiffness"),
        ("poisson", "Poisson's ratio"),
    ):
        fit.add_argument(
            f"--{name}",
            nargs="+",
            default=[],
            metavar="TISSUE",
            help=f"tissues whose {words} is unknown, by name or label",
        )
    fit.add_argument(
        "--load", action="store_true", help="find a factor on all forces of the study, too"
    )
    fit.add_argument(
        "-o", "--out", type=Path, metavar="STUDY", help="write the study with the fitted values"
    )
    _add_force(fit)
    _add_backend(fit)


def _add_uncertainty(commands: Commands) -> None:
    uncertainty = commands.add(
        "uncertainty",
        "Estimate how sure a displacement is, and where one more landmark helps most.",
        "napari-hmrf uncertainty out/scan.study -o sd.nii.gz",
        "The study must have the elastic model. Error bars are standard deviations of the mean "
        "displacement of patches of tissue; those of whole tissues are printed by the command "
        "measure.",
    )
    uncertainty.add_argument("study", type=Path, metavar="STUDY", help="solved study")
    uncertainty.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="IMAGE",
        help="also write the standard deviations along the motion as an image (.nii.gz, .nii, "
        ".mha, .nrrd or .tif), and those along each axis beside it, such as sd-row.nii.gz and "
        "sd-col.nii.gz for sd.nii.gz",
    )
    uncertainty.add_argument(
        "--patch",
        type=_option(Positive),
        metavar="SIDE",
        help="side of a patch, in the unit of the image (default: 5 %% of its longest side)",
    )
    uncertainty.add_argument(
        "--samples",
        type=_at_least(2),
        default=30,
        metavar="N",
        help="number of random fields from which the standard deviations are estimated; 30 give "
        "an accuracy of 13 %% (default: %(default)s)",
    )
    uncertainty.add_argument(
        "--within",
        type=Path,
        metavar="IMAGE",
        help="pixels in which a landmark can be set: those that are not 0 (default: all tissue)",
    )
    uncertainty.add_argument(
        "--landmarks",
        action="store_true",
        help="also test whether the landmarks agree with the tissue and with each other, and find "
        "their most likely typical strain; each component of a landmark takes one solve",
    )
    _add_force(uncertainty)
    _add_backend(uncertainty)


def _add_solve(commands: Commands) -> None:
    solve = commands.add(
        "solve",
        "Solve a study, or an image with boundary conditions.",
        "napari-hmrf solve scan.png --boundary rim.png --rules rules.csv -o out",
        "The solved study and the deformed image are written to a folder. For a saved study, only "
        "--out is required.",
    )
    solve.add_argument(
        "image", type=Path, metavar="STUDY|IMAGE", help="saved study, or image to deform"
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
        help="boundary conditions: a label image, used with --rules; pairs of landmarks (.csv of "
        "BigWarp), or landmarks used with --targets; or a displacement field",
    )
    _add_targets(solve, "--boundary")
    solve.add_argument(
        "--rules",
        type=Path,
        metavar="TABLE",
        help=".csv with the columns label,action,row,col,amount,confidence and one line for each "
        "label of --boundary; the actions are fixed, move, expand, press, pull, slide and remove "
        "(press and pull apply forces)",
    )
    solve.add_argument(
        "--forward",
        action="store_true",
        help="treat the field of --boundary as a forward field, which maps points to their new "
        "positions, if its file does not state the direction (default: a backward field, as "
        "written by registration tools)",
    )
    solve.add_argument(
        "--confidence",
        metavar="IMAGE|edges",
        help="confidence in the field of --boundary: an image with values from 0 to 1, a mask, or "
        "the word edges, for full confidence at edges in the image only",
    )
    _add_slice(solve)
    _add_spacing(solve)
    solve.add_argument("--hold-edge", action="store_true", help="fix the outer edge of the tissue")
    solve.add_argument(
        "--model", type=as_word, choices=MODELS, help="model of the tissue (default: elastic)"
    )
    _add_material(solve)
    solve.add_argument(
        "--tolerance",
        type=_option(OPTIONS["tolerance"]),
        metavar="PX",
        help="largest estimated error of the field, in pixels (default: 0.001); not available for "
        "the model paper",
    )
    solve.add_argument(
        "--budget",
        type=_option(OPTIONS["budget"]),
        metavar="SOLVES",
        help="largest work of a large-motion solve, in linear solves, or inf for no limit "
        "(default: 60); a solve that takes more ends with the best motion so far and a note on "
        "what is missing",
    )
    solve.add_argument(
        "--penalty",
        type=_option(OPTIONS["penalty"]),
        metavar="K",
        help="holding force above which boundaries slip (default: boundaries do not slip; the "
        "paper's models use a force that is large enough to prevent slip)",
    )
    solve.add_argument(
        "--weight",
        type=_option(OPTIONS["weight"]),
        metavar="[PLANE/]ROW/COL",
        help="body force on elastic tissue along each axis (of a whole scan: head to foot, front "
        "to back, left to right, in the directions of the file; of a slice: its rows and columns "
        "in the file), in units of stiffness per length, such as 0.00981/0 for water in kPa and "
        "mm; if the first number is negative, use an equals sign: --weight=-0.01/0",
    )
    solve.add_argument(
        "--cavity",
        type=_option(OPTIONS["cavity"]),
        metavar="PRESSURE/FLUID/LEVEL",
        help="pressure, in units of stiffness, and fluid on the surface where a rule removes "
        "tissue: weight of the fluid per volume, as in --weight, and its level as a fraction of "
        "the height of the cavity, such as 0/0.00981/0.5 (default: nothing acts there)",
    )
    _add_backend(solve)


def _add_register(commands: Commands) -> None:
    register = commands.add(
        "register",
        "Find the displacement of elastic tissue between two images.",
        "napari-hmrf register before.nii.gz after.nii.gz --rigid -o out",
        "The tissue of FIXED moves until it looks like MOVING. The folder contains the study, the "
        "deformed image, the other image on the grid of FIXED, the change of size, a field for ITK "
        "and a report. Both images must have the same modality.",
    )
    register.add_argument("fixed", type=Path, metavar="FIXED", help="image or volume")
    register.add_argument(
        "moving", type=Path, metavar="MOVING", help="image or volume of the same tissue"
    )
    register.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    _add_force(register)
    alignment = register.add_mutually_exclusive_group()
    for kind, motion in (("rigid", "shift and turn"), ("affine", "shift, turn, scale and shear")):
        alignment.add_argument(
            f"--{kind}",
            action="store_const",
            const=kind,
            dest="alignment",
            help=f"first {motion} the whole image with SimpleITK (default: the images are used at "
            "their positions in world coordinates)",
        )
    _add_tissue(register)
    register.add_argument(
        "--mask",
        type=Path,
        metavar="IMAGE",
        help="pixels of FIXED that count: those that are not 0 (default: all)",
    )
    register.add_argument(
        "--moving-mask",
        type=Path,
        metavar="IMAGE",
        help="pixels of MOVING that count: those that are not 0 (default: all)",
    )
    register.add_argument(
        "--landmarks",
        type=Path,
        metavar="CSV",
        help="pairs of landmarks in the columns of BigWarp: first the position in FIXED, then that "
        "in MOVING; a further column may contain standard deviations; or positions in FIXED, used "
        "with --targets",
    )
    _add_targets(register, "--landmarks, in MOVING")
    register.add_argument(
        "--landmark-sd",
        type=_option(Positive),
        metavar="SD",
        help="standard deviation of landmarks without one, in the unit of FIXED (default: a pixel)",
    )
    _add_spacing(register)
    register.add_argument(
        "--smoothness",
        type=_option(Positive),
        default=1.0,
        metavar="S",
        help="weight of the elastic energy, relative to the usual weight (default: %(default)g); "
        "a larger weight leads to smaller strains",
    )


def _add_result(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "result", type=Path, metavar="RESULT", help="solved study, or saved result"
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
    """Add the options for elastic tissue."""
    low, high = POISSON_RANGE
    command.add_argument(
        "--poisson",
        type=_option(Poisson),
        metavar="NU",
        help=f"Poisson's ratio of all elastic tissue, from {low:g} to {high:g} (default: the "
        f"values in the table of materials, or {USUAL_POISSON})",
    )
    command.add_argument(
        "--plane",
        choices=get_args(Plane),
        help="behaviour of elastic tissue perpendicular to the slice: free to bulge (plane stress, "
        "the default), or confined by the adjacent slices (plane strain)",
    )


def _add_tissue(command: argparse.ArgumentParser) -> None:
    """Add the options that define the tissue of each pixel."""
    command.add_argument("--labels", type=Path, metavar="IMAGE", help="label image of the tissue")
    command.add_argument(
        "--maps",
        type=Path,
        nargs="+",
        default=(),
        metavar="MAP",
        help="instead of --labels: one probability image for each tissue, in the order 1, 2 ...",
    )
    command.add_argument(
        "--materials",
        type=Path,
        metavar="TABLE",
        help="table with the columns label,name,stiffness,poisson,growth,slides, in which a growth "
        "of 0.2 or 20%% increases lengths by a fifth, and yes lets a tissue slide along all other "
        "tissue; or a table of the label names of a segmentation, as for the command materials",
    )


def _add_slice(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--slice",
        type=int,
        metavar="N",
        help="index of a slice along the first axis of a volume (default: the whole volume)",
    )


def _add_targets(command: argparse.ArgumentParser, landmarks: str) -> None:
    command.add_argument(
        "--targets",
        type=Path,
        metavar="FILE",
        help=f"target positions of the landmarks of {landmarks}, in the same order, if it is one "
        "list of points (.mrk.json or .fcsv of 3D Slicer, .csv of napari)",
    )


def _add_spacing(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--spacing",
        type=_option(OPTIONS["spacing"]),
        metavar="[PLANE/]ROW/COLUNIT",
        help="size of a pixel along each axis of a picture whose file does not state it, such as "
        "2.5/0.5/0.5um (default: pixels of size 1)",
    )


def _add_truth(commands: Commands) -> None:
    truth = commands.add(
        "truth",
        "Deform an image with known random fields, to validate a registration.",
        "napari-hmrf truth scan.nii.gz --labels labels.nii.gz --materials tissue.csv -o truth "
        "--count 10",
    )
    truth.add_argument(
        "image",
        type=Path,
        metavar="STUDY|IMAGE",
        help="image, used with --labels or --maps, or study with labelled tissue",
    )
    _add_tissue(truth)
    _add_slice(truth)
    truth.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for the image and its labels, with a subfolder 001, 002 ... for each pair",
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
        help="seed of the random numbers; the same seed gives the same pairs (default: "
        "%(default)s)",
    )
    truth.add_argument(
        "--amplitude",
        type=_option(_LENGTHS),
        metavar="A|LOW-HIGH",
        help="largest prescribed displacement of each pair, or a range to draw it from, in mm, or "
        "in pixels if the image has no pixel size (default: from 0 to a quarter of the distance "
        "between the patches that are moved, or an eighth for a volume)",
    )
    truth.add_argument(
        "--patches",
        type=int,
        metavar="P",
        help="number of patches of tissue that are moved (default: 12, or 8 for a volume)",
    )
    truth.add_argument(
        "--weight",
        type=float,
        metavar="W",
        help="largest body force, such as gravity, which has a random direction, in units of "
        "stiffness per mm, or per pixel if the image has no pixel size (water in kPa: 0.00981; "
        "default: 0)",
    )
    truth.add_argument(
        "--free-edge",
        action="store_false",
        dest="hold_edge",
        help="allow the outer edge of the tissue to move (default: the edge is fixed)",
    )
    _add_backend(truth)


def _add_many_commands(commands: Commands) -> None:
    materials = commands.add(
        "materials",
        "Look up the published stiffness of each label of a segmentation by its name.",
        "napari-hmrf materials FreeSurferColorLUT.txt --labels aseg.nii.gz -o materials.csv",
    )
    materials.add_argument(
        "table",
        type=Path,
        metavar="TABLE",
        help="class map of TotalSegmentator, dataset.json of nnU-Net, FreeSurferColorLUT.txt, "
        "label descriptions of ITK-SNAP, colour table or .seg.nrrd of 3D Slicer, or .csv with the "
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
        help="also write the table to a .csv file, which can be edited and passed to --materials",
    )
    _add_force(materials)
    batch = commands.add(
        "batch",
        "Solve the cases in a table, in several processes or on several machines.",
        "napari-hmrf batch cases.csv out --jobs 4 --resume",
        "The results of each case are written to a subfolder of OUT and to a line of summary.csv. "
        "Only one batch at a time can write to OUT.",
    )
    batch.add_argument(
        "cases",
        type=Path,
        metavar="CASES",
        help=".csv with a line for each case and the columns name, image or study, and options of "
        "the command solve. The columns growth:TISSUE, stiffness:TISSUE, poisson:TISSUE, "
        "amount:BOUNDARY and poisson replace numbers in the files of the case. If a cell contains "
        "several values, separated by semicolons, there is one case for each value. The column "
        "slice also accepts a range, such as 3-7, or all",
    )
    batch.add_argument(
        "out", type=Path, metavar="OUT", help="folder for summary.csv and the results of the cases"
    )
    where = batch.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=_at_least(1),
        metavar="N",
        help="number of single-threaded processes (default: one per core)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address, or scheduler file, of a dask cluster on which to solve the cases (default: "
        "none)",
    )
    batch.add_argument(
        "--resume",
        action="store_true",
        help="skip solved cases for which the line and the input files are unchanged",
    )
    _add_backend(batch, usual="cpu")
