"""Matrices of expressions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fkgen.problem.text.expression import Number, parse
from fkgen.problem.text.matrix import Matrix, congruence, mirrored

PARAMETRIC = Matrix(((Number(1.0), parse("tau*rate")), (Number(0.0), parse("exp(tau)"))))


def test_shape_names_and_values() -> None:
    assert PARAMETRIC.shape == (2, 2)
    assert PARAMETRIC.names == {"tau", "rate"}
    assert not PARAMETRIC.is_constant
    values = PARAMETRIC.values({"tau": 2.0, "rate": 3.0, "unused": 4.0})
    assert values.dtype == np.float64
    np.testing.assert_array_equal(values, [[1.0, 6.0], [0.0, np.exp(2.0)]])


def test_a_missing_parameter_raises() -> None:
    with pytest.raises(KeyError, match="rate"):
        PARAMETRIC.values({"tau": 1.0})


def test_a_matrix_without_columns_has_rows() -> None:
    empty = Matrix.zeros(3, 0)
    assert empty.shape == (3, 0)
    assert empty.is_constant
    assert empty.values().shape == (3, 0)


def test_constants_need_no_parameters() -> None:
    matrix = Matrix.of([[1, 2], [3, 4]])
    assert matrix.is_constant
    assert matrix.names == frozenset()
    np.testing.assert_array_equal(matrix.values(), [[1.0, 2.0], [3.0, 4.0]])


def test_matrices_are_values() -> None:
    assert Matrix.of(np.eye(2)) == Matrix.of([[1, 0], [0, 1]])
    assert hash(Matrix.of(np.eye(2))) == hash(Matrix.of([[1, 0], [-0.0, 1]]))
    with pytest.raises(dataclasses.FrozenInstanceError):
        PARAMETRIC.rows = ()  # type: ignore[misc]


def test_the_lower_triangle_wins() -> None:
    np.testing.assert_array_equal(mirrored(Matrix.of([[1, 2], [3, 4]])).values(), [[1, 3], [3, 4]])


def test_congruence_is_exactly_symmetric() -> None:
    rng = np.random.default_rng(1)
    factor, root = rng.normal(size=(4, 3)), rng.normal(size=(3, 3))
    middle = root @ root.T
    result = congruence(Matrix.of(factor), mirrored(Matrix.of(middle))).values()
    np.testing.assert_allclose(result, factor @ middle @ factor.T, rtol=1e-13)
    np.testing.assert_array_equal(result, result.T)
