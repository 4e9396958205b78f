"""From painted labels and two small tables to the images the method takes.

A *material* says how stiff the tissue under a label is, and how it grows; a *boundary rule* says
how the tissue under a label was seen to move and how sure that is, or what presses or pulls there.
Both tables belong to integer label images, as napari's Labels layers hold them; nothing here needs
napari.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_one_of, is_whole, real, reals, refuse_unless, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.normals import outward_normals
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.solver.problem import FloatArray, as_numbers

Action = Literal["fixed", "move", "expand", "press", "pull"]
#: Those that are forces, and observe nothing.
FORCES: tuple[Action, ...] = "press", "pull"
#: In all directions, or along each axis of the image.
Growth = float | tuple[float, ...]

#: The common choice for soft tissue, where nothing better is known.
USUAL_POISSON = 0.45
#: The stiffness of a body that moves as one, such as bone or an implant.
RIGID = math.inf
_RIGID = "rigid"
#: The name of label 0, and the stiffness of a new tissue where nothing is known.
UNPAINTED = "everything unpainted"
_STIFFNESS = 20.0
#: Ten times longer: more is a number in per cent.
_LARGEST_GROWTH = 10.0
#: Single precision holds no larger one: it would come out as rigid.
LARGEST_STIFFNESS = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Material:
    """What a tissue label means.

    Attributes
    ----------
    label : int
        Its value in the label image; 0 is what was left unpainted.
    name : str
        For people.
    stiffness : float
        Young's modulus in any unit, the same for all materials: only ratios matter. 0 is void (no
        tissue: air, or whatever does not hold on to its surroundings); `RIGID`, which is infinite,
        moves as one, and only an `ElasticPrior` takes it.
    poisson : float
        Poisson's ratio, 0 to 0.499; only elastic tissue knows it, and neither void nor what is
        rigid has one.
    growth : float or tuple of float
        How much longer it would be if it were free: 0.1 is a tenth. In all directions, or along
        (row, col), in a volume (plane, row, col); neither void nor what is rigid grows.

    Raises
    ------
    ProblemError
        If the stiffness is below 0.
    """

    label: int
    name: str
    stiffness: float
    poisson: float = USUAL_POISSON
    growth: Growth = 0.0

    def __post_init__(self) -> None:
        if real(self.stiffness) < 0:
            raise _wrong_stiffness(self)

    @property
    def is_rigid(self) -> bool:
        """Whether it moves as one."""
        return real(self.stiffness) == RIGID

    @property
    def is_deformable(self) -> bool:
        """Whether it is tissue that changes its shape: neither void nor rigid."""
        return 0 < real(self.stiffness) < RIGID

    @property
    def grows(self) -> bool:
        """Whether it is to become longer, or shorter, by itself."""
        return self.is_deformable and bool(np.any(self.growth))

    def as_row(self) -> dict[str, Any]:
        """The material in JSON types, which have no infinite number: the stiffness is "rigid"."""
        row = asdict(self)
        if not self.grows:  # so that earlier versions read it
            del row["growth"]
        return {**row, "stiffness": _RIGID} if self.is_rigid else row

    @classmethod
    def of_row(cls, **row: Any) -> Material:
        """The material that `as_row` said."""
        return cls(**{**row, "stiffness": read_stiffness(row["stiffness"])})


@dataclass(frozen=True)
class BoundaryRule:
    """What a boundary label means.

    Attributes
    ----------
    label : int
        Its value in the label image, above 0: what is unpainted is not observed.
    action : {"fixed", "move", "expand", "press", "pull"}
        The tissue under the label stays where it is, moves by `vector`, or moves outward by
        `amount` (inward where negative): all of a ring, but only the rim of a patch. Or it is free,
        and its surface under the label, where tissue ends, is pressed on by `amount`, or pulled at
        by `vector`.
    vector : tuple of float
        Displacement in (row, col) direction, in the unit of the pixel spacing; in a volume across
        no plane, unless it is (plane, row, col). Of a pull a force per area, in that of stiffness.
    amount : float
        Displacement along the outward normal, in the unit of the pixel spacing; of a pressure a
        force per area against it, in the unit of stiffness.
    confidence : tuple of float
        How sure the (row, col) component is, from 0 (not observed) to 1 (complete); in a volume
        that across planes is as sure as the surer of these, unless it is (plane, row, col).
    name : str
        For people.
    """

    label: int
    action: Action
    _: KW_ONLY
    vector: tuple[float, ...] = (0.0, 0.0)
    amount: float = 0.0
    confidence: tuple[float, ...] = (1.0, 1.0)
    name: str = ""


def default_material(label: int, known: Iterable[Material]) -> Material:
    """A new tissue behaves as the first known one that is not rigid, until told otherwise."""
    name = UNPAINTED if label == 0 else f"tissue {label}"
    first = next((material for material in known if material.is_deformable), None)
    if first is None:
        return Material(label, name, _STIFFNESS)
    return replace(first, label=label, name=name)


def default_rigid(label: int) -> Material:
    """What moves as one, to be painted."""
    return Material(label, "bone or implant", RIGID)


def default_rule(label: int) -> BoundaryRule:
    """A new boundary stays where it is, until told otherwise."""
    return BoundaryRule(label, "fixed", name=f"boundary {label}")


def is_growth(strain: Any) -> bool:
    """Whether tissue can grow by that: it does not shrink to nothing, nor is it a slip of 100."""
    return -1 < real(strain) <= _LARGEST_GROWTH


def read_stiffness(value: Any) -> Any:
    """Take the word "rigid", however it is spelt, as `RIGID`; anything else is left as it is."""
    is_word = isinstance(value, str) and value.strip().casefold() == _RIGID
    return RIGID if is_word else value


def stiffness_in_words(stiffness: float, unit: str = "") -> str:
    """Say a stiffness for people: "20 kPa", or "rigid"."""
    return _RIGID if stiffness == RIGID else f"{stiffness:g} {unit}".rstrip()


def stiffness_image(labels: npt.ArrayLike, materials: Iterable[Material]) -> FloatArray:
    """Give every pixel the stiffness of its material.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
    materials : iterable of Material
        One for each value in `labels`, 0 included; more do no harm.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        The stiffness of a `Problem`; infinite where tissue is rigid.

    Raises
    ------
    ProblemError
        If a label has no material or two, or a stiffness is neither `RIGID` nor a number of 0 or
        more that single precision holds.
    """
    image, present, table = _read("stiffness", "materials", Material, labels, materials)
    for material in table.values():
        stiffness = real(material.stiffness)
        if not (0 <= stiffness <= LARGEST_STIFFNESS or stiffness == RIGID):
            raise _wrong_stiffness(material)
    return _at_labels(image, present, [table[int(label)].stiffness for label in present])


def poisson_image(labels: npt.ArrayLike, materials: Iterable[Material]) -> float | FloatArray:
    """Give every pixel the Poisson's ratio of its material.

    Parameters
    ----------
    labels, materials
        As for `stiffness_image`.

    Returns
    -------
    float or ndarray, shape ([D,] H, W), float32
        `poisson` of an `ElasticPrior`: one number if all tissue has the same. 0 in void and in
        what is rigid, which have none.

    Raises
    ------
    ProblemError
        If a label has no material or two, or a tissue's ratio is out of range.
    """
    image, present, table = _read("stiffness", "materials", Material, labels, materials)
    there = [table[int(label)] for label in present]
    low, high = POISSON_RANGE
    tissues = [material for material in there if material.is_deformable]
    for material in tissues:
        if not low <= real(material.poisson) <= high:
            raise ProblemError(
                "stiffness",
                f"gives {quoted(material)} a Poisson's ratio of {shown(material.poisson)}. Give a "
                f"number from {low:g} to {high:g}.",
            )
    if len({material.poisson for material in tissues}) <= 1:
        return float(tissues[0].poisson) if tissues else USUAL_POISSON
    values = [material.poisson if material.is_deformable else 0.0 for material in there]
    return _at_labels(image, present, values)


def boundary_images(
    labels: npt.ArrayLike,
    rules: Iterable[BoundaryRule],
    *,
    spacing: Sequence[float] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Give every painted pixel the displacement and the confidence of its rule.

    Each connected part of a label that expands moves along the outward normal of the outline that
    encloses it (its holes filled): a painted rim of a tumour moves radially, and so does the rim of
    a tumour painted full, whose inside follows as tissue does.

    Parameters
    ----------
    labels : array_like of int, shape ([D,] H, W)
        0 where nothing is observed.
    rules : iterable of BoundaryRule
        One for each value in `labels` above 0; more do no harm.
    spacing : sequence of float, shape (n,), optional
        Size of a pixel along each axis, in the unit of the displacements; by default 1.

    Returns
    -------
    observed : ndarray, shape ([D,] H, W, n), float32
        Material displacement in the order of the axes, in the unit of `spacing`.
    confidence : ndarray, shape ([D,] H, W, n), float32
        Confidence per component; 0 where nothing is painted or a force acts, inside a patch that
        expands, and on an expanding spot so small that it has no direction.

    Raises
    ------
    ProblemError
        If a label has no rule or two, a rule holds numbers out of range, or an open line is to
        expand (which of its sides is outside, nobody can say).
    """
    image, present, table = _read("observed", "rules", BoundaryRule, labels, rules)
    n = image.ndim
    sizes = (1.0,) * n if spacing is None else spacing
    for rule in table.values():
        _check_rule(rule, n)
    y = np.zeros((*image.shape, n), dtype=np.float32)
    c = np.zeros_like(y)
    for label in present:
        rule = table[int(label)]
        painted = image == label
        if rule.action in FORCES:
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
    field: str, what: str, kind: type, labels: npt.ArrayLike, rows: Iterable[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], dict[int, Any]]:
    """Labels as an image, those in it, and their rows by label."""
    image = as_numbers(field, labels)
    if image.dtype.kind not in "biu" or image.ndim not in (2, 3):
        raise ProblemError(
            field,
            f"has labels of type {image.dtype}, shape {image.shape}, but a 2-D image (H, W) or a "
            "volume (D, H, W) of whole numbers is needed, one per material.",
        )
    table: dict[int, Any] = {}
    for row in rows if isinstance(rows, Iterable) else [rows]:
        refuse_unless(isinstance(row, kind), what, row, f"a list, each a {kind.__name__}")
        if not is_whole(row.label):
            raise ProblemError(
                field, f"has {what} for label {shown(row.label)}. Give labels as whole numbers."
            )
        if row.label in table:
            raise ProblemError(field, f"has two {what} for label {row.label}. Remove one.")
        table[row.label] = row
    present = np.unique(image)
    if kind is BoundaryRule:
        present = present[present != 0]
    missing = [str(label) for label in present if int(label) not in table]
    if missing:
        raise ProblemError(
            field,
            f"has labels without a {'rule' if kind is BoundaryRule else 'stiffness'}: "
            f"{', '.join(missing[:10])}. Give each one in the table, or erase what is painted so.",
        )
    return image, present, table


def _check_rule(rule: BoundaryRule, n: int) -> None:
    vector, confidence = (
        reals(given, 3 if n == 3 and np.shape(given) == (3,) else 2)
        for given in (rule.vector, rule.confidence)
    )
    lengths = (*vector, real(rule.amount))
    sure = all(0 <= value <= 1 for value in confidence)
    for field, right, needed in (
        ("observed", rule.label > 0, "a label above 0: 0 is what is unpainted"),
        (
            "observed",
            is_one_of(rule.action, get_args(Action)),
            '"fixed", "move", "expand", "press" or "pull"',
        ),
        ("observed", all(map(math.isfinite, lengths)), "(row, col), or an amount"),
        ("confidence", sure, "the confidence as two values from 0 to 1, (row, col)"),
    ):
        if not right:
            raise ProblemError(field, f"has {shown(rule)} as a rule. Give {needed}.")


def _wrong_stiffness(material: Material) -> ProblemError:
    """Return the error for a stiffness that no tissue has."""
    return ProblemError(
        "stiffness",
        f"gives {quoted(material)} a stiffness of {shown(material.stiffness)}. Give a number above "
        f"0 (up to {LARGEST_STIFFNESS:.2g}), 0 where there is no tissue, or 'rigid' for what moves "
        "as one.",
    )


def quoted(row: Material | BoundaryRule) -> str:
    """Which row of a table it is, by its label and its name."""
    return f"label {row.label} ({row.name})" if row.name else f"label {row.label}"


def unlisted(labels: npt.ArrayLike, rows: Iterable[Any]) -> list[int]:
    """List the labels that are somewhere, and in no row of a table."""
    return sorted({*np.unique(labels).tolist()} - {row.label for row in rows})


def _at_labels(
    image: npt.NDArray[Any], present: npt.NDArray[Any], values: Sequence[float]
) -> FloatArray:
    """Give every pixel the value of its label, one of those `present`, which are in order."""
    return np.asarray(values, dtype=np.float32)[np.searchsorted(present, image)]
