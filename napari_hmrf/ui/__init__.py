"""The dock: forms, tools, and the result in napari. The only room that imports Qt.

An edit passes through six steps:

1. *Edit.* A form writes its values to the `StudyModel` by the `form_binding`; a tool writes its
   drawing there (`motion.pointer` passes mouse and keys to the current tool). The model records
   one undo step, and emits `changed`.
2. *Read.* The `controller` has the `study_reader` read the chosen layers as a `Study`, once napari
   is idle (`look`). After an edit of the drawing only the drawing is replaced.
3. *Submit.* The controller submits the study to the `paced_engine`. Of several studies, the newest
   is solved next, and not before the picture of the last answer is painted.
4. *Answer.* The compute thread solves the study and moves its image (`study.engine`). The answer
   comes back to the GUI thread (`gui_thread`), if it is still current.
5. *Show.* The controller shows image, arrows and paint at once (`motion.display`). When the tissue
   is at rest, all layers of the result are made in the background (`layers.complete_result`).
6. *Look.* `result.result_view` plays, compares and saves the result; its pictures are made by
   `background_jobs`.

`soft_tissue` puts the parts together, and scripts use it. `viewer_watch` responds to events of
napari, and `guide` writes the status text.
"""
