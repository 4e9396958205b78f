"""Mutation tests of the package outside the solver: a test must fail for each mutation.

    python scripts/mutations.py [number ...]

Each mutation changes a sign, an index, a weight or a constant, with an effect that a user would
notice. At least one of its tests must fail. The mutations are applied one at a time to a copy of
the package and its tests.
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
_FOLDERS = "napari_hmrf", "shaders", "sample_data", "benchmarks", "tests"
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


def copied(folder: Path) -> Path:
    """Copy the package and its tests to a folder, and return the folder."""
    # Copy the tests too, because pytest imports the package that is next to them.
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
            print(f"{number:2} {said:8} {mutation.file}: {mutation.wrong.strip()}", flush=True)
    print(f"{survivors} of {len(chosen)} survive")
    return survivors


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
