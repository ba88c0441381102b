"""Covariance matrices: symmetric, without a negative direction, exactly symmetric afterwards."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.table.place import Place
from fkgen.problem.text.matrix import Matrix, mirrored

#: What is expected of every covariance.
SEMIDEFINITE = "a positive semidefinite matrix, as every covariance is"

#: Largest difference of mirrored entries, relative to the largest entry.
SYMMETRY_TOLERANCE = 1e-12

#: The same relative to the two standard deviations: large entries do not hide small ones.
CORRELATION_TOLERANCE = 1e-6

#: Most negative eigenvalue, relative to the largest one, that is taken for rounding.
NEGATIVE_TOLERANCE = 1e-10

#: Smallest eigenvalue, relative to the largest one, of a matrix that counts as regular.
SINGULAR_TOLERANCE = 1e-12


def checked_covariance(matrix: Matrix, place: Place, defaults: Mapping[str, float]) -> Matrix:
    """Return a covariance matrix with its upper triangle mirroring the lower one."""
    result = mirrored(matrix)
    if matrix != result:
        _check_symmetry(matrix, place, defaults)
    if given := negative_direction(result.values(defaults)):
        raise place.error(given, SEMIDEFINITE)
    return result


def is_singular(values: NDArray[np.float64]) -> bool:
    """Whether a covariance has a direction without variance, decided on its correlations."""
    if not np.diag(values).all():
        return True
    eigenvalues = _correlation_eigenvalues(values)
    return bool(eigenvalues[0] <= SINGULAR_TOLERANCE * eigenvalues[-1])


def nearby(defaults: Mapping[str, float]) -> list[Mapping[str, float]]:
    """Return the defaults and three points near them, to tell expressions apart by their values."""

    def moved(step: float) -> Mapping[str, float]:
        return {
            name: value * (1.0 + step * (1.0 + 0.37 * index)) + step * (value == 0.0)
            for index, (name, value) in enumerate(defaults.items())
        }

    return [defaults, moved(0.013), moved(-0.029), moved(0.057)]


def values_nearby(
    matrix: Matrix, defaults: Mapping[str, float]
) -> list[tuple[Mapping[str, float], NDArray[np.float64]]]:
    """Return such points, as far as they lie in the domain of every entry, and the values there."""
    found = []
    for point in [defaults] if matrix.is_constant else nearby(defaults):
        with contextlib.suppress(ArithmeticError):
            found.append((point, matrix.values(point)))
    return found


def _check_symmetry(matrix: Matrix, place: Place, defaults: Mapping[str, float]) -> None:
    for point, values in values_nearby(matrix, defaults):
        with np.errstate(over="ignore"):
            difference = np.abs(np.tril(values - values.T))
        deviation = np.sqrt(np.abs(np.diag(values)))
        allowed = np.minimum(
            SYMMETRY_TOLERANCE * np.abs(values).max(),
            CORRELATION_TOLERANCE * deviation[:, None] * deviation,
        )
        entries = ", ".join(f"{name} = {point[name]:.6g}" for name in sorted(matrix.names))
        for i, j in np.argwhere(difference > allowed):
            raise place.error(
                f"entries [{i}][{j}] = {float(values[i, j])!r} and "
                f"[{j}][{i}] = {float(values[j, i])!r}{entries and f' at {entries}'}",
                "a symmetric matrix, as every covariance is",
            )


def negative_direction(values: NDArray[np.float64]) -> str:
    """Say where a symmetric matrix is no covariance; empty if it is one."""
    given = ""
    variances = np.diag(values)
    smallest = f"smallest eigenvalue {np.linalg.eigvalsh(values)[0]:.6g}"
    present = variances > 0
    if (variances < 0).any():
        i = int(np.argmin(variances))
        given = f"the variance {variances[i]:.6g} on the diagonal at [{i}][{i}] ({smallest})"
    elif values[~present].any():
        i, j = (int(index[0]) for index in np.nonzero(values * ~present[:, None]))
        given = f"variance 0 at [{i}][{i}] beside covariance {values[i, j]:.6g} at [{i}][{j}]"
        given += f" ({smallest})"
    elif present.any():
        eigenvalues = _correlation_eigenvalues(values[np.ix_(present, present)])
        if eigenvalues[0] < -NEGATIVE_TOLERANCE * eigenvalues[-1]:
            given = f"a matrix with {smallest} ({eigenvalues[0]:.6g} when scaled to unit diagonal)"
    return given


def _correlation_eigenvalues(values: NDArray[np.float64]) -> NDArray[np.float64]:
    deviation = np.sqrt(np.diag(values))
    return np.asarray(np.linalg.eigvalsh(values / deviation[:, None] / deviation), float)
