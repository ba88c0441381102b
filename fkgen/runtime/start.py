"""Where a filter starts: the prior of the spec, one that the caller brings, or a snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.problem.covariance import SEMIDEFINITE, negative_direction
from fkgen.problem.functions.named import UNIT_TOLERANCE
from fkgen.runtime import record
from fkgen.runtime.layout import Layout
from fkgen.runtime.results import Snapshot

Array = NDArray[np.floating]

#: Keys of a start.
KEYS = ("x0", "P0")

#: Largest difference of mirrored entries, relative to the two standard deviations, in units of the
#: last place of the filter's scalar: what products of matrices leave.
ASYMMETRY = 64.0


#: Means (K, n) and packed covariances (K, ne(ne+1)/2); None for those of the spec.
Priors = tuple[Array | None, Array | None]


def priors(layout: Layout, start: Any, records: int | None = None) -> Priors:
    """What is given of means and covariances, of which there are one, or one for each record.

    Raises
    ------
    DataError
        If a key, a shape or a number is wrong, or a covariance is none.
    """
    if not isinstance(start, Mapping):
        given, expected = type(start).__name__, "a Snapshot or a mapping with 'x0' and 'P0'"
        raise DataError("start", given=given, expected=expected)
    for key in start:
        if key not in KEYS:
            expected = record.choice(str(key), KEYS)
            raise DataError(f"start.{key}", given="an unknown key", expected=expected)
    x0, P0 = (start.get(key) for key in KEYS)
    n, ne, kind = len(layout.states), len(layout.errors), layout.dtype
    means: Array | None = None
    packed: Array | None = None
    if x0 is not None:
        means = _stacked("x0", x0, (n,), layout, records)
        _check_rotations(layout, np.asarray(means, float))
    if P0 is not None:
        covariances = _stacked("P0", P0, (ne, ne), layout, records)
        rows, columns = np.tril_indices(ne)
        packed = np.ascontiguousarray(covariances[:, rows, columns])
        for m, covariance in enumerate(() if _definite(covariances, kind) else covariances):
            name = f"P0[{m}]" if len(covariances) > 1 else "P0"
            _check(name, np.asarray(covariance, float), kind)
    return means, packed


def _stacked(
    what: str, value: ArrayLike, shape: tuple[int, ...], layout: Layout, records: int | None
) -> Array:
    """One or, for several records, as many arrays of this shape, all of them finite."""
    array = record.numbers(what, value, layout.dtype)
    several = () if records is None else ((records, *shape),)
    if array.shape not in (shape, *several):
        expected = " or ".join(f"shape {each}" for each in (shape, *several))
        if layout.attitudes:
            names = ", ".join(layout.errors if len(shape) > 1 else layout.states)
            expected += f": {names}"
        raise DataError(what, given=f"shape {array.shape}", expected=expected)
    if not np.isfinite(array).all():
        at = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        place = "".join(f"[{i}]" for i in at)
        raise DataError(f"{what}{place}", given=str(array[at]), expected="a finite number")
    return array.reshape(-1, *shape)


def _check_rotations(layout: Layout, means: NDArray[np.float64]) -> None:
    """Refuse quaternions that are far from unit length; C scales the others."""
    for at in layout.attitudes:
        lengths = np.linalg.norm(means[:, at : at + 4], axis=1)
        for m in np.flatnonzero(~(np.abs(lengths - 1.0) <= UNIT_TOLERANCE)).tolist():
            name = layout.states[at].removesuffix("[0]")
            expected = f"a unit quaternion (w, x, y, z) for {name}, to within {UNIT_TOLERANCE:g}"
            place = f"x0[{m}, {at}]" if len(means) > 1 else f"x0[{at}]"
            given = f"four numbers of length {lengths[m]:.6g}"
            raise DataError(place, given=given, expected=expected)


def _definite(covariances: Array, kind: type[np.floating]) -> bool:
    """Whether all of them are plainly positive definite, which is quickly seen."""
    whole = np.asarray(covariances, float)
    scale = np.sqrt(np.abs(np.diagonal(whole, axis1=1, axis2=2)))
    allowed = ASYMMETRY * np.finfo(kind).eps * scale[:, :, None] * scale[:, None, :]
    if (np.abs(whole - whole.swapaxes(1, 2)) > allowed).any():
        return False
    try:
        np.linalg.cholesky(whole)
    except np.linalg.LinAlgError:
        return False
    return True


def _check(what: str, covariance: NDArray[np.float64], kind: type[np.floating]) -> None:
    """Refuse what is no covariance."""
    scale = np.sqrt(np.abs(np.diag(covariance)))
    allowed = ASYMMETRY * np.finfo(kind).eps * scale[:, None] * scale
    wrong = np.argwhere(np.abs(covariance - covariance.T) > allowed)
    if len(wrong):
        i, j = wrong[0].tolist()
        given = " and ".join(f"[{a}][{b}] = {covariance[a, b]:.6g}" for a, b in ((i, j), (j, i)))
        raise DataError(what, given=given, expected="a symmetric matrix, as every covariance is")
    if given := negative_direction(np.tril(covariance) + np.tril(covariance, -1).T):
        raise DataError(what, given=given, expected=SEMIDEFINITE)


def own_bytes(layout: Layout, snapshot: Any) -> bytes:
    """The instance that a snapshot holds, if it is one of the same filter."""
    if not isinstance(snapshot, Snapshot):
        raise DataError("snapshot", given=type(snapshot).__name__, expected="a Snapshot")
    theirs = snapshot.layout
    if (theirs.name, theirs.spec) != (layout.name, layout.spec):
        given = f"one of the filter {theirs.name!r}, spec {theirs.spec}"
        expected = f"one of {layout.name!r}, spec {layout.spec}"
        raise DataError("snapshot", given=given, expected=expected)
    return snapshot.data
