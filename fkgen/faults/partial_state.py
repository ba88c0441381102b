"""The part of the state that some rows of y measure, and the rest: Lee & Lee, (37)-(39)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.model import Model

Array = NDArray[np.float64]

#: A column of which less is left beside those chosen before it is a combination of them.
_INDEPENDENT = 1e-10

#: Rounding of the entries of C, relative to the largest of their row.
SAME = 1e-9


def typical_deviation(model: Model, defaults: Mapping[str, float]) -> Array:
    """Standard deviations (n,) of the states, from P0 + Q: to compare states of different units."""
    variance = np.diag(model.P0.values(defaults) + model.Q.values(defaults))
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

    C1 (m, n), independent rows, is phi T1. Where the rows measure m states and no other, T1 are
    these states, and T is a permutation. Elsewhere T1 are the rows. T2 are the states that are left
    beside `measured_states`, as they are. (38) leaves T2 open, and with it what F11 of (39) is, but
    for permutations. This choice knows neither units nor the order of the states, and keeps F11 as
    small as it can be so.
    """
    n = C1.shape[1]
    measured = list(measured_states(C1, deviation))
    others = [j for j in range(n) if j not in measured]
    T1 = C1 if C1[:, others].any() else np.eye(n)[measured]
    return np.vstack([T1, np.eye(n)[others]])
