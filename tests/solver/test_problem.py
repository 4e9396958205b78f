"""Problem: validation of its arrays, which are copied and made read-only."""

import numpy as np
import pytest

from napari_hmrf import Problem, ProblemError
from napari_hmrf.solver.problem import part_of, variant_of


def valid_arrays(shape=(5, 4)):
    y = np.zeros((*shape, 2))
    c = np.zeros((*shape, 2))
    c[0] = 1
    m = np.ones(shape)
    return y, c, m


def test_inputs_are_copied_converted_and_frozen():
    y, c, m = valid_arrays()
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=[0.5, 2])
    m[:] = 7
    assert problem.stiffness.max() == 1
    assert problem.shape == (5, 4)
    assert problem.spacing == (0.5, 2.0)
    assert problem.unit == pytest.approx(1.0)
    for array in (problem.observed, problem.confidence, problem.stiffness, problem.tissue):
        assert not array.flags.writeable
    assert (
        problem.observed.dtype == problem.confidence.dtype == problem.stiffness.dtype == np.float32
    )
    with pytest.raises(AttributeError):
        problem.stiffness = m


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.astype(">f8"),
        np.asfortranarray,
        lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
        lambda a: a.astype(np.float16),
        lambda a: np.ascontiguousarray(a, dtype=np.longdouble),
    ],
    ids=["big-endian", "fortran", "negative strides", "half", "long double"],
)
def test_any_memory_layout_gives_the_same_problem(change):
    arrays = [np.round(np.random.default_rng(0).random((4, 6)), 2) + 1]
    arrays += [np.round(np.random.default_rng(1).random((4, 6, 2)), 1) for _ in range(2)]
    m, y, c = (array.astype(np.float16).astype(float) for array in arrays)
    expected = Problem(observed=y, confidence=c, stiffness=m)
    changed = Problem(observed=change(y), confidence=change(c), stiffness=change(m))
    for field in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(changed, field), getattr(expected, field))


def test_observations_without_confidence_are_ignored():
    y, c, m = valid_arrays()
    y[4] = np.nan
    assert np.isfinite(Problem(observed=y, confidence=c, stiffness=m).observed).all()


def test_integers_and_booleans_are_accepted():
    y, c, _ = valid_arrays()
    problem = Problem(
        observed=y.astype(int),
        confidence=c.astype(bool),
        stiffness=np.ones((5, 4), dtype=np.uint16) * 40000,
    )
    assert problem.stiffness[0, 0] == 40000


def arrays_with(field, where, value):
    y, c, m = valid_arrays()
    arrays = {"observed": y, "confidence": c, "stiffness": m}
    arrays[field][where] = value
    return arrays


@pytest.mark.parametrize(
    ("arrays", "field", "says"),
    [
        (
            arrays_with("stiffness", (1, 2), np.nan),
            "stiffness",
            r"at 1 pixel that are NaN .* \(1, 2\)",
        ),
        (arrays_with("stiffness", (1, 2), -np.inf), "stiffness", r"\(1, 2\)"),
        (
            arrays_with("stiffness", (3, 0), -2),
            "stiffness",
            r"1 negative values, the first at \(3, 0\)",
        ),
        (arrays_with("stiffness", ..., 0), "stiffness", "no tissue"),
        (arrays_with("stiffness", (0, 0), 1e9), "stiffness", "ten million times"),
        (arrays_with("stiffness", (0, 0), 1e300), "stiffness", "beyond single precision"),
        (arrays_with("stiffness", ..., 1e-44), "stiffness", r"is 1e-44 at \(0, 0\).*choose a unit"),
        (
            arrays_with("stiffness", (1, 2), 1e-60),
            "stiffness",
            r"is 1e-60 at \(1, 2\).*0 where there is no tissue",
        ),
        (arrays_with("stiffness", ..., 3e38), "stiffness", r"is 3e\+38 at \(0, 0\).*choose a unit"),
        (arrays_with("confidence", (2, 1, 1), np.nan), "confidence", r"at 1 pixel .* \(2, 1\)\."),
        (
            arrays_with("confidence", (2, 1, 1), 1.5),
            "confidence",
            r"at 1 pixel outside 0 to 1, the first at \(2, 1\)\.",
        ),
        (arrays_with("confidence", (2, 1), 1.5), "confidence", r"at 1 pixel outside 0 to 1"),
        (arrays_with("confidence", (2, 1, 0), -0.1), "confidence", "outside 0 to 1"),
        (arrays_with("confidence", ..., 0), "confidence", "Mark at least one place"),
        (arrays_with("stiffness", 0, 0), "confidence", "only where there is no tissue"),
        (
            arrays_with("observed", (0, 3, 0), np.inf),
            "observed",
            r"where confidence is above 0, the first at \(0, 3\)\.",
        ),
    ],
)
def test_an_invalid_value_is_named_with_its_position(arrays, field, says):
    with pytest.raises(ProblemError, match=says) as caught:
        Problem(**arrays)
    assert caught.value.field == field
    assert str(caught.value).startswith(f"{field}: ")


@pytest.mark.parametrize(
    ("field", "shape"),
    [
        ("observed", (5, 4)),
        ("confidence", (5, 4, 3)),
        ("observed", (4, 5, 2)),
        ("confidence", (5, 4, 1)),
    ],
)
def test_arrays_on_different_grids_are_rejected_with_both_shapes(field, shape):
    y, c, m = valid_arrays()
    arrays = {"observed": y, "confidence": c, "stiffness": m, field: np.zeros(shape)}
    with pytest.raises(ProblemError, match=r"\(5, 4\)") as caught:
        Problem(**arrays)
    assert caught.value.field == field
    assert str(shape) in str(caught.value)


@pytest.mark.parametrize("shape", [(0, 5), (1, 1), (5,), (0, 4, 5), (1, 1, 1), (2, 2, 2, 2), ()])
def test_grids_that_cannot_deform_are_rejected(shape):
    ndim = len(shape)
    with pytest.raises(ProblemError) as caught:
        Problem(
            observed=np.zeros((*shape, ndim)),
            confidence=np.ones((*shape, ndim)),
            stiffness=np.ones(shape),
        )
    assert caught.value.field == "stiffness"


def test_a_volume_has_three_components_and_three_spacings():
    m = np.ones((3, 4, 5))
    problem = Problem(
        observed=np.zeros((3, 4, 5, 3)),
        confidence=np.ones((3, 4, 5, 3)),
        stiffness=m,
        spacing=(2, 1, 1),
    )
    assert problem.is_volume
    assert problem.unit == pytest.approx(2 ** (1 / 3))
    assert Problem(
        observed=np.zeros((3, 4, 5, 3)), confidence=np.ones((3, 4, 5, 3)), stiffness=m
    ).spacing == (1, 1, 1)
    with pytest.raises(ProblemError, match=r"\(3, 4, 5, 3\) is needed"):
        Problem(observed=np.zeros((3, 4, 5, 2)), confidence=np.ones((3, 4, 5, 3)), stiffness=m)
    with pytest.raises(ProblemError, match="3 positive"):
        Problem(
            observed=np.zeros((3, 4, 5, 3)),
            confidence=np.ones((3, 4, 5, 3)),
            stiffness=m,
            spacing=(1, 1),
        )


def test_arrays_in_the_wrong_order_are_rejected_with_the_right_order():
    y, c, m = valid_arrays()
    with pytest.raises(ProblemError, match="Pass one value for each pixel"):
        Problem(observed=m, confidence=c, stiffness=y)


@pytest.mark.parametrize(
    "spacing",
    [
        (0, 1),
        (1,),
        (1, 1, 1),
        (np.nan, 1),
        (-1, 1),
        (np.inf, 1),
        "ab",
        "11",
        None,
        (1e-200, 1),
        (1e200, 1),
        {0.5, 0.8},
        frozenset({0.5, 0.8}),
        {0.5: "row", 0.8: "col"},
    ],
)
def test_an_invalid_spacing_is_rejected(spacing):
    y, c, m = valid_arrays()
    with pytest.raises(ProblemError, match=r"pixel sizes|positive numbers|unit of length"):
        Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


@pytest.mark.parametrize("kind", [complex, object, str])
def test_arrays_of_other_than_real_numbers_are_rejected(kind):
    y, c, m = valid_arrays()
    with pytest.raises(ProblemError, match="type"):
        Problem(observed=y, confidence=c, stiffness=m.astype(kind))


def test_rows_of_different_length_are_rejected():
    y, c, _ = valid_arrays()
    with pytest.raises(ProblemError, match="rows of different lengths"):
        Problem(observed=y, confidence=c, stiffness=[[1, 2], [3]])


def test_a_masked_array_is_rejected():
    y, c, m = valid_arrays()
    with pytest.raises(ProblemError, match="mask would be lost"):
        Problem(observed=y, confidence=c, stiffness=np.ma.masked_less(m, 0))


@pytest.mark.parametrize("shape", [(1, 7), (7, 1), (2, 2)])
def test_thin_grids_are_accepted(shape):
    y, c, m = np.zeros((*shape, 2)), np.ones((*shape, 2)), np.ones(shape)
    assert Problem(observed=y, confidence=c, stiffness=m).shape == shape


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.01, 0.02), (300.0, 100.0)])
def test_a_motion_far_beyond_the_image_is_rejected_as_a_wrong_unit(spacing):
    """A motion of up to two image diagonals is accepted; a larger motion names its first pixel."""
    y, c, m = valid_arrays()
    c[2, 3] = (0, 1)
    reach = 2 * np.hypot(*np.multiply(m.shape, spacing))
    y[2, 3] = (0, 0.999 * reach)
    Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)
    y[2, 3] = (0, -1.001 * reach)
    with pytest.raises(
        ProblemError, match=r"observed: moves tissue by up to .* the image is only"
    ) as caught:
        Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)
    assert "(2, 3)" in str(caught.value)
    assert "Use the unit of length in which a pixel is" in str(caught.value)


def test_a_huge_motion_without_confidence_is_ignored():
    y, c, m = valid_arrays()
    y[2, 3], c[2, 3] = 1e30, 0
    assert not Problem(observed=y, confidence=c, stiffness=m).observed[2, 3].any()


def test_equal_maps_of_later_problems_are_one_array_and_others_are_checked():
    y, c, m = (array.astype(np.float32) for array in valid_arrays())
    first = Problem(observed=y, confidence=c, stiffness=m)
    second = Problem(observed=y + 1, confidence=c.copy(), stiffness=m.copy())
    assert second.confidence is first.confidence
    assert second.stiffness is first.stiffness
    assert second.known is first.known
    assert (second.known_values == 1).all()
    assert (first.known_values == 0).all()
    c[1, 2, 0] = np.nan
    with pytest.raises(ProblemError, match=r"confidence: .* the first at \(1, 2\)"):
        Problem(observed=y, confidence=c, stiffness=m)
    m[3, 1] = -1
    with pytest.raises(ProblemError, match=r"stiffness: has 1 negative .* the first at \(3, 1\)"):
        Problem(observed=y, confidence=first.confidence, stiffness=m)
    y[0, 3, 1] = np.inf
    with pytest.raises(ProblemError, match=r"observed: .* the first at \(0, 3\)"):
        Problem(observed=y, confidence=first.confidence, stiffness=first.stiffness)


def test_few_values_in_single_precision_are_kept_as_many_in_double_precision_are():
    y, c, m = valid_arrays((9, 8))
    y[:] = np.arange(y.size).reshape(y.shape) / 64
    m[0, 2] = 0  # an observation in void
    few = Problem(observed=y.astype(np.float32), confidence=c, stiffness=m)
    many = Problem(observed=y, confidence=c, stiffness=m)
    assert np.array_equal(few.observed, many.observed)
    assert few.known_at.tolist() == many.known_at.tolist() == [0, 1, 2, 3, *range(6, 16)]
    assert np.array_equal(few.known_values, many.known_values)


def test_a_variant_with_other_observations_remembers_nothing_of_the_first():
    y, c, m = valid_arrays()
    problem = Problem(observed=y, confidence=c, stiffness=m)
    assert problem.known_at.size == 8
    assert not problem.known_values.any()
    other = variant_of(problem, observed=problem.observed + 1, confidence=problem.confidence[::-1])
    assert other.known_at.tolist() == list(range(32, 40))
    assert other.known_values.tolist() == [1] * 8
    part = part_of(problem, (slice(0, 2), slice(1, 3)))
    assert part.known_at.tolist() == [0, 1, 2, 3]


def test_the_repr_of_a_problem_is_one_line_without_arrays():
    c, m = np.zeros((300, 200, 2)), np.full((300, 200), 10.0)
    c[:2], m[100:] = (0, 1), 0.12345
    problem = Problem(observed=np.zeros_like(c), confidence=c, stiffness=m, spacing=(0.5, 1))
    assert repr(problem) == (
        "Problem(300 x 200 sites of 0.5 x 1, 400 observed, stiffness 0.123 to 10)"
    )


@pytest.mark.parametrize(
    ("stiffness", "says"),
    [
        ([2, 2, 2], "stiffness 2"),
        ([2, 0, 5], "2 of tissue, 2 observed, stiffness 2 to 5"),
        ([2, 5, np.inf], "stiffness 2 to 5 and rigid"),
        ([np.inf, 0, 0], "1 of tissue, 1 observed, stiffness rigid"),
    ],
)
def test_the_repr_of_a_problem_mentions_void_and_rigid_tissue(stiffness, says):
    problem = Problem(
        observed=np.zeros((1, 3, 2)), confidence=np.ones((1, 3, 2)), stiffness=[stiffness]
    )
    assert repr(problem).endswith(f"{says})")


def test_observed_and_confidence_cannot_be_swapped_by_position():
    with pytest.raises(TypeError, match="positional"):
        Problem(*valid_arrays())
