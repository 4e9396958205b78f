"""Dock widget: forms, tools, and display of the result.

This is the only subpackage that imports Qt.

An edit passes through six steps:

1. *Edit.* A form writes its values to the `Session` through `form_binding`. A tool writes its
   drawing to the same session; `motion.pointer` passes mouse and key events to the current tool.
   The session records one undo step and emits `changed`.
2. *Read.* Once napari is idle, `Controller.refresh` reads the chosen layers as a `Study` through
   `layers.read`. After an edit to the drawing, only the drawing is replaced.
3. *Submit.* The controller submits the study to the `PacedEngine` of `solving`, which solves the
   newest submitted study as soon as the last picture has been painted.
4. *Answer.* The compute thread solves the study and deforms its image (`study.engine`). The GUI
   thread receives the answer (`jobs`), and drops it if another study has replaced it (`solving`).
5. *Show.* The controller immediately shows the image, the arrows and the paint (`motion.display`).
   After a pause in the edits, all layers of the result are created in the background
   (`layers.result_layers`).
6. *View.* `result.result_view` plays, compares and saves the result; `jobs` computes its pictures.

All layers are written by `layers.viewer_layers`, and the status text, the warning and the buttons
that can be pressed are those of one `scene`, which `guide` draws.

`study_files` saves and opens studies, `autosave` writes and opens recovery files, and `unsaved`
asks before a window closes.

`soft_tissue` combines these parts and is the interface for scripts. `viewer_watch` responds to
napari events.
"""
