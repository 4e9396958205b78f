"""Commands of the shell: one dataclass for each, whose docstring is the help.

A field without a default is an argument, or a required option if it is keyword-only. A type that
names the content of a file, such as `Image`, is shown in the help.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from napari_hmrf.io.case_options import (
    Case,
    File,
    Image,
    LabelledImage,
    RegistrationCase,
    Resampling,
    Table,
)
from napari_hmrf.samples import PhantomName
from napari_hmrf.solver.backends import BackendName
from napari_hmrf.solver.model_names import ModelName, Plane

if TYPE_CHECKING:
    from napari_hmrf.checks import Count, Flag, Number, Poisson, Positive, Samples, Seed
    from napari_hmrf.io.option_texts import Index, Lengths

#: Content of a file or folder that an option names.
Folder = Path
Study = Path
Result = Path
#: Name or label of a tissue.
Tissue = str


@dataclass(frozen=True, kw_only=True)
class Writing:
    """Command that writes files.

    Attributes
    ----------
    force : bool
        Overwrite existing files.
    """

    force: Flag = False


@dataclass(frozen=True, kw_only=True)
class Solving:
    """Command that solves.

    Attributes
    ----------
    backend : str
        Renderer; auto uses shaders if there is a GPU, and otherwise loops on the CPU, which are
        compiled once per machine.
    """

    backend: BackendName = "auto"


@dataclass(frozen=True, kw_only=True)
class Demo(Writing, Solving):
    """Deform a sample image, save pictures of the result, and show it in napari.

    The command also prints a table of measurements. If there is no display, napari is not opened.

    Attributes
    ----------
    phantom : str
        Sample to deform; by default, expansion.
    volume : bool
        Deform a volume instead of a `phantom`: a head with a growing tumour.
    model : str
        Model of the tissue: elastic, elastic for large motion, or the paper's Markov random field,
        solved either with its schedule or to convergence. The results of the paper's schedule are
        always printed for comparison.
    poisson, plane
        As for the command solve.
    size : int
        Number of pixels along each side; by default, 300, the size for which a finite-element
        solution is available. For a volume, number of voxels from front to back; by default, 95,
        each 2 mm in size.
    out : Path
        Folder for the pictures and the result; by default, demo-output, in which an earlier demo is
        overwritten.
    no_window : bool
        Do not open napari.

    Examples
    --------
    napari-hmrf demo --phantom mass-effect --no-window
    """

    phantom: PhantomName | None = None
    volume: Flag = False
    model: ModelName = "elastic"
    poisson: Poisson | None = None
    plane: Plane | None = None
    size: Count | None = None
    out: Folder | None = None
    no_window: Flag = False


@dataclass(frozen=True)
class Selftest:
    """Describe this machine and its renderers, and check the results of each renderer.

    Include the output in bug reports. It contains no names of folders or users.

    Examples
    --------
    napari-hmrf selftest
    """


@dataclass(frozen=True, kw_only=True)
class Solve(Case, Writing, Solving):
    """Solve a study, or an image with boundary conditions.

    The solved study and the deformed image are written to a folder. For a saved study, only `out`
    is required.

    Attributes
    ----------
    out : Path
        Folder for the results.

    Examples
    --------
    napari-hmrf solve scan.png --boundary rim.png --rules rules.csv -o out
    """

    out: Folder


@dataclass(frozen=True, kw_only=True)
class Register(RegistrationCase, Writing):
    """Find the displacement of elastic tissue between two images.

    The tissue of `fixed` moves until it looks like `moving`. The folder contains the study, the
    deformed image, the other image on the grid of `fixed`, the change of size, a field for ITK and
    a report.

    Attributes
    ----------
    out : Path
        Folder for the results.

    Examples
    --------
    napari-hmrf register before.nii.gz after.nii.gz --rigid -o out
    """

    out: Folder


@dataclass(frozen=True)
class Export(Writing):
    """Export the displacement field of a result for other tools.

    ITK, SimpleITK, ANTs, elastix and 3D Slicer can read the file. Its vectors are in mm, in LPS
    coordinates.

    Attributes
    ----------
    result : Path
        Solved study, or saved result.
    out : Path
        Output file, ending in .nii.gz, .mha, .nrrd or, for a backward field only, .h5.
    forward : bool
        Write the forward field, which maps points to their new positions; by default, the backward
        field, which maps pixels to their original positions and is used to warp images.

    Examples
    --------
    napari-hmrf export out/scan.study field.nii.gz
    """

    result: Result
    out: File
    forward: Flag = False


@dataclass(frozen=True)
class Apply(Resampling, Writing):
    """Deform images, labels or landmarks with a displacement field.

    Attributes
    ----------
    field : Path
        Solved study, saved result, or displacement field from another tool.
    files : Path
        Images on the pixel grid of the field, or landmark files (.csv, .mrk.json, .fcsv).
    labels : bool
        Treat the images as labels, without interpolation.
    out : Path
        Folder for the deformed files, which have the same names; DICOM scans become .nrrd files.

    Examples
    --------
    napari-hmrf apply out/scan.study channel.tif landmarks.csv -o moved
    """

    field: File
    files: tuple[File, ...]
    labels: Flag = False
    out: Folder = Path("moved")


@dataclass(frozen=True)
class Measure(Resampling, Writing):
    """Print the displacement, change in size and strain of each tissue.

    Attributes
    ----------
    result : Path
        Solved study, or saved result.
    labels : Path
        Label image; by default, that of the study.
    out : Path
        Also write the table to a .csv file.
    uncertainty : bool
        Add the standard deviation of the mean displacement of each tissue, along its motion and, in
        the .csv file, along each axis; for a study of the elastic model.

    Examples
    --------
    napari-hmrf measure out/scan.study -o measurements.csv
    """

    result: Result
    labels: Image | None = None
    out: Table | None = None
    uncertainty: Flag = False


@dataclass(frozen=True)
class Uncertainty(Writing, Solving):
    """Estimate how sure a displacement is, and where one more landmark helps most.

    The study must have the elastic model. Error bars are standard deviations of the mean
    displacement of patches of tissue; those of whole tissues are printed by the command measure.

    Attributes
    ----------
    study : Path
        Solved study.
    out : Path
        Also write the standard deviations along the motion as an image (.nii.gz, .nii, .mha, .nrrd
        or .tif), and those along each axis beside it, such as sd-row.nii.gz and sd-col.nii.gz for
        sd.nii.gz.
    patch : float
        Side of a patch, in the unit of the image; by default, 5 % of its longest side. After a
        registration, it is 7 pixels, and cannot be chosen.
    samples : int
        Number of random fields from which the standard deviations are estimated, at least 2; 30
        give an accuracy of 13 %.
    within : Path
        Pixels in which a landmark can be set: those that are not 0; by default, all tissue.
    landmarks : bool
        Also test whether the landmarks agree with the tissue and with each other, and find their
        most likely typical strain; each component of a landmark takes one solve.

    Examples
    --------
    napari-hmrf uncertainty out/scan.study -o sd.nii.gz
    """

    study: Study
    out: Image | None = None
    patch: Positive | None = None
    samples: Samples = 30
    within: Image | None = None
    landmarks: Flag = False


@dataclass(frozen=True)
class Fit(Writing, Solving):
    """Find the growth or the stiffness of tissues with which a study moves to a second image.

    Values are printed with intervals of 95 %. Without a second image, the landmarks of the study
    that have a standard deviation are used.

    Attributes
    ----------
    study : Path
        Study with its image and labels.
    second : Path
        Image of the same kind after the motion, at its position in world coordinates.
    growth : str
        Tissues whose growth is unknown, by name or label.
    stiffness : str
        Tissues whose stiffness is unknown, by name or label.
    poisson : str
        Tissues whose Poisson's ratio is unknown, by name or label.
    load : bool
        Find a factor on all forces of the study, too.
    out : Path
        Write the study with the fitted values.

    Examples
    --------
    napari-hmrf fit before.study --second after.nii.gz --growth tumour -o fitted.study
    """

    study: Study
    second: Image | None = None
    growth: tuple[Tissue, ...] = ()
    stiffness: tuple[Tissue, ...] = ()
    poisson: tuple[Tissue, ...] = ()
    load: Flag = False
    out: Study | None = None


@dataclass(frozen=True)
class Play(Writing):
    """Write an animation of the deformation, forward and back, as .gif or .mp4.

    Attributes
    ----------
    result : Path
        Solved study, or saved result.
    out : Path
        Output file, ending in .gif or .mp4.
    image : Path
        Image to deform; by default, that of the study.
    slice : int
        Index of a slice along the first axis of a volume; by default, the middle slice.

    Examples
    --------
    napari-hmrf play out/scan.study scan.gif
    """

    result: Result
    out: File
    image: Image | None = None
    slice: Index | None = None


@dataclass(frozen=True)
class Replay:
    """Solve a saved study again, and compare the new field with the saved field.

    The exit code is 1 if the fields differ by more than the tolerance.

    Attributes
    ----------
    study : Path
        Solved study.
    image : Path
        Image of the study, if the study file does not contain it.

    Examples
    --------
    napari-hmrf replay out/scan.study
    """

    study: Study
    image: Image | None = None


@dataclass(frozen=True)
class Materials(Writing):
    """Look up the published stiffness of each label of a segmentation by its name.

    Attributes
    ----------
    table : Path
        Class map of TotalSegmentator, dataset.json of nnU-Net, FreeSurferColorLUT.txt, label
        descriptions of ITK-SNAP, colour table or .seg.nrrd of 3D Slicer, or .csv with the columns
        label,name.
    labels : Path
        List only the labels of this image.
    out : Path
        Also write the table to a .csv file, which can be edited and passed to --materials.

    Examples
    --------
    napari-hmrf materials FreeSurferColorLUT.txt --labels aseg.nii.gz -o materials.csv
    """

    table: Table
    labels: Image | None = None
    out: Table | None = None


@dataclass(frozen=True)
class Resample(Writing):
    """Resample images whose axes are not at right angles, as of a tilted gantry.

    All commands, and napari, can read the written files.

    Attributes
    ----------
    files : Path
        Images, or folders with a DICOM series.
    labels : bool
        Treat the images as labels, without interpolation.
    out : Path
        Folder for the resampled files.

    Examples
    --------
    napari-hmrf resample ct -o resampled
    """

    files: tuple[Image, ...]
    labels: Flag = False
    out: Folder = Path("resampled")


@dataclass(frozen=True)
class Batch:
    """Solve the cases in a table, in several processes or on several machines.

    The results of each case are written to a subfolder of `out` and to a line of summary.csv. Only
    one batch at a time can write to `out`.

    Attributes
    ----------
    cases : Path
        Table (.csv) with a line for each case and the columns name, image or study, and options of
        the command solve. The columns growth:TISSUE, stiffness:TISSUE, poisson:TISSUE,
        amount:BOUNDARY and poisson replace numbers in the files of the case. If a cell contains
        several values, separated by semicolons, there is one case for each value. The column slice
        also accepts a range, such as 3-7, or all.
    out : Path
        Folder for summary.csv and the results of the cases.
    jobs : int
        Number of single-threaded processes; by default, one per core.
    scheduler : str
        Instead of `jobs`: address, or scheduler file, of a dask cluster on which to solve the
        cases.
    resume : bool
        Skip solved cases for which the line and the input files are unchanged.
    backend : str
        Renderer.

    Examples
    --------
    napari-hmrf batch cases.csv out --jobs 4 --resume
    """

    cases: Table
    out: Folder
    jobs: Count | None = None
    scheduler: str | None = None
    resume: Flag = False
    backend: BackendName = "cpu"


@dataclass(frozen=True, kw_only=True)
class Truth(LabelledImage, Writing, Solving):
    """Deform an image with known random fields, to validate a registration.

    The image is used with `labels` or `maps`, or is a study with labelled tissue.

    Attributes
    ----------
    out : Path
        Folder for the image and its labels, with a subfolder 001, 002 ... for each pair.
    count : int
        Number of pairs.
    seed : int
        Seed of the random numbers; the same seed gives the same pairs.
    amplitude : float
        Largest prescribed displacement of each pair, or a range, such as 1-4, to draw it from, in
        mm, or in pixels if the image has no pixel size; by default, from 0 to a quarter of the
        distance between the patches that are moved, or an eighth for a volume.
    patches : int
        Number of patches of tissue that are moved; by default, 12, or 8 for a volume.
    weight : float
        Largest body force, such as gravity, which has a random direction, in units of stiffness per
        mm, or per pixel if the image has no pixel size; 0.00981 for water in kPa.
    free_edge : bool
        Allow the outer edge of the tissue to move, which is fixed by default.

    Examples
    --------
    napari-hmrf truth scan.nii.gz --labels labels.nii.gz --materials tissue.csv -o truth --count 10
    """

    out: Folder
    count: Count = 1
    seed: Seed = 0
    amplitude: Lengths | None = None
    patches: Count | None = None
    weight: Number | None = None
    free_edge: Flag = False


#: Commands in the order of the help.
COMMANDS = (
    *(Demo, Selftest, Solve, Register, Export, Apply, Measure, Uncertainty, Fit, Play, Replay),
    *(Materials, Resample, Batch, Truth),
)
