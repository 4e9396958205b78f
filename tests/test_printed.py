"""Tests of the `repr` of public records, which fits on one line."""

import numpy as np

from napari_hmrf import (
    ICM,
    Arrow,
    BoundaryRule,
    Drawing,
    ElasticPrior,
    Grid,
    LiveSolver,
    Material,
    Motion,
    Multigrid,
    NeoHookeanPrior,
    SeilerPrior,
    Study,
    Tissue,
    build_problem,
    solve_study,
)
from napari_hmrf.data import head_phantom, phantom
from napari_hmrf.fields import Picture, Warper, export_field, measure, read_field
from napari_hmrf.landmarks import read_points, write_points
from napari_hmrf.loads import growth
from napari_hmrf.random import RandomDeformation
from napari_hmrf.tissue import PRESETS, lookup_tissue, materials_by_name

LABELS, MATERIAL = np.ones((20, 30), int), Material(1, "gel", 1.0)
RATIOS = np.full(LABELS.shape, 0.3)


def test_every_public_record_is_printed_in_a_short_line(tmp_path):
    pull = Drawing((Arrow(at=(10, 15), by=(0, 2), radius=3),))
    motion = Motion(hold_edge=True, drawing=pull)
    study = Study(Grid((20, 30), (1, 1)), Tissue(labels=LABELS, materials=(MATERIAL,)), motion)
    solution, stated = solve_study(study, backend="cpu"), build_problem(study)
    export_field(tmp_path / "field.mha", solution, placed=False)
    write_points(tmp_path / "pairs.csv", np.ones((40, 2)), np.ones((40, 2)))
    deformation = RandomDeformation(LABELS, [MATERIAL], spacing=1, patches=2)
    records = [
        *(study, study.grid, study.tissue, study.motion, study.pictures, stated, stated.problem),
        *(solution, solution.provenance, measure(solution, LABELS)[0]),
        *(ElasticPrior(RATIOS), NeoHookeanPrior(RATIOS), SeilerPrior(), ICM(), Multigrid()),
        *(phantom("bar", 32), head_phantom(24), head_phantom(24).frame, LiveSolver(print)),
        *(Picture(RATIOS), Warper(RATIOS, spacing=1), growth(RATIOS)),
        *(read_field(tmp_path / "field.mha"), read_points(tmp_path / "pairs.csv")),
        *(materials_by_name({1: "brain", 2: "?"}), lookup_tissue("brain"), *PRESETS),
        *(deformation, deformation.sample(0), MATERIAL, BoundaryRule(1, "fixed"), pull),
    ]
    printed = {type(each).__name__: repr(each) for each in records}
    assert {name: said for name, said in printed.items() if "\n" in said or len(said) > 300} == {}
