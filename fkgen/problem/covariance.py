"""Covariance matrices: symmetric, without a negative direction, exactly symmetric afterwards."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.table.place import Place
from fkgen.problem.text.matrix import Matrix, mirrored

SYMMETRY_TOLERANCE = 1e-12
"""Largest difference of mirrored entries, relative to the largest entry."""

CORRELATION_TOLERANCE = 1e-6
"""The same relative to the two standard deviations: large entries do not hide small ones."""

NEGATIVE_TOLERANCE = 1e-10
"""Most negative eigenvalue, relative to the largest one, that is taken for rounding."""

SINGULAR_TOLERANCE = 1e-12
"""Smallest eigenvalue, relative to the largest one, of a matrix that counts as regular."""


def checked_covariance(matrix: Matrix, place: Place, defaults: Mapping[str, float]) -> Matrix:
    """Return a covariance matrix with its upper triangle mirroring the lower one."""
    _check_symmetry(matrix, place, defaults)
    result = mirrored(matrix)
    _check_sign(result.values(defaults), place)
    return result


def is_singular(values: NDArray[np.float64]) -> bool:
    """Whether a covariance has a direction without variance, decided on its correlations."""
    deviation = np.sqrt(np.diag(values))
    if not deviation.all():
        return True
    eigenvalues = np.linalg.eigvalsh(_correlation(values, deviation))
    return bool(eigenvalues[0] <= SINGULAR_TOLERANCE * eigenvalues[-1])


def nearby(defaults: Mapping[str, float]) -> list[Mapping[str, float]]:
    """Return the defaults and three points near them, to tell expressions apart by their values."""
    return [
        defaults,
        *(
            {
                name: value * (1.0 + step * (1.0 + 0.37 * index)) + step * (value == 0.0)
                for index, (name, value) in enumerate(defaults.items())
            }
            for step in (0.013, -0.029, 0.057)
        ),
    ]


def _correlation(
    values: NDArray[np.float64], deviation: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(values / deviation[:, None] / deviation[None, :])


def _check_symmetry(matrix: Matrix, place: Place, defaults: Mapping[str, float]) -> None:
    exact = matrix.is_constant or matrix == mirrored(matrix)
    for point in [defaults] if exact else nearby(defaults):
        try:
            values = matrix.values(point)
        except ArithmeticError:  # outside the domain of an entry: this point says nothing
            continue
        with np.errstate(over="ignore"):
            difference = np.abs(np.tril(values - values.T))
        deviation = np.sqrt(np.abs(np.diag(values)))
        allowed = np.minimum(
            SYMMETRY_TOLERANCE * np.abs(values).max(),
            CORRELATION_TOLERANCE * deviation[:, None] * deviation[None, :],
        )
        for i, j in np.argwhere(difference > allowed):
            raise place.error(
                f"entries [{i}][{j}] = {float(values[i, j])!r} and "
                f"[{j}][{i}] = {float(values[j, i])!r}{_written(matrix, point)}",
                "a symmetric matrix, as every covariance is",
            )


def _written(matrix: Matrix, point: Mapping[str, float]) -> str:
    entries = ", ".join(f"{name} = {point[name]:.6g}" for name in sorted(matrix.names))
    return f" at {entries}" if entries else ""


def _check_sign(values: NDArray[np.float64], place: Place) -> None:
    expected = "a positive semidefinite matrix, as every covariance is"
    variances = np.diag(values)
    smallest = float(np.linalg.eigvalsh(values)[0])
    if (variances < 0).any():
        i = int(np.argmin(variances))
        raise place.error(
            f"the variance {variances[i]:.6g} on the diagonal at [{i}][{i}] "
            f"(smallest eigenvalue {smallest:.6g})",
            expected,
        )
    present = variances > 0
    if values[~present].any():
        i, j = (int(index[0]) for index in np.nonzero(values * ~present[:, None]))
        raise place.error(
            f"variance 0 at [{i}][{i}] beside covariance {values[i, j]:.6g} at [{i}][{j}] "
            f"(smallest eigenvalue {smallest:.6g})",
            expected,
        )
    if not present.any():
        return
    deviation = np.sqrt(variances[present])
    eigenvalues = np.linalg.eigvalsh(_correlation(values[np.ix_(present, present)], deviation))
    if eigenvalues[0] < -NEGATIVE_TOLERANCE * eigenvalues[-1]:
        raise place.error(
            f"a matrix with smallest eigenvalue {smallest:.6g} "
            f"({eigenvalues[0]:.6g} when scaled to unit diagonal)",
            expected,
        )
