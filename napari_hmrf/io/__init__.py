"""Files: studies, fields, images, landmarks, tables and figures; the work of the shell.

A case passes through five steps, from its files to its results:

1. *Read.* `images` reads an image with its place. Pictures are decoded here, and medical images by
   `itk_files`, in another process (`decoder_process`), so that a damaged file cannot end this one.
   `landmark_files` reads points, `fields` displacements, `tables`, `segmentation_tables` and
   `material_tables` the tissues of labels and the rules of boundaries.
2. *Study.* `case` combines these files and the `case_options` in a ``Study``; `study_file` reads a
   study that was saved whole. `sweeps` varies single numbers of it.
3. *Solve.* The study becomes a ``Problem``, and the problem a ``Solution``: see ``study/``. For the
   many cases of a table (`case_tables`), `batch` starts processes, and `case_records` lets it
   resume.
4. *Write.* `study_file` writes the study with its solution, so that the field can be reproduced;
   `fields` writes the displacement for other tools, with a `seal` that reveals damage. Files are
   replaced only when the new ones are complete, and on request (`overwriting`).
5. *Use.* `apply` moves images, labels and landmarks of the same tissue with a field; `results`
   measures tissues; `figures` and `moving_pictures` show them.
"""
