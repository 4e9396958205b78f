"""File input and output for studies, fields, images, landmarks, tables and figures.

The processing of a case, from its input files to its results, has five steps:

1. *Read.* `images` reads images and their positions in space. Medical images are read by
   `itk_files`, with `nifti` or `itk_reader`; formats whose readers crash on damaged files are read
   in a `child_process`. `landmark_files` reads points and `fields` reads displacement fields.
   `tables` and `segmentation_tables` read the materials of tissue labels and the rules of boundary
   labels.
2. *Build a study.* `case` combines these files and the `case_options` into a ``Study``;
   `study_file` reads a saved study. `sweeps` replaces single numbers in a study.
3. *Solve.* The study is converted to a ``Problem``, which is solved to obtain a ``Solution``; see
   ``study/``. For a table of cases (`case_tables`), `batch` starts several processes, and
   `case_records` makes it possible to resume a batch.
4. *Write.* `study_file` writes the study and its solution, so that the field can be reproduced.
   `fields` writes the displacement field for other tools.
   Existing files are overwritten only on request (`overwriting`), and only by complete files.
5. *Use.* `apply` deforms images, labels and landmarks with a field. `results` measures tissues.
   `figures` and `moving_pictures` draw results.

`registration_files` registers two image files, and writes the resulting study, images and field.
"""
