"""Table of cases that shows how the growth of a tumour narrows the ventricles.

Each row of a table defines a case. Two cells of the row below contain several values, so the row
defines six cases. The results of each case are written to a folder: the study, its displacement
field and the deformed image.
"""

from pathlib import Path

import numpy as np
from tifffile import imwrite

from napari_hmrf import read_study
from napari_hmrf.cases import read_cases, solve_cases
from napari_hmrf.data import phantom
from napari_hmrf.fields import measure

MATERIALS = """\
label,name,stiffness,poisson
0,air,0,
1,brain,3,0.45
2,ventricles,1,0.3
3,tumour,3,0.45
"""
CASES = """\
name,image,labels,materials,hold-edge,growth:tumour,stiffness:tumour
brain,brain.tif,labels.tif,materials.csv,yes,0.1;0.2;0.3,3;30
"""


def main() -> None:
    """Write the input files, solve the cases, and print the results."""
    brain, files = phantom("mass-effect", size=96), Path("sweep")
    files.mkdir()
    imwrite(files / "brain.tif", brain.image.astype(np.float32))
    imwrite(files / "labels.tif", brain.tissue_labels.astype(np.uint8))
    (files / "materials.csv").write_text(MATERIALS)
    (files / "cases.csv").write_text(CASES)

    for outcome in solve_cases(read_cases(files / "cases.csv"), files / "out", jobs=2):
        study, solution = read_study(files / "out" / outcome.case / "brain.study")
        names = {row.label: row.name for row in study.tissue.materials}
        rows = measure(solution, brain.tissue_labels, names=names)
        areas = {row.name: row.size_change for row in rows}
        print(f"{outcome.case}: ventricles {areas['ventricles']:.2f} %, {outcome.folds} folds")
    print(f"summary of all cases: {files / 'out' / 'summary.csv'}")


if __name__ == "__main__":  # required because worker processes import this file
    main()
