"""Probabilities of a spec: one, a distribution, a transition matrix.

Finite Markov chains: which states are visited, and the law that stays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_list, as_number

Distribution = tuple[float, ...]
Transition = tuple[Distribution, ...]  # Pr(j at k+1 | i at k)
Array = NDArray[np.float64]

#: Largest distance of a sum from one that is taken for what a user rounded when typing.
SUM_TOLERANCE = 1e-9

#: Sums closer to one than this stay as they are; others are divided by their sum.
ROUNDING = 1e-14


def as_probability(value: object, place: Place) -> float:
    """Return a number in [0, 1]."""
    number = as_number(value, place, "a probability in [0, 1]")
    if not 0.0 <= number <= 1.0:
        raise place.error(show(number), "a probability in [0, 1]")
    return number


def as_distribution(value: object, place: Place, count: int, what: str) -> Distribution:
    """Return ``count`` probabilities that sum to one."""
    entries = as_list(value, place, f"a list of {count} probabilities, {what}", count)
    found = tuple(as_probability(entry, place.item(i)) for i, entry in enumerate(entries))
    total = sum(found)
    if abs(total - 1.0) > SUM_TOLERANCE:
        raise place.error(f"probabilities that sum to {total:.12g}", "a sum of 1")
    return found if abs(total - 1.0) <= ROUNDING else tuple(each / total for each in found)


def read_transition(section: Section, key: str, order: str, count: int) -> Transition:
    """Return a (count, count) transition matrix: row i is the law of the next state after i."""
    place = section.place.entry(key)
    expected = f"a {count} x {count} matrix, states ordered {order}, rows that sum to 1"
    rows = as_list(section.require(key, expected), place, expected, count, "rows")
    what = f"the law of the next state, ordered {order}"
    return tuple(as_distribution(row, place.item(i), count, what) for i, row in enumerate(rows))


def read_initial(section: Section, stationary: Array | None, count: int, what: str) -> Distribution:
    """Return the law of the first state: the stationary one if it is not said, and there is one."""
    if "initial" in section:
        place = section.place.entry("initial")
        return as_distribution(section.table["initial"], place, count, what)
    if stationary is None:
        raise section.error(
            "initial",
            "nothing (the key is missing), and several stationary laws",
            f"{count} probabilities, {what}: where the chain starts decides where it stays",
        )
    return tuple(stationary.tolist())


def stationary_law(transition: ArrayLike) -> Array | None:
    """The law that one step does not change; None if there are several.

    Grassmann, Taksar & Heyman 1985: elimination without a subtraction.
    """
    P = np.asarray(transition, float)
    reach = _reaches(P)
    recurrent = [i for i in range(len(P)) if all(reach[j, i] for j in np.flatnonzero(reach[i]))]
    if not reach[np.ix_(recurrent, recurrent)].all():
        return None
    law = np.zeros(len(P))
    P = P[np.ix_(recurrent, recurrent)]
    for last in range(len(P) - 1, 0, -1):
        P[:last, last] /= P[last, :last].sum()
        P[:last, :last] += np.outer(P[:last, last], P[last, :last])
    found = np.ones(len(P))
    for i in range(1, len(P)):
        found[i] = found[:i] @ P[:i, i]
    law[recurrent] = found / found.sum()
    return law


def visited(transition: ArrayLike, initial: ArrayLike) -> NDArray[np.bool_]:
    """Which states a chain with this start can ever be in, (N,)."""
    start = np.asarray(initial, float) > 0.0
    return np.asarray(_reaches(np.asarray(transition, float))[start].any(axis=0))


def period(transition: ArrayLike) -> int:
    """Greatest common divisor of the lengths of all cycles among recurrent states."""
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
