"""Conversion of a study to a problem, shared by the window, the Python API and the shell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import compress
from operator import add
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_kind
from napari_hmrf.errors import ArgumentError, LayerError, ProblemError
from napari_hmrf.field.resample import unknown_values
from napari_hmrf.notes import Note
from napari_hmrf.real_arrays import as_int32, first_index, how_many
from napari_hmrf.solver.body_forces import weight
from napari_hmrf.solver.caveats import caveats, missing_constraint
from napari_hmrf.solver.data_term import combined_data
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Elastic, Prior
from napari_hmrf.solver.problem import FloatArray, Problem, as_stiffness, check_reach
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, solve
from napari_hmrf.solver.uncertain_landmarks import typical_stiffness
from napari_hmrf.solver.unconnected import left_at_rest, scraps
from napari_hmrf.solver.volume_memory import STUDY, require_memory
from napari_hmrf.study.landmark_data import (
    landmark_caveats,
    landmark_data,
    landmarks_hold,
    points_in_tissue,
    sites_of,
    uncertain_landmarks,
)
from napari_hmrf.study.shortcomings import shortcomings
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import refuse_unsupported
from napari_hmrf.study.without_effect import (
    asks_motion,
    marks_without_effect,
    rows_without_effect,
)
from napari_hmrf.tissue.boundary_rules import (
    Material,
    boundary_images,
    default_material,
    poisson_image,
    sliding_parts,
    stiffness_image,
    stiffness_in_words,
    unlisted,
)
from napari_hmrf.tissue.drawing import Canvas, Drawing, Stroke
from napari_hmrf.tissue.material_presets import OTHER, Palette
from napari_hmrf.tissue.normals import outer_rim
from napari_hmrf.tissue.painted_loads import boundary_loads, growth_loads
from napari_hmrf.tissue.sliding import inner_surface, sliding_data
from napari_hmrf.tissue.surroundings import air_that_is_tissue, dark_border

#: Stiffness of the subject and of its dark surroundings if there is no tissue map. The surroundings
#: are too soft to impede motion, but because they are tissue, they still constrain the subject.
_TISSUE, _SURROUNDINGS = 1.0, 0.01

_OVER = Note(
    "the drawing moves tissue that is painted as held, and takes precedence at overlaps; "
    "make the drawing smaller, or move it farther away",
    short="the drawing moves held tissue",
)

_NOTHING_ACTS = (
    "nothing acts on the tissue that remains, so it does not move: set its weight, or what acts on "
    "the cavity (`weight=..., cavity=...`)"
)

_NO_UNIT = Note(
    "forces are in the unit of stiffness, which is not known here: a pressure of 0.1 strains "
    "tissue of stiffness 1 by about a tenth",
    short="the unit of the forces is unknown",
)


@dataclass(frozen=True, eq=False)
class Statement:
    """Problem that represents a study, with its prior and optimizer.

    Attributes
    ----------
    problem : Problem
    prior : ElasticPrior, NeoHookeanPrior or SeilerPrior
        Prior with the Poisson's ratios of the tissues.
    optimizer : ICM or Multigrid
    at_rest : ndarray of bool, shape ([D,] H, W)
        Mask of insufficiently constrained tissue, which is excluded from the problem and does not
        move.
    removed : ndarray of bool, shape ([D,] H, W), optional
        Mask of the tissue that labels or strokes remove; None if no tissue is removed.
    edge : ndarray of bool, shape ([D,] H, W), optional
        Mask of the outer edge of the tissue, if it is held.
    labels : ndarray of int, shape ([D,] H, W), optional
        Tissue labels including brush strokes; None unless strokes changed labels of the tissue's
        own table.
    study : Study, optional
        Study from which the problem was built.
    """

    problem: Problem
    prior: Prior
    optimizer: Optimizer
    at_rest: npt.NDArray[np.bool_]
    labels: npt.NDArray[np.int32] | None = None
    study: Study | None = None
    removed: npt.NDArray[np.bool_] | None = None
    edge: npt.NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        return f"Statement({self.problem!r}, {self.prior!r}, {self.optimizer!r})"


@dataclass(frozen=True, eq=False)
class Ground:
    """Interpretation of a study without its drawing: stiffness and boundary conditions.

    Attributes
    ----------
    study : Study
    base : Canvas
        Images of the boundary conditions, without the drawing.
    stiffness : ndarray, shape ([D,] H, W), float32
        Young's modulus; 0 in void, infinite in rigid tissue.
    prior : Prior
        Prior with the Poisson's ratios of the tissues.
    body : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue without the dark surroundings.
    palette : Palette
        Tissues that brushes can paint; the labels of `base` refer to them.
    notes : tuple of str
        Clauses for the user about the interpretation of the study.
    """

    study: Study
    base: Canvas
    stiffness: FloatArray
    prior: Prior
    body: npt.NDArray[np.bool_]
    palette: Palette
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, study: Study, checkpoint: Callable[[], None] = lambda: None) -> Ground:
        """Interpret a study without its drawing; callable from any thread.

        The interpretation of a large image is slow.

        Parameters
        ----------
        study : Study
        checkpoint : callable
            Called between the steps; it may raise an error to cancel the computation.

        Returns
        -------
        Ground

        Raises
        ------
        ProblemError
            If a part of the study is invalid; the error names the part and suggests a remedy.
        """
        _check_study(study)
        _refuse_other_axes(study)
        _refuse_thin(study)
        require_memory(study.grid.shape, STUDY, study.named("image", "tissue"))
        refuse_unsupported(study)
        image = study.pictures.image
        if image is not None and image.dtype.kind == "f" and not np.isfinite(image).any():
            here = "is NaN everywhere in this slice. Choose another image or slice."
            raise LayerError(study.named("image"), here)
        checkpoint()
        with study.naming():
            ground = _tissue_of(study)
        base, tissue, notes = ground.base, ground.stiffness > 0, [*ground.notes]
        checkpoint()
        notes += filter(None, [_unknown_pixels(study)])
        _observe(study, base)
        ignored = int(((base.confidence > 0).any(axis=-1) & ~tissue).sum())
        if ignored:
            pixels = "1 boundary pixel" if ignored == 1 else f"{ignored} boundary pixels"
            notes.insert(0, f"{pixels} outside tissue {'was' if ignored == 1 else 'were'} ignored")
        checkpoint()
        if study.motion.hold_edge:
            free = ~(base.confidence > 0).any(axis=-1)
            if study.motion.labels is not None:  # an expanding patch must remain free inside
                free &= study.motion.labels == 0
            for part in (tissue, ground.body):
                rim = outer_rim(part, diagonal=True) & free
                base.observed[rim], base.confidence[rim], base.edge[rim] = 0, 1, True
        return replace(ground, notes=tuple(notes))

    def statement(self, drawn: Canvas | None = None, drawing: Drawing | None = None) -> Statement:
        """Return the problem that consists of this ground and a drawing.

        Insufficiently constrained tissue is excluded from the problem and does not move.

        Parameters
        ----------
        drawn : Canvas, optional
            `base` with a drawing; by default with `drawing`.
        drawing : Drawing, optional
            Source of landmarks with a standard deviation, which are not painted; by default the
            drawing of the study.

        Returns
        -------
        Statement

        Raises
        ------
        ProblemError
            If a part of the study is invalid; the error names the part and suggests a remedy.
        """
        drawing = self.study.motion.drawing if drawing is None else drawing
        canvas = drawing.render(self.base) if drawn is None else drawn
        m, prior = self.palette.painted(canvas.labels, self.base.labels, self.stiffness, self.prior)
        painted = self.palette.is_table and m is not self.stiffness
        labels = canvas.labels.copy() if painted else None
        at_rest = np.zeros(m.shape, dtype=bool)
        removed = canvas.removed & (m > 0) if canvas.removed.any() else None
        if removed is not None:
            m = np.where(removed, np.float32(0), m)
            self._check_remaining(m, canvas)
        slides = bool(canvas.slides.any())
        refuse_unsupported(self.study, drawing=drawing, labels=canvas.labels, slides=slides)
        marks = uncertain_landmarks(drawing)
        points, near = points_in_tissue(marks, m > 0)
        marks, points = tuple(compress(marks, near)), points[near]
        if isinstance(prior, Elastic):
            held = (canvas.confidence > 0) | (canvas.slides != 0)[..., None]
            if marks:
                held |= sites_of(points, m.shape)
            if self.study.motion.measured is not None:
                held |= self.study.motion.measured.sites[..., None]
            at_rest = scraps(m > 0, held)
            if at_rest.any():
                m = np.where(at_rest, np.float32(0), m)
        with self.study.naming():
            loads, spacing = self._loads(canvas.labels, m, removed), self.study.grid.spacing
            y, precision = sliding_data(canvas.observed, canvas.slides, m, spacing)
            motion = self.study.motion
            if motion.measured is not None:
                own = self.typical_stiffness * motion.measured.precision
                y, precision = combined_data(
                    (y, precision), (motion.measured.displacement, own), canvas.confidence > 0
                )
            landmarks = landmark_data(
                marks, points, m, self.body, spacing, motion.typical_strain, bool(motion.drift)
            )
            problem = Problem(
                observed=y,
                confidence=canvas.confidence,
                stiffness=m,
                spacing=spacing,
                loads=loads,
                precision=precision,
                landmarks=landmarks,
                sliding=sliding_parts(canvas.labels, self.palette.materials, m),
            )
        edge = canvas.edge if motion.hold_edge else None
        optimizer = self.study.optimizer
        return Statement(problem, prior, optimizer, at_rest, labels, self.study, removed, edge)

    def _check_remaining(self, m: FloatArray, canvas: Canvas) -> None:
        """Raise an error if no tissue, or no constrained tissue, remains after the removal."""
        name = self.study.named("drawing" if self.study.motion.drawing.marks else "boundary")
        if not (m > 0).any():
            raise ProblemError(name, "removes all tissue, so nothing can deform. Remove less.")
        held = (canvas.confidence > 0).any(axis=-1)
        if held.any() and not (held & (m > 0)).any():
            raise ProblemError(
                name,
                "removes all tissue that is held or moved. Remove less, or hold other tissue.",
            )

    @cached_property
    def typical_stiffness(self) -> float:
        """Stiffness to which the precision of measured motion is relative."""
        return typical_stiffness(self.stiffness[self.body])

    def _loads(
        self, labels: npt.NDArray[Any], m: FloatArray, removed: npt.NDArray[np.bool_] | None
    ) -> Loads | None:
        """Return the loads due to growth, forces, weight and cavities; None if there are none."""
        motion, spacing = self.study.motion, self.study.grid.spacing
        parts = [growth_loads(labels, self.palette.materials)]
        if motion.labels is not None:
            parts.append(boundary_loads(motion.labels, motion.rules, m, spacing=spacing))
        if any(motion.weight):
            # Dark surroundings are soft tissue in the model, but have no weight until painted.
            air = ~self.body & (m == self.stiffness)
            density = np.where(air, 0.0, 1.0)
            parts.append(weight(m, motion.weight, density=density, spacing=spacing))
        if removed is not None and motion.cavity.acts:
            parts.append(motion.cavity.loads(m, removed, motion.weight, spacing=spacing))
        known = [part for part in parts if part is not None]
        return reduce(add, known) if known else None

    def refuse_motionless(self, statement: Statement) -> None:
        """Raise an error if a problem has no displacement, force, growth or removed tissue.

        Raises
        ------
        ProblemError
            If no tissue would move; the error lists inputs without effect and suggests a remedy.
        """
        if not asks_motion(statement.problem) and statement.removed is None:
            idle = (*self.unused(statement), *self.idle_marks(statement))
            notes = "".join(f"; {note}" for note in idle)
            raise ProblemError(
                "motion",
                f"nothing moves{notes}. Prescribe a displacement, force or growth "
                "(`Motion(drawing=..., labels=..., observed=..., weight=...)`).",
            )

    def idle_marks(self, statement: Statement) -> tuple[str, ...]:
        """Return clauses about marks of the drawing that have no effect."""
        drawing, tissue = self.study.motion.drawing, statement.problem.tissue | statement.at_rest
        if statement.removed is not None:
            tissue |= statement.removed
        return tuple(marks_without_effect(drawing, tissue, self.base))

    def _assumed_tissues(self) -> list[str]:
        """Return clauses about painted tissues that are not in the palette."""
        marks, unit = self.study.motion.drawing.marks, self.palette.unit
        painted = [
            mark.label for mark in marks if isinstance(mark, Stroke) and mark.action == "tissue"
        ]
        return [
            f"painted tissue {row.label} is not listed: '{row.name}' "
            f"({stiffness_in_words(row.stiffness, unit)}) is assumed"
            for row in self.palette.assumed(painted)
        ]

    def unused(self, statement: Statement) -> tuple[str, ...]:
        """Return clauses about rules, growth and sliding that have no effect.

        The window does not display these clauses, because its tables apply to all slices.
        """
        labels = statement.labels
        if labels is None and self.study.tissue.labels is not None:
            labels = self.base.labels
        return tuple(rows_without_effect(self.study, labels, statement.problem.stiffness > 0))

    def without_air(self, solution: Solution) -> Solution:
        """Return a solution of the study whose tissue and displacement do not include air."""
        body = solution.tissue & self.body
        if np.array_equal(body, solution.tissue):
            return solution
        field = np.where(body[..., None], solution.displacement, np.float32(0))
        return replace(solution, displacement=field, tissue=body)

    def notes_on(self, statement: Statement) -> tuple[str, ...]:
        """Return clauses for the user about the interpretation of a problem."""
        motion, problem = self.study.motion, statement.problem
        notes = [*self.notes]
        notes += self._assumed_tissues()
        notes += self.idle_marks(statement)
        notes.append(self._removed_constraints(statement))
        if statement.at_rest.any():
            notes.append(left_at_rest(statement.at_rest))
        if motion.labels is not None:
            still = (self.base.confidence > 0) & (self.base.observed == 0)
            over = (still & problem.known & (problem.observed != 0))[motion.labels != 0].any()
            notes.append(_OVER if over else "")
        notes += landmark_caveats(motion, problem)
        is_marked = motion.labels is not None or problem.observed.any()
        if statement.removed is not None and not asks_motion(problem):
            notes.append(_NOTHING_ACTS)
        elif is_marked and not landmarks_hold(motion.drawing, problem):
            notes.append(missing_constraint(problem))
        if self.study.slides:
            slides = motion.drawing.render(self.base).slides
            stiffness, spacing = problem.stiffness, self.study.grid.spacing
            notes.append(inner_surface(slides, stiffness, spacing))
        pulled = problem.loads is not None and problem.loads.force is not None
        notes.append(_NO_UNIT if pulled and not self.study.tissue.unit else "")
        if (image := self.study.pictures.image) is not None:
            notes.append(air_that_is_tissue(image, self.body))
        notes += caveats(problem, statement.prior, statement.optimizer)
        return tuple(filter(None, notes))

    def _removed_constraints(self, statement: Statement) -> str:
        """Return a clause about removed tissue that is also held or moved; "" if there is none."""
        if statement.removed is None:
            return ""
        both = statement.removed & (statement.problem.confidence > 0).any(axis=-1)
        if self.study.motion.hold_edge:  # the outer edge of removed tissue is not held on purpose
            for part in (self.stiffness > 0, self.body):
                both &= ~outer_rim(part, diagonal=True)
        count = int(both.sum())
        if not count:
            return ""
        pixels = (
            "1 pixel of removed tissue is"
            if count == 1
            else f"{count} pixels of removed tissue are"
        )
        return f"{pixels} also held or moved, which has no effect"


def build_problem(study: Study) -> Statement:
    """Convert a study to a problem, with its prior and optimizer.

    Parameters
    ----------
    study : Study

    Returns
    -------
    Statement
        Its attributes `problem`, `prior` and `optimizer` are the arguments of `solve`.

    Raises
    ------
    ProblemError
        If a part of the study is invalid; the error names the part and suggests a remedy.
    """
    return Ground.of(study).statement()


def solve_study(
    study: Study,
    *,
    stated: Statement | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Solution:
    """Solve a study from a cold start.

    Parameters
    ----------
    study : Study
    stated : Statement, optional
        Result of `build_problem` for this study; computed by default.
    backend, progress, cancel
        As for `solve`.

    Returns
    -------
    Solution
        Solution with the place and the unit of the study's grid. Its notes list shortcomings such
        as folds. Folds of volumes are not counted; use `Solution.count_folds` for these. If
        `stated` is None, the notes also list inputs without effect and assumed values.

    Raises
    ------
    ArgumentError
        If `study` is not a Study, or `stated` is not a Statement of this study.
    ProblemError
        If a part of the study is invalid, or if there is no displacement, force or growth; the
        error names the part and suggests a remedy.
    Cancelled, ConvergenceError, BackendError
        As for `solve`.
    """
    _check_study(study)
    notes: tuple[str, ...] = ()
    if stated is None:
        ground = Ground.of(study)
        stated = ground.statement()
        ground.refuse_motionless(stated)
        notes = (*ground.unused(stated), *ground.notes_on(stated))
        del ground  # its images need as much memory as the problem
    require_kind(Statement, "stated", stated, "build_problem(study)")
    if stated.study is None or not stated.study.same_as(study):
        raise ArgumentError(
            "stated is the problem of another study. Pass build_problem(study), or omit stated."
        )
    solution = solve_statement(study, stated, backend=backend, progress=progress, cancel=cancel)
    # Counting folds takes milliseconds for an image, but 5 % of the solve time for a volume.
    folds = 0 if solution.tissue.ndim == 3 else solution.count_folds()
    short = shortcomings(solution, solution.unit, folds, stated.problem, stated.edge)
    notes = (*drift_clauses(solution), *notes) if notes else solution.notes
    return replace(solution, notes=(*short, *notes))


def solve_statement(
    study: Study,
    stated: Statement,
    *,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Solution:
    """Solve the problem of a study from a cold start, without checks for shortcomings.

    Parameters
    ----------
    study : Study
    stated : Statement
        Result of `build_problem` for this study.
    backend, progress, cancel
        As for `solve`.

    Returns
    -------
    Solution
        Solution with the place and the unit of the study's grid.
    """
    with study.naming():
        solution = solve(
            stated.problem,
            stated.prior,
            optimizer=stated.optimizer,
            backend=backend,
            progress=progress,
            cancel=cancel,
        )
    return replace(at_place_of(study, solution), removed=stated.removed)


def at_place_of(study: Study, solution: Solution) -> Solution:
    """Return a solution with the place of the grid of a study, and its units."""
    place = study.grid.place
    frame = None if place is None else place.as_dict()
    parameters = dict(solution.provenance.parameters)
    if unit := study.tissue.stiffness_unit:
        parameters["tissue"] = {"unit": unit}
    provenance = replace(solution.provenance, parameters=parameters)
    return replace(solution, frame=frame, unit=study.grid.unit, provenance=provenance)


def _check_study(study: object) -> None:
    """Raise an error if the argument is not a study."""
    if isinstance(study, Problem):
        raise ArgumentError("study is a Problem. Call solve(problem), or pass a Study.")
    require_kind(Study, "study", study, "Study(grid, tissue, motion)")


def _refuse_other_axes(study: Study) -> None:
    """Raise an error if a mark and the grid differ in their number of axes."""
    # `Study` does not check this, because the window changes grid and drawing one after the other.
    axes = len(study.grid.shape)
    for mark in study.motion.drawing.marks:
        place = mark.lines[0][0]
        if len(place) != axes:
            raise ProblemError(
                study.named("drawing"),
                f"has the {type(mark).__name__} at {place}, with {len(place)} axes, but the grid "
                f"has {axes}. Pass positions as "
                f"{'(row, col)' if axes == 2 else '(plane, row, col)'}.",
            )


def _refuse_thin(study: Study) -> None:
    """Raise an error for a volume of one slice, in which elastic tissue has no elements."""
    shape = study.grid.shape
    if len(shape) == 3 and 1 in shape and isinstance(study.prior, Elastic):
        across = shape.index(1)
        raise ProblemError(
            study.named("image", "tissue"),
            f"is a volume with one voxel along axis {across}. Pass the slice as an image, for "
            f"example data.squeeze({across}) on grid_of_image(image).",
        )


def _tissue_of(study: Study) -> Ground:
    """Return the ground of a study with its tissues, but without boundary conditions."""
    tissue, image, shape, prior = study.tissue, study.pictures.image, study.grid.shape, study.prior
    palette, notes = Palette.of_preset(tissue.preset), [*study.notes]
    labels, around = np.full(shape, OTHER, dtype=np.int32), np.zeros(shape, dtype=bool)
    if tissue.labels is not None:
        known, name = tissue.materials, study.named("tissue", "image")
        missing = [] if known else unlisted(tissue.labels, known)
        new = [default_material(label, known) for label in missing]
        notes += [
            Note(
                f"label {row.label} of '{name}' is not in the table: stiffness {row.stiffness:g} "
                "is assumed",
                short=f"label {row.label} is not in the table",
            )
            for row in new
        ]
        labels, rows = as_int32(study.named("tissue", "image"), tissue.labels), (*known, *new)
        m = stiffness_image(tissue.labels, rows)
        if tissue.without_border and image is not None:
            air = dark_border(image, len(shape)) & (tissue.labels == 0)
            m = np.where(air, np.float32(0), m)
        if isinstance(prior, Elastic):
            prior = replace(prior, poisson=poisson_image(tissue.labels, rows))
        spare: tuple[Material, ...] = ()
        if tissue.preset is not None:
            spare = Palette.of_preset(tissue.preset, typical_stiffness(m)).materials
        palette = Palette(rows, tissue.unit, is_table=True, spare=spare)
    elif tissue.stiffness is not None:
        m = as_stiffness(tissue.stiffness)
    elif tissue.curve is not None:
        intensities = study.intensities
        if intensities is None:
            raise ProblemError(
                study.named("tissue"),
                "is defined by a curve of the image's brightness, but the study has no image. Add "
                "an image (`pictures=Pictures(image)`).",
            )
        _refuse_unknown_brightness(study, intensities)
        m = tissue.curve(intensities)
    else:
        around = around if image is None else dark_border(image, len(shape))
        m = np.where(around, np.float32(_SURROUNDINGS), np.float32(_TISSUE))
        labels = np.where(around, OTHER, palette.unpainted_label).astype(np.int32)
    if tissue.stiffness is not None or tissue.curve is not None:
        palette = Palette.of_preset(tissue.preset, typical_stiffness(m), tissue.stiffness_unit)
    base, body = Canvas.blank(shape, study.grid.spacing, labels), (m > 0) & ~around
    if not body.all():
        base = replace(base, surroundings=~body)
    return Ground(study, base, m, prior, body, palette, tuple(notes))


def _refuse_unknown_brightness(study: Study, intensities: npt.NDArray[Any]) -> None:
    """Raise an error if brightness determines stiffness and is NaN or infinite somewhere."""
    unknown = ~np.isfinite(intensities)
    if unknown.any():
        raise LayerError(
            study.named("image"),
            f"has {how_many(unknown)} that are NaN or infinite, the first at "
            f"{first_index(unknown)}, but its brightness determines the stiffness. Replace "
            "them with numbers, or define the tissue by labels.",
        )


def _unknown_pixels(study: Study) -> str:
    """Return a clause about the NaN or infinite pixels of the image; "" if there are none."""
    image, name = study.pictures.image, f"'{study.named('image')}'"
    return "" if image is None else unknown_values(image, len(study.grid.shape), name)


def _observe(study: Study, base: Canvas) -> None:
    """Write the boundary conditions of a study to a blank canvas."""
    motion = study.motion
    if motion.observed is not None and motion.confidence is not None:
        c, by_component = motion.confidence, motion.confidence.ndim > len(base.shape)
        base.confidence[...] = c if by_component else c[..., None]
        base.observed[...] = np.where(base.confidence != 0, motion.observed, 0)
    if motion.labels is not None:
        with study.naming(drawn=False):
            y, c = boundary_images(motion.labels, motion.rules, spacing=base.spacing)
        painted = motion.labels != 0
        base.observed[painted], base.confidence[painted] = y[painted], c[painted]
        for rule in motion.rules:
            under = motion.labels == rule.label
            if rule.action == "slide":
                base.slides[under], base.observed[under, 0] = rule.label, rule.amount
            elif rule.action == "remove":
                base.removed[under] = True
    with study.naming(drawn=False):
        check_reach(base.observed, base.spacing)
