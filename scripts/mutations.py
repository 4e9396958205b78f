"""Mutation tests of the package: a test must fail for each mutation.

    python scripts/mutations.py [number ...]

Each mutation changes a sign, an index, a weight or a constant, with an effect that a user would
notice. At least one of its tests must fail. The mutations are applied one at a time to a copy of
the package and its tests. The copy keeps the loops that numba has compiled, except for mutations of
a file with loops.
"""

from __future__ import annotations

import os
import queue
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
#: Folders that are copied.
_FOLDERS = "napari_hmrf", "shaders", "sample_data", "benchmarks", "tests", "validation"
#: Beginnings of the paths of files with compiled loops, relative to `napari_hmrf`.
_LOOPS = (
    "solver/backends/cpu/",
    "field/interpolation.py",
    "field/tetrahedron_raster.py",
    "field/triangle_raster.py",
    "field/volume_loops.py",
)
#: Pattern of the files in which numba stores compiled loops.
_COMPILED = "*.nb[ic]"
#: Number of mutations that are tested in parallel.
_AT_ONCE = os.cpu_count() or 1
#: Exit statuses of pytest if all tests pass, and if a test fails. Any other status means that no
#: test was run.
_PASSED, _FAILED = 0, 1


class Mutation(NamedTuple):
    """Error in a source file, and the tests that must detect it.

    Attributes
    ----------
    file : str
        Path of the file, relative to `napari_hmrf`.
    right, wrong : str
        Correct text, which must occur exactly once in the file, and its replacement.
    tests : str
        Arguments for pytest, separated by spaces: paths relative to `tests`.
    """

    file: str
    right: str
    wrong: str
    tests: str


MUTATIONS = (
    # the edited model and its forms
    Mutation(
        "study/edit_history.py",
        "        self._past.append(step)\n        self._future.clear()",
        "        self._past.append(step)",
        "study/test_edit_history.py",
    ),
    Mutation(
        "study/edit_history.py",
        "            back = step._replace(value=self._now[step.part])",
        "            back = step",
        "study/test_edit_history.py",
    ),
    Mutation(
        "study/study_model.py",
        "return known and image is not None",
        "return not known and image is not None",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "before = self.setdefault(part, type(now)())",
        "before = self.setdefault(part, now)",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        'self._set(part, now, word if step else "")',
        "self._set(part, now, word)",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "        if self.drawing_in_progress:\n            self.end()\n        self.slice",
        "        self.slice",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "            choice = replace(choice, plane=prior.plane)",
        "            choice = replace(choice)",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "hold_edge=motion.hold_edge,",
        "",
        "study/test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        'extent="volume" if len(study.grid.shape) == 3 else "slice"',
        'extent="slice"',
        "ui/test_volume_window.py ui/test_saved_study.py",
    ),
    Mutation(
        "layers/read.py",
        "hold_edge=choice.hold_edge,",
        "hold_edge=True,",
        "study/test_study_model.py ui/test_soft_tissue.py",
    ),
    Mutation(
        "layers/read.py",
        "weight=choice.weight,",
        "",
        "ui/test_images_in_turn.py ui/test_model.py ui/test_large_window.py",
    ),
    Mutation(
        "layers/viewer_undo.py",
        "store_table(value, part.layer, part.kind)",
        "pass",
        "study/test_study_model.py",
    ),
    Mutation(
        "tissue/row_table.py",
        "    if len(differing) != 1:",
        "    if not differing:",
        "tissue/test_row_table.py",
    ),
    Mutation(
        "ui/form_binding.py",
        "        known = self._model.select(image)\n",
        "        known = self._model.select(image) and False\n",
        "ui/test_images_in_turn.py",
    ),
    Mutation(
        "ui/form_binding.py",
        "        if model.model_part in model.parts:",
        "        if model.model_part not in model.parts:",
        "ui/test_remembered_settings.py ui/test_docks.py",
    ),
    Mutation(
        "ui/controller.py",
        "return replace(read, motion=replace(read.motion, drawing=self._model.drawing))",
        "return read",
        "ui/motion/test_grab.py",
    ),
    # solver, study, ui: the queue of background work
    Mutation(
        "solver/latest_queue.py",
        "        elif not self._is_held:\n",
        "        else:\n",
        "solver/test_latest_queue.py ui/test_grab_pace.py",
    ),
    Mutation(
        "solver/latest_queue.py",
        "return self.series != self._queue.series",
        "return False",
        "solver/test_latest_queue.py",
    ),
    Mutation(
        "solver/latest_queue.py",
        "self._is_held = self._current is not None and not self._current.dropped",
        "self._is_held = True",
        "solver/test_latest_queue.py",
    ),
    Mutation(
        "study/engine.py",
        "return answer is self._latest_deformation and answer.generation > self._dropped",
        "return answer is self._latest_deformation",
        "ui/test_grab_pace.py",
    ),
    Mutation(
        "ui/paced_engine.py",
        "        if state.moved.error is None or not self._engine.has_pending:\n",
        "        if state.moved.error is None:\n",
        "ui/test_grab_pace.py",
    ),
    Mutation(
        "ui/background_jobs.py",
        "        if turn.dropped:\n            return\n",
        "",
        "study/test_volume_cancel.py",
    ),
    Mutation(
        "study/drag_preview.py",
        "Preview(grid, axis, number, cut)",
        "Preview(CoarseGrid(1), axis, number, cut)",
        "study/test_drag_preview.py",
    ),
    Mutation(
        "layers/viewer_undo.py",
        "        if not self._owners:\n",
        "        if owner not in self._owners:\n",
        "ui/test_undo_keys.py",
    ),
    # study: interpretation of a study
    Mutation(
        "study/ground.py",
        "_TISSUE, _SURROUNDINGS = 1.0, 0.01",
        "_TISSUE, _SURROUNDINGS = 1.0, 0.02",
        "ui/motion/test_pull.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "DOUBTED_PENALTY = 1.0",
        "DOUBTED_PENALTY = 2.0",
        "study/test_one_confidence.py",
    ),
    Mutation(
        "study/ground.py",
        "rim = outer_rim(part) & free",
        "rim = outer_rim(part)",
        "study/test_study.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "np.where(c < 1, DOUBTED_PENALTY * c, math.inf)",
        "np.where(c <= 1, DOUBTED_PENALTY * c, math.inf)",
        "study/test_one_confidence.py",
    ),
    Mutation(
        "field/moved_pictures.py",
        "shown += over",
        "shown = [*over, *shown]",
        "ui/motion/test_grab_tools.py",
    ),
    Mutation(
        "study/study.py",
        "and _same_parts(self.tissue, other.tissue)",
        "and True",
        "layers/test_layers_inputs.py",
    ),
    # tissue: drawing, rules, surroundings
    Mutation(
        "tissue/surroundings.py", "_AROUND = 0.75", "_AROUND = 0.25", "ui/motion/test_pull.py"
    ),
    Mutation(
        "tissue/surroundings.py", "_APART = 0.35", "_APART = 0.95", "tissue/test_surroundings.py"
    ),
    Mutation("tissue/usual_lengths.py", "shorter / 16", "shorter / 8", "ui/motion/test_pull.py"),
    Mutation(
        "tissue/material_presets.py",
        "stiffness_image(now, rows)[0] / np.float32(self.unit_stiffness)",
        "stiffness_image(now, rows)[0] * np.float32(self.unit_stiffness)",
        "study/test_study.py",
    ),
    Mutation(
        "ui/motion/pull_tools.py",
        "to = tuple(x - away for x, away in zip(point, self._offset, strict=True))",
        "to = tuple(x + away for x, away in zip(point, self._offset, strict=True))",
        "tissue/drawing/test_drawing.py ui/motion/test_pull.py ui/motion/test_grab.py",
    ),
    Mutation(
        "tissue/drawing/canvas.py",
        "soft = mark.softness * reach",
        "soft = mark.softness * reach * 0.5",
        "ui/motion/test_brush.py tissue/drawing/test_drawing.py",
    ),
    Mutation(
        "tissue/drawing/marks.py",
        "(b - a) * size",
        "(a - b) * size",
        "layers/test_landmark_boundary.py",
    ),
    # layers: positions, and reading of layers
    Mutation(
        "field/frame.py",
        "return tuple(np.linalg.norm(self._steps(), axis=0).tolist())",
        "return tuple(np.linalg.norm(self._steps(), axis=0).tolist()[::-1])",
        "layers/test_layers_inputs.py",
    ),
    Mutation(
        "field/frame.py",
        "placed[:, 0] = self.index",
        "placed[:, 1] = self.index",
        "field/test_frame.py",
    ),
    Mutation(
        "field/landmark_pairs.py",
        "(away / 2)[patches.reshape(-1)]",
        "away[patches.reshape(-1)]",
        "layers/test_landmark_boundary.py",
    ),
    Mutation(
        "field/observation.py",
        "at = np.rint(arrows[:, 0]).astype(int)",
        "at = np.ceil(arrows[:, 0]).astype(int)",
        "layers/test_layers_inputs.py",
    ),
    Mutation(
        "field/directions.py",
        "int(sign < 0)",
        "int(sign > 0)",
        "field/test_directions.py",
    ),
    Mutation(
        "layers/pixel_copy.py",
        "kept = next((each for each in known if _is_equal(each, copy)), copy)",
        "kept = copy",
        "layers/test_layers_inputs.py ui/motion/test_pull.py",
    ),
    # ui: messages, display and animation
    Mutation(
        "study/ground.py",
        "dark_border(image, len(shape)) & (tissue.labels == 0)",
        "dark_border(image, len(shape)) & (tissue.labels == 1)",
        "tissue/test_surroundings.py",
    ),
    Mutation(
        "ui/motion/brush_tools.py",
        "between(start, point, self._spacing)",
        "between(point, start, self._spacing)",
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "layers/result_layers.py",
        "c = problem.confidence.max(axis=-1)",
        "c = problem.confidence.min(axis=-1)",
        "layers/test_layers_outputs.py",
    ),
    Mutation(
        "layers/result_layers.py",
        "still.motion(answer.solution).at(1).overlay",
        "still.motion(answer.solution).at(0).overlay",
        "ui/result/test_result_view.py",
    ),
    Mutation("ui/messages.py", "HANDFUL = 5", "HANDFUL = 50", "ui/test_messages.py"),
    Mutation(
        "ui/footer.py", "LARGEST = 1200 * 1200", "LARGEST = 120 * 120", "ui/test_live_mode.py"
    ),
    Mutation(
        "ui/result/moving_layers.py",
        "part = along if along <= 1 else 2 - along",
        "part = along if along <= 1 else along - 1",
        "ui/result/test_result_view.py",
    ),
    Mutation(
        "ui/motion/pointer.py", "_LARGER = 1.25", "_LARGER = 0.8", "ui/motion/test_grab_tools.py"
    ),
    # tools, and the pointer that passes mouse events to tools
    Mutation(
        "ui/motion/tool.py",
        'return None if self.is_dragging else settings["radius"]',
        'return settings["radius"]',
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "ui/motion/pull_tools.py",
        "return is_click and is_new",
        "return is_click",
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "ui/motion/brush_tools.py",
        "return self._selected_stroke if self.is_dragging else None",
        "return self._selected_stroke",
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "ui/motion/brush_tools.py",
        "-0.5 <= at <= size - 0.5",
        "-0.5 <= at <= size + 0.5",
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "ui/motion/brush_tools.py",
        "return message if stroke is None or stroke.moves_nowhere else",
        "return message if stroke is None else",
        "ui/motion/test_brush.py",
    ),
    Mutation(
        "ui/motion/pointer.py",
        "        self.tool.pick(number)",
        "        self.tool.select(number)",
        "ui/motion/test_grab_tools.py",
    ),
    Mutation(
        "ui/motion/pointer.py",
        "self.message.emit(self.tool.error_message or in_short(error))",
        "self.message.emit(in_short(error))",
        "ui/motion/test_grab_tools.py",
    ),
    Mutation(
        "ui/motion/pointer.py",
        "        self._fields.show_for(tool)\n        self._show_cursor()\n",
        "        self._fields.show_for(tool)\n",
        "ui/motion/test_grab_tools.py",
    ),
    Mutation(
        "ui/motion/arrows.py",
        'layer is None or frame is None or layer.mode != "pan_zoom"',
        "layer is None or frame is None",
        "ui/motion/test_grab_tools.py",
    ),
    # batches of cases, random deformations and tables of segmentations
    Mutation("io/sweeps.py", "step * amount / length", "step * amount", "io/test_batch.py"),
    Mutation(
        "io/case_records.py",
        "record.cells != dict(case.cells)",
        "not record.cells",
        "io/test_batch.py",
    ),
    Mutation(
        "augmentation/random_deformation.py",
        "drawn * scale, scale, case",
        "drawn, scale, case",
        "augmentation/test_random_deformation.py",
    ),
    Mutation(
        "augmentation/ground_truth.py",
        "* (np.array(place.spacing[-n:]) / solution.spacing)",
        "/ solution.spacing",
        "augmentation/test_ground_truth.py",
    ),
    Mutation(
        "io/segmentation_tables.py",
        "if len(layers) > 1:",
        "if len(layers) > 2:",
        "io/test_irregular_grids.py",
    ),
    # solver: compiled loops
    Mutation(
        "solver/backends/cpu/kernels.py",
        "change1 = change(steps[k], a1, twice1, p1, sign1 * off1, now1)",
        "change1 = change(steps[k], a1, twice1, p1, off1, now1)",
        "solver/backends/test_kernel_twins.py solver/optimizers/test_icm.py",
    ),
    Mutation(
        "solver/backends/cpu/kernels.py",
        "w[3, 0], w[3, 1], ti, tj, i + 1, j + 3, i, j + 4, i + 3, j + 1, i + 4, j\n",
        "w[3, 0], w[3, 1], ti, tj, i + 1, j + 3, i, j + 4, i + 3, j + 1, i + 4, j + 4\n",
        "solver/backends/test_kernel_twins.py solver/priors/test_priors.py",
    ),
    Mutation(
        "solver/backends/cpu/transfer.py",
        "        far_i = min(max(near_i + (1 if i % 2 else -1), 0), coarse_height - 1)",
        "        far_i = min(max(near_i + (-1 if i % 2 else 1), 0), coarse_height - 1)",
        "solver/backends/test_kernel_twins.py solver/optimizers/test_icm.py",
    ),
    Mutation(
        "solver/backends/cpu/elastic_exact.py",
        "    col += data[2, at] * x + data[1, at] * y",
        "    col += data[2, at] * x + data[0, at] * y",
        "solver/test_data_term.py",
    ),
    Mutation(
        "solver/backends/cpu/finite_strain.py",
        "        rr * cc - rc * rc,",
        "        rr * cc + rc * rc,",
        "solver/optimizers/test_large_loads.py",
    ),
    Mutation(
        "solver/backends/cpu/hexahedra.py",
        "t02 = less * (q2 * u011 + q0 * w110)",
        "t02 = less * (q2 * u011 - q0 * w110)",
        "solver/test_elastic_volume.py",
    ),
    Mutation(
        "solver/backends/cpu/volume_cliques.py",
        "        lost[j] += change(step,",
        "        lost[j] = change(step,",
        "solver/test_volume_paper.py",
    ),
    Mutation(
        "solver/backends/cpu/finite_bricks.py",
        "    f[at + 5 * STEP] += r * b + t * c",
        "    f[at + 5 * STEP] += t * b + r * c",
        "solver/optimizers/test_large_volume.py",
    ),
    # solver: priors, loads and data term
    Mutation(
        "solver/priors/elements.py",
        "row = (self.cols / self.rows) ** 0.25",
        "row = (self.cols / self.rows) ** 0.5",
        "solver/priors/test_elastic.py solver/test_loads.py",
    ),
    Mutation(
        "solver/priors/growth.py",
        "        if across:\n            trace = trace + beyond\n",
        "",
        "solver/test_loads.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "np.add(load.forces, loads.force / self.force_unit(problem), out=load.forces)",
        "np.add(load.forces, loads.force / stiffest(problem.stiffness), out=load.forces)",
        "solver/test_loads.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "        limit: Float64Array = self.penalty * c\n",
        "        limit: Float64Array = self.penalty * c**2\n",
        "solver/optimizers/test_slip.py",
    ),
    Mutation(
        "solver/priors/cliques.py",
        "of_space, of_faces = 1 / along.max(), total / longer",
        "of_space, of_faces = 1 / along.min(), total / longer",
        "solver/priors/test_priors.py solver/test_volume_paper.py",
    ),
    Mutation(
        "solver/data_term.py",
        "adds = np.asarray(second.any(axis=(-2, -1)) & ~known.any(axis=-1))",
        "adds = np.asarray(second.any(axis=(-2, -1)))",
        "solver/test_data_term.py",
    ),
    Mutation(
        "solver/data_term.py",
        "landmarks.displacement(problem.spacing).T / problem.unit,",
        "landmarks.displacement(problem.spacing).T,",
        "solver/test_data_term.py",
    ),
    Mutation(
        "solver/uncertain_landmarks.py",
        "return typical * self.strain**2 * extent**stiffness.ndim",
        "return typical * self.strain * extent**stiffness.ndim",
        "posterior/test_scale_fit.py",
    ),
    Mutation(
        "solver/loads.py",
        "[*[(0, 0)] * (strain.ndim - 2), (missing, 0), (missing, 0)]",
        "[*[(0, 0)] * (strain.ndim - 2), (0, missing), (0, missing)]",
        "solver/test_loads.py",
    ),
    Mutation(
        "solver/body_forces.py",
        "np.maximum(depth - (lowest - level * (lowest - highest)), 0)",
        "np.maximum(depth - (highest + level * (lowest - highest)), 0)",
        "study/test_removed_tissue.py",
    ),
    Mutation(
        "solver/body_forces.py",
        "    share = math.prod(size) / 2**tissue.ndim\n",
        "    share = 1 / 2**tissue.ndim\n",
        "solver/test_loads.py",
    ),
    Mutation(
        "solver/problem.py",
        "            marks.targets - first,\n",
        "            marks.targets,\n",
        "posterior/test_sampling.py",
    ),
    # solver: drift, rigid tissue, sliding parts, reactions
    Mutation(
        "solver/drift.py",
        "of_growth = of_growth - problem.loads.force / prior.force_unit(problem)",
        "of_growth = of_growth + problem.loads.force / prior.force_unit(problem)",
        "solver/test_drift.py",
    ),
    Mutation(
        "solver/drift.py",
        "    soft = problem.tissue & ~problem.rigid\n",
        "    soft = problem.tissue\n",
        "solver/test_drift.py",
    ),
    Mutation(
        "solver/backends/rigid/bodies.py",
        "turn[first, second], turn[second, first] = -1.0, 1.0",
        "turn[first, second], turn[second, first] = 1.0, 1.0",
        "solver/test_rigid.py",
    ),
    Mutation(
        "solver/backends/rigid/bodies.py",
        "    first = [max(along.start - 1, 0) for along in box[0]]",
        "    first = [along.start for along in box[0]]",
        "solver/test_rigid.py",
    ),
    Mutation(
        "solver/rigid_modes.py",
        "            motions[number] = from_middle[first] / max(shape)",
        "            motions[number] = -from_middle[first] / max(shape)",
        "solver/optimizers/test_slip.py",
    ),
    Mutation(
        "solver/unfolded.py",
        "force=None if loads.force is None else of_own(loads.force),",
        "force=None if loads.force is None else of_all(loads.force),",
        "solver/test_sliding_parts.py",
    ),
    Mutation(
        "solver/interface_normals.py",
        "        at[:, axis] += 0.5\n",
        "",
        "solver/test_sliding_parts.py",
    ),
    Mutation(
        "solver/reactions.py",
        "forces * prior.force_unit(problem), 0.0)",
        "forces * problem.unit, 0.0)",
        "solver/test_solution.py solver/test_loads.py",
    ),
    # solver: optimizers, warm start, levels, live solver, solution
    Mutation(
        "solver/optimizers/slip_states.py",
        "np.where(held, np.sign(force), 0.0), self._slips)",
        "np.where(held, -np.sign(force), 0.0), self._slips)",
        "solver/optimizers/test_slip.py",
    ),
    Mutation(
        "solver/optimizers/dead_loads.py",
        "        return super().forces(d) + self._planes(self._limit * off / length)",
        "        return super().forces(d) + self._planes(2 * self._limit * off / length)",
        "solver/optimizers/test_large_slip.py",
    ),
    Mutation(
        "solver/optimizers/large_motion.py",
        "        1.0 - most / whole,\n",
        "        most / whole,\n",
        "solver/optimizers/test_large_motion.py",
    ),
    Mutation(
        "solver/optimizers/multigrid.py",
        "    d.reshape(-1)[earlier.idle] = 0\n",
        "",
        "solver/test_warm_start.py",
    ),
    Mutation(
        "solver/quadtree.py",
        "    half = (1 << level.number) >> 1\n",
        "    half = 0\n",
        "solver/test_quadtree.py",
    ),
    Mutation(
        "solver/warm_start.py",
        "        if _shortfall(each) < _shortfall(best) and",
        "        if _shortfall(each) > _shortfall(best) and",
        "solver/optimizers/test_large_budget.py",
    ),
    Mutation(
        "solver/solution.py",
        "        return np.asarray(at + step / np.array(self.spacing))",
        "        return np.asarray(at + step)",
        "solver/test_solution.py",
    ),
    # field: warping and inversion
    Mutation(
        "field/warp.py",
        "        drawn &= ~covered | (inside & ~deep)",
        "        drawn &= ~covered",
        "field/test_parts.py",
    ),
    Mutation(
        "field/warp.py",
        "            line /= size\n",
        "            line *= size\n",
        "field/test_warp.py",
    ),
    Mutation(
        "field/triangle_raster.py",
        "row + to_c + to_d, col + to_c)",
        "row + to_c + to_d, col + to_d)",
        "field/test_triangle_raster.py field/test_warp.py",
    ),
    Mutation(
        "field/resample.py",
        "    spacing = tuple(size / step for size in solution.spacing)",
        "    spacing = tuple(size * step for size in solution.spacing)",
        "field/test_warp.py",
    ),
    Mutation(
        "field/displacement_field.py",
        "        return (origins - points) * self.spacing",
        "        return origins - points",
        "field/test_displacement_field.py",
    ),
    Mutation(
        "field/moved_points.py",
        "tree.query(site[void] * size)",
        "tree.query(site[void])",
        "field/test_volume_motion.py",
    ),
    Mutation(
        "field/other_grid.py",
        "        out[:, -1] -= np.array(frame.index)[across]",
        "        out[:, -1] += np.array(frame.index)[across]",
        "field/test_volume_motion.py",
    ),
    Mutation(
        "field/landmark_spline.py",
        "        return forces / self.sd[:, None], motion",
        "        return forces, motion",
        "field/test_landmark_spline.py",
    ),
    # field: positions, strain and measurements
    Mutation(
        "field/frame.py",
        "translate = (np.linalg.inv(np.array(self.affine)) @ world)[:-1]",
        "translate = world[:-1]",
        "field/test_frame.py",
    ),
    Mutation(
        "field/frame.py",
        "world[shared] = np.array(other.matrix)[theirs] * factors[:, None]",
        "world[shared] = np.array(other.matrix)[theirs]",
        "field/test_frame.py",
    ),
    Mutation(
        "field/deformation.py",
        "    following = np.where(exists[1:], steps[1:], steps[:-1])",
        "    following = steps[1:]",
        "field/test_deformation.py",
    ),
    Mutation(
        "field/volume_loops.py",
        "mean * (sizes[i] / sizes[j])",
        "mean * (sizes[j] / sizes[i])",
        "field/test_volume_loops.py",
    ),
    Mutation(
        "field/elastic_strain.py",
        "squared = np.linalg.det(np.eye(2) + gradient) ** 2",
        "squared = np.linalg.det(np.eye(2) + gradient)",
        "field/test_elastic_strain.py",
    ),
    Mutation(
        "field/elastic_strain.py",
        "return tensor[:, beyond:, beyond:], tensor[:, 0, 0] if beyond else 0.0",
        "return tensor[:, :n, :n], tensor[:, 0, 0] if beyond else 0.0",
        "field/test_elastic_strain.py",
    ),
    Mutation(
        "field/strain.py",
        "            + 2 * tensor[..., 0, 1] ** 2\n",
        "            + tensor[..., 0, 1] ** 2\n",
        "field/test_quantities.py",
    ),
    Mutation(
        "field/measurement.py",
        "np.average(change[mask], weights=weight[mask])",
        "np.average(change[mask])",
        "field/test_measurement.py",
    ),
    Mutation(
        "field/deformation.py",
        "float(np.sqrt((difference**2).sum(axis=-1).mean()))",
        "float(np.sqrt((difference**2).sum(axis=-1)).mean())",
        "field",
    ),
    # io: fields and places
    Mutation(
        "io/nifti.py",
        "    turn[:, 2] *= -1 if zooms[0] < 0 else 1",
        "    turn[:, 0] *= -1 if zooms[0] < 0 else 1",
        "io/test_foreign_fields.py",
    ),
    Mutation(
        "io/fields.py",
        "        start = start - turn[:, 2] * size[0]",
        "        start = start + turn[:, 2] * size[0]",
        "io/test_fields.py",
    ),
    Mutation(
        "io/fields.py",
        "along = (vectors @ image.direction.astype(vectors.dtype))[..., ::-1]",
        "along = (vectors @ image.direction.T.astype(vectors.dtype))[..., ::-1]",
        "io/test_fields.py io/test_foreign_fields.py",
    ),
    Mutation(
        "io/image_grid.py",
        "    steps[:3] *= _millimetres(image)",
        "    steps[:3, :3] *= _millimetres(image)",
        "io/test_image_grid.py",
    ),
    Mutation(
        "io/images.py",
        "                turn[:, list(order)][::-1, ::-1],",
        "                turn[list(order)][::-1, ::-1],",
        "io/test_image_files.py io/test_volume_files.py",
    ),
    Mutation(
        "io/case.py",
        "        place = place._replace(origin=tuple(first[::-1].tolist()))",
        "        place = place._replace(origin=tuple(first.tolist()))",
        "io/test_case.py",
    ),
    Mutation(
        "io/registration_files.py",
        "matrix[:n, :n], matrix[:n, n] = back @ turn, back @ offset\n    # Rounding",
        "matrix[:n, :n], matrix[:n, n] = back @ turn, -back @ offset\n    # Rounding",
        "io/test_registration_files.py",
    ),
    Mutation(
        "io/uncertainty_files.py",
        "factor = place.spacing[-1] / solution.spacing[-1]",
        "factor = solution.spacing[-1] / place.spacing[-1]",
        "io/test_uncertainty_files.py",
    ),
    # io: landmarks, tables and films
    Mutation(
        "io/landmark_files.py",
        "np.concatenate([points[:, ::-1], targets[:, ::-1]], axis=1)",
        "np.concatenate([points[:, ::-1], targets], axis=1)",
        "io/test_landmark_files.py",
    ),
    Mutation(
        "io/landmark_files.py",
        "(factor * places * _TO_LPS[system])[:, ::-1]",
        "(factor * places)[:, ::-1]",
        "io/test_landmark_files.py",
    ),
    Mutation(
        "io/apply.py",
        "at[in_slice, -n:] += field.field.at(at[in_slice, -n:]) / field.spacing",
        "at[in_slice, -n:] += field.field.at(at[in_slice, -n:])",
        "io/test_apply.py",
    ),
    Mutation(
        "io/registration_files.py",
        "    back = np.linalg.inv(matrix)\n",
        "    back = matrix\n",
        "io/test_registration_files.py",
    ),
    Mutation(
        "io/tables.py",
        '        vector = (row.pop("plane"), *vector)',
        '        vector = (*vector, row.pop("plane"))',
        "io/test_case.py io/test_volume_case.py io/test_csv_files.py",
    ),
    Mutation(
        "io/moving_pictures.py",
        "forward_frames[-2:0:-1]",
        "forward_frames[::-1]",
        "field/test_measurement.py",
    ),
    # registration
    Mutation(
        "registration/alignment.py",
        "return np.asarray(matrix * before / after[:, None])",
        "return np.asarray(matrix * before * after[:, None])",
        "registration/test_register.py",
    ),
    Mutation(
        "registration/image_data.py",
        "        weight = weight / (1 + (difference / _OUTLIER) ** 2)\n",
        "",
        "registration/test_register.py",
    ),
    Mutation(
        "registration/image_data.py",
        "np.asarray(at + displacement[..., axis] / size, np.float32)",
        "np.asarray(at + displacement[..., axis], np.float32)",
        "registration/test_register.py",
    ),
    Mutation(
        "registration/matching.py",
        "        if not base.rigid.any():\n            return solution\n",
        "        return solution\n",
        "registration/test_register.py",
    ),
    Mutation(
        "registration/register.py",
        "float(np.trace(covariance, axis1=1, axis2=2).mean()) / axes)",
        "float(np.trace(covariance, axis1=1, axis2=2).mean()))",
        "registration/test_register.py",
    ),
    Mutation(
        "registration/result.py",
        "self._in_moving(sites + self.displacement / np.asarray(self.solution.spacing))",
        "self._in_moving(sites + self.displacement)",
        "registration/test_register.py",
    ),
    # posterior
    Mutation(
        "posterior/noise.py",
        "amount = np.sqrt(energy / (unit * problem.unit)) * unit",
        "amount = np.sqrt(energy / unit) * unit",
        "posterior/test_sampling.py",
    ),
    Mutation(
        "posterior/noise.py",
        "return cls(corners, np.sqrt(energy * precision))",
        "return cls(corners, np.sqrt(precision))",
        "posterior/test_sampling.py",
    ),
    Mutation(
        "posterior/uncertainty.py",
        "        squares_along += (moved * ways).sum(axis=-1) ** 2",
        "        squares_along += (moved**2).sum(axis=-1)",
        "posterior/test_uncertainty.py",
    ),
    Mutation(
        "posterior/agreement.py",
        "_divided(pulls, np.sqrt(np.where(own > least, own, 0)))",
        "_divided(pulls, np.where(own > least, own, 0))",
        "posterior/test_agreement.py",
    ),
    Mutation(
        "posterior/data_space.py",
        "(basis.T @ missing) / left, sizes / left, data.sd)",
        "(basis.T @ missing) / left, sizes, data.sd)",
        "posterior/test_agreement.py",
    ),
    Mutation(
        "posterior/scale_fit.py",
        "precision = problem.precision * (strain / noise) ** 2",
        "precision = problem.precision * (strain / noise)",
        "posterior/test_scale_fit.py",
    ),
    Mutation(
        "posterior/fit.py",
        "return self.apply(tissue, math.log(2.0)), 1.0",
        "return self.apply(tissue, math.log(2.0)), math.log(2.0)",
        "posterior/test_fit.py",
    ),
    Mutation(
        "posterior/blanket.py",
        "force[t] += (1 + r_u) * first + (1 + r_s) * second",
        "force[t] += (1 + r_s) * first + (1 + r_u) * second",
        "posterior/test_blanket.py",
    ),
)


def survives(mutation: Mutation, folder: Path) -> bool:
    """Return whether all tests pass despite a mutation.

    Raises
    ------
    SystemExit
        If the text to replace does not occur exactly once, or if the tests could not be run.
    """
    package = folder / "napari_hmrf"
    file = package / mutation.file
    text = file.read_text(encoding="utf-8")
    if text.count(mutation.right) != 1:
        raise SystemExit(f"{mutation.file} must have {mutation.right!r} once: update MUTATIONS")
    times, has_loops = file.stat(), mutation.file.startswith(_LOOPS)
    if has_loops:
        # A compiled loop may contain inlined functions of other files, whose changes numba does not
        # notice.
        remove_loops(file.parent)
    file.write_text(text.replace(mutation.right, mutation.wrong), encoding="utf-8")
    try:
        tests = [f"tests/{each}" for each in mutation.tests.split()]
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        paths = {**os.environ, "PYTHONPATH": str(folder)}
        done = subprocess.run(command, env=paths, cwd=folder, capture_output=True, text=True)
        if done.returncode not in (_PASSED, _FAILED):
            raise SystemExit(f"{mutation.file}: no test was run\n{done.stdout}{done.stderr}")
        return done.returncode == _PASSED
    finally:
        file.write_text(text, encoding="utf-8")
        os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        if has_loops:
            remove_loops(file.parent)
            copy_loops((ROOT / "napari_hmrf" / mutation.file).parent, file.parent)


def remove_loops(folder: Path) -> None:
    """Remove the compiled loops of the modules in a folder."""
    for compiled in (folder / "__pycache__").glob(_COMPILED):
        compiled.unlink()


def copy_loops(source: Path, folder: Path) -> None:
    """Copy the compiled loops of the modules in a folder to a copy of this folder."""
    for compiled in (source / "__pycache__").glob(_COMPILED):
        shutil.copy2(compiled, folder / "__pycache__")


def copied(folder: Path) -> Path:
    """Copy the package and its tests to a folder, and return the folder."""
    # Copy the tests too, because pytest imports the package that is next to them. `copytree` keeps
    # the times of files, by which older versions of numba recognize the source of a compiled loop.
    for name in _FOLDERS:
        shutil.copytree(ROOT / name, folder / name)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def main(wanted: list[str]) -> int:
    """Test all mutations, or those with the given numbers; return the number that survive."""
    chosen = [int(each) for each in wanted] or range(len(MUTATIONS))
    folders: queue.SimpleQueue[Path] = queue.SimpleQueue()

    def tried(number: int) -> tuple[int, bool]:
        folder = folders.get()
        try:
            return number, survives(MUTATIONS[number], folder)
        finally:
            folders.put(folder)

    with tempfile.TemporaryDirectory() as made, ThreadPoolExecutor(_AT_ONCE) as pool:
        for number in range(_AT_ONCE):
            folders.put(copied(Path(made) / f"{number}"))
        survivors = 0
        for number, is_alive in pool.map(tried, chosen):
            survivors += is_alive
            said = "SURVIVES" if is_alive else "detected"
            mutation = MUTATIONS[number]
            print(f"{number:3} {said:8} {mutation.file}: {mutation.wrong.strip()}", flush=True)
    print(f"{survivors} of {len(chosen)} survive")
    return survivors


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
