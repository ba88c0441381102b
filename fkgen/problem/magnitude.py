"""Numbers so large or small that the arithmetic of a filter would leave the range of its scalar."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fkgen.problem.table.place import Place
from fkgen.problem.text.matrix import Matrix

#: Smallest variance above zero, and largest entry of any matrix: squares and reciprocals still fit.
LIMITS = {"double": (1e-100, 1e100), "float": (1e-30, 1e18)}


def check_magnitudes(
    plant: object, place: Place, defaults: Mapping[str, float], scalar: str
) -> None:
    """Refuse entries of a model or mode beyond `LIMITS`; parameters have their default values."""
    names = ("A", "B", "C", "D", "Q", "R", "x0", "P0", "c")
    found = {name: getattr(plant, name) for name in names if hasattr(plant, name)}
    _check(found, place, defaults, scalar)


def _check(
    matrices: Mapping[str, Matrix], place: Place, defaults: Mapping[str, float], scalar: str
) -> None:
    smallest, largest = LIMITS[scalar]
    for name, matrix in matrices.items():
        values = matrix.values(defaults)
        for i, j in np.argwhere(np.abs(values) > largest).tolist():
            raise _at(place, name, i, j).error(
                f"{values[i, j]:g}", f"at most {largest:g} in magnitude with scalar {scalar!r}"
            )
        if name in ("Q", "R", "P0"):
            tiny = (np.diag(values) > 0.0) & (np.diag(values) < smallest)
            for i in np.flatnonzero(tiny).tolist():
                raise _at(place, name, i, i).error(
                    f"{values[i, i]:g}", f"0 or at least {smallest:g} with scalar {scalar!r}"
                )


def _at(place: Place, name: str, i: int, j: int) -> Place:
    """Where an entry stands; x0 and c are written as flat lists."""
    where = place.entry(name)
    return where.item(i) if name in ("x0", "c") else where.item(i, j)
