"""Conversion of painted labels and their tables to the input images of the solver.

A *material* defines the stiffness and growth of the tissue under a label. A *boundary rule* defines
the observed motion of the tissue under a label and its confidence, or a force on this tissue. The
tables of materials and rules belong to integer label images, such as napari's Labels layers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter

from napari_hmrf.arguments import refuse_unless
from napari_hmrf.checks import (
    Choice,
    Flag,
    Growth,
    Number,
    Painted,
    Poisson,
    Shares,
    Stiffness,
    Text,
    Vector,
    Whole,
    checked,
)
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import checked_spacing, whole_numbers
from napari_hmrf.solver.problem import FloatArray
from napari_hmrf.solver.sliding_parts import SlidingParts
from napari_hmrf.tissue.normals import outward_normals

Action = Literal["fixed", "move", "expand", "press", "pull", "slide", "remove"]
#: Actions that are forces on tissue, rather than observed displacements.
FORCES: tuple[Action, ...] = "press", "pull"
#: Actions that neither observe a displacement nor apply a force.
_UNOBSERVED: tuple[Action, ...] = "slide", "remove"

#: Default Poisson's ratio of soft tissue.
USUAL_POISSON = 0.45
#: Stiffness of a rigid body, such as bone or an implant.
RIGID = math.inf
_RIGID = "rigid"
#: Name of label 0.
UNPAINTED = "everything unpainted"
#: Stiffness of a new tissue if there is no deformable tissue to copy.
_STIFFNESS = 20.0


@checked
class Material:
    """Material of a tissue label.

    Attributes
    ----------
    label : int
        Value in the label image; 0 means unpainted.
    name : str
        Name for display.
    stiffness : float
        Young's modulus. All materials share one unit, which is arbitrary because only ratios
        matter. 0 means void, such as air or matter that does not adhere to its surroundings.
        Tissue with the infinite stiffness `RIGID` moves as a rigid body, which only elastic models
        support.
    poisson : float
        Poisson's ratio, from 0 to 0.499. Only elastic models use this value, and only for
        deformable tissue.
    growth : float or tuple of float
        Relative change in length of unconstrained tissue: 0.1 means 10 % longer. One number for
        all directions, or one number for each axis: (row, col), or (plane, row, col) in a volume.
        Void and rigid tissue do not grow.
    slides : bool
        If True, the tissue slides along all tissue of other labels without friction, and stays
        together with it along the normal of the interface; see `SlidingParts`. Only the elastic
        model supports this.

    Raises
    ------
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    label: Whole
    name: Text
    stiffness: Stiffness
    poisson: Poisson = USUAL_POISSON
    growth: Growth = 0.0
    slides: Flag = False

    @property
    def is_rigid(self) -> bool:
        """True if the material moves as a rigid body."""
        return self.stiffness == RIGID

    @property
    def is_deformable(self) -> bool:
        """True if the material is tissue that can deform: neither void nor rigid."""
        return 0 < self.stiffness < RIGID

    @property
    def grows(self) -> bool:
        """True if the material has growth or shrinkage."""
        return self.is_deformable and bool(np.any(self.growth))


@checked
class BoundaryRule:
    """Boundary condition of a boundary label.

    Attributes
    ----------
    label : int
        Value in the label image, above 0, because 0 means unpainted.
    action : {"fixed", "move", "expand", "press", "pull", "slide", "remove"}
        Effect on the tissue under the label. "fixed": the tissue does not move. "move": the tissue
        moves by `vector`. "expand": the tissue moves outward by `amount`, or inward if `amount` is
        negative. A painted ring moves as a whole; a filled patch moves only at its rim. "press"
        and "pull": the tissue is free, and a pressure of `amount` or a traction of `vector` acts
        on its surface under the label. "slide": the tissue moves freely along its surface under
        the label, and by `amount` along the outward normal of this surface; a label inside tissue
        that does not cover a surface slides along its own outline. Only the elastic model supports
        this action. "remove": the tissue is removed; `Cavity` is what then acts on the new surface.
    vector : tuple of float
        Displacement along (row, col), or (plane, row, col) in a volume, in the unit of the pixel
        spacing; with two components in a volume, the plane component is 0. For "pull", force per
        area, in the unit of stiffness.
    amount : float
        Displacement along the outward normal, in the unit of the pixel spacing. For "press", force
        per area against the normal, in the unit of stiffness.
    confidence : tuple of float
        Confidence of the components along (row, col), or (plane, row, col) in a volume, from 0 (not
        observed) to 1 (certain). With two values in a volume, the plane component has the larger
        value.
    name : str
        Name for display.

    Raises
    ------
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    label: Painted
    action: Annotated[Action, Choice()]
    _: KW_ONLY
    vector: Vector = (0.0, 0.0)
    amount: Number = 0.0
    confidence: Shares = (1.0, 1.0)
    name: Text = ""


#: Conversion of the rows of tables from and to JSON types, in which rigid tissue is "rigid".
MATERIALS = TypeAdapter(tuple[Material, ...])
RULES = TypeAdapter(tuple[BoundaryRule, ...])


def default_material(label: int, known: Iterable[Material]) -> Material:
    """Return the default material of a new tissue: a copy of the first deformable material."""
    name = UNPAINTED if label == 0 else f"tissue {label}"
    first = next((material for material in known if material.is_deformable), None)
    if first is None:
        return Material(label, name, _STIFFNESS)
    return replace(first, label=label, name=name, slides=False)


def with_motion_of(material: Material, row: Material) -> Material:
    """Return a material with the growth and the sliding of the row that it replaces.

    A published material states how stiff a tissue is, and not how the tissue moves in an image.
    Growth or sliding that the material states takes precedence. Void and rigid tissue neither grow
    nor slide.
    """
    if not (material.is_deformable and row.is_deformable):
        return material
    growth = material.growth if material.grows else row.growth
    return replace(material, growth=growth, slides=material.slides or row.slides)


def sliding_parts(
    labels: npt.NDArray[Any], materials: Iterable[Material], stiffness: npt.NDArray[Any]
) -> SlidingParts | None:
    """Return the parts of labelled tissue that slide; None if there are fewer than two parts.

    Each label that slides is a part of its own, and all other tissue is one part.

    Parameters
    ----------
    labels : ndarray of int, shape ([D,] H, W)
        Label of the tissue at each pixel.
    materials : iterable of Material
    stiffness : ndarray, shape ([D,] H, W)
        Stiffness of each pixel; 0 in void.
    """
    slides = [row.label for row in materials if row.slides]
    parts = np.zeros(stiffness.shape, dtype=np.int32)
    for number, label in enumerate(slides, start=1):
        parts[labels == label] = number
    return SlidingParts(parts) if len(np.unique(parts[stiffness > 0])) > 1 else None


def default_rigid(label: int) -> Material:
    """Return the default rigid material for painting."""
    return Material(label, "bone or implant", RIGID)


#: Names of new rules, which follow the action until the user changes the name.
NAMES_OF_ACTIONS: dict[Action, str] = {
    "fixed": "holds",
    "move": "moves",
    "expand": "grows",
    "press": "presses",
    "pull": "pulls",
    "slide": "slides",
    "remove": "removed",
}


def default_rule(label: int) -> BoundaryRule:
    """Return the default rule of a new boundary: fixed."""
    return BoundaryRule(label, "fixed", name=f"boundary {label}")


def stiffness_in_words(stiffness: float, unit: str = "") -> str:
    """Format a stiffness for display: "20 kPa", or "rigid"."""
    return _RIGID if stiffness == RIGID else f"{stiffness:g} {unit}".rstrip()


def stiffness_image(labels: npt.ArrayLike, materials: Iterable[Material]) -> FloatArray:
    """Return an image of the stiffness of each pixel's material.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
        Label of the tissue at each pixel.
    materials : iterable of Material
        Materials for all values in `labels`, including 0; other materials are ignored.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        Argument `stiffness` of a `Problem`; infinite in rigid tissue.

    Raises
    ------
    ProblemError
        If a label does not have exactly one material.
    """
    image, present, table = _read("stiffness", "materials", Material, labels, materials)
    return _at_labels(image, present, [table[int(label)].stiffness for label in present])


def poisson_image(labels: npt.ArrayLike, materials: Iterable[Material]) -> float | FloatArray:
    """Return an image of the Poisson's ratio of each pixel's material.

    Parameters
    ----------
    labels, materials
        As for `stiffness_image`.

    Returns
    -------
    float or ndarray, shape ([D,] H, W), float32
        Argument `poisson` of an `ElasticPrior`: a number if all deformable tissue has the same
        ratio, otherwise an image that is 0 in void and rigid tissue.

    Raises
    ------
    ProblemError
        If a label does not have exactly one material.
    """
    image, present, table = _read("stiffness", "materials", Material, labels, materials)
    rows = [table[int(label)] for label in present]
    tissues = [material for material in rows if material.is_deformable]
    if len({material.poisson for material in tissues}) <= 1:
        return tissues[0].poisson if tissues else USUAL_POISSON
    values = [material.poisson if material.is_deformable else 0.0 for material in rows]
    return _at_labels(image, present, values)


def boundary_images(
    labels: npt.ArrayLike,
    rules: Iterable[BoundaryRule],
    *,
    spacing: float | Sequence[float],
) -> tuple[FloatArray, FloatArray]:
    """Return images of the observed displacement and its confidence, from labels and rules.

    Each connected part of an expanding label moves along the outward normal of its outer outline;
    holes are filled. Therefore a painted ring around a tumour moves radially. If the whole tumour
    is painted, its rim moves in the same way, and its interior is free.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
        Boundary label of each pixel; 0 where the motion is not observed.
    rules : iterable of BoundaryRule
        Rules for all values in `labels` above 0; other rules are ignored.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis, in the unit of the displacements; a single number applies
        to all axes.

    Returns
    -------
    observed : ndarray, shape ([D,] H, W, n), float32
        Material displacement in the order of the axes, in the unit of `spacing`.
    confidence : ndarray, shape ([D,] H, W, n), float32
        Confidence of each component; 0 in unpainted pixels, under forces, where tissue slides or is
        removed, in the interior of an expanding patch, and in an expanding spot that is too small
        to have a direction.

    Raises
    ------
    ProblemError
        If a label does not have exactly one rule, if a rule has more components than the image has
        axes, or if an expanding label is an open line, which has no interior.
    """
    image, present, table = _read("observed", "rules", BoundaryRule, labels, rules)
    n = image.ndim
    sizes = checked_spacing(spacing, n)
    for rule in table.values():
        for name, values in (("vector", rule.vector), ("confidence", rule.confidence)):
            if len(values) > n:
                raise ProblemError(
                    "observed",
                    f"has a rule for {quoted(rule)} with the {name} {values}. Use (row, col).",
                )
    y = np.zeros((*image.shape, n), dtype=np.float32)
    c = np.zeros_like(y)
    for label in present:
        rule = table[int(label)]
        painted = image == label
        if rule.action in (*FORCES, *_UNOBSERVED):
            continue
        c[painted] = (*(max(rule.confidence),) * (n - len(rule.confidence)), *rule.confidence)
        if rule.action == "move":
            y[painted] = (*(0.0,) * (n - len(rule.vector)), *rule.vector)
        elif rule.action == "expand":
            normals = outward_normals(painted, sizes, quoted(rule))
            y[painted] = np.float32(rule.amount) * normals[painted]
            c[painted & ~normals.any(axis=-1)] = 0
    return y, c


def _read(
    field: str, name: str, kind: type, labels: npt.ArrayLike, rows: Iterable[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], dict[int, Any]]:
    """Return the label image, the labels that it contains, and the table rows by label."""
    image = whole_numbers(field, labels)
    if image.dtype.kind not in "biu" or image.ndim not in (2, 3):
        raise ProblemError(
            field,
            f"has labels of type {image.dtype} and shape {image.shape}. Use an image (H, W) or a "
            "volume (D, H, W) of whole numbers, one per material.",
        )
    table: dict[int, Any] = {}
    for row in rows if isinstance(rows, Iterable) else [rows]:
        refuse_unless(isinstance(row, kind), name, row, f"a list of {kind.__name__}")
        if row.label in table:
            raise ProblemError(field, f"has two {name} for label {row.label}. Remove one.")
        table[row.label] = row
    present = np.unique(image)
    if kind is BoundaryRule:
        present = present[present != 0]
    missing = [str(label) for label in present if int(label) not in table]
    if missing:
        raise ProblemError(
            field,
            f"has labels without a {'rule' if kind is BoundaryRule else 'material'}: "
            f"{', '.join(missing[:10])}. Add each label to the table, or erase its pixels.",
        )
    return image, present, table


def quoted(row: Material | BoundaryRule) -> str:
    """Format the label and name of a row of a table."""
    return f"label {row.label} ({row.name})" if row.name else f"label {row.label}"


def unlisted(labels: npt.ArrayLike, rows: Iterable[Material | BoundaryRule]) -> list[int]:
    """Return the sorted labels of an image that are missing from a table."""
    return sorted({*np.unique(labels).tolist()} - {row.label for row in rows})


def _at_labels(
    image: npt.NDArray[Any], present: npt.NDArray[Any], values: Sequence[float]
) -> FloatArray:
    """Return an image of the value of each pixel's label; `present` lists the sorted labels."""
    return np.asarray(values, dtype=np.float32)[np.searchsorted(present, image)]
