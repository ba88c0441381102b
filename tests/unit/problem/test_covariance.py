"""What counts as a covariance, and as a singular one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fkgen.errors import SpecError
from fkgen.problem.covariance import checked_covariance, is_singular
from fkgen.problem.table.place import Place
from fkgen.problem.text.expression import parse
from fkgen.problem.text.matrix import Matrix

PLACE = Place("x.toml", "model.Q")


def check(values: object, **defaults: float) -> Matrix:
    matrix = values if isinstance(values, Matrix) else Matrix.of(values)
    return checked_covariance(matrix, PLACE, defaults)


def texts(*rows: tuple[str, ...]) -> Matrix:
    return Matrix(tuple(tuple(parse(entry) for entry in row) for row in rows))


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 8),
    rank=st.integers(0, 8),
    decades=st.integers(0, 9),
)
def test_products_pass_whatever_their_rank_and_units(
    seed: int, n: int, rank: int, decades: int
) -> None:
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.integers(-decades, decades + 1, n)
    factor = units[:, None] * rng.normal(size=(n, rank))
    result = check(factor @ factor.T).values()
    np.testing.assert_array_equal(result, result.T)


def test_rounding_is_no_asymmetry() -> None:
    result = check([[1.0, 0.3], [0.3 * (1 + 1e-13), 1.0]]).values()
    assert result[0, 1] == result[1, 0] == 0.3 * (1 + 1e-13)


@pytest.mark.parametrize(
    "values",
    [
        [[1.0, 0.3], [0.3 + 1e-9, 1.0]],
        [[1.0, 0.0], [1e-3, 1.0]],
        [[1e12, 0.0, 0.0], [0.0, 1e-6, 5e-7], [0.0, -5e-7, 1e-6]],
        [[1e308, 1e308], [-1e308, 1e308]],
    ],
)
def test_asymmetry_is_refused(values: list[list[float]]) -> None:
    with pytest.raises(SpecError, match=r"x\.toml: model\.Q: .* expected a symmetric matrix"):
        check(values)


@pytest.mark.parametrize(
    ("values", "given"),
    [
        ([[-1.0]], "the variance -1 on the diagonal at [0][0] (smallest eigenvalue -1)"),
        ([[1.0, 2.0], [2.0, 1.0]], "smallest eigenvalue -1 (-1 when scaled to unit diagonal)"),
        ([[1e8, 20.0], [20.0, 1e-6]], "(-1 when scaled to unit diagonal)"),
        ([[0.0, 1e-9], [1e-9, 1.0]], "variance 0 at [0][0] beside covariance 1e-09 at [0][1]"),
        ([[1.0, 1.0 + 1e-6], [1.0 + 1e-6, 1.0]], "smallest eigenvalue -1e-06"),
    ],
)
def test_negative_directions_are_refused(values: list[list[float]], given: str) -> None:
    with pytest.raises(SpecError) as caught:
        check(values)
    assert given in caught.value.given
    assert "positive semidefinite" in caught.value.expected


@pytest.mark.parametrize("values", [[[0.0]], np.zeros((3, 3)), np.ones((3, 3)), [[0, 0], [0, 2]]])
def test_singular_covariances_are_covariances(values: object) -> None:
    assert is_singular(check(values).values())


@pytest.mark.parametrize("values", [[[1e-30]], np.diag([1e12, 1e-12]), [[1.0, 0.99], [0.99, 1.0]]])
def test_small_units_are_not_singular(values: object) -> None:
    assert not is_singular(check(values).values())


def test_equal_expressions_may_look_different() -> None:
    matrix = texts(("1.0", "a*b"), ("b*a", "1.0"))
    assert check(matrix, a=0.2, b=0.5).rows[0][1] == parse("b*a")


def test_expressions_that_agree_at_the_defaults_only_are_refused() -> None:
    matrix = texts(("1.0", "a"), ("a**2", "1.0"))
    with pytest.raises(SpecError, match=r"\[1\]\[0\] = .* at a = 1\.013"):
        check(matrix, a=1.0)


def test_a_point_outside_the_domain_says_nothing() -> None:
    matrix = texts(("2.0", "sqrt(1 - a)"), ("sqrt(1 - a) + 0*a", "1.0"))
    assert check(matrix, a=1.0).is_constant is False
    matrix = texts(("2.0", "sqrt(1 - a)"), ("(1 - a)**0.5", "1.0"))
    assert check(matrix, a=1.0).rows[0][1] == parse("(1 - a)**0.5")
