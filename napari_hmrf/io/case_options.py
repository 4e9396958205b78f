"""Input files and options of a case and of a registration, as fields of dataclasses.

The fields are the options of the shell and the columns of a table of cases. The types of the fields
are in `option_texts`; a field that names a file has the type of its content, such as `Image`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from napari_hmrf.arguments import checked_path, tuple_of
from napari_hmrf.solver.model_names import ModelName, Plane

if TYPE_CHECKING:
    from napari_hmrf.checks import Budget, Flag, PerAxis, Poisson, Positive
    from napari_hmrf.io.option_texts import CavityLoad, Index, PixelSize

#: Content of a file that an option names.
Image = Path
Table = Path
File = Path
Alignment = Literal["rigid", "affine"]
Similarity = Literal["auto", "same", "inverse", "other"]
#: Metadata of a field each of whose words is an option without a value.
WORDS_AS_FLAGS = {"flags": True}


@dataclass(frozen=True, kw_only=True)
class Resampling:
    """Reading of images whose axes are not at right angles.

    Attributes
    ----------
    resample : bool
        Resample images whose axes are not at right angles, as of a tilted gantry, to a grid at
        right angles: linearly, or labels to the nearest pixel. By default, they are refused.
    """

    resample: Flag = False


@dataclass(frozen=True, kw_only=True)
class TissueFiles:
    """Files that define the tissue of each pixel.

    Attributes
    ----------
    labels : Path, optional
        Label image of the tissue.
    maps : sequence of Path
        Instead of `labels`: one probability image for each tissue, in the order 1, 2 ... The label
        of a pixel is that of the most likely tissue, or 0 if it is more likely that there is none.
    materials : Path, optional
        Table with the columns label,name,stiffness,poisson,growth,slides, in which a growth of 0.2
        or 20% increases lengths by a fifth, and yes lets a tissue slide along all other tissue; or
        a table of the label names of a segmentation, as for the command materials.
    """

    labels: Image | None = None
    maps: tuple[Image, ...] = ()
    materials: Table | None = None


@dataclass(frozen=True, kw_only=True)
class LabelledImage(TissueFiles):
    """Image, or a slice of it, with its tissue.

    Attributes
    ----------
    image : Path
        Image, or saved study, which needs no other files.
    slice : int, optional
        Index of a slice along the first axis of a volume; by default, the whole volume.
    """

    image: Image = field(kw_only=False)
    slice: Index | None = None


@dataclass(frozen=True, kw_only=True)
class Case(Resampling, LabelledImage):
    """Input files and options of a case.

    The image, its slice and its tissue are given as in `LabelledImage` and `TissueFiles`. Paths can
    be given as text, and are stored as `Path`.

    Attributes
    ----------
    boundary : Path, optional
        Motion of the tissue: a label image, used with `rules`; pairs of landmarks (.csv of
        BigWarp), or landmarks used with `targets`; or a displacement field, such as the result of a
        registration.
    targets : Path, optional
        Target positions of the landmarks of `boundary`, in the same order, if it is one list of
        points (.mrk.json or .fcsv of 3D Slicer, .csv of napari).
    rules : Path, optional
        Table (.csv) with the columns label,action,row,col,amount,confidence and one line for each
        label of `boundary`; the actions are fixed, move, expand, press, pull, slide and remove
        (press and pull apply forces).
    forward : bool
        Treat the field of `boundary` as a forward field, which maps points to their new positions,
        if its file does not state the direction; by default, it is a backward field, as written by
        registration tools.
    confidence : Path or "edges", optional
        Confidence in the field of `boundary`: an image with values from 0 to 1, a mask, or the word
        edges, for full confidence at edges in the image only.
    spacing : (tuple of float, str), optional
        Size of a pixel along each axis of a picture whose file does not state it, and its unit,
        such as 2.5/0.5/0.5um; by default, pixels have size 1.
    hold_edge : bool
        Fix the outer edge of the tissue.
    model : str, optional
        Model of the tissue; by default, elastic.
    poisson : float, optional
        Poisson's ratio of all elastic tissue, from 0 to 0.499; by default, the values in the table
        of materials, or 0.45.
    plane : {"stress", "strain"}, optional
        Behaviour of elastic tissue perpendicular to the slice: free to bulge (plane stress, the
        default), or confined by the adjacent slices (plane strain).
    tolerance : float, optional
        Largest estimated error of the field, in pixels; by default, 0.001. Not available for the
        model paper.
    budget : float, optional
        Largest work of a large-motion solve, in linear solves, or inf for no limit; by default, 60.
        A solve that takes more ends with the best motion so far and a note on what is missing.
    penalty : float, optional
        Holding force above which boundaries slip. By default, boundaries do not slip; the paper's
        models use a force that is large enough to prevent slip.
    weight : tuple of float
        Body force on elastic tissue along each axis, [PLANE/]ROW/COL (of a whole scan: head to
        foot, front to back, left to right, in the directions of the file; of a slice: its rows and
        columns in the file), in units of stiffness per length, such as 0.00981/0 for water in kPa
        and mm. If the first number is negative, use an equals sign: --weight=-0.01/0.
    cavity : Cavity, optional
        Pressure, in units of stiffness, and fluid on the surface where a rule removes tissue:
        PRESSURE/FLUID/LEVEL, with the weight of the fluid per volume, as in `weight`, and its level
        as a fraction of the height of the cavity, such as 0/0.00981/0.5; by default, nothing acts
        there.
    """

    boundary: File | None = None
    targets: File | None = None
    rules: Table | None = None
    forward: Flag = False
    confidence: Image | Literal["edges"] | None = None
    spacing: PixelSize | None = None
    hold_edge: Flag = False
    model: ModelName | None = None
    poisson: Poisson | None = None
    plane: Plane | None = None
    tolerance: Positive | None = None
    budget: Budget | None = None
    penalty: Positive | None = None
    weight: PerAxis = ()
    cavity: CavityLoad | None = None

    def __post_init__(self) -> None:
        for name in ("image", "labels", "materials", "boundary", "targets", "rules", "confidence"):
            path = getattr(self, name)
            if path is not None and (name, path) != ("confidence", "edges"):
                object.__setattr__(self, name, Path(checked_path(path, name)))
        maps = tuple_of(str | os.PathLike, "maps", self.maps, "('white.nii', 'grey.nii')")
        object.__setattr__(self, "maps", tuple(Path(checked_path(each, "maps")) for each in maps))

    @property
    def options(self) -> tuple[str, ...]:
        """Shell names of the options that are set, except the image."""
        names = [each.name for each in fields(Case) if each.name != "image"]
        given = [name for name in names if getattr(self, name) not in (None, (), False)]
        return tuple(f"--{name.replace('_', '-')}" for name in given)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Paths of the input files and folders."""
        motion = self.boundary, self.targets, self.rules
        named = (self.image, self.labels, self.materials, *motion, *self.maps)
        confidence = (self.confidence,) if isinstance(self.confidence, Path) else ()
        return tuple(path for path in (*named, *confidence) if path is not None)


@dataclass(frozen=True, kw_only=True)
class RegistrationCase(Resampling, TissueFiles):
    """Input files and options of a registration.

    Attributes
    ----------
    fixed : Path
        Image or volume, whose tissue moves.
    moving : Path
        Image or volume of the same tissue.
    mask : Path, optional
        Pixels of `fixed` that count: those that are not 0; by default, all.
    moving_mask : Path, optional
        Pixels of `moving` that count: those that are not 0; by default, all.
    landmarks : Path, optional
        Pairs of landmarks in the columns of BigWarp: first the position in `fixed`, then that in
        `moving`; a further column may contain standard deviations. Or positions in `fixed`, used
        with `targets`.
    targets : Path, optional
        Positions of the landmarks in `moving`, in the same order, if `landmarks` is one list of
        points (.mrk.json or .fcsv of 3D Slicer, .csv of napari).
    landmark_sd : float, optional
        Standard deviation of landmarks without one, in the unit of `fixed`; by default, a pixel.
    spacing : (tuple of float, str), optional
        Size of a pixel of both images, if they are pictures whose files do not state it, as for the
        command solve.
    alignment : {"rigid", "affine"}, optional
        First align the whole image with SimpleITK: rigid shifts and turns it, affine also scales
        and shears it. By default, the images are used at their positions in world coordinates.
    smoothness : float
        Weight of the elastic energy, relative to the usual weight; a larger weight leads to smaller
        strains.
    similarity : {"auto", "same", "inverse", "other"}
        Relation of the brightness of both images: bright tissue is bright in both (same), dark in
        one of them (inverse), or the brightness of one image is another function of that of the
        other (other), as in two sequences of an MRI. By default, the images decide (auto).
    compare_all : bool
        Compare all pixels that count, also of tissue that exists in one image only, such as a
        tumour before an operation; by default, such tissue is found and has no effect.
    """

    fixed: Image = field(kw_only=False)
    moving: Image = field(kw_only=False)
    mask: Image | None = None
    moving_mask: Image | None = None
    landmarks: Table | None = None
    targets: File | None = None
    landmark_sd: Positive | None = None
    spacing: PixelSize | None = None
    alignment: Alignment | None = field(default=None, metadata=WORDS_AS_FLAGS)
    smoothness: Positive = 1.0
    similarity: Similarity = "auto"
    compare_all: Flag = False
