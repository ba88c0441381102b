"""The part of the state that some rows of y measure, and the rest: Lee & Lee, (37)-(39)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fkgen.spec.covariance import nearby
from fkgen.spec.model import Model
from fkgen.spec.place import Place

Array = NDArray[np.float64]

#: Shares of a column that must not be explained by the columns chosen before it: well-conditioned
#: choices first, then whatever rank decides on.
_INDEPENDENT = (1e-3, 1e-10)

#: Rounding of the entries of C, relative to the largest of their row.
_SAME = 1e-9

_WAY_OUT = "for the family cpcf; the family dfcf takes any rows"


def measured_states(C1: Array) -> tuple[int, ...]:
    """The first states that the rows of C1 tell apart, ascending; fewer than rows if they cannot.

    Units of states and measurements do not matter.
    """
    m = len(C1)
    chosen: list[int] = []
    for share in _INDEPENDENT:
        chosen = []
        rest = C1 / np.maximum(np.abs(C1).max(axis=1, keepdims=True), np.finfo(float).tiny)
        size = np.linalg.norm(rest, axis=0)
        for j in range(C1.shape[1]):
            length = float(np.linalg.norm(rest[:, j]))
            if len(chosen) < m and length > share * size[j]:
                chosen.append(j)
                direction = rest[:, j] / length
                rest = rest - np.outer(direction, direction @ rest)
        if len(chosen) == m:
            break
    return tuple(chosen)


def similarity(C1: Array) -> Array:
    """The transformation T = [T1; T2] of (38).

    Parameters
    ----------
    C1 : (m, n) ndarray
        Independent rows of C.

    Returns
    -------
    (n, n) ndarray
        C1 = phi T1. Where the rows measure m states and no other, T1 are these states, and T is a
        permutation. Elsewhere T1 are the rows. T2 are states that are left, as they are.

    Notes
    -----
    (38) leaves T2 open, and with it what F11 of (39) is, but for permutations. This choice knows no
    units of measurement.
    """
    n = C1.shape[1]
    measured = list(measured_states(C1))
    others = [j for j in range(n) if j not in measured]
    T1 = C1 if C1[:, others].any() else np.eye(n)[measured]
    return np.vstack([T1, np.eye(n)[others]])


def check_partial_state(
    model: Model, rows: Sequence[int], place: Place, defaults: Mapping[str, float]
) -> None:
    """Refuse rows of y that are not phi [I 0] T x with det phi != 0.

    Parameters
    ----------
    model : Model
        The plant.
    rows : sequence of int
        The compression group.
    place : Place
        Of the model.
    defaults : mapping of str to float
        The parameters and their default values.

    Raises
    ------
    SpecError
        If the rows are linearly dependent, or what they measure changes with parameters by
        more than a factor phi.
    """
    which = _named(model, rows)
    where, C1 = place.entry("C"), model.C.values(defaults)[list(rows)]
    measured = measured_states(C1)
    if len(measured) < len(rows):
        raise where.error(
            f"linearly dependent rows {which}: rank {len(measured)} of {len(rows)}",
            f"a compression group phi [I 0] T with det(phi) != 0, (37), {_WAY_OUT}",
        )
    T1 = np.linalg.solve(C1[:, measured], C1)
    for point in [] if model.C.is_constant else nearby(defaults):
        try:
            now = model.C.values(point)[list(rows)]
        except ArithmeticError:  # outside the domain of an entry: this point says nothing
            continue
        apart = np.abs(now - now[:, measured] @ T1)
        if (apart > _SAME * np.abs(now).max(axis=1, keepdims=True)).any():
            moving = ", ".join(sorted(model.C.names))
            raise where.error(
                f"rows {which} that measure other combinations of states as {moving} change",
                f"a compression group phi T1 x with a constant T1, (37), {_WAY_OUT}",
            )


def _named(model: Model, rows: Sequence[int]) -> str:
    return ", ".join(f"{row} ({model.outputs[row].name})" for row in rows)
