"""The part of the state that some rows of y measure, and the rest: Lee & Lee, (37)-(39)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.covariance import nearby
from fkgen.problem.model import Model
from fkgen.problem.table.place import Place

Array = NDArray[np.float64]

#: A column of which less is left beside those chosen before it is a combination of them.
_INDEPENDENT = 1e-10

#: Rounding of the entries of C, relative to the largest of their row.
_SAME = 1e-9

_WAY_OUT = "for the family cpcf; the family dfcf takes any rows"


def typical_deviation(model: Model, defaults: Mapping[str, float]) -> Array:
    """Standard deviations (n,) of the states, from P0 + Q: to compare states of different units."""
    variance = np.diag(model.P0.values() + model.Q.values(defaults))
    known = variance > 0.0
    least = float(variance[known].min()) if known.any() else 1.0
    return np.sqrt(np.where(known, variance, 1e-6 * least))


def measured_states(C1: Array, deviation: Array) -> tuple[int, ...]:
    """The states that the rows of C1 measure most of all, ascending; fewer if rows are dependent.

    The state that contributes most to what the rows vary by comes first, then the one that adds
    most to it, and so on; ``deviation`` (n,) says by how much states vary.
    """
    whole = C1 * deviation
    whole = whole / np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), np.finfo(float).tiny)
    size, rest = np.linalg.norm(whole, axis=0), whole
    chosen: list[int] = []
    for _ in C1:
        length = np.linalg.norm(rest, axis=0)
        length[length <= _INDEPENDENT * size] = 0.0
        j = int(np.argmax(length))
        if length[j] == 0.0:
            break
        chosen.append(j)
        direction = rest[:, j] / length[j]
        rest = rest - np.outer(direction, direction @ rest)
    return tuple(sorted(chosen))


def similarity(C1: Array, deviation: Array) -> Array:
    """The transformation T = [T1; T2] of (38).

    Parameters
    ----------
    C1 : (m, n) ndarray
        Independent rows of C.
    deviation : (n,) ndarray
        By how much the states vary.

    Returns
    -------
    (n, n) ndarray
        C1 = phi T1. Where the rows measure m states and no other, T1 are these states, and T is a
        permutation. Elsewhere T1 are the rows. T2 are the states that are left beside
        `measured_states`, as they are.

    Notes
    -----
    (38) leaves T2 open, and with it what F11 of (39) is, but for permutations. This choice knows
    neither units nor the order of the states, and keeps F11 as small as it can be so.
    """
    n = C1.shape[1]
    measured = list(measured_states(C1, deviation))
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
    measured = measured_states(C1, typical_deviation(model, defaults))
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
