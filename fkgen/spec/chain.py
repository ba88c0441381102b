"""Finite Markov chains: which states are visited, and the law that stays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def stationary_law(transition: ArrayLike) -> Array | None:
    """The law that one step does not change; None if there are several.

    Parameters
    ----------
    transition : (N, N) array_like
        Rows sum to one.

    Returns
    -------
    (N,) ndarray or None
        Transient states have exactly zero.

    References
    ----------
    Grassmann, Taksar & Heyman 1985: elimination without a subtraction.
    """
    P = np.asarray(transition, float)
    reach = _reaches(P)
    recurrent = [i for i in range(len(P)) if all(reach[j, i] for j in np.flatnonzero(reach[i]))]
    if not reach[np.ix_(recurrent, recurrent)].all():
        return None
    law = np.zeros(len(P))
    law[recurrent] = _irreducible_law(P[np.ix_(recurrent, recurrent)])
    return law


def visited(transition: ArrayLike, initial: ArrayLike) -> NDArray[np.bool_]:
    """Which states a chain with this start can ever be in, (N,)."""
    start = np.asarray(initial, float) > 0.0
    return np.asarray(_reaches(np.asarray(transition, float))[start].any(axis=0))


def period(transition: ArrayLike) -> int:
    """Greatest common divisor of the lengths of all cycles among recurrent states.

    Parameters
    ----------
    transition : (N, N) array_like
        A chain with one recurrent class.
    """
    P = np.asarray(transition, float)
    reach = _reaches(P)
    start = next(i for i in range(len(P)) if all(reach[j, i] for j in np.flatnonzero(reach[i])))
    level, queue, found = {start: 0}, [start], 0
    for i in queue:  # breadth first: an edge that closes a cycle tells its length
        for j in np.flatnonzero(P[i] > 0.0).tolist():
            if j not in level:
                level[j] = level[i] + 1
                queue.append(j)
            found = math.gcd(found, level[i] + 1 - level[j])
    return found


def _reaches(P: Array) -> NDArray[np.bool_]:
    """Whether j can be reached from i in any number of steps, none included."""
    reach: NDArray[np.bool_] = (P > 0.0) | np.eye(len(P), dtype=bool)
    for middle in range(len(P)):
        reach |= np.outer(reach[:, middle], reach[middle])
    return reach


def _irreducible_law(transition: Array) -> Array:
    P = transition.copy()
    n = len(P)
    for last in range(n - 1, 0, -1):
        P[:last, last] /= P[last, :last].sum()
        P[:last, :last] += np.outer(P[:last, last], P[last, :last])
    law = np.ones(n)
    for i in range(1, n):
        law[i] = law[:i] @ P[:i, i]
    return np.asarray(law / law.sum())
