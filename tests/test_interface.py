"""Tests of the public interface: exported names, signatures and errors."""

import inspect
import math
import re
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf import (
    ICM,
    ArgumentError,
    BoundaryRule,
    ElasticPrior,
    HmrfError,
    Material,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Provenance,
    SeilerPrior,
    Solution,
    solve,
)
from napari_hmrf.fields import Picture, Warper, equivalent_strain, fold_mask, green_lagrange_strain
from napari_hmrf.solver.model_names import ModelName, model_name
from napari_hmrf.study.models import parts_of
from napari_hmrf.tissue import StiffnessCurve, boundary_images, poisson_image, stiffness_image
from tests.support.public_names import PACKAGES, public_names

#: Public objects by name, without their packages.
NAMES = {full.rpartition(".")[2]: found for full, found in public_names().items()}


def test_a_script_with_exported_names_builds_solves_and_measures_tissue():
    tissue, boundary = np.ones((20, 30), int), np.zeros((20, 30), int)
    tissue[8:12] = 2
    boundary[:, :2], boundary[:, -2:] = 1, 2
    stiffness = stiffness_image(tissue, [Material(1, "soft", 1.0), Material(2, "stiff", 50.0)])
    rules = [BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0, 3))]
    observed, confidence = boundary_images(boundary, rules, spacing=1)
    solution = solve(Problem(observed=observed, confidence=confidence, stiffness=stiffness))
    field = solution.displacement
    strain = equivalent_strain(green_lagrange_strain(field, spacing=1, tissue=solution.tissue))
    assert np.ptp(field[10, :, 1]) == pytest.approx(3, abs=0.01)
    assert 0.03 < strain.mean() < 0.3
    assert not fold_mask(field, spacing=1).any()
    bright = StiffnessCurve(((0, 1), (255, 100)))
    assert bright(np.uint8([[0, 255]])).tolist() == [[1, 100]]


def test_every_exported_name_exists_once_and_documents_its_parameters():
    assert len(NAMES) == len(public_names()), "two packages export the same name"
    for module in PACKAGES.values():
        assert len(module.__all__) == len(set(module.__all__))
    for found in NAMES.values():
        assert not inspect.ismodule(found)
    for name, found in NAMES.items():
        text = inspect.getdoc(found) or ""
        assert not callable(found) or text, name
        if inspect.isfunction(found):
            assert not inspect.signature(found).parameters or "Parameters\n-----" in text, name
        elif inspect.isclass(found) and not issubclass(found, Exception):
            assert re.search(r"^(Parameters|Attributes)\n-----", text, re.M), name


def test_at_most_two_options_of_a_function_are_given_by_position():
    for name, found in NAMES.items():
        if inspect.isfunction(found):
            given = inspect.signature(found).parameters.values()
            options = [each for each in given if each.default is not each.empty]
            assert len([o for o in options if o.kind is o.POSITIONAL_OR_KEYWORD]) <= 2, name


def test_the_top_package_imports_its_packages_on_demand():
    for package, module in PACKAGES.items():
        name = package.removeprefix("napari_hmrf").lstrip(".")
        assert not name or getattr(napari_hmrf, name) is module
        assert set(module.__all__) <= set(dir(module))
    assert not hasattr(napari_hmrf, "phantom")
    assert not hasattr(napari_hmrf.tissue, "Material")


#: Libraries and modules that take long to import.
HEAVY = ("napari", "qtpy", "PyQt6", "PySide6", "superqt", "magicgui", "moderngl", "glcontext")
HEAVY += ("numba", "matplotlib", "vispy", "pandas")
HEAVY += ("scipy.ndimage", "scipy.optimize", "scipy.linalg", "scipy.sparse")


def test_importing_the_packages_and_the_commands_loads_no_heavy_library():
    """Import all packages in one process: no package then loads a heavy library alone, either."""
    lines = ["import sys"]
    for package in (*PACKAGES, "napari_hmrf.cli"):
        lines.append(f"from {package} import *")  # The names, too: some are loaded on first use.
        lines.append(f"print({package!r}, [n for n in {HEAVY!r} if n in sys.modules])")
    command = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert [line for line in done.stdout.splitlines() if not line.endswith("[]")] == []


def test_the_help_of_the_shell_needs_only_the_standard_library():
    lines = "import sys; from napari_hmrf.cli import parser_of_commands; parser_of_commands()"
    lines += "; print([name for name in ('numpy', 'pydantic', 'scipy') if name in sys.modules])"
    command = [sys.executable, "-c", lines]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_the_default_model_is_elastic_and_a_result_names_its_model(tmp_path):
    problem = napari_hmrf.data.phantom("mass-effect", 32).problem
    usual, elastic, large, papers, converged = (
        solve(problem, backend="cpu"),
        solve(problem, ElasticPrior(), optimizer=Multigrid(), backend="cpu"),
        solve(problem, NeoHookeanPrior(), backend="cpu"),
        solve(problem, SeilerPrior(), backend="cpu"),
        solve(problem, SeilerPrior(), optimizer=Multigrid(), backend="cpu"),
    )
    np.testing.assert_array_equal(usual.displacement, elastic.displacement)
    models = usual, large, papers, converged
    assert [each.provenance.model for each in models] == [*get_args(ModelName)]
    assert papers.iterations == 6 * 70
    assert np.abs(papers.displacement - usual.displacement).max() > 0.1
    for solution in models:
        path = solution.write(tmp_path / "kept.npz")
        assert Solution.read(path).provenance.model == solution.provenance.model


@pytest.mark.parametrize("name", get_args(ModelName))
def test_a_model_name_selects_the_model(name):
    prior, optimizer = parts_of(name)
    parameters = {"prior": prior.parameters, "optimizer": optimizer.parameters}
    assert model_name(parameters) == name
    assert Provenance("cpu", "a device", parameters=parameters).model == name


@pytest.mark.parametrize("parameters", [{}, {"prior": 3}, {"prior": {"name": "?"}}, None, [1]])
def test_unknown_parameters_have_no_model_name(parameters):
    assert model_name(parameters) == ""


def test_the_blanket_conditional_has_its_own_model_name():
    problem = napari_hmrf.data.phantom("bar", 32).problem
    blanket = SeilerPrior(conditional="blanket")
    for optimizer, name in ((ICM(3), "paper, blanket"), (Multigrid(), "paper, blanket, converged")):
        solution = solve(problem, blanket, optimizer=optimizer, backend="cpu")
        assert solution.provenance.model == name


LABELS, IMAGE, FIELD = np.ones((4, 5), int), np.ones((4, 5)), np.zeros((4, 5, 2))
HELD = np.zeros((4, 5, 2))
HELD[0] = HELD[-1] = 1
PROBLEM = Problem(observed=FIELD, confidence=HELD, stiffness=IMAGE)
MOVED = {"displacement": FIELD, "spacing": (1, 1), "tissue": None}


def images_of_rule(**of_the_rule):
    return boundary_images(LABELS, [BoundaryRule(**of_the_rule)], spacing=1)


#: Valid arguments of each call.
CALLS = {
    "Problem": {"observed": FIELD, "confidence": HELD, "stiffness": IMAGE, "spacing": (1, 1)},
    "solve": {
        "problem": PROBLEM,
        "prior": ElasticPrior(),
        "optimizer": Multigrid(),
        "backend": "cpu",
        "progress": None,
        "cancel": None,
        "initial": None,
    },
    "LiveSolver": {"deliver": print, "prior": None, "optimizer": None, "backend": "cpu"},
    "ElasticPrior": {"poisson": 0.3, "plane": "stress", "penalty": 1.0},
    "NeoHookeanPrior": {"poisson": 0.3, "plane": "stress", "penalty": 1.0},
    "SeilerPrior": {"penalty": 1.0, "conditional": "centred", "damping": 1.0},
    "ICM": {"iterations": 2, "steps": None, "energy_change": None},
    "Multigrid": {"tolerance": 1e-3, "max_iterations": 3},
    "warp": {"image": IMAGE, **MOVED, "order": 1, "fill": 0},
    "resample": {"image": IMAGE, "coordinates": FIELD, "covered": IMAGE, "order": 1, "fill": 0},
    "inverse_map": MOVED,
    "jacobian_determinant": MOVED,
    "count_folds": MOVED,
    "fold_mask": MOVED,
    "deformation_gradient": MOVED,
    "small_strain": MOVED,
    "green_lagrange_strain": MOVED,
    "deformation_grid": {**MOVED, "every": 2, "pieces": 2},
    "arrows": {**MOVED, "about": 3},
    "magnitude": {"displacement": FIELD},
    "principal_strains": {"strain": np.eye(2)},
    "equivalent_strain": {"strain": np.eye(2), "through": 0.0},
    "strain_through_slice": {"strain": np.eye(2), "poisson": 0.3},
    "phantom": {"name": "bar", "size": 16},
    "chest_phantom": {"size": 96, "breath": 4.0},
    "head_phantom": {"size": 24, "growth": 1.0},
    "sample": {"name": "bar"},
    "reference_displacement": {"name": "bar"},
    "Warper": {"pictures": IMAGE, "spacing": (1, 1)},
    "stiffness_image": {"labels": LABELS, "materials": [Material(1, "a", 1.0)]},
    "poisson_image": {"labels": LABELS, "materials": [Material(1, "a", 1.0)]},
    "boundary_images": {"labels": LABELS, "rules": [BoundaryRule(1, "fixed")], "spacing": (1, 1)},
    "sliding_precision": {"stiffness": IMAGE, "painted": IMAGE, "spacing": 1, "strength": 9.0},
    "StiffnessCurve": {"points": ((0, 1), (1, 2)), "void_below": None, "between": "straight"},
    "luminance": {"colours": np.zeros((3, 3, 3))},
    "is_solution_file": {"path": "none.npz"},
}
#: Objects that are made first and checked on use.
CALLS_OF = {
    "a picture": (
        lambda **of: Warper(Picture(**of), spacing=(1, 1)),
        {"image": IMAGE, "order": 1, "fill": 0},
    ),
    "a material": (
        lambda **of: stiffness_image(LABELS, [Material(**of)]),
        {"label": 1, "name": "a", "stiffness": 1.0},
    ),
    "a ratio": (
        lambda **of: poisson_image(LABELS, [Material(1, "a", **of)]),
        {"stiffness": 1.0, "poisson": 0.3},
    ),
    "a move": (
        images_of_rule,
        {"label": 1, "action": "move", "vector": (1, 1), "confidence": (1, 1)},
    ),
    "an expansion": (images_of_rule, {"label": 1, "action": "expand", "amount": 1.0}),
    "intensities": (StiffnessCurve(((0, 1), (1, 2))), {"intensities": IMAGE}),
    "percentiles": (StiffnessCurve.from_percentiles, {"intensities": np.arange(20.0)}),
    "a stored curve": (StiffnessCurve.from_dict, {"values": {"points": ((0, 1), (1, 2))}}),
    "a stored solution": (Solution.read, {"path": "none.npz"}),
}
CALLS_OF |= {name: (NAMES[name], good) for name, good in CALLS.items()}

WRONG = [
    *(None, "a", b"a", 3, -1, 0.5, 1j, math.nan, math.inf, True, object(), {1}, {"a": 1}),
    *([], [[1, 2], [3]], (1, "b"), range(3), np.float32(1), np.zeros(0), np.zeros((3, 3, 3))),
    *(np.zeros((4, 5), complex), np.array(["a"]), np.array([None, 1]), np.full((4, 5), np.nan)),
    *(
        np.full((4, 5, 2), np.nan),
        np.ma.masked_equal(np.ones((4, 5)), 1),
        np.array(["2020"], "M8[D]"),
    ),
    *(PROBLEM, str, ICM(), SeilerPrior(), Material(1, "a", 1.0), lambda *given: None),
]


@pytest.mark.parametrize("name", CALLS_OF)
def test_any_wrong_argument_is_refused_with_a_short_error_of_the_package(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    call, good = CALLS_OF[name]
    said = []
    for argument in good:
        # An integer may be an open file descriptor, which the test must not close.
        wrong = [each for each in WRONG if argument != "path" or type(each) not in (int, bool, str)]
        for each in wrong:
            try:
                call(**{**good, argument: each})
            except HmrfError as error:
                said.append(str(error))
    assert len(said) >= len(WRONG) / 2
    assert [each for each in said if len(each) > 400 or "\n" in each] == []


def test_an_argument_of_a_wrong_type_raises_a_type_error_that_is_a_value_error():
    with pytest.raises(TypeError):
        solve(IMAGE)
    assert issubclass(ArgumentError, ValueError)


def test_a_function_of_a_displacement_requires_its_spacing():
    for name, found in NAMES.items():
        parameters = inspect.signature(found).parameters if inspect.isfunction(found) else {}
        if "displacement" in parameters and name not in ("magnitude", "rmsd"):
            spacing = parameters["spacing"]
            assert spacing.kind is spacing.KEYWORD_ONLY, name
            assert spacing.default is spacing.empty, name
