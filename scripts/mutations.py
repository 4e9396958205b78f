"""Break all but the solver in many places, one at a time, and see a test fail for each.

    python scripts/mutations.py [number ...]

Each is a sign, an index, a weight or a constant that a person would notice, and names the tests
that are to fail. The package is copied to another folder, and broken there.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent


class Mutation(NamedTuple):
    """What is broken, and which tests see it.

    Attributes
    ----------
    file : str
        Below `napari_hmrf`.
    right, wrong : str
        The text, which occurs once, and what it is replaced by.
    tests : str
        As pytest takes them, below `tests`.
    """

    file: str
    right: str
    wrong: str
    tests: str


MUTATIONS = (
    # the model of what is edited, and its forms
    Mutation(
        "study/edit_history.py",
        "        self._past.append(step)\n        self._future.clear()",
        "        self._past.append(step)",
        "test_edits.py",
    ),
    Mutation(
        "study/edit_history.py",
        "        back = step._replace(value=self._now[step.part])\n        target.append(back)",
        "        back = step\n        target.append(back)",
        "test_edits.py",
    ),
    Mutation(
        "study/study_model.py",
        "return known and image is not None",
        "return not known and image is not None",
        "test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "before = self.setdefault(part, type(now)())",
        "before = self.setdefault(part, now)",
        "test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        'self._set(part, now, word if step else "")',
        "self._set(part, now, word)",
        "test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "        if self.drawing_in_progress:\n            self.end()\n        self.slice",
        "        self.slice",
        "test_edits.py",
    ),
    Mutation(
        "study/study_model.py",
        "            choice = replace(choice, plane=prior.plane)",
        "            choice = replace(choice)",
        "test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        "hold_edge=motion.hold_edge,",
        "",
        "test_study_model.py",
    ),
    Mutation(
        "study/study_model.py",
        'extent="volume" if len(study.grid.shape) == 3 else "slice"',
        'extent="slice"',
        "test_volume_window.py test_saved_study.py",
    ),
    Mutation(
        "layers/read.py",
        "hold_edge=choice.hold_edge,",
        "hold_edge=True,",
        "test_study_model.py test_widgets.py",
    ),
    Mutation(
        "layers/read.py",
        "weight=choice.weight,",
        "",
        "test_images_in_turn.py test_widgets_model.py test_large_window.py",
    ),
    Mutation(
        "layers/viewer_undo.py",
        "store_table(value, part.layer, part.kind)",
        "pass",
        "test_undo_keys.py test_segmentations.py test_widgets_layers.py",
    ),
    Mutation(
        "tissue/row_table.py",
        "    if len(differing) != 1:",
        "    if not differing:",
        "test_first_use.py test_undo_keys.py",
    ),
    Mutation(
        "ui/form_binding.py",
        "        known = self._model.select(image)\n",
        "        known = self._model.select(image) and False\n",
        "test_images_in_turn.py",
    ),
    Mutation(
        "ui/form_binding.py",
        "        if MODEL_PART in model.parts:",
        "        if MODEL_PART not in model.parts:",
        "test_remembered.py test_docks.py",
    ),
    Mutation(
        "ui/controller.py",
        "return replace(read, motion=replace(read.motion, drawing=self._model.drawing))",
        "return read",
        "test_grab.py",
    ),
    # solver, study, ui: one queue for all background work
    Mutation(
        "solver/latest_queue.py",
        "        elif not self._held:\n",
        "        else:\n",
        "test_latest_queue.py test_grab_pace.py",
    ),
    Mutation(
        "solver/latest_queue.py",
        "return self.series != self._queue.series",
        "return False",
        "test_latest_queue.py",
    ),
    Mutation(
        "solver/latest_queue.py",
        "self._held = self._current is not None and not self._current.dropped",
        "self._held = True",
        "test_latest_queue.py",
    ),
    Mutation(
        "study/engine.py",
        "return answer is self._newest and answer.generation > self._dropped",
        "return answer is self._newest",
        "test_grab_pace.py",
    ),
    Mutation(
        "ui/paced_engine.py",
        "        if seen.moved.error is None or not self._engine.waits:\n",
        "        if seen.moved.error is None:\n",
        "test_grab_pace.py",
    ),
    Mutation(
        "ui/background_jobs.py",
        "        if turn.dropped:\n            return\n",
        "",
        "test_volume_cancel.py",
    ),
    Mutation(
        "study/drag_preview.py",
        "Glance(CoarseGrid.of_at_most(PREVIEW_SITES, shape), *plane)",
        "Glance(CoarseGrid(1), *plane)",
        "test_volume_window.py",
    ),
    Mutation(
        "layers/viewer_undo.py",
        "        if not self._owners:\n",
        "        if owner not in self._owners:\n",
        "test_undo_keys.py",
    ),
    # study: how a study is understood
    Mutation(
        "study/ground.py",
        "_TISSUE, _SURROUNDINGS = 1.0, 0.01",
        "_TISSUE, _SURROUNDINGS = 1.0, 0.02",
        "test_pull.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "DOUBTED_PENALTY = 1.0",
        "DOUBTED_PENALTY = 2.0",
        "test_one_confidence.py",
    ),
    Mutation(
        "study/ground.py",
        "rim = outer_rim(part) & free",
        "rim = outer_rim(part)",
        "test_study.py",
    ),
    Mutation(
        "solver/priors/elastic.py",
        "np.where(c < 1, DOUBTED_PENALTY * c, math.inf)",
        "np.where(c <= 1, DOUBTED_PENALTY * c, math.inf)",
        "test_one_confidence.py",
    ),
    Mutation(
        "field/moved_pictures.py",
        "shown += over",
        "shown = [*over, *shown]",
        "test_grab_tools.py",
    ),
    Mutation(
        "study/study.py",
        "and _same_parts(self.tissue, other.tissue)",
        "and True",
        "test_layers_inputs.py",
    ),
    # tissue: drawing, rules, surroundings
    Mutation("tissue/surroundings.py", "_AROUND = 0.75", "_AROUND = 0.25", "test_pull.py"),
    Mutation(
        "tissue/surroundings.py", "_APART = 0.35", "_APART = 0.95", "test_layers_background.py"
    ),
    Mutation("tissue/usual_lengths.py", "shorter / 16", "shorter / 8", "test_pull.py"),
    Mutation(
        "tissue/material_presets.py",
        "stiffness_image(now, self.materials)[0] / np.float32(self.one)",
        "stiffness_image(now, self.materials)[0] * np.float32(self.one)",
        "test_study.py",
    ),
    Mutation(
        "ui/motion/hands.py",
        "to = tuple(x - away for x, away in zip(point, self._offset, strict=True))",
        "to = tuple(x + away for x, away in zip(point, self._offset, strict=True))",
        "test_drawing.py test_pull.py test_grab.py",
    ),
    Mutation(
        "tissue/drawing/canvas.py",
        "soft = mark.softness * reach",
        "soft = mark.softness * reach * 0.5",
        "test_brush.py test_drawing.py",
    ),
    Mutation(
        "tissue/drawing/marks.py",
        "(b - a) * size",
        "(a - b) * size",
        "test_landmark_boundary.py",
    ),
    # layers: where things lie, and what is read
    Mutation(
        "field/frame.py",
        "return tuple(np.linalg.norm(self._steps(), axis=0).tolist())",
        "return tuple(np.linalg.norm(self._steps(), axis=0).tolist()[::-1])",
        "test_layers_inputs.py",
    ),
    Mutation(
        "field/frame.py",
        "placed[:, 0] = self.index",
        "placed[:, 1] = self.index",
        "test_layers_outputs.py",
    ),
    Mutation(
        "field/landmark_pairs.py",
        "(away / 2)[patches.reshape(-1)]",
        "away[patches.reshape(-1)]",
        "test_landmark_boundary.py",
    ),
    Mutation(
        "field/observation.py",
        "at = np.rint(arrows[:, 0]).astype(int)",
        "at = np.ceil(arrows[:, 0]).astype(int)",
        "test_layers_inputs.py",
    ),
    Mutation(
        "field/directions.py",
        "int(sign < 0)",
        "int(sign > 0)",
        "test_directions.py",
    ),
    Mutation(
        "layers/pixel_copy.py",
        "found = next((each for each in known if _same(each, now)), now)",
        "found = now",
        "test_layers_inputs.py test_pull.py",
    ),
    # ui: what is said, shown and played
    Mutation(
        "study/ground.py",
        "dark_border(image, len(shape)) & (tissue.labels == 0)",
        "dark_border(image, len(shape)) & (tissue.labels == 1)",
        "test_layers_background.py",
    ),
    Mutation(
        "ui/motion/brush.py",
        "between(start, point, self._spacing)",
        "between(point, start, self._spacing)",
        "test_brush.py",
    ),
    Mutation(
        "layers/result_layers.py",
        "c = problem.confidence.max(axis=-1)",
        "c = problem.confidence.min(axis=-1)",
        "test_layers_outputs.py",
    ),
    Mutation(
        "layers/result_layers.py",
        "Motion(answer.solution, overlay=picture).at(1).overlay",
        "Motion(answer.solution, overlay=picture).at(0).overlay",
        "test_widgets_look.py",
    ),
    Mutation("ui/messages.py", "HANDFUL = 5", "HANDFUL = 50", "test_widgets.py"),
    Mutation("ui/footer.py", "LARGEST = 1200 * 1200", "LARGEST = 120 * 120", "test_live_mode.py"),
    Mutation(
        "ui/result/moving_layers.py",
        "part = along if along <= 1 else 2 - along",
        "part = along if along <= 1 else along - 1",
        "test_widgets_look.py",
    ),
    Mutation("ui/motion/pointer.py", "_LARGER = 1.25", "_LARGER = 0.8", "test_grab_tools.py"),
    # many cases, random deformations and tables of segmentations
    Mutation("io/sweeps.py", "step * amount / length", "step * amount", "test_batch.py"),
    Mutation(
        "io/case_records.py",
        "record.cells != dict(case.cells)",
        "not record.cells",
        "test_batch.py",
    ),
    Mutation(
        "augmentation/random_deformation.py",
        "drawn * scale, scale, case",
        "drawn, scale, case",
        "test_random_deformation.py",
    ),
    Mutation(
        "augmentation/ground_truth.py",
        "* (np.array(place.spacing[-n:]) / solution.spacing)",
        "/ solution.spacing",
        "test_truth.py",
    ),
    Mutation(
        "io/segmentation_tables.py",
        'each.get("Layer", "0") == "0"',
        'each.get("Layer", "0") != "1"',
        "test_segmentations.py",
    ),
)


def survives(mutation: Mutation, folder: Path) -> bool:
    """Whether no test sees a mutation."""
    package = folder / "napari_hmrf"
    file = package / mutation.file
    text = file.read_text(encoding="utf-8")
    if text.count(mutation.right) != 1:
        raise SystemExit(f"{mutation.file} has {mutation.right!r} not once: mend the list")
    file.write_text(text.replace(mutation.right, mutation.wrong), encoding="utf-8")
    try:
        tests = [str(ROOT / "tests" / each) for each in mutation.tests.split()]
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        paths = {**os.environ, "PYTHONPATH": str(folder)}
        return subprocess.run(command, env=paths, cwd=folder, capture_output=True).returncode == 0
    finally:
        file.write_text(text, encoding="utf-8")


def main(wanted: list[str]) -> int:
    """Try all mutations, or those of some numbers; how many survive."""
    chosen = [int(each) for each in wanted] or range(len(MUTATIONS))
    survivors = 0
    with tempfile.TemporaryDirectory() as made:
        shutil.copytree(ROOT / "napari_hmrf", Path(made) / "napari_hmrf")
        shutil.copytree(ROOT / "shaders", Path(made) / "shaders")
        for number in chosen:
            mutation = MUTATIONS[number]
            alive = survives(mutation, Path(made))
            survivors += alive
            said = "SURVIVES" if alive else "is seen"
            print(f"{number:2} {said:8} {mutation.file}: {mutation.wrong}", flush=True)
    print(f"{survivors} of {len(chosen)} survive")
    return survivors


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
