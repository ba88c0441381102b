"""Probabilities of a spec: one, a distribution, a transition matrix.

Finite Markov chains: which states are visited, and the law that stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_entry, as_list, as_number
from fkgen.problem.text.expression import (
    Expression,
    Number,
    evaluate,
    operation,
    to_text,
)
from fkgen.problem.text.matrix import Matrix

Distribution = tuple[float, ...]
Transition = tuple[Distribution, ...]  # Pr(j at k+1 | i at k)
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FirstLaw:
    """The law of the first state of a chain, where it depends on parameters."""

    stated: tuple[Expression, ...] = ()  # If empty it is the stationary law of the chain

    def at(self, parameters: Mapping[str, float], chain: Transition) -> Distribution:
        """Return the law with these parameters; NaN where a chain has several stationary ones."""
        if self.stated:
            return tuple(evaluate(each, parameters) for each in self.stated)
        law = stationary_law(chain)
        return (math.nan,) * len(chain) if law is None else tuple(law.tolist())


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


def as_rate(value: object, place: Place, defaults: Mapping[str, float]) -> Expression:
    """Return a number in [0, 1], or an expression that is one at the default parameters."""
    rate = as_entry(value, place, defaults, "a probability in [0, 1], or an expression of one")
    number = evaluate(rate, defaults)
    if not 0.0 <= number <= 1.0:
        at = "" if isinstance(rate, Number) else f" at the defaults ({to_text(rate)})"
        raise place.error(f"{number!r}{at}", "a probability in [0, 1]")
    return rate


def as_law(
    value: object, place: Place, count: int, what: str, defaults: Mapping[str, float]
) -> tuple[Expression, ...]:
    """Return ``count`` probabilities, of which some may be expressions."""
    entries = as_list(value, place, f"a list of {count} probabilities, {what}", count)
    found = tuple(as_rate(each, place.item(i), defaults) for i, each in enumerate(entries))
    values = [evaluate(each, defaults) for each in found]
    if all(isinstance(each, Number) for each in found):
        return tuple(map(Number, as_distribution(values, place, count, what)))
    if abs(sum(values) - 1.0) > SUM_TOLERANCE:
        given = f"probabilities that sum to {sum(values):.12g} at the defaults"
        raise place.error(given, "a sum of 1")
    return found


def as_distribution(value: object, place: Place, count: int, what: str) -> Distribution:
    """Return ``count`` probabilities that sum to one."""
    entries = as_list(value, place, f"a list of {count} probabilities, {what}", count)
    found = tuple(as_probability(entry, place.item(i)) for i, entry in enumerate(entries))
    total = sum(found)
    if abs(total - 1.0) > SUM_TOLERANCE:
        raise place.error(f"probabilities that sum to {total:.12g}", "a sum of 1")
    return found if abs(total - 1.0) <= ROUNDING else tuple(each / total for each in found)


def read_transition(section: Section, key: str, order: str, count: int) -> Matrix:
    """Return a (count, count) transition matrix: row i is the law of the next state after i."""
    place = section.place.entry(key)
    expected = f"a {count} x {count} matrix, states ordered {order}, rows that sum to 1"
    rows = as_list(section.require(key, expected), place, expected, count, "rows")
    what = f"the law of the next state, ordered {order}"
    defaults = section.defaults
    return Matrix(
        tuple(as_law(row, place.item(i), count, what, defaults) for i, row in enumerate(rows))
    )


def at_defaults(law: Matrix, section: Section) -> Transition:
    """Return the numbers of a transition matrix at the default parameters."""
    return rows_of(law.values(section.defaults))


def rows_of(values: Array) -> Transition:
    """Return an array as rows of numbers."""
    return tuple(map(tuple, values.tolist()))


def read_initial(
    section: Section, chain: Matrix, resting: Array | None, what: str, own: FirstLaw | None = None
) -> tuple[Distribution, FirstLaw | None]:
    """Return the law of the first state at the defaults, and how it depends on parameters.

    It is the stationary one, ``resting`` at the defaults, if it is not said and there is one;
    ``own`` if the chain is not as it stands.
    """
    count = len(chain.rows)
    if "initial" in section:
        place = section.place.entry("initial")
        law = as_law(section.table["initial"], place, count, what, section.defaults)
        numbers = tuple(evaluate(each, section.defaults) for each in law)
        return numbers, None if Matrix((law,)).is_constant else FirstLaw(law)
    if resting is None:
        at = "" if chain.is_constant else " at the defaults"
        raise section.error(
            "initial",
            f"nothing (the key is missing), and several stationary laws{at}",
            f"{count} probabilities, {what}: where the chain starts decides where it stays",
        )
    if chain.is_constant:
        return tuple(resting.tolist()), None
    first = own or resting_law(chain)
    return first.at(section.defaults, at_defaults(chain, section)), first


def resting_law(chain: Matrix) -> FirstLaw:
    """Return the stationary law of a chain that depends on parameters."""
    if len(chain.rows) != 2:
        return FirstLaw()
    (_, away), (back, _) = chain.rows
    whole = operation("+", away, back)
    return FirstLaw((operation("/", back, whole), operation("/", away, whole)))


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
