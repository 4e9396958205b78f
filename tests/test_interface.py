"""Tests of the public interface: exported names, signatures and errors."""

import doctest
import inspect
import math
import re
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
    LiveSolver,
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
#: Number of arguments that may be given by position.
WHAT_A_CALL_IS_ABOUT = {
    "BoundaryRule": 2,
    "ElasticPrior": 1,
    "ICM": 1,
    "Landmarks": 2,
    "LiveSolver": 2,
    "Loads": 0,
    "MeasuredMotion": 3,
    "Multigrid": 1,
    "NeoHookeanPrior": 1,
    "Picture": 1,
    "Problem": 3,
    "RandomDeformation": 2,
    "SeilerPrior": 0,
    "SlidingParts": 1,
    "StrainScale": 1,
    "StiffnessCurve": 1,
    "Warper": 1,
    "arrows": 1,
    "edge_confidence": 1,
    "chest_phantom": 1,
    "head_phantom": 1,
    "boundary_images": 2,
    "count_folds": 1,
    "deformation_gradient": 1,
    "deformation_grid": 1,
    "fold_mask": 1,
    "green_lagrange_strain": 1,
    "growth": 1,
    "inverse_map": 1,
    "jacobian_determinant": 1,
    "resample": 3,
    "read_study": 1,
    "materials_by_name": 1,
    "pressure": 3,
    "sliding_precision": 2,
    "reactions": 3,
    "cavity": 2,
    "traction": 3,
    "weight": 2,
    "write_movie": 3,
    "read_field": 1,
    "register": 2,
    "fit": 2,
    "fit_study": 2,
    "sample_posterior": 3,
    "check_agreement": 2,
    "fit_scale": 2,
    "stiffness_map": 2,
    "study_uncertainty": 2,
    "uncertainty": 3,
    "replay": 1,
    "write_points": 3,
    "write_study": 3,
    "small_strain": 1,
    "solve": 2,
    "solve_cases": 2,
    "solve_study": 1,
    "warp": 2,
    "write_field": 2,
    "write_truth": 2,
}


def test_a_script_with_exported_names_builds_solves_and_measures_tissue():
    tissue, boundary = np.ones((20, 30), int), np.zeros((20, 30), int)
    tissue[8:12] = 2
    boundary[:, :2], boundary[:, -2:] = 1, 2
    stiffness = stiffness_image(tissue, [Material(1, "soft", 1.0), Material(2, "stiff", 50.0)])
    rules = [BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0, 3))]
    solution = solve(Problem(*boundary_images(boundary, rules, spacing=1), stiffness))
    field = solution.displacement
    strain = equivalent_strain(green_lagrange_strain(field, spacing=1, tissue=solution.tissue))
    assert np.ptp(field[10, :, 1]) == pytest.approx(3, abs=0.01)
    assert 0.03 < strain.mean() < 0.3
    assert not fold_mask(field, spacing=1).any()
    bright = StiffnessCurve(((0, 1), (255, 100)))
    assert bright(np.uint8([[0, 255]])).tolist() == [[1, 100]]


def test_every_exported_name_exists_once_and_has_a_docstring():
    assert len(NAMES) == len(public_names()), "two packages export the same name"
    for module in PACKAGES.values():
        assert len(module.__all__) == len(set(module.__all__))
    for found in NAMES.values():
        assert not inspect.ismodule(found)
        assert not callable(found) or inspect.getdoc(found)


def test_the_top_package_has_few_names_and_imports_its_packages_on_demand():
    assert len(napari_hmrf.__all__) < 40
    for package, module in PACKAGES.items():
        name = package.removeprefix("napari_hmrf").lstrip(".")
        assert not name or getattr(napari_hmrf, name) is module
        assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match="'napari_hmrf' has no attribute 'phantom'"):
        napari_hmrf.phantom  # noqa: B018
    with pytest.raises(AttributeError, match=r"'napari_hmrf\.tissue' has no attribute 'Material'"):
        napari_hmrf.tissue.Material  # noqa: B018


def test_the_help_lists_every_package_and_its_example_runs():
    page = inspect.getdoc(napari_hmrf)
    for package, module in PACKAGES.items():
        assert re.search(rf"^{package} +\w", page, re.M), package
        assert inspect.getdoc(module), package
    (example,) = doctest.DocTestFinder(recurse=False).find(napari_hmrf)
    assert len(example.examples) <= 10
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert said == []


def test_functions_for_files_begin_with_read_or_write():
    methods = {each for found in NAMES.values() if isinstance(found, type) for each in dir(found)}
    verbs = {name.partition("_")[0] for name in {*NAMES, *methods}}
    assert {"read", "write"} <= verbs
    assert not verbs & {"save", "open", "dump", "store"}
    assert not [name for name in NAMES if name.startswith("load_")], "'load' denotes a force here"


@pytest.mark.parametrize(("name", "count"), WHAT_A_CALL_IS_ABOUT.items())
def test_optional_arguments_are_keyword_only(name, count):
    parameters = inspect.signature(NAMES[name]).parameters.values()
    unnamed = [each for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
    assert len(unnamed) == count


def test_every_callable_with_options_is_in_the_list():
    """Except `phantom(name, size)` and records: rows of tables, marks, studies and results."""
    records = {"Material", "Monitor", "Phantom", "Provenance", "Solution", "phantom"}
    records |= {"Study", "Grid", "Frame", "Tissue", "Motion", "Cavity", "Pictures"}
    records |= {"Field", "LandmarkFile", "Measurement", "NamedMaterials", "Fit"}
    records |= {"BatchProgress", "Case", "CaseOutcome", "NamedCase", "Update"}
    records |= {"Drawing", "Arrow", "Landmark", "Stroke"}
    choices = set()
    for name, found in NAMES.items():
        if callable(found) and not (isinstance(found, type) and issubclass(found, Exception)):
            given = inspect.signature(found).parameters.values()
            if any(each.default is not each.empty for each in given):
                choices.add(name)
    assert choices - records - {"equivalent_strain"} <= set(WHAT_A_CALL_IS_ABOUT)


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
        with np.load(path, allow_pickle=False) as file:
            assert f'"model": "{solution.provenance.model}"' in str(file["header"])


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
PROBLEM = Problem(FIELD, HELD, IMAGE)
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


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda: solve(IMAGE), r"problem is array.*of type ndarray\. Pass a Problem"),
        (lambda: solve(PROBLEM, Multigrid()), r"prior is Multigrid.*Pass a prior: ElasticPrior"),
        (lambda: solve(PROBLEM, optimizer=ElasticPrior()), "optimizer is .*Pass an optimizer"),
        (lambda: solve(PROBLEM, optimizer=Multigrid), "optimizer is .*Pass an optimizer"),
        (lambda: LiveSolver(3), "deliver is 3, of type int. Pass a function to call"),
        (lambda: Multigrid("x"), "tolerance must be a positive number, in pixels, not 'x'"),
        (lambda: ICM(steps=3), r"steps must be positive numbers, such as \(1, 0.1\).*, not 3"),
        (lambda: ICM("many"), "iterations must be a positive whole number, not 'many'"),
        (lambda: SeilerPrior(conditional="both"), 'must be "centred" or "blanket", not \'both\''),
        (lambda: ElasticPrior("a"), "poisson: is 'a', of type str. Pass real numbers"),
        (lambda: ElasticPrior(0.6), "poisson must be from 0 to 0.499, not 0.6"),
        (lambda: Problem("a", 1, 2), r"stiffness: has shape \(\), but a 2-D image"),
        (lambda: Problem("a", HELD, IMAGE), "observed: is 'a', of type str. Pass real numbers"),
        (lambda: stiffness_image(LABELS, {1: 5.0}), "materials must be a list of Material"),
        (
            lambda: napari_hmrf.data.phantom("liver"),
            "unknown phantom 'liver'; use one of expansion",
        ),
    ],
)
def test_an_error_names_the_given_value_and_the_expected_value(mistake, says):
    with pytest.raises(HmrfError, match=says) as refused:
        mistake()
    assert isinstance(refused.value, ValueError), "the error is no ValueError"


def test_an_argument_of_a_wrong_type_raises_a_type_error():
    with pytest.raises(TypeError):
        solve(IMAGE)
    assert issubclass(ArgumentError, TypeError)


def test_every_public_function_documents_its_parameters_and_return_value():
    for name, found in NAMES.items():
        text = inspect.getdoc(found) or ""
        if inspect.isfunction(found):
            signature = inspect.signature(found)
            returns = signature.return_annotation not in (None, "None")
            assert not signature.parameters or "Parameters\n-----" in text, name
            assert not returns or "Returns\n-----" in text, name
        elif inspect.isclass(found) and not issubclass(found, Exception):
            assert re.search(r"^(Parameters|Attributes)\n-----", text, re.M), name


def test_a_function_of_a_displacement_requires_its_spacing():
    for name, found in NAMES.items():
        parameters = inspect.signature(found).parameters if inspect.isfunction(found) else {}
        if "displacement" in parameters and name != "magnitude":
            spacing = parameters["spacing"]
            assert spacing.kind is spacing.KEYWORD_ONLY, name
            assert spacing.default is spacing.empty, name
